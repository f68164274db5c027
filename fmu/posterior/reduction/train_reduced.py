"""Train a problem's reduced model. It is most accurate where the posterior has its mass."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.special import chdtri

from fmu.engines.base import Engine
from fmu.fem.modes.modal import ModalSolution, is_rigid
from fmu.fem.modes.solver import LAPACK
from fmu.fem.pairing.failed_solves import NOT_FINITE, why_no_frequencies
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.paired_structure import PairedStructure, structure_of
from fmu.fem.reduced.anchors import NoModesError, SingularAnchorError
from fmu.fem.reduced.cache import load_basis, store_basis
from fmu.fem.reduced.points import box_points
from fmu.fem.reduced.reduced_structure import ReducedStructure, reduced_in, restore, train, train_at
from fmu.fem.reduced.training import BUDGET
from fmu.numbers import apart, significant, typed
from fmu.posterior.density import Posterior
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.reduction.region import is_narrower, plausible_points, posterior_box, training_box
from fmu.posterior.reduction.tolerance import LOOSEST_FREQUENCY, LOOSEST_LOG_PROB, Tolerance, next_power_of_ten
from fmu.posterior.rounding import bounded_rounding
from fmu.progress.phases import by_parts
from fmu.types import BoolArray, FloatArray

PATIENCE = 3
_AT_ONCE = 16  # points solved at once
# Share of the tolerance of the log-probability that training must meet at its points; other points may be worse.
_TUNED = 0.7
# Safety factor on the reduction of the errors required in the next round, and limits of that reduction: with many
# parameters, fresh points lie further out than the worst point so far.
_SPARE, _TIMES = 2.0, (3.0, 30.0)
_CHECKED, _CHECK_SEED = 32, 10_000
# Number of points from the prior, and from the posterior, whose modes are a basis for wide bounds; share of a
# Gaussian posterior that may lie further out than the points from the posterior.
_SNAPSHOTS, _BEYOND = 60, 1e-3


class ReductionWarning(UserWarning):
    """Warns that a reduced model cannot be made, misses its tolerance, or meets it only in a part of the box.

    Also warns if K is negative for some motion, or errors are not bounded well, in a part of the box.
    `fmu.FRFErrors` gives this warning for its reduced models.
    """


def reduced_model(
    problem: Posterior, tolerance: Tolerance, engine: Engine | None = None
) -> tuple[ModalModel, Tolerance | None]:
    """Return a reduced model, trained or read from the cache, and the tolerance that it must meet.

    The frequencies must meet their tolerance at every point tested in the box, and the log-probability wherever it
    is within the tolerance's `depth` of its maximum. Points at a jump, where modes swap and the two models may
    pair different modes, are ignored. Training ends early if more points do not help, because only the full
    model's rounding remains, or if a larger basis would not save time (`fmu.fem.reduced.points.affordable`). After
    a run, the certificate states whether the tolerances were met (`fmu.analysis.certificate`).

    If the box is so wide that a basis for the tolerance would not save time, three alternatives are tried in turn:

    - A basis with which the frequencies are accurate to 1e-3 in the box, and to their tolerance wherever the
      log-probability is within that depth of its maximum, if this basis saves time.
    - A basis of modes at draws from the prior and the posterior, if the errors at fresh points from the posterior
      are well below `LOOSEST_LOG_PROB` and `LOOSEST_FREQUENCY`.
    - The full model, which is returned with None for the tolerance.

    A model without matrices is returned unchanged, with None. If there is an engine, its workers solve the full
    model at several points at once, and compute the residuals of large structures. Comparisons with the full model
    count against a budget (`fmu.fem.reduced.training.BUDGET`).

    Raises
    ------
    ValueError
        If the model must be trained and rounding errors exceed the measurement errors, or if, somewhere in the
        box, a displacement has neither stiffness nor mass, or has negative mass.

    Warns
    -----
    ReductionWarning
        If the full model has no modes at draws from the prior, the reduced model misses its tolerance or meets it
        only where the posterior has its mass, or K is negative or errors are not bounded well in a part of the
        box. The warning is repeated if the model is read from the cache.
    """
    structure = structure_of(problem.model)
    if structure is None:
        return problem.model, None
    with structure.spread_over(engine):
        return _reduce(problem, structure, tolerance)


def _reduce(
    problem: Posterior, structure: PairedStructure, tolerance: Tolerance
) -> tuple[ModalModel, Tolerance | None]:
    """Return the reduced model of a structure, and its tolerance; see `reduced_model`."""
    tolerances = (tolerance.frequency, tolerance.log_prob, tolerance.depth)
    key = {"problem": problem.configuration(), "tolerances": tolerances, "solver": structure.solver}
    state = load_basis(key)
    if state is not None:
        model = restore(structure, state)
        return model, _find_tolerance(problem, model, tolerance, state)
    bounded_rounding(problem)  # before the time for training is spent
    n = structure.n_parameters
    bounds = problem.lower[:n], problem.upper[:n]
    trained = np.stack(training_box(problem.parameters[:n]))
    rng = np.random.default_rng(0)
    likelihood = problem.likelihood

    differences: list[float] = []
    compared: list[int] = []

    def some_points(model: ReducedStructure) -> FloatArray:
        """Return plausible points. For a large structure, they lie in the trained box and need no full solves."""
        if structure.solver == LAPACK:
            return plausible_points(problem.with_model(model), 64, rng, tolerance.depth)
        points = plausible_points(problem.with_model(model.extend(*bounds)), 64, rng, tolerance.depth)
        return np.concatenate([np.clip(points[:, :n], *trained), points[:, n:]], axis=1)

    def wider_box(model: ReducedStructure) -> tuple[FloatArray, FloatArray] | None:
        found = posterior_box(problem.with_model(model.extend(*bounds)), trained)
        if found is not None:
            trained[:] = found
        return found

    def inaccurate_points(model: ReducedStructure) -> tuple[FloatArray, float] | None:
        points = some_points(model)
        needs_solves = structure.solver == LAPACK or structure.is_soft or likelihood.needs_shapes
        may_jump = not structure.is_soft
        if isinstance(likelihood, ModalLikelihood) and not needs_solves:  # cheaper, and ignores jumps
            difference, may_jump = _log_prob_bound(model, likelihood, points), False
        else:
            left = BUDGET - sum(compared)
            if left <= 0:
                return None
            points = points[:: -(-len(points) // left)]  # some points around every maximum
            compared.append(len(points))
            difference = _log_prob_errors(problem, model, points)
        wrong = ~(np.abs(difference) <= _TUNED * tolerance.log_prob)
        if may_jump:
            wrong[wrong] = ~on_a_jump(model, points[wrong, :n], tolerance.frequency)
        differences.append(np.max(np.abs(difference[wrong]), initial=0.0))
        if not wrong.any() or has_stalled(differences):
            return None
        # errors of the log-probability are proportional to errors of the frequencies
        times = _SPARE * differences[-1] / (_TUNED * tolerance.log_prob)
        return points[:, :n], float(np.clip(times, *_TIMES)) if np.isfinite(times) else _TIMES[1]

    # the modal residual uses no computed modes, so its log-probability does not depend on the reduced model
    try:
        model, state = train(
            structure,
            trained[0].copy(),
            trained[1].copy(),
            tolerance.frequency,
            inaccurate_points if likelihood.of_modes else None,
            (lambda model: some_points(model)[:, :n]) if likelihood.of_modes else None,
            wider_box if likelihood.of_modes and is_narrower(problem, trained) else None,
        )
    except SingularAnchorError as singular:
        raise ValueError(_singular(problem, singular)) from singular
    reduced = reduced_in(model)
    if reduced is None:
        if likelihood.of_modes:
            try:
                found = _trained_at_draws(problem, structure, trained, tolerance.frequency)
                model, state = found or (model, state)
            except NoModesError as unsolved:
                state["unsolved"] = unsolved.theta
        store_basis(key, state)
        return model, _find_tolerance(problem, model, tolerance, state)
    error = 0.0 if reduced.confirmed else _paired_error(reduced, trained[0], trained[1], tolerance.frequency)
    reached = np.array([error, differences[-1] if differences else 0.0])
    if not (reached[0] <= tolerance.frequency and reached[1] <= tolerance.log_prob):
        state["reached"] = reached
    store_basis(key, state)
    return model, _find_tolerance(problem, model, tolerance, state)


def _find_tolerance(
    problem: Posterior, model: ModalModel, tolerance: Tolerance, state: dict[str, FloatArray]
) -> Tolerance | None:
    """Return the tolerance that a reduced model must meet, or None for a full model.

    Warn if the reduced model misses the requested tolerance or meets it only in a part of the box, if K is
    negative or errors are not bounded well in a part of the box, or if the full model has no modes at draws from
    the prior.
    """
    if "unsolved" in state:
        reason = why_no_frequencies(model, state["unsolved"]) or NOT_FINITE
        _warn(
            f"no reduced model can be made, as the full model has no modes at draws from the prior ({reason}); "
            "narrow the bounds or priors"
        )
    if model is model.truth:
        return None
    _warn_if_missed(problem, model, tolerance, state)
    return Tolerance(*state["loosened"].tolist()) if "loosened" in state else tolerance


def _trained_at_draws(
    problem: Posterior, structure: PairedStructure, trained: FloatArray, frequency: float
) -> tuple[ReducedStructure, dict[str, FloatArray]] | None:
    """Return a reduced model trained at draws from the prior and the posterior, and its training state.

    Return None if, at fresh points from the posterior, a log-probability error exceeds the share `_TUNED` of
    `LOOSEST_LOG_PROB` or a relative frequency error exceeds half of `LOOSEST_FREQUENCY`. Return None also if, at a
    draw, a displacement has neither stiffness nor mass, or has negative mass. Raise NoModesError if no draw from
    the prior can be solved. `trained` (2, n_parameters) is the box, and `frequency` is the requested relative
    error.
    """
    n, rng = structure.n_parameters, np.random.default_rng(0)
    depth = 0.5 * float(chdtri(problem.ndim, _BEYOND))  # contains all but this share of a Gaussian posterior

    def within(points: FloatArray) -> FloatArray:
        return np.clip(points[:, :n], *trained)

    prior = within(problem.prior.draw(rng, 2 * _SNAPSHOTS))
    try:
        model, _ = train_at(structure, prior[: _SNAPSHOTS // 2], *trained)  # for a first look at the posterior
        points = plausible_points(problem.with_model(model), _SNAPSHOTS + _CHECKED, rng, depth)
        points = rng.permutation(points)
        at = np.concatenate([prior[:_SNAPSHOTS], within(points[:_SNAPSHOTS])])
        model, state = train_at(structure, at, *trained)
    except SingularAnchorError:  # a displacement has neither stiffness nor mass at a draw
        return None
    points = points[_SNAPSHOTS:][:_CHECKED]
    wrong = ~(np.abs(_log_prob_errors(problem, model, points)) <= _TUNED * LOOSEST_LOG_PROB)
    if not structure.is_soft:
        wrong[wrong] = ~on_a_jump(model, points[wrong, :n], LOOSEST_FREQUENCY)
    off = _error_at(model, points[:, :n], frequency)
    if wrong.any() or not 2.0 * off <= LOOSEST_FREQUENCY:
        return None
    errors = np.maximum([off, _error_at(model, prior[_SNAPSHOTS:][:_CHECKED], frequency)], frequency)
    kept, elsewhere = (next_power_of_ten(2.0 * error) for error in np.maximum.accumulate(errors).tolist())
    state |= {"elsewhere": np.array(elsewhere), "loosened": np.array([kept, LOOSEST_LOG_PROB])}
    return model.with_tolerance_elsewhere(elsewhere), state


def _log_prob_errors(problem: Posterior, model: ReducedStructure, points: FloatArray) -> FloatArray:
    """Return the reduced model's log-probability errors at points (n, ndim), shape (n,)."""
    exact = np.concatenate(by_parts("training", problem.likelihood.terms, points, _AT_ONCE, _AT_ONCE))
    return np.asarray(np.sum(problem.with_model(model).likelihood.terms(points) - exact, axis=1))


