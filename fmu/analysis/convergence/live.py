"""How far a run has come while it goes on, cheap enough to be asked again and again."""

from __future__ import annotations

import numpy as np

from fmu.analysis.convergence import effective
from fmu.types import FloatArray

MOST_RANKED = 2000
"""Draws a chain that R-hat is made of."""
MOST_BATCHES = 2000
"""Batches a chain whose means the effective sample size is made of."""
MOST_STEPS = 20_000
"""Steps a chain that go into the batches."""


def live_diagnostics(draws: FloatArray, walkers: int = 1) -> dict[str, float]:
    """Return the worst R-hat and the worst bulk effective sample size among the parameters, so far.

    The rules are those of `fmu.summary`: rank-normalised split R-hat, over ensembles for an ensemble sampler; bulk
    ESS, for ensembles by the autocorrelation time of their steps. Up to 2000 draws a chain they are its numbers.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws, ndim) or (chains, steps, walkers, ndim)
        In the first, the draws of an ensemble are step-major.
    walkers : int
        Of an ensemble, in the first.

    Returns
    -------
    dict of str to float
        ``rhat`` and ``ess``. NaN where one parameter has none: R-hat of one chain, fewer than four draws, a
        parameter that has not moved yet, a draw that is not finite.

    Notes
    -----
    Of longer runs R-hat is that of every k-th draw, 2000 a chain, which moves it by less than it is known to. The
    ESS is that of the mean of all draws, from means of consecutive ones: batching changes no variance of the mean,
    as thinning would. With batch means b of the draws z, ESS = ESS(b) var(z)/var(b). Of more than 20 000 steps a
    chain every k-th is taken, so that the ESS of draws that hardly depend on each other is a lower bound, of about
    20 000 a chain.
    """
    if draws.ndim == 4:
        draws, walkers = draws.reshape(len(draws), -1, draws.shape[3]), draws.shape[2]
    parameters = [np.ascontiguousarray(x) for x in np.moveaxis(draws, -1, 0)]
    return {
        "rhat": float(np.max([_rhat(x, walkers) for x in parameters])),
        "ess": float(np.min([_ess(x, walkers) for x in parameters])),
    }


def _rhat(x: FloatArray, walkers: int) -> float:
    if not np.all(np.isfinite(x)):  # also of the draws that are left out
        return np.nan
    return effective.rhat(x[:, :: effective.apart(x.shape[1], MOST_RANKED, walkers)])


def _ess(x: FloatArray, walkers: int) -> float:
    """Return the bulk ESS of one parameter, draws (chains, steps · walkers)."""
    steps = x.shape[1] // walkers
    if steps <= MOST_BATCHES or not np.all(np.isfinite(x)) or np.ptp(x) == 0:
        return effective.ess_bulk(x, walkers)
    paths = x.reshape(len(x), steps, walkers)[:, :: -(-steps // MOST_STEPS)]
    if walkers == 1:
        paths = _rank_normalised(paths)
    steps = paths.shape[1]
    k = -(-steps // MOST_BATCHES)
    paths = paths[:, steps % k :]  # the first few steps, rather than the latest
    batches = paths.reshape(len(x), -1, k, walkers).mean(axis=2)
    # about the mean of each ensemble, as its autocorrelation is
    axes = (1, 2) if walkers > 1 else (0, 1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):  # of an ensemble that stands still it is NaN
        ratio = np.var(paths, axis=axes) / np.var(batches, axis=axes)
    flat = batches.reshape(len(x), -1)
    if walkers == 1:
        return float(min(effective.ess_mean(flat) * ratio, paths.size * np.log10(paths.size)))
    each = flat.shape[1] / effective.autocorrelation_times(flat, walkers) * ratio
    return float(np.sum(np.minimum(each, paths[0].size * np.log10(paths[0].size))))


def _rank_normalised(x: FloatArray) -> FloatArray:
    """Return the normal scores (Blom) of draws among every k-th of them, of the shape of `x`."""
    from scipy.special import ndtri

    among = np.sort(x[:, :: -(-x.shape[1] // MOST_RANKED)], axis=None)
    # twice the number of draws below, ties counted half
    place = np.searchsorted(among, x, "left") + np.searchsorted(among, x, "right")
    scores = ndtri((0.5 * np.arange(2 * len(among) + 1) + 0.125) / (len(among) + 0.25))
    return np.asarray(scores[place])
