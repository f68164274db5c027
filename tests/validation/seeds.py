"""The paper's second experiment by number, and its first by shape, twenty times each: do all runs end the same?

And with three more posteriors, five times each: how many effective draws has the mixture per evaluation?

    python -m tests.validation.seeds OUT [--kept DIRECTORY] [--minutes M]

Exit code 1 where a run of default length has not converged, has a wrong mass of a maximum or a wrong log-evidence,
or where the mixture has fewer effective draws per evaluation than wanted. With a file, runs that it holds are not
repeated.
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
"""Monte-Carlo standard errors that the mass of a maximum may be off by."""


class Experiment(NamedTuple):
    """Case, pairing, starts, samplers; what is wanted of the log-evidence and of the mixture; and the seeds.

    `within` is how far from the reference a log-evidence may be, and `wanted` the least median of effective draws
    per evaluation.
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
        """What it is called on the page."""
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
        Error of the mass of a maximum, the largest, in its standard errors; infinite where a maximum that holds
        nothing was visited by more than a thousandth of the draws.
    log_evidence : tuple of float
        By importance and by bridge.
    n_solves : int
        Warm-up included.
    per_evaluation : float
        `ess` per evaluation after the warm-up, where a gradient counts as the log-probabilities that it costs.
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
        """The experiment that it is a run of."""
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
    """Return the log-evidence by importance sampling around the maxima, which knows nothing of a mixture."""
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
    """Return what is wrong, a sentence each."""
    found = []
    for one in outcomes:
        within = one.experiment.within
        what = f"{one.experiment.words}, {one.sampler} from {one.start}, seed {one.seed}"
        off = np.abs(np.array(one.log_evidence) - reference(one.experiment).log_evidence)
        if not one.converged:
            found.append(f"{what}: not converged, R-hat {one.rhat:.3f}")
        if not one.mass <= WRONG:
            found.append(f"{what}: the mass of a maximum is off by {one.mass:.1f} standard errors")
        if not np.all(off <= within):
            found.append(f"{what}: the log-evidence is off by {off.max():.3f}; {within:g} is allowed")
    for experiment, median in efficiencies(outcomes).items():
        if not median >= experiment.wanted:
            found.append(
                f"{experiment.words}: the mixture has {median:.2f} effective draws per evaluation; "
                f"{experiment.wanted:g} are wanted"
            )
    return found


def efficiencies(outcomes: Sequence[Outcome]) -> dict[Experiment, float]:
    """Return the median of the mixture's effective draws per evaluation on each posterior."""
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
        "case", "sampler", "start", "converged", "largest R-hat", "smallest bulk ESS", "mass, worst",
        *(f"log-evidence by {method}: mean, worst error" for method in OF_MIXTURE), "evaluations",
        "ESS per evaluation",
    ]  # fmt: skip
    verdict = "**All runs converged, with right masses and evidences; the mixture is as efficient as wanted.**"
    if wrong:
        verdict = "**Wrong:**\n\n" + "\n".join(f"- {failure}" for failure in wrong)
    planned = len(list(jobs()))
    so_far = "" if len(outcomes) >= planned else f", with {len(outcomes)} of its {planned} runs so far,"
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "seeds.md").write_text(
        PAGE.format(
            so_far=so_far,
            minutes=sum(one.processor_s for one in outcomes) / 60.0,
            verdict=verdict,
            seeds=SEEDS,
            wrong=WRONG,
            references="\n".join(
                f"- {one.words}: {reference(one).log_evidence:.3f} ± {reference(one).error:.3f}; "
                f"a run may be off by {one.within:g}"
                for one in medians
            ),
            wanted="\n".join(
                f"- {one.words}: {median:.2f}, wanted ≥ {one.wanted:g}" for one, median in medians.items()
            ),
            rows=markdown_table(head, rows, words=(0, 1, 2)),
        ),
        encoding="utf-8",
    )


PAGE = """# Twenty seeds

Written by `make validate`{so_far} in {minutes:.0f} minutes of processor time.

{verdict}

Runs of default length, 1000 draws after 1000 steps of warm-up in 4 chains, of {seeds} seeds, or of 5 where the
mixture alone is tried on a further posterior. cantilever-section by number is
section 5.2 of the paper: its highest maximum holds all of the probability, and chains with local steps alone
seldom reach it from the paper's start or from the prior (`evidence.md` says where the maxima are). mh, slice and
hmc have jumps there, which is the default. A run fails if `fmu.diagnose` does not call it converged, if the share
of the draws at a maximum is off by more than {wrong:g} standard errors from its mass, or if the log-evidence is
off from that of importance sampling around the maxima, which knows nothing of a mixture:

{references}

*ESS per evaluation* is the smallest bulk ESS of a parameter over the evaluations after the warm-up, a gradient
counted as the log-probabilities that it costs; the median of the runs. Of all runs of the mixture:

{wanted}

{rows}"""


if __name__ == "__main__":
    sys.exit(main())
