"""Standard errors against what estimates are off by, in many replicates.

    python -m tests.validation.replicates OUT [--kept DIRECTORY] [--minutes M]

Means, standard deviations, 5 % and 95 % quantiles and log-evidences of 400 short runs on each of two posteriors,
against importance sampling that knows nothing of the runs; and quantiles of known processes. Exit code 1 where
errors over their standard errors have an sd outside 0.9 to 1.1 or more than 2.5 % of them lie beyond 2.58. With a
file, runs that it holds are not repeated.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.special import expit, gammaln, logit, logsumexp
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.convergence import effective
from fmu.analysis.maxima.results import Maxima
from fmu.analysis.trace.reading import parameter_draws
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.validation import storeys
from tests.validation.kept import Units, each, fields_of, study_parser
from tests.validation.processes import PROCESSES, Process

RUNS, WARMUP, DRAWS = 400, 400, 400
PILOT_DRAWS, REFERENCE_DRAWS, AT_ONCE = 4000, 2_000_000, 50_000
OF_PROCESSES = 2000
TAILS = (0.05, 0.95)
WITHIN, BEYOND, MOST_BEYOND = (0.9, 1.1), 2.58, 0.025
QUANTITIES = ("mean", "sd", "5 % quantile", "95 % quantile")
EVIDENCES = ("log-evidence by importance", "log-evidence by bridge")
_DF = 5.0


def _building() -> fmu.UpdatingProblem:
    return storeys.problem(storeys.reduced_model(), np.array([3.3, 8.6]))


CASES: dict[str, Callable[[], fmu.UpdatingProblem]] = {
    "cantilever-young, by shape": lambda: fmu.cases.load("cantilever-young", "shape"),
    "building of three parameters": _building,
}


@dataclass(frozen=True)
class Replicate:
    """Errors over standard errors of one run: of each quantity and parameter, and of the evidences.

    Attributes
    ----------
    case : str
    seed : int
    errors : list of list of float
        Of `QUANTITIES`, each a parameter.
    of_evidence : list of float
        Of `EVIDENCES`.
    ess : float
        Smallest bulk or tail ESS.
    processor_s : float
    """

    case: str
    seed: int
    errors: list[list[float]]
    of_evidence: list[float]
    ess: float
    processor_s: float


@dataclass(frozen=True)
class Reference:
    """Quantities (4, ndim) by importance sampling, log-evidence with its error, and the effective draws."""

    values: FloatArray
    log_evidence: float
    error: float
    effective: float


class _Drawn(Exception):  # noqa: N818
    """The draws are there; predictions and modes left out are not wanted."""


@cache
def problem_of(case: str) -> tuple[fmu.UpdatingProblem, Maxima]:
    """Return a problem and its maxima."""
    problem = CASES[case]()
    return problem, fmu.find_map(problem)


def run(case: str, seed: int, draws: int = DRAWS) -> xr.DataTree:
    """Return the trace of a run of the default sampler."""
    problem, maxima = problem_of(case)
    found: list[xr.DataTree] = []

    def drawn(trace: xr.DataTree) -> None:
        found.append(trace)
        raise _Drawn

    with suppress(_Drawn):
        fmu.sample(problem, draws=draws, warmup=WARMUP, seed=seed, maxima=maxima, progress=False, on_draws=drawn)
    return found[0]


@cache
def reference(case: str) -> Reference:
    """Return what importance sampling says, with a t distribution for log u/(1 − u) of the place u in the box."""
    problem, _ = problem_of(case)
    lower, away = problem.lower, problem.upper - problem.lower
    pilot = logit((parameter_draws(run(case, 0, PILOT_DRAWS)).reshape(-1, problem.ndim) - lower) / away)
    centre, root = pilot.mean(axis=0), np.linalg.cholesky(np.cov(pilot.T))
    n = problem.ndim
    constant = gammaln((_DF + n) / 2) - gammaln(_DF / 2) - 0.5 * n * np.log(_DF * np.pi)
    constant -= float(np.sum(np.log(np.diag(root))))
    rng, points, log_w = np.random.default_rng(20), [], []
    for _ in range(REFERENCE_DRAWS // AT_ONCE):
        z = rng.standard_normal((AT_ONCE, n)) / np.sqrt(rng.chisquare(_DF, AT_ONCE) / _DF)[:, None]
        y = centre + z @ root.T
        theta = np.clip(lower + away * expit(y), problem.lower, problem.upper)
        log_stretch = np.sum(np.log(away) - np.abs(y) - 2.0 * np.log1p(np.exp(-np.abs(y))), axis=1)
        log_q = constant - 0.5 * (_DF + n) * np.log1p(np.sum(z**2, axis=1) / _DF)
        points.append(theta)
        log_w.append(problem.log_prob(theta) + log_stretch - log_q)
    theta, log_weight = np.concatenate(points), np.concatenate(log_w)
    weight = np.exp(log_weight - logsumexp(log_weight))
    mean = weight @ theta
    sd = np.sqrt(weight @ (theta - mean) ** 2)
    ends = [[_quantile(x, weight, p) for x in theta.T] for p in TAILS]
    log_evidence = float(logsumexp(log_weight) - np.log(len(theta)))
    error = float(np.sqrt(np.sum(weight**2) - 1.0 / len(theta)))
    return Reference(np.array([mean, sd, *ends]), log_evidence, error, float(1.0 / np.sum(weight**2)))


def _quantile(x: FloatArray, weight: FloatArray, probability: float) -> float:
    order = np.argsort(x)
    return float(x[order][np.searchsorted(np.cumsum(weight[order]), probability)])


def replicate(case: str, seed: int) -> Replicate:
    """Make a run, and compare it with the reference."""
    exact = reference(case)
    began = time.process_time()
    trace = run(case, seed)
    table, draws = fmu.summary(trace), parameter_draws(trace)
    values = table[["mean", "sd", "eti90_lb", "eti90_ub"]].to_numpy().T
    of_sd = np.array([effective.mcse_sd(x) for x in np.moveaxis(draws, -1, 0)])
    errors = table[["mcse_mean", "mcse_eti90_lb", "mcse_eti90_ub"]].to_numpy().T
    errors = np.insert(errors, 1, of_sd, axis=0)
    found = [fmu.evidence(trace, method) for method in ("importance", "bridge")]
    return Replicate(
        case,
        seed,
        ((values - exact.values) / errors).tolist(),
        [(one.log_evidence - exact.log_evidence) / float(np.hypot(one.error, exact.error)) for one in found],
        float(table[["ess_bulk", "ess_tail"]].to_numpy().min()),
        time.process_time() - began,
    )


@dataclass(frozen=True)
class Row:
    """Errors over standard errors, (replicates, …): their mean, sd, and the share beyond 2.58."""

    what: tuple[str, ...]
    z: FloatArray

    @property
    def sd(self) -> float:
        """About their mean."""
        return float(np.std(self.z))

    @property
    def beyond(self) -> float:
        """Share of the errors."""
        return float(np.mean(np.abs(self.z) > BEYOND))

    @property
    def is_right(self) -> bool:
        """Whether the standard errors are what they should be."""
        return WITHIN[0] <= self.sd <= WITHIN[1] and self.beyond <= MOST_BEYOND

    def cells(self) -> list[str]:
        """Return the numbers of a table."""
        return [
            f"{self.z.mean():+.2f}", f"{self.sd:.2f}", f"{100 * self.beyond:.1f} %", f"{np.abs(self.z).max():.1f}",
        ]  # fmt: skip


def of_runs(runs: Sequence[Replicate]) -> list[Row]:
    """Return the rows of the posteriors."""
    rows = []
    for case in dict.fromkeys(one.case for one in runs):
        own = [one for one in runs if one.case == case]
        errors, of_evidence = np.array([one.errors for one in own]), np.array([one.of_evidence for one in own])
        rows += [Row((case, name), errors[:, k]) for k, name in enumerate(QUANTITIES)]
        rows += [Row((case, name), of_evidence[:, k]) for k, name in enumerate(EVIDENCES)]
    return rows


def of_process(number: int, process: Process) -> list[Row]:
    """Return the rows of a process."""
    truth = [process.quantile(p) for p in TAILS]
    z, ess = np.empty((OF_PROCESSES, 2)), np.empty((OF_PROCESSES, 2))
    for k, x in enumerate(process.runs(np.random.default_rng([30, number]), OF_PROCESSES)):
        found = np.quantile(x, TAILS)
        z[k] = (found - truth) / [effective.mcse_quantile(x, p, process.walkers) for p in TAILS]
        ess[k] = effective.ess_tail(x, process.walkers)
    title = (process.title, f"{np.median(ess):.0f}")
    return [Row((*title, f"{100 * p:g} %"), z[:, k]) for k, p in enumerate(TAILS)]


def main() -> int:
    """Run the study, write ``replicates.md``, and return the exit code."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    keys = [(case, seed) for seed in range(1, RUNS + 1) for case in CASES]
    with threadpool_limits(1):
        found = units.completed(
            "processes",
            enumerate(PROCESSES),
            lambda process: [asdict(row) for row in of_process(PROCESSES.index(process), process)],
        )
        processes = [Row(tuple(row["what"]), np.array(row["z"])) for of in found for row in of]
        runs = units.completed(
            "runs", each(keys), lambda key: replicate(*key), fields_of(Replicate, list), least=20
        )
        rows = of_runs(runs)
        wrong = [row for row in rows + processes if not row.is_right]
        write(asked.out, runs, rows, processes, wrong, units.processor_s)
    for row in wrong:
        print(", ".join((*row.what, *row.cells())))
    return 1 if wrong else 0


