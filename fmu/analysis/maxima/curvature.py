"""The Hessian of −log P at a maximum, where bounds may be active and the gradient may jump."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem


DIFFERENCES, GAUSS_NEWTON = "differences", "Gauss-Newton"
_FIRST_STEP = 1e-4
_OF_THE_WIDTH = 0.05
_SMOOTH = 0.3


def hessian_at(problem: UpdatingProblem, theta: FloatArray) -> tuple[FloatArray, str]:
    """Return −∇² log P at a maximum, in the coordinates (θ − offset)/scale, and where it comes from.

    Differences of the exact gradient over a twentieth of the width that a first attempt finds, one-sided at the
    bounds; the part that is not positive semidefinite is taken away. Where modes swap the gradient jumps, and
    differences over another step differ: then JᵀJ of the residuals plus the curvature of the prior (Gauss–Newton),
    where the errors are in the modes. With residuals of several standard deviations it may be an order too small.

    Parameters
    ----------
    problem : UpdatingProblem
    theta : ndarray, shape (ndim,)

    Returns
    -------
    hessian : ndarray, shape (ndim, ndim)
    source : {"differences", "Gauss-Newton"}
    """
    from fmu.posterior.maxima.ascent import GaussNewton
    from fmu.posterior.scaled import ScaledDensity

    rough = np.diag(_differences(problem, theta, np.full(problem.ndim, _FIRST_STEP)))
    step = np.clip(_OF_THE_WIDTH / np.sqrt(np.maximum(rough, 1.0)), 1e-6, 1e-2)
    hessian = _differences(problem, theta, step)
    if problem.likelihood.of_modes:
        other = np.diag(_differences(problem, theta, 0.5 * step))
        size = np.maximum(np.abs(np.diag(hessian)), np.abs(other))
        free = (theta > problem.lower) & (theta < problem.upper)
        is_smooth = np.all(np.abs(np.diag(hessian) - other) <= _SMOOTH * np.maximum(size, 1.0))
        if not is_smooth or np.any(np.linalg.eigvalsh(hessian[np.ix_(free, free)]) <= 0):
            return GaussNewton(problem)(ScaledDensity(problem).to_scaled(theta)[None])[2][0], GAUSS_NEWTON
    values, vectors = np.linalg.eigh(hessian)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T, DIFFERENCES


def _differences(problem: UpdatingProblem, theta: FloatArray, step: FloatArray) -> FloatArray:
    """Return the symmetric part of the gradient's differences over ± `step` (ndim,), in scaled coordinates."""
    h = np.diag(step * problem.scale)
    # a bound at which the prior vanishes has no gradient: halfway there
    vanishing = [(p.lowest > p.lower, p.highest < p.upper) for p in problem.parameters]
    vanish_below, vanish_above = np.array(vanishing).T
    lower = np.where(vanish_below, 0.5 * (problem.lower + theta), problem.lower)
    upper = np.where(vanish_above, 0.5 * (problem.upper + theta), problem.upper)
    ahead, behind = np.minimum(theta + h, upper), np.maximum(theta - h, lower)
    slopes = [problem.log_prob_and_grad(points)[1] * problem.scale for points in (ahead, behind)]
    hessian = (slopes[1] - slopes[0]) / (np.diag(ahead - behind) / problem.scale)[:, None]
    return 0.5 * (hessian + hessian.T)
