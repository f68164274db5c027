"""What plans of modal tests are worth: choices against bounds and searches, and expected against real accuracy.

    python -m tests.validation.planning OUT [--kept DIRECTORY] [--minutes M] [--tests N]

Writes ``planning.md``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from itertools import combinations

import numpy as np

import fmu
from fmu.analysis.plan.options import AGAIN
from fmu.analysis.plan.result import Plan
from fmu.analysis.plan.sensors.bound import relax
from fmu.analysis.plan.sensors.choice import exchange, greedy
from tests.shear_building import shear_building
from tests.validation.kept import Units, study_parser
from tests.validation.planned_accuracy import INDEPENDENCE, accuracy
from tests.validation.planned_damage import decisions
from tests.validation.planned_structures import frame_problem, grid, problem_of, translations
from tests.validation.scale_model import Size
from tests.validation.sections import write_sections

_RANDOM = 200


def random_best(plan: Plan, count: int, n: int = _RANDOM) -> tuple[float, float]:
    """Return the largest and the median log-determinant of random choices."""
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

10 moduli (prior sd 7 %), 6 modes (frequencies to 0.5 %, shapes to 2 %), 12 of {len(there)} directions, 32 draws.
Log-determinant of the posterior precision, in units of the prior's.

| choice | log-determinant |
| :-- | --: |
| greedy and exchange | {free:.3f} |
| this plan, whose modes can be paired by MAC | {paired:.3f} |
| effective independence | {independent:.3f} |
| best of {_RANDOM} random choices | {best:.3f} |
| their median | {median:.3f} |
| upper bound | {bound:.3f} |

Greedy and exchange exceed effective independence by {free - independent:.2f} and the best random choice by
{free - best:.2f}; the plan by {paired - independent:.2f} and {paired - best:.2f}. The gap to the bound is
{100 * (1 - free / bound):.2f} % for greedy and exchange, {100 * plan.gap:.2f} % for the plan. Seconds of one core:
greedy and exchange {search:.1f}; a plan of one sensor, which is nearly all reduced basis and Jacobians,
{jacobians:.1f}; `fmu.plan` with bound, pairing and tables {whole:.1f}.
"""


def exhaustive(n: int = 50) -> str:
    """Return the section on an exhaustive search in random structures."""
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
    return f"""## Exhaustive search: 12 candidates, choose 4, {n} random nets of springs

Greedy with exchange finds the best of the 495 choices in {int(np.sum(off < 1e-9))} of {n} structures,
and misses at most {100 * off.max():.2f} % of the information. The bound is below the best in {below}
structures; it exceeds the best by
{100 * float(np.median(gaps)):.2f} % (median), {100 * float(np.max(gaps)):.2f} % at most.
"""


def known_mass() -> str:
    """Return the section on a structure whose stiffness and mass cannot be told apart."""
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
    return f"""## Stiffness and mass that cannot be told apart

Two storeys, one factor on both stiffnesses and one on both masses (prior sd 10 %). One test leaves
{100 * float((before["after"] / before["before"]).max()):.0f} % of the prior's standard deviation.

| second test | gain, nats | median sd after both / before |
| :-- | --: | --: |
{rows}

The plan proposes: {best}. Updates with the frequencies of two simulated tests (true factors 1.08 and 0.93): after
{AGAIN} the sds are {sds[AGAIN][0]:.4f} (k) and {sds[AGAIN][1]:.4f} (m), with {best} {sds[best][0]:.4f} and
{sds[best][1]:.4f}; before the tests 0.1.
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
    return f"""## 10 080 DOF

10 moduli, 32 draws, {len(there)} candidate directions, 20 sensors, 10 modes: {seconds:.0f} s of one core
({clock:.0f} s by the clock beside other work), reduced basis of {certificate.size} vectors included. At
{certificate.draws} draws its shapes at the candidates differ from the full model's by at most
{certificate.shape:.1e} of their largest component, its frequencies by {certificate.frequency:.1e}.
The plan is within {100 * plan.gap:.2f} % of the best.
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
    parts += [decisions(4 * asked.tests, units), accuracy(asked.tests, units)]
    head = (
        "# Plans of modal tests\n\n"
        "Written by `make validate` (`python -m tests.validation.planning results`), in "
        f"{units.processor_s / 60.0:.0f} minutes of one core.\n"
    )
    (asked.out / "planning.md").write_text("\n".join([head, *parts]), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
