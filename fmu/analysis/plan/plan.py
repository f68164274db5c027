"""`fmu.plan`: which sensors, modes, repeats and changes of the structure tell most about its parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from annotated_types import Ge, Gt, Interval
from numpy.typing import ArrayLike

from fmu.analysis.identifiability import truncated_sd
from fmu.analysis.plan import baselines
from fmu.analysis.plan.bound import relax
from fmu.analysis.plan.candidates import (
    Candidates,
    find_candidates,
    group_candidates,
    require_places,
    require_sensors,
)
from fmu.analysis.plan.choice import Limits, choose
from fmu.analysis.plan.design import Design, Target, target_of
from fmu.analysis.plan.options import change_table, mode_table, repeat_table
from fmu.analysis.plan.pairing import Pairing, check_pairing
from fmu.analysis.plan.result import PLANNED, Plan, choice_row, information_curve
from fmu.analysis.plan.sensitivities import (
    UNSEEN,
    Sensitivities,
    of_model,
    of_structure,
    paired_with_itself,
    pick_modes,
)
from fmu.analysis.trace.densities import is_updating
from fmu.analysis.trace.reading import check_trace, parameter_draws, parameter_names
from fmu.arguments import ArgumentError, Count, Place, Seed, check_arguments
from fmu.fem.modes.changes import Change, changed_model
from fmu.fem.modes.modal import mac
from fmu.fem.pairing.paired_structure import PairedStructure, structure_of
from fmu.fem.pairing.rules import assign
from fmu.posterior.problem import UpdatingProblem
from fmu.progress.phases import phase
from fmu.tables import data_frame
from fmu.types import Dof, FloatArray, NotNegative, Positive

if TYPE_CHECKING:
    import xarray as xr

FREQUENCY_SD = 0.005
INDEPENDENCE, MOST = "effective independence", "most information, pairing not considered"


@check_arguments
def plan(
    problem: UpdatingProblem,
    sensors: Count = 12,
    *,
    candidates: Sequence[Dof] | None = None,
    triaxial: bool = False,
    mounted: Sequence[Dof] = (),
    exclude: Sequence[Place] = (),
    min_distance: NotNegative = 0.0,
    costs: Mapping[Place, float] | None = None,
    budget: Positive | None = None,
    modes: Annotated[int, Ge(1)] | Sequence[Annotated[int, Ge(1)]] | None = None,
    frequency_sd: Annotated[ArrayLike, Gt(0.0)] | None = None,
    shape_sd: Annotated[float, Interval(gt=0.0, le=1.0)] = 0.02,
    drift: NotNegative = 0.0,
    target: Target | None = None,
    changes: Mapping[str, Change] | None = None,
    trace: xr.DataTree | None = None,
    draws: Annotated[int, Interval(ge=2, le=10_000)] = 32,
    seed: Seed = 1,
) -> Plan:
    """Plan a modal test: choose the sensors that reduce the uncertainty of the parameters most.

    The model is linearised at draws from the prior or, with a trace, from the posterior of a run. The expected
    information ½ E log det(I + Σ Jᵀ Σ_e⁻¹ J) is maximised by a greedy choice and exchanges; an upper bound by
    convex relaxation says how far from the best choice the plan can be. Bounds and bent posteriors are not
    counted: `fmu.simulate_plan` compares the plan with simulated tests. If the modes could not be paired by MAC
    with the most informative sensors, only choices with which they can be are considered.

    Parameters
    ----------
    problem : UpdatingProblem
        One test of a structure. Its data may be those of an earlier test, or those that the model predicts
        (`fmu.expected_modes`); only the model and the prior are used, and the errors of the frequencies.
    sensors : int
        Number of sensors to choose, besides those that are mounted. With a budget, the largest number.
    candidates : sequence of (place, direction), optional
        Where a sensor may be; every translation of every node by default. For a user's function or a surrogate:
        the sensors of the problem's data.
    triaxial : bool
        Whether one sensor reads all candidate directions of its place.
    mounted : sequence of (place, direction)
        Sensors that stay where they are.
    exclude : sequence of place
        Places out of reach.
    min_distance : float, m
        Smallest distance of two sensors.
    costs : mapping of place to float, optional
        Costs of sensors at these places; 1 elsewhere.
    budget : float, optional
        Largest total cost of the chosen sensors.
    modes : int or sequence of int, optional
        Number of modes to be measured, the lowest elastic ones that the candidates see; or the numbers of these
        modes, from 1, among all elastic modes. As many as the problem has by default.
    frequency_sd : float or array_like, shape (n_modes,), optional
        Relative standard deviation of the frequencies in one test; by default the one of the problem, or 0.005.
    shape_sd : float
        Standard deviation of a component of a shape, relative to its largest component at the candidates.
    drift : float
        Relative standard deviation of the frequencies that repeated tests do not reduce.
    target : str, sequence of str, mapping or callable, optional
        What the test is for, if not all parameters alike: names of parameters, a combination as weights by name,
        or a prediction that maps theta (n, ndim) to (n,).
    changes : mapping of str to Change, optional
        Known changes of the structure for a second test, by name.
    trace : DataTree, optional
        A run of the same problem, whose posterior takes the place of the prior.
    draws : int
        Number of draws at which the model is linearised.
    seed : int

    Returns
    -------
    Plan

    Raises
    ------
    ValueError
        If a sensor does not exist, there are fewer candidates than sensors, the candidates do not see a mode, no
        mode moves a candidate, or the model gives no shapes.
    """
    if not is_updating(problem) or problem.model.n_tests > 1:
        raise ArgumentError("problem", "must be an UpdatingProblem of one test", type(problem).__name__)
    theta, scale = _draws(problem, trace, draws, np.random.default_rng(seed))
    asked = _modes(problem, modes)
    costs, changes = costs or {}, changes or {}
    known = structure_of(problem.model)
    second: dict[str, tuple[Sensitivities, tuple[int, ...]]] = {}
    energy: FloatArray | None = None
    places: FloatArray | None = None
    if known is None:
        if changes:
            raise ArgumentError("changes", "need a model with matrices", problem.model.name)
        there = _own_candidates(problem, candidates, mounted, exclude, triaxial, costs)
        picked = tuple(range(asked)) if isinstance(asked, int) else asked
        found = _of_own_model(problem, theta, there, picked)
    else:
        structure, start = known.structure, problem.start[: problem.n_structural]
        there = find_candidates(structure, candidates, mounted, exclude, triaxial, costs)
        picked, paired = pick_modes(structure, start, there.sensors, asked)
        nominal = paired.observed(start[None]).shapes[0][:, list(picked)]
        there = _moving(there, nominal, are_named=candidates is not None)
        paired, places = paired.seen_by(there.sensors), there.places(structure)
        found, energy = of_structure(paired, theta, start), kinetic_energies(paired, start, picked)
        second = {name: _of_change(name, one, paired, theta, start, picked) for name, one in changes.items()}
    at = theta if found.kept is None else theta[found.kept]
    names, sd = problem.names[: problem.n_structural], _frequency_sd(problem, frequency_sd, len(picked))
    design = Design(names, scale, found, there, picked, sd, shape_sd, target_of(target, problem, at, scale))
    limits = there.limits(sensors, np.inf if budget is None else budget, places, min_distance)
    readings = design.readings(frequency_sd=np.sqrt(sd**2 + drift**2))
    with phase("choosing sensors"):
        usual = _usual_choices(design, limits, energy)
        relaxed = relax(readings, limits)
        rounded = [int(k) for k in np.argsort(-relaxed.weights, kind="stable")]
        most = choose(readings, limits, [usual[INDEPENDENCE], rounded])
        assert most is not None  # for the type checker: every choice is accepted

        @cache
        def pairing_of(chosen: tuple[int, ...]) -> Pairing:
            return check_pairing(design, there.rows([*limits.mounted, *chosen]), np.random.default_rng(seed))

        def can_pair(chosen: Sequence[int]) -> bool:
            return pairing_of(tuple(chosen)).ok

        chosen = most if can_pair(most) else choose(readings, limits, [*usual.values(), rounded], can_pair) or most
    every = [*limits.mounted, *chosen]
    rows = {
        name: choice_row(design, readings, [*limits.mounted, *one], pairing_of(one))
        for name, one in {PLANNED: chosen, **({} if chosen == most else {MOST: most}), **usual}.items()
    }
    return Plan(
        problem=problem,
        design=design,
        limits=limits,
        chosen=chosen,
        usual=usual,
        places=places,
        information=readings.value_of(every),
        bound=max(relaxed.bound, readings.value_of(every)),
        curve=information_curve(readings, limits, chosen),
        choices=data_frame(list(rows.values()), "choice", list(rows)),
        modes=mode_table(design, every, [str(i + 1) for i in picked]),
        repeats=repeat_table(design, every, drift),
        second_tests=change_table(design, every, second, drift) if second else None,
        pairing=pairing_of(chosen),
        drift=drift,
    )


def _draws(
    problem: UpdatingProblem, trace: xr.DataTree | None, n: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return draws of the parameters (n, p) from prior or posterior, and L with LLᵀ their covariance."""
    p = problem.n_structural
    if trace is None:
        return problem.sample_prior(rng, n)[:, :p], np.diag([truncated_sd(one) for one in problem.parameters[:p]])
    check_trace(trace)
    if parameter_names(trace)[:p] != problem.names[:p]:
        raise ArgumentError("trace", f"must be of the parameters {problem.names[:p]}", parameter_names(trace))
    every = parameter_draws(trace)[..., :p].reshape(-1, p)
    covariance = np.atleast_2d(np.cov(every.T))
    return every[rng.choice(len(every), n, replace=len(every) < n)], np.linalg.cholesky(covariance)


