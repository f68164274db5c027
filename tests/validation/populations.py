"""Populations over several tests: do intervals hold the truth, and do default runs converge, in random designs?

    python -m tests.validation.populations OUT [--kept DIRECTORY] [--minutes M] [--replicates N] [--seed N]

Each set is a shear building of 3 to 6 storeys with 5 to 40 tests, drawn at random. The stiffness of every storey
has a log-normal population, and in two of three sets the populations are correlated. Medians, standard deviations
and partial correlations are drawn from their priors, and the values of each test from the populations. A test
lacks some modes, and its errors have a standard deviation of its own; half of the sets have mode shapes too. The
data are made by LAPACK and NumPy alone. Each set is sampled as `fmu run` does it. As the truths are draws from the
prior, 90 % intervals hold them in 90 % of the sets, and their ranks among posterior draws are uniform (Talts et
al. 2018). Written to populations.md. Exit code 1 where a gate fails.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

import fmu
from fmu.posterior.joint.joint_problem import simulate_next_test
from fmu.types import FloatArray
from tests.validation.kept import Units, each, fields_of, study_parser
from tests.validation.populations_page import INTERVAL, KINDS, RANKED, Study, page
from tests.validation.several_tests import building, modes

REPLICATES, SEED = 300, 20_283
MEDIAN_SD, LOG_SD, ETA = 0.1, 0.05, 2.0
MISSING, ERRORS, SHAPE_ERROR = 0.2, (0.001, 0.02), 0.03
UNTIL_ESS, DRAWS, WARMUP, MAX_SOLVES = 400, 250, 100, 80_000
"""`fmu run` allows 2 000 000 solves; so many would take an hour in each of the few sets that do not converge."""


@dataclass(frozen=True)
class Design:
    """A simulated set of tests.

    Attributes
    ----------
    problem : UpdatingProblem
    truths : mapping of str to float
        The medians, standard deviations and partial correlations, by the names of the parameters.
    following : ndarray, shape (n_storeys,)
        Frequencies measured in one further test like the first, Hz.
    with_shapes : bool
    """

    problem: fmu.UpdatingProblem
    truths: Mapping[str, float]
    following: FloatArray
    with_shapes: bool


@dataclass(frozen=True)
class SetOfTests:
    """The result of one set.

    Attributes
    ----------
    number : int
    storeys, tests : int
    correlated, with_shapes, converged : bool
    reasons : list of str
        Why the run has not converged.
    ess : dict of str to float
        The parameter other than a score with the smallest bulk or tail ESS, and that ESS.
    draws, solves : int
        Of all chains together; solves of all tests.
    processor_s : float
    inside, ranks : dict of str to list
        Of each kind of quantity: whether the interval holds each truth, and the rank of the truth.
    """

    number: int
    storeys: int
    tests: int
    correlated: bool
    with_shapes: bool
    converged: bool
    reasons: list[str]
    ess: dict[str, float]
    draws: int
    solves: int
    processor_s: float
    inside: dict[str, list[bool]]
    ranks: dict[str, list[int]]


def correlation_factor(rng: np.random.Generator, p: int) -> tuple[FloatArray, list[float]]:
    """Return the Cholesky factor of a correlation matrix from the LKJ(`ETA`) distribution, and ρ_12, ρ_13, ….

    Lewandowski, Kurowicka & Joe (2009), *J. Multivar. Anal.* 100, 1989–2001, section 2.4: the correlation of i and
    j given the k − 1 variables before i is 2 B − 1, B ~ beta(b, b), b = η + (p − 1 − k)/2.
    """
    factor, partial = np.zeros((p, p)), []
    factor[0, 0] = 1.0
    for j in range(1, p):
        left = 1.0
        for i in range(j):
            b = ETA + 0.5 * (p - 2 - i)
            partial.append(float(2.0 * rng.beta(b, b) - 1.0))
            factor[j, i] = partial[-1] * np.sqrt(left)
            left *= 1.0 - partial[-1] ** 2
        factor[j, j] = np.sqrt(left)
    return factor, partial


def simulate_design(seed: int, number: int) -> Design:
    """Return set `number` of tests."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    storeys, n = int(rng.integers(3, 7)), int(rng.integers(5, 41))
    with_shapes, is_correlated = bool(rng.random() < 0.5), bool(rng.random() < 2.0 / 3.0)
    model, names = building(storeys), [f"k{i + 1}" for i in range(storeys)]
    median, sd = 1.0 + MEDIAN_SD * rng.standard_normal(storeys), np.abs(LOG_SD * rng.standard_normal(storeys))
    factor, partial = correlation_factor(rng, storeys)
    if not is_correlated:
        factor, partial = np.eye(storeys), []
    values = median * np.exp(sd * (rng.standard_normal((n + 1, storeys)) @ factor.T))
    typical = modes(model, np.ones(storeys))[0]
    relative = np.exp(rng.uniform(*np.log(ERRORS), n))
    relative = np.append(relative, relative[0])  # the further test is like the first
    seen = rng.random((n + 1, storeys)) >= MISSING
    seen[[0, n]] = True
    seen[np.flatnonzero(~seen.any(axis=1)), 0] = True
    labels, tests, following = [f"mode {i + 1}" for i in range(storeys)], [], typical
    for t, theta in enumerate(values):
        f, shapes = modes(model, theta)
        sigma = relative[t] * typical
        f = f + sigma * rng.standard_normal(storeys)
        shapes = shapes + SHAPE_ERROR * rng.standard_normal(shapes.shape)
        if t == n:
            following = f
            break
        here = np.flatnonzero(seen[t])
        of_shapes = {"sensors": model.dofs, "shapes": shapes[:, here], "shapes_sd": SHAPE_ERROR}
        data = fmu.ModalData(
            f[here],
            labels=[labels[i] for i in here],
            numbers=tuple(int(i) + 1 for i in here),
            sd_hz=sigma[here],
            **(of_shapes if with_shapes else {}),
        )
        tests.append(fmu.Test(f"t{t + 1}", data))
    population = fmu.Population("log-normal", sd=fmu.HalfNormal(LOG_SD))
    problem = fmu.JointProblem(
        model,
        tests,
        [fmu.Parameter(k, 1.0, 0.3, 2.5, prior=fmu.Normal(MEDIAN_SD, mean=1.0)) for k in names],
        varies=dict.fromkeys(names, population),
        correlation=ETA if is_correlated else None,
        pairing="index",
        error=[fmu.FrequencyErrors("absolute"), *([fmu.ShapeErrors()] if with_shapes else [])],
    )
    truths = {f"{k} median": float(one) for k, one in zip(names, median, strict=True)}
    truths |= {f"{k} log sd": float(one) for k, one in zip(names, sd, strict=True)}
    if is_correlated:
        correlation = problem.layout.correlation
        assert correlation is not None
        truths |= {problem.names[c]: one for c, one in zip(correlation.columns, partial, strict=True)}
    return Design(problem, truths, following, with_shapes)