def _log_prob_bound(model: ReducedStructure, likelihood: ModalLikelihood, points: FloatArray) -> FloatArray:
    """Return upper bounds of the log-probability error, (n,), at points (n, ndim), from frequency error bounds.

    Each bound is the sum of the changes due to each frequency's largest error separately. To first order,
    simultaneous errors of all frequencies cannot change the log-probability by more.
    """
    theta = points[:, : model.n_parameters]
    bound = np.concatenate(by_parts("training", model.frequency_bound, theta, _AT_ONCE, _AT_ONCE))
    reduced = model.frequencies(theta)
    terms, off = np.sum(likelihood.terms_of_frequencies(reduced, points), axis=1), np.zeros(len(points))
    for i in range(model.n_modes):
        moved = reduced.copy()
        moved[:, i] /= 1.0 + bound[:, i]
        off += np.abs(np.sum(likelihood.terms_of_frequencies(moved, points), axis=1) - terms)
    return off


def _singular(problem: Posterior, error: SingularAnchorError) -> str:
    if error.parameter is None:
        return f"reduction: {error}, in the middle of the bounds; hold the motion or give it mass"
    name = problem.parameters[error.parameter].name
    return f"parameters: {name} must not reach zero: there {error}; raise its lower bound, or give the motion mass"


