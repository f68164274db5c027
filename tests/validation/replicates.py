"""Compare Monte-Carlo standard errors with the actual errors of estimates, in many replicate runs.

    python -m tests.validation.replicates OUT [--kept DIRECTORY] [--minutes M]

On each of two posteriors, 400 short runs estimate means, standard deviations, 5 % and 95 % quantiles and
log-evidences. The reference is an independent importance sampling. Quantiles are also checked on processes whose
quantiles are known. Each error is divided by its standard error. The exit code is 1 if the ratios have a root mean
square outside 0.9 to 1.1, or if more than 2.5 % of them lie beyond 2.58. Runs stored in the directory of
``--kept`` are not repeated.
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
from fmu.numbers import whole
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
QUANTITIES = ("posterior mean", "posterior sd", "5 % quantile", "95 % quantile")
EVIDENCES = ("log-evidence, importance sampling", "log-evidence, bridge sampling")
_DF = 5.0


def _building() -> fmu.UpdatingProblem:
    return storeys.problem(storeys.reduced_model(), np.array([3.3, 8.6]))


CASES: dict[str, Callable[[], fmu.UpdatingProblem]] = {
    "cantilever-young, by shape": lambda: fmu.cases.load("cantilever-young", "shape"),
    "building of three parameters": _building,
}


@dataclass(frozen=True)
class Replicate:
    """Errors of one run, each divided by its standard error.

    Attributes
    ----------
    case : str
    seed : int
    errors : list of list of float
        One list per entry of `QUANTITIES`, with one value per parameter.
    of_evidence : list of float
        One value per entry of `EVIDENCES`.
    ess : float
        The smallest bulk or tail ESS of all parameters.
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
    """Results of importance sampling.

    Attributes
    ----------
    values : ndarray, shape (4, ndim)
        `QUANTITIES` of each parameter.
    log_evidence, error : float
        The log-evidence and its standard error.
    effective : float
        Number of effective draws.
    """

    values: FloatArray
    log_evidence: float
    error: float
    effective: float


class _Drawn(Exception):  # noqa: N818
    """Raised once the draws exist, to skip predictions and leave-one-out analyses."""


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
    """Return the reference values of a posterior by importance sampling.

    The proposal is a multivariate t distribution of log(u/(1 − u)), where u in (0, 1) is the position between the
    bounds. It is fitted to the draws of a separate run.
    """
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
    """Make one run and compare it with the reference."""
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
    """Errors divided by their standard errors, shape (replicates, …), and the labels of their table row."""

    what: tuple[str, ...]
    z: FloatArray

    @property
    def rms(self) -> float:
        """Root mean square of the ratios: their bias counts too."""
        return float(np.sqrt(np.mean(self.z**2)))

    @property
    def beyond(self) -> float:
        """Share of the ratios that exceed 2.58 in absolute value."""
        return float(np.mean(np.abs(self.z) > BEYOND))

    @property
    def is_right(self) -> bool:
        """Whether the standard errors pass the test."""
        return WITHIN[0] <= self.rms <= WITHIN[1] and self.beyond <= MOST_BEYOND

    @property
    def name(self) -> str:
        """The estimate in words."""
        if len(self.what) == 2:  # posterior, quantity
            return ", ".join(self.what)
        title, ess, quantile = self.what
        return f"{title} (tail ESS {ess}), {quantile} quantile"

    @property
    def failure(self) -> str:
        """The estimate in words, with the number that fails the test."""
        if self.beyond > MOST_BEYOND:
            return f"{self.name}: {100 * self.beyond:.2f} % of the errors exceed {BEYOND} standard errors"
        return f"{self.name}: errors divided by standard errors have a root mean square of {self.rms:.3f}"

    def cells(self) -> list[str]:
        """Return the table cells with the numbers of this row."""
        return [
            f"{self.z.mean():+.2f}",
            f"{self.rms:.2f}",
            f"{100 * self.beyond:.1f} %",
            f"{np.abs(self.z).max():.1f}",
        ]


