"""Choose overdispersed starting points around the maxima, in proportion to their posterior probabilities."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from fmu.analysis.maxima.funnel import components_along
from fmu.analysis.maxima.missed import NEARBY, OUT_OF_PROPORTION
from fmu.analysis.maxima.plain import PlainDensity
from fmu.analysis.maxima.results import NEGLIGIBLE, TYPICAL_POINT
from fmu.analysis.maxima.search import find_map, is_searchable
from fmu.analysis.trace.conversion import START_STREAM, generator
from fmu.analysis.trace.densities import has_prior, is_updating
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.samplers.mixture.warp import Warp
from fmu.samplers.settings import whole_number
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    from fmu.analysis.maxima.results import Maxima, PosteriorMaximum
    from fmu.posterior.problem import UpdatingProblem
    from fmu.types import LogDensity


DISPERSION = 2.0
"""Ratio of the standard deviation of the starting points around a maximum to that of the posterior there.

Overdispersed chains must contract to the posterior before they agree, so that R-hat reveals chains that have not
(Gelman & Rubin 1992, Statistical Science 7, 457-472, section 2.1). Twice the width is also used by the importance
sampling, and is far less than the distance to another maximum. Overdispersion cannot reveal a maximum that
the search did not find; nor can starting points from the prior, unless one of them falls into its basin."""
_HALVINGS = 30
_SCATTERED = 16
_MAY_MATTER, _MOST_COMPONENTS = 1e-6, 8
_IN_A_NECK = 10.0
"""ESS below which a maximum's quadratic model is useless; it is estimated from hundreds of draws around it."""
_FIT_BADLY = 64.0
"""Effective draws below which a model with a discrepancy gets components for many sizes of the discrepancy."""


class Starts(NamedTuple):
    """The starting points of chains.

    Attributes
    ----------
    position : str or ndarray, shape (chains, ndim) or (chains, walkers, ndim)
        Argument `init` of `fmu.samplers.Run`: a word, or positions in SI units.
    word : {"maxima", "prior", "start", "array"}
        How the starting points were chosen.
    origin : str, ndarray or dict
        Description of the starting points in the run's configuration.
    """

    position: str | FloatArray
    word: str
    origin: object


def choose_starts(
    density: LogDensity, init: str | ArrayLike, maxima: Maxima | None, chains: int, walkers: int, seed: int
) -> Starts:
    """Return the starting points of the chains.

    Parameters
    ----------
    density : LogDensity
    init : "maxima", "prior", "start" or array_like
        For a hierarchical posterior, "maxima" means its typical point. For another density without `maxima`, or
        one that is infinite at a bound, which chains hardly leave, it means the prior. If there is no prior, or
        the density is not finite at some of its draws, it means scattered points.
    maxima : Maxima or None
    chains, walkers, seed : int
        See `starts_at_maxima`.

    Raises
    ------
    ValueError
        If scattered points are needed, and the density is finite at none of them.
    """
    if not isinstance(init, str):
        positions = np.asarray(init, dtype=float)
        return Starts(positions, "array", positions)
    if init != "maxima":
        return Starts(init, init, init)
    if maxima is not None and not maxima.are_singular:
        theta, origin = starts_at_maxima(density, maxima, chains, walkers, seed), {"maxima": maxima.hash}
        return Starts(theta, "maxima", origin)
    if is_searchable(density):
        plain = PlainDensity(density)
        if plain.has_prior and _is_finite_in_prior(plain, seed):
            return Starts("prior", "prior", "prior")
        theta, origin = _scatter_starts(plain, chains * walkers, seed), {"maxima": "scattered"}
    else:
        from fmu.posterior.joint.conditional.both import scatter_about_typical

        rng = generator(seed, START_STREAM)
        problem, origin = cast("UpdatingProblem", density), TYPICAL_POINT
        theta = scatter_about_typical(problem, rng, chains * walkers, DISPERSION)
    return Starts(theta if walkers == 1 else theta.reshape(chains, walkers, -1), "maxima", origin)


def _is_finite_in_prior(density: PlainDensity, seed: int) -> bool:
    """Return True if a log-density is finite at its starting point and at each of several prior draws."""
    return bool(np.all(np.isfinite(density.log_prob(density.starting_points(_SCATTERED, seed)))))


