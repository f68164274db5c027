"""Do credible intervals contain the true value as often as they should, if the noise is inferred too?

    python -m tests.validation.coverage OUT [--kept DIRECTORY] [--minutes M] [--replicates N] [--seed N]

True values, the noise included, are drawn from the prior of the case shear-10dof. For each, a measurement is
simulated and a run is made. A 90 % interval then contains the true value in 90 % of the runs, whatever the prior
is, and the ranks of the true value are uniform (`tests.validation.calibration`). Exit code 1 if a gate fails.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom
from threadpoolctl import threadpool_limits

from fmu.analysis.convergence.effective import ess_mean
from fmu.samplers import HamiltonianMonteCarlo, Run
from fmu.types import BoolArray, FloatArray
from tests.validation import ten_storeys
from tests.validation.bands import UniformRanks
from tests.validation.kept import Units, fields_of, study_parser

REPLICATES, SEED = 1400, 20262
"""As many replicates find a parameter with a coverage of 86 % instead of 90 % with a probability of 87 %."""
CHAINS, WARMUP, DRAWS = 16, 100, 40
LEAST_ESS = 200
"""Smallest effective sample size of every quantity; runs with less are extended."""
RANKED = 63
"""Number of draws among which the true value is ranked."""
MOST_EXTENSIONS = 20
INTERVAL = 0.9
TAIL = 0.5 * (1.0 - INTERVAL)
NAMES = (*(p.name for p in ten_storeys.PARAMETERS), "sd_frequency", "sd_shape")
QUANTITIES = (*NAMES, "log-likelihood")
FALSE_ALARM = 0.01
"""Largest probability that a correct sampler fails any gate."""
DOUBTFUL = 0.05
"""Single p-values below this are listed on the page. The verdict is doubtful if the smallest of all p-values is as
rare as this among as many."""


@dataclass(frozen=True)
class Replicate:
    """Result of one run.

    Attributes
    ----------
    truth : ndarray, shape (12,)
    covered : ndarray of bool, shape (12,)
        Whether the equal-tailed interval contains the true value.
    ranks : ndarray of int, shape (13,)
        Rank of the true value among `RANKED` draws.
    sd : ndarray, shape (12,)
        Posterior standard deviation.
    lost : ndarray, shape (12,)
        Loss of coverage because the ends of the interval are estimated from draws (`lost_to_draws`).
    ess : float
        Smallest effective sample size of all quantities.
    draws : int
        Number of draws of all chains together.
    processor_s : float
    """

    truth: NDArray[np.float64]
    covered: BoolArray
    ranks: NDArray[np.int64]
    sd: NDArray[np.float64]
    lost: NDArray[np.float64]
    ess: float
    draws: int
    processor_s: float


@dataclass(frozen=True)
class Study:
    """All runs, their p-values and the gates."""

    runs: Sequence[Replicate]

    @property
    def replicates(self) -> int:
        """Number of runs."""
        return len(self.runs)

    @cached_property
    def covered(self) -> NDArray[np.int64]:
        """Number of runs in which the interval contains the true value, shape (12,)."""
        return np.sum([run.covered for run in self.runs], axis=0)

    @cached_property
    def expected(self) -> FloatArray:
        """Expected coverage of a correct sampler with as many draws, shape (12,)."""
        return np.asarray(INTERVAL - np.mean([run.lost for run in self.runs], axis=0))

    @cached_property
    def coverage_p_values(self) -> list[float]:
        """Two-sided p-value of the number of intervals that contain the true value, for every parameter."""
        n = self.replicates
        tails = np.minimum(binom.cdf(self.covered, n, self.expected), binom.sf(self.covered - 1, n, self.expected))
        return [float(p) for p in np.minimum(1.0, 2.0 * tails)]

    @property
    def band(self) -> tuple[int, int]:
        """Smallest and largest number of covered true values that pass, for the mean of `expected`."""
        expected, tail = self.expected.mean(), 0.5 * self.level
        return int(binom.ppf(tail, self.replicates, expected)), int(binom.isf(tail, self.replicates, expected))

    @cached_property
    def spread_of_truths(self) -> NDArray[np.float64]:
        """Root mean square of the true values' normal scores under their priors, shape (12,): about 1."""
        median, sigma = ten_storeys.prior()
        scores = np.log(np.array([run.truth for run in self.runs]) / median) / sigma
        return np.asarray(np.sqrt(np.mean(scores**2, axis=0)))

    @cached_property
    def ranks(self) -> NDArray[np.int64]:
        """Ranks of the true values, shape (replicates, 13)."""
        return np.array([run.ranks for run in self.runs])

    @cached_property
    def rank_p_values(self) -> list[float]:
        """Probability that uniform ranks deviate as far, for every quantity."""
        return [UniformRanks(self.replicates, RANKED).p_value(ranks) for ranks in self.ranks.T]

    @cached_property
    def p_values(self) -> dict[str, float]:
        """All p-values by name; each is a gate."""
        return {f"coverage of {name}": p for name, p in zip(NAMES, self.coverage_p_values, strict=True)} | {
            f"ranks of {name}": p for name, p in zip(QUANTITIES, self.rank_p_values, strict=True)
        }

    @property
    def level(self) -> float:
        """The p-value below which a gate fails (Bonferroni)."""
        return FALSE_ALARM / (len(NAMES) + len(QUANTITIES))

    @cached_property
    def smallest(self) -> tuple[str, float, float]:
        """Name and size of the smallest p-value, and the probability of one as small among as many (Šidák)."""
        what, p = min(self.p_values.items(), key=lambda entry: entry[1])
        return what, p, float(-np.expm1(len(self.p_values) * np.log1p(-p)))

    @cached_property
    def failures(self) -> list[str]:
        """The gates that fail, one sentence each."""
        return [
            f"{what}: p = {p:.1g}, below {self.level:.1g}"
            for what, p in self.p_values.items()
            if not p > self.level
        ]


