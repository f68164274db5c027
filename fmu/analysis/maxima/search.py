"""Search for all posterior maxima from many starting points, and compute the curvature and mass of each."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, cast
from weakref import WeakKeyDictionary

import numpy as np
from annotated_types import Interval

from fmu.analysis.maxima.kinds import SINGULARITY, active_bounds, basin, kind_of, slope, without_singularity
from fmu.analysis.maxima.mode_weights import DRAWS, IMPROBABLE, TEMPERATURES, ModeWeight, mode_weights
from fmu.analysis.maxima.plain import PlainDensity
from fmu.analysis.maxima.results import Maxima, PosteriorMaximum
from fmu.analysis.trace.densities import is_updating
from fmu.arguments import Seed, check_arguments
from fmu.differences import both_sides
from fmu.fem.black_box import solves_of_a_surrogate
from fmu.fem.pairing.paired_structure import structure_of
from fmu.fem.programs.solves import SLOW_S
from fmu.posterior.scaled import ScaledDensity, clip_to_support
from fmu.progress.phases import gradients, phase, solves
from fmu.samplers.mixture.quadratic import Quadratic, definite
from fmu.types import BoolArray, FloatArray, LogDensity

if TYPE_CHECKING:
    from fmu.posterior.maxima import Maximum
    from fmu.posterior.problem import UpdatingProblem


STARTS = 256
"""Default number of starting points.

Each costs about a millisecond, and nothing can warn of a maximum that was not found."""
STARTS_WITHOUT_DERIVATIVES = 16
"""Number of starting points without derivatives.

Each costs some hundred calls of the user's function, which may be a finite-element program."""
STARTS_IF_SLOW = 64
"""Number of starting points for a large model that is not reduced, or is reduced to at least `_MANY` unknowns.

Each costs about a hundred solves."""
_MANY = 128
STARTS_OF_PLAIN, MOST_EVALUATIONS = 64, 20_000
"""Number of starting points for a plain log-density with gradients, and of evaluations that end the search."""
SCATTERED = 16
"""Number of points per starting point at which a plain log-density is evaluated, to see how dense they are."""
_FEW = 20
"""Largest number of parameters with which the curvature even of improbable maxima comes from differences."""
_MOST_PLACES = 8
"""Largest number of maxima of a plain log-density whose curvature and mass are computed."""
_WEIGHING, _OF_SEARCH, _FEWEST_DRAWS = 1, 0.5, 8
_KNOWN: WeakKeyDictionary[LogDensity, dict[tuple[int, int, float], Maxima]] = WeakKeyDictionary()


def default_starts(problem: UpdatingProblem) -> int:
    """Return the default number of starting points.

    There are fewer if gradients are finite differences, or if a solve takes milliseconds because a large model is
    not reduced, or is reduced to many unknowns.
    """
    if problem.solves_per_gradient > 1:
        return STARTS_WITHOUT_DERIVATIVES
    return STARTS_IF_SLOW if _is_slow(problem) else STARTS


def _is_slow(problem: UpdatingProblem) -> bool:
    """Return True if a large model is not reduced, or is reduced to many unknowns."""
    structure = structure_of(problem.model)
    return structure is not None and (bool(structure.why_full) or max(problem.model.sizes, default=0) >= _MANY)


def is_searchable(problem: LogDensity) -> bool:
    """Return True if `find_map` can search the density.

    It cannot search a hierarchical posterior, whose maximum is far from its probability mass.
    """
    return not getattr(problem, "is_hierarchical", False)