def _modes(problem: UpdatingProblem, modes: int | Sequence[int] | None) -> int | tuple[int, ...]:
    """Return the number of modes, or their indices from 0, ascending."""
    if modes is None or isinstance(modes, int):
        return problem.data.n_modes if modes is None else modes
    found = tuple(sorted(int(i) - 1 for i in modes))
    if not found or len(set(found)) < len(found):
        raise ArgumentError("modes", "must be distinct numbers of modes, at least one", modes)
    return found


def _moving(there: Candidates, shapes: FloatArray, are_named: bool) -> Candidates:
    """Return the candidates without those that no mode moves; ValueError for one that the user has named."""
    largest = np.max(np.abs(shapes), axis=0)
    still = ~np.any(np.abs(shapes) > UNSEEN * largest, axis=1)
    for k, rows in enumerate(there.groups):
        if still[rows[rows >= 0]].all() and (are_named or k in there.mounted):
            key = "mounted" if k in there.mounted else "candidates"
            sensor = repr(list(there.sensors[rows[0]]))
            raise ArgumentError(key, "must be moved by a mode to be measured, not as", sensor, "; remove it")
    if not still.any():
        return there
    lost, mounted = {there.sensors[row] for row in np.flatnonzero(still)}, there.rows(there.mounted)
    free = [sensor for row, sensor in enumerate(there.sensors) if sensor not in lost and row not in mounted]
    fixed = [there.sensors[row] for row in mounted if there.sensors[row] not in lost]
    costs = {there.sensors[rows[0]][0]: cost for rows, cost in zip(there.groups, there.cost, strict=True)}
    kept = {place: cost for place, cost in costs.items() if any(place == one for one, _ in (*free, *fixed))}
    return group_candidates(free, fixed, (), there.groups.shape[1] > 1, kept)


