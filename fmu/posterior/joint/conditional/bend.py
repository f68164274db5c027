"""Model the curved ridges in a test's score density.

They occur if precise data leave some combinations of scores undetermined. Along an undetermined combination, the
other combinations follow a curve, which is a parabola to second order. Let x be the scores in coordinates that
have unit variances in the normal approximation, in the order of decreasing score variance. The density is close to
the distribution of

x_j = y_j + Σ_(i,k<j) Q_jik y_i y_k

with normally distributed y. The map from y to x has determinant one (compare the test distributions of Haario,
Saksman & Tamminen 1999, *Comput. Stat.* 14, 375–395).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fmu.types import FloatArray


class Bend(NamedTuple):
    """Parabolas along which each test's score density is curved.

    Attributes
    ----------
    forward, inverse : ndarray, shape (n_tests, p, p)
        The matrix that maps the scores' offset from the centre to coordinates, and its inverse.
    curvature : ndarray, shape (n_tests, p, p, p)
        The coefficients Q.
    slopes : ndarray, shape (n_tests, p)
        Derivatives of parameter values with respect to scores at the point where the matrices were computed.
    """

    forward: FloatArray
    inverse: FloatArray
    curvature: FloatArray
    slopes: FloatArray


class Curve(NamedTuple):
    """A `Bend` about a given centre.

    Attributes
    ----------
    of : Bend
    centre : ndarray, shape (n, n_tests, p)
        Scores at the centre.
    stretch : ndarray, shape (n, n_tests, p)
        Derivatives of parameter values with respect to scores, relative to the bend's `slopes`.
    """

    of: Bend
    centre: FloatArray
    stretch: FloatArray

    def bend(self, z: FloatArray) -> FloatArray:
        """Map straightened scores z to the scores on the curved ridge, both of shape (n, n_tests, p)."""
        y = np.einsum("tij,ntj->nti", self.of.forward, self.stretch * (z - self.centre))
        added = np.einsum("tjik,nti,ntk->ntj", self.of.curvature, y, y)
        return np.asarray(z + np.einsum("tij,ntj->nti", self.of.inverse, added) / self.stretch)

    def straighten(self, z: FloatArray) -> FloatArray:
        """Map scores z to straightened scores, both of shape (n, n_tests, p); the inverse of `bend`."""
        y = np.einsum("tij,ntj->nti", self.of.forward, self.stretch * (z - self.centre))
        added = np.zeros_like(y)
        for j in range(1, y.shape[2]):
            before = y[..., :j]
            added[..., j] = np.einsum("tik,nti,ntk->nt", self.of.curvature[:, j, :j, :j], before, before)
            y[..., j] -= added[..., j]
        return np.asarray(z - np.einsum("tij,ntj->nti", self.of.inverse, added) / self.stretch)


def find_bend(
    gradient: Callable[[FloatArray], FloatArray], mean: FloatArray, precision: FloatArray, slopes: FloatArray
) -> Bend:
    """Return the parabolas about each test's most probable scores.

    Parameters
    ----------
    gradient : callable
        Returns the gradients of each test's score log-density at scores (n, n_tests, p), with the same shape.
    mean : ndarray, shape (n_tests, p)
        The most probable scores.
    precision : ndarray, shape (n_tests, p, p)
        Precision matrices of the normal approximation.
    slopes : ndarray, shape (n_tests, p)
        Derivatives of parameter values with respect to scores.

    Notes
    -----
    Q is computed from gradients at p (p + 1) points, one standard deviation away from the mean in each direction
    and between each pair of directions.
    """
    values, vectors = np.linalg.eigh(precision)
    inverse = vectors / np.sqrt(values)[:, None, :]
    p = mean.shape[1]
    pairs = np.stack(np.triu_indices(p), axis=1)
    y = np.eye(p)[pairs].sum(axis=1)
    y /= np.linalg.norm(y, axis=1)[:, None]
    away = np.einsum("tij,nj->nti", inverse, y)
    both = np.einsum("tij,nti->ntj", inverse, gradient(np.concatenate([mean + away, mean - away])))
    along = 0.5 * (both[: len(y)] + both[len(y) :])  # the x_j at which the gradients vanish, of unit curvature
    curvature = np.zeros((len(mean), p, p, p))
    for (i, k), of in zip(pairs, along, strict=True):
        curvature[:, :, i, k] = curvature[:, :, k, i] = of
    square = np.einsum("tjii->tji", curvature)
    mixed = curvature - 0.5 * (square[..., :, None] + square[..., None, :])
    mixed[:, :, np.arange(p), np.arange(p)] = square
    j, i, k = np.ogrid[:p, :p, :p]
    return Bend(
        np.sqrt(values)[..., None] * np.swapaxes(vectors, 1, 2),
        inverse,
        np.where(np.maximum(i, k) < j, mixed, 0.0),
        slopes,
    )
