"""Several tests of one structure: are populations, the next test and damage told as surely as they are known?

    python -m tests.validation.several_tests OUT_DIRECTORY [--replicates N] [--seed N] [--kept FILE] [--only STUDY]

Three studies of simulated shear buildings, written to several-tests.md. Exit code 1 where a gate fails.

- Coverage: truths from the prior, hyperparameters among them; ten tests of each, and one more. As many 90 %
  intervals hold mean, sd and the frequencies of the next test as a binomial distribution allows, and the ranks of
  the truth among the draws are uniform (simulation-based calibration).
- Damage: losses of 0, 5, 10 and 20 % in random storeys, errors of 1 % in the frequencies. Where P(loss > 5 %) is
  said to be p, p of the losses are larger.
- Temperature: no damage, but the later tests were made on other days, and stiffness falls by 0.3 % per °C. False
  alarms with and without the temperature as a covariate.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom, truncnorm
from threadpoolctl import threadpool_limits

import fmu
from fmu.numbers import share, significant
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.validation.bands import UniformRanks
from tests.validation.kept import kept_lines

REPLICATES, SEED = 200, 20_281
N_TESTS, NOISE = 10, 0.005
INTERVAL, ALARM = 0.9, 0.5
LEVEL = 1e-3
BEYOND = 0.05
LOSSES = (0.0, 0.05, 0.1, 0.2)
RANKED = 63
EDGES = (0.0, 0.1, 0.3, 0.7, 0.9, 1.0)
DEGREES, PER_DEGREE, HOTTEST = 0.003, "temperature", 30.0
MASS, STIFFNESS = 1000.0, 2e6


def building(storeys: int) -> fmu.SeparableModel:
    """Return a shear building with a factor on the stiffness of each storey."""
    terms = []
    for i in range(storeys):
        K = np.zeros((storeys, storeys))
        K[i, i] = STIFFNESS
        if i:
            K[i - 1, i - 1] = STIFFNESS
            K[i, i - 1] = K[i - 1, i] = -STIFFNESS
        terms.append((K, f"k{i + 1}"))
    floors = [(f"floor {i + 1}", "x") for i in range(storeys)]
    return fmu.SeparableModel.from_terms([name for _, name in terms], terms, [MASS * np.eye(storeys)], dofs=floors)


def modes(model: fmu.SeparableModel, theta: Any) -> tuple[FloatArray, FloatArray]:
    """Return frequencies, Hz, and shapes by LAPACK."""
    values, shapes = np.linalg.eigh(model.K(theta).toarray() / MASS)
    return np.sqrt(values) / (2 * np.pi), shapes


def _covered(rng: np.random.Generator) -> dict[str, Any]:
    """Return whether intervals hold a truth from the prior, and its ranks."""
    storeys = 2
    model = building(storeys)
    names = [f"k{i + 1}" for i in range(storeys)]
    population = fmu.Population(sd=fmu.HalfNormal(0.1))
    # bounds far from the priors: what they cut off is neither in the truth nor in the model
    parameters = [fmu.Parameter(name, 1.0, 0.3, 2.5, prior=fmu.Normal(0.1, 1.0)) for name in names]
    mean, sd = 1.0 + 0.1 * rng.standard_normal(storeys), np.abs(0.1 * rng.standard_normal(storeys))
    ends = (0.3 - mean) / sd, (2.5 - mean) / sd
    values = truncnorm.rvs(*ends, mean, sd, size=(N_TESTS + 1, storeys), random_state=rng)
    tests, sigma = [], NOISE * modes(model, np.ones(storeys))[0]
    floors = [(f"floor {i + 1}", "x") for i in range(storeys)]
    for t, theta in enumerate(values[:-1]):
        f, shapes = modes(model, theta)
        shapes = shapes + 0.02 * rng.standard_normal(shapes.shape)
        f = f + sigma * rng.standard_normal(storeys)
        tests.append(
            fmu.Test(f"t{t}", fmu.ModalData(f, sensors=floors, shapes=shapes, sd_hz=sigma, shapes_sd=0.02))
        )
    errors = [fmu.FrequencyErrors("absolute"), fmu.ShapeErrors()]
    problem = fmu.JointProblem(model, tests, parameters, varies=dict.fromkeys(names, population), error=errors)
    trace = fmu.sample(
        problem, draws=250, warmup=300, seed=int(rng.integers(2**31)), until_ess=100, max_draws=1000
    )
    following = modes(model, values[-1])[0] + sigma * rng.standard_normal(storeys)
    found: dict[str, Any] = {"rhat": float(fmu.summary(trace)["rhat"].max()), "inside": {}, "ranks": {}}
    truths = {f"{n} mean": m for n, m in zip(names, mean, strict=True)}
    truths |= {f"{n} sd": s for n, s in zip(names, sd, strict=True)}
    truths |= {f"next test, mode {i + 1}": f for i, f in enumerate(following)}
    for name, truth in truths.items():
        if name.startswith("next"):
            draws = trace["next_test"]["frequency"].to_numpy()[..., int(name[-1]) - 1].ravel()
        else:
            draws = trace["posterior"][name].to_numpy().ravel()
        low, high = np.quantile(draws, (0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2))
        found["inside"][name] = bool(low <= truth <= high)
        chosen = draws[np.linspace(0, len(draws) - 1, RANKED).astype(int)]
        found["ranks"][name] = int(np.sum(chosen < truth))
    return found


def _states(rng: np.random.Generator, losses: FloatArray, degrees: Any, as_covariate: bool) -> Any:
    """Return the trace of a building tested before and after, three times each."""
    storeys = len(losses)
    model, names = building(storeys), [f"k{i + 1}" for i in range(storeys)]
    floors = [(f"floor {i + 1}", "x") for i in range(storeys)]
    truth, tests = 1.0 + 0.1 * rng.standard_normal(storeys), []
    for t, celsius in enumerate(degrees):
        state = "before" if t < len(degrees) // 2 else "after"
        theta = truth * (1.0 - losses if state == "after" else 1.0) * (1.0 - DEGREES * (celsius - HOTTEST / 2))
        f, shapes = modes(model, theta)
        f = f * (1.0 + 0.01 * rng.standard_normal(storeys))
        shapes = shapes + 0.02 * rng.standard_normal(shapes.shape)
        data = fmu.ModalData(f, sensors=floors, shapes=shapes, sd_hz=0.01 * f, shapes_sd=0.02)
        tests.append(fmu.Test(f"t{t}", data, group=state, covariates={PER_DEGREE: celsius}))
    slopes = {name: {PER_DEGREE: fmu.Normal(0.002, -0.003)} for name in names} if as_covariate else {}
    problem = fmu.JointProblem(
        model,
        tests,
        [fmu.Parameter(name, 1.0, 0.3, 2.5, prior=fmu.Normal(0.1, 1.0)) for name in names],
        varies=dict.fromkeys(names, fmu.Damage(prior=fmu.Uniform())),
        slopes=slopes,
        error=[fmu.FrequencyErrors("absolute"), fmu.ShapeErrors()],
    )
    return fmu.sample(
        problem, draws=300, warmup=400, maxima=fmu.find_map(problem, 16), seed=int(rng.integers(2**31))
    )


def _damaged(rng: np.random.Generator) -> dict[str, Any]:
    """Return P(loss > 5 %) of each storey, and the losses."""
    losses = rng.choice(LOSSES, 4, p=(0.55, 0.15, 0.15, 0.15)) * rng.uniform(0.6, 1.4, 4)
    table = fmu.damage(_states(rng, losses, np.full(4, HOTTEST / 2), False), (BEYOND,)).drop(index="any", level=1)
    return {"losses": losses.tolist(), "p": table.iloc[:, 4].tolist()}


def _warmed(rng: np.random.Generator) -> dict[str, Any]:
    """Return the largest P(loss > 5 %) of an undamaged building on other days, with and without covariate."""
    degrees = np.concatenate([rng.uniform(0.0, 10.0, 3), rng.uniform(20.0, HOTTEST, 3)])
    seed, found = int(rng.integers(2**31)), {}
    for name, told in (("with", True), ("without", False)):
        trace = _states(np.random.default_rng(seed), np.zeros(4), degrees, told)
        found[name] = float(fmu.damage(trace, (BEYOND,)).drop(index="any", level=1).iloc[:, 4].max())
    return found


STUDIES = {"covered": _covered, "damaged": _damaged, "warmed": _warmed}


def studied(study: str, number: int, seed: int) -> dict[str, Any]:
    """Return replicate `number` of a study."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(list(STUDIES).index(study), number)))
    return {"study": study, "number": number, **STUDIES[study](rng)}


