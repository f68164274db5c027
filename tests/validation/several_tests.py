"""Several tests of one structure: are populations, the next test and damage told as surely as they are known?

    python -m tests.validation.several_tests OUT [--kept DIRECTORY] [--minutes M]
        [--replicates N] [--seed N] [--only STUDY]

Four studies of simulated shear buildings, written to several-tests.md. Exit code 1 where a gate fails.

- Scatter: as the tests grow from 5 to 100, the error of the population's mean falls as 1/√n, and the population's
  standard deviation is found and does not shrink. The mean of the tests ± s/√n, updated with alone, is beside it.
- Coverage: truths from the prior, hyperparameters among them; ten tests of each, and one more. As many 90 %
  intervals hold mean, sd and the frequencies of the next test as a binomial distribution allows, and the ranks of
  the truth among the draws are uniform (simulation-based calibration).
- Damage: losses of 0, 5, 10 and 20 % in random storeys, errors of 1 % in the frequencies. Where P(loss > 5 %) is
  said to be p, p of the losses are larger.
- Temperature: no damage, but the later tests were made on other days, and stiffness falls by 0.3 % per °C. False
  alarms with and without the temperature as a covariate.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from scipy.stats import truncnorm
from threadpoolctl import threadpool_limits

import fmu
from fmu.types import FloatArray
from tests.shear_building import shear_building
from tests.validation.kept import Units, each, study_parser
from tests.validation.several_tests_page import BEYOND, INTERVAL, RANKED, page

REPLICATES, SEED = 200, 20_281
SCATTERED = 20
N_TESTS, NOISE = 10, 0.005
GROWING, SCATTER, NEXT = (5, 10, 20, 50, 100), 0.08, 200
LOSSES = (0.0, 0.05, 0.1, 0.2)
DEGREES, PER_DEGREE, HOTTEST = 0.003, "temperature", 30.0
MASS, STIFFNESS = 1000.0, 2e6


ERRORS = [fmu.FrequencyErrors("absolute"), fmu.ShapeErrors()]


def building(storeys: int) -> fmu.SeparableModel:
    """Return a shear building with a factor on the stiffness of each storey."""
    numbers = range(1, storeys + 1)
    floors = [(f"floor {i}", "x") for i in numbers]
    return shear_building([f"k{i}" for i in numbers], STIFFNESS, MASS, dofs=floors)


def modes(model: fmu.SeparableModel, theta: Any) -> tuple[FloatArray, FloatArray]:
    """Return frequencies, Hz, and shapes by LAPACK."""
    values, shapes = np.linalg.eigh(model.K(theta).toarray() / MASS)
    return np.sqrt(values) / (2 * np.pi), shapes


def _measured(
    rng: np.random.Generator, model: fmu.SeparableModel, values: FloatArray, sigma: FloatArray
) -> list[fmu.Test]:
    """Return a test at each row of values: frequencies with errors of sd sigma, and shapes."""
    found = []
    for t, theta in enumerate(values):
        f, shapes = modes(model, theta)
        shapes = shapes + 0.02 * rng.standard_normal(shapes.shape)
        f = f + sigma * rng.standard_normal(f.shape)
        data = fmu.ModalData(f, sensors=model.dofs, shapes=shapes, sd_hz=sigma, shapes_sd=0.02)
        found.append(fmu.Test(f"t{t}", data))
    return found


def _scattered(rng: np.random.Generator) -> dict[str, Any]:
    """Return what 5, 10, … of 100 tests tell of a population, and what their mean does."""
    model, names = building(2), ("k1", "k2")
    values = 1.0 + SCATTER * rng.standard_normal((GROWING[-1] + NEXT, 2))
    sigma = NOISE * modes(model, np.ones(2))[0]
    tests = _measured(rng, model, values[: GROWING[-1]], sigma)
    following = np.array([modes(model, theta)[0] for theta in values[GROWING[-1] :]])
    following = following + sigma * rng.standard_normal(following.shape)
    parameters = [fmu.Parameter(name, 1.0, 0.3, 2.5) for name in names]
    population = fmu.Population(sd=fmu.HalfNormal(0.2))
    found: dict[str, Any] = {"tests": list(GROWING), "truth": SCATTER}
    keys = ("sd_of_mean", "population_sd", "low", "high", "within", "sd_by_average", "within_by_average")
    found |= {key: [] for key in keys}

    def within(frequencies: FloatArray) -> float:
        low, high = np.quantile(frequencies, (0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2), axis=0)
        return float(np.mean((following >= low) & (following <= high)))

    for n in GROWING:
        options = {"draws": 300, "warmup": 300, "seed": int(rng.integers(2**31))}
        varies = dict.fromkeys(names, population)
        problem: Any = fmu.JointProblem(model, tests[:n], parameters, varies=varies, error=ERRORS)
        trace = fmu.sample(problem, **options)
        spread = trace["posterior"]["k1 sd"].to_numpy()
        low, high = np.quantile(spread, (0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2))
        of = [trace["posterior"]["k1 mean"].to_numpy().std(), spread.mean(), low, high]
        of.append(within(trace["next_test"]["frequency"].to_numpy().reshape(-1, 2)))
        data = fmu.ModalData.from_tests(
            [test.data.frequencies_hz for test in tests[:n]],
            sensors=model.dofs,
            shapes=[test.data.shapes for test in tests[:n]],
        )
        problem = fmu.UpdatingProblem(model, data, parameters, error=ERRORS)
        trace = fmu.sample(problem, **options)
        theta = np.stack([trace["posterior"][name].to_numpy().ravel() for name in names], axis=1)
        of += [theta[:, 0].std(), within(problem.simulate_test(rng, problem.model.frequencies(theta), theta))]
        for key, value in zip(keys, of, strict=True):
            found[key].append(float(value))
    return found


def _covered(rng: np.random.Generator) -> dict[str, Any]:
    """Return whether intervals hold a truth from the prior, and its ranks."""
    storeys = 2
    model = building(storeys)
    names = [f"k{i + 1}" for i in range(storeys)]
    population = fmu.Population(sd=fmu.HalfNormal(0.1))
    # bounds far from the priors: what they cut off is neither in the truth nor in the model
    parameters = [fmu.Parameter(name, 1.0, 0.3, 2.5, prior=fmu.Normal(0.1, mean=1.0)) for name in names]
    mean, sd = 1.0 + 0.1 * rng.standard_normal(storeys), np.abs(0.1 * rng.standard_normal(storeys))
    ends = (0.3 - mean) / sd, (2.5 - mean) / sd
    values = truncnorm.rvs(*ends, mean, sd, size=(N_TESTS + 1, storeys), random_state=rng)
    sigma = NOISE * modes(model, np.ones(storeys))[0]
    tests = _measured(rng, model, values[:-1], sigma)
    varies = dict.fromkeys(names, population)
    problem = fmu.JointProblem(model, tests, parameters, varies=varies, error=ERRORS)
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
    slopes = {name: {PER_DEGREE: fmu.Normal(0.002, mean=-0.003)} for name in names} if as_covariate else {}
    problem = fmu.JointProblem(
        model,
        tests,
        [fmu.Parameter(name, 1.0, 0.3, 2.5, prior=fmu.Normal(0.1, mean=1.0)) for name in names],
        varies=dict.fromkeys(names, fmu.Damage(prior=fmu.Uniform())),
        slopes=slopes,
        error=ERRORS,
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


# in the order of their random numbers
STUDIES = {"covered": _covered, "damaged": _damaged, "warmed": _warmed, "scattered": _scattered}


def studied(study: str, number: int, seed: int) -> dict[str, Any]:
    """Return replicate `number` of a study."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(list(STUDIES).index(study), number)))
    return {"study": study, "number": number, **STUDIES[study](rng)}


def main() -> int:
    """Run what is missing, and write the page."""
    parser = study_parser(__doc__)
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--only", choices=tuple(STUDIES))
    asked = parser.parse_args()
    keys = [
        (study, number)
        for number in range(asked.replicates)
        for study in ((asked.only,) if asked.only else STUDIES)
        if study != "scattered" or number < SCATTERED
    ]
    units = Units(asked.kept, asked.minutes)
    with threadpool_limits(1):
        runs = units.completed("replicates", each(keys), lambda key: studied(*key, asked.seed))
    text, passed = page(runs)
    (asked.out / "several-tests.md").write_text(text, encoding="utf-8")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
