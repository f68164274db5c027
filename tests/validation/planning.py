"""Plans of modal tests: choices of sensors against bounds and searches, and expected against real accuracy.

    python -m tests.validation.planning OUT [--kept DIRECTORY] [--minutes M] [--tests N]

Writes ``planning.md``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np

import fmu
from fmu.analysis.plan.options import AGAIN
from fmu.analysis.plan.result import Plan
from fmu.analysis.plan.sensors.bound import relax
from fmu.analysis.plan.sensors.choice import exchange, greedy
from fmu.numbers import significant
from tests.shear_building import shear_building
from tests.validation.kept import Units, study_parser
from tests.validation.planned_accuracy import INDEPENDENCE, Accuracy, accuracies, accuracy_page, quantiles
from tests.validation.planned_damage import LOSSES, Decided, decided, decision_page, means
from tests.validation.planned_structures import frame_problem, grid, problem_of, translations
from tests.validation.scale_model import Size
from tests.validation.sections import write_sections

_RANDOM = 200


def random_best(plan: Plan, count: int, n: int = _RANDOM) -> tuple[float, float]:
    """Return the largest and the median log-determinant of `n` random choices of `count` sensors."""
    readings, rng = plan.design.readings(), np.random.default_rng(0)
    total = len(plan.design.candidates.groups)
    every = [2.0 * readings.value_of(rng.choice(total, count, replace=False)) for _ in range(n)]
    return max(every), float(np.median(every))


def medium() -> str:
    """Return the section on a frame of about 1000 DOF."""
    problem = frame_problem(Size(28, 3, 2), 10, 6)
    there = translations(problem)
    began = time.process_time()
    plan = fmu.plan(problem, 12, candidates=there)
    whole = time.process_time() - began
    readings, limits = plan.design.readings(), plan.limits
    began = time.process_time()
    chosen = exchange(readings, limits, greedy(readings, limits))
    search = time.process_time() - began
    began = time.process_time()
    again = fmu.plan(problem, 1, candidates=there)
    jacobians = time.process_time() - began
    best, median = random_best(plan, 12)
    free = 2.0 * readings.value_of(chosen)
    independent = 2.0 * float(plan.choices.loc[INDEPENDENCE, "information"])
    paired, bound = 2.0 * plan.information, 2.0 * plan.bound
    assert again.design.found.certificate is not None
    return f"""## A regular frame of 1008 DOF

The frame has 10 moduli (prior standard deviation 7 %). The test measures 6 modes, frequencies to 0.5 % and
shapes to 2 %, in 12 of {len(there)} directions; the plan averages over 32 draws from the prior. The table gives
the log-determinant of the posterior precision relative to the prior precision. The plan also requires that its
sensors can pair the modes by MAC; the choice by greedy search and exchange does not.

| choice | log-determinant |
| :-- | --: |
| greedy search and exchange | {free:.3f} |
| this plan | {paired:.3f} |
| effective independence | {independent:.3f} |
| best of {_RANDOM} random choices | {best:.3f} |
| median of these random choices | {median:.3f} |
| upper bound for any choice | {bound:.3f} |

Greedy search and exchange exceed effective independence by {free - independent:.2f} and the best random choice
by {free - best:.2f}; the plan exceeds them by {paired - independent:.2f} and {paired - best:.2f}. The relative
distance to the bound is {100 * (1 - free / bound):.2f} % for greedy search and exchange, and
{100 * plan.gap:.2f} % for the plan. Greedy search and exchange take {search:.1f} s of processor time. A plan of
one sensor, nearly all of which is training and derivatives, takes {jacobians:.1f} s; the plan of 12 sensors with
bound, pairing and tables takes {whole:.1f} s.
"""


def exhaustive(n: int = 50) -> str:
    """Return the section on exhaustive searches in random structures."""
    missed, gaps, below = [], [], 0
    for seed in range(n):
        plan = fmu.plan(problem_of(grid(seed), 0.15), 4, draws=8, seed=seed)
        readings = plan.design.readings()
        best = max(readings.value_of(one) for one in combinations(range(12), 4))
        found = readings.value_of(exchange(readings, plan.limits, greedy(readings, plan.limits)))
        missed.append((best - found) / best)
        bound = relax(readings, plan.limits).bound
        gaps.append(bound / best - 1.0)
        below += bound < best - 1e-9
    off = np.array(missed)
    return f"""## Exhaustive search of 4 sensors among 12 candidates

