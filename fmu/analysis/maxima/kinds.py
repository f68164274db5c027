"""Classify the point where an ascent ends: maximum, kink, jump, edge, singularity or slope.

Where computed modes swap or coincide, the log-probability of paired modes has a kink or, with mode shapes, a jump.
An ascent that reaches a jump stops there with a non-zero gradient pointing across it. This point is not a maximum,
and a quadratic model that extrapolates the gradient is wrong beyond the jump. If a beta prior has a or b below 1,
the density is infinite at a bound. An ascent ends beside that bound, at a height that only rounding limits. It
says nothing about probability.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fmu.numbers import significant
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

MAXIMUM, KINK, JUMP, EDGE, SINGULARITY, SLOPE = "maximum", "kink", "jump", "edge", "singularity", "slope"
"""Kinds of end points. Maximum: zero gradient or active bound. Kink: the gradient changes sign. Jump: log P falls.
Edge: the model has no solution beyond. Singularity: the density is infinite at a bound beside it. Slope: log P
rises further."""
_RISES = "the log-probability rises by {0} per posterior standard deviation up to "
_ENDS = {
    JUMP: f"{_RISES}a jump down, where computed modes swap or coincide.",
    EDGE: f"{_RISES}a place beyond which the model has no solution.",
    SINGULARITY: "it is at a bound where the {1}density is infinite.",
    SLOPE: f"{_RISES}where the search ended, and beyond: use more starts.",
}
VANISHING = 0.1
"""Largest gradient at a maximum, in nats per posterior standard deviation."""
_FALL, _WITHIN = 0.05, 1e-5
"""Smallest fall of log P at a jump, in nats, and largest width of a jump, in posterior standard deviations."""
_AHEAD = np.logspace(-8.0, -1.0, 15)
_HALVINGS = 40
_BESIDE, _TOWARDS = 1e-3, np.array([1e-6, 1e-8, 1e-10])
"""Scaled distance from a bound within which a point may be a singularity, and distances at which log P is
compared."""
_GROWTH, _ALIKE = 0.02, 0.1
"""Least rise of log P, in nats, from one of these distances to the next, and largest relative difference of both
rises."""
_LOW, _WIDER = 40.0, 28.0
"""Nats below the best point at which mass is negligible, and nats added per coordinate for a factor of 1e12 in
width."""


def why_no_maximum(kind: str, slope: float, of: str = "") -> str:
    """Return a clause on why a point of this kind is no maximum; `of` is "prior's " if a prior may be infinite."""
    return _ENDS[kind].format(significant(slope, 2), of)


def slope(scaled: ScaledDensity, model: Quadratic) -> float:
    """Return the slope of log P in nats per posterior standard deviation, ignoring coordinates at active bounds.

    The slope is √(gᵀH⁻¹g) over the other coordinates. This is the gradient's length in the posterior metric.
    """
    from fmu.posterior.ascent import decrement

    falls = decrement(model.position[None], -model.gradient[None], model.hessian[None], scaled.lower, scaled.upper)
    return float(np.sqrt(max(2.0 * falls[0], 0.0)))


def kind_of(problem: UpdatingProblem, scaled: ScaledDensity, model: Quadratic) -> str:
    """Return the kind of point where an ascent ended: `MAXIMUM`, `KINK`, `JUMP`, `EDGE`, `SINGULARITY` or `SLOPE`.

    It is `SINGULARITY` if the density is infinite at a bound beside the point (`is_singular`). If the gradient
    does not vanish, log P is followed along the Newton step of the quadratic model, from 1e-8 to a tenth of the
    step. Bisection then finds the first point where log P rises by less than half of what the quadratic model
    predicts. If there is no such point, the kind is `SLOPE`. It is `EDGE` if log P is not finite there, `JUMP` if
    log P falls there by more than 0.05 nats, and otherwise `KINK`.

    Parameters
    ----------
    problem : UpdatingProblem
    scaled : ScaledDensity
    model : Quadratic
        Quadratic model at the end point, in scaled coordinates.
    """
    if is_singular(scaled, model.position):
        return SINGULARITY
    rise = slope(scaled, model)
    if rise <= VANISHING:
        return MAXIMUM
    u, free = model.position, active_bounds(scaled, model) == 0
    step = np.zeros(len(u))
    H = model.hessian[np.ix_(free, free)]
    step[free] = np.linalg.solve(
        H + 1e-12 * (1.0 + np.trace(model.hessian)) * np.eye(int(free.sum())), model.gradient[free]
    )

    def gain(t: FloatArray) -> FloatArray:
        points = np.clip(u + t[:, None] * step, scaled.lower, scaled.upper)
        values = np.asarray(scaled.log_prob(points)) - model.log_prob
        return np.where(np.isfinite(values), values, -np.inf)

    failing = np.flatnonzero(gain(_AHEAD) < 0.5 * rise**2 * _AHEAD * (1.0 - 0.5 * _AHEAD) - 1e-9)
    if not len(failing):
        return SLOPE
    last, first = (0.0 if failing[0] == 0 else _AHEAD[failing[0] - 1]), _AHEAD[failing[0]]
    for _ in range(_HALVINGS):
        middle = 0.5 * (last + first)
        rises = gain(np.array([middle]))[0] >= 0.5 * rise**2 * middle * (1.0 - 0.5 * middle) - 1e-9
        last, first = (middle, first) if rises else (last, middle)
    before, just, after = gain(np.array([last, first, first + _WITHIN / rise]))
    if np.isneginf(just):
        return EDGE
    return JUMP if before - min(just, after) > _FALL else KINK


def is_singular(scaled: ScaledDensity, u: FloatArray) -> bool:
    """Return True if a log-density rises without limit towards a bound that a scaled point u (ndim,) is close to.

    At the distance d from the bound such a density is ∝ d^(a−1) with 0 < a < 1. Whenever d falls to a hundredth,
    log P rises by the same amount, (1 − a) log 100, whereas a finite density hardly rises any more.
    """
    for bound, inwards in ((scaled.lower, 1.0), (scaled.upper, -1.0)):
        for k in np.flatnonzero(_is_beside(u, bound)):
            points = np.repeat(u[None], len(_TOWARDS), axis=0)
            points[:, k] = bound[k] + inwards * _TOWARDS
            value = np.asarray(scaled.log_prob(points))
            first, second = np.diff(np.where(np.isfinite(value), value, 0.0))
            if np.isfinite(value).all() and second > _GROWTH and abs(first - second) < _ALIKE * second:
                return True
    return False


def _is_beside(u: FloatArray, bound: FloatArray) -> BoolArray:
    return np.asarray((np.abs(u - bound) < _BESIDE) & (u != bound))


def without_singularity(scaled: ScaledDensity, model: Quadratic) -> Quadratic:
    """Return the quadratic model at a singularity, flat along the coordinates that are close to a bound."""
    flat = _is_beside(model.position, scaled.lower) | _is_beside(model.position, scaled.upper)
    gradient = np.where(flat, 0.0, model.gradient)
    return replace(model, gradient=gradient, hessian=np.where(flat | flat[:, None], 0.0, model.hessian))


def active_bounds(scaled: ScaledDensity, model: Quadratic) -> FloatArray:
    """Return each coordinate's active bound, shape (ndim,): −1 for the lower, 1 for the upper, 0 for none."""
    above = (model.gradient > 0) & (model.position >= scaled.upper)
    below = (model.gradient < 0) & (model.position <= scaled.lower)
    return above.astype(float) - below.astype(float)


def basin(model: Quadratic, kind: str, at_bound: FloatArray | IntArray) -> Quadratic:
    """Return the quadratic model used to assign draws to a maximum.

    At a maximum or kink this is `model` itself. At any other point the model gets no slope except across active
    bounds, because the slope would be wrong beyond a jump.
    """
    if kind in (MAXIMUM, KINK):
        return model
    return replace(model, gradient=np.where(at_bound != 0, model.gradient, 0.0))


def are_negligible(log_prob: FloatArray, ndim: int) -> BoolArray:
    """Return a mask (n,) of the maxima that are too low for their mass to matter, even if they are very wide."""
    return np.asarray(log_prob < np.max(log_prob) - _LOW - _WIDER * ndim)
