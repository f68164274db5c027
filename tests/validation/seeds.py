"""Do runs of default length agree whatever the seed, and how efficient is the mixture sampler?

    python -m tests.validation.seeds OUT [--kept DIRECTORY] [--minutes M]

The paper's second experiment paired by number, and its first paired by shape, are sampled with 20 seeds each, and
three more posteriors with 5 seeds. Exit code 1 if a run of default length has not converged or has a wrong mass of
a maximum or a wrong log-evidence, or if the mixture has fewer effective draws per evaluation than required.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.evidence import OF_MIXTURE
from fmu.analysis.maxima.missed import visits
from fmu.analysis.trace.reading import in_solves
from fmu.tables import markdown_table
from tests.validation.evidence import Estimate, weighed
from tests.validation.kept import Units, fields_of, study_parser

SEEDS = 20
REFERENCE_DRAWS = 65_536
WRONG = 5.0
"""Largest error of the mass of a maximum, in Monte-Carlo standard errors."""


class Experiment(NamedTuple):
    """A posterior, how it is sampled, and the requirements on the runs.

    `within` is the largest error of a log-evidence. `wanted` is the smallest median of the mixture's effective
    draws per evaluation. `seeds` is the number of seeds.
    """

    case: str
    pairing: str
    starts: tuple[str, ...]
    samplers: tuple[str, ...]
    within: float
    wanted: float
    seeds: int = 5

    @property
    def words(self) -> str:
        """Name on the page."""
        return f"{self.case}, by {'number' if self.pairing == 'index' else self.pairing}"


EXPERIMENTS = (
    Experiment(
        "cantilever-section", "index", ("start", "prior"), ("mixture", "mh", "slice", "hmc"), 0.03, 0.6, SEEDS
    ),
    Experiment("cantilever-young", "shape", ("maxima",), ("mixture",), 0.02, 0.4, SEEDS),
    Experiment("cantilever-young", "index", ("maxima",), ("mixture",), 0.02, 0.6),
    Experiment("cantilever-section", "shape", ("maxima",), ("mixture",), 0.02, 0.6),
    Experiment("garteur", "shape", ("maxima",), ("mixture",), 0.1, 0.12),
)


@dataclass(frozen=True)
class Outcome:
    """One run of default length.

    Attributes
    ----------
    case, pairing, sampler, start : str
    seed : int
    converged : bool
    rhat, ess : float
        Of the worst parameter.
    mass : float
        Largest error of the mass of a maximum, in Monte-Carlo standard errors; errors below 0.001 count as 0.
        Infinite if more than 0.001 of the draws are at a maximum of negligible mass.
    log_evidence : tuple of float
        By importance sampling and by bridge sampling.
    n_solves : int
        Warm-up included.
    per_evaluation : float
        `ess` per evaluation after the warm-up. A gradient counts as the number of log-probabilities that it costs.
    processor_s : float
    """

    case: str
    pairing: str
    sampler: str
    start: str
    seed: int
    converged: bool
    rhat: float
    ess: float
    mass: float
    log_evidence: tuple[float, ...]
    n_solves: int
    per_evaluation: float
    processor_s: float

    @property
    def experiment(self) -> Experiment:
        """The experiment to which the run belongs."""
        (found,) = (one for one in EXPERIMENTS if (one.case, one.pairing) == (self.case, self.pairing))
        return found


def jobs() -> Iterator[tuple[Experiment, str, str, int]]:
    """Yield all runs."""
    for seed in range(1, SEEDS + 1):
        for one in EXPERIMENTS:
            if seed <= one.seeds:
                yield from ((one, sampler, start, seed) for sampler in one.samplers for start in one.starts)


@cache
def problem_of(one: Experiment) -> tuple[fmu.UpdatingProblem, Any]:
    """Return a problem and its maxima."""
    problem = fmu.cases.load(one.case, one.pairing)
    return problem, fmu.find_map(problem)


@cache
def reference(one: Experiment) -> Estimate:
    """Return the log-evidence by importance sampling around the maxima, which uses no draws of a sampler."""
    problem, maxima = problem_of(one)
    return weighed(problem, [m for m in maxima if m.share > 1e-12], REFERENCE_DRAWS)


def outcome(one: Experiment, sampler: str, start: str, seed: int) -> Outcome:
    """Make a run."""
    began = time.process_time()
    problem, maxima = problem_of(one)
    jumps = None if sampler != "mixture" else False
    trace = fmu.sample(problem, sampler, init=start, seed=seed, maxima=maxima, jumps=jumps, progress=False)
    table, seen = fmu.summary(trace), visits(trace, maxima)
    errors = [0.0]
    for share, error, m in zip(seen.share / seen.share.sum(), seen.error, maxima, strict=True):
        if m.share < 1e-3:
            errors.append(0.0 if share < 1e-3 else np.inf)
        elif abs(share - m.share) > 1e-3:
            errors.append(abs(share - m.share) / error)
    ess, solves = float(table["ess_bulk"].min()), int(trace.attrs["n_solves"])
    return Outcome(
        one.case,
        one.pairing,
        sampler,
        start,
        seed,
        converged=fmu.diagnose(trace).converged,
        rhat=float(table["rhat"].max()),
        ess=ess,
        mass=float(np.max(errors)),
        log_evidence=tuple(fmu.evidence(trace, method).log_evidence for method in OF_MIXTURE),
        n_solves=solves + int(trace.attrs["warmup_n_solves"]),
        per_evaluation=ess / float(in_solves(trace, solves, trace.attrs["n_gradients"])),
        processor_s=time.process_time() - began,
    )


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the criteria that are not met, one sentence each."""
    found = []
    for one in outcomes:
        within = one.experiment.within
        what = f"{one.experiment.words}, {one.sampler} from {one.start}, seed {one.seed}"
        off = np.abs(np.array(one.log_evidence) - reference(one.experiment).log_evidence)
        if not one.converged:
            found.append(f"{what}: not converged (R-hat {one.rhat:.3f}, bulk ESS {one.ess:.0f})")
        if not one.mass <= WRONG:
            found.append(
                f"{what}: the mass of a maximum is off by {one.mass:.1f} Monte-Carlo standard errors "
                f"({WRONG:g} allowed)"
            )
        if not np.all(off <= within):
            found.append(f"{what}: the log-evidence is off by {off.max():.3f} ({within:g} allowed)")
    for experiment, median in efficiencies(outcomes).items():
        if not median >= experiment.wanted:
            found.append(
                f"{experiment.words}: the mixture has {median:.2f} effective draws per evaluation "
                f"({experiment.wanted:g} required)"
            )
    return found


