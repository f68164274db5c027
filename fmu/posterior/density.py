"""The posterior density of an updating problem: the log-probability of theta, its gradient and its parts."""

from __future__ import annotations

from copy import copy
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import Numbers, require
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.modal_model import ModalModel
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import Likelihood
from fmu.posterior.failures import Failure, FailureRecord
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Role
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.joint import JointPrior
from fmu.posterior.reduction.tolerance import MEASURED, Tolerance
from fmu.types import BoolArray, Chain, ComplexArray, FloatArray, Plain

_LEAST_NOISE = 1e-150


class Posterior:
    """The posterior of eq. (8) of Boulkaibet et al. (`fmu.paper.published`), as a density of theta.

    The layout maps theta to the structural parameters in every test, the model maps these to the modes, and the
    likelihood compares the modes with the data. Methods whose `theta` is ``ArrayLike`` raise ValueError if it has
    the wrong shape. The attributes are set by the subclass `fmu.posterior.problem.UpdatingProblem`.
    """

    name: str
    data: ModalData
    layout: Layout
    model: ModalModel
    likelihood: Likelihood
    prior: JointPrior
    parameters: tuple[Parameter, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    ndim: int
    n_structural: int
    lower: FloatArray
    upper: FloatArray
    start: FloatArray
    offset: FloatArray
    scale: FloatArray
    tolerance: Tolerance | None
    _lowest: FloatArray
    _highest: FloatArray
    _failed: FailureRecord

    def with_model(self, model: ModalModel) -> Self:
        """Return the same problem with another model. The new model must have the same parameters and modes."""
        other = copy(self)
        other.model, other.likelihood = model, self.likelihood.with_model(model)
        other._failed = FailureRecord()
        return other

    def with_likelihood(self, likelihood: Likelihood) -> Self:
        """Return the same problem with another likelihood, which may have other inferred error parameters."""
        other = copy(self)
        other.likelihood, other._failed = likelihood, FailureRecord()
        other._take_parameters()
        return other

    def log_prob(self, theta: ArrayLike) -> Any:
        """Return log P(θ|D) up to the log-evidence: a float for theta (ndim,), an array (n,) for theta (n, ndim).

        It is ``-inf`` outside `support` and where the log-likelihood is not finite.
        """
        points, single = self._points(theta)
        within = self._within(points)
        if np.count_nonzero(within) == within.size > 0:  # the usual case, without copies
            value = self._posterior(points)
        else:
            value = np.full(len(points), -np.inf)
            inside = within.all(axis=1)
            if inside.any():
                value[inside] = self._posterior(points[inside])
        return float(value[0]) if single else value

    def log_prob_and_grad(self, theta: ArrayLike) -> tuple[Any, Any]:
        """Return the log-probability and its gradient, which has theta's shape and is NaN outside `support`."""
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
        """Return log P(D|θ), also outside the bounds. With known β it is eqs. (4) and (5) of the paper.

        The result has the shape of `log_prob`. It is ``-inf`` where a datum's log-likelihood is not finite.
        """
        points, single = self._points(theta)
        value = self._terms(points).sum(axis=1)
        return float(value[0]) if single else value

    def log_likelihood_terms(self, theta: ArrayLike) -> FloatArray:
        """Return the log-likelihood of each datum, shape (n_terms,) or (n, n_terms).

        The modes used in updating come first, then masses and displacements, then the FRFs of each test. All terms
        of a theta are ``-inf`` if one of them is not finite.
        """
        points, single = self._points(theta)
        terms = self._terms(points)
        return terms[0] if single else terms

    def terms_of_tests(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each datum, (n, n_terms), at theta (n, ndim); -inf where it is not finite.

        By contrast, `log_likelihood_terms` returns -inf for all data at a theta if one of them fails.
        """
        terms = self.likelihood.terms(self.layout.of_model(theta))
        self._record_failures(terms, theta)
        return np.where(np.isfinite(terms), terms, -np.inf)

    def terms_and_misfit(
        self, theta: FloatArray, frequencies: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the log-likelihood and the squared residuals of each used mode. Both come from the same solves.

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)
        frequencies : ndarray, shape (n, n_modes), Hz, optional
            The model's frequencies at theta, if they are known. The model is solved again only if the likelihood
            needs more than the frequencies.

        Returns
        -------
        terms : ndarray, shape (n, n_used)
            All −∞ at a theta where one is not finite.
        squares : ndarray, shape (n, n_kinds, n_used)
            Σ r² over the residuals r of a mode, converted to normal scores, for each error model in
            ``likelihood.chi_square``.
        """
        terms, squares = self.likelihood.terms_and_misfit(self.layout.of_model(theta), frequencies)
        return self._record_failures(terms, theta), squares

    def terms_of_frequencies(self, theta: FloatArray, frequencies: FloatArray) -> FloatArray:
        """Return the log-likelihood of each datum at theta (n, ndim), given frequencies (n, n_modes) in Hz.

        The model is solved again only if the likelihood needs more than the frequencies.
        """
        return self.likelihood.terms_of_frequencies(frequencies, self.layout.of_model(theta))

    def quadratic(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim).

        The likelihood must have residuals (`Likelihood.of_modes`). The information on the structural parameters is
        JᵀJ, where J is the Jacobian of the residuals at theta (n, ndim). The information on the inferred error
        parameters is Fisher's.
        """
        return self.likelihood.quadratic(self.layout.of_model(theta), self._chain(theta))

    def sensitivity(self, theta: FloatArray) -> FloatArray:
        """Return the residuals' derivatives, (n, n_residuals, n_structural), at theta (n, ndim)."""
        return self.likelihood.residuals_and_slopes(self.layout.of_model(theta), self._chain(theta))[1]

    def log_prior(self, theta: ArrayLike) -> Any:
        """Return the log-prior, normalised within the bounds, shaped like `log_prob`; -inf outside `support`."""
        points, single = self._points(theta)
        value = np.full(len(points), -np.inf)
        inside = self._within(points).all(axis=1)
        value[inside] = self.prior.log_pdf(points[inside])
        return float(value[0]) if single else value

    def log_prior_and_grad(self, theta: ArrayLike) -> tuple[Any, Any]:
        """Return `log_prior` and its gradient, which has theta's shape and is NaN outside `support`."""
        points, single = self._points(theta)
        value, gradient = np.full(len(points), -np.inf), np.full(points.shape, np.nan)
        inside = self._within(points).all(axis=1)
        value[inside] = self.prior.log_pdf(points[inside])
        gradient[inside] = self.prior.log_pdf_gradient(points[inside])
        return (float(value[0]), gradient[0]) if single else (value, gradient)

    def frfs(self, theta: ArrayLike) -> tuple[ComplexArray, ...]:
        """Return the computed frequency response functions, one array for each `fmu.FRFErrors`.

        Each array has the shape (n_frfs, n_lines) or (n, n_frfs, n_lines), in the units of the data. Its lines are
        the frequency lines that at least one FRF uses.
        """
        points, single = self._points(theta)
        found = [term.frfs(own) for term, own in self.responses_at(points)]
        return tuple(one[0] if single else one for one in found)

    def responses_at(self, theta: FloatArray) -> list[tuple[Any, FloatArray]]:
        """Return each `FRFTerm` together with its own parameters, (n, n_own), at theta (n, ndim)."""
        of_model = self.layout.of_model(theta)
        return [(one.term, one.own(of_model)) for one in self.likelihood.every]

    def frequencies(self, theta: ArrayLike) -> FloatArray:
        """Return the computed frequencies paired with the measured modes, Hz, shape (n_modes,) or (n, n_modes).

        They are also defined outside the bounds. They are NaN where the solve failed.
        """
        points, single = self._points(theta)
        frequencies = self.model.frequencies(self.model_parameters(points))
        return frequencies[0] if single else frequencies

    def model_parameters(self, theta: FloatArray) -> FloatArray:
        """Return the model's parameters, (n, n_parameters), at theta (n, ndim).

        With several tests, these are the structural parameters in the first test, then in the second, and so on.
        """
        return self.layout.of_model(theta)[:, : self.model.n_parameters]

    def values(self, theta: ArrayLike) -> FloatArray:
        """Return the p structural parameters in every test, shape (n_tests, p) or (n, n_tests, p).

        Parameters
        ----------
        theta : array_like, shape (ndim,) or (n, ndim)

        Returns
        -------
        ndarray
            Values in the order of the tests and of ``layout.structural``. A parameter that is known in a test has
            its known value.
        """
        points, single = self._points(theta)
        values = self.layout.values(points[:, : self.n_structural])
        for t, test in enumerate(self.tests):
            for j, parameter in enumerate(self.layout.structural):
                if parameter.name in test.known:
                    values[:, t, j] = test.known[parameter.name]
        return values[0] if single else values

    @property
    def failures(self) -> list[Failure]:
        """The first ten thousand points inside the bounds without a finite log-likelihood, each with a reason."""
        return list(self._failed.first)

    @property
    def n_failures(self) -> int:
        """Number of evaluations inside the bounds that gave no finite log-likelihood."""
        return self._failed.count

    def take_failures(self) -> list[Failure]:
        """Return the failures since the last call of this method; they remain in `failures`.

        A theta that failed several times is returned once. At most ten thousand failures are stored.
        """
        return self._failed.take()

    def configuration(self) -> dict[str, Plain]:
        """Return the settings and data that define the posterior as a dict of plain Python types."""
        other = {} if self.tolerance in (None, Tolerance(), MEASURED) else {"reduction": self.tolerance.frequency}
        of_tests = {} if len(self.tests) == 1 else self.layout.configuration()
        if self.layout.held:
            of_tests = {"not_updated": dict(self.layout.held), **of_tests}
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
        """Cost of `log_prob_and_grad` at one theta, in model solves. It is 1 if all derivatives are exact."""
        of_model, often = self.model, self.likelihood.predictions_per_gradient
        shapes = self.likelihood.needs_shapes
        return often * (of_model.solves_per_shape_gradient if shapes else of_model.solves_per_gradient)

    @property
    def tests(self) -> tuple[Test, ...]:
        """The tests of the structure."""
        return self.layout.tests

    @property
    def roles(self) -> tuple[Role, ...]:
        """Role (meaning) of each parameter in theta."""
        return (*self.layout.roles, *[Role("noise", None)] * (self.ndim - self.n_structural))

    @property
    def is_hierarchical(self) -> bool:
        """Whether the distribution of some parameters is itself inferred (a population)."""
        return bool(self.layout.scales)

    def matrices_of(self, k: int) -> tuple[SeparableModel, int] | None:
        """Return the first SeparableModel that parameter `k` of theta changes, and the parameter's index there.

        Return None if `k` changes no matrices.
        """
        of = self.roles[k].of
        return None if of is None else self.model.matrices_of(of)

    def with_layout(self, layout: Layout) -> Self:
        """Return the same problem with a layout that differs only in the definition of the tests' scores."""
        other = copy(self)
        other.layout, other.prior, other._failed = layout, self._prior_of(layout), FailureRecord()
        return other

    def _take_parameters(self) -> None:
        """Set the attributes that follow from the layout's parameters and the likelihood's error parameters."""
        self.parameters = (*self.layout.parameters, *self.likelihood.noise)
        self.ndim = len(self.parameters)
        self.names = tuple(p.name for p in self.parameters)
        self.units = tuple(p.unit for p in self.parameters)
        self.lower = np.array([p.lower for p in self.parameters], dtype=float)
        self.upper = np.array([p.upper for p in self.parameters], dtype=float)
        # rows of shape (1, ndim), so that NumPy need not broadcast for a single theta; a bound at which the prior
        # vanishes is excluded
        self._lowest = np.array([[p.lowest for p in self.parameters]])
        self._highest = np.array([[p.highest for p in self.parameters]])
        # errors with a standard deviation of zero have no density; the square of `_LEAST_NOISE` does not underflow
        noise = self._lowest[:, self.n_structural :]
        noise[noise == 0.0] = _LEAST_NOISE
        self.start = np.array([p.start for p in self.parameters], dtype=float)
        scales = [p.prior.scale(p.lower, p.upper) for p in self.parameters]
        self.offset = np.array([offset for offset, _ in scales])
        self.scale = np.array([scale for _, scale in scales])
        self.prior = self._prior_of(self.layout)

    def _prior_of(self, layout: Layout) -> JointPrior:
        return JointPrior(self.parameters, layout if layout.scales else None)

    def _noise(self, theta: FloatArray | None) -> FloatArray | None:
        return None if theta is None else theta[:, self.n_structural :]

    def _chain(self, theta: FloatArray) -> Chain | None:
        """Return the function that applies the chain rule from each test's parameters to theta.

        Return None if theta consists of a single test's parameters, so that no chain rule is needed.
        """
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

    @property
    def support(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest theta at which `log_prob` may be finite, (ndim,) each: the bounds, or just inside."""
        return self._lowest[0], self._highest[0]

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
        """Return `terms`, all −∞ at points where one is not finite; record such points inside the bounds."""
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
