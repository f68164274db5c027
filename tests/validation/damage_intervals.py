"""How often the intervals of the damaged building of notebook 05 hold the truth, over many simulated data sets.

    python -m tests.validation.damage_intervals OUT [--kept DIRECTORY] [--minutes M] [--replicates N] [--seed N]

The building of `notebooks/05-damage.ipynb` and its six days: storey 2 has lost 15 %, stiffness falls by 0.3 %
per °C, errors are 0.5 % of the frequencies and 0.01 in the shapes. Only the errors differ from data set to data
set. Each is updated as in the notebook, with the temperature as a covariate, once with a loss of any size in
every storey and once with few losses (`fmu.SpikeAndSlab`). Written to damage-intervals.md. Exit code 1 where
intervals hold the truth less often than a binomial distribution allows, at 1 in 10 000.
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
    """Return the six tests of the notebook with other errors."""
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
    """Return the ends of the 90 % intervals (4, 2) of the losses, and P(loss > 5 %) of each."""
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
    """What intervals and probabilities say of a data set: of each storey, by the prior of the losses."""

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
    """Return the page, and whether every interval holds the truth often enough."""
    n = len(found)
    inside = {name: np.array([one.inside[name] for one in found]) for name in DAMAGES}
    exact = {name: np.array([one.alarm[name] == (LOST > BEYOND).tolist() for one in found]) for name in DAMAGES}
    rows = [
        (f"90 % interval of {storey} holds the truth", *(int(of[:, i].sum()) for of in inside.values()))
        for i, storey in enumerate(STOREYS)
    ]
    for k in range(len(STOREYS) + 1):
        miss = "1 of the four intervals misses" if k == 1 else f"{k} of the four intervals miss"
        counts = (int(np.sum(np.sum(~of, axis=1) == k)) for of in inside.values())
        rows.append((f"{miss} the truth", *counts))
    rows.append(
        ("P(loss > 5 %) is above one half in storey 2 and no other", *(int(of.sum()) for of in exact.values()))
    )
    least = int(binom.ppf(LEVEL, n, INTERVAL))
    passed = min(count for row in rows[: len(STOREYS)] for count in row[1:]) >= least
    lines = [f"| of {n} data sets | {' | '.join(DAMAGES)} |", "| :-- | --: | --: |"]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    return (
        "# How often intervals of losses hold the truth\n\n"
        "Made by `python -m tests.validation.damage_intervals results`, whose first lines say what is simulated:\n"
        "the building of [notebook 05](../notebooks/05-damage.ipynb), with other errors of the measurement in "
        "each data set.\n\n" + "\n".join(lines) + "\n\n"
        f"Intervals of 90 % hold the truth in at least {least} of {n} data sets, except once in 10 000 times. "
        f"All eight do: {'yes' if passed else 'no'}.\n"
    ), passed


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


if __name__ == "__main__":
    sys.exit(main())
