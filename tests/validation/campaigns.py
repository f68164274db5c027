"""Campaigns of many tests: damage under a law of temperature, the date of damage, tests of no common population.

    python -m tests.validation.campaigns OUT [--kept DIRECTORY] [--minutes M] [--replicates N] [--seed N]

A building of four storeys, by frequencies with errors of 0.3 %. Written to campaigns.md. Exit code 1 where a gate
fails.

- Laws: 200 tests over a year; stiffness falls by 0.3 % per °C below 0 °C, and from test 150 on storey 2 has lost
  8 %. With the right law the 90 % interval of the loss holds 8 %, and no other storey is said to have lost 5 %.
  With a linear law the model is contradicted, the temperature is named, and P(loss) is withheld.
- Dates: 60 tests; storey 2 has lost 8 % from an unknown test on. The median of the date is within 5 tests of it.
- Populations: 30 tests, also by shapes, stiffnesses that scatter by 5 %. One of them drifts by 3 standard
  deviations over the tests, or comes in three blocks 2 apart, or is 6 off in one test; or all four drift. The
  checks of a run tell it, and nothing without. The scores are those at the typical point where sampling begins,
  without draws.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binom, norm
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.fit.check import OF_POPULATIONS
from fmu.analysis.fit.populations import checks_of_scores
from fmu.numbers import share
from fmu.posterior.joint.conditional.both import conditionals
from fmu.types import FloatArray
from tests.validation.kept import Units, each, fields_of, study_parser
from tests.validation.several_tests import building, modes

REPLICATES, SEED = 200, 20_284
STOREYS = ("k1", "k2", "k3", "k4")
NOISE, PER_DEGREE, LOSS = 0.003, -0.003, 0.08
DAYS, DAMAGED = 200, 150
DATED, NEAR = 60, 5
TESTS, SCATTER, SHAPES = 30, 0.05, 0.01
DEPARTURES = ("a drift of 3 sd", "three blocks 2 sd apart", "one test 6 sd off", "all drift by 3 sd", "none")
INTERVAL, BEYOND, GATE_LEVEL = 0.9, 0.05, 1e-3
LEAST_TOLD, MOST_ALARMS, SURE = 0.95, 0.02, 0.99


class _DrawnError(Exception):
    """Ends a run after its draws: what follows is not needed here."""


@dataclass(frozen=True)
class Laws:
    """What is said of losses under the right law and a linear one."""

    inside: bool
    quiet: bool
    contradicted: bool
    named: bool
    withheld: bool


def sampled(problem: fmu.UpdatingProblem, seed: int) -> Any:
    """Return the trace of a run without the analyses after its draws."""
    found = []

    def keep(trace: Any) -> None:
        found.append(trace)
        raise _DrawnError

    with suppress(_DrawnError):
        fmu.sample(problem, draws=250, warmup=200, seed=seed, progress=False, on_draws=keep)
    return found[0]


def simulated_tests(
    rng: np.random.Generator, values: FloatArray, celsius: FloatArray | None = None, by_shapes: bool = False
) -> list[fmu.Test]:
    """Return tests of the building with the `values` (n, 4) of its stiffnesses."""
    model, tests = building(4), []
    for t, theta in enumerate(values):
        f, shapes = modes(model, theta)
        f = f * (1.0 + NOISE * rng.standard_normal(4))
        options: dict[str, Any] = {"sd_hz": NOISE * f}
        if by_shapes:
            noisy = shapes + SHAPES * rng.standard_normal(shapes.shape)
            options |= {"sensors": model.dofs, "shapes": noisy, "shapes_sd": SHAPES}
        covariates = {} if celsius is None else {"temperature": float(celsius[t])}
        group = "after" if t >= DAMAGED - 1 else "before"
        tests.append(fmu.Test(f"t{t + 1}", fmu.ModalData(f, **options), group=group, covariates=covariates))
    return tests


def parameters() -> list[fmu.Parameter]:
    """Return the parameters: a factor on the stiffness of each storey."""
    return [fmu.Parameter(name, 1.0, 0.5, 1.6, prior=fmu.Normal(0.2, mean=1.0)) for name in STOREYS]


def losses_under_laws(seed: int) -> Laws:
    """Simulate and update a year of tests with both laws."""
    rng = np.random.default_rng((seed, 0))
    year = np.cos(2.0 * np.pi * np.arange(DAYS) / DAYS)
    celsius = np.clip(10.0 - 25.0 * year + rng.normal(0.0, 3.0, DAYS), -15.0, 35.0)
    values = np.ones((DAYS, 4)) + PER_DEGREE * np.minimum(celsius, 0.0)[:, None]
    values[DAMAGED - 1 :, 1] *= 1.0 - LOSS
    tests, found = simulated_tests(rng, values, celsius), []
    prior = fmu.Normal(0.005)
    for law in (fmu.PiecewiseLinear(prior, [0.0]), prior):
        problem = fmu.JointProblem(
            building(4),
            tests,
            parameters(),
            varies=dict.fromkeys(STOREYS, fmu.Damage()),
            slopes={name: {"temperature": law} for name in STOREYS},
            pairing="index",
        )
        found.append(sampled(problem, seed))
    right, linear = (fmu.damage(trace, (BEYOND,)).drop(index="any", level=1) for trace in found)
    low, high = right["eti90_lb"].to_numpy(), right["eti90_ub"].to_numpy()
    said = fmu.diagnose(found[1]).fit.against
    return Laws(
        bool(low[1] <= LOSS <= high[1]) and not right.attrs["withheld"],
        bool(np.all(np.delete(right.iloc[:, 4].to_numpy(), 1) < 0.5)),
        bool(said),
        any("temperature" in sentence for sentence in said),
        bool(linear.attrs["withheld"]),
    )


def error_of_date(seed: int) -> float:
    """Return the distance of the median date of damage from the truth, in tests."""
    rng = np.random.default_rng((seed, 1))
    first = int(rng.integers(10, DATED - 10))  # the number of tests before the damage
    values = np.ones((DATED, 4))
    values[first:, 1] *= 1.0 - LOSS
    problem = fmu.JointProblem(
        building(4),
        simulated_tests(rng, values),
        parameters(),
        varies={"k2": fmu.UndatedDamage()},
        pairing="index",
    )
    draws = sampled(problem, seed)["posterior"]["test of damage"].to_numpy()
    return float(abs(np.median(draws) - (first + 0.5)))


def damage_said(seed: int) -> tuple[float, Laws]:
    """Return the distance of the date of damage from the truth, and what is said under the two laws."""
    return error_of_date(seed), losses_under_laws(seed)


def departures_told(seed: int) -> list[bool]:
    """Return for each of the `DEPARTURES` whether the checks tell it."""
    rng = np.random.default_rng((seed, 2))
    return [is_told(rng, departure) for departure in DEPARTURES]


def is_told(rng: np.random.Generator, departure: str) -> bool:
    """Return whether the checks tell that a population of the tests is none."""
    z, k = rng.standard_normal((TESTS, 4)), int(rng.integers(4))
    if departure == DEPARTURES[0]:
        z[:, k] += np.linspace(-1.5, 1.5, TESTS)
    elif departure == DEPARTURES[1]:
        z[:, k] += np.repeat(rng.permutation([-2.0, 0.0, 2.0]), TESTS // 3)
    elif departure == DEPARTURES[2]:
        z[int(rng.integers(TESTS)), k] = 6.0
    elif departure == DEPARTURES[3]:
        z += np.linspace(-1.5, 1.5, TESTS)[:, None]
    problem = fmu.JointProblem(
        building(4),
        simulated_tests(rng, np.exp(SCATTER * z), by_shapes=True),
        parameters(),
        varies=dict.fromkeys(STOREYS, fmu.Population("log-normal", sd=fmu.HalfNormal(0.1))),
        error=[fmu.FrequencyErrors("absolute"), fmu.ShapeErrors()],
    )
    known = conditionals(problem)
    linear = known.scores.linearise(known.typical)
    mean, variance = (linear.z + linear.step)[0], np.einsum("tii->ti", linear.inverse[0])
    tests = [{"name": test.name, "group": "", "covariates": {}} for test in problem.tests]
    return any(
        c.failed for c in checks_of_scores(mean / np.sqrt(1.0 - variance), STOREYS, tests, set(), OF_POPULATIONS)
    )


def most_of_drifts() -> float:
    """Return the power of the test of the largest of four correlations with the order, by Fisher's z."""
    drift = np.linspace(-1.5, 1.5, TESTS).var()
    shift = np.arctanh(np.sqrt(drift / (1.0 + drift))) * np.sqrt(TESTS - 3)
    return float(norm.cdf(shift - norm.isf(MOST_ALARMS / (2 * len(STOREYS)))))


