"""Expected against real accuracy of plans: simulated tests of five structures, each really updated."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import fmu
from fmu.analysis.plan.result import PLANNED
from fmu.sampling.simulated_updates import REASONS
from tests.shear_building import shear_building
from tests.validation.kept import Units, fields_of
from tests.validation.planned_structures import beam, grid, problem_of

INDEPENDENCE = "effective independence"


def structures() -> dict[str, tuple[Callable[[], fmu.UpdatingProblem], int]]:
    """Return five structures by name, and how many sensors each gets."""
    storeys = ["p1"] * 2 + ["p2"] * 2 + ["p3"] * 2 + ["p4"] * 2
    return {
        "shear building, 8 storeys": (lambda: problem_of(shear_building(storeys, 5e6, 2000.0), 0.15), 4),
        "shear building with an unknown mass": (
            lambda: problem_of(shear_building(storeys[:6], 5e6, 2000.0, "m"), 0.1),
            3,
        ),
        "cantilever": (lambda: problem_of(beam(), 0.1), 4),
        "net of springs": (lambda: problem_of(grid(3, 16, 4), 0.15, n_modes=5), 5),
        "net of springs, larger": (lambda: problem_of(grid(8, 20, 5), 0.2, n_modes=6), 6),
    }


@dataclass
class Accuracy:
    """Simulated tests of one structure: real over expected sds, and over sds linearised at the true parameters."""

    name: str
    tests: int
    ratios: list[list[float]]
    at_truth: list[list[float]]
    cases: list[list[object]]
    by_sensors: dict[str, float]
    converged: dict[str, int]
    seconds: float


def simulate(name: str, tests: int) -> Accuracy:
    """Return the simulated tests of a structure."""
    build, count = structures()[name]
    began = time.process_time()
    plan = fmu.plan(build(), count)
    found = fmu.simulate_plan(plan, tests, choices=[INDEPENDENCE])
    unit = plan.design.prior_sd
    print(name, found, found.cases().to_string(), sep="\n", flush=True)
    return Accuracy(
        name,
        tests,
        found.ratios().tolist(),
        (found.updates[PLANNED].real / found.updates[PLANNED].at_truth).tolist(),
        found.cases().to_numpy().tolist(),
        {choice: float(np.median(one.real / unit)) for choice, one in found.updates.items()},
        {choice: int(one.converged.sum()) for choice, one in found.updates.items()},
        time.process_time() - began,
    )


def accuracy(tests: int, units: Units) -> str:
    """Return the section on simulated tests of five structures."""
    keyed = (((name, tests), name) for name in structures())
    found = units.completed("structures", keyed, lambda name: simulate(name, tests), fields_of(Accuracy, list))
    every = np.concatenate([np.ravel(one.ratios) for one in found])
    low, middle, high = np.quantile(every, [0.05, 0.5, 0.95])
    own = np.quantile(np.concatenate([np.ravel(one.at_truth) for one in found]), [0.05, 0.5, 0.95])
    better = sum(one.by_sensors[PLANNED] < one.by_sensors[INDEPENDENCE] for one in found)
    converged = sum(sum(one.converged.values()) for one in found)
    rows, cases = [], []
    for one in found:
        a, b, c = np.quantile(one.ratios, [0.05, 0.5, 0.95])
        mine, other = one.by_sensors[PLANNED], one.by_sensors[INDEPENDENCE]
        rows.append(f"| {one.name} | {b:.2f} | {a:.2f}–{c:.2f} | {mine:.3f} | {other:.3f} |")
        for test, parameter, ratio, truth, noise, shape, bounds, skewness, crossed, reason in one.cases:
            factors = f"{ratio:.2f} | {truth:.2f} | {noise:.2f} | {shape:.2f}"
            shares = f"{100 * bounds:.0f} % | {skewness:.1f} | {100 * crossed:.0f} %"
            cases.append(f"| {one.name}, {test} | {parameter} | {factors} | {shares} | {reason} |")
    reasons = [str(case[-1]) for one in found for case in one.cases]
    counts = "\n".join(
        f"- {reason}: {reasons.count(reason)} of {len(reasons)}. There {why}."
        for reason, why in REASONS.items()
        if reason in reasons
    )
    return f"""## Expected against real standard deviations

{tests} simulated tests of each of five structures with either of two choices of sensors, really updated
(`fmu.sample`, four chains of the mixture until 400 effective draws): {converged} of {2 * tests * len(found)}
updates converged. Real over expected standard deviation of the plans: median {middle:.2f}, 90 % between {low:.2f}
and {high:.2f}, over {tests * len(found)} tests. {sum(one.seconds for one in found) / 60:.0f} minutes of one core.

| structure | real / expected | 90 % | median real sd, this plan | effective independence |
| :-- | --: | --: | --: | --: |
{chr(10).join(rows)}

Sds are relative to those before the test. At the same number of sensors the plan's is the smaller one in {better}
of {len(found)} structures.

### Why single tests differ from the expectation

In {len(reasons)} of {every.size} cases, a parameter in a test, the ratio is outside 0.7 to 1.4. It is a product
of three factors:

- *true values*: the sd linearised at the true parameters over the expected one, which is a mean over 32 draws;
- *noise*: the sd linearised at the posterior mean over that;
- *shape*: the real sd over that, which is 1 of a Gaussian posterior.

The factor furthest from 1 names the reason. If it is the shape, the reason is the bounds or the order of the
modes, if more than 5 % of the draws are within 2 % of a bound or have the modes in another order. Reasons:

{counts}

Over all {every.size} cases the real sd is {own[1]:.2f} times the one linearised at the true parameters (median),
90 % between {own[0]:.2f} and {own[2]:.2f}: the ratios spread with the place, which the plan cannot know.

| structure, test | parameter | ratio | true values | noise | shape | at bounds | skewness | crossed | reason |
| :-- | :-- | --: | --: | --: | --: | --: | --: | --: | :-- |
{chr(10).join(cases)}
"""
