"""Expected against real accuracy of plans: tests of five structures are simulated and updated."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

import fmu
from fmu.analysis.plan.result import PLANNED
from fmu.numbers import fixed
from fmu.sampling.simulated_updates import REASONS
from tests.shear_building import shear_building
from tests.validation.kept import Units, fields_of
from tests.validation.planned_structures import beam, grid, problem_of

INDEPENDENCE = "effective independence"


def structures() -> dict[str, tuple[Callable[[], fmu.UpdatingProblem], int]]:
    """Return five structures by name, each with its number of sensors."""
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
    """Simulated tests of one structure.

    Attributes
    ----------
    name : str
    tests : int
    ratios : list of list of float
        Real / expected standard deviation, by test and parameter.
    at_truth : list of list of float
        Real standard deviation / the one linearised at the true parameters.
    cases : list of list
        Rows of the table of cases whose ratio is far from 1.
    by_sensors : dict of str to float
        Median real standard deviation / that of the prior, for each choice of sensors.
    converged : dict of str to int
        Number of runs that converged, for each choice of sensors.
    seconds : float
        Processor time.
    """

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


def accuracies(tests: int, units: Units) -> list[Accuracy]:
    """Return the simulated tests of the structures that are done."""
    keyed = (((name, tests), name) for name in structures())
    return units.completed("structures", keyed, lambda name: simulate(name, tests), fields_of(Accuracy, list))


def quantiles(found: Sequence[Accuracy]) -> tuple[float, float, float]:
    """Return the 5 %, 50 % and 95 % quantiles of real / expected standard deviation over all structures."""
    low, middle, high = np.quantile(np.concatenate([np.ravel(one.ratios) for one in found]), [0.05, 0.5, 0.95])
    return float(low), float(middle), float(high)


def accuracy_page(found: Sequence[Accuracy], tests: int) -> str:
    """Return the section on simulated tests of five structures."""
    (low, middle, high), size = quantiles(found), sum(np.size(one.ratios) for one in found)
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
            shares = f"{100 * bounds:.0f} % | {fixed(skewness, 1)} | {100 * crossed:.0f} %"
            cases.append(f"| {one.name} | {test} | {parameter} | {factors} | {shares} | {reason} |")
    reasons = [str(case[-1]) for one in found for case in one.cases]
    counts = "\n".join(
        f"- {reason} ({reasons.count(reason)} of {len(reasons)}): {why}."
        for reason, why in REASONS.items()
        if reason in reasons
    )
    return f"""## Expected and real standard deviations

{tests} tests of each of five structures are simulated with two choices of sensors, the plan and effective
independence. Each test is updated (`fmu.sample`, four chains of the mixture sampler until 400 effective draws);
{converged} of {2 * tests * len(found)} updates converged. For the plans, the real posterior standard deviation is
{middle:.2f} times the expected one in the median; 90 % of the ratios are between {low:.2f} and {high:.2f}
({tests * len(found)} tests). The last two columns are median real standard deviations relative to the prior. The
section took {sum(one.seconds for one in found) / 60:.0f} minutes of processor time.

| structure | real / expected, median | 90 % of the ratios | plan | effective independence |
| :-- | --: | --: | --: | --: |
{chr(10).join(rows)}

With the same number of sensors, the plan has the smaller standard deviation in {better} of {len(found)}
structures.

### Single tests that differ from the expectation

In {len(reasons)} of {size} cases (a parameter in a test), the ratio is outside 0.7 to 1.4. It is the product of
three factors:

- *true values*: standard deviation linearised at the true parameters / expected one, a mean over 32 prior draws;
- *noise*: standard deviation linearised at the posterior mean / linearised at the true parameters;
- *shape*: real standard deviation / linearised at the posterior mean, 1 for a Gaussian posterior.

The factor furthest from 1 gives the reason. If this is the shape, and more than 5 % of the draws are within 2 %
of a bound or have the modes in another order, the reason is the bounds or the order of the modes. The reasons
are:

{counts}

Over all {size} cases, the real standard deviation is {own[1]:.2f} times the one linearised at the true
parameters in the median; 90 % of these ratios are between {own[0]:.2f} and {own[2]:.2f}. The narrower this
range, the more of the scatter of the ratios comes from the true values, which are unknown when a test is
planned.

*At bounds* and *reordered* are the shares of draws near a bound and with the modes in another order.

| structure | test | parameter | ratio | true values | noise | shape | at bounds | skewness | reordered | reason |
| :-- | --: | :-- | --: | --: | --: | --: | --: | --: | --: | :-- |
{chr(10).join(cases)}
"""
