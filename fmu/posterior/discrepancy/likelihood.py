"""The likelihood of a model that has errors of its own, which the data of a mode have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmu.arguments import ArgumentError
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.pairing.sensitivities import Sensitivities, Steps
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.discrepancy.curvature import by_parameters
from fmu.posterior.discrepancy.embedded import Discrepancy
from fmu.posterior.discrepancy.frequencies import ScatteredFrequencies
from fmu.posterior.discrepancy.latent import LatentErrors
from fmu.posterior.errors.base import Chain, ErrorModel, ErrorTerm
from fmu.posterior.errors.frequency import FrequencyTerm
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.errors.noise import numbering
from fmu.posterior.errors.quantities import QuantityTerm
from fmu.posterior.errors.shape import ShapeTerm
from fmu.posterior.errors.slopes import chain_prediction, residuals_of_term, without_shapes
from fmu.posterior.joint.layout import Layout
from fmu.types import FloatArray, IntArray, Plain

_COMPLEX_STEP = 1e-30  # relative; a complex step subtracts nothing, so it may be as small as numbers allow


@dataclass(frozen=True, eq=False)
class Linearised:
    """The residuals of m rows, each a mode in a test, to first order in the parameters of its test.

    Attributes
    ----------
    residuals : ndarray, shape (n, m, k)
        All residuals of the mode: of its frequency, then of its shape.
    slopes : ndarray, shape (n, m, k, p)
    """

    residuals: FloatArray
    slopes: FloatArray


class DiscrepantLikelihood(ModalLikelihood):
    """A `ModalLikelihood` in which every mode sees parameters of its own: θ + s τ z_g for the mode g.

    To first order in τ the residuals of mode g, of its frequency and its shape in all tests, are then Gaussian
    with the covariance I + J T² Jᵀ, T = diag(s τ), in standard deviations of the measurement. One z_g serves all
    tests, because the error of a model does not average out over tests. The terms of a mode in several tests are
    conditional on the tests before; their sum is the joint log-density, determinant included.

    Parameters
    ----------
    model, data, errors, quantities
        As in `ModalLikelihood`. Errors of `quantities` have no scatter.
    discrepancies : sequence of Discrepancy
    layout : Layout
        The parameters of the structure in the tests, and the tests with the labels of their modes.

    Raises
    ------
    ValueError
        In the cases listed for `ModalLikelihood`, if errors of modes are correlated or not Gaussian, or a
        discrepancy does not fit the parameters.
    """

    has_discrepancy = True

    def __init__(
        self,
        model: ModalModel,
        data: ModalData,
        errors: Sequence[ErrorModel],
        quantities: Sequence[QuantityTerm],
        discrepancies: Sequence[Discrepancy],
        layout: Layout,
    ) -> None:
        super().__init__(model, data, errors, quantities)
        for term in self.terms_of:
            if type(term) not in (FrequencyTerm, ShapeTerm):
                rule = "needs Gaussian errors of frequencies and shapes that are independent from mode to mode"
                raise ArgumentError("discrepancy", rule, str(term.as_dict()["error"]))
            if term.tests is not None:
                term.tests = None  # the scatter of tests no longer gives all of the variance
        noise = list(self.noise)
        names = [one.name for one in discrepancies if one.tau is None]
        if len(set(names)) < len(names):
            raise ArgumentError("discrepancy.name", "must be different for each discrepancy", names[-1])
        self.scatters = tuple(one.bind(layout.structural, numbering(noise)) for one in discrepancies)
        self.noise = tuple(noise)
        self.error, self.beta, self._fast, self.terms_name = None, None, None, "modes"
        self.n_tests, self._bounds = len(layout.tests), np.array(layout.box())
        labels = [label for test in layout.tests for label in test.data.labels]
        self.group = np.array([labels.index(label) for label in labels])
        only = self.terms_of[0] if len(self.terms_of) == 1 and self.n_tests == 1 else None
        self._alone = ScatteredFrequencies(only, self.scatters) if isinstance(only, FrequencyTerm) else None
        scattered = [(one.fixed > 0.0) | (one.number >= 0) for one in self.scatters]
        self.scattered = np.flatnonzero(np.any(scattered, axis=0))

    @property
    def by_frequencies(self) -> bool:
        """Whether the frequencies of the model are enough for the terms: they need their gradients."""
        return False

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted modes at theta with their derivatives, which the density needs too."""
        structural = theta[:, : self.model.n_parameters]
        if self.needs_shapes or self.model.is_uncertain:
            return self.model.observed(structural, True)
        return without_shapes(*self.model.frequencies_and_gradient(structural))

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the terms, (n, n_terms), at theta (n, ndim); see `ModalLikelihood`."""
        if self._alone is None or self.model.is_uncertain:
            return super().terms(theta)
        values = self._values(theta)[:, 0]
        terms = self._alone.terms(*self.model.frequencies_and_gradient(values), values, self._noise(theta))
        return self._with_quantities(self.of_used(terms), theta)

    def terms_of_observed(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return the `terms` at theta (n, ndim), given the prediction of the modes there."""
        parts = self._parts(seen, theta, gradient=False)[1]
        terms = self.of_used(np.asarray(sum(part.terms for part in parts)))
        with np.errstate(all="ignore"):
            shared = self._latent(self._linearise(seen, self._noise(theta)), theta).terms()
        return self._with_quantities(terms + shared, theta)

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the terms, and the derivatives of their sum through each mode, (n, n_used, ndim).

        Row i has the derivatives through the prediction of mode i in its test. They are those of term i unless the
        mode was measured in several tests.
        """
        seen, exact = self._observed_with_curvature(theta)
        if self._alone is None or exact is None:
            return self._terms_and_slopes(seen, exact, theta, None)
        terms, slopes = self._alone.terms_and_slopes(exact, self._values(theta)[:, 0], self._noise(theta))
        return self._with_quantities_and_slopes(self.of_used(terms), self.of_used(slopes, 1), theta)

    def quadratic(
        self, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood, its gradient and the information; see `ModalLikelihood`.

        The information on the parameters is JᵀS⁻¹J with the covariance S, that on standard deviations and τ is
        Fisher's. The change of S with the parameters is neglected.
        """
        seen, exact = self._observed_with_curvature(theta)
        terms, slopes = self._terms_and_slopes(seen, exact, theta, chain)
        J = self._whitened(seen, theta, chain)[1]
        N = J.shape[-1]
        information = np.zeros((len(theta), slopes.shape[-1], slopes.shape[-1]))
        information[:, :N, :N] = np.einsum("nrk,nrl->nkl", J, J)
        with np.errstate(all="ignore"):
            information[:, N:, N:] = self._information_on_noise(seen, theta)
        return terms.sum(axis=1), slopes.sum(axis=1), information

    def residuals_and_slopes(self, theta: FloatArray, chain: Chain | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the residuals and their derivatives, both times S^(−½), so that they are independent.

        S is the covariance of the residuals of a mode in all tests, or, without a `chain`, in each test alone.
        """
        return self._whitened(self.observed(theta), theta, chain)

    def misfit(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return the squared residuals, in standard deviations that include the model's own errors.

        Those of a mode in several tests are conditional on the tests before.
        """
        found = np.empty((len(theta), 0, len(self._used)))
        with np.errstate(all="ignore"):
            for term in self.chi_square:
                latent = self._latent(self._linearise(seen, self._noise(theta), (term,)), theta)
                found = np.concatenate([found, latent.squares()[:, None]], axis=1)
        return found

    def variance(self, theta: FloatArray) -> FloatArray:
        """Return the variances of the model's own errors at theta (n, ndim), shape (n, n_modes), Hz²."""
        return np.asarray(np.sum(self._in_hz(self.observed(theta), theta) ** 2, axis=2))

    def with_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None
    ) -> FloatArray:
        """Return computed frequencies with the model's own errors added; see `Likelihood`."""
        if theta is None:
            raise ValueError("theta: must be given where the model has a discrepancy (got None)")
        loads = self._in_hz(self.observed(theta), theta)
        z = rng.standard_normal((len(theta), len(self.group), loads.shape[2]))[:, self.group]
        return np.asarray(frequencies + np.sum(loads * z, axis=2))

    def as_dict(self) -> dict[str, Plain]:
        """Return a dict of names and settings in plain Python types."""
        return super().as_dict() | {"discrepancy": [one.as_dict() for one in self.scatters]}

    @property
    def _used(self) -> IntArray:
        return np.arange(len(self.group)) if self.used is None else self.used

    @property
    def _test(self) -> IntArray:
        """The test of each used mode."""
        return self.model.test_of_modes[self._used]

    def _noise(self, theta: FloatArray) -> FloatArray:
        return theta[:, self.model.n_parameters :]

    def _values(self, theta: FloatArray) -> FloatArray:
        """Return the parameters of the structure in every test, (n, n_tests, p)."""
        return theta[:, : self.model.n_parameters].reshape(len(theta), self.n_tests, -1)

    def scale_of_scatter(self, theta: FloatArray) -> FloatArray:
        """Return the standard deviations s τ of the parameters over the modes, (n, n_tests, p), at theta."""
        tau = np.sqrt(self._tau2(self._noise(theta))[0])
        return np.asarray(self.scatters[0].scale(self._values(theta)) * tau[:, None])

    def _tau2(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return τ² of the parameters, (n, p), and its derivatives by noise, (n, n_noise, p)."""
        every = [one.variances(noise) for one in self.scatters]
        value, slopes = (np.asarray(sum(parts)) for parts in zip(*every, strict=True))
        return value, slopes

    def _linearise(
        self, seen: ModalPrediction, noise: FloatArray, terms: Sequence[ErrorTerm] | None = None
    ) -> Linearised:
        """Return the residuals of the used modes, and their derivatives by the parameters of the test."""
        parts = [residuals_of_term(term, seen, noise, within=True) for term in terms or self.terms_of]
        r, J = parts[0] if len(parts) == 1 else (np.concatenate(x, axis=2) for x in zip(*parts, strict=True))
        return Linearised(self.of_used(r, 1), self.of_used(J, 1))

    def _latent(self, rows: Linearised, theta: FloatArray, by_test: bool = False) -> LatentErrors:
        """Return the density of the residuals, with z_g common to all tests unless `by_test`."""
        T = self.scale_of_scatter(theta)[:, self._test][:, :, None]
        loads = rows.slopes[..., self.scattered] * T[..., self.scattered]
        group = self._used if by_test else self.group[self._used]
        return LatentErrors(rows.residuals, loads, np.empty((*rows.residuals.shape, 0)), group)

    def _in_hz(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return the change of every frequency with z of its mode, (n, n_modes, P), Hz."""
        T = self.scale_of_scatter(theta)[:, self.model.test_of_modes]
        return (np.asarray(seen.frequency_slopes) * T)[..., self.scattered]

    def _observed_with_curvature(self, theta: FloatArray) -> tuple[ModalPrediction, Sensitivities | None]:
        """Return `observed`, and second derivatives of the frequencies along directions if these are enough."""
        if self.needs_shapes or self.model.is_uncertain:
            return self.observed(theta), None
        scale = self.scatters[0].scale(self._values(theta)).reshape(len(theta), -1)
        bounds = np.array([self._bounds[0].min(axis=0), self._bounds[1].max(axis=0)])
        exact = self.model.sensitivities(theta[:, : self.model.n_parameters], Steps(scale, bounds))
        return without_shapes(exact.frequencies, exact.gradient), exact

    def _terms_and_slopes(
        self, seen: ModalPrediction, exact: Sensitivities | None, theta: FloatArray, chain: Chain | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the terms and the derivatives of their sum through each of them."""
        of_errors = seen if chain is None else chain_prediction(seen, chain, self.model.test_of_modes)
        terms, slopes = self._terms_and_gradient(of_errors, theta, chain)
        m, N = len(self._used), slopes.shape[-1] - len(self.noise)
        with np.errstate(all="ignore"):
            shared, by_theta, by_noise = self._shared_slopes(seen, exact, theta)
            by_theta = by_theta if chain is None else chain(by_theta, self._test)
            slopes[:, :m, :N] += by_theta
            slopes[:, :m, N:] += by_noise
        slopes[~np.isfinite(slopes)] = np.nan
        terms = np.concatenate([terms[:, :m] + shared, terms[:, m:]], axis=1)
        return terms, slopes

    def _shared_slopes(
        self, seen: ModalPrediction, exact: Sensitivities | None, theta: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return `LatentErrors.terms` and the derivatives of their sum, by the parameters and by noise."""
        values, noise = self._values(theta), self._noise(theta)
        rows = self._linearise(seen, noise)
        latent = self._latent(rows, theta)
        slopes = latent.slopes()
        tau2, by_tau2 = self._tau2(noise)
        weight = np.zeros(rows.slopes.shape)
        T = self.scale_of_scatter(theta)[:, self._test][:, :, None]
        weight[..., self.scattered] = slopes.by_loads * T[..., self.scattered]
        along = np.sum(weight * rows.slopes, axis=2)  # times ∂ log s/∂θ, or ½ ∂ log τ²: the change through s or τ
        relative = self.scatters[0].relative
        at = values[:, self._test]
        by_theta = np.where(relative, along / np.where(relative, at, 1.0), 0.0)
        by_theta += self._by_changing_slopes(seen, exact, theta, rows, weight, slopes.by_residual)
        positive = np.where(tau2 > 0.0, tau2, 1.0)[:, None]
        by_noise = np.einsum("nml,ndl->nmd", along, 0.5 * by_tau2 / positive)
        by_noise += self._by_sd(seen, noise, weight, slopes.by_residual)
        return latent.terms(), by_theta, by_noise

    def _by_changing_slopes(
        self,
        seen: ModalPrediction,
        exact: Sensitivities | None,
        theta: FloatArray,
        rows: Linearised,
        weight: FloatArray,
        by_residual: FloatArray,
    ) -> FloatArray:
        """Return the change of `by_residual` r + `weight` J with the parameters, shape (n, m, p).

        Of frequencies alone, the second derivatives are needed in one direction a mode only, and `exact` has them.
        With shapes, or of an uncertain model, the slopes are differenced in every parameter: 2 p solves.
        """
        values, noise = self._values(theta), self._noise(theta)
        n, m, _, p = rows.slopes.shape
        of_residuals = np.einsum("nmk,nmkp->nmp", by_residual, rows.slopes)
        if exact is not None:
            of_terms = [t.slope_and_curvature(seen.frequencies, noise) for t in self.terms_of]  # type: ignore[attr-defined]
            of_hz, of_square = (self.of_used(np.stack(x, axis=2), 1) for x in zip(*of_terms, strict=True))
            D = self.of_used(np.asarray(seen.frequency_slopes), 1)
            direction = np.zeros((n, len(self.group), p))
            direction[:, self._used] = np.einsum("nmk,nmkp->nmp", of_hz, weight)
            found = exact.curvature(direction)
            bent = np.einsum("nmk,nmkp,nmp->nm", of_square, weight, D)
            return np.asarray(of_residuals + found[:, self._used] + bent[..., None] * D)

        def contract(points: FloatArray) -> FloatArray:
            k = points.shape[1]
            moved = self.model.observed(points.reshape(n * k, -1), True)
            there = self._linearise(moved, np.repeat(noise, k, axis=0))
            found = np.einsum("nbmkp,nmkp->nbm", there.slopes.reshape(n, k, m, -1, p), weight)
            if self.model.is_uncertain:
                found += np.einsum("nbmk,nmk->nbm", there.residuals.reshape(n, k, m, -1), by_residual)
            return found

        scale = self.scatters[0].scale(values)
        found = by_parameters(contract, values, scale, self._bounds, self._test)
        return found if self.model.is_uncertain else of_residuals + found

    def _by_sd(
        self, seen: ModalPrediction, noise: FloatArray, weight: FloatArray, by_residual: FloatArray
    ) -> FloatArray:
        """Return the change of `by_residual` r + `weight` J with inferred standard deviations, (n, m, n_noise)."""
        found = np.zeros((*by_residual.shape[:2], noise.shape[1]))
        for d in sorted({d for term in self.terms_of for d in term.spread.sizes}):
            step = _COMPLEX_STEP * noise[:, d]
            moved = noise.astype(complex)
            moved[:, d] += 1j * step
            rows = self._linearise(seen, moved)
            change = np.einsum("nmk,nmk->nm", rows.residuals.imag, by_residual)
            change += np.einsum("nmkp,nmkp->nm", rows.slopes.imag, weight)
            found[..., d] = change / step[:, None]
        return found

    def _whitened(
        self, seen: ModalPrediction, theta: FloatArray, chain: Chain | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the residuals and their derivatives times S^(−½), in the order of `labels`."""
        noise, J, sizes = self._noise(theta), [], []
        chained = seen if chain is None else chain_prediction(seen, chain, self.model.test_of_modes)
        with np.errstate(all="ignore"):
            latent = self._latent(self._linearise(seen, noise), theta, by_test=chain is None)
            for term in self.terms_of:
                J.append(self.of_used(residuals_of_term(term, chained, noise, within=True)[1], 1))
                sizes.append(J[-1].shape[2])
            r, slopes = latent.whiten(np.concatenate(J, axis=2))
        cuts = np.cumsum(sizes)[:-1]
        n = len(theta)
        of_modes = [part.reshape(n, -1) for part in np.split(r, cuts, axis=2)]
        slopes_of_modes = [part.reshape(n, -1, part.shape[-1]) for part in np.split(slopes, cuts, axis=2)]
        others = list(self._residuals_of_quantities(theta, chain))
        return (
            np.concatenate([*of_modes, *(one for one, _ in others)], axis=1),
            np.concatenate([*slopes_of_modes, *(one for _, one in others)], axis=1),
        )

    def _information_on_noise(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return Fisher's information on standard deviations and τ, shape (n, n_noise, n_noise).

        It is ½ tr(S⁻¹ ∂S S⁻¹ ∂S), in which AᵀS⁻¹A = I − Cov and S⁻¹A = A Cov with the covariance Cov of z. What
        the same mode in another test tells about standard deviations is neglected, and of q sensors each counts
        by the part (q − 1)/q that is independent of the scale of a shape.
        """
        noise = self._noise(theta)
        latent = self._latent(self._linearise(seen, noise), theta)
        of_z = latent.given_residuals()[2]
        tau2, slopes = (x[..., self.scattered] for x in self._tau2(noise))
        E = slopes / np.where(tau2 > 0.0, tau2, 1.0)[:, None]
        K = np.eye(of_z.shape[-1]) - of_z[:, np.unique(latent.last)]
        found = 0.5 * E @ np.sum(K**2, axis=1) @ np.swapaxes(E, 1, 2)
        delta, share = np.zeros((*latent.residuals.shape, noise.shape[1])), np.ones(latent.residuals.shape[2])
        first = 0
        for term in self.terms_of:
            q = len(term.labels([""]))
            share[first : first + q] = term.n_data / q
            V = term.spread.variance(noise)
            for d, dV in term.spread.slopes(noise).items():
                relative = (dV / V).reshape(len(noise), -1, V.shape[-1])  # (n, q, n_modes)
                delta[:, :, first : first + q, d] = self.of_used(np.swapaxes(relative, 1, 2), 1)
            first += q
        if np.any(delta):
            A, cov = latent.loads, of_z[:, latent.last]
            inverse = np.eye(A.shape[2]) - A @ cov @ np.swapaxes(A, 2, 3)
            weighted = share[:, None] * delta
            found += 0.5 * np.einsum("nmkd,nmkl,nmle->nde", weighted, inverse**2, delta)
            cross = 0.5 * np.einsum("nmkd,nmkl,nel->nde", delta, (A @ cov) ** 2, E)
            found += cross + np.swapaxes(cross, 1, 2)
        return np.asarray(found)
