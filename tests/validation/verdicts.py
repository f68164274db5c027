"""Is a run that is reported as converged correct? All samplers on posteriors with known moments.

    python -m tests.validation.verdicts OUT [--kept DIRECTORY] [--minutes M]

The exit code is 1 if a run is reported as converged and is wrong. Runs stored in the directory of ``--kept`` are
not repeated.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import beta as beta_distribution
from scipy.stats import t as student
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.convergence.diagnosis import LOCALLY
from fmu.analysis.convergence.effective import mcse_mean
from fmu.analysis.evidence import OF_MIXTURE, has_candidates
from fmu.analysis.maxima.missed import nearest_maxima
from fmu.analysis.maxima.results import Maxima
from fmu.analysis.trace.reading import parameter_draws, walkers_of
from fmu.samplers.registry import SAMPLERS, make_sampler
from fmu.types import FloatArray
from tests.validation.kept import Units, fields_of, study_parser
from tests.validation.known import FURTHER, KNOWN, Known

WRONG = 5.0
"""Largest error of a mean of a converged run, in Monte-Carlo standard errors."""
FEWEST_RUNS, FEWEST_WITH_CANDIDATES = 500, 400
CHAINS = 4
JUMPS = " with jumps"
WITH_CANDIDATES = ("mixture", *(name + JUMPS for name in ("mh", "slice", "hmc")))
"""Samplers that take proposals from a fitted mixture."""
OF_ANY_DENSITY = tuple(name for name in SAMPLERS if name != "gibbs")
"""Gibbs sampling needs a population over several tests."""
NAMES = (*OF_ANY_DENSITY, *WITH_CANDIDATES[1:])


class Length(NamedTuple):
    """Steps of a run, and numbers of seeds on plain densities and on frames; emcee, which is slow, has its own."""

    warmup: int
    draws: int
    until_ess: float | None
    seeds: tuple[int, int]
    seeds_emcee: tuple[int, int]


LENGTHS = {
    "short": Length(100, 150, None, (4, 3), (4, 3)),
    "until good": Length(300, 100, 400.0, (4, 1), (1, 1)),
    "default": Length(1000, 1000, None, (1, 1), (1, 1)),
}
SEEDS_AT_ONE_PLACE = (2, 1)
"""Numbers of seeds of runs started at one maximum, on plain densities and on frames."""
SEEDS_WITH_JUMPS, SEEDS_ALL = (1, 2), 4
"""Numbers of seeds on posteriors without and with separated maxima; number where all maxima are known."""
USUAL, ONE_PLACE, ALL = "usual", "one maximum", "all maxima"
"""Where the chains start: as `fmu.sample` chooses; at one maximum; around all maxima, known by formula."""


class Job(NamedTuple):
    """One planned run."""

    known: Known
    sampler: str
    length: str
    start: str
    seed: int

    @property
    def key(self) -> tuple[str, str, str, str, int]:
        """Key that identifies the run."""
        return self.known.name, self.sampler, self.length, self.start, self.seed


@dataclass(frozen=True)
class Outcome:
    """Verdict on a run, and its errors.

    Attributes
    ----------
    name, sampler, length, start : str
    seed : int
    converged, searched : bool
        The verdict, and whether the search for maxima excludes further maxima.
    told : bool
        Whether the verdict is "converged locally".
    reason : str
        First reason why the run has not converged.
    draws : int
        Number of retained steps.
    of_means, of_variances : tuple of float
        Error of every mean, and of every mean of (x − μ)² about the exact μ, divided by its MCSE.
    mcse : tuple of float
        MCSE of every mean.
    ess : float
        The smallest bulk ESS.
    processor_s : float
    of_evidence : tuple of float
        Errors of the log-evidence by importance and bridge sampling, divided by their standard errors; empty
        without mixture proposals, or if `fmu.evidence` warns.
    been_everywhere : bool
        Whether each separated maximum had a draw near it, during warm-up or after it.
    """

    name: str
    sampler: str
    length: str
    start: str
    seed: int
    converged: bool
    searched: bool
    told: bool
    reason: str
    draws: int
    of_means: tuple[float, ...]
    of_variances: tuple[float, ...]
    mcse: tuple[float, ...]
    ess: float
    processor_s: float
    of_evidence: tuple[float, ...] = ()
    been_everywhere: bool = True

    @property
    def worst(self) -> float:
        """The largest error of a mean, in MCSE."""
        return float(np.max(np.abs(self.of_means)))

    @property
    def is_wrong(self) -> bool:
        """Whether the run was reported as converged with a mean off by more than `WRONG` MCSE, or by NaN."""
        return self.converged and not self.worst <= WRONG


def jobs() -> Iterator[Job]:
    """Yield all planned runs, the cheap ones first."""
    for length, (_, _, _, seeds, seeds_emcee) in LENGTHS.items():
        for known in (*KNOWN, *FURTHER):
            for sampler in OF_ANY_DENSITY if known in KNOWN else WITH_CANDIDATES[:1]:
                count = (seeds_emcee if sampler == "emcee" else seeds)[known.is_searched]
                yield from (Job(known, sampler, length, USUAL, seed) for seed in range(1, count + 1))
    for known in (*KNOWN, *FURTHER):
        if known.one_place is not None:
            for sampler in NAMES if known in KNOWN else WITH_CANDIDATES:
                for seed in range(1, SEEDS_AT_ONE_PLACE[known.is_searched] + 1):
                    yield Job(known, sampler, "until good", ONE_PLACE, seed)
        for sampler in WITH_CANDIDATES[1:]:
            for seed in range(1, SEEDS_WITH_JUMPS[known.one_place is not None] + 1):
                yield Job(known, sampler, "until good", USUAL, seed)
        if known.maxima is not None:
            for sampler in WITH_CANDIDATES:
                yield from (Job(known, sampler, "until good", ALL, seed) for seed in range(1, SEEDS_ALL + 1))


def outcome(job: Job) -> Outcome:
    """Make a run and compare it with the known moments."""
    began, length = time.process_time(), LENGTHS[job.length]
    density, truth = job.known.density, job.known.truth
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of divergent trajectories far from the mass, and of the reduced model
        trace = fmu.sample(
            density,
            job.sampler.removesuffix(JUMPS),
            draws=length.draws,
            warmup=length.warmup,
            chains=CHAINS,
            seed=job.seed,
            init=_at(job) if job.start == ONE_PLACE else "maxima",
            jumps=JUMPS in job.sampler,
            maxima=job.known.maxima if job.start == ALL else None,
            until_ess=length.until_ess,
            progress=False,
        )
        found = fmu.diagnose(trace, density if job.known.is_searched else None)
    draws, walkers = parameter_draws(trace), walkers_of(trace)
    means, variances, errors = [], [], []
    for k in range(density.ndim):
        x = draws[:, :, k]
        error = mcse_mean(x, walkers)
        means.append(float((x.mean() - truth.mean[k]) / error))
        errors.append(error)
        square = (x - truth.mean[k]) ** 2
        variances.append(float((square.mean() - truth.variance[k]) / mcse_mean(square, walkers)))
    evidences = [fmu.evidence(trace, method) for method in OF_MIXTURE] if has_candidates(trace) else []
    sure = [one for one in evidences if not one.warnings]
    return Outcome(
        *job.key,
        converged=found.converged,
        searched=found.searched,
        told=found.state == LOCALLY,
        reason=found.reasons[0] if found.reasons else "",
        draws=int(trace.attrs["draws"]),
        of_means=tuple(means),
        of_variances=tuple(variances),
        mcse=tuple(errors),
        ess=float(np.min(fmu.summary(trace)["ess_bulk"].to_numpy())),
        processor_s=time.process_time() - began,
        of_evidence=tuple((one.log_evidence - truth.log_mass) / one.error for one in sure),
        been_everywhere=_been_everywhere(trace, job.known.maxima),
    )


def _been_everywhere(trace: Any, maxima: Maxima | None) -> bool:
    """Return whether each of the maxima has a draw near it, including warm-up."""
    if maxima is None:
        return True
    groups = (trace[name].to_dataset() for name in ("warmup_posterior", "posterior"))
    theta = np.concatenate([np.stack([one[x].to_numpy().ravel() for x in maxima.names], axis=1) for one in groups])
    return len(set(nearest_maxima(theta, maxima).tolist()) - {-1}) == len(maxima)


def _at(job: Job) -> FloatArray:
    """Return starting points around one maximum, within a hundredth of the box on either side."""
    known = job.known
    walkers = make_sampler(job.sampler.removesuffix(JUMPS)).walkers
    shape = (CHAINS, known.density.ndim) if walkers == 1 else (CHAINS, walkers, known.density.ndim)
    lower, upper = known.box or (known.density.lower, known.density.upper)
    away = np.random.default_rng(job.seed).uniform(-0.01, 0.01, shape)
    return np.asarray(known.one_place) + away * (np.asarray(upper) - np.asarray(lower))


@dataclass(frozen=True)
class Study:
    """All runs, and whether they pass the gates."""

    outcomes: Sequence[Outcome]

    @cached_property
    def alone(self) -> list[Outcome]:
        """Runs on densities with separated maxima that the search does not exclude; they are reported apart."""
        separated = {known.name for known in (*KNOWN, *FURTHER) if known.one_place is not None}
        return [one for one in self.outcomes if one.name in separated and not one.searched]

    @cached_property
    def judged(self) -> list[Outcome]:
        """All other runs. None of them may be wrong."""
        alone = set(self.alone)
        return [one for one in self.outcomes if one not in alone]

    @cached_property
    def converged(self) -> list[Outcome]:
        """The runs in `judged` that were reported as converged."""
        return [one for one in self.judged if one.converged]

    @property
    def most_wrong(self) -> float:
        """One-sided 95 % upper limit (Clopper & Pearson) of the rate at which converged runs are wrong."""
        wrong = sum(one.is_wrong for one in self.converged)
        return float(beta_distribution.ppf(0.95, wrong + 1, len(self.converged) - wrong))

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom ν of an MCSE, whose logarithm has the variance 1/(2ν).

        Estimated from the scatter of MCSE·√draws between the converged runs of the same sampler and parameter;
        infinite if there is only one run of each.
        """
        groups: dict[tuple[str, str, int], list[float]] = {}
        for one in self.converged:
            for k, error in enumerate(one.mcse):
                groups.setdefault((one.name, one.sampler, k), []).append(np.log(error) + 0.5 * np.log(one.draws))
        several = [values for values in groups.values() if len(values) > 1]
        squares = sum(float(np.sum((np.array(values) - np.mean(values)) ** 2)) for values in several)
        return 0.5 * sum(len(values) - 1 for values in several) / squares if squares else np.inf

    def expected_beyond(self, limit: float) -> float:
        """Return the expected number of means off by more than `limit` MCSE in correct runs, by Student's t."""
        return float(sum(len(one.of_means) for one in self.converged) * 2.0 * student.sf(limit, self.freedom))

    @cached_property
    def failures(self) -> list[str]:
        """Gates that fail, one sentence each."""
        found = [f"{len(self.judged)} runs; at least {FEWEST_RUNS} are needed"] * (len(self.judged) < FEWEST_RUNS)
        count = sum(one.sampler in WITH_CANDIDATES for one in self.judged)
        if count < FEWEST_WITH_CANDIDATES:
            found.append(f"{count} runs with mixture proposals; at least {FEWEST_WITH_CANDIDATES} are needed")
        for one in self.outcomes:
            excused = one.told and one in self.alone
            if one.sampler in WITH_CANDIDATES:  # a mixture must keep a maximum that a chain has visited
                excused = excused and not one.been_everywhere
            if one.is_wrong and not excused:
                found.append(
                    f"{one.name}, {one.sampler} (length: {one.length}, start: {one.start}, seed {one.seed}): "
                    f"converged, but a mean is off by {one.worst:.1f} MCSE"
                )
        return found


def main() -> int:
    """Run the study, write ``verdicts.md``, and return the exit code."""
    from tests.validation.verdicts_page import write

    asked = study_parser(__doc__).parse_args()
    units = Units(asked.kept, asked.minutes)
    with threadpool_limits(1):
        in_order = sorted(jobs(), key=lambda job: job.seed)  # first one run of each kind
        keyed = ((job.key, job) for job in in_order)
        found = Study(units.completed("runs", keyed, outcome, fields_of(Outcome)))
    write(found, asked.out)
    for failure in found.failures:
        print(failure)
    return 1 if found.failures else 0


if __name__ == "__main__":
    sys.exit(main())
