"""Likelihood with a model discrepancy, which is the same in all tests of a structure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmu.arguments import ArgumentError
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.pairing.sensitivities import Sensitivities, Steps
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.discrepancy.curvature import by_parameters, by_second_derivatives
from fmu.posterior.discrepancy.draws import at_distinct_rows, errors_from_normal
from fmu.posterior.discrepancy.embedded import Discrepancy, EmbeddedScatter, require_distinct_names
from fmu.posterior.discrepancy.latent import LatentErrors
from fmu.posterior.discrepancy.model_errors import Change, Linearised, ModelErrors
from fmu.posterior.discrepancy.modes import ModeErrors
from fmu.posterior.discrepancy.one_test import density_of_one_test
from fmu.posterior.errors.base import ErrorModel, ErrorTerm, Likelihood
from fmu.posterior.errors.frequency import FrequencyTerm
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.errors.noise import numbering
from fmu.posterior.errors.quantities import QuantityTerm
from fmu.posterior.errors.shape import ShapeTerm
from fmu.posterior.errors.slopes import chain_prediction, nan_unless_finite, residuals_of_term, without_shapes
from fmu.posterior.joint.layout import Layout
from fmu.types import Chain, FloatArray, IntArray, Plain

_COMPLEX_STEP = 1e-30  # relative; a complex step has no cancellation errors, so that it may be tiny


class DiscrepantLikelihood(ModalLikelihood):
    """A `ModalLikelihood` with model discrepancy: parameters that scatter over the modes, or errors of the modes.

    In mode g, a scattering parameter is θ + s τ z_g. To first order in τ, the mode's residuals r in all tests, in
    measurement sds, are Gaussian with the covariance I + J T² Jᵀ, where J = ∂r/∂θ and T = diag(s τ). All tests
    share z_g, so it does not average out. A mode's term is conditional on earlier terms that share errors.

    Parameters
    ----------
    model, data, errors, quantities
        As in `ModalLikelihood`. Errors of `quantities` have no discrepancy.
    discrepancies : sequence of Discrepancy
    layout : Layout
        Gives the structural parameters in the tests, and the tests with their mode labels.

    Raises
    ------
    ValueError
        As for `ModalLikelihood`; also if mode errors are correlated or not Gaussian, or a discrepancy is invalid.
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
        self._made_of = (data, errors, quantities)
        super().__init__(model, *self._made_of)
        for error, term in zip(errors, self.terms_of, strict=True):
            if type(term) not in (FrequencyTerm, ShapeTerm):
                rule = "needs Gaussian errors of frequencies and shapes that are independent from mode to mode"
                raise ArgumentError("discrepancy", rule, type(error).__name__)
            if term.tests is not None:
                term.tests = None  # the scatter of tests no longer gives all of the variance
        noise = list(self.noise)
        of_frequencies = any(term.of_frequencies for term in self.terms_of)
        require_distinct_names(discrepancies, of_frequencies, self.needs_shapes)
        index, self.measured = numbering(noise), np.asarray(data.frequencies_hz)
        scatters = tuple(one.bind(layout.structural, index) for one in discrepancies if one.kind == "embedded")
        of_modes, structure = [one for one in discrepancies if one.kind == "modes"], model.parts[0].structure
        modes = tuple(ModeErrors.of(one, index, self.terms_of, data.sensors, structure) for one in of_modes)
        self.errors = ModelErrors(scatters or (EmbeddedScatter.none(len(layout.structural)),), modes)
        self.n_sizes, self.noise = len(noise) - len(self.noise), tuple(noise)
        self.error, self.beta, self._fast = None, None, None
        self.terms_name, self.n_tests, self._bounds = "modes", len(layout.tests), np.array(layout.box())
        labels = [label for test in layout.tests for label in test.data.labels]
        self.group = np.array([labels.index(label) for label in labels])
        is_alone = self.n_tests == 1 and not self.errors.modes and not self.errors.n_common
        self._alone = density_of_one_test(self.terms_of, self.errors.scatters) if is_alone else None
        if not model.gives_curvature(self.needs_shapes):  # slopes are differenced
            self.predictions_per_gradient = 1 + 2 * len(layout.structural)
        elif scatters and not model.has_exact_curvature:
            self.predictions_per_gradient = 1 + 2 * model.n_modes

    def easier(self) -> list[Likelihood]:
        """Return a list with one likelihood, which has the same parameters but no discrepancy."""
        found = ModalLikelihood(self.model, *self._made_of).using(self.used)
        found.noise, found._fast = self.noise, None  # the fast path has no parameters of errors
        return [found]

    @property
    def by_frequencies(self) -> bool:
        """Whether the modes' log-likelihood needs only the computed frequencies; False if parameters scatter."""
        return super().by_frequencies and not len(self.errors.scattered)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted modes, with derivatives if `gradient` is True or if parameters scatter."""
        if not (gradient or len(self.errors.scattered)):
            return super().observed(theta)
        structural = theta[:, : self.model.n_parameters]
        if self.needs_shapes or self.model.is_uncertain:
            return self.model.observed(structural, True)
        return without_shapes(*self.model.frequencies_and_gradient(structural))

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood terms, (n, n_terms), at theta (n, ndim); see `ModalLikelihood`."""
        if self._alone is None or self.model.is_uncertain:
            return super().terms(theta)
        values = self._values(theta)[:, 0]
        terms = self._alone.terms(self.observed(theta), values, self._noise(theta))
        return self._with_quantities(self.of_used(terms), theta)

    def terms_of_observed(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return the `terms` at theta (n, ndim), given the predicted modes there."""
        parts = self._parts(seen, theta, gradient=False)[1]
        terms = self.of_used(np.asarray(sum(part.terms for part in parts)))
        with np.errstate(all="ignore"):
            shared = self._latent(self._linearise(seen, theta), theta).terms()
        return self._with_quantities(terms + shared, theta)

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-likelihood terms, (n, n_terms), and each term's part of the gradient, (n, n_terms, ndim).

        The parts add up to the gradient of the sum of the terms. A mode's part contains the derivatives through
        its prediction. It is the gradient of the mode's own term unless terms are coupled (`couples_modes`).
        """
        seen, exact = self._observed_with_curvature(theta)
        if self._alone is None or exact is None:
            with np.errstate(all="ignore"):
                rows = self._linearise(seen, theta)
                latent = self._latent(rows, theta)
            return self._terms_and_slopes(seen, exact, theta, None, rows, latent)
        terms, slopes = self._alone.terms_and_slopes(exact, self._values(theta)[:, 0], self._noise(theta))
        return self._with_quantities_and_slopes(self.of_used(terms), self.of_used(slopes, 1), theta)

    def quadratic(
        self, theta: FloatArray, chain: Chain | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information (n, ndim, ndim).

        The information on the parameters is JᵀS⁻¹J, with S as in `residuals_and_slopes`; the derivatives of S are
        neglected in it, but not in the gradient. For error sds and τ, see `ModelErrors.information`.
        """
        seen, exact = self._observed_with_curvature(theta)
        with np.errstate(all="ignore"):
            rows = self._linearise(seen, theta)
            latent = self._latent(rows, theta)
            of_test = self._latent(rows, theta, by_test=True) if chain is None else latent
        terms, slopes = self._terms_and_slopes(seen, exact, theta, chain, rows, latent)
        J = self._whiten(seen, theta, chain, of_test)[1]
        N = J.shape[-1]
        information = np.zeros((len(theta), slopes.shape[-1], slopes.shape[-1]))
        information[:, :N, :N] = np.einsum("nrk,nrl->nkl", J, J)
        with np.errstate(all="ignore"):
            information[:, N:, N:] = self.errors.information(
                self.terms_of, latent, self._noise(theta), self.of_used
            )
        return terms.sum(axis=1), slopes.sum(axis=1), information

    def residuals_and_slopes(self, theta: FloatArray, chain: Chain | None = None) -> tuple[FloatArray, FloatArray]:
        """Return the whitened residuals (n, n_residuals) and their derivatives (n, n_residuals, n_structural).

        The residuals are whitened with their covariance S. With several tests and no `chain`, S is the covariance
        of a mode's residuals in one test alone.
        """
        seen = self.observed(theta, True)
        with np.errstate(all="ignore"):
            latent = self._latent(self._linearise(seen, theta), theta, by_test=chain is None)
        return self._whiten(seen, theta, chain, latent)

    def misfit(self, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Return sums of squares (n, n_kinds, n_used) of used modes' residuals, whitened given earlier rows."""
        found = np.empty((len(theta), 0, len(self._used)))
        with np.errstate(all="ignore"):
            for term in self.chi_square:
                latent = self._latent(self._linearise(seen, theta, (term,)), theta)
                found = np.concatenate([found, latent.squares()[:, None]], axis=1)
        return found

    @property
    def couples_modes(self) -> bool:
        """Whether a mode's likelihood depends on other data: the same mode in other tests, or other modes."""
        return self.errors.n_common > 0 or len(set(self.group[self._used].tolist())) < len(self._used)

    def terms_given_others(self, theta: FloatArray) -> FloatArray:
        """Return the log-density of each datum given all others, (n, n_terms), at theta (n, ndim)."""
        seen = self.observed(theta)
        found = self.terms_of_observed(seen, theta)
        if self.couples_modes:
            with np.errstate(all="ignore"):
                latent = self._latent(self._linearise(seen, theta), theta)
                found[:, : len(self._used)] += latent.terms_given_others() - latent.terms()
        return found

    def error_given_others(
        self, seen: ModalPrediction, theta: FloatArray, k: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return the discrepancy in mode `k`'s frequency, given the data of the other used modes.

        `seen` is the result of `observed` at theta (n, ndim).

        Returns
        -------
        mean, variance : ndarray, shape (n,), Hz and Hz²
            Mean and variance of the discrepancy: the frequency with discrepancy minus the computed frequency.
        """
        mean, gain, covariance, w, of_w = self.errors_given_data(seen, theta, np.setdiff1d(self._used, k))
        own, common = (x[:, k] for x in self._in_hz(seen, theta))
        of_common = common - np.einsum("np,npc->nc", own, gain[:, k])
        shift = np.einsum("np,np->n", own, mean[:, k]) + np.einsum("nc,nc->n", of_common, w)
        variance = np.einsum("np,npq,nq->n", own, covariance[:, k], own)
        return -shift, variance + np.einsum("nc,ncd,nd->n", of_common, of_w, of_common)

    def errors_given_data(
        self, seen: ModalPrediction, theta: FloatArray, used: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return `LatentErrors.given_common` for each mode, and w's mean and covariance, given the `used` modes.

        If `used` is empty, return the prior: zero means and unit covariances. Means are NaN where a solve failed.
        """
        (n, m, P), (*_, C) = (x.shape for x in self._in_hz(seen, theta))
        mean, gain, covariance = np.zeros((n, m, P)), np.zeros((n, m, P, C)), np.tile(np.eye(P), (n, m, 1, 1))
        if not len(used):
            return mean, gain, covariance, np.zeros((n, C)), np.tile(np.eye(C), (n, 1, 1))
        of = self.using(used)
        with np.errstate(all="ignore"):  # the determinants are NaN where a solve failed
            latent = of._latent(of._linearise(seen, theta), theta)
            found, (_, w, _, _, of_w) = latent.given_common(), latent.given_residuals()
        for i in np.unique(latent.last):
            rows = self.group == latent.group[i]
            for all_modes, one in zip((mean, gain, covariance), found, strict=True):
                all_modes[:, rows] = one[:, [i]]
        return mean, gain, covariance, w, of_w

    def with_discrepancy(
        self, rng: np.random.Generator, frequencies: FloatArray, theta: FloatArray | None, given_data: bool = False
    ) -> FloatArray:
        """Add random discrepancies to frequencies in Hz; see `Likelihood`. Raise ValueError if theta is None."""
        if theta is None:
            raise ValueError("theta: must be given where the model has a discrepancy (got None)")

        def errors(theta: FloatArray) -> tuple[FloatArray, ...]:
            seen = self.observed(theta)
            given = self.errors_given_data(seen, theta, self._used) if given_data else ()
            return *self._in_hz(seen, theta), *given

        own, common, *given = at_distinct_rows(errors, theta)
        z = rng.standard_normal((len(theta), len(self.group), own.shape[2]))[:, self.group]
        w = rng.standard_normal((len(theta), common.shape[2]))
        if given_data:
            z, w = errors_from_normal(z, w, given)
        return np.asarray(frequencies - np.sum(own * z, axis=2) - np.einsum("nmc,nc->nm", common, w))

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings of the error models and the discrepancy as a dict of plain Python types."""
        return super().as_dict() | {"discrepancy": self.errors.as_list()}

    @property
    def _used(self) -> IntArray:
        return np.arange(len(self.group)) if self.used is None else self.used

    @property
    def _test(self) -> IntArray:
        """Index of the test that each used mode belongs to, shape (n_used,)."""
        return self.model.test_of_modes[self._used]

    def _noise(self, theta: FloatArray) -> FloatArray:
        return theta[:, self.model.n_parameters :]

    def _values(self, theta: FloatArray) -> FloatArray:
        """Return the structural parameters in every test, shape (n, n_tests, p)."""
        return theta[:, : self.model.n_parameters].reshape(len(theta), self.n_tests, -1)

    def _linearise(
        self, seen: ModalPrediction, theta: FloatArray, terms: Sequence[ErrorTerm] | None = None
    ) -> Linearised:
        """Return the residuals of the used modes, and their derivatives with respect to the test's parameters."""
        return self.errors.linearise(terms or self.terms_of, seen, self._noise(theta), self.of_used)

    def _latent(self, rows: Linearised, theta: FloatArray, by_test: bool = False) -> LatentErrors:
        """Build the `LatentErrors` for the residuals. With `by_test` and several tests, no rows share errors."""
        group = self._used if by_test else self.group[self._used]
        found = self.errors.latent(rows, self._values(theta)[:, self._test], self._noise(theta), group)
        if by_test and self.n_tests > 1:
            loads = np.concatenate([found.loads, found.common], axis=3)
            found = LatentErrors(found.residuals, loads, found.common[..., :0], group)
        return found

    def _in_hz(self, seen: ModalPrediction, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the frequencies' derivatives with respect to the latent errors; see `ModelErrors.in_hz`."""
        values = self._values(theta)[:, self.model.test_of_modes]
        return self.errors.in_hz(seen.frequency_slopes, self.measured, values, self._noise(theta))

    def _observed_with_curvature(self, theta: FloatArray) -> tuple[ModalPrediction, Sensitivities | None]:
        """Return `observed` with derivatives, and the `Sensitivities`, or None if the model does not give them."""
        if not self.model.gives_curvature(self.needs_shapes):
            return self.observed(theta, True), None
        scale = self.errors.scale(self._values(theta)).reshape(len(theta), -1)
        bounds = np.array([self._bounds[0].min(axis=0), self._bounds[1].max(axis=0)])
        structural, steps = theta[:, : self.model.n_parameters], Steps(scale, bounds)
        exact = self.model.sensitivities(structural, steps, self.needs_shapes)
        return exact.prediction, exact

    def _terms_and_slopes(
        self,
        seen: ModalPrediction,
        exact: Sensitivities | None,
        theta: FloatArray,
        chain: Chain | None,
        rows: Linearised,
        latent: LatentErrors,
    ) -> tuple[FloatArray, FloatArray]:
        """Return terms and slopes as in `terms_and_gradient` or, with a `chain`, for all tests' parameters."""
        of_errors = seen if chain is None else chain_prediction(seen, chain, self.model.test_of_modes)
        terms, slopes = self._terms_and_gradient(of_errors, theta, chain)
        m, N = len(self._used), slopes.shape[-1] - len(self.noise)
        with np.errstate(all="ignore"):
            change = self.errors.change(rows, latent, self._values(theta)[:, self._test], self._noise(theta))
            by_theta = change.by_value + self._by_changing_rows(seen, exact, theta, rows, change)
            slopes[:, :m, :N] += by_theta if chain is None else chain(by_theta, self._test)
            slopes[:, :m, N:] += change.by_noise + self._by_sd(seen, theta, change)
            shared = latent.terms()
        terms = np.concatenate([terms[:, :m] + shared, terms[:, m:]], axis=1)
        return terms, nan_unless_finite(slopes)

    def _by_changing_rows(
        self,
        seen: ModalPrediction,
        exact: Sensitivities | None,
        theta: FloatArray,
        rows: Linearised,
        change: Change,
    ) -> FloatArray:
        """Return derivatives with respect to the parameters, (n, m, p), through the residuals and their slopes.

        Without exact second derivatives, finite differences of the slopes are used, which take 2 p solves.
        """
        values, noise = self._values(theta), self._noise(theta)
        of_residuals = np.einsum("nmk,nmkp->nmp", change.by_residual, rows.slopes)
        if exact is not None:
            bent = by_second_derivatives(self.terms_of, seen, exact, noise, self._of_all_modes(change.by_slope))
            bent += self.errors.change_of_units(self.terms_of, seen, noise, self._of_all_modes(change.by_own))
            return np.asarray(of_residuals + self.of_used(bent, 1))

        def contract(points: FloatArray) -> FloatArray:
            k = points.shape[1]
            at = np.concatenate([points.reshape(len(theta) * k, -1), np.repeat(noise, k, axis=0)], axis=1)
            there = self._linearise(self.observed(at), at)
            there = Linearised(*(x.reshape(len(theta), k, *x.shape[1:]) for x in there))
            found = np.stack([change.of(Linearised(*(x[:, b] for x in there))) for b in range(k)], axis=1)
            if self.model.is_uncertain:
                found += np.einsum("nbmk,nmk->nbm", there.residuals, change.by_residual)
            return found

        found = by_parameters(contract, values, self.errors.scale(values), self._bounds, self._test)
        return found if self.model.is_uncertain else of_residuals + found

    def _of_all_modes(self, of_used: FloatArray) -> FloatArray:
        """Expand rows (n, m, …) of the used modes to all modes, with 0 for unused modes."""
        found = np.zeros((len(of_used), len(self.group), *of_used.shape[2:]))
        found[:, self._used] = of_used
        return found

    def _by_sd(self, seen: ModalPrediction, theta: FloatArray, change: Change) -> FloatArray:
        """Return the log-density's derivatives with respect to inferred measurement sds, (n, m, n_noise)."""
        found = np.zeros(change.by_noise.shape)
        for d in sorted({d for term in self.terms_of for d in term.spread.sizes}):
            moved, column = theta.astype(complex), self.model.n_parameters + d
            step = _COMPLEX_STEP * theta[:, column]
            moved[:, column] += 1j * step
            rows = Linearised(*(x.imag for x in self._linearise(seen, moved)))
            of_residuals = np.einsum("nmk,nmk->nm", rows.residuals, change.by_residual)
            found[..., d] = (of_residuals + change.of(rows)) / step[:, None]
        return found

    def _whiten(
        self, seen: ModalPrediction, theta: FloatArray, chain: Chain | None, latent: LatentErrors
    ) -> tuple[FloatArray, FloatArray]:
        """Return the whitened residuals and their derivatives, in the order of `labels`."""
        n, noise = len(theta), self._noise(theta)
        chained = seen if chain is None else chain_prediction(seen, chain, self.model.test_of_modes)
        with np.errstate(all="ignore"):
            J = [self.of_used(residuals_of_term(t, chained, noise, within=True)[1], 1) for t in self.terms_of]
            r, slopes = latent.whiten(np.concatenate(J, axis=2))
        cuts = np.cumsum([one.shape[2] for one in J])[:-1]
        pairs = [
            (one.reshape(n, -1), slope.reshape(n, -1, slope.shape[-1]))
            for one, slope in zip(np.split(r, cuts, axis=2), np.split(slopes, cuts, axis=2), strict=True)
        ]
        found, slopes_found = zip(*pairs, *self._residuals_of_quantities(theta, chain), strict=True)
        return np.concatenate(found, axis=1), np.concatenate(slopes_found, axis=1)
