"""Curved ridges in the density of a test's scores, if precise data leave some combinations of scores undetermined.

Along such a combination the other combinations follow a curve, to second order a parabola. Let the coordinates y
have unit variances in the normal approximation, in the order of decreasing variances of the scores. The density is
close to a normal distribution of the y with

x_j = y_j + Σ_(i,k<j) Q_jik y_i y_k,

where x are the same coordinates of the scores. The map from y to x has a determinant of one (compare the test
distributions of Haario, Saksman & Tamminen 1999, *Comput. Stat.* 14, 375–395).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fmu.types import FloatArray


class Bend(NamedTuple):
    """The parabolas that the densities of each test's scores follow.

    Attributes
    ----------
    forward, inverse : ndarray, shape (n_tests, p, p)
        The matrix that maps the distance of the scores from a centre to coordinates, and its inverse.
    curvature : ndarray, shape (n_tests, p, p, p)
        The coefficients Q.
    slopes : ndarray, shape (n_tests, p)
        Derivatives of the values with respect to the scores, for which the matrices are valid.
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
    stretch : ndarray, shape (n, n_tests, p)
        Derivatives of the values with respect to the scores, relative to the `slopes` of the bend.
    """

    of: Bend
    centre: FloatArray
    stretch: FloatArray

    def bend(self, z: FloatArray) -> FloatArray:
        """Return the scores (n, n_tests, p) for straightened scores z."""
        y = np.einsum("tij,ntj->nti", self.of.forward, self.stretch * (z - self.centre))
        added = np.einsum("tjik,nti,ntk->ntj", self.of.curvature, y, y)
        return np.asarray(z + np.einsum("tij,ntj->nti", self.of.inverse, added) / self.stretch)

    def straighten(self, z: FloatArray) -> FloatArray:
        """Return the straightened scores (n, n_tests, p) for scores z; the inverse of `bend`."""
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
    """Return the parabolas about the most probable scores.

    Parameters
    ----------
    gradient : callable
        Returns the gradients of the log-densities of each test's scores, at scores (n, n_tests, p).
    mean : ndarray, shape (n_tests, p)
    precision : ndarray, shape (n_tests, p, p)
    slopes : ndarray, shape (n_tests, p)
        Derivatives of the values with respect to the scores.

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
