"""Make a problem's reduced model good where its posterior lives, and remember it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fmu.fem.basis_cache import load_basis, store_basis
from fmu.fem.candidates import SoftPairing
from fmu.fem.structure import PairedStructure
from fmu.posterior.maxima import local_maxima

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

FloatArray = NDArray[np.float64]

FREQUENCY_TOLERANCE = 1e-6
LOG_PROB_TOLERANCE = 1e-3
# Below the maximum by more than this, a probability does not matter.
PLAUSIBLE = 50.0
PATIENCE = 3


def reduce_model(problem: UpdatingProblem, structure: PairedStructure) -> None:
    """Train the reduced model of `structure`, or fetch it from the cache.

    Frequencies are good to `FREQUENCY_TOLERANCE` (relative) over the whole box, and the log-probability to
    `LOG_PROB_TOLERANCE` wherever it is within `PLAUSIBLE` of its maximum, at every point that was tried. Points on
    a jump, where modes swap and either model may take either of them, say nothing of the basis. Where what is
    left is rounding of the full model, more points do not help, and training ends: a run's certificate says
    what was promised and not kept (`fmu.analysis.certificate`).
    """
    tolerances = (FREQUENCY_TOLERANCE, LOG_PROB_TOLERANCE, PLAUSIBLE)
    key = {"problem": problem.configuration(), "tolerances": tolerances}
    state = load_basis(key)
    if state is not None:
        structure.restore(state)
        return
    n = structure.n_parameters
    lower, upper = np.array([p.prior.box(p.lower, p.upper) for p in problem.parameters[:n]]).T
    rng = np.random.default_rng(0)
    likelihood: Any = problem.likelihood

    differences: list[float] = []

    def wanting() -> FloatArray | None:
        points = plausible_points(problem, 64, rng)
        difference = np.sum(likelihood.terms(points) - likelihood.full_terms(points), axis=1)
        wrong = ~(np.abs(difference) <= LOG_PROB_TOLERANCE)
        if not isinstance(structure.rule, SoftPairing):
            wrong[wrong] = ~on_a_jump(structure, points[wrong, :n], FREQUENCY_TOLERANCE)
        differences.append(np.max(np.abs(difference[wrong]), initial=0.0))
        return points[:, :n] if wrong.any() and not has_stalled(differences) else None

    # without such terms the computed modes take no part in the log-probability
    state = structure.train(
        lower, upper, FREQUENCY_TOLERANCE, wanting if hasattr(likelihood, "full_terms") else None
    )
    store_basis(key, state)


def has_stalled(differences: Sequence[float]) -> bool:
    """Say whether the last `PATIENCE` rounds of training halved no largest difference that came before them."""
    return len(differences) > PATIENCE and min(differences[-PATIENCE:]) > 0.5 * min(differences[:-PATIENCE])


def on_a_jump(structure: PairedStructure, theta: FloatArray, tolerance: float) -> NDArray[np.bool_]:
    """Say, shape (n,), where the reduced model has the modes that the full one pairs, and yet pairs others.

    Parameters
    ----------
    structure : PairedStructure
        Trained.
    theta : ndarray, shape (n, n_parameters)
    tolerance : float
        Largest relative difference between frequencies that are the same.
    """
    reduced, full = structure.modes(theta), structure.full_modes(theta)
    answers = np.full(full.eigenvalues.shape, np.nan)
    for b in np.unique(full.block):
        block = structure.reduced.blocks[b] if structure.reduced is not None else structure.full.blocks[b]
        row, column = np.nonzero(full.block == b)
        rank = full.rank[row, column]
        known = rank < block.trusted
        if known.any():
            lam = block.eigenvalues(theta, int(rank[known].max()) + 1)
            answers[row[known], column[known]] = lam[row[known], rank[known]]
    # of an eigenvalue, twice as much
    same = np.abs(answers - full.eigenvalues) <= 2.0 * tolerance * np.abs(full.eigenvalues)
    others = (reduced.block != full.block) | (reduced.rank != full.rank)
    return np.asarray(others.any(axis=1) & same.all(axis=1))


def plausible_points(problem: UpdatingProblem, n: int, rng: np.random.Generator) -> FloatArray:
    """Return points inside the bounds at which the log-probability is within `PLAUSIBLE` of its maximum.

    From every local maximum that is itself plausible, along random directions of the Laplace approximation, to
    where the log-probability has dropped by a random amount, or to the bounds.

    Parameters
    ----------
    n : int
        Points a maximum.

    Returns
    -------
    ndarray, shape (n · maxima, ndim)
    """
    maxima = local_maxima(problem, starts=8)
    points = []
    for maximum in maxima:
        allowed = maximum.log_prob - (maxima[0].log_prob - PLAUSIBLE)
        if allowed < 0:
            continue
        direction = _laplace_directions(problem, maximum.theta, n, rng)
        floor = maximum.log_prob - rng.uniform(0.0, allowed, size=n)
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = (
                np.where(direction > 0, problem.upper - maximum.theta, problem.lower - maximum.theta) / direction
            )
        far = np.min(np.where(direction == 0, np.inf, walls), axis=1)
        near, far = np.zeros(n), np.minimum(far, 100.0)
        for _ in range(40):
            middle = 0.5 * (near + far)
            above = problem.log_prob(_along(problem, maximum.theta, direction, middle)) >= floor
            near, far = np.where(above, middle, near), np.where(above, far, middle)
        points.append(_along(problem, maximum.theta, direction, near))
    return np.concatenate(points)


def _along(problem: UpdatingProblem, origin: FloatArray, direction: FloatArray, step: FloatArray) -> FloatArray:
    return np.clip(origin + step[:, None] * direction, problem.lower, problem.upper)


def _laplace_directions(
    problem: UpdatingProblem, theta: FloatArray, n: int, rng: np.random.Generator
) -> FloatArray:
    """Return random directions with the covariance of the Gauss–Newton approximation, bent inward at walls."""
    information = problem.likelihood.quadratic(theta[None])[2][0]  # type: ignore[union-attr]
    precision = information * np.outer(problem.scale, problem.scale) + np.eye(problem.ndim)
    z = np.linalg.solve(np.linalg.cholesky(precision).T, rng.standard_normal((problem.ndim, n))).T
    z = np.where(theta <= problem.lower, np.abs(z), np.where(theta >= problem.upper, -np.abs(z), z))
    return z * problem.scale
