"""The protocol of an updating problem, for modules that `fmu.posterior.problem` imports itself."""

from __future__ import annotations

from typing import Any, Protocol, Self

from numpy.typing import ArrayLike

from fmu.fem.pairing.modal_model import ModalModel
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import Likelihood
from fmu.posterior.parameters import JointPrior, Parameter
from fmu.types import FloatArray


class Problem(Protocol):
    """What is documented in `fmu.posterior.problem.UpdatingProblem`."""

    name: str
    data: ModalData
    model: ModalModel
    likelihood: Likelihood
    parameters: tuple[Parameter, ...]
    prior: JointPrior
    ndim: int
    lower: FloatArray
    upper: FloatArray
    start: FloatArray
    offset: FloatArray
    scale: FloatArray

    def with_model(self, model: ModalModel) -> Self:
        """Return the same problem with another model of the same parameters and modes."""
        ...

    def log_prob(self, theta: ArrayLike) -> Any:
        """Return the log-probability."""
        ...

    def log_prob_and_grad(self, theta: ArrayLike) -> tuple[Any, Any]:
        """Return the log-probability and its gradient."""
        ...

    def log_prior(self, theta: ArrayLike) -> Any:
        """Return the log-density of the prior."""
        ...

    def frequencies(self, theta: ArrayLike) -> FloatArray:
        """Return the frequencies paired with the measured modes, Hz."""
        ...

    def configuration(self) -> dict[str, Any]:
        """Return the data that define the posterior."""
        ...