def _own_candidates(
    problem: UpdatingProblem,
    candidates: Sequence[Dof] | None,
    mounted: Sequence[Dof],
    exclude: Collection[Any],
    triaxial: bool,
    costs: Mapping[Any, float],
) -> Candidates:
    """Return the candidates of a model without matrices: sensors of the problem's data."""
    own = problem.data.sensors
    if not (problem.model.gives_shapes and own):
        rule = "must give shapes at the sensors of its data, which are the candidates of a model without matrices"
        raise ArgumentError("problem", rule, problem.model.name)
    require_sensors(candidates, mounted, lambda one: tuple(one) in own, "must be a sensor of the problem's data")
    require_places({place for place, _ in own}, exclude, costs)
    return group_candidates(own if candidates is None else candidates, mounted, exclude, triaxial, costs)


def _of_own_model(
    problem: UpdatingProblem, theta: FloatArray, there: Candidates, picked: tuple[int, ...]
) -> Sensitivities:
    """Return the sensitivities of a model without matrices, at the candidates."""
    if max(picked) >= problem.data.n_modes:
        raise ArgumentError("modes", f"must be at most {problem.data.n_modes}, as in the data", max(picked) + 1)
    found = of_model(problem, theta)
    rows = [problem.data.sensors.index(sensor) for sensor in there.sensors]
    for i in picked:
        if not np.any(found.nominal.shapes[0][rows, i]):
            rule = f"must include a place and a direction in which mode {i + 1} moves"
            raise ArgumentError("candidates", rule, "none")
    _moving(there, found.nominal.shapes[0][rows][:, list(picked)], are_named=True)
    seen, nominal = found.seen, found.nominal
    assert seen.shape_slopes is not None  # for the type checker: derivatives were requested
    return replace(
        found,
        seen=replace(seen, shapes=seen.shapes[:, rows], shape_slopes=seen.shape_slopes[:, rows]),
        nominal=replace(nominal, shapes=nominal.shapes[:, rows]),
    )


