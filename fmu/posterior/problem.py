"""The updating problem: THE log-probability callable that every sampler shares."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import replace
from importlib import import_module
from typing import Annotated, Any

import numpy as np
from annotated_types import Gt, Interval
from numpy.typing import ArrayLike

from fmu.arguments import OwnRule, check_arguments
from fmu.engines.base import Engine
from fmu.fem.pairing.modal_model import Model
from fmu.fem.pairing.rules import SOFTNESS
from fmu.posterior.build import check_names, likelihood_of, paired_model
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.density import Posterior
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.failures import FailureRecord
from fmu.posterior.joint.layout import Layout
from fmu.posterior.parameters import Parameter
from fmu.posterior.reduction.tolerance import Tolerance
from fmu.posterior.reduction.train_reduced import reduced_model
from fmu.posterior.rounding import require_digits
from fmu.types import FloatArray, Positive

_LEAST_NOISE = 1e-150


class UpdatingProblem(Posterior):
    """The posterior of eq. (8): a model, a measurement and the priors of the parameters.

    The full model answers; `reduced` makes the same problem with a reduced model, which is much faster.

    Parameters
    ----------
    model : SeparableModel, BlackBoxModel or ModalModel
        The structure, a function of the user, or any map from theta to the frequencies of the measured modes. Of
        several tests (`fmu.JointProblem`) it maps the parameters in all tests to the modes of all.
    data : ModalData
    parameters : sequence of Parameter
        Parameters of the model, in the order of theta. Standard deviations inferred by `error` follow them.
    pairing : {"shape", "index", "soft"}
        How the modes of a SeparableModel are paired with the measured ones (`fmu.fem.pairing.rules`): by MAC with
        the modes of the model before updating, or by number in the sorted spectrum. ``"soft"``: all of them, with
        weights exp(MAC/τ), so that the log-probability does not jump where modes veer; see
        `fmu.posterior.errors.mixture` for its cost.
    softness : float
        τ, for ``"soft"`` only.
    beta : float or array_like, shape (n_modes,), optional
        Trust in the data, β = 1/(2σ²) (eq. 4): 1/Hz² for frequencies, dimensionless for the modal residual; 1 by
        default, as in the paper. It must not be given if `data` have standard deviations or a covariance.
    error : {"frequency", "modal-residual"}, ErrorModel, or sequence of ErrorModel
        ``"frequency"``: ε = f − f^m in Hz. ``"modal-residual"``: the residual of eq. (2) at the sensors, a
        pseudo-likelihood that needs measured shapes and a SeparableModel (`fmu.posterior.errors.residual`). Or the
        error models to be summed: `fmu.FrequencyErrors`, `fmu.ShapeErrors`, `fmu.MACErrors`; and for data beside
        the modes `fmu.MassErrors` and `fmu.StaticErrors`, with which frequencies keep their default errors.
    name : str
    layout : Layout, optional
        From theta to the parameters of the structure in each of several tests; the identity by default.

    Attributes
    ----------
    ndim : int
    n_structural : int
        Number of parameters before the inferred standard deviations.
    names, units : tuple of str
    lower, upper, start : ndarray, shape (ndim,), SI units
    offset, scale : ndarray, shape (ndim,)
        (theta − offset)/scale is of order one: the unit box where there are bounds.
    prior : JointPrior
    layout : Layout
    tests : tuple of Test
        One, unless the structure was tested several times.
    roles : tuple of Role
        What each parameter is for.
    tolerance : Tolerance or None
        Errors allowed to the reduced model; None where there is none, see `reduced`.
    failures : list of Failure
        ``(theta, reason)`` for every theta inside the bounds whose solve failed or whose log-likelihood was not
        finite, the first ten thousand.
    n_failures : int
        Number of such evaluations.
    is_hierarchical : bool
        Whether parameters have a distribution that is inferred too (`fmu.Population`). The maximum of such a
        posterior lies far from its mass.

    Raises
    ------
    ValueError
        If the model does not fit the parameters or the data, two parameters share a name, or rounding in the
        matrices is larger than the errors of the measurement (`fmu.posterior.rounding`).

    Warns
    -----
    RoundingWarning
        If rounding is not negligible beside those errors.

    Notes
    -----
    theta is in SI units throughout. ``log_prob`` maps ``(ndim,)`` to a float and ``(n, ndim)`` to ``(n,)``; it
    is ``-inf`` outside the bounds, and never an exception for a finite theta.
    """

    @check_arguments
    def __init__(
        self,
        model: Annotated[Model, OwnRule()],
        data: ModalData,
        parameters: Sequence[Parameter],
        *,
        pairing: str = "shape",
        softness: Positive = SOFTNESS,
        beta: Annotated[ArrayLike, Gt(0.0)] | None = None,
        error: str | ErrorModel | Sequence[ErrorModel] = "frequency",
        name: str = "problem",
        layout: Layout | None = None,
    ) -> None:
        check_names(parameters)
        self.data, self.name = data, name
        self.layout = Layout.of_one(parameters, data) if layout is None else layout
        self.n_structural = len(self.layout.parameters)
        self.tolerance: Tolerance | None = None
        self.model = paired_model(model, data, parameters, pairing, softness)
        self.likelihood = likelihood_of(error, beta, model, self.model, data, parameters)
        self.parameters = (*self.layout.parameters, *self.likelihood.noise)
        check_names(self.parameters)
        self.ndim = len(self.parameters)
        self.names = tuple(p.name for p in self.parameters)
        self.units = tuple(p.unit for p in self.parameters)
        self.lower = np.array([p.lower for p in self.parameters], dtype=float)
        self.upper = np.array([p.upper for p in self.parameters], dtype=float)
        # as rows, like one theta, which spares it NumPy's broadcasting; open where the prior vanishes at a bound
        self._lowest = np.array([[p.lowest for p in self.parameters]])
        self._highest = np.array([[p.highest for p in self.parameters]])
        # errors of no size at all have no density, and their square must not vanish
        self._lowest[:, self.n_structural :] = np.maximum(self._lowest[:, self.n_structural :], _LEAST_NOISE)
        self.start = np.array([p.start for p in self.parameters], dtype=float)
        scales = [p.prior.scale(p.lower, p.upper) for p in self.parameters]
        self.offset = np.array([offset for offset, _ in scales])
        self.scale = np.array([scale for _, scale in scales])
        self._failed = FailureRecord()
        self.prior = self._prior_of(self.layout)
        require_digits(self)

    @classmethod
    @check_arguments
    def reduced(
        cls,
        *args: Any,
        reduction: Annotated[bool | float, OwnRule()] = True,
        engine: Engine | None = None,
        **options: Any,
    ) -> UpdatingProblem:
        """Return a problem in which a certified reduced model replaces a SeparableModel inside the bounds.

        It is trained here, or read from the cache (`fmu.posterior.reduction.train_reduced`). Others are kept.

        Parameters
        ----------
        *args, **options
            Those of `UpdatingProblem`.
        reduction : bool or float
            Largest relative error of its frequencies, above 0 and at most 0.01; true stands for 1e-6. The error
            allowed to the log-probability follows from it (`fmu.posterior.reduction.tolerance.Tolerance.of`).
            False: the full model is kept.
        engine : Engine, optional
            Trains with its workers (see `fmu.engine`); the result is the same in every bit. It is not kept.

        Raises
        ------
        ValueError
            As `UpdatingProblem` does, and if `reduction` is out of range.

        Warns
        -----
        ReductionWarning
            If training ended before the tolerance was reached.
        """
        tolerance = Tolerance.of(reduction)
        problem = cls(*args, **options)
        if tolerance is None:
            return problem
        problem.tolerance = tolerance
        model, tolerance = reduced_model(problem, tolerance, engine)
        reduced = problem.with_model(model)
        reduced.tolerance = tolerance
        if model.sizes:
            require_digits(reduced)  # the reduced model adds rounding of its own
        return reduced

    @check_arguments
    def using(self, labels: Collection[str]) -> UpdatingProblem:
        """Return the same problem updated with other modes; the model, reduced or not, is shared.

        Parameters
        ----------
        labels : collection of str
            Names of the modes whose measurement is used; the others are paired and predicted only.

        Raises
        ------
        ValueError
            If there is no such mode, or none is named.
        """
        unknown = [name for name in labels if name not in self.data.labels]
        if unknown:
            raise ValueError(f"labels: must be of {', '.join(self.data.labels)} (got {unknown[0]!r})")
        if not labels:
            raise ValueError(f"labels: must name at least one of {', '.join(self.data.labels)} (got none)")
        other = copy(self)
        other.data = replace(self.data, use=tuple(label in labels for label in self.data.labels))
        other.likelihood = self.likelihood.using(other.data.used)
        other._failed = FailureRecord()
        return other

    @check_arguments
    def coarser(self, share: Annotated[float, Interval(gt=0, le=1)]) -> UpdatingProblem:
        """Return the same problem with a model by only a share of its reduced basis, if it has one.

        A solve takes less time and is less accurate: for what may be approximate, such as proposals.
        """
        return self.with_model(self.model.coarser(share))

    def __repr__(self) -> str:
        return f"UpdatingProblem({self.name!r}, {self.ndim} parameters, {self.data.n_modes} modes, {self.model!r})"

    def _repr_html_(self) -> str:
        from fmu.posterior.card import problem_card

        return problem_card(self)

    def sample_prior(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw `n` parameter vectors from the truncated prior, shape (n, ndim)."""
        return np.clip(self.prior.draw(rng, n), self._lowest, self._highest)

    def walkers(self, n: int, seed: int = 1) -> FloatArray:
        """Return starts for the walkers of an ensemble, such as emcee's, shape (n, ndim), SI units.

        They are spread over the maxima of the posterior in proportion to their probability, around each of them
        twice as wide as the posterior, within the bounds and where the log-probability is finite
        (`fmu.analysis.maxima.starts.starts_at_maxima`); of a hierarchical posterior around its middle. The maxima
        are searched for once (`fmu.find_map`). Another seed gives other starts, for another ensemble.

        Parameters
        ----------
        n : int
            At least twice the number of parameters.
        seed : int

        Raises
        ------
        ValueError
            If `n` or `seed` is out of range.
        """
        # the search for maxima is in a layer above: the one call that goes up, when it is made
        found: FloatArray = import_module("fmu.analysis.maxima.starts").walkers(self, n, seed)
        return found

    def simulate_data(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None = None
    ) -> FloatArray:
        """Return computed frequencies with measurement noise added, Hz, shape (n, n_modes).

        Parameters
        ----------
        rng : Generator
        frequencies : ndarray, shape (n, n_modes), Hz
        theta : ndarray, shape (n, ndim), optional
            Where standard deviations are inferred, they are taken from here.

        Raises
        ------
        ValueError
            If the error models give no distribution of the frequencies (shapes alone, the modal residual).
        """
        return self.likelihood.simulate(rng, frequencies, self._noise(theta))

    def simulate_test(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None = None
    ) -> FloatArray:
        """Return simulated frequencies of one more test where the model has `frequencies`, Hz, shape (n, n_modes).

        `simulate_data` repeats the data, the mean of all tests; a single test scatters √n times as much
        (`fmu.posterior.data.repeated.RepeatedTests.simulate`). The parameters are those of `simulate_data`.

        Raises
        ------
        ValueError
            If the data are not the mean of tests.
        """
        if self.data.tests is None:
            raise ValueError("data: must be the mean of repeated tests to simulate one more (got no tests)")
        frequencies = self.likelihood.simulate_discrepancy(rng, frequencies, self._noise(theta))
        return np.asarray(frequencies + self.data.tests.simulate(rng, len(frequencies)))