def _scatter_starts(density: PlainDensity, n: int, seed: int) -> FloatArray:
    """Return `n` points (n, ndim) at which a log-density is finite.

    They are chosen from a larger number of points, drawn from the prior, within the bounds, or widely around the
    starting point. If too few of these are finite, points are repeated. Raise ValueError if no point is finite.
    """
    theta = density.starting_points(_SCATTERED * n, seed)
    theta = theta[np.isfinite(density.log_prob(theta))]
    if not len(theta):
        raise ValueError(f"problem: the log-density must be finite somewhere {density.region} (got −inf or NaN)")
    return np.resize(theta, (n, density.ndim))


def worth_starting_from(density: LogDensity, maxima: Maxima) -> Maxima | None:
    """Return the maxima of a plain log-density if they are better starting points than its prior, otherwise None.

    They are better if there are several, as even an improbable one can catch chains, or if there is no prior. In
    both cases their masses must be reliable, which they are not in a funnel.
    """
    return maxima if maxima.are_weighed and (len(maxima) > 1 or not has_prior(density)) else None


def middle(problem: Any) -> Quadratic:
    """Return the quadratic model of log P at a hierarchical posterior's typical point, in scaled coordinates."""
    from fmu.posterior.joint.typical import curvature_at, typical_point

    position = typical_point(problem)
    hessian, scaled = curvature_at(problem, position), ScaledDensity(problem)
    log_prob = float(scaled.log_prob(position))
    return Quadratic(position, log_prob, np.zeros(len(position)), hessian)


def starts_at_maxima(density: LogDensity, maxima: Maxima, chains: int, walkers: int, seed: int) -> FloatArray:
    """Draw the starting points of all chains around the maxima, in proportion to their posterior probabilities.

    Around each maximum, points are drawn from the local Gaussian approximation, widened by `DISPERSION` and
    truncated at the bounds. The approximation may be poor that far out. So any point whose log-probability is not
    finite, or is below the contour that encloses nearly all of the widened Gaussian, is moved halfway to the
    maximum, up to `_HALVINGS` times. If the log-probability is still not finite, the point is then reflected
    through the maximum.

    Parameters
    ----------
    density : LogDensity
    maxima : Maxima
        The result of `fmu.find_map`.
    chains : int
        Number of chains, or of ensembles.
    walkers : int
        Number of walkers per ensemble; 1 for samplers with ordinary chains. The walkers of each ensemble are
        allocated to the maxima in proportion to the posterior probabilities.
    seed : int
        Seed of the run.

    Returns
    -------
    ndarray, shape (chains, ndim) or (chains, walkers, ndim)
        Starting points in SI units.
    """
    scaled, rng = ScaledDensity(density), generator(seed, START_STREAM)
    share = np.array([m.starting_share for m in maxima])
    home = allot_chains(share, chains) if walkers == 1 else np.tile(allot_chains(share, walkers), chains)
    u = np.empty((len(home), scaled.ndim))
    for k in np.unique(home):
        u[home == k] = _around(scale_maximum(maxima[int(k)], scaled), scaled, rng, int(np.sum(home == k)))
    theta: FloatArray = scaled.to_theta(u)
    return theta if walkers == 1 else theta.reshape(chains, walkers, -1)


def walkers(problem: UpdatingProblem, n: int, seed: int = 1) -> FloatArray:
    """Return starting points for the walkers of one ensemble, (n, ndim); see `fmu.UpdatingProblem.walkers`.

    Raise ValueError unless `n` is at least twice the number of parameters.
    """
    least = 2 * problem.ndim
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < least:
        raise ValueError(f"n: must be a whole number of at least {least}, twice the parameters (got {n!r})")
    maxima = find_map(problem) if is_searchable(problem) else None
    starts = choose_starts(problem, "maxima", maxima, 1, int(n), whole_number("seed", seed, 0))
    if starts.word == "prior":
        return problem.sample_prior(generator(seed, START_STREAM), int(n))
    return np.asarray(starts.position)[0]


