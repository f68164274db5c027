"""The ladder of inverse temperatures of parallel tempering, and how it is learnt.

Neighbouring rungs k and k+1 propose to swap, and are refused with probability r_k. The sum Λ of all r_k hardly
depends on where the rungs stand as long as they are many: it is the communication barrier between prior and
posterior. Replicas travel fastest where the r_k are all the same, with about 2Λ rungs.

Syed, Bouchard-Côté, Deligiannidis & Doucet (2022), "Non-reversible parallel tempering", JRSS B 84, 321-350.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fmu.samplers.loop.settings import vector
from fmu.types import FloatArray

FEWEST, MOST = 8, 64
"""Rungs that a learnt ladder has: few of them would do to travel, but leave evidences coarse."""
FIRST = 12
"""Rungs before anything is known."""
_POWER = 5.0
"""The first rungs lie at (k/K)⁵ (Friel & Pettitt 2008): posteriors are narrower than priors by orders."""
_SHORTEST = 20
_LEAST = 1e-3


def ladder(name: str, value: Any) -> tuple[float, ...]:
    """Return inverse temperatures in ascending order; ValueError unless they are distinct, from 0 to 1."""
    t = tuple(sorted(vector(name, value)))
    if len(t) < 2 or t[0] != 0.0 or t[-1] != 1.0 or len(set(t)) < len(t):
        raise ValueError(f"{name}: must be distinct inverse temperatures from 0 to 1, with both (got {value!r})")
    return t


def first_ladder(rungs: int | None) -> FloatArray:
    """Return the ladder to begin with."""
    return np.linspace(0.0, 1.0, rungs or FIRST) ** _POWER


def stages(steps: int) -> list[int]:
    """Return the lengths of the parts of a warm-up between which the ladder changes, each twice the one before."""
    lengths = []
    while steps >= 2 * _SHORTEST:
        lengths.append(steps - steps // 2)
        steps //= 2
    return [*([steps] if steps else []), *reversed(lengths)]


def rejections(log_likelihood: FloatArray, temperatures: FloatArray) -> FloatArray:
    """Return how often swaps between neighbouring rungs are refused, shape (..., rungs − 1).

    Parameters
    ----------
    log_likelihood : ndarray, shape (..., draws, rungs)
    temperatures : ndarray, shape (rungs,)
    """
    gain = np.diff(temperatures) * (log_likelihood[..., :-1] - log_likelihood[..., 1:])
    return np.mean(1.0 - np.exp(np.minimum(gain, 0.0)), axis=-2)


def adapted(temperatures: FloatArray, rejection: FloatArray, rungs: int | None) -> FloatArray:
    """Return the ladder on which all swaps are expected to be refused alike.

    The barrier from 0 to each rung is interpolated monotonely and cut into equal parts.

    Parameters
    ----------
    temperatures : ndarray, shape (rungs,)
    rejection : ndarray, shape (rungs − 1,)
    rungs : int, optional
        How many there shall be; from the barrier if not given, so that half of all swaps are expected to succeed.
    """
    from scipy.interpolate import PchipInterpolator

    barrier = np.concatenate([[0.0], np.cumsum(np.maximum(rejection, _LEAST))])
    if rungs is None:
        rungs = int(np.clip(np.ceil(2.0 * np.sum(rejection)) + 1, FEWEST, MOST))
    level = np.linspace(0.0, barrier[-1], rungs)
    t = PchipInterpolator(barrier, temperatures)(level)
    t[0], t[-1] = 0.0, 1.0
    return t if np.all(np.diff(t) > 0.0) else np.interp(level, barrier, temperatures)
