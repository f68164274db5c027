"""Likelihood of one test whose modes share no errors, in fewer operations than `fmu.posterior.discrepancy.latent`.

With frequencies alone, each mode has one error ε_i, and its scatter is one number. The log-density is then
log N(ε_i; 0, V_i) with

V_i = σ_i² + (∂ε_i/∂f_i)² v_i,   v_i = Σ_k (∂f_i/∂θ_k)² s_k² τ_k².

Here ε_i is the error of the frequency f_i, and σ_i its measurement standard deviation. The parameter θ_k scatters
with the standard deviation s_k τ_k (`fmu.posterior.discrepancy.embedded`).

With shapes, let r be a mode's residuals in measurement standard deviations and F = ∂r/∂θ diag(s τ) their loadings.
With M = I + FᵀF and b = Fᵀr, the log-density of independent residuals is increased by ½ (bᵀM⁻¹b − log det M). The
Cholesky factor of the following matrix gives both terms:

M    b
bᵀ   1 + rᵀr.

The square of the factor's last diagonal element is 1 + rᵀr − bᵀM⁻¹b. The product of the others is √det M.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from fmu.fem.modes.stacks import nan_where_singular
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.pairing.sensitivities import Sensitivities
from fmu.posterior.discrepancy.embedded import EmbeddedScatter
from fmu.posterior.discrepancy.latent import MOST_SQUARES, solve_positive
from fmu.posterior.errors.base import LOG_2PI, ErrorTerm
from fmu.posterior.errors.frequency import FrequencyTerm
from fmu.posterior.errors.shape import ShapeTerm
from fmu.posterior.errors.slopes import nan_unless_finite, split_by_term
from fmu.types import FloatArray

_NONE = np.empty((1, 0))  # no inferred standard deviations


def density_of_one_test(
    terms: Sequence[ErrorTerm], scatters: Sequence[EmbeddedScatter]
) -> ScatteredFrequencies | ScatteredModes | None:
    """Return the density of one test's modes that share no errors; None with shapes if any sd is inferred."""
    if len(terms) == 1 and isinstance(terms[0], FrequencyTerm):
        return ScatteredFrequencies(terms[0], scatters)
    return ScatteredModes(terms, scatters) if all(term.is_known for term in terms) else None


class OneTest:
    """Density of the modes of one test that share no errors, with embedded scatter.

    Parameters
    ----------
    scatters : sequence of EmbeddedScatter
        Scatters of the same p parameters. Their variances are added.
    """

    def __init__(self, scatters: Sequence[EmbeddedScatter]) -> None:
        self._relative, self._size_squared = scatters[0].relative[None], scatters[0].size[None] ** 2
        self._fixed = sum(one.fixed[None] ** 2 for one in scatters)
        inferred = {d for one in scatters for d in one.number.tolist() if d >= 0}
        # keyed by a τ's index in the noise: how many scatters of each parameter have this τ
        self._counts = {d: sum(1.0 * (one.number[None] == d) for one in scatters) for d in sorted(inferred)}

    def _squares(self, values: FloatArray) -> FloatArray:
        """Return each parameter's squared scatter unit s², shape (n, p)."""
        return np.where(self._relative, values**2, self._size_squared)

    def _tau_squared(self, noise: FloatArray) -> FloatArray:
        """Return each parameter's squared scatter τ², shape (n, p), or (1, p) if all τ are known."""
        total = self._fixed
        for d, count in self._counts.items():
            total = total + noise[:, d, None] ** 2 * count
        return np.asarray(total)


