"""Update with simulated tests of a plan, to show how accurate the plan's linearised prediction is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmu.analysis.plan.result import PLANNED, Plan
from fmu.arguments import ArgumentError, Count, Draws, Seed, check_arguments
from fmu.fem.pairing.modal_model import ModalModel, PartialModel
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.reduced.anchors import SingularAnchorError
from fmu.fem.reduced.reduced_structure import ReducedStructure, train
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.errors.frequency import FrequencyErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.reduction.region import training_box
from fmu.progress.phases import phase
from fmu.sampling import sample
from fmu.sampling.simulated_updates import SimulatedTests, Updates, summarise_update
from fmu.types import FloatArray

ENOUGH = 400.0
"""ESS of every parameter at which an update ends."""
_MOST = 20  # largest number of draws per chain, divided by `draws`


@check_arguments
def simulate_plan(
    plan: Plan,
    tests: Count = 20,
    *,
    choices: Sequence[str] | None = None,
    draws: Draws = 200,
    seed: Seed = 1,
) -> SimulatedTests:
    """Simulate tests as planned, update with each, and compare the real accuracy with the expected accuracy.

    A test consists of the model's frequencies and mode shapes at a draw from the prior, with random errors. The
    update pairs modes as in the plan. If the model has matrices, the update uses a reduced model where possible.

    Parameters
    ----------
    plan : Plan
        A result of `fmu.plan` for a problem with one test, without a discrepancy, a trace or a decision about
        damage.
    tests : int
        Number of simulated tests for each choice of sensors. All choices use the same parameters and random
        numbers.
    choices : sequence of str, optional
        Customary choices to compare with the plan: keys of ``plan.usual``. Defaults to effective independence and
        the smallest AutoMAC.
    draws : int
        Number of draws in each of four chains, and of warm-up steps before them. Sampling continues until the run
        has converged and every parameter has an ESS of 400, up to twenty times as many draws.
    seed : int
        Seed of the tests and of the sampling.

    Returns
    -------
    SimulatedTests

    Raises
    ------
    ValueError
        If a choice is unknown, the model has a discrepancy, which the simulated tests would lack, or the plan does
        not start from the prior of a single test with all parameters updated.
    """
    if plan.problem.likelihood.has_discrepancy:
        rule = "must be of a model without a discrepancy to simulate tests, which would lack it"
        raise ArgumentError("plan", rule, "a plan of a model with a discrepancy")
    if not plan.before.is_prior:
        rule = "must start from the prior of a problem of one test, all parameters updated, to simulate tests"
        raise ArgumentError("plan", rule, "a plan after earlier tests, of damage, or with updated = false")
    known = {PLANNED: plan.chosen, **plan.usual}
    names = list(known)[:3] if choices is None else list(dict.fromkeys((PLANNED, *choices)))
    unknown = next((name for name in names if name not in known), None)
    if unknown is not None:
        raise ArgumentError("choices", f"must be of {', '.join(known)}", repr(unknown))
    expected, updates = {}, {}
    readings = plan.design.readings(frequency_sd=plan.frequency_sd)
    with phase("simulated tests", len(names) * tests) as under_way:
        for name in names:
            every = [*plan.limits.mounted, *known[name]]
            expected[name] = plan.design.sd_of(readings.with_sensors(every))
            model, found = model_of(plan, every), []
            for k in range(tests):
                rng = np.random.default_rng([seed, k])
                truth = plan.problem.sample_prior(rng, 1)[0, : plan.problem.n_structural]
                problem = simulated_problem(plan, model, every, rng, truth)
                trace = sample(
                    problem,
                    draws=draws,
                    warmup=draws,
                    seed=seed,
                    until_ess=ENOUGH,
                    max_draws=_MOST * draws,
                    progress=False,
                )
                found.append(summarise_update(problem, trace, truth, plan.design.scale))
                under_way.advance()
            updates[name] = Updates.of(found)
    return SimulatedTests(plan.design.names, expected, updates)


def model_of(plan: Plan, every: Sequence[int]) -> ModalModel:
    """Return the plan's model for updating, with only the measured modes and the sensors of a choice.

    `every` contains the indices of the chosen candidates, including those that are already mounted.
    """
    there, whole = plan.design.candidates, plan.design.found.model
    rows = there.rows(every)
    if isinstance(whole, ReducedStructure | PairedStructure):
        whole = _reduce(plan, whole)
        whole = whole.seen_by(tuple(there.sensors[row] for row in rows))
        return PartialModel(whole, plan.design.modes, range(len(rows)))
    own = [plan.before.data.sensors.index(there.sensors[row]) for row in rows]
    return PartialModel(whole, plan.design.modes, own)


def _reduce(plan: Plan, whole: ReducedStructure | PairedStructure) -> ReducedStructure | PairedStructure:
    """Return the plan's model with a reduced basis for the parameter box that `training_box` gives.

    A reduced model keeps its basis, and its box is enlarged. For any other model a new basis is trained. The full
    model is returned if a basis would save little, or if a displacement has neither stiffness nor mass at a bound.
    """
    lower, upper = training_box(plan.problem.parameters[: whole.n_parameters])
    if isinstance(whole, ReducedStructure):
        return whole.extend(lower, upper)
    try:
        return train(whole, lower, upper)[0]
    except SingularAnchorError:  # a displacement has neither stiffness nor mass at a bound
        return whole


def simulated_problem(
    plan: Plan, model: ModalModel, every: Sequence[int], rng: np.random.Generator, theta: FloatArray
) -> UpdatingProblem:
    """Return the updating problem for one simulated test.

    Parameters
    ----------
    plan : Plan
    model : ModalModel
        Result of `model_of` for the same choice.
    every : sequence of int
        Indices of the candidates that the test uses, including those that are already mounted.
    rng : Generator
    theta : ndarray, shape (p,)
        True parameters.
    """
    problem, design, sd = plan.problem, plan.design, plan.frequency_sd
    p = problem.n_structural
    seen = model.observed(theta[None])
    f = seen.frequencies[0] * (1.0 + sd * rng.standard_normal(len(sd)))
    # a component's error is a share of the shape's largest component at all candidates
    largest = np.median(design.largest[:, 0, list(design.modes)], axis=0)
    off = design.shape_sd * largest * rng.standard_normal((len(design.candidates.sensors), len(sd)))
    shapes = seen.shapes[0] + off[design.candidates.rows(every)]
    shapes_sd = design.shape_sd * largest / np.linalg.norm(shapes, axis=0)
    data = ModalData(
        f,
        sensors=tuple(design.candidates.sensors[row] for row in design.candidates.rows(every)),
        shapes=shapes,
        sd_hz=sd * f,
        shapes_sd=np.broadcast_to(shapes_sd, shapes.shape),
    )
    errors: list[ErrorModel] = [FrequencyErrors("absolute"), ShapeErrors()]
    return UpdatingProblem(model, data, problem.parameters[:p], error=errors, name=f"{problem.name}, simulated")