def efficiencies(outcomes: Sequence[Outcome]) -> dict[Experiment, float]:
    """Return the mixture's median number of effective draws per evaluation on each posterior."""
    found: dict[Experiment, list[float]] = {}
    for one in outcomes:
        if one.sampler == "mixture":
            found.setdefault(one.experiment, []).append(one.per_evaluation)
    return {experiment: float(np.median(values)) for experiment, values in found.items()}


def main() -> int:
    """Run the study, write ``seeds.md``, and return the exit code."""
    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    keyed = (((one.case, one.pairing, *rest), (one, *rest)) for one, *rest in jobs())
    with threadpool_limits(1):
        outcomes = units.completed("runs", keyed, lambda job: outcome(*job), fields_of(Outcome))
        write(outcomes, asked.out)
        wrong = failures(outcomes)
    for failure in wrong:
        print(failure)
    return 1 if wrong else 0


def write(outcomes: Sequence[Outcome], directory: Path) -> None:
    """Write ``seeds.md`` into the directory."""
    wrong, rows = failures(outcomes), []
    medians = efficiencies(outcomes)
    kinds = dict.fromkeys((one.experiment, one.sampler, one.start) for one in outcomes)
    for experiment, sampler, start in kinds:
        runs = [
            one for one in outcomes if (one.experiment, one.sampler, one.start) == (experiment, sampler, start)
        ]
        z = np.array([one.log_evidence for one in runs])
        rows.append([
            experiment.words, sampler, start,
            f"{sum(one.converged for one in runs)} of {len(runs)}",
            f"{max(one.rhat for one in runs):.4f}",
            f"{min(one.ess for one in runs):.0f}",
            f"{max(one.mass for one in runs):.1f}",
            *(f"{x.mean():.3f}, {np.max(np.abs(x - reference(experiment).log_evidence)):.3f}" for x in z.T),
            f"{np.median([one.n_solves for one in runs]):.0f}",
            f"{np.median([one.per_evaluation for one in runs]):.2f}",
        ])  # fmt: skip
    head = [
        "case, pairing", "sampler", "start", "converged", "largest R-hat", "smallest bulk ESS",
        "largest error of a mass", *(f"log-evidence by {method}: mean, largest error" for method in OF_MIXTURE),
        "evaluations", "ESS per evaluation",
    ]  # fmt: skip
    verdict = "**Yes: all runs converged with correct masses and evidences, and the mixture is efficient enough.**"
    if wrong:
        verdict = "**Not in all runs:**\n\n" + "\n".join(f"- {failure}" for failure in wrong)
    planned = len(list(jobs()))
    runs = f"All {planned} runs" if len(outcomes) >= planned else f"The {len(outcomes)} of {planned} runs so far"
    required = [
        [
            one.words,
            str(one.seeds),
            f"{reference(one).log_evidence:.3f} ± {reference(one).error:.3f}",
            f"{one.within:g}",
            f"{one.wanted:g}",
            f"{median:.2f}",
        ]
        for one, median in medians.items()
    ]
    of_required = [
        "case, pairing", "seeds", "reference log-evidence", "largest error allowed", "ESS per evaluation required",
        "ESS per evaluation of the mixture, median",
    ]  # fmt: skip
    (directory / "seeds.md").write_text(
        PAGE.format(
            runs=runs,
            minutes=sum(one.processor_s for one in outcomes) / 60.0,
            verdict=verdict,
            wrong=WRONG,
            required=markdown_table(of_required, required).rstrip(),
            rows=markdown_table(head, rows, words=(0, 1, 2)),
        ),
        encoding="utf-8",
    )


PAGE = """# Agreement of runs with different seeds

Do runs of default length converge whatever the seed, with the correct masses of the maxima and the correct
evidence, and does the mixture sampler have enough effective draws per evaluation? {verdict}

{runs} took {minutes:.0f} minutes of processor time. Each has 1000 draws after 1000 steps of warm-up in 4
chains. cantilever-section by number is section 5.2 of the paper. Its highest maximum holds all of the
probability, but chains with only local steps seldom reach it from the paper's start or from the prior
([evidence.md](evidence.md) has the maxima). mh, slice and hmc therefore jump between the maxima, which is their
default. A run passes if

- `fmu.diagnose` calls it converged,
- the share of the draws at each maximum is within {wrong:g} Monte-Carlo standard errors of the mass of the
  maximum (a difference below 0.001 counts as 0), and
- its log-evidence is close enough to the reference, which is importance sampling around the maxima without any
  draws of a sampler.

ESS per evaluation is the smallest bulk ESS of a parameter divided by the evaluations after warm-up. A gradient
counts as the number of log-probabilities that it costs. The lower table has medians of evaluations (warm-up
included) and of ESS per evaluation, and errors of masses in Monte-Carlo standard errors.

{required}

{rows}"""


if __name__ == "__main__":
    sys.exit(main())