All 495 choices are compared in {n} random nets of springs. Greedy search with exchange finds the best choice in
{int(np.sum(off < 1e-9))} of {n} structures, and misses at most {100 * off.max():.2f} % of the information. The
upper bound is below the best choice in {below} structures; it exceeds the best choice by
{100 * float(np.median(gaps)):.2f} % in the median and by {100 * float(np.max(gaps)):.2f} % at most.
"""


def known_mass() -> str:
    """Return the section on a structure whose stiffness and mass one test cannot separate."""
    model = shear_building(["k", "k"], 1e6, 1000.0, "m")
    problem = problem_of(model, 0.1, n_modes=2)
    changes = {
        f"{kg} kg on floor {i + 1}": fmu.Change(masses={i: float(kg)}) for i in range(2) for kg in (100, 400)
    }
    plan = fmu.plan(problem, 2, changes=changes)
    table = plan.second_tests
    assert table is not None
    best = str(table.index[0])
    before = plan.parameters()
    truth = np.array([1.08, 0.93])
    sds = {}
    for name, change in {AGAIN: fmu.Change(), best: changes.get(best, fmu.Change())}.items():
        rng = np.random.default_rng(5)
        tests = [
            fmu.Test("first", _measured(model, truth, rng)),
            fmu.Test("second", _measured(model, truth, rng, change), masses=change.masses),
        ]
        joint = fmu.JointProblem(model, tests, list(problem.parameters), error=[fmu.FrequencyErrors("absolute")])
        trace = fmu.sample(joint, draws=300, warmup=300, progress=False)
        posterior = trace["posterior"].to_dataset()
        sds[name] = [float(posterior[key].std()) for key in ("p1", "p2")]
    rows = "\n".join(f"| {i} | {r.gain:.3f} | {r.median_sd:.2f} |" for i, r in table.iterrows())
    return f"""## Stiffness and mass that one test cannot separate

A building of two storeys has one factor on both stiffnesses and one on both masses (prior standard deviation 10
%). One test reduces the larger standard deviation only to
{100 * float((before["after"] / before["before"]).max()):.0f} % of the prior's. The table compares possible
second tests, with a known mass on one floor or without.

| second test | information gain, nats | median standard deviation after both tests / prior |
| :-- | --: | --: |
{rows}

The plan recommends {best}. Two tests are simulated (true factors 1.08 and 0.93), and both factors are updated with
their frequencies. The standard deviations of the stiffness and of the mass are {sds[best][0]:.4f} and
{sds[best][1]:.4f} with {best}, and {sds[AGAIN][0]:.4f} and {sds[AGAIN][1]:.4f} with {AGAIN}.
"""


def _measured(
    model: fmu.SeparableModel, truth: np.ndarray, rng: np.random.Generator, change: fmu.Change | None = None
) -> fmu.ModalData:
    from fmu.fem.modes.changes import changed_model
    from tests.shear_building import frequencies_hz

    f = frequencies_hz(changed_model(model, (change or fmu.Change()).masses), truth)[0]
    return fmu.ModalData(f * (1.0 + 0.005 * rng.standard_normal(2)), sd_hz=0.005 * f)


def large() -> str:
    """Return the section on a frame of 10 080 DOF."""
    problem = frame_problem(Size(70, 6, 4), 10, 10)
    there = translations(problem, 1000)
    began, clock = time.process_time(), time.perf_counter()
    plan = fmu.plan(problem, 20, candidates=there)
    seconds, clock = time.process_time() - began, time.perf_counter() - clock
    certificate = plan.design.found.certificate
    assert certificate is not None
    return f"""## A frame of 10 080 DOF

The plan has 10 moduli, 32 draws, {len(there)} candidate directions, 20 sensors and 10 modes. It takes
{seconds:.0f} s of processor time ({clock:.0f} s of wall time), including a reduced basis of {certificate.size}
vectors. At {certificate.draws} draws, the reduced shapes at the candidates differ from the full model by at most
{significant(certificate.shape, 2)} of their largest component, and the frequencies by at most
{significant(certificate.frequency, 2)}, relative. The information of the plan is within {100 * plan.gap:.2f} %
of the best possible choice.
"""


def head(found: Sequence[Accuracy], made: Sequence[Decided], minutes: float) -> str:
    """Return the first lines: the question, the verdict and the method."""
    low, middle, high = quantiles(found)
    words = []
    for loss, true in LOSSES.items():
        _, expected, real = (values.mean() for values in means(made, loss))
        when = f"with a loss of {100 * true:.0f} %" if true else "without damage"
        words.append(f"{100 * real:.1f} % {when} (expected: {100 * expected:.1f} %)")
    return f"""# Plans of modal tests

How close are planned modal tests to the best possible ones, and do updates reach the expected accuracy? **The
posterior standard deviation after a test is {middle:.2f} times the expected one in the median, and 90 % of the
ratios are between {low:.2f} and {high:.2f}. The mean probability of damage after an update is
{" and ".join(words)}.** Sensor positions are compared with upper bounds, random choices and exhaustive searches.
All tests are simulated. The study took {minutes:.0f} minutes of processor time.
"""


SECTIONS: dict[str, Callable[[], str]] = {
    "medium": medium,
    "exhaustive": exhaustive,
    "known mass": known_mass,
    "large": large,
}


def main() -> int:
    """Write planning.md."""
    parser = study_parser(__doc__)
    parser.add_argument("--tests", type=int, default=20, help="simulated tests of each structure")
    asked = parser.parse_args()
    units = Units(asked.kept, asked.minutes)
    parts = write_sections(SECTIONS, units)
    made, found = decided(4 * asked.tests, units), accuracies(asked.tests, units)
    first = head(found, made, units.processor_s / 60.0)
    parts = [first, *parts, decision_page(made, 4 * asked.tests), accuracy_page(found, asked.tests)]
    (asked.out / "planning.md").write_text("\n".join(parts), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
