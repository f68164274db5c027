"""Pairs of close modes, whose eigenvalues are replaced by two smooth functions of the parameters.

Modes that are numbered in order of frequency swap where they cross. As functions of the parameters, their
eigenvalues have a kink there, and nearly a kink where the modes veer. A pair of modes obeys a 2 × 2 eigenproblem,
whose trace and determinant are smooth functions of stiffness and mass (Kato 1995, *Perturbation Theory for Linear
Operators*, II §1). The mean s and the squared half-distance d of z = log λ are therefore smooth too:

s = ½ (z₁ + z₂),  d = ¼ (z₂ − z₁)²,  from which  z = s ∓ √d.

If d is uncertain, with expectation d̂ and variance v, the expectation of √d is taken as the square root of
½ (d̂ + h), and the variance of √d as v/(4h), with h² = d̂² + v. These values are correct to first order
for large d̂, and have the right order of magnitude for d̂ = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmu.types import FloatArray

_CLOSE = 0.2
"""Two modes are close if their smallest distance in log λ is less than this fraction of the median distance."""
_LEAST = 1e-14  # smallest h, which is the d of two frequencies that agree to seven digits


@dataclass(frozen=True)
class ClosePairs:
    """Pairs of close modes, and the map between their z = log λ and the smooth quantities s and d.

    Attributes
    ----------
    first : tuple of int
        Index of the lower mode in each pair; no mode is in two pairs.
    """

    first: tuple[int, ...] = ()

    @classmethod
    def of(cls, z: FloatArray) -> ClosePairs:
        """Find pairs of adjacent modes that come close at some point, for z = log λ of shape (N, n_modes).

        The modes of a pair must be in ascending order at all N points. If two pairs share a mode, the closer pair
        is used.
        """
        gap = np.diff(z, axis=1)
        closeness = np.min(gap, axis=0) / np.median(gap, axis=0)
        found: list[int] = []
        for i in np.argsort(closeness, kind="stable"):
            is_new = i not in found and i - 1 not in found and i + 1 not in found
            if np.all(gap[:, i] >= 0.0) and closeness[i] < _CLOSE and is_new:
                found.append(int(i))
        return cls(tuple(sorted(found)))

    def learnt(self, z: FloatArray) -> FloatArray:
        """Return the quantities to fit, (N, n_modes): s and d in a pair's two columns, z for other modes."""
        found = z.copy()
        for i in self.first:
            found[:, i] = 0.5 * (z[:, i] + z[:, i + 1])
            found[:, i + 1] = 0.25 * (z[:, i + 1] - z[:, i]) ** 2
        return found

    def values(self, y: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z and its variance, (n, n_modes) each, from the fitted quantities y and their variances v."""
        z, z_variance = y.copy(), v.copy()
        for i in self.first:
            root, h = _root(y[:, i + 1], v[:, i + 1])
            z[:, i], z[:, i + 1] = y[:, i] - root, y[:, i] + root
            z_variance[:, i] = z_variance[:, i + 1] = v[:, i] + 0.25 * v[:, i + 1] / h
        return z, z_variance

    def slopes(
        self, y: FloatArray, v: FloatArray, dy: FloatArray, dv: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of z and of its variance, (n, n_modes, n_parameters) each; see `values`.

        dy and dv are the derivatives of y and v with respect to the parameters, of the same shape.
        """
        dz, dz_variance = dy.copy(), dv.copy()
        for i in self.first:
            d, s2 = y[:, i + 1, None], v[:, i + 1, None]
            root, h = _root(d, s2)
            dh = (d * dy[:, i + 1] + 0.5 * dv[:, i + 1]) / h
            by_root = 0.25 * (dy[:, i + 1] + dh) / root
            dz[:, i], dz[:, i + 1] = dy[:, i] - by_root, dy[:, i] + by_root
            of_root = 0.25 * (dv[:, i + 1] - s2 / h * dh) / h
            dz_variance[:, i] = dz_variance[:, i + 1] = dv[:, i] + of_root
        return dz, dz_variance

    def of_eigenvalues(self, learnt: FloatArray) -> FloatArray:
        """Return the elements of an array (n_modes,) that belong to s and z, without those that belong to d."""
        return np.delete(learnt, [i + 1 for i in self.first])

    def weights(self, y: FloatArray, v: FloatArray, by_z: FloatArray) -> FloatArray:
        """Convert weights `by_z` for the variances of z to weights for the variances v, both (n, n_modes).

        The weighted sum of variances stays the same. The fitted quantities y and their variances v are as in
        `values`.
        """
        found = by_z.copy()
        for i in self.first:
            both = by_z[:, i] + by_z[:, i + 1]
            found[:, i], found[:, i + 1] = both, 0.25 * both / _root(y[:, i + 1], v[:, i + 1])[1]
        return found


def _root(d: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return E[√d] and h (see the module) for expectations `d` and variances `v`, all of the same shape."""
    h = np.sqrt(d**2 + v + _LEAST**2)
    # the second form is for negative d, without cancellation
    square = 0.5 * np.where(d >= 0.0, d + h, (v + _LEAST**2) / (h - np.minimum(d, 0.0)))
    return np.sqrt(square), h