def lost_to_draws(ess: FloatArray, draws: int) -> FloatArray:
    """Return the loss of coverage of an interval because its ends are quantiles of draws.

    To first order the estimate q̂ of the quantile of probability α has E F(q̂) − α = (½ − α)/ESS: half the
    derivative by α of the variance α(1 − α)/ESS of the share of draws below the quantile, with the ESS of this
    share. In addition, NumPy puts (n − 1)α + ½ of n draws below its quantile, which adds (½ − α)/n.

    Parameters
    ----------
    ess : ndarray, shape (…, 2)
        Effective sample sizes of the indicators at both ends.
    draws : int
    """
    return np.asarray((0.5 - TAIL) * np.sum(1.0 / ess + 1.0 / draws, axis=-1))


def study(units: Units, replicates: int = REPLICATES, seed: int = SEED) -> Study:
    """Return the study."""
    seeds = enumerate(np.random.SeedSequence(seed).spawn(replicates))
    with threadpool_limits(1):
        return Study(units.completed("replicates", seeds, _replicate, fields_of(Replicate, np.array)))


@cache
def _structure() -> Any:
    """Return the model."""
    return ten_storeys.structure()


def _replicate(seed: np.random.SeedSequence) -> Replicate:
    """Draw true values and a measurement, and make a run; RuntimeError if it does not reach `LEAST_ESS`."""
    began = time.process_time()
    rng, model = np.random.default_rng(seed), _structure()
    truth, data = ten_storeys.drawn(rng, model)
    problem = ten_storeys.problem(model, data)
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
    ends = np.quantile(theta, [TAIL, 1.0 - TAIL], axis=0)
    ess_of_ends = np.array(
        [[ess_mean((position[:, :, k] <= end).astype(float)) for end in ends[:, k]] for k in range(len(NAMES))]
    )
    thinned = values[np.linspace(0, len(values) - 1, RANKED).round().astype(int)]
    ranks = np.sum(thinned < np.append(truth, problem.log_likelihood(truth)), axis=0)
    return Replicate(
        truth=truth,
        covered=(ends[0] <= truth) & (truth <= ends[1]),
        ranks=ranks,
        sd=theta.std(axis=0),
        lost=lost_to_draws(ess_of_ends, len(theta)),
        ess=float(ess),
        draws=len(theta),
        processor_s=time.process_time() - began,
    )


def main() -> int:
    """Run the study, write ``coverage.md`` and its figure, and return the exit code."""
    from tests.validation.coverage_page import write

    parser = study_parser(__doc__)
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--seed", type=int, default=SEED)
    asked = parser.parse_args()
    found = study(Units(asked.kept, asked.minutes), asked.replicates, asked.seed)
    write(found, asked.out)
    for failure in found.failures:
        print(failure)
    return 1 if found.failures else 0


if __name__ == "__main__":
    sys.exit(main())
