"""Draws of the posterior without a mode from a separate run, for modes with unreliable importance weights."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.effective import ess_bulk, ess_tail, rhat
from fmu.analysis.convergence.remedies import RHAT_LIMIT, required_ess
from fmu.analysis.maxima.search import find_map
from fmu.analysis.maxima.starts import choose_starts, components
from fmu.samplers.loop.run import Run
from fmu.samplers.mixture.mixture import MixtureSampler
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

_CHAINS, _WARMUP, _FIRST, _MOST = 4, 1000, 1000, 128_000
"""Number of chains, warm-up steps, steps before convergence is first judged, and largest number of steps."""


def draws_without(without: UpdatingProblem, seed: int) -> FloatArray | None:
    """Return draws of a posterior, (chains, n, ndim), SI units; None if they do not converge.

    They have converged if R-hat and the effective sample sizes of all parameters meet the limits of
    `fmu.diagnose`. Until then the number of draws is doubled, up to `_MOST` per chain.

    Parameters
    ----------
    without : UpdatingProblem
        The problem updated without the mode (`UpdatingProblem.using`).
    seed : int
    """
    maxima = find_map(without)
    sampler = MixtureSampler().starting_from(*components(without, maxima))
    starts = choose_starts(without, "maxima", maxima, _CHAINS, sampler.walkers, seed)
    run = Run(without, sampler, warmup=_WARMUP, chains=_CHAINS, seed=seed, init=starts.position)
    more = _FIRST
    while True:
        position = run.extend(more).posterior.position
        draws = position.reshape(_CHAINS, -1, without.ndim)
        if all(_is_converged(x) for x in np.moveaxis(draws, 2, 0)):
            return draws
        more = draws.shape[1]
        if 2 * more > _MOST:
            return None


def _is_converged(x: FloatArray) -> bool:
    return bool(rhat(x) < RHAT_LIMIT and min(ess_bulk(x), ess_tail(x)) >= required_ess(len(x)))
