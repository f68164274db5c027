"""Eigenvalues and residues of modes with their derivatives, for FRFs whose mode frequencies are parameters.

With mass-normalised shapes φ_r, the receptance between the points j and k is H_jk = Σ_r A_r g_r with the residues
A_r = φ_jr φ_kr (`fmu.fem.frf.proportional`). For changes dK, dM in modal coordinates,

    dλ_r = dK_rr − λ_r dM_rr,
    dA_r = Σ_{s≠r} (φ_jr φ_ks + φ_js φ_kr) (dK_rs − λ_r dM_rs)/(λ_r − λ_s) − φ_jr φ_kr dM_rr

(Fox & Kapoor 1968, *AIAA J.* 6, 2426–2429).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fmu.fem.frf.model import FRFModel
from fmu.fem.frf.proportional import CLOSE, ProportionalDamping
from fmu.types import ComplexArray, FloatArray


@dataclass(frozen=True, eq=False)
class Residues:
    """Eigenvalues and residues of r modes at n parameter vectors, with derivatives for p structural parameters.

    Attributes
    ----------
    lam, by_lam : ndarray, shapes (n, r) and (n, r, p)
        Eigenvalues in ascending order, and their derivatives.
    amplitudes, by_amplitude : ndarray, shapes (n, n_frfs, r) and (n, n_frfs, r, p)
        Residues A, and their derivatives. The derivatives omit the mixing of modes whose eigenvalues nearly
        coincide.
    """

    lam: FloatArray
    by_lam: FloatArray
    amplitudes: FloatArray
    by_amplitude: FloatArray

    @classmethod
    def of(cls, model: FRFModel, theta: FloatArray) -> Residues:
        """Compute a model's eigenvalues and residues for structural parameters (n, p)."""
        lam, phi = model.block.modes(theta, model.block.size)
        dK, dM = model.block.changes(theta, phi)
        seen = model.points @ phi
        at, to = seen[:, model.responses], seen[:, model.drives]
        gap = lam[:, :, None] - lam[:, None]
        apart = np.abs(gap) > CLOSE * (np.abs(lam[:, :, None]) + np.abs(lam[:, None]))
        mixed = (dK - lam[:, None, :, None] * dM) / np.where(apart, gap, np.inf)[:, None]  # (n, p, r, s)
        mixed = np.moveaxis(mixed, 1, 3)  # (n, r, s, p)
        own = np.einsum("nprr->nrp", dM)
        by_amplitude = at[..., None] * np.einsum("nfs,nrsp->nfrp", to, mixed)
        by_amplitude += to[..., None] * np.einsum("nfs,nrsp->nfrp", at, mixed)
        by_amplitude -= (at * to)[..., None] * own[:, None]
        by_lam = np.einsum("nprr->nrp", dK) - lam[..., None] * own
        return cls(lam, by_lam, at * to, by_amplitude)


@dataclass(frozen=True, eq=False)
class Resonances:
    """Resonance factors g_r(ω) of n × r modes at L lines, and their derivatives.

    Attributes
    ----------
    g : ndarray of complex, shape (n, r, L)
    by_lam, by_viscous, by_hysteretic : ndarray of complex, shape (n, r, L)
        Derivatives with respect to the eigenvalue (including its effect on the damping), and to c_r and h_r.
    """

    g: ComplexArray
    by_lam: ComplexArray
    by_viscous: ComplexArray
    by_hysteretic: ComplexArray

    @classmethod
    def of(
        cls, damping: ProportionalDamping, lam: FloatArray, values: FloatArray, omega: FloatArray
    ) -> Resonances:
        """Compute the factors for eigenvalues (n, r), damping parameters (n, q) and lines (L,) in rad/s."""
        rates = damping.rates(lam, values)
        lossy = rates.viscous[..., None] * omega + rates.hysteretic[..., None]
        g = 1.0 / (lam[..., None] - omega**2 + 1j * lossy)
        square = -(g**2)
        slope = 1.0 + 1j * (rates.viscous_slope[..., None] * omega + rates.hysteretic_slope[..., None])
        parts = (g, square * slope, 1j * square * omega, 1j * square)
        return cls(*(np.asarray(part, dtype=complex) for part in parts))

    def smooth(self, along_lines: Callable[[ComplexArray], ComplexArray]) -> Resonances:
        """Return the factors and derivatives after applying `along_lines`, a linear map along the last axis."""
        return Resonances(*map(along_lines, (self.g, self.by_lam, self.by_viscous, self.by_hysteretic)))
