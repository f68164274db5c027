"""Starting points of the chains, and checks on them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fmu.numbers import typed
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray

BALL = 0.02
"""Standard deviation, in scaled units, of an ensemble's walkers around a common starting point."""


def starting_points(
    scaled: ScaledDensity, init: str | ArrayLike, generators: list[np.random.Generator], chains: int, walkers: int
) -> list[FloatArray]:
    """Return the starting points of each group, in scaled units.

    Parameters
    ----------
    scaled : ScaledDensity
    init : "prior", "start" or array_like
        "prior": draws from ``density.sample_prior``. "start": ``density.start`` for every chain; the walkers of an
        ensemble are spread around this point with standard deviation `BALL`, because they must span the space. An
        array contains the starting points theta, shape (chains, ndim), or (chains, walkers, ndim) for ensembles.
    generators : list of Generator
        One generator per group; the chains are divided equally among the groups.
    chains, walkers : int
        `walkers` is 1 for samplers with ordinary chains.

    Returns
    -------
    list of ndarray, shape (chains of the group, ndim) or (chains of the group, walkers, ndim)

    Raises
    ------
    ValueError
        If `init` is none of these or has the wrong shape, the density lacks ``sample_prior`` or ``start``, or a
        starting point is not finite or is outside the bounds.
    """
    shape = (chains, scaled.ndim) if walkers == 1 else (chains, walkers, scaled.ndim)
    word = init if isinstance(init, str) else None
    density: Any = scaled.density
    needed = {"prior": "sample_prior", "start": "start", None: "ndim"}.get(word)
    if needed is None:
        raise ValueError(f"init: must be 'prior', 'start' or an array of shape {shape} (got {init!r})")
    if not hasattr(density, needed):
        raise ValueError(f"init: {init!r} needs a density with {needed!r} (got one without)")
    if word == "prior":
        each = chains // len(generators) * walkers
        theta = np.concatenate([np.asarray(density.sample_prior(rng, each), dtype=float) for rng in generators])
        theta = theta.reshape(shape)
    elif word == "start":
        theta = np.broadcast_to(np.asarray(density.start, dtype=float), shape)
    else:
        theta = np.asarray(init, dtype=float)
    if theta.shape != shape:
        raise ValueError(f"init: must have shape {shape} (got {theta.shape})")
    check_inside(scaled, theta)
    start = np.split(scaled.to_scaled(theta), len(generators))
    if word == "start" and walkers > 1:
        start = [_ball(scaled, rng, u) for rng, u in zip(generators, start, strict=True)]
    return [np.clip(u, scaled.lower, scaled.upper) for u in start]


def check_inside(scaled: ScaledDensity, theta: FloatArray) -> None:
    """Raise ValueError, naming the first case, if a starting point is not finite or is outside the bounds."""
    inside = (theta >= scaled.theta_lower) & (theta <= scaled.theta_upper) & np.isfinite(theta)
    if not inside.all():
        *where, i = (int(k) for k in np.argwhere(~inside)[0])
        raise ValueError(
            f"init: {_label(where)} must start within [{typed(scaled.theta_lower[i])}, "
            f"{typed(scaled.theta_upper[i])}] in coordinate {i} (got {typed(theta[(*where, i)])})"
        )


def check_finite(scaled: ScaledDensity, position: FloatArray, log_prob: FloatArray, first_chain: int) -> None:
    """Raise ValueError, naming the first case, if the log-density is not finite at a starting point.

    `position` contains the scaled starting points of the chains from `first_chain` onwards.
    """
    bad = np.argwhere(~np.isfinite(log_prob))
    if len(bad):
        chain, *rest = (int(k) for k in bad[0])
        theta = scaled.to_theta(position[(chain, *rest)])
        raise ValueError(
            f"init: {_label([first_chain + chain, *rest])} must start where the log-density is finite "
            f"(got theta = {theta.tolist()})"
        )


def _label(where: list[int]) -> str:
    return " ".join(f"{kind} {k}" for kind, k in zip(("chain", "walker"), where, strict=False))


def _ball(scaled: ScaledDensity, rng: np.random.Generator, u: FloatArray) -> FloatArray:
    """Return walkers scattered around their starting points `u` and reflected at the bounds, same shape as `u`."""
    spread = u + BALL * rng.standard_normal(u.shape)
    spread = np.where(spread < scaled.lower, 2 * scaled.lower - spread, spread)
    return np.where(spread > scaled.upper, 2 * scaled.upper - spread, spread)
