"""`fmu.plan`, which chooses sensors and compares modes, repeats and structural changes by expected information."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Annotated

import numpy as np
from annotated_types import Ge, Gt, Interval
from numpy.typing import ArrayLike

from fmu.analysis.plan.before import known_before
from fmu.analysis.plan.design import Design
from fmu.analysis.plan.linearised import Wishes, linearise
from fmu.analysis.plan.model_errors import scaled_with_errors, shape_sd_of_model
from fmu.analysis.plan.options import change_table, mode_table, repeat_table
from fmu.analysis.plan.pairing import Pairing, check_pairing
from fmu.analysis.plan.result import PLANNED, Plan, choice_row, information_curve
from fmu.analysis.plan.sensors import baselines
from fmu.analysis.plan.sensors.bound import Relaxed, relax
from fmu.analysis.plan.sensors.choice import Limits, choose
from fmu.analysis.plan.sensors.information import Readings
from fmu.analysis.plan.targets import Decision, Target, damage_in, target_of, without_the_unneeded
from fmu.analysis.trace.densities import is_updating
from fmu.analysis.trace.reading import parameter_draws
from fmu.arguments import ArgumentError, Count, Place, Seed, check_arguments
from fmu.fem.modes.changes import Change
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.slopes import without_shapes
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
    place_names: Mapping[Place, str] | None = None,
    like: str | None = None,
    trace: xr.DataTree | None = None,
    draws: Annotated[int, Interval(ge=2, le=10_000)] = 32,
    seed: Seed = 1,
) -> Plan:
    """Plan a modal test: choose the sensors that reduce the parameter uncertainty most.

    The model is linearised at draws from the prior or, after several tests or with a trace, from the posterior.
    Greedy selection and exchanges maximise the expected information ½ E log det(I + Jᵀ Σ_e⁻¹ J). Here E is the
    mean over the draws, J contains the derivatives of all measured values with respect to the scaled parameters,
    and Σ_e is the diagonal matrix of the variances of the measurement errors. The scales of the mode shapes are
    unknown, which reduces the information (`fmu.analysis.plan.sensors.information`). With a target, only
    information about the target counts. An upper bound from convex relaxation shows how far the plan can be from
    the best choice. Parameter bounds and non-Gaussian posteriors are ignored; `fmu.simulate_plan` compares the
    plan with simulated tests. If the most informative sensors do not allow the modes to be paired by MAC, the plan
    is the most informative choice found that does. If no such choice is found, the plan keeps the most informative
    sensors.

    Parameters
    ----------
    problem : UpdatingProblem
        One test of a structure, or several tests (`fmu.JointProblem`), after which the next test is planned. With
        one test, only the model, its discrepancy, the prior and the frequency errors are used, so the data may
        come from an earlier test or from the model (`fmu.expected_modes`). After several tests, the plan starts
        from their linearised posterior or, with a trace, from a run's posterior, and ignores a discrepancy.
    sensors : int
        Number of sensors to choose, in addition to the mounted ones. With a budget, the largest number.
    candidates : sequence of (place, direction), optional
        Possible sensors. Defaults to every translation of every node or, for a user's function or a surrogate, to
        the sensors of the problem's data.
    triaxial : bool
        Whether one sensor reads all candidate directions at its place.
    mounted : sequence of (place, direction)
        Sensors that stay where they are.
    exclude : sequence of place
        Places where no sensor can be mounted.
    min_distance : float, m
        Smallest distance between two sensors. It requires a model with coordinates.
    costs : mapping of place to float, optional
        Costs of sensors at these places; 1 at all others.
    budget : float, optional
        Largest total cost of the chosen sensors. By default, there is no limit.
    modes : int or sequence of int, optional
        Number of modes to measure, starting from the lowest elastic mode that the candidates see; or the mode
        numbers, from 1, among all elastic modes. For a user's function or a surrogate, modes are counted in the
        order of the data, and the candidates must see each of them. Defaults to the problem's number of modes.
    frequency_sd : float or array_like, shape (n_modes,), optional
        Relative standard deviation of the frequencies in one test. Defaults to the standard deviations of the
        problem's frequency errors, with the scatter of one test if they are of the mean of repeated tests; to
        their median if another number of modes is planned; to 0.005 without frequency errors. Correlations of a
        covariance are ignored.
    shape_sd : float
        Standard deviation of a mode-shape component, relative to the largest component at the candidates.
    drift : float
        Relative standard deviation of the frequencies that repeated tests do not reduce.
    target : str, sequence of str, mapping, callable or DamageTarget, optional
        Purpose of the test, if not all parameters matter equally: parameter names, a combination as weights by
        name, a prediction that maps theta without inferred error parameters, (n, n_structural), to (n,) or (n, t),
        or a decision about damage (`fmu.DamageTarget`).
    changes : mapping of str to Change, optional
        Known structural changes, each for a second test, keyed by name. They require a model with matrices.
    place_names : mapping of place to str, optional
        Names of places in tables and files, for example of numbered nodes.
    like : str, optional
        With several tests, the name of the test that the planned one resembles in its group, masses, springs and
        known parameters. Defaults to the last test. Covariates take their means over the tests, but the time of a
        loss at an unknown date takes its value in the last test.
    trace : DataTree, optional
        A run of the same problem. Its posterior replaces the prior or, after several tests, their linearised
        posterior.
    draws : int
        Number of draws at which the model is linearised, 2 to 10 000.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    Plan

    Raises
    ------
    ValueError
        If `problem` is not an UpdatingProblem, a number is out of range, a sensor or place does not exist, a
        sensor is given twice, there are fewer candidates than sensors, the budget is too small for one sensor, a
        cost is not positive, the candidates do not see a mode, a given or mounted sensor sees none of the modes,
        the modes are not distinct or the model lacks one, the model has no derivatives of the modes at any draw,
        `frequency_sd` has the wrong shape, the model gives no mode shapes, `changes` or `min_distance` is given
        for a model without matrices or coordinates, a change does not suit the structure, `like` is not the name
        of one of several tests, the trace is not a trace or has other parameters, the target names an unknown
        parameter, depends on none, returns values that are not finite or does not suit the problem, a parameter
        has a separate value in each test, or no trace is given where parameters form populations and the model has
        a discrepancy or their values are correlated in time.
    """
    if not is_updating(problem):
        raise ArgumentError("problem", "must be an UpdatingProblem", type(problem).__name__)
    damage = damage_in(target)
    losses = [] if damage is None else damage.parameters(problem)
    before = known_before(problem, trace, like, losses, draws, np.random.default_rng(seed))
    before = without_the_unneeded(before, target)
    wishes = Wishes(candidates, mounted, exclude, triaxial, costs or {}, _modes(before.data, modes), changes or {})
    test = linearise(before, wishes)
    there, at = test.candidates, before.at(test.found.kept)
    rows = target_of(target, at)
    if frequency_sd is None:
        frequency_sd = _frequency_sd(problem, trace, before.test, len(test.modes))
    sd = _per_mode(frequency_sd, len(test.modes))
    scale, scaled = scaled_with_errors(before, test.found.seen, rows)
    design = Design(
        before.parameters, scale, test.found, there, test.modes, sd, shape_sd, scaled, shape_sd_of_model(before)
    )
    limits = there.limits(sensors, np.inf if budget is None else budget, test.places, min_distance)
    readings = design.readings(frequency_sd=np.sqrt(sd**2 + drift**2))

    @cache
    def pairing_of(chosen: tuple[int, ...]) -> Pairing:
        return check_pairing(design, there.rows([*limits.mounted, *chosen]), np.random.default_rng(seed))

    with phase("choosing sensors"):
        usual, relaxed = _usual_choices(design, limits, test.energy), relax(readings, limits)
        most, chosen = _choose(readings, limits, usual, relaxed, lambda one: pairing_of(tuple(one)).ok)
    every = [*limits.mounted, *chosen]
    rows_of = {PLANNED: chosen, **({} if chosen == most else {MOST: most}), **usual}
    decision = Decision.of(target, before)
    choices = [
        choice_row(design, readings, [*limits.mounted, *one], pairing_of(one), decision)
        for one in rows_of.values()
    ]
    return Plan(
        before=before,
        structure=test.structure,
        design=design,
        limits=limits,
        chosen=chosen,
        usual=usual,
        places=test.places,
        place_names=place_names or {},
        information=readings.value_of(every),
        bound=max(relaxed.bound, readings.value_of(every)),
        curve=information_curve(readings, limits, chosen),
        choices=data_frame(choices, "choice", list(rows_of)),
        modes=mode_table(design, every, [str(i + 1) for i in test.modes]),
        repeats=repeat_table(design, every, drift),
        second_tests=change_table(design, every, test.second, drift) if test.second else None,
        pairing=pairing_of(chosen),
        drift=drift,
        decision=decision,
    )


def _choose(
    readings: Readings,
    limits: Limits,
    usual: Mapping[str, tuple[int, ...]],
    relaxed: Relaxed,
    can_pair: Callable[[Sequence[int]], bool],
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the most informative choice found, and the most informative one found that allows pairing by MAC.

    Both are the same if the first allows pairing, or if no choice that was tried allows it.
    """
    rounded = [int(k) for k in np.argsort(-relaxed.weights, kind="stable")]
    most = choose(readings, limits, [usual[INDEPENDENCE], rounded])
    assert most is not None  # for the type checker: every choice is accepted
    if can_pair(most):
        return most, most
    return most, choose(readings, limits, [*usual.values(), rounded], can_pair) or most


