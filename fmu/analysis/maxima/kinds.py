"""Classify the point where an ascent ends: maximum (zero gradient or active bound), kink, jump, edge or slope.

Where computed modes swap or coincide, the log-probability of paired modes has a kink or, with mode shapes, a jump.
An ascent that reaches a jump stops there with a non-zero gradient pointing across it. This point is not a maximum,
and a quadratic model that extrapolates the gradient is wrong beyond the jump.
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
"""Kinds of end points. Maximum: zero gradient or active bound. Kink: the gradient changes sign. Jump: log P falls.
Edge: the model has no solution beyond. Slope: log P rises further."""
VANISHING = 0.1
"""Largest gradient at a maximum, in nats per posterior standard deviation."""
_FALL, _WITHIN = 0.05, 1e-5
"""Smallest fall of log P at a jump, in nats, and largest width of a jump, in posterior standard deviations."""
_AHEAD = np.logspace(-8.0, -1.0, 15)
_HALVINGS = 40
_LOW, _WIDER = 40.0, 28.0
"""Nats below the best point at which mass is negligible, and nats added per coordinate for a factor of 1e12 in
width."""


def slope(scaled: ScaledDensity, model: Quadratic) -> float:
    """Return the slope of log P in nats per posterior standard deviation, ignoring coordinates at active bounds.

    The slope is √(gᵀH⁻¹g) over the other coordinates. This is the gradient's length in the posterior metric.
    """
    from fmu.posterior.ascent import decrement

    falls = decrement(model.position[None], -model.gradient[None], model.hessian[None], scaled.lower, scaled.upper)
    return float(np.sqrt(max(2.0 * falls[0], 0.0)))


def kind_of(problem: UpdatingProblem, scaled: ScaledDensity, model: Quadratic) -> str:
    """Return the kind of point where an ascent ended: `MAXIMUM`, `KINK`, `JUMP`, `EDGE` or `SLOPE`.

    If the gradient does not vanish, log P is followed along the Newton step of the quadratic model, from 1e-8 to a
    tenth of the step. Bisection then finds the first point where log P rises by less than half of what the
    quadratic model predicts. If there is no such point, the kind is `SLOPE`. It is `EDGE` if log P is not finite
    there, `JUMP` if log P falls there by more than 0.05 nats, and otherwise `KINK`.

    Parameters
    ----------
    problem : UpdatingProblem
    scaled : ScaledDensity
    model : Quadratic
        Quadratic model at the end point, in scaled coordinates.
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
