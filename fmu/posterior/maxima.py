"""Local maxima of a posterior, from several starts: an optimum found once is not the mode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import qmc

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Maximum:
    """A local maximum within the bounds: theta (ndim,), its log-probability, and from how many starts it came."""

    theta: FloatArray
    log_prob: float
    starts: int


def local_maxima(problem: UpdatingProblem, starts: int = 16, seed: int = 1) -> tuple[Maximum, ...]:
    """Return the distinct local maxima of the log-probability within the bounds, the highest first.

    L-BFGS-B with the exact gradient (Byrd, Lu, Nocedal & Zhu 1995) from the problem's start and from points of a
    scrambled Sobol sequence in its box, in the coordinates (theta − offset)/scale. Two results are one maximum
    when they differ by less than a thousandth of the scale in every coordinate.

    Parameters
    ----------
    problem : UpdatingProblem
    starts : int
        At least 1; the first is ``problem.start``.
    seed : int

    Raises
    ------
    ValueError
        If `starts` is not positive.
    """
    if starts < 1:
        raise ValueError(f"starts: must be at least 1 (got {starts})")
    box = np.array([p.prior.box(p.lower, p.upper) for p in problem.parameters])
    sobol = qmc.Sobol(problem.ndim, rng=np.random.default_rng(seed))
    unit = sobol.random_base2(int(np.ceil(np.log2(starts))))[: starts - 1]
    points = np.concatenate([problem.start[None], box[:, 0] + (box[:, 1] - box[:, 0]) * unit])
    found: list[Maximum] = []
    for theta, value in (_climb(problem, point) for point in points):
        for i, known in enumerate(found):
            if np.all(np.abs(theta - known.theta) < 1e-3 * problem.scale):
                best = (theta, value) if value > known.log_prob else (known.theta, known.log_prob)
                found[i] = Maximum(*best, known.starts + 1)
                break
        else:
            found.append(Maximum(theta, value, 1))
    return tuple(sorted(found, key=lambda m: -m.log_prob))


def _climb(problem: UpdatingProblem, start: FloatArray) -> tuple[FloatArray, float]:
    def negative(u: FloatArray) -> tuple[float, FloatArray]:
        theta = np.clip(problem.offset + problem.scale * u, problem.lower, problem.upper)
        value, gradient = problem.log_prob_and_grad(theta)
        if not (np.isfinite(value) and np.all(np.isfinite(gradient))):
            return 1e300, np.zeros_like(u)
        return -value, -gradient * problem.scale

    bounds = list(
        zip(
            (problem.lower - problem.offset) / problem.scale,
            (problem.upper - problem.offset) / problem.scale,
            strict=True,
        )
    )
    result = minimize(
        negative,
        (start - problem.offset) / problem.scale,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"ftol": 1e-13, "gtol": 1e-7, "maxiter": 500, "maxcor": 20},
    )
    theta = np.clip(problem.offset + problem.scale * result.x, problem.lower, problem.upper)
    return theta, float(problem.log_prob(theta))