def _modes(data: ModalData, modes: int | Sequence[int] | None) -> int | tuple[int, ...]:
    """Return the number of modes, or their 0-based indices in ascending order.

    Raise ValueError unless the mode numbers are distinct and there is at least one.
    """
    if modes is None or isinstance(modes, int):
        return data.n_modes if modes is None else modes
    found = tuple(sorted(int(i) - 1 for i in modes))
    if not found or len(set(found)) < len(found):
        raise ArgumentError("modes", "must be distinct numbers of modes, at least one", modes)
    return found


def _frequency_sd(
    problem: UpdatingProblem, trace: xr.DataTree | None, test: int, n_modes: int
) -> FloatArray | float:
    """Return the relative frequency standard deviations in the test with index `test`, (n_modes,), or one value.

    For a covariance, they are the square roots of its diagonal, because a plan treats errors as independent. For
    Student's errors, they are the standard deviations of Gaussian errors with the same information, σ √((ν + 3)/(ν
    + 1)). Inferred standard deviations have their posterior means or, without a run, their starting values. If
    repeated tests gave the known standard deviations, which are those of their mean, the scatter s of one test
    replaces these (`RepeatedTests.relative_scatter`). If the number of modes in the test differs from `n_modes`,
    the one value returned is the median over its modes. If the problem has no frequency errors in this test, it is
    `FREQUENCY_SD`.
    """
    term, n, used = problem.likelihood.frequency_term, problem.n_structural, problem.likelihood.used
    here = problem.model.test_of_modes == test
    of_frfs = problem.likelihood.responses and used is not None and not np.any(here[used])
    if term is None or of_frfs:  # modes that were picked from FRFs are no data
        return FREQUENCY_SD
    theta = problem.start if trace is None else parameter_draws(trace).mean(axis=(0, 1))
    noise = theta[None, n : n + problem.likelihood.n_noise]
    measured = np.concatenate([one.data.frequencies_hz for one in problem.tests])
    if term.couples_modes:  # a covariance, in Hz²
        every = np.sqrt(term.spread.variance(noise)[0])
    else:
        every = 1.0 / np.asarray(term.residuals(without_shapes(measured[None]), noise).by_frequency)[0, :, 0]
    sd, tests = np.asarray((every / measured)[here]), problem.tests[test].data.tests
    if tests is not None:
        known, (_, sd_hz, covariance) = term.spread.fixed[here], tests.mean()
        of_mean = np.asarray(sd_hz) if covariance is None else np.sqrt(np.diag(covariance))
        root = np.sqrt(np.ones(len(measured)) if term.weights is None else term.weights)[here]
        per_unit = (root, 0.5 * measured[here] * root)  # known sds in Hz, or those of (f/f^m)²
        if any(np.allclose(known * hz, of_mean, rtol=1e-9, atol=0.0) for hz in per_unit):
            more = (tests.relative_scatter() * measured[here] / of_mean) ** 2 - 1.0
            sd = sd * np.sqrt(1.0 + more * known**2 / term.spread.variance(noise)[0, here])
    return sd if len(sd) == n_modes else float(np.median(sd))


