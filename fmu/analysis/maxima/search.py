"""The deterministic updating that engineers already do, from many starts: every maximum, with its curvature."""

from __future__ import annotations

from collections.abc import Hashable
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from fmu.analysis.maxima.curvature import hessian_at
from fmu.analysis.maxima.mode_weights import LocalQuadratic, ModeWeight, mode_weights
from fmu.analysis.maxima.results import Maxima, PosteriorMaximum
from fmu.posterior.scaled import ScaledDensity
from fmu.progress.phases import phase
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.maxima.local_maxima import Maximum
    from fmu.posterior.problem import UpdatingProblem


STARTS = 256
"""A climb takes about a millisecond, and of a maximum that was not found nothing can warn."""
STARTS_WITHOUT_DERIVATIVES = 16
"""A climb takes some hundred calls of the user's function, which may be a finite-element program."""
_WEIGHING = 1
_KNOWN: WeakKeyDictionary[Any, dict[tuple[int, int], Maxima]] = WeakKeyDictionary()


def default_starts(problem: UpdatingProblem) -> int:
    """Return from how many starts to climb: fewer where a gradient is made of differences of solves."""
    if problem.solves_per_gradient > 1:
        return STARTS_WITHOUT_DERIVATIVES
    return STARTS


def is_searchable(problem: Any) -> bool:
    """Say whether `find_map` takes it: an updating problem, or what looks like one."""
    return hasattr(problem, "parameters") and hasattr(problem, "likelihood")


def find_map(problem: UpdatingProblem, starts: int | None = None, seed: int = 1) -> Maxima:
    """Find the maxima of the posterior within the bounds, with the curvature and the mass of each.

    This is the updating that ends in one parameter vector, and the check that no sampler can do by itself: whether
    there are other places where the posterior is, and how much of it. The result is remembered with the problem:
    a second search from as many starts with the same seed costs nothing.

    Parameters
    ----------
    problem : UpdatingProblem
    starts : int, optional
        Climbs, see `fmu.posterior.maxima.local_maxima.local_maxima`. Fewer are faster and may miss a maximum. 256,
        or 16 where the model has no derivatives of its own.
    seed : int
        Chooses the starts, and the draws that weigh the maxima.

    Returns
    -------
    Maxima
        The highest first. The Hessians are differences of the exact gradient where that is smooth
        (`fmu.analysis.maxima.curvature`). The masses are integrals over the box by importance sampling around each
        maximum (`mode_weights`), so that active bounds and what a Hessian leaves out count.

    Raises
    ------
    ValueError
        If `starts` is not positive, or `problem` is no updating problem.
    """
    if not is_searchable(problem):
        raise ValueError(f"problem: must be an UpdatingProblem (got {type(problem).__name__})")
    starts = default_starts(problem) if starts is None else starts
    known = _KNOWN.setdefault(problem, {}) if isinstance(problem, Hashable) else {}
    if (starts, seed) not in known:
        known[starts, seed] = _searched(problem, starts, seed)
    return known[starts, seed]


def _searched(problem: UpdatingProblem, starts: int, seed: int) -> Maxima:
    from fmu.posterior.maxima.local_maxima import local_maxima

    found = local_maxima(problem, starts, seed)
    theta = np.array([maximum.theta for maximum in found])
    scaled = ScaledDensity(problem)
    gradient = np.asarray(problem.log_prob_and_grad(theta)[1]) * problem.scale
    with phase("curvature", len(theta)) as under_way:
        curved = []
        for x in theta:
            curved.append(hessian_at(problem, x))
            under_way.advance()
    hessians, curvatures = zip(*curved, strict=True)
    models = [
        LocalQuadratic(scaled.to_scaled(m.theta), m.log_prob, g, H)
        for m, g, H in zip(found, gradient, hessians, strict=True)
    ]
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_WEIGHING,)))
    weighed = mode_weights(scaled.log_prob, models, scaled.lower, scaled.upper, rng)
    frequencies = problem.frequencies(theta)
    total = float(np.logaddexp.reduce([mass.log_mass for mass in weighed]))
    return Maxima(
        maxima=tuple(
            _in_si(problem, total, *parts)
            for parts in zip(found, models, curvatures, weighed, frequencies, strict=True)
        ),
        names=problem.names,
        units=problem.units,
        labels=tuple(problem.data.labels),
        lower=problem.lower,
        upper=problem.upper,
        start=problem.start,
        measured=np.asarray(problem.data.frequencies_hz, dtype=float),
        before=problem.frequencies(problem.start),
    )


def _in_si(
    problem: UpdatingProblem,
    total: float,
    found: Maximum,
    model: LocalQuadratic,
    curvature: str,
    mass: ModeWeight,
    frequencies: FloatArray,
) -> PosteriorMaximum:
    """Return one maximum, back from scaled coordinates."""
    scale = problem.scale
    at_bound = np.where(model.gradient > 0, found.theta >= problem.upper, 0) - np.where(
        model.gradient < 0, found.theta <= problem.lower, 0
    )
    return PosteriorMaximum(
        theta=found.theta,
        log_prob=found.log_prob,
        frequencies=frequencies,
        starts=found.starts,
        at_bound=at_bound.astype(np.int64),
        gradient=model.gradient / scale,
        hessian=model.hessian / np.outer(scale, scale),
        curvature=curvature,
        mean=problem.offset + scale * mass.mean,
        sd=scale * np.sqrt(np.diag(mass.covariance)),
        log_mass=mass.log_mass + float(np.sum(np.log(scale))),
        effective_draws=mass.effective,
        share=float(np.exp(mass.log_mass - total)),
    )
