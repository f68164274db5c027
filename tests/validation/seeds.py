"""The paper's second experiment by number, and its first by shape, twenty times each: do all runs end the same?

    python -m tests.validation.seeds OUT_DIRECTORY [--kept FILE]

Exit code 1 where a run of default length has not converged, or has a wrong mass of a maximum or a wrong
log-evidence. With a file, runs that it holds are not repeated.
"""

from __future__ import annotations

import argparse
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
from fmu.tables import markdown_table
from tests.validation.evidence import Estimate, weighed
from tests.validation.kept import completed, kept_lines

SEEDS = 20
REFERENCE_DRAWS = 65_536
WRONG = 5.0
"""Monte-Carlo standard errors that the mass of a maximum may be off by."""


class Experiment(NamedTuple):
    """Case, pairing, starts and samplers, and how far from the reference a log-evidence may be."""

    case: str
    pairing: str
    starts: tuple[str, ...]
    samplers: tuple[str, ...]
    within: float


EXPERIMENTS = (
    Experiment("cantilever-section", "index", ("start", "prior"), ("mixture", "mh", "slice", "hmc"), 0.03),
    Experiment("cantilever-young", "shape", ("maxima",), ("mixture",), 0.02),
)


@dataclass(frozen=True)
class Outcome:
    """One run of default length.

    Attributes
    ----------
    case, sampler, start : str
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
    processor_s : float
    """

    case: str
    sampler: str
    start: str
    seed: int
    converged: bool
    rhat: float
    ess: float
    mass: float
    log_evidence: tuple[float, ...]
    n_solves: int
    processor_s: float


def jobs() -> Iterator[tuple[Experiment, str, str, int]]:
    """Yield all runs."""
    for seed in range(1, SEEDS + 1):
        for one in EXPERIMENTS:
            yield from ((one, sampler, start, seed) for sampler in one.samplers for start in one.starts)


@cache
def problem_of(case: str) -> tuple[fmu.UpdatingProblem, Any]:
    """Return a problem and its maxima."""
    (one,) = (one for one in EXPERIMENTS if one.case == case)
    problem = fmu.cases.load(case, one.pairing)
    return problem, fmu.find_map(problem)


@cache
def reference(case: str) -> Estimate:
    """Return the log-evidence by importance sampling around the maxima, which knows nothing of a mixture."""
    problem, maxima = problem_of(case)
    return weighed(problem, [m for m in maxima if m.share > 1e-12], REFERENCE_DRAWS)


def outcome(case: str, sampler: str, start: str, seed: int) -> Outcome:
    """Make a run."""
    began = time.process_time()
    problem, maxima = problem_of(case)
    jumps = None if sampler != "mixture" else False
    trace = fmu.sample(problem, sampler, init=start, seed=seed, maxima=maxima, jumps=jumps, progress=False)
    table, seen = fmu.summary(trace), visits(trace, maxima)
    errors = [0.0]
    for share, error, m in zip(seen.share / seen.share.sum(), seen.error, maxima, strict=True):
        if m.share < 1e-3:
            errors.append(0.0 if share < 1e-3 else np.inf)
        elif abs(share - m.share) > 1e-3:
            errors.append(abs(share - m.share) / error)
    return Outcome(
        case,
        sampler,
        start,
        seed,
        converged=fmu.diagnose(trace).converged,
        rhat=float(table["rhat"].max()),
        ess=float(table["ess_bulk"].min()),
        mass=float(np.max(errors)),
        log_evidence=tuple(fmu.evidence(trace, method).log_evidence for method in OF_MIXTURE),
        n_solves=int(trace.attrs["n_solves"]) + int(trace.attrs["warmup_n_solves"]),
        processor_s=time.process_time() - began,
    )


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """Return what is wrong, a sentence each."""
    found = []
    for one in outcomes:
        (within,) = (each.within for each in EXPERIMENTS if each.case == one.case)
        what = f"{one.case}, {one.sampler} from {one.start}, seed {one.seed}"
        off = np.abs(np.array(one.log_evidence) - reference(one.case).log_evidence)
        if not one.converged:
            found.append(f"{what}: not converged, R-hat {one.rhat:.3f}")
        if not one.mass <= WRONG:
            found.append(f"{what}: the mass of a maximum is off by {one.mass:.1f} standard errors")
        if not np.all(off <= within):
            found.append(f"{what}: the log-evidence is off by {off.max():.3f}; {within:g} is allowed")
    return found


def main(directory: Path, kept: Path | None) -> int:
    """Run the study, write ``seeds.md``, and return the exit code."""
    known = [Outcome(**fields) for fields in kept_lines(kept)]
    done = {(one.case, one.sampler, one.start, one.seed): one for one in known}
    keys = [(one.case, sampler, start, seed) for one, sampler, start, seed in jobs()]
    with threadpool_limits(1):
        outcomes = completed(zip(keys, keys, strict=True), done, lambda key: outcome(*key), kept)
        write(outcomes, directory)
        wrong = failures(outcomes)
    for failure in wrong:
        print(failure)
    return 1 if wrong else 0


def write(outcomes: Sequence[Outcome], directory: Path) -> None:
    """Write ``seeds.md`` into the directory."""
    wrong, rows = failures(outcomes), []
    for case, sampler, start in dict.fromkeys((one.case, one.sampler, one.start) for one in outcomes):
        runs = [one for one in outcomes if (one.case, one.sampler, one.start) == (case, sampler, start)]
        z = np.array([one.log_evidence for one in runs])
        rows.append([
            case, sampler, start,
            f"{sum(one.converged for one in runs)} of {len(runs)}",
            f"{max(one.rhat for one in runs):.4f}",
            f"{min(one.ess for one in runs):.0f}",
            f"{max(one.mass for one in runs):.1f}",
            *(f"{x.mean():.3f}, {np.max(np.abs(x - reference(case).log_evidence)):.3f}" for x in z.T),
            f"{np.median([one.n_solves for one in runs]):.0f}",
        ])  # fmt: skip
    head = [
        "case", "sampler", "start", "converged", "largest R-hat", "smallest bulk ESS", "mass, worst",
        *(f"log-evidence by {method}: mean, worst error" for method in OF_MIXTURE), "evaluations",
    ]  # fmt: skip
    verdict = "**All runs converged, with right masses and evidences.**"
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
                f"- {one.case}, by {'number' if one.pairing == 'index' else one.pairing}: "
                f"{reference(one.case).log_evidence:.3f} ± {reference(one.case).error:.3f}; "
                f"a run may be off by {one.within:g}"
                for one in EXPERIMENTS
            ),
            rows=markdown_table(head, rows, words=(0, 1, 2)),
        ),
        encoding="utf-8",
    )


PAGE = """# Twenty seeds

Written by `make validate`{so_far} in {minutes:.0f} minutes of processor time.

{verdict}

Runs of default length, 1000 draws after 1000 steps of warm-up in 4 chains. cantilever-section by number is
section 5.2 of the paper: its highest maximum holds all of the probability, and chains with local steps alone
seldom reach it from the paper's start or from the prior (`evidence.md` says where the maxima are). mh, slice and
hmc have jumps there, which is the default. A run fails if `fmu.diagnose` does not call it converged, if the share
of the draws at a maximum is off by more than {wrong:g} standard errors from its mass, or if the log-evidence is
off from that of importance sampling around the maxima, which knows nothing of a mixture:

{references}

{rows}"""


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.validation.seeds")
    parser.add_argument("directory", type=Path)
    parser.add_argument("--kept", type=Path, help="file of the runs made so far, one a line; it is continued")
    sys.exit(main(**vars(parser.parse_args())))