def _per_mode(given: ArrayLike, n_modes: int) -> FloatArray:
    """Return the relative standard deviations of the frequencies, (n_modes,).

    Raise ValueError if `given` does not have one value, or one per mode.
    """
    try:
        return np.broadcast_to(np.asarray(given, dtype=float), (n_modes,)).copy()
    except ValueError:
        rule = f"must be a number or {n_modes} numbers, one per mode"
        raise ArgumentError("frequency_sd", rule, np.shape(given)) from None


def _usual_choices(design: Design, limits: Limits, energy: FloatArray | None) -> dict[str, tuple[int, ...]]:
    """Return the choices that the customary rules make within the budget, keyed by rule.

    The rule of kinetic energy requires a model with matrices. The minimum distance is ignored.
    """
    shapes, groups = design.found.nominal.shapes[0][:, list(design.modes)], design.candidates.groups
    rules: dict[str, Callable[[Limits], tuple[int, ...]]] = {
        INDEPENDENCE: lambda limits: baselines.effective_independence(shapes, groups, limits),
        "smallest AutoMAC": lambda limits: baselines.smallest_auto_mac(shapes, groups, limits),
    }
    if energy is not None:
        rules["kinetic energy"] = lambda limits: baselines.kinetic_energy(energy, groups, limits)
    return {name: baselines.within_budget(rule, limits) for name, rule in rules.items()}