@dataclass(frozen=True)
class Gate:
    """A statement, what was found, what a right result may be, and whether it is."""

    what: str
    found: str
    allowed: str
    passed: bool


def coverage(runs: Sequence[Mapping[str, Any]]) -> list[Gate]:
    """Return the gates of intervals and ranks."""
    if not runs:
        return []
    gates, n = [], len(runs)
    names = list(runs[0]["inside"])
    level = LEVEL / (2 * len(names))
    for name in names:
        inside = sum(run["inside"][name] for run in runs)
        low, high = binom.interval(1.0 - level, n, INTERVAL)
        what = f"90 % interval of {name} holds the truth"
        passed = bool(low <= inside <= high)
        gates.append(Gate(what, f"{inside} of {n}", f"{low:.0f} to {high:.0f}", passed))
    for name in names:
        p = UniformRanks(n, RANKED).p_value(np.array([run["ranks"][name] for run in runs]))
        gates.append(
            Gate(f"ranks of {name} are uniform", f"p = {significant(p, 2)}", f"p ≥ {level:.1g}", p >= level)
        )
    return gates


def reliability(runs: Sequence[Mapping[str, Any]]) -> list[Gate]:
    """Return the gates of P(loss > 5 %): in each class of p, as many losses are larger as p says."""
    if not runs:
        return []
    p = np.concatenate([run["p"] for run in runs])
    larger = np.concatenate([np.array(run["losses"]) > BEYOND for run in runs])
    gates = []
    for low, high in pairwise(EDGES):
        here = (p >= low) & ((p < high) | (high == 1.0))
        if not here.any():
            continue
        n, mean = int(here.sum()), float(p[here].mean())
        # of independent losses with these probabilities; the band is that of their mean
        few, many = binom.interval(1.0 - LEVEL / (len(EDGES) - 1), n, min(max(mean, 1e-9), 1.0 - 1e-9))
        said = f"P(loss > 5 %) from {share(low)} to {share(high)}, {share(mean)} on average"
        count = int(larger[here].sum())
        gates.append(Gate(said, f"{count} of {n} are", f"{few:.0f} to {many:.0f}", bool(few <= count <= many)))
    return gates