@check_arguments
def find_map(
    problem: LogDensity, starts: Annotated[int, Interval(ge=1, le=1_000_000)] | None = None, seed: Seed = 1
) -> Maxima:
    """Find the maxima of the posterior within the bounds, with the curvature and mass of each.

    This is updating to a single parameter vector. It also answers two questions that no sampler can answer by
    itself: whether the posterior has other maxima, and how much probability they hold. The result is cached with
    an updating problem, so a second search with the same number of starting points and the same seed costs
    nothing.

    If the model is a function without derivatives that takes 0.05 s or longer, the search takes about as many
    solves as building a surrogate, unless `starts` is given. If it ends at this limit, `Maxima.doubts` says after
    how many starting points.

    For any other log-density, the starting points are drawn from its prior (``sample_prior``), or within its
    bounds. A density with neither is searched around its starting point, which excludes no other maxima;
    `Maxima.doubts` and the verdict on a run state this. A maximum that attracts fewer than one in `starts`
    starting points may be missed. Unless `starts` is given, no ascent begins after 20 000 evaluations, or after
    sixteen ascents if these have found more than eight maxima.

    Parameters
    ----------
    problem : LogDensity
    starts : int, optional
        Number of starting points for the optimiser; see `fmu.posterior.maxima.local_maxima`. Fewer are faster but
        may miss a maximum. The default is 256. It is 16 without derivatives, and 64 for a plain log-density and
        for a large model that is not reduced, or is reduced to 128 or more unknowns.
    seed : int
        Seed of the starting points and of the importance sampling.

    Returns
    -------
    Maxima
        The maxima, the highest first; for a plain log-density, only the eight highest. The Hessians are
        differences of the gradient. For errors of modes or FRFs, they are Gauss–Newton matrices if the gradient is
        not smooth (`hessian_at`), if the number of solves is limited and, with more than 20 parameters, at maxima
        with less than e⁻²⁵ of the largest mass. The masses are integrals within the bounds by importance sampling
        around each maximum (`mode_weights`), so they account for active bounds and non-Gaussian shapes.

    Raises
    ------
    ValueError
        If `starts` is not between 1 and 1 000 000, `problem` is no log-density or has a population, or the
        log-density is finite at none of the starting points.
    """
    if not is_searchable(problem):
        raise ValueError("problem: must have no population: its maximum is far from its mass; sample it instead")
    if not is_updating(problem):
        return _search_plain(PlainDensity(problem), starts, seed)
    most = _most_solves(problem) if starts is None else np.inf
    starts = default_starts(problem) if starts is None else starts
    known = _KNOWN.setdefault(problem, {}) if isinstance(problem, Hashable) else {}
    if (starts, seed, most) not in known:
        known[starts, seed, most] = _search(problem, starts, seed, most)
    return known[starts, seed, most]


def _search(problem: UpdatingProblem, starts: int, seed: int, most: float) -> Maxima:
    """Return the maxima of an updating problem, found with a limit of about `most` solves.

    If the limit ended the search, `Maxima.doubts` says so.
    """
    from fmu.posterior.maxima import local_maxima

    solved, differentiated = solves(), gradients()
    found = local_maxima(problem, starts, seed, most_solves=_OF_SEARCH * most)
    draws = DRAWS // 4 if _is_slow(problem) else DRAWS
    best = _weigh(problem, found, seed, solved, differentiated, most, draws)
    climbed = sum(m.starts for m in found)
    if climbed == starts or np.isinf(most):
        return best
    doubt = (
        f"a solve takes long, so that the search ended after {climbed} of {starts} starts: let fmu.surrogate "
        f"stand for the model, or search further, maxima=fmu.find_map(problem, starts={starts})"
    )
    return replace(best, doubts=(doubt,))


def _most_solves(problem: UpdatingProblem) -> float:
    """Return the default limit on solves: the cost of a surrogate for a slow function, otherwise infinity."""
    if problem.solves_per_gradient == 1:
        return np.inf
    seconds = problem.model.seconds_at(problem.model_parameters(problem.start[None])[0])
    is_slow = seconds is not None and seconds >= SLOW_S
    return solves_of_a_surrogate(problem.n_structural) if is_slow else np.inf


