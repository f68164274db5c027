"""Classify the point where an ascent ends: a maximum (zero gradient or active bound), kink, jump, edge or slope.

Where computed modes swap or coincide, the log-probability of paired modes has a kink or, with shapes, a jump. An
ascent that reaches a jump stops there with a non-zero gradient pointing across it. Such a point is not a maximum,
and a quadratic model that extrapolates this gradient is wrong beyond the jump.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

MAXIMUM, KINK, JUMP, EDGE, SLOPE = "maximum", "kink", "jump", "edge", "slope"
"""Kinds of points: zero gradient or active bound; the gradient changes sign; log P falls; the model has no
solution beyond; log P rises further."""
VANISHING = 0.1
"""Largest gradient at a maximum, in nats per posterior standard deviation."""
_FALL, _WITHIN = 0.05, 1e-5
"""Smallest fall of log P at a jump, nats, and largest width of a jump, in posterior standard deviations."""
_AHEAD = np.logspace(-8.0, -1.0, 15)
_HALVINGS = 40
_LOW, _WIDER = 40.0, 28.0
"""Nats below the best point at which mass is negligible, and nats per coordinate for a factor of 1e12 in width."""


def slope(scaled: ScaledDensity, model: Quadratic) -> float:
    """Return the slope of log P in nats per posterior standard deviation, with active bounds held fixed.

    The slope is √(gᵀH⁻¹g) over the free coordinates: the length of the gradient in the metric of the posterior.
    """
    from fmu.posterior.ascent import decrement

    falls = decrement(model.position[None], -model.gradient[None], model.hessian[None], scaled.lower, scaled.upper)
    return float(np.sqrt(max(2.0 * falls[0], 0.0)))


def kind_of(problem: UpdatingProblem, scaled: ScaledDensity, model: Quadratic) -> str:
    """Return the kind of point where an ascent ends: `MAXIMUM`, `KINK`, `JUMP`, `EDGE` or `SLOPE`.

    If the gradient does not vanish, log P is followed along the step that its quadratic model proposes, from 1e-8
    to a tenth of the step. The first point where log P rises less than its gradient predicts is then found by
    bisection.

    Parameters
    ----------
    problem : UpdatingProblem
    scaled : ScaledDensity
    model : Quadratic
        Quadratic model around the end of the ascent, scaled.
    """
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


def active_bounds(scaled: ScaledDensity, model: Quadratic) -> FloatArray:
    """Return −1 where the lower bound is active, 1 where the upper bound is active, else 0, shape (ndim,)."""
    above = (model.gradient > 0) & (model.position >= scaled.upper)
    below = (model.gradient < 0) & (model.position <= scaled.lower)
    return above.astype(float) - below.astype(float)


def basin(model: Quadratic, kind: str, at_bound: FloatArray | IntArray) -> Quadratic:
    """Return the quadratic model that divides the draws among the maxima.

    Unless the point is a maximum or a kink, this model has no slope, except across active bounds: beyond a jump
    the slope would be wrong.
    """
    if kind in (MAXIMUM, KINK):
        return model
    return replace(model, gradient=np.where(at_bound != 0, model.gradient, 0.0))


def are_negligible(log_prob: FloatArray, ndim: int) -> BoolArray:
    """Return whether each maximum, by its log-probability (n,), is too low to have mass, however wide it is."""
    return np.asarray(log_prob < np.max(log_prob) - _LOW - _WIDER * ndim)
