"""Samplers of fmu with their defaults, until a good verdict and enough effective draws."""

from __future__ import annotations

import copy
from typing import Any

import fmu
from fmu.analysis.maxima.starts import components, starts_at_maxima
from fmu.analysis.trace.reading import parameter_draws, walkers_of
from fmu.samplers.registry import make_sampler, plan_steps
from tests.benchmarks.peers.ensembles import WithoutModel, walkers_for
from tests.benchmarks.peers.posteriors import Target
from tests.benchmarks.peers.run import NOTHING, Meter, Run

CHAINS = 4
MOST_SOLVES = 300_000
"""Solves after which a run of fmu is stopped."""


def fmu_run(target: Target, name: str, seed: int, enough: float) -> Run:
    """Run a sampler as ``fmu run --until-ess`` does, the search for maxima included."""
    meter, costs = Meter(target), {"warmup": NOTHING, "draws": NOTHING}

    def progress(phase: str, done: int, total: int, words: dict[str, Any]) -> None:
        if phase in costs:
            costs[phase] += meter.read()

    with meter.counting():
        problem = copy.copy(target.problem)  # whose maxima are not known yet
        maxima = fmu.find_map(problem)
        warmup, draws = plan_steps(name, None, None)
        # as for a problem: `fmu.sample` begins with a density alone at its prior
        sampler = fmu.Ensemble(walkers_for(problem.ndim)) if name == "emcee" else make_sampler(name)
        start = starts_at_maxima(problem, maxima, CHAINS, sampler.walkers, seed)
        sampler = sampler.starting_from(*components(problem, maxima))
        search = meter.read()
        trace = fmu.sample(
            WithoutModel(problem), sampler, maxima=maxima, init=start, seed=seed, until_ess=enough,
            progress=progress, warmup=warmup, draws=draws, chains=CHAINS, max_solves=MOST_SOLVES,
        )  # fmt: skip
    found = fmu.evidence(trace) if name == "mixture" else None
    return Run.of_chains(
        parameter_draws(trace),
        walkers_of(trace),
        search=search,
        evidence=None if found is None else (found.log_evidence, found.error),
        ended=fmu.diagnose(trace).converged,
        **costs,
    )