def _of_change(
    name: str,
    change: Change,
    paired: PairedStructure,
    theta: FloatArray,
    start: FloatArray,
    picked: tuple[int, ...],
) -> tuple[Sensitivities, tuple[int, ...]]:
    """Return the sensitivities of the changed structure at the same candidates, and its modes to be measured.

    These are the modes most like those of the unchanged structure, by MAC at the candidates.
    """
    before = paired.observed(start[None]).shapes[0][:, list(picked)]
    try:
        changed = changed_model(paired.structure, change.masses, change.springs)
        found = of_structure(paired_with_itself(changed, start, paired.sensors, max(picked) + 1), theta, start)
    except ValueError as error:
        raise ArgumentError.of(error).under(f"changes.{name}") from None
    return found, tuple(int(i) for i in assign(np.nan_to_num(mac(found.nominal.shapes[0], before))[None])[0])


def kinetic_energies(paired: PairedStructure, start: FloatArray, modes: Sequence[int]) -> FloatArray:
    """Return φ_q (Mφ)_q summed over some modes at the start, at each sensor, shape (rows,)."""
    phi = paired.shapes(start)[:, list(modes)]
    rows = paired.structure.observation(paired.sensors)
    return np.asarray(np.sum((rows @ phi) * (rows @ (paired.structure.M(start) @ phi)), axis=1))


def _frequency_sd(problem: UpdatingProblem, given: ArrayLike | None, n_modes: int) -> FloatArray:
    """Return the relative standard deviations of the frequencies, (n_modes,)."""
    if given is not None:
        try:
            return np.broadcast_to(np.asarray(given, dtype=float), (n_modes,)).copy()
        except ValueError:
            rule = f"must be a number or {n_modes} numbers, one per mode"
            raise ArgumentError("frequency_sd", rule, np.shape(given)) from None
    data = problem.data
    if data.sd_hz is None or data.n_modes != n_modes:
        return np.full(n_modes, FREQUENCY_SD)
    return np.asarray(data.sd_hz) / np.asarray(data.frequencies_hz)


def _usual_choices(design: Design, limits: Limits, energy: FloatArray | None) -> dict[str, tuple[int, ...]]:
    """Return a dict of the choices by the customary rules, by name."""
    shapes, groups = design.found.nominal.shapes[0][:, list(design.modes)], design.candidates.groups
    found = {
        INDEPENDENCE: baselines.effective_independence(shapes, groups, limits),
        "smallest AutoMAC": baselines.smallest_auto_mac(shapes, groups, limits),
    }
    if energy is not None:
        found["kinetic energy"] = baselines.kinetic_energy(energy, groups, limits)
    return found