def _search_plain(density: PlainDensity, starts: int | None, seed: int) -> Maxima:
    """Return the maxima of a plain log-density, with the reasons why there may be others (`Maxima.doubts`).

    Only the highest eight are returned. Raise ValueError if the density is finite at no starting point.
    """
    from fmu.posterior.maxima import maxima_from

    most = MOST_EVALUATIONS if starts is None else np.inf
    if starts is None:
        starts = STARTS_WITHOUT_DERIVATIVES if density.solves_per_gradient > 1 else STARTS_OF_PLAIN
    solved, differentiated = solves(), gradients()
    scaled = ScaledDensity(density)
    theta = density.starting_points(SCATTERED * starts, seed)
    level = float(np.sort(density.log_prob(theta))[-min(3, len(theta))])
    points = scaled.to_scaled(theta[:starts])
    begun = solves()
    with phase("search", len(points)):
        found = maxima_from(cast("UpdatingProblem", density), scaled, points, most)
    is_spent = solves() - begun >= most
    if not found:
        raise ValueError(
            f"problem: the log-density must be finite somewhere; it is so at none of {starts} points "
            f"{density.region}"
        )
    best = _weigh(density, found[:_MOST_PLACES], seed, solved, differentiated, draws=DRAWS // 4)
    said, doubts = density.search_in_words(found), density.doubts(best, found, is_spent)
    return replace(best, search=said, doubts=doubts, level=level)


def _weigh(
    problem: Any,
    found: Sequence[Maximum],
    seed: int,
    solved: int,
    differentiated: int,
    most: float = np.inf,
    draws: int = DRAWS,
) -> Maxima:
    """Return all maxima found with their curvatures and masses.

    A mass takes `draws` draws from each of the two Gaussians around its maximum, or none if it is less than e⁻²⁵
    of the largest one (`mode_weights`). `solved` and `differentiated` are the numbers of solves and gradients
    before the search. If the solves are limited to `most`, the curvature for errors of modes or FRFs is the
    Gauss–Newton matrix, and each Gaussian gets only as many draws as the remaining solves allow, but at least
    eight.
    """
    theta = np.array([maximum.theta for maximum in found])
    scaled = ScaledDensity(problem)
    is_rough = np.isfinite(most) | _are_improbable(problem, theta)
    with phase("curvature", len(found)) as under_way:
        curved = []
        for m, rough in zip(found, is_rough, strict=True):
            curved.append(quadratic_at(problem, scaled, m, is_rough=bool(rough)))
            under_way.advance()
    models, curvatures = zip(*curved, strict=True)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_WEIGHING,)))
    if np.isfinite(most):
        left = int(most - solves() + solved) // (len(TEMPERATURES) * len(models))
        draws = max(_FEWEST_DRAWS, min(left, draws))
    kinds = [kind_of(problem, scaled, model) for model in models]
    models = tuple(
        without_singularity(scaled, model) if kind == SINGULARITY else model
        for kind, model in zip(kinds, models, strict=True)
    )
    basins = [basin(model, kind, active_bounds(scaled, model)) for model, kind in zip(models, kinds, strict=True)]
    are_divided = any(basin is not model for basin, model in zip(basins, models, strict=True))
    weighed = mode_weights(scaled.log_prob, models, scaled.lower, scaled.upper, rng, draws, basins)
    frequencies = problem.frequencies(theta)
    total = float(np.logaddexp.reduce([mass.log_mass for mass in weighed]))
    reached = float(np.logaddexp.reduce([mass.log_reach for mass in weighed]))
    return Maxima(
        maxima=tuple(
            replace(
                _in_si(problem, scaled, total, *parts),
                kind=kind,
                slope=slope(scaled, parts[1]),
                weight=float(np.exp(parts[3].log_reach - reached)) if are_divided else np.nan,
            )
            for kind, *parts in zip(kinds, found, models, curvatures, weighed, frequencies, strict=True)
        ),
        names=problem.names,
        units=problem.units,
        labels=tuple(problem.data.labels),
        lower=problem.lower,
        upper=problem.upper,
        start=problem.start,
        measured=np.asarray(problem.data.frequencies_hz, dtype=float),
        before=problem.frequencies(problem.start),
        n_solves=solves() - solved,
        n_gradients=gradients() - differentiated,
    )


def _are_improbable(problem: UpdatingProblem, theta: FloatArray) -> BoolArray:
    """Return a mask (n,) of the maxima `theta` (n, ndim) with less than e⁻²⁵ of the largest mass.

    The masses are Laplace approximations by Gauss–Newton matrices, which exist only for errors of modes or FRFs.
    With at most 20 parameters the mask is False throughout, as exact curvatures cost little.
    """
    if len(theta) == 1 or problem.ndim <= _FEW or not problem.likelihood.of_modes:
        return np.zeros(len(theta), dtype=bool)
    value, hessian = _gauss_newton(problem, theta)
    log_mass = -value - 0.5 * np.linalg.slogdet([definite(one) for one in hessian])[1]
    return np.asarray(log_mass < log_mass.max() - IMPROBABLE)


def quadratic_at(
    problem: UpdatingProblem, scaled: ScaledDensity, maximum: Maximum, *, is_rough: bool = False
) -> tuple[Quadratic, str]:
    """Return the second-order expansion of log P at a maximum, in scaled coordinates, and its Hessian's source.

    The source is ``"differences"`` or ``"Gauss-Newton"``; see `hessian_at`. Where the gradient is not finite, it
    is taken to be 0.
    """
    gradient = np.asarray(problem.log_prob_and_grad(maximum.theta)[1]) * problem.scale
    gradient = np.where(np.isfinite(gradient), gradient, 0.0)  # at an edge
    hessian, source = hessian_at(problem, maximum.theta, is_rough=is_rough)
    return Quadratic(scaled.to_scaled(maximum.theta), maximum.log_prob, gradient, hessian), source


