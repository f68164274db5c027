"""What a run returns: its draws, their statistics and how they came about."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from fmu.types import FloatArray


@dataclass(frozen=True)
class Draws:
    """What was drawn in one phase.

    Attributes
    ----------
    position : ndarray, shape (chains, draws, ndim)
        theta, in the density's own coordinates. The draws of an ensemble are steps × walkers, step-major.
    stats : dict of str to ndarray, shape (chains, draws)
        ``lp``, ``accepted``, ``n_solves``, ``n_gradients`` and what the sampler adds. The sums of n_solves and
        n_gradients over warm-up and draws are exactly what the density was asked for: the cost of the start is
        booked on the first stored step.
    """

    position: FloatArray
    stats: dict[str, NDArray[Any]]


@dataclass(frozen=True)
class RunResult:
    """Draws of a run and its configuration.

    Attributes
    ----------
    warmup, posterior : Draws
    sampler : str
        Short name of the sampler.
    settings : dict
        Its settings, as JSON-able data.
    seed, chains, draws, warmup_draws, walkers : int
        `draws` and `warmup_draws` count steps; an ensemble stores `walkers` draws a step.
    groups : int
        How many groups the chains were divided into.
    init : str
        Where the chains started: "prior", "start", "maxima" or "array".
    wall_s, warmup_wall_s : float
        Seconds spent sampling, warm-up included, and in warm-up alone.
    learnt : dict
        The settings that warm-up arrived at and the draws were made with, {} where nothing was learnt. Of several
        groups of chains, a list of each context.
    """

    warmup: Draws
    posterior: Draws
    sampler: str
    settings: dict[str, Any]
    seed: int
    walkers: int
    draws: int
    warmup_draws: int
    chains: int
    init: str
    wall_s: float
    warmup_wall_s: float
    groups: int = 1
    learnt: dict[str, Any] = field(default_factory=dict)