def alarms(runs: Sequence[Mapping[str, Any]]) -> list[Gate]:
    """Return the gates of false alarms under a change of temperature."""
    if not runs:
        return []
    n = len(runs)
    told, untold = (sum(run[name] > ALARM for run in runs) for name in ("with", "without"))
    most = int(binom.ppf(1.0 - LEVEL, n, 0.1))
    return [
        Gate(
            "buildings with a false alarm, temperature as a covariate",
            f"{told} of {n}",
            f"at most {most}",
            told <= most,
        ),
        Gate("the same without the covariate", f"{untold} of {n}", f"more than {told}", untold > told),
    ]


def page(runs: Sequence[Mapping[str, Any]]) -> tuple[str, bool]:
    """Return the page, and whether every gate passes."""
    by_study = {name: [run for run in runs if run["study"] == name] for name in STUDIES}
    rhat = [run["rhat"] for run in by_study["covered"]]
    lines = [
        "# Several tests of one structure",
        "",
        "Made by `python -m tests.validation.several_tests results`, whose first lines say what is simulated.",
        "",
    ]
    passed = True
    titles = {
        "covered": (
            "Coverage",
            f"{len(rhat)} buildings of two storeys with {N_TESTS} tests each; the largest R-hat of a run has a "
            f"median of {np.median(rhat or [np.nan]):.3f}.",
            coverage,
        ),
        "damaged": (
            "Damage",
            f"{len(by_study['damaged'])} buildings of four storeys, two tests before and two after.",
            reliability,
        ),
        "warmed": (
            "Temperature",
            f"{len(by_study['warmed'])} undamaged buildings, three tests between 0 and 10 °C and three between 20 "
            "and 30 °C, stiffness −0.3 % per °C. An alarm is P(loss > 5 %) above one half in any storey.",
            alarms,
        ),
    }
    for name, (title, words, gates_of) in titles.items():
        gates = gates_of(by_study[name])
        rows = [[gate.what, gate.found, gate.allowed, "yes" if gate.passed else "**no**"] for gate in gates]
        lines += [f"## {title}", "", words, "", markdown_table(["", "found", "allowed", "passed"], rows), ""]
        passed &= bool(gates) and all(gate.passed for gate in gates)
    return "\n".join(lines), passed


def main() -> int:
    """Run what is missing, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--kept", type=Path)
    parser.add_argument("--only", choices=tuple(STUDIES))
    arguments = parser.parse_args()
    runs: list[dict[str, Any]] = kept_lines(arguments.kept, list)
    known = {(run["study"], run["number"]) for run in runs}
    with threadpool_limits(1):
        for number in range(arguments.replicates):
            for study in STUDIES if arguments.only is None else (arguments.only,):
                if (study, number) in known:
                    continue
                runs.append(studied(study, number, arguments.seed))
                if arguments.kept is not None:
                    with arguments.kept.open("a", encoding="utf-8") as lines:
                        lines.write(json.dumps(runs[-1]) + "\n")
    text, passed = page(runs)
    (arguments.out / "several-tests.md").write_text(text, encoding="utf-8")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