class ScatteredFrequencies(OneTest):
    """Density of independent Gaussian frequency errors with embedded scatter.

    Parameters
    ----------
    term : FrequencyTerm
    scatters : sequence of EmbeddedScatter
        Scatters of the same p parameters. Their variances are added.
    """

    def __init__(self, term: FrequencyTerm, scatters: Sequence[EmbeddedScatter]) -> None:
        super().__init__(scatters)
        self._term = term

    def terms(self, seen: ModalPrediction, values: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the log-density of each mode, shape (n, n_modes).

        Parameters
        ----------
        seen : ModalPrediction
            Predicted modes with derivatives with respect to the structural parameters.
        values : ndarray, shape (n, p)
            Structural parameters.
        noise : ndarray, shape (n, n_noise)
            Inferred error sds and τ.
        """
        with np.errstate(all="ignore"):
            error, slope = self._term.errors(seen.frequencies)
            J = np.asarray(seen.frequency_slopes)
            # einsum without `optimize` adds term by term: a result does not depend on the rest of the batch
            v = np.einsum("nmk,nmk,nk->nm", J, J, self._squares(values) * self._tau_squared(noise))
            V = self._term.spread.variance(noise) + slope**2 * v
            return np.asarray(-0.5 * (error**2 / V + np.log(V) + LOG_2PI))

    def terms_and_slopes(
        self, exact: Sensitivities, values: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return `terms` and their derivatives with respect to parameters and noise, (n, n_modes, p + n_noise).

        With the second derivatives H_i of f_i and d_i = s² τ² ∂f_i/∂θ, ∂v_i/∂θ = 2 H_i d_i + (∂f_i/∂θ)² τ² ∂s²/∂θ.
        Derivatives that are not finite are replaced by NaN.
        """
        f, J = exact.frequencies, exact.gradient
        with np.errstate(all="ignore"):
            error, slope = self._term.errors(f)
            squares, tau_squared = self._squares(values), self._tau_squared(noise)
            d = J * (squares * tau_squared)[:, None]
            by_tau_squared = J**2 * squares[:, None]
            v = np.einsum("nmk,nmk->nm", J, d)
            V = self._term.spread.variance(noise) + slope**2 * v
            terms = -0.5 * (error**2 / V + np.log(V) + LOG_2PI)
            by_V = 0.5 * (error**2 / V - 1.0) / V
            by_v = by_V * slope**2
            by_f = -error / V * slope
            if self._term.kind == "eigenvalue":  # ∂ε/∂f grows with f
                by_f = by_f + by_V * 4.0 * slope / self._term.measured**2 * v
            growth = np.where(self._relative, 2.0 * tau_squared * values, 0.0)  # τ² ∂s²/∂θ
            by_theta = by_f[..., None] * J
            by_theta += by_v[..., None] * (2.0 * exact.curvature(d) + J**2 * growth[:, None])
            p = values.shape[1]
            slopes = np.zeros((*f.shape, p + noise.shape[1]))
            slopes[..., :p] = by_theta
            for k, dV in self._term.spread.slopes(noise).items():
                slopes[..., p + k] += by_V * dV
            for k, count in self._counts.items():
                by_tau = 2.0 * noise[:, k, None] * np.einsum("nmk,nk->nm", by_tau_squared, count)
                slopes[..., p + k] += by_v * by_tau
        return terms, nan_unless_finite(slopes)


class Whitened(NamedTuple):
    """Residuals divided by known standard deviations, and their derivatives with respect to the parameters.

    Attributes
    ----------
    residuals : ndarray, shape (n, n_modes, q)
    slopes : ndarray, shape (n, n_modes, q, p)
        Derivatives of the residuals, projected as in `ErrorTerm.residuals_within`.
    log_peak : ndarray, shape (n, n_modes)
        The log-density plus half the sum of the squared residuals.
    log_peak_slopes : ndarray, shape (n, n_modes, p), or the number 0
    """

    residuals: FloatArray
    slopes: FloatArray
    log_peak: FloatArray
    log_peak_slopes: FloatArray | float = 0.0


class ScatteredModes(OneTest):
    """Density of independent Gaussian errors of frequencies and shapes, with embedded scatter.

    Parameters
    ----------
    terms : sequence of FrequencyTerm and ShapeTerm
        All of their standard deviations are known.
    scatters : sequence of EmbeddedScatter
        Scatters of the same p parameters. Their variances are added.
    """

    def __init__(self, terms: Sequence[ErrorTerm], scatters: Sequence[EmbeddedScatter]) -> None:
        super().__init__(scatters)
        self._terms = terms
        self._whiten = [_whitener(term) for term in terms]

    def terms(self, seen: ModalPrediction, values: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the log-density of each mode, (n, n_modes); see `ScatteredFrequencies.terms`."""
        with np.errstate(all="ignore"):
            r, J, log_peak = _join([whiten(seen) for whiten in self._whiten])
            return log_peak + self._factorise(r, J * self._sd(values, noise)[:, None, None])[0]

    def terms_and_slopes(
        self, exact: Sensitivities, values: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return `terms` and their derivatives; see `ScatteredFrequencies.terms_and_slopes`.

        With V = I + FFᵀ, the derivatives with respect to r are −e = −V⁻¹r, and with respect to F they are
        e(M⁻¹b)ᵀ − F M⁻¹.
        """
        seen, p = exact.prediction, values.shape[1]
        with np.errstate(all="ignore"):
            parts = [whiten(seen) for whiten in self._whiten]
            r, J, log_peak = _join(parts)
            sd = self._sd(values, noise)[:, None, None]
            F = J * sd
            terms, precision, b = self._factorise(r, F)
            unit = np.broadcast_to(np.eye(p), precision.shape)
            given = solve_positive(precision, np.concatenate([b, unit], axis=3))  # M⁻¹b and M⁻¹
            e = r - (F @ given[..., :1])[..., 0]
            by_F = e[..., None] * given[:, :, None, :, 0] - F @ given[..., 1:]
            by_log_sd = np.sum(by_F * F, axis=2)
            slopes = np.zeros((*terms.shape, p + noise.shape[1]))
            by_theta = slopes[..., :p]
            by_theta -= np.einsum("nmk,nmkp->nmp", e, J)
            d, of_shapes, by_J = np.zeros(exact.gradient.shape), None, by_F * sd
            for term, part, by in zip(self._terms, parts, split_by_term(self._terms, by_J), strict=True):
                of_frequency, of_shape, direct = term.change_of_slopes(seen, noise, by)
                by_theta += direct + part.log_peak_slopes
                if of_frequency is not None:
                    d = of_frequency
                if of_shape is not None:
                    of_shapes = of_shape
            by_theta += exact.curvature(d, of_shapes)
            by_theta += by_log_sd * np.where(self._relative, 1.0 / values, 0.0)[:, None]
            tau_squared = self._tau_squared(noise)
            by_tau_squared = by_log_sd / np.where(tau_squared > 0.0, tau_squared, np.inf)[:, None]
            for k, count in self._counts.items():
                slopes[..., p + k] += noise[:, k, None] * np.einsum("nmk,nk->nm", by_tau_squared, count)
        return terms + log_peak, nan_unless_finite(slopes)

    def _sd(self, values: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the standard deviation s τ of each parameter's scatter, shape (n, p)."""
        return np.sqrt(self._squares(values) * self._tau_squared(noise))

    def _factorise(self, r: FloatArray, F: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return −½ (rᵀV⁻¹r + log det V), shape (n, m), M and b, from residuals (n, m, k) and loadings F.

        V = I + FFᵀ is the covariance of the residuals; the module docstring defines M and b.
        """
        X = np.concatenate([F, r[..., None]], axis=3)
        matrix = np.swapaxes(X, 2, 3) @ X
        squares, i = matrix[..., -1, -1].copy(), np.arange(matrix.shape[-1])
        matrix[..., i, i] += 1.0
        diagonal = cholesky(matrix)[..., i, i]
        terms = 0.5 * (1.0 - diagonal[..., -1] ** 2) - np.sum(np.log(diagonal[..., :-1]), axis=2)
        return np.where(squares > MOST_SQUARES, -np.inf, terms), matrix[..., :-1, :-1], matrix[..., :-1, -1:]


def _whitener(term: ErrorTerm) -> Callable[[ModalPrediction], Whitened]:
    """Return the function that whitens the errors of a prediction."""
    if isinstance(term, ShapeTerm):
        return partial(_whiten_shapes, term, _log_scale(term))
    assert isinstance(term, FrequencyTerm)  # narrowed for the type checker
    return partial(_whiten_frequencies, term)


def _whiten_frequencies(term: FrequencyTerm, seen: ModalPrediction) -> Whitened:
    error, slope = term.errors(seen.frequencies)
    root = np.sqrt(2.0 * term.beta)[None]
    J = (root * slope)[..., None] * np.asarray(seen.frequency_slopes)
    return Whitened((root * error)[..., None], J[:, :, None], np.log(root) - 0.5 * LOG_2PI)


def _whiten_shapes(term: ShapeTerm, log_scale: FloatArray, seen: ModalPrediction) -> Whitened:
    """Return the whitened errors of shapes, given the `_log_scale` of the error model.

    The derivatives are −a (I − ψψᵀ/ψᵀψ) Λ^½ ∂φ/∂θ with ψ = Λ^½φ.
    """
    s, slopes, root = seen.shapes, np.asarray(seen.shape_slopes), term.spread.inverse_sd(_NONE)
    u, psi, pulled = root * term.unit, root * s, root[..., None] * slopes
    weighted, size = np.sum(psi**2, axis=1), np.sum(s**2, axis=1)
    a = np.sum(u * psi, axis=1) / weighted
    along = np.einsum("nqm,nqmp->nmp", psi, pulled) / weighted[..., None]
    J = a[:, None, :, None] * (psi[..., None] * along[:, None] - pulled)
    by_peak = np.einsum("nqm,nqmp->nmp", s, slopes) / size[..., None] - along
    log_peak = log_scale - 0.5 * np.log(weighted / size)
    return Whitened(np.swapaxes(u - a[:, None] * psi, 1, 2), np.swapaxes(J, 1, 2), log_peak, by_peak)


def _log_scale(term: ShapeTerm) -> FloatArray:
    """Return the part of each mode's log-density that depends on the known sds alone, shape (1, n_modes)."""
    return np.sum(np.log(term.spread.inverse_sd(_NONE)), axis=1) - 0.5 * term.n_data * LOG_2PI


def _join(parts: Sequence[Whitened]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the residuals (n, m, k), their derivatives (n, m, k, p) and the log-density at r = 0, (n, m)."""
    r = np.concatenate([part.residuals for part in parts], axis=2)
    J = np.concatenate([part.slopes for part in parts], axis=2)
    return r, J, np.asarray(sum(part.log_peak for part in parts))


def cholesky(matrix: FloatArray) -> FloatArray:
    """Return the Cholesky factors of matrices (…, P, P); NaN if a matrix is not positive definite."""
    return nan_where_singular(np.linalg.cholesky, matrix)
