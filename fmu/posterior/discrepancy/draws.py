"""Evaluate quantities at posterior draws, only once for equal draws (a rejected step repeats the last draw)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fmu.progress.phases import by_parts
from fmu.types import FloatArray, IntArray


def distinct_rows(theta: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the distinct rows of theta (n, ndim), and each row's index among them, shape (n,)."""
    distinct, index = np.unique(theta, axis=0, return_inverse=True)
    return distinct, index.reshape(-1)


def at_distinct_rows(
    function: Callable[[FloatArray], Sequence[FloatArray]], theta: FloatArray
) -> tuple[FloatArray, ...]:
    """Return the arrays that a function gives at theta (n, ndim), evaluating the function at distinct rows only.

    Parameters
    ----------
    function : callable
        Maps rows (m, ndim) to arrays (m, …).
    theta : ndarray, shape (n, ndim)
    """
    distinct, index = distinct_rows(theta)
    parts = by_parts("predictions", function, distinct)
    return tuple(np.concatenate(part)[index] for part in zip(*parts, strict=True))


def errors_from_normal(z: FloatArray, w: FloatArray, given: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Transform standard normal z, (n, m, P), and w, (n, C), to draws of the latent errors given the data.

    `given` is the result of `DiscrepantLikelihood.errors_given_data`. P and C are the numbers of own errors of a
    mode and of common errors (`fmu.posterior.discrepancy.latent`).
    """
    mean, gain, covariance, mean_w, of_w = given
    w = mean_w + np.einsum("ncd,nd->nc", np.linalg.cholesky(of_w), w)
    z = mean + np.einsum("nmpq,nmq->nmp", np.linalg.cholesky(covariance), z)
    return z - np.einsum("nmpc,nc->nmp", gain, w), w
