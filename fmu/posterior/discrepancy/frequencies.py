"""Frequency likelihood for one test whose modes share no errors, computed without matrices.

If only frequencies have errors, each mode has one residual, and its scatter is one number. The log-density in
`fmu.posterior.discrepancy.latent` is then log N(ε_i; 0, V_i) with

V_i = σ_i² + (∂ε_i/∂f_i)² v_i,   v_i = Σ_k (∂f_i/∂θ_k)² s_k² τ_k².

Here ε_i is the error of the frequency f_i, and σ_i its measurement standard deviation. The parameter θ_k scatters
with the standard deviation s_k τ_k (`fmu.posterior.discrepancy.embedded`). At a single theta, this method takes a
third of the time of the general one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmu.fem.pairing.sensitivities import Sensitivities
from fmu.posterior.discrepancy.embedded import EmbeddedScatter
from fmu.posterior.errors.base import LOG_2PI
from fmu.posterior.errors.frequency import FrequencyTerm
from fmu.types import FloatArray


class ScatteredFrequencies:
    """Density of independent Gaussian frequency errors with embedded scatter.

    Parameters
    ----------
    term : FrequencyTerm
    scatters : sequence of EmbeddedScatter
        Scatters of the same p parameters. Their variances are added.
    """

    def __init__(self, term: FrequencyTerm, scatters: Sequence[EmbeddedScatter]) -> None:
        self._term = term
        self._relative, self._size_squared = scatters[0].relative[None], scatters[0].size[None] ** 2
        self._fixed = sum(one.fixed[None] ** 2 for one in scatters)
        inferred = {d for one in scatters for d in one.number.tolist() if d >= 0}
        # keyed by a τ's index in the noise: how many scatters of each parameter have this τ
        self._counts = {d: sum(1.0 * (one.number[None] == d) for one in scatters) for d in sorted(inferred)}

    def terms(self, f: FloatArray, J: FloatArray, values: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the log-density of each mode, shape (n, n_modes).

        Parameters
        ----------
        f : ndarray, shape (n, n_modes), Hz
            Computed frequencies.
        J : ndarray, shape (n, n_modes, p)
            Frequency gradients with respect to the structural parameters.
        values : ndarray, shape (n, p)
            Structural parameters.
        noise : ndarray, shape (n, n_noise)
            Inferred error sds and τ.
        """
        with np.errstate(all="ignore"):
            error, slope = self._term.errors(f)
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
        finite = np.isfinite(slopes)
        if np.count_nonzero(finite) < finite.size:
            slopes[~finite] = np.nan
        return terms, slopes

    def _squares(self, values: FloatArray) -> FloatArray:
        """Return each parameter's squared scatter unit s², shape (n, p)."""
        return np.where(self._relative, values**2, self._size_squared)

    def _tau_squared(self, noise: FloatArray) -> FloatArray:
        """Return each parameter's squared scatter τ², shape (n, p), or (1, p) if all τ are known."""
        total = self._fixed
        for d, count in self._counts.items():
            total = total + noise[:, d, None] ** 2 * count
        return np.asarray(total)