def of_runs(runs: Sequence[Replicate]) -> list[Row]:
    """Return the table rows of the posteriors."""
    rows = []
    for case in dict.fromkeys(one.case for one in runs):
        own = [one for one in runs if one.case == case]
        errors, of_evidence = np.array([one.errors for one in own]), np.array([one.of_evidence for one in own])
        rows += [Row((case, name), errors[:, k]) for k, name in enumerate(QUANTITIES)]
        rows += [Row((case, name), of_evidence[:, k]) for k, name in enumerate(EVIDENCES)]
    return rows


def of_process(number: int, process: Process) -> list[Row]:
    """Return the table rows of a process."""
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
        print(row.failure)
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
    total = len(rows) + len(processes)
    verdict = f"**All {total} standard errors pass.**"
    if wrong:
        verdict = f"**{len(wrong)} of {total} standard errors fail:**\n\n"
        verdict += "\n".join(f"- {row.failure}" for row in wrong)
    numbers = ["mean ratio", "rms of ratios", f"beyond {BEYOND}", "largest ratio"]
    parameters = []
    for row in rows:
        of_each = [Row(row.what, z) for z in np.atleast_2d(row.z.T)]
        spread = sorted(one.rms for one in of_each)
        parameters.append([*row.what, *row.cells(), f"{spread[0]:.2f} to {spread[-1]:.2f}"])
    references = [
        f"- {case}: {whole(round(reference(case).effective))} effective draws, log-evidence "
        f"{reference(case).log_evidence:.4f} ± {reference(case).error:.4f}. The median ESS of the runs is "
        f"{np.median([one.ess for one in runs if one.case == case]):.0f}."
        for case in CASES
    ]
    page = PAGE.format(
        minutes=seconds / 60.0,
        verdict=verdict,
        runs=" and ".join(dict.fromkeys(str(sum(one.case == case for one in runs)) for case in CASES)),
        draws=DRAWS,
        warmup=WARMUP,
        beyond=BEYOND,
        low=WITHIN[0],
        high=WITHIN[1],
        most=100 * MOST_BEYOND,
        references="\n".join(references),
        rows=markdown_table(["posterior", "quantity", *numbers, "rms by parameter"], parameters, words=(0, 1)),
        replicates=OF_PROCESSES,
        processes=markdown_table(
            ["process", "median tail ESS", "quantile", *numbers],
            [[*row.what, *row.cells()] for row in processes],
            words=(0,),
        ),
    )
    (directory / "replicates.md").write_text(page, encoding="utf-8")


PAGE = """# Monte-Carlo standard errors in replicate runs

Do the Monte-Carlo standard errors that fmu reports match the actual errors of its estimates?

{verdict}

The error of each estimate is divided by its standard error. The tables show the mean and the root mean square
(rms) of this ratio over many runs, the share of ratios beyond ±{beyond}, and the largest absolute ratio. If errors
are normal and standard errors exact, the mean is 0, the rms is 1 and 1.0 % of the ratios lie beyond ±{beyond}. A
standard error passes if the rms is between {low} and {high} and at most {most:g} % of the ratios lie beyond
±{beyond}. Bias raises the rms, so biased estimates fail too. The study took {minutes:.0f} minutes of processor
time.

## Posteriors

The posteriors are the paper's beam, with five Young's moduli and modes paired by shape, and a shear building with
two stiffnesses and a mass as parameters. Runs of the mixture sampler on each: {runs}. Every run has its own
seed and 4 chains of {draws} draws after {warmup} steps of warm-up. A row pools all parameters; the last column
gives the smallest and the largest rms of a single parameter. Reference values come from importance sampling with a
t distribution fitted to a separate run. The standard error of a log-evidence includes the error of the reference:

{references}

{rows}

## Quantiles of known processes

Each process is simulated {replicates} times with 4 chains, or with 4 ensembles of 32 walkers. The standard errors
are those of `effective.mcse_quantile`. AR(1) processes are Gaussian, transformed to the marginal distribution
named. With the *narrower proposal*, importance weights are unbounded: a chain seldom reaches the tails and then
stays there for long, so the standard error from a short run is too small.

{processes}"""


if __name__ == "__main__":
    sys.exit(main())