def page(laws: Sequence[Laws], dates: Sequence[float], told: Sequence[Sequence[bool]]) -> tuple[str, bool]:
    """Return the page, and whether every gate is passed, as far as so many campaigns can tell."""
    rows = []

    def add(what: str, count: int, n: int, least: float, most: float = 1.0) -> None:
        low, high = int(binom.ppf(GATE_LEVEL, n, least)), int(binom.ppf(1.0 - GATE_LEVEL, n, most))
        rows.append((what, f"{count} of {n}", f"{low} – {high}", low <= count <= high))

    add("right law: 90 % interval of the loss", sum(x.inside for x in laws), len(laws), INTERVAL, INTERVAL)
    add("right law: no other storey has P(loss > 5 %) > 0.5", sum(x.quiet for x in laws), len(laws), SURE)
    add("linear law: the model is contradicted", sum(x.contradicted for x in laws), len(laws), SURE)
    add("linear law: the temperature is named", sum(x.named for x in laws), len(laws), SURE)
    add("linear law: P(loss) is withheld", sum(x.withheld for x in laws), len(laws), SURE)
    add("date of damage within 5 tests", sum(x <= NEAR for x in dates), len(dates), INTERVAL)
    counts = [sum(of) for of in zip(*told, strict=True)]
    for departure, count in zip(DEPARTURES[:-1], counts, strict=False):
        add(f"population: {departure} told", count, len(told), LEAST_TOLD)
    add("population: told though nothing is there", counts[-1], len(told), 0.0, MOST_ALARMS)
    lines = ["| what | campaigns | gate | passed |", "| :-- | --: | :-- | :-- |"]
    lines += [f"| {what} | {count} | {gate} | {'yes' if good else 'no'} |" for what, count, gate, good in rows]
    return (
        "# Campaigns of many tests\n\n"
        "Made by `python -m tests.validation.campaigns results`, whose first lines say what is simulated.\n\n"
        + "\n".join(lines)
        + "\n\nA count is within its gate except once in 1000 times at each end, if the share is that asked for: "
        "90 % of intervals and dates,\n95 % of departures, at most 2 % of false alarms, and 99 % of the rest. "
        "A test for nothing but drifts, with all of these 2 %,\nwould tell a drift of 3 sd of one of four "
        f"parameters in {share(most_of_drifts())} (Fisher's z).\n"
    ), all(good for *_, good in rows)


def main() -> int:
    """Update the campaigns that are missing, write the page, and return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--seed", type=int, default=SEED)
    asked = parser.parse_args()
    units, seeds = Units(asked.kept, asked.minutes), range(asked.seed, asked.seed + asked.replicates)
    with threadpool_limits(1):
        told = units.completed("populations", each(seeds), departures_told, least=1)
        damaged = units.completed("dates and laws", each(seeds), damage_said, least=1)
    dates, laws = zip(*damaged, strict=True)
    text, passed = page([*map(fields_of(Laws), laws)], dates, told)
    (asked.out / "campaigns.md").write_text(text, encoding="utf-8")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
