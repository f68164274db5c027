"""A cheap model with a known error, and the true one behind it."""

from __future__ import annotations

from collections.abc import Sequence

from fmu.fem.certificates import Certificate
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.programs.solves import Failure
from fmu.types import FloatArray


class Approximation(ModalModel):
    """A cheap model that answers in place of a true one, which is too slow to be asked often.

    Its two kinds are Gaussian processes (`fmu.fem.surrogate.surrogate_model.SurrogateModel`), which answer
    everywhere, and the reduced basis of a structure (`fmu.fem.reduced.reduced_structure.ReducedStructure`), which
    answers in a box. Nothing in it changes, but the number of solves of the true model.

    Parameters
    ----------
    truth : ModalModel
    cheap : ModalModel
        Of the same parameters and modes.
    certificate : Certificate, optional
        What is known of the errors of the cheap model where the posterior has its mass, if that is known before a
        run (`fmu.fem.certificates.SurrogateCertificate`).

    Attributes
    ----------
    full_solves : int
        How often the true model had to answer.
    """

    def __init__(self, truth: ModalModel, cheap: ModalModel, certificate: Certificate | None = None) -> None:
        self._truth, self.cheap, self.certificate = truth, cheap, certificate
        self.n_parameters, self.n_modes, self.name = truth.n_parameters, truth.n_modes, cheap.name
        self.structure, self.by_shape, self.is_soft = truth.structure, truth.by_shape, truth.is_soft
        self.gives_shapes, self.is_uncertain = cheap.gives_shapes, cheap.is_uncertain

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.cheap!r})"

    @property
    def truth(self) -> ModalModel:
        """The model that the cheap one approximates."""
        return self._truth

    @property
    def reasons(self) -> Sequence[Failure]:
        """The first points at which the true model failed, and why."""
        return self._truth.reasons

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), at theta (n, n_parameters); NaN where a solve failed."""
        return self.cheap.frequencies(theta)

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters), exact."""
        return self.cheap.frequencies_and_gradient(theta)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return frequencies and shapes at the sensors, with variances if the cheap model is uncertain."""
        return self.cheap.observed(theta, gradient)

    def configuration(self) -> dict[str, object]:
        """Return the data that identify the true model and the cheap one, in plain Python types."""
        return {"surrogate of": self._truth.configuration(), **self.cheap.configuration()}
