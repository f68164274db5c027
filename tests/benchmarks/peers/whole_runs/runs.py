"""Whole runs, from nothing to so many effective draws: every evaluation counts, the search for maxima included."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any

import numpy as np

import fmu
from fmu.analysis.convergence.effective import ess_bulk, mcse_mean
from fmu.analysis.estimate import gradient_cost
from fmu.analysis.trace.reading import parameter_draws, walkers_of
from fmu.posterior.reduction.region import plausible_points
from fmu.samplers.registry import plan_steps
from tests.benchmarks.peers.outcome import Cost, Stopwatch
from tests.benchmarks.peers.target import Target

ENOUGH = 4000
"""Effective draws of the worst parameter that a run is asked for."""
MOST_CALLS = {"garteur": 100_000}
"""Likelihoods after which a run of a peer is ended, whatever it has reached; on the others `OTHERWISE`."""
OTHERWISE = 300_000
MOST_DRAWS = 32_000
"""Draws of a chain after which a run of fmu is ended."""
NOTHING = Cost(0.0, 0.0, 0)
POSTERIORS = (
    ("cantilever-young", "shape"),
    ("cantilever-young", "index"),
    ("cantilever-section", "shape"),
    ("cantilever-section", "index"),
    ("garteur", "shape"),
    ("shear-10dof", "index"),
)
FMU, PEER = "fmu", "peer"
SEEDS = {"mixture": 5, "hmc": 1, "mh": 1, "slice": 1, "emcee": 1}
"""Runs of each sampler of fmu; of a peer, one."""
COSTLY, ON_COSTLY = "garteur", ("mixture", "hmc")
"""Where a log-probability takes ten times as long as on the others, and the samplers of fmu that run there."""


@dataclass(frozen=True)
class WholeRun:
    """What one run gave and cost.

    Attributes
    ----------
    ess : float
        The smallest of the parameters, or Kish's of weighted draws.
    mean, mcse : list of float
        Posterior means and their standard errors, SI units.
    draws, warmup, search : Cost
        In log-probabilities: a gradient counts as what it costs.
    evidence : (float, float) or None
        Its logarithm and the standard error.
    ended : bool
        Whether it has ended by itself: not at its largest number of steps or calls.
    """

    ess: float
    mean: list[float]
    mcse: list[float]
    draws: Cost
    warmup: Cost = NOTHING
    search: Cost = NOTHING
    evidence: tuple[float, float] | None = None
    ended: bool = True

    @classmethod
    def read(cls, kept: dict[str, Any]) -> WholeRun:
        """Return the run that was kept as a dict."""
        costs = {name: Cost(**kept[name]) for name in ("search", "warmup", "draws")}
        return cls(**{**kept, **costs})

    @property
    def cost(self) -> Cost:
        """All that it cost."""
        return self.search + self.warmup + self.draws


@cache
def cost_of_gradient(target: Target) -> float:
    """Return how many log-probabilities a gradient takes, at plausible points: where the reduced model answers."""
    return gradient_cost(target.problem, plausible_points(target.problem, 4, np.random.default_rng(7)))


class Meter:
    """Time, and evaluations as the model sees them, since it was last read: a gradient counts as what it costs.

    Attributes
    ----------
    gradient : float
        How many log-probabilities a gradient takes.
    """

    def __init__(self, target: Target) -> None:
        problem = target.problem
        self.gradient = cost_of_gradient(target)
        self._evaluations, self._stopwatch = 0.0, Stopwatch()
        solve = type(problem.model)._answered

        def counted(reduced: Any, full: Any, theta: Any, gradient: bool) -> Any:
            self._evaluations += len(theta) * (self.gradient if gradient else 1.0)
            return solve(problem.model, reduced, full, theta, gradient)

        problem.model._answered = counted

    def read(self) -> Cost:
        """Return the cost since the last reading."""
        cost = self._stopwatch.read(round(self._evaluations))
        self._evaluations = 0.0
        return cost


class WithoutModel:
    """A problem as a log-density alone: `fmu.sample` does not predict, check and leave out after its draws."""

    def __init__(self, problem: Any) -> None:
        for name in ("ndim", "names", "units", "lower", "upper", "offset", "scale", "solves_per_gradient"):
            setattr(self, name, getattr(problem, name))
        self.log_prob, self.log_prob_and_grad = problem.log_prob, problem.log_prob_and_grad
        self.sample_prior = problem.sample_prior


def fmu_whole(target: Target, name: str) -> Callable[[int], WholeRun]:
    """Return what runs a sampler for a seed as ``fmu run`` does, until the verdict is good and the ESS enough."""

    def once(seed: int) -> WholeRun:
        meter, costs = Meter(target), {"warmup": NOTHING, "draws": NOTHING}
        maxima = fmu.find_map(copy.copy(target.problem))  # whose maxima are not known yet
        costs["search"] = meter.read()

        def progress(phase: str, done: int, total: int, words: dict[str, Any]) -> None:
            if phase in costs:
                costs[phase] += meter.read()

        density = WithoutModel(target.problem)
        warmup, draws = plan_steps(name, None, None)
        steps = {"warmup": warmup, "draws": draws, "max_draws": MOST_DRAWS}
        trace = fmu.sample(density, name, maxima=maxima, seed=seed, until_ess=ENOUGH, progress=progress, **steps)
        walkers, columns = walkers_of(trace), np.moveaxis(parameter_draws(trace), 2, 0)
        found = fmu.evidence(trace) if name == "mixture" else None
        return WholeRun(
            ess=float(np.min([ess_bulk(x, walkers) for x in columns])),
            mean=[float(x.mean()) for x in columns],
            mcse=[mcse_mean(x, walkers) for x in columns],
            evidence=None if found is None else (found.log_evidence, found.error),
            ended=fmu.diagnose(trace).converged,
            **costs,
        )

    return once


def measured(case: str, pairing: str, names: Collection[str] = (), one_seed: bool = False) -> list[dict[str, Any]]:
    """Run everybody, or those that are named, on one posterior; return plain data, an entry a contender."""
    rows = []
    target = Target.load(case, pairing)
    everybody = list(contenders(target))
    for whose, name, seeds, run in [one for one in everybody if one[1] in names] or everybody:
        runs = []
        for seed in range(1, 1 + (1 if one_seed else seeds)):
            runs.append(asdict(run(seed)))
            cost = WholeRun.read(runs[-1]).cost
            took = f"{cost.cpu_s:.0f} s, {cost.evaluations} evaluations, ESS {round(runs[-1]['ess'])}"
            print(f"{target.title}, seed {seed}: {name}, {took}", flush=True)
        rows.append({"posterior": target.title, "whose": whose, "label": name, "runs": runs})
    return rows


def contenders(target: Target) -> Iterator[tuple[str, str, int, Callable[[int], WholeRun]]]:
    """Yield who takes part on a target: whose it is, its name, how many seeds it has, and what runs it for one."""
    from tests.benchmarks.peers.whole_runs.nested import dynesty_whole, nautilus_whole

    for name, seeds in SEEDS.items():
        if target.case != COSTLY or name in ON_COSTLY:
            yield FMU, name, seeds, fmu_whole(target, name)
    yield PEER, "nautilus", 1, nautilus_whole(target, 4)
    yield PEER, "nautilus, no networks", 1, nautilus_whole(target, 0)
    yield PEER, "dynesty, dynamic", 1, dynesty_whole(target)
