"""Two modes that come close: smooth are not their eigenvalues but the mean and the square of the distance.

Modes that are taken by number, in the order of their frequencies, change places where they cross: their
eigenvalues have a kink there, and where they veer a bend that is nearly one. Of the two by two problem that the
pair obeys, the trace and the determinant are smooth functions of stiffness and mass (Kato 1995, *Perturbation
Theory for Linear Operators*, II §1), and so are, with z = log λ,

s = ½ (z₁ + z₂),  d = ¼ (z₂ − z₁)²,  from which  z = s ∓ √d.

Where d is uncertain, with the expectation d̂ and the variance v, √d is taken to have the square ½ (d̂ + h) and the
variance v/(4h), h² = d̂² + v: to first order where d̂ is large, and of the right size where it is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmu.types import FloatArray

_CLOSE = 0.2
"""Modes are close whose least distance in log λ is such a part of the median."""
_LEAST = 1e-14  # h, of d: that of frequencies that agree to seven digits


@dataclass(frozen=True)
class ClosePairs:
    """Which modes are close to the next one, and what is learnt instead of their eigenvalues.

    Attributes
    ----------
    first : tuple of int
        The lower mode of each pair; no mode is in two of them.
    """

    first: tuple[int, ...] = ()

    @classmethod
    def of(cls, z: FloatArray) -> ClosePairs:
        """Return the pairs of modes with log λ z (N, n_modes): those in order at all points that come close.

        Of two pairs that share a mode the one that comes closer counts.
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
        """Return what is learnt, (N, n_modes): s and d in the places of a pair, and z of all others."""
        found = z.copy()
        for i in self.first:
            found[:, i] = 0.5 * (z[:, i] + z[:, i + 1])
            found[:, i + 1] = 0.25 * (z[:, i + 1] - z[:, i]) ** 2
        return found

    def values(self, y: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return z and its variance, from what was learnt and its variance, (n, n_modes) each."""
        z, z_variance = y.copy(), v.copy()
        for i in self.first:
            root, h = _root(y[:, i + 1], v[:, i + 1])
            z[:, i], z[:, i + 1] = y[:, i] - root, y[:, i] + root
            z_variance[:, i] = z_variance[:, i + 1] = v[:, i] + 0.25 * v[:, i + 1] / h
        return z, z_variance

    def slopes(
        self, y: FloatArray, v: FloatArray, dy: FloatArray, dv: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of `values`, (n, n_modes, n_parameters) each, from the learnt derivatives."""
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
        """Return the numbers (n_modes,) of learnt quantities that are in the unit of z."""
        return np.delete(learnt, [i + 1 for i in self.first])

    def weights(self, y: FloatArray, v: FloatArray, by_z: FloatArray) -> FloatArray:
        """Return the weights of the learnt variances, (n, n_modes), for weights of the variances of z."""
        found = by_z.copy()
        for i in self.first:
            both = by_z[:, i] + by_z[:, i + 1]
            found[:, i], found[:, i + 1] = both, 0.25 * both / _root(y[:, i + 1], v[:, i + 1])[1]
        return found


def _root(d: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return √d and h."""
    h = np.sqrt(d**2 + v + _LEAST**2)
    # of a negative d without loss of digits
    square = 0.5 * np.where(d >= 0.0, d + h, (v + _LEAST**2) / (h - np.minimum(d, 0.0)))
    return np.sqrt(square), h