def _paired_error(model: ReducedStructure, lower: FloatArray, upper: FloatArray, tolerance: float) -> float:
    """Return the measured modes' largest relative frequency error at fresh points in the box; see `_error_at`."""
    theta = box_points(lower, upper, _CHECKED, _CHECK_SEED)
    if model.truth.solver != LAPACK:  # where solves are expensive, use only about _CHECKED points in total
        theta = theta[:: -(-len(theta) // _CHECKED)]
    return _error_at(model, theta, tolerance)


def _error_at(model: ReducedStructure, theta: FloatArray, tolerance: float) -> float:
    """Return the reduced model's largest relative frequency error at theta (n, p), over measured modes.

    The result is 0 if no error exceeds `tolerance`. Rigid-body modes are left out. Points are skipped if the full
    model fails there, or if both models have the same modes but pair different ones with the measured modes.
    """
    full = model.truth.modes(theta)
    exact, reduced = full.eigenvalues, model.modes(theta).eigenvalues
    elastic = ~is_rigid(exact)
    # the relative error of a frequency is half that of its eigenvalue
    error = np.max(np.where(elastic, 0.5 * np.abs(reduced / np.where(elastic, exact, 1.0) - 1.0), 0.0), axis=1)
    wrong = ~(error <= tolerance) & np.isfinite(exact).all(axis=1)
    if wrong.any():
        wrong &= ~on_a_jump(model, theta, tolerance, full)
    return float(np.max(error[wrong], initial=0.0))


def _off(found: float, tolerance: float) -> str:
    return f"{apart(found, tolerance, digits=3)[0]} (asked for: {typed(tolerance)})"


def _warn_if_missed(
    problem: Posterior, model: ModalModel, tolerance: Tolerance, state: dict[str, FloatArray]
) -> None:
    if "far" in state:
        j, value, is_above, is_negative = state["far"]
        there = f"{problem.parameters[int(j)].name} is {'above' if is_above else 'below'} {significant(value, 3)}"
        _warn(
            f"K is negative for some motion where {there}; narrow the bounds of this parameter"
            if is_negative
            else f"errors of the reduced model are not bounded well where {there}, far from every point at which "
            "K was factorised; narrow the bounds of this parameter, or let fewer stiffnesses vanish at once"
        )
    sizes = " + ".join(map(str, model.sizes))
    if "reached" not in state:
        if "elsewhere" in state:
            kept = typed(float(state["loosened"][0])) if "loosened" in state else "it"
            box = typed(float(state["elsewhere"]))
            where = "" if kept == box else f" where the posterior has its mass, and {box} elsewhere"
            _warn(
                f"within the bounds a basis for frequencies to {typed(tolerance.frequency)} would not pay; this "
                f"one of {sizes} vectors keeps {kept}{where}; after a run see its certificate, or choose narrower "
                "bounds or priors"
            )
        return
    frequency, log_prob = state["reached"].tolist()
    missed = []
    if not frequency <= tolerance.frequency:
        missed.append(f"its frequencies are off by up to {_off(frequency, tolerance.frequency)}")
    if not log_prob <= tolerance.log_prob:
        missed.append(f"its log-probability is off by up to {_off(log_prob, tolerance.log_prob)}")
    _warn(
        f"with a basis of {sizes} vectors the reduced model misses its tolerance: {' and '.join(missed)}; "
        f"choose a looser tolerance, such as reduction={typed(_looser(tolerance, frequency))}, narrower bounds or "
        "priors, or reduction=False, the full model"
    )


def _warn(said: str) -> None:
    warnings.warn(
        f"reduction: {said}",
        ReductionWarning,
        skip_file_prefixes=(f"{Path(__file__).parents[1]}{os.sep}",),  # point at the user's line
    )


def _looser(tolerance: Tolerance, reached: float) -> float:
    """Return the smallest power of ten that is ten times the tolerance or more, and not below `reached`.

    It is at most `LOOSEST_FREQUENCY`, which is also returned if `reached` is not finite.
    """
    wanted = max(reached, 10.0 * tolerance.frequency) if np.isfinite(reached) else LOOSEST_FREQUENCY
    return min(next_power_of_ten(wanted), LOOSEST_FREQUENCY)


def has_stalled(differences: Sequence[float]) -> bool:
    """Return True if the last `PATIENCE` rounds of training did not halve the smallest earlier difference."""
    return len(differences) > PATIENCE and min(differences[-PATIENCE:]) > 0.5 * min(differences[:-PATIENCE])


def on_a_jump(
    model: ReducedStructure, theta: FloatArray, tolerance: float, full: ModalSolution | None = None
) -> BoolArray:
    """Return a mask (n,) of the points at which mode pairing jumps.

    There the reduced and the full model have the same modes, but pair different modes with the measured ones.

    Parameters
    ----------
    model : ReducedStructure
    theta : ndarray, shape (n, n_parameters)
    tolerance : float
        Largest relative difference between frequencies that count as equal.
    full : ModalSolution, optional
        The full model's modes at theta, if they are already computed.
    """
    reduced, full = model.modes(theta), full or model.truth.modes(theta)
    answers = np.full(full.eigenvalues.shape, np.nan)
    for b in np.unique(full.block):
        block = model.cheap.blocks[b]
        row, column = np.nonzero(full.block == b)
        rank = full.rank[row, column]
        known = rank < block.n_trained
        if known.any():
            lam = block.eigenvalues(theta, int(rank[known].max()) + 1)
            answers[row[known], column[known]] = lam[row[known], rank[known]]
    # the relative tolerance of an eigenvalue is twice that of its frequency
    same = np.abs(answers - full.eigenvalues) <= 2.0 * tolerance * np.abs(full.eigenvalues)
    others = (reduced.block != full.block) | (reduced.rank != full.rank)
    return np.asarray(others.any(axis=1) & same.all(axis=1))
