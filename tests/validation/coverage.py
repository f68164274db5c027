"""Do intervals hold the truth as often as they say, where the noise is inferred too?

    python -m tests.validation.coverage OUT_DIRECTORY

Truths, noise among them, from the prior of the case shear-10dof, a measurement of each and a run on it. A 90 %
interval then holds the truth in 90 % of the runs, whatever the prior is; and the ranks of the truth are uniform
(`tests.validation.calibration`). Exit code 1 where a gate fails.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom
from threadpoolctl import threadpool_limits

from fmu.analysis.convergence.effective import ess_mean
from fmu.samplers import HamiltonianMonteCarlo, Run
from fmu.types import BoolArray
from tests.validation import ten_storeys
from tests.validation.bands import UniformRanks

REPLICATES, SEED, WORKERS = 200, 10, 2
CHAINS, WARMUP, DRAWS = 16, 100, 40
LEAST_ESS = 200
"""Of every quantity; runs that have less are drawn on."""
RANKED = 63
"""Draws that the truth is ranked among."""
MOST_EXTENSIONS = 5
INTERVAL = 0.9
NAMES = (*(p.name for p in ten_storeys.PARAMETERS), "sd_frequency", "sd_shape")
QUANTITIES = (*NAMES, "log-likelihood")
BAND = 0.999
"""Probability that the coverage of one parameter of a correct sampler is within the gate."""
FALSE_ALARM = 1e-3
"""That one quantity's ranks of a correct sampler are taken for not uniform."""


@dataclass(frozen=True)
class Replicate:
    """What one run says of its truth.

    Attributes
    ----------
    truth : ndarray, shape (12,)
    covered : ndarray of bool, shape (12,)
        Whether the equal-tailed interval holds the truth.
    ranks : ndarray of int, shape (13,)
        Of the truth among `RANKED` draws.
    sd : ndarray, shape (12,)
        Standard deviation of the posterior.
    ess : float
        Of the quantity that has the smallest.
    draws : int
        Of all chains together.
    processor_s : float
    """

    truth: NDArray[np.float64]
    covered: BoolArray
    ranks: NDArray[np.int64]
    sd: NDArray[np.float64]
    ess: float
    draws: int
    processor_s: float


@dataclass(frozen=True)
class Study:
    """All runs, and whether they pass."""

    runs: Sequence[Replicate]

    @property
    def replicates(self) -> int:
        """Number of runs."""
        return len(self.runs)

    @cached_property
    def covered(self) -> NDArray[np.int64]:
        """In how many runs the interval holds the truth, shape (12,)."""
        return np.sum([run.covered for run in self.runs], axis=0)

    @cached_property
    def band(self) -> tuple[int, int]:
        """The smallest and the largest number of runs that pass."""
        tail = 0.5 * (1.0 - BAND)
        return int(binom.ppf(tail, self.replicates, INTERVAL)), int(binom.isf(tail, self.replicates, INTERVAL))

    @cached_property
    def spread_of_truths(self) -> NDArray[np.float64]:
        """Root mean square of the truths' normal scores under their priors, shape (12,): about 1."""
        median, sigma = ten_storeys.prior()
        scores = np.log(np.array([run.truth for run in self.runs]) / median) / sigma
        return np.asarray(np.sqrt(np.mean(scores**2, axis=0)))

    @cached_property
    def ranks(self) -> NDArray[np.int64]:
        """Ranks of the truth, shape (replicates, 13)."""
        return np.array([run.ranks for run in self.runs])

    @cached_property
    def p_values(self) -> list[float]:
        """Probability that uniform ranks stray as far, of every quantity."""
        return [UniformRanks(self.replicates, RANKED).p_value(ranks) for ranks in self.ranks.T]

    @property
    def level(self) -> float:
        """Below which a p-value fails (Bonferroni)."""
        return FALSE_ALARM / len(QUANTITIES)

    @cached_property
    def failures(self) -> list[str]:
        """What is wrong, a sentence each."""
        lowest, highest = self.band
        return [
            f"{name}: the interval holds {count} of {self.replicates} truths, not {lowest} to {highest}"
            for name, count in zip(NAMES, self.covered, strict=True)
            if not lowest <= count <= highest
        ] + [
            f"{name}: the ranks are not uniform (p = {p:.1g})"
            for name, p in zip(QUANTITIES, self.p_values, strict=True)
            if not p > self.level
        ]


def study(replicates: int = REPLICATES, workers: int = WORKERS) -> Study:
    """Return the study; the runs do not depend on the number of workers."""
    seeds = np.random.SeedSequence(SEED).spawn(replicates)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_start) as pool:
        return Study(list(pool.map(_replicate, seeds)))


def _start() -> None:
    global _model, _limits
    _limits = threadpool_limits(1)
    _model = ten_storeys.structure()


def _replicate(seed: np.random.SeedSequence) -> Replicate:
    """Return what a run on a truth of its own says; RuntimeError if it does not reach `LEAST_ESS`."""
    began = time.process_time()
    rng = np.random.default_rng(seed)
    truth, data = ten_storeys.drawn(rng, _model)
    problem = ten_storeys.problem(_model, data)
    run = Run(
        problem,
        HamiltonianMonteCarlo(),
        warmup=WARMUP,
        chains=CHAINS,
        seed=int(rng.integers(2**31)),
        init="prior",
    )
    for _ in range(MOST_EXTENSIONS):
        result = run.extend(DRAWS)
        position = result.posterior.position
        theta = position.reshape(-1, problem.ndim)
        likelihood = problem.log_likelihood(theta)
        values = np.column_stack([theta, likelihood])
        chains = values.reshape(*position.shape[:2], len(QUANTITIES))
        ess = min(ess_mean(chains[:, :, k]) for k in range(len(QUANTITIES)))
        if ess >= LEAST_ESS:
            break
    else:
        raise RuntimeError(f"{ess:.0f} effective draws after {result.draws} steps (seed {seed.spawn_key})")
    tail = 0.5 * (1.0 - INTERVAL)
    lowest, highest = np.quantile(theta, [tail, 1.0 - tail], axis=0)
    thinned = values[np.linspace(0, len(values) - 1, RANKED).round().astype(int)]
    ranks = np.sum(thinned < np.append(truth, problem.log_likelihood(truth)), axis=0)
    covered = (lowest <= truth) & (truth <= highest)
    return Replicate(truth, covered, ranks, theta.std(axis=0), ess, len(theta), time.process_time() - began)


def main(directory: str) -> int:
    """Run the study, write ``coverage.md`` and its figure, and return the exit code."""
    from tests.validation.coverage_page import write

    found = study()
    write(found, Path(directory))
    for failure in found.failures:
        print(failure)
    return 1 if found.failures else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
