"""Residuals of a reduced model at all points in its box, from one set of right-hand sides.

Let K(θ) = Σ_k c_k(θ) K_k and M(θ) = Σ_l d_l(θ) M_l, and let V be the trial vectors. The residual of a Ritz pair
(μ, V y), r = Σ_k c_k(θ) K_k V y − μ Σ_l d_l(θ) M_l V y, is a sum of multiples of the vectors K_k V and M_l V,
which do not depend on θ. The solutions W = Ā⁻¹ [K_k V, M_l V] are computed once, where Ā is K + s M at the anchor
point. The energies rᵀ Ā⁻¹ r and the corrections Ā⁻¹ r of every mode at every θ then need no further solve (offline
and online stage; Rozza, Huynh & Patera 2008, *Arch. Comput. Methods Eng.* 15, 229–275, section 8). An energy is a
difference of numbers of the size of λ, so its rounding error is 1e-15 λ, whereas the frequency errors that matter
are above 1e-9.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.solver import LARGE
from fmu.fem.modes.terms import coefficients
from fmu.types import FloatArray

_MOST_TERMS = 16
MEMORY = 2**33
"""Memory limit for the vectors W, in bytes; beyond it, each residual needs its own solve."""
_TOGETHER = 32  # vectors of a space whose right-hand sides are solved together


@dataclass(frozen=True, eq=False)
class SharedResiduals:
    """Inner products between the right-hand sides of one block's residuals, computed once.

    Let r be the number of basis vectors, and T the number of stiffness and mass terms. The right-hand side with
    the index v T + t is matrix term t times basis vector v; stiffness terms come before mass terms.

    Attributes
    ----------
    block : FullBlock
    energy : ndarray, shape (r T, r T)
        The forms Rᵀ Ā⁻¹ R of the right-hand sides R.
    mass : ndarray, shape (n_mass_terms, r T, r T)
        The forms Wᵀ M_l W.
    W : tuple of ndarray, each of shape (n_dof, q T)
        The solutions W = Ā⁻¹ R, in groups of columns; empty once the basis is final.
    """

    block: FullBlock
    energy: FloatArray
    mass: FloatArray
    W: tuple[FloatArray, ...] = ()

    @classmethod
    def of(cls, block: FullBlock) -> Self | None:
        """Return shared residuals for a space without vectors.

        Return None if the block has fewer than `LARGE` degrees of freedom or more than 16 stiffness and mass
        terms.
        """
        n_terms = len(block.K_terms) + len(block.M_terms)
        if block.size < LARGE or n_terms > _MOST_TERMS:
            return None
        return cls(block, np.empty((0, 0)), np.empty((len(block.M_terms), 0, 0)))

    def grown(self, X: FloatArray, solve: Callable[[FloatArray], FloatArray]) -> Self | None:
        """Return shared residuals for the space with vectors X (n_dof, q) added, or None if W would be too large.

        `solve` returns Ā⁻¹ b for b (n_dof, m).
        """
        terms = (*self.block.K_terms, *self.block.M_terms)
        grown = self
        for first in range(0, X.shape[1], _TOGETHER):
            new = X[:, first : first + _TOGETHER]
            size = len(grown.energy) + new.shape[1] * len(terms)
            if 8 * size * self.block.size > MEMORY:
                return None
            R = np.stack([term.matrix @ new for term in terms], axis=2).reshape(self.block.size, -1)
            W = solve(R)
            energy = np.concatenate([part.T @ R for part in (*grown.W, W)])
            masses = []
            for term, mass in zip(self.block.M_terms, grown.mass, strict=True):
                heavy = term.matrix @ W
                masses.append(_add_border(mass, np.concatenate([part.T @ heavy for part in (*grown.W, W)])))
            grown = replace(
                grown, energy=_add_border(grown.energy, energy), mass=np.stack(masses), W=(*grown.W, W)
            )
        return grown

    def restrict(self, S: FloatArray) -> Self:
        """Return the shared residuals, without the vectors W, for the smaller space V S with S of shape (r, q)."""
        T = len(self.energy) // len(S)

        def project(forms: FloatArray) -> FloatArray:
            parts = forms.reshape(len(S), T, len(S), T)
            return np.asarray(np.einsum("ac,atbu,bd->ctdu", S, parts, S, optimize=True)).reshape(
                T * S.shape[1], -1
            )

        return replace(self, energy=project(self.energy), mass=np.stack(list(map(project, self.mass))), W=())

    def coefficients(self, theta: FloatArray, lam: FloatArray, y: FloatArray) -> FloatArray:
        """Return modal residuals as coefficients of the right-hand sides R, shape (n, r T, m).

        The modes at theta (n, p) have eigenvalues λ (n, m) and vectors y (n, r, m).
        """
        stiff = np.repeat(coefficients(self.block.K_terms, theta)[:, None], lam.shape[1], axis=1)
        heavy = -lam[:, :, None] * coefficients(self.block.M_terms, theta)[:, None]
        weights = np.concatenate([stiff, heavy], axis=2)  # (n, m, T)
        z = y.swapaxes(1, 2)[..., None] * weights[:, :, None]
        return np.asarray(z.reshape(*lam.shape, -1).swapaxes(1, 2))

    def forms(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the inner products rᵢᵀ Ā⁻¹ rⱼ of modal residuals, (n, m, m), and wᵀ M w with w = Ā⁻¹ r, (n, m).

        The residuals at theta (n, p) have the `coefficients` z.
        """
        energy = z.swapaxes(1, 2) @ (self.energy @ z)
        heavy = coefficients(self.block.M_terms, theta)
        mass = sum(heavy[:, [k]] * np.sum(z * (form @ z), axis=1) for k, form in enumerate(self.mass))
        return energy, np.asarray(mass)

    def corrections(self, z: FloatArray) -> FloatArray:
        """Return the corrections Ā⁻¹ r, shape (n_dof, m), for residuals r with coefficients z (r T, m).

        They require `W`: once it is empty, the result is zero.
        """
        found, first = np.zeros((self.block.size, z.shape[1])), 0
        for part in self.W:
            found += part @ z[first : first + part.shape[1]]
            first += part.shape[1]
        return found


def _add_border(form: FloatArray, columns: FloatArray) -> FloatArray:
    """Append columns (r + q, q), and the matching rows, to a symmetric matrix (r, r)."""
    r = len(form)
    corner = columns[r:]
    return np.block([[form, columns[:r]], [columns[:r].T, 0.5 * (corner + corner.T)]])