def write(
    directory: Path,
    runs: Sequence[Replicate],
    rows: Sequence[Row],
    processes: Sequence[Row],
    wrong: Sequence[Row],
    seconds: float,
) -> None:
    """Write ``replicates.md`` into the directory."""
    verdict = "**All standard errors are right.**"
    if wrong:
        verdict = "**Not right:** " + "; ".join(", ".join((*row.what, *row.cells())) for row in wrong)
    numbers = ["mean", "sd", "beyond 2.58", "largest"]
    parameters = []
    for row in rows:
        of_each = [Row(row.what, z) for z in np.atleast_2d(row.z.T)]
        spread = sorted(one.sd for one in of_each)
        parameters.append([*row.what, *row.cells(), f"{spread[0]:.2f} to {spread[-1]:.2f}"])
    references = [
        f"- {case}: {reference(case).effective:.0f} effective draws, log-evidence "
        f"{reference(case).log_evidence:.4f} ± {reference(case).error:.4f}; the runs have a median ESS of "
        f"{np.median([one.ess for one in runs if one.case == case]):.0f}"
        for case in CASES
    ]
    page = PAGE.format(
        minutes=seconds / 60.0,
        verdict=verdict,
        runs=" and ".join(dict.fromkeys(str(sum(one.case == case for one in runs)) for case in CASES)),
        draws=DRAWS,
        warmup=WARMUP,
        low=WITHIN[0],
        high=WITHIN[1],
        most=100 * MOST_BEYOND,
        references="\n".join(references),
        rows=markdown_table(["posterior", "quantity", *numbers, "sd by parameter"], parameters, words=(0, 1)),
        replicates=OF_PROCESSES,
        processes=markdown_table(
            ["process", "tail ESS", "quantile", *numbers],
            [[*row.what, *row.cells()] for row in processes],
            words=(0,),
        ),
    )
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "replicates.md").write_text(page, encoding="utf-8")


PAGE = """# Standard errors in replicates

Written by `make validate` in {minutes:.0f} minutes of processor time.

{verdict}

Each table shows errors over their Monte-Carlo standard errors: their mean, their sd, how many lie beyond 2.58,
and the largest. Normal errors over exact standard errors have an sd of 1, with 1.0 % beyond 2.58. A standard
error counts as right where the sd is {low} to {high} and at most {most:g} % lie beyond.

## Posteriors

{runs} runs of the mixture on each, of different seeds: {draws} draws after {warmup} steps of warm-up in 4 chains.
All parameters count alike; the last column has the smallest and the largest sd of a single parameter. The
reference is importance sampling by a t distribution that was fitted to another run. The error of its log-evidence
is added to that of a run:

{references}

{rows}

## Quantiles of known processes

{replicates} runs of 4 chains, or of 4 ensembles of 32 walkers, by `effective.mcse_quantile`. A *narrower proposal*
has weights without a bound: where a chain seldom gets to a region that it then does not leave, no error from its
draws can be right.

{processes}"""


if __name__ == "__main__":
    sys.exit(main())
