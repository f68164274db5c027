"""The updating problem: THE log-probability callable that every sampler shares."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Annotated, Any, Self

import numpy as np
from annotated_types import Gt, Interval
from numpy.typing import ArrayLike

from fmu.arguments import Numbers, OwnRule, check_arguments, require
from fmu.engines.base import Engine
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.rules import SOFTNESS
from fmu.posterior.build import check_names, likelihood_of, paired_model
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import Chain, ErrorModel
from fmu.posterior.failures import Failure, FailureRecord
from fmu.posterior.joint.layout import Layout, Role
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.parameters import JointPrior, Parameter
from fmu.posterior.rounding import require_digits
from fmu.posterior.train_reduced import Tolerance, reduced_model
from fmu.types import BoolArray, FloatArray, Positive

_LEAST_NOISE = 1e-150


class UpdatingProblem:
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
        model: Annotated[SeparableModel | BlackBoxModel | ModalModel, OwnRule()],
        data: ModalData,
        parameters: Sequence[Parameter],
        *,
        pairing: str = "shape",
        softness: Positive = SOFTNESS,
        beta: Annotated[ArrayLike, Gt(0.0)] | None = None,
        error: str | ErrorModel | Sequence[ErrorModel] = "frequency",
        name: str = "problem",
        layout: Annotated[Layout | None, OwnRule()] = None,
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

        It is trained here, or read from the cache (`fmu.posterior.train_reduced`). Other models are unchanged.

        Parameters
        ----------
        *args, **options
            Those of `UpdatingProblem`.
        reduction : bool or float
            Largest relative error of its frequencies, above 0 and at most 0.01; true stands for 1e-6. The error
            allowed to the log-probability follows from it (`fmu.posterior.train_reduced.Tolerance.of`). False: the
            full model is kept.
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

    def with_model(self, model: ModalModel) -> Self:
        """Return the same problem with another model of the same parameters and modes."""
        other = copy(self)
        other.model, other.likelihood = model, self.likelihood.with_model(model)
        other._failed = FailureRecord()
        return other

    def __repr__(self) -> str:
        return f"UpdatingProblem({self.name!r}, {self.ndim} parameters, {self.data.n_modes} modes, {self.model!r})"

    def _repr_html_(self) -> str:
        from fmu.posterior.card import problem_card

        return problem_card(self)

    def log_prob(self, theta: ArrayLike) -> Any:
        """Return log P(θ|D) up to the evidence: the sum of `log_likelihood` and `log_prior`."""
        points, single = self._points(theta)
        within = self._within(points)
        if np.count_nonzero(within) == within.size > 0:  # as a rule; it saves the copies
            value = self._posterior(points)
        else:
            value = np.full(len(points), -np.inf)
            inside = within.all(axis=1)
            if inside.any():
                value[inside] = self._posterior(points[inside])
        return float(value[0]) if single else value

    def log_prob_and_grad(self, theta: ArrayLike) -> tuple[Any, Any]:
        """Return the log-probability and its gradient (NaN outside the bounds), with the shapes of `log_prob`."""
        points, single = self._points(theta)
        within = self._within(points)
        if np.count_nonzero(within) == within.size > 0:
            value, gradient = self._posterior_and_gradient(points)
        else:
            value, gradient = np.full(len(points), -np.inf), np.full(points.shape, np.nan)
            inside = within.all(axis=1)
            if inside.any():
                value[inside], gradient[inside] = self._posterior_and_gradient(points[inside])
        return (float(value[0]), gradient[0]) if single else (value, gradient)

    def log_likelihood(self, theta: ArrayLike) -> Any:
        """Return log P(D|θ), eq. (4) with its normaliser (5); defined outside the bounds too."""
        points, single = self._points(theta)
        value = self._terms(points).sum(axis=1)
        return float(value[0]) if single else value

    def log_likelihood_terms(self, theta: ArrayLike) -> FloatArray:
        """Return the log-likelihood of each datum, shape (n_terms,) or (n, n_terms).

        The modes used in updating come first, then masses and displacements.
        """
        points, single = self._points(theta)
        terms = self._terms(points)
        return terms[0] if single else terms

    def terms_and_misfit(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-likelihood and the squared residuals of each used mode, from the same solves.

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)

        Returns
        -------
        terms : ndarray, shape (n, n_used)
        squares : ndarray, shape (n, n_kinds, n_used)
            Σ r² over the residuals r of a mode, by the error models of ``likelihood.chi_square``.
        """
        terms, squares = self.likelihood.terms_and_misfit(self.layout.of_model(theta))
        return self._record_failures(terms, theta), squares

    def quadratic(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim).

        At theta (n, ndim), of a likelihood of computed modes: JᵀJ of the residuals for the parameters of the
        structure, Fisher's information for the inferred standard deviations.
        """
        return self.likelihood.quadratic(self.layout.of_model(theta), self._chain(theta))

    def sensitivity(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives of errors over their sds, (n, n_residuals, n_structural), at theta (n, ndim)."""
        return self.likelihood.residuals_and_slopes(self.layout.of_model(theta), self._chain(theta))[1]

    def log_prior(self, theta: ArrayLike) -> Any:
        """Return the log-density of the prior (6), normalised over the bounds; ``-inf`` outside them."""
        points, single = self._points(theta)
        value = np.full(len(points), -np.inf)
        inside = self._within(points).all(axis=1)
        value[inside] = self.prior.log_pdf(points[inside])
        return float(value[0]) if single else value

    def log_prior_and_grad(self, theta: ArrayLike) -> tuple[Any, Any]:
        """Return `log_prior` and its gradient (NaN outside the bounds), with the shapes of `log_prob`."""
        points, single = self._points(theta)
        value, gradient = np.full(len(points), -np.inf), np.full(points.shape, np.nan)
        inside = self._within(points).all(axis=1)
        value[inside] = self.prior.log_pdf(points[inside])
        gradient[inside] = self.prior.log_pdf_gradient(points[inside])
        return (float(value[0]), gradient[0]) if single else (value, gradient)

    def frequencies(self, theta: ArrayLike) -> FloatArray:
        """Return the frequencies in Hz paired with the measured modes, shape (n_modes,) or (n, n_modes).

        Works outside the bounds too.
        """
        points, single = self._points(theta)
        frequencies = self.model.frequencies(self.model_parameters(points))
        return frequencies[0] if single else frequencies

    def model_parameters(self, theta: FloatArray) -> FloatArray:
        """Return the parameters of the model, (n, n_parameters), at theta (n, ndim).

        Of several tests the structure's in the first test, then in the second, and so on.
        """
        return self.layout.of_model(theta)[:, : self.model.n_parameters]

    def values(self, theta: ArrayLike) -> FloatArray:
        """Return the parameters of the structure in every test, shape (n_tests, n) or (n_points, n_tests, n).

        Parameters
        ----------
        theta : array_like, shape (ndim,) or (n_points, ndim)

        Returns
        -------
        ndarray
            In the order of the tests, and of ``layout.structural``; the known value where one is known in a test.
        """
        points, single = self._points(theta)
        values = self.layout.values(points[:, : self.n_structural])
        for t, test in enumerate(self.tests):
            for j, parameter in enumerate(self.layout.structural):
                if parameter.name in test.known:
                    values[:, t, j] = test.known[parameter.name]
        return values[0] if single else values

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

    @property
    def failures(self) -> list[Failure]:
        """The points inside the bounds that have no finite log-likelihood, and why; the first ten thousand."""
        return list(self._failed.first)

    @property
    def n_failures(self) -> int:
        """How many evaluations inside the bounds gave no finite log-likelihood."""
        return self._failed.count

    def take_failures(self) -> list[Failure]:
        """Return the failures since this was last called; they remain in `failures`.

        A theta that failed several times is returned once; at most ten thousand are kept, `n_failures` counts all.
        """
        return self._failed.take()

    def configuration(self) -> dict[str, Any]:
        """Return the data that define the posterior, in plain Python types."""
        other = {} if self.tolerance in (None, Tolerance()) else {"reduction": self.tolerance.frequency}
        of_tests = {} if self.layout.is_identity else self.layout.configuration()
        return other | {
            "name": self.name,
            "model": self.model.configuration(),
            "data": self.data.as_dict(),
            "likelihood": self.likelihood.as_dict(),
            "parameters": [
                {
                    "name": p.name,
                    "unit": p.unit,
                    "start": p.start,
                    "lower": p.lower,
                    "upper": p.upper,
                    "prior": p.prior.as_dict(),
                }
                for p in self.parameters
            ],
            **of_tests,
        }

    @property
    def solves_per_gradient(self) -> int:
        """What `log_prob_and_grad` costs at one theta, in solves of the model: 1 where derivatives are exact."""
        of_model = self.model
        return of_model.solves_per_shape_gradient if self.likelihood.needs_shapes else of_model.solves_per_gradient

    @property
    def tests(self) -> tuple[Test, ...]:
        """The tests of the structure."""
        return self.layout.tests

    @property
    def roles(self) -> tuple[Role, ...]:
        """What each parameter of theta is for."""
        return (*self.layout.roles, *[Role("noise", None)] * (self.ndim - self.n_structural))

    @property
    def is_hierarchical(self) -> bool:
        """Whether parameters have a distribution that is inferred: a population."""
        return bool(self.layout.scales)

    def matrices_of(self, k: int) -> tuple[SeparableModel, int] | None:
        """Return the first matrices that parameter `k` of theta changes, and its number there, or None."""
        of = self.roles[k].of
        return None if of is None else self.model.matrices_of(of)

    def with_layout(self, layout: Layout) -> Self:
        """Return the same problem with scores that refer to others, of the same parameters."""
        other = copy(self)
        other.layout, other.prior, other._failed = layout, self._prior_of(layout), FailureRecord()
        return other

    def _prior_of(self, layout: Layout) -> JointPrior:
        return JointPrior(self.parameters, layout if layout.scales else None)

    def _noise(self, theta: FloatArray | None) -> FloatArray | None:
        return None if theta is None else theta[:, self.n_structural :]

    def _chain(self, theta: FloatArray) -> Chain | None:
        """Return the chain rule from the parameters of each test to theta; None if they are the same."""
        if self.layout.is_identity:
            return None
        return partial(self.layout.chain_slopes, theta[:, : self.n_structural])

    def _points(self, theta: ArrayLike) -> tuple[FloatArray, bool]:
        if not isinstance(theta, np.ndarray) or theta.dtype.kind not in "fiu":
            require("theta", theta, Numbers)
        points = np.asarray(theta, dtype=float, order="C")
        if points.ndim not in (1, 2) or points.shape[-1] != self.ndim:
            raise ValueError(f"theta: must have shape ({self.ndim},) or (n, {self.ndim}) (got {points.shape})")
        return (points[None], True) if points.ndim == 1 else (points, False)

    def _within(self, points: FloatArray) -> BoolArray:
        return (points >= self._lowest) & (points <= self._highest)

    def _posterior(self, points: FloatArray) -> FloatArray:
        """Return the log-probability, shape (n,), at points (n, ndim) inside the bounds."""
        return self._terms(points).sum(axis=1) + self.prior.log_pdf(points)

    def _posterior_and_gradient(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        terms, slopes = self.likelihood.terms_and_gradient(self.layout.of_model(points))
        value = self._record_failures(terms, points).sum(axis=1) + self.prior.log_pdf(points)
        if self.layout.is_identity:
            gradient = slopes.sum(axis=1)
        else:
            gradient = self.layout.gradient(points, slopes, self.likelihood.test_of_terms)
        return value, gradient + self.prior.log_pdf_gradient(points)

    def _terms(self, points: FloatArray) -> FloatArray:
        return self._record_failures(self.likelihood.terms(self.layout.of_model(points)), points)

    def _record_failures(self, terms: FloatArray, points: FloatArray) -> FloatArray:
        """Return `terms` with -inf in place of non-finite values, after recording the points that failed."""
        finite = np.isfinite(terms)
        if np.count_nonzero(finite) == finite.size:
            return terms
        failed = ~finite.all(axis=1)
        self._failed.add(
            points[failed & self._within(points).all(axis=1)],
            lambda theta: (
                self.likelihood.why_not_finite(self.layout.of_model(theta[None])[0])
                or "the log-likelihood was not finite, and is when it is computed again"
            ),
        )
        return np.where(failed[:, None], -np.inf, terms)