def kind_of(name: str) -> str:
    """Return the kind of a parameter by its name."""
    ends = {"median": KINDS[0], "log sd": KINDS[1]}
    return next((kind for end, kind in ends.items() if name.endswith(end)), KINDS[2])


def one_set(seed: int, number: int) -> SetOfTests:
    """Simulate and sample a set."""
    design = simulate_design(seed, number)
    problem, began = design.problem, time.process_time()
    trace = fmu.sample(
        problem,
        draws=DRAWS,
        warmup=WARMUP,
        until_ess=UNTIL_ESS,
        max_solves=MAX_SOLVES,
        seed=number + 1,
        progress=False,
    )
    seconds = time.process_time() - began
    table, verdict = fmu.summary(trace), fmu.diagnose(trace)
    main = [name for name, role in zip(problem.names, problem.roles, strict=True) if role.kind != "score"]
    ess = table.loc[main, ["ess_bulk", "ess_tail"]].min(axis=1)
    draws = {name: trace["posterior"][name].to_numpy().ravel() for name in problem.names}
    theta = np.column_stack([draws[name] for name in problem.names])
    chosen = np.linspace(0, len(theta) - 1, RANKED).astype(int)
    following = simulate_next_test(problem, np.random.default_rng(number), theta, like=problem.tests[0].name)[1]
    quantities = [(kind_of(name), truth, draws[name]) for name, truth in design.truths.items()]
    quantities += [(KINDS[3], f, following[:, i]) for i, f in enumerate(design.following)]
    inside: dict[str, list[bool]] = {kind: [] for kind in KINDS}
    ranks: dict[str, list[int]] = {kind: [] for kind in KINDS}
    for kind, truth, of in quantities:
        low, high = np.quantile(of, (0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2))
        inside[kind].append(bool(low <= truth <= high))
        ranks[kind].append(int(np.sum(of[chosen] < truth)))
    return SetOfTests(
        number,
        len(design.following),
        len(problem.tests),
        problem.layout.correlation is not None,
        design.with_shapes,
        verdict.converged and bool(ess.min() >= UNTIL_ESS),
        list(verdict.reasons),
        {str(ess.idxmin()): float(ess.min())},
        len(theta),
        int(trace.attrs["n_solves"]) + int(trace.attrs["warmup_n_solves"]),
        seconds,
        inside,
        ranks,
    )


def main() -> int:
    """Run the sets that are missing, write the page, and return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--seed", type=int, default=SEED)
    asked = parser.parse_args()
    units, numbers = Units(asked.kept, asked.minutes), each(range(asked.replicates))
    with threadpool_limits(1):
        sets = units.completed("sets", numbers, lambda n: one_set(asked.seed, n), fields_of(SetOfTests, list))
    study = Study(sets)
    settings = (
        f"until an ESS of {UNTIL_ESS}, {DRAWS} draws at first, {WARMUP} steps of warm-up, "
        f"at most {MAX_SOLVES} solves of all tests"
    )
    (asked.out / "populations.md").write_text(page(study, REPLICATES, settings), encoding="utf-8")
    return 1 if study.failures else 0


if __name__ == "__main__":
    sys.exit(main())
