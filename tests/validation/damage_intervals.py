"""Coverage of the damage intervals of the building of notebook 05, over many simulated data sets.

    python -m tests.validation.damage_intervals OUT [--kept DIRECTORY] [--minutes M] [--replicates N] [--seed N]

The building of `notebooks/05-damage.ipynb` is measured on six days. Storey 2 has lost 15 % of its stiffness,
stiffness falls by 0.3 % per °C, and errors are 0.5 % of the frequencies and 0.01 in the shapes. The data sets
differ only in the errors. Each is updated as in the notebook, with the temperature as a covariate, once with a
loss of any size in every storey and once with few losses (`fmu.SpikeAndSlab`). The page is damage-intervals.md.
Exit code 1 if intervals contain the true loss less often than a binomial distribution allows, at 1 in 10 000.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binom
from threadpoolctl import threadpool_limits

import fmu
from fmu.types import FloatArray
from tests.validation.kept import Units, each, fields_of, study_parser
from tests.validation.several_tests import building, modes

REPLICATES, SEED = 100, 20_282
STOREYS = ("k1", "k2", "k3", "k4")
LOST = np.array([0.0, 0.15, 0.0, 0.0])
DAYS = {"before": (2.0, 5.0, 9.0), "after": (21.0, 25.0, 29.0)}
INTERVAL, BEYOND, ALARM, LEVEL = 0.9, 0.05, 0.5, 1e-4
DAMAGES = {"a loss of any size": fmu.Damage(), "few losses": fmu.Damage(fmu.SpikeAndSlab(0.1))}


def simulated(rng: np.random.Generator, model: fmu.SeparableModel) -> list[fmu.Test]:
    """Return the six tests of the notebook with new errors."""
    tests = []
    for state, days in DAYS.items():
        for day, celsius in enumerate(days, 1):
            f, shapes = modes(model, (1.0 - 0.003 * (celsius - 15.0)) * (1.0 - LOST * (state == "after")))
            f = f * (1.0 + 0.005 * rng.standard_normal(4))
            shapes = shapes + 0.01 * rng.standard_normal(shapes.shape)
            data = fmu.ModalData(f, sensors=model.dofs, shapes=shapes, sd_hz=0.005 * f, shapes_sd=0.01)
            tests.append(fmu.Test(f"{state} {day}", data, group=state, covariates={"temperature": celsius}))
    return tests


def updated(tests: list[fmu.Test], model: fmu.SeparableModel, damage: Any, seed: int) -> tuple[FloatArray, Any]:
    """Return the ends of the 90 % intervals of the losses (4, 2), and P(loss > 5 %) of each storey."""
    problem = fmu.JointProblem(
        model,
        tests,
        [fmu.Parameter(name, 1.0, 0.3, 2.5, prior=fmu.Normal(0.1, mean=1.0)) for name in STOREYS],
        varies=dict.fromkeys(STOREYS, damage),
        slopes={name: {"temperature": fmu.Normal(0.002, mean=-0.003)} for name in STOREYS},
        error=[fmu.FrequencyErrors("absolute"), fmu.ShapeErrors()],
    )
    trace = fmu.sample(problem, seed=seed, progress=False)
    table = fmu.damage(trace, (BEYOND,)).drop(index="any", level=1)
    return table[["eti90_lb", "eti90_ub"]].to_numpy(), table.iloc[:, 4].to_numpy()


@dataclass(frozen=True)
class DataSet:
    """Result of a data set, for each prior of the losses: for each storey, is the true loss in its interval, and
    is P(loss > 5 %) above one half?
    """

    seed: int
    inside: Mapping[str, list[bool]]
    alarm: Mapping[str, list[bool]]


def one_data_set(seed: int) -> DataSet:
    """Simulate and update a data set."""
    model = building(4)
    tests = simulated(np.random.default_rng(seed), model)
    inside, alarm = {}, {}
    for name, damage in DAMAGES.items():
        ends, p = updated(tests, model, damage, seed)
        inside[name] = ((ends[:, 0] <= LOST) & (ends[:, 1] >= LOST)).tolist()
        alarm[name] = (p > ALARM).tolist()
    return DataSet(seed, inside, alarm)


def page(found: Sequence[DataSet]) -> tuple[str, bool]:
    """Return the page, and whether every interval contains the true loss often enough."""
    n = len(found)
    inside = {name: np.array([one.inside[name] for one in found]) for name in DAMAGES}
    exact = {name: np.array([one.alarm[name] == (LOST > BEYOND).tolist() for one in found]) for name in DAMAGES}
    rows = [
        (f"interval of storey {i + 1} contains the true loss", *(int(of[:, i].sum()) for of in inside.values()))
        for i in range(len(STOREYS))
    ]
    for k in range(len(STOREYS) + 1):
        miss = "1 of the four intervals misses" if k == 1 else f"{k} of the four intervals miss"
        counts = (int(np.sum(np.sum(~of, axis=1) == k)) for of in inside.values())
        rows.append((f"{miss} the true loss", *counts))
    rows.append(
        ("P(loss > 5 %) is above one half in storey 2 and no other", *(int(of.sum()) for of in exact.values()))
    )
    least = int(binom.ppf(LEVEL, n, INTERVAL))
    smallest = min(count for row in rows[: len(STOREYS)] for count in row[1:])
    passed = smallest >= least
    lines = [f"| number of {n} data sets in which | {' | '.join(DAMAGES)} |", "| :-- | --: | --: |"]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    verdict = f"each of the {2 * len(STOREYS)} intervals does in at least {smallest} of {n} data sets"
    if not passed:
        verdict = f"one of the {2 * len(STOREYS)} intervals does in only {smallest} of {n} data sets"
    text = PAGE.format(
        verdict=f"**{'Yes' if passed else 'No'}: {verdict}; {least} are required.**",
        n=n,
        least=least,
        table="\n".join(lines),
    )
    return text, passed


def main() -> int:
    """Update the data sets that are missing, write the page, and return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--seed", type=int, default=SEED)
    asked = parser.parse_args()
    units, seeds = Units(asked.kept, asked.minutes), range(asked.seed, asked.seed + asked.replicates)
    with threadpool_limits(1):
        found = units.completed("data sets", each(seeds), one_data_set, fields_of(DataSet))
    text, passed = page(found)
    (asked.out / "damage-intervals.md").write_text(text, encoding="utf-8")
    return 0 if passed else 1


PAGE = """# Coverage of damage intervals

Do 90 % intervals of stiffness losses contain the true loss often enough? {verdict}

The building of [notebook 05](../notebooks/05-damage.ipynb) is measured on three days before the damage and three
days after it. Storey 2 has lost 15 % of its stiffness, and stiffness falls by 0.3 % per °C. Errors are 0.5 % of
the frequencies and 0.01 in the shapes. The {n} data sets differ only in these errors. Each is updated with the
temperature as a covariate and with two priors: a loss of any size in every storey (`fmu.Damage()`), and few
losses (`fmu.Damage(fmu.SpikeAndSlab(0.1))`).

With a coverage of 90 %, an interval contains the true loss in fewer than {least} of {n} data sets with a
probability below 1e-4. The coverage of a Bayesian interval is 90 % on average over true losses drawn from the
prior. These true losses are fixed, and three of them are zero, so that the coverage can be higher.

{table}
"""


if __name__ == "__main__":
    sys.exit(main())