def components(density: LogDensity, maxima: Maxima | None) -> tuple[list[Quadratic], FloatArray, Warp | None]:
    """Return quadratic models at the important maxima, in scaled coordinates, their mixture weights, and a warp.

    At most eight maxima are taken, with more than 1e-6 of the probability. Half of the total weight is divided in
    proportion to their posterior probabilities, the other half equally. A sampler then gets enough first
    candidates around each maximum to find its shape, and notices a probability that was estimated far too low.

    If `maxima` is None, the single component is at the typical point of a hierarchical posterior. If one
    discrepancy size is inferred and the quadratic models are therefore poor, the components lie along the funnel
    instead, and are Gaussians in the coordinates of the warp. In all other cases the warp is None.
    """
    if maxima is None:
        return [middle(density)], np.ones(1), None
    if is_updating(density) and density.likelihood.of_modes and density.likelihood.n_sizes == 1:
        matter = [m.effective_draws for m in maxima if m.share > NEGLIGIBLE]
        if min(matter, default=np.inf) < _FIT_BADLY:
            return components_along(density, maxima)
    scaled = ScaledDensity(density)
    chosen = sorted((m for m in maxima if m.starting_share > _MAY_MATTER), key=lambda m: -m.starting_share)
    chosen = chosen[:_MOST_COMPONENTS]
    share = np.array([m.starting_share for m in chosen])
    return [scale_maximum(m, scaled) for m in chosen], 0.5 * (share / share.sum() + 1.0 / len(chosen)), None


def are_in_funnel(problem: UpdatingProblem, maxima: Maxima) -> bool:
    """Return True if the posterior is a funnel with its maximum in the neck, which model discrepancy may cause.

    The more the parameters scatter, the wider their posterior. Its maximum is at little scatter, and hardly any
    draw around it has posterior weight. Return False without a discrepancy, or if several maxima matter.
    """
    if not problem.likelihood.has_discrepancy:
        return False
    matter = [m.effective_draws for m in maxima if m.share > NEGLIGIBLE]
    return len(matter) == 1 and matter[0] < _IN_A_NECK


def scale_maximum(maximum: PosteriorMaximum, scaled: ScaledDensity) -> Quadratic:
    """Return the second-order expansion of log P at a maximum, converted to scaled coordinates."""
    return Quadratic(
        scaled.to_scaled(maximum.theta),
        maximum.log_prob,
        maximum.gradient * scaled.scale,
        maximum.hessian * np.outer(scaled.scale, scaled.scale),
    )


def allot_chains(share: FloatArray, n: int) -> IntArray:
    """Return the index of the maximum at which each of `n` chains starts, shape (n,), in ascending order.

    Maxima with a probability below 1 %, or below a tenth of 1/n, get no chain: a chain that never leaves one of
    them would be out of proportion (`fmu.analysis.maxima.missed.compare_shares`). Every other maximum gets one
    chain, the most probable first if there are too few chains. The remaining chains are allotted by the method of
    Webster and Sainte-Laguë, whose whole numbers are closest to the probabilities. If all probabilities are too
    small, all chains start at the most probable maximum.

    Parameters
    ----------
    share : ndarray, shape (maxima,)
        Posterior probability of each maximum.
    n : int
    """
    least = max(NEGLIGIBLE, 1.0 / (OUT_OF_PROPORTION * n))
    order = np.argsort(-share, kind="stable")
    taking_part = order[: max(1, int(np.sum(share >= least)))][:n]
    count = np.zeros(len(share), dtype=np.int64)
    count[taking_part] = 1
    while count.sum() < n:
        count[taking_part[np.argmax((share / (2 * count + 1))[taking_part])]] += 1
    return np.repeat(np.arange(len(share)), count)


def _around(model: Quadratic, scaled: ScaledDensity, rng: np.random.Generator, n: int) -> FloatArray:
    """Return `n` starting points around one maximum in scaled coordinates, (n, ndim), as in `starts_at_maxima`."""
    temperature = DISPERSION**2
    u = model.proposal(scaled.lower, scaled.upper, temperature).draw(rng, n)
    rim = model.log_prob - temperature * float(gammaincinv(0.5 * scaled.ndim, NEARBY))
    for _ in range(_HALVINGS):
        log_prob = np.asarray(scaled.log_prob(u))
        too_low = ~(log_prob >= rim)  # NaN counts as too low
        if not too_low.any():
            break
        u[too_low] = 0.5 * (u[too_low] + model.position)
    else:  # at an edge beyond which the model has no solution: reflect to the other side
        too_low = ~np.isfinite(np.asarray(scaled.log_prob(u)))
        u[too_low] = 2.0 * model.position - u[too_low]
    return u