def _in_si(
    problem: UpdatingProblem,
    scaled: ScaledDensity,
    total: float,
    found: Maximum,
    model: Quadratic,
    curvature: str,
    mass: ModeWeight,
    frequencies: FloatArray,
) -> PosteriorMaximum:
    """Convert one maximum from scaled coordinates to SI units."""
    scale = problem.scale
    return PosteriorMaximum(
        theta=found.theta,
        log_prob=found.log_prob,
        frequencies=frequencies,
        starts=found.starts,
        at_bound=active_bounds(scaled, model).astype(np.int64),
        gradient=model.gradient / scale,
        hessian=model.hessian / np.outer(scale, scale),
        curvature=curvature,
        mean=problem.offset + scale * mass.mean,
        sd=scale * np.sqrt(np.diag(mass.covariance)),
        log_mass=mass.log_mass + float(np.sum(np.log(scale))),
        effective_draws=mass.effective,
        evidence_covariance=mass.evidence_covariance,
        share=float(np.exp(mass.log_mass - total)),
    )


DIFFERENCES, GAUSS_NEWTON = "differences", "Gauss-Newton"
_FIRST_STEP = 1e-4
_OF_THE_WIDTH = 0.05
_SMOOTH = 0.3


def hessian_at(problem: UpdatingProblem, theta: FloatArray, *, is_rough: bool = False) -> tuple[FloatArray, str]:
    """Return −∇² log P at a maximum, in the coordinates (θ − offset)/scale, and how it was computed.

    The Hessian is computed from differences of the gradient, one-sided at the bounds. The step is a
    twentieth of the width that a first attempt finds. Negative eigenvalues are set to zero.

    For errors of modes or FRFs, the Gauss–Newton matrix replaces it in two cases: if differences with half the
    step disagree, because the gradient jumps where modes swap, or if the Hessian is not positive definite over the
    parameters that are not at a bound. This matrix is JᵀJ of the residuals plus the curvature of the prior. It may
    be ten times too small if residuals are several standard deviations.

    Parameters
    ----------
    problem : UpdatingProblem
    theta : ndarray, shape (ndim,)
    is_rough : bool
        Whether the Gauss–Newton matrix, which takes one gradient, suffices for errors of modes or FRFs.

    Returns
    -------
    hessian : ndarray, shape (ndim, ndim)
    source : {"differences", "Gauss-Newton"}
    """
    if is_rough and problem.likelihood.of_modes:
        return _gauss_newton(problem, theta[None])[1][0], GAUSS_NEWTON
    rough = np.diag(_differences(problem, theta, np.full(problem.ndim, _FIRST_STEP)))
    step = np.clip(_OF_THE_WIDTH / np.sqrt(np.maximum(rough, 1.0)), 1e-6, 1e-2)
    hessian = _differences(problem, theta, step)
    if problem.likelihood.of_modes:
        other = np.diag(_differences(problem, theta, 0.5 * step))
        size = np.maximum(np.abs(np.diag(hessian)), np.abs(other))
        free = (theta > problem.lower) & (theta < problem.upper)
        is_smooth = np.all(np.abs(np.diag(hessian) - other) <= _SMOOTH * np.maximum(size, 1.0))
        if not is_smooth or np.any(np.linalg.eigvalsh(hessian[np.ix_(free, free)]) <= 0):
            return _gauss_newton(problem, theta[None])[1][0], GAUSS_NEWTON
    values, vectors = np.linalg.eigh(hessian)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T, DIFFERENCES


def _gauss_newton(problem: UpdatingProblem, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return −log P (n,) and its Gauss–Newton Hessian (n, ndim, ndim) in scaled coordinates at theta (n, ndim)."""
    from fmu.posterior.ascent import GaussNewton

    scaled = clip_to_support(ScaledDensity(problem), problem)  # a scatter of 0 has no density
    value, _, hessian = GaussNewton(problem, scaled)(scaled.to_scaled(theta))
    return value, hessian


def _differences(problem: UpdatingProblem, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return −∇² log P (ndim, ndim), symmetrised, from differences of the gradient over ± `step` (ndim,).

    The result and `step` are in scaled coordinates, `theta` (ndim,) is in SI units. Entries that are not finite
    are set to 0.
    """
    lower, upper = problem.lower, problem.upper
    if problem.parameters:  # at a bound where the prior vanishes there is no gradient: go only halfway
        vanishing = [(p.lowest > p.lower, p.highest < p.upper) for p in problem.parameters]
        vanish_below, vanish_above = np.array(vanishing).T
        lower = np.where(vanish_below, 0.5 * (lower + theta), lower)
        upper = np.where(vanish_above, 0.5 * (upper + theta), upper)
    ends, distance = both_sides(theta[None], step * problem.scale, lower, upper)
    slopes = [problem.log_prob_and_grad(points[0])[1] * problem.scale for points in ends]
    with np.errstate(invalid="ignore"):  # there is no gradient beyond an edge: no curvature is assumed
        hessian = (slopes[1] - slopes[0]) / (distance[0] / problem.scale)[:, None]
    hessian = np.where(np.isfinite(hessian), hessian, 0.0)
    return 0.5 * (hessian + hessian.T)
