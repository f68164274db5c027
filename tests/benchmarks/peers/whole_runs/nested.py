"""nautilus and dynesty with their defaults: on prior and likelihood, over the unit cube."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import dynesty
import nautilus
import numpy as np

from fmu.types import FloatArray
from tests.benchmarks.peers.target import Target, of_unit_cube
from tests.benchmarks.peers.whole_runs.runs import ENOUGH, MOST_CALLS, OTHERWISE, Meter, WholeRun


def nautilus_whole(target: Target, networks: int) -> Callable[[int], WholeRun]:
    """Return what runs nautilus for a seed, with so many networks: 4 by default, 0 for ellipsoids alone.

    What it calls exploration is its warm-up; all of its points are kept, by default.
    """
    most = MOST_CALLS.get(target.case, OTHERWISE)

    def once(seed: int) -> WholeRun:
        meter = Meter(target)
        sampler = nautilus.Sampler(
            of_unit_cube(target.problem),
            target.problem.log_likelihood,
            n_dim=target.problem.ndim,
            n_networks=networks,
            vectorized=True,
            seed=seed,
        )
        sampler.run(n_eff=0, n_like_max=most)
        explored = meter.read()
        ended = sampler.run(n_eff=ENOUGH, n_like_max=most)
        x, log_w, _ = sampler.posterior()
        evidence = (float(sampler.log_z), float(sampler.n_eff) ** -0.5)
        drawn = meter.read()
        return _weighted(x, np.exp(log_w), evidence, ended, warmup=explored, draws=drawn)

    return once


def dynesty_whole(target: Target) -> Callable[[int], WholeRun]:
    """Return what runs dynesty's dynamic nested sampling, its way to posteriors, for a seed."""
    most = MOST_CALLS.get(target.case, OTHERWISE)

    def once(seed: int) -> WholeRun:
        meter = Meter(target)
        sampler = dynesty.DynamicNestedSampler(
            target.problem.log_likelihood,
            of_unit_cube(target.problem),
            target.problem.ndim,
            rstate=np.random.default_rng(seed),
        )
        sampler.run_nested(n_effective=ENOUGH, maxcall=most, print_progress=False)
        found = sampler.results
        evidence = (float(found.logz[-1]), float(found.logzerr[-1]))
        drawn = meter.read()
        ended = drawn.evaluations < most
        return _weighted(found.samples, found.importance_weights(), evidence, ended, draws=drawn)

    return once


def _weighted(x: FloatArray, w: FloatArray, evidence: tuple[float, float], ended: bool, **costs: Any) -> WholeRun:
    """Return a run from weighted draws: Kish's effective size, and the error of a weighted mean."""
    w = w / w.sum()
    mean = w @ x
    return WholeRun(
        ess=float(1.0 / np.sum(w**2)),
        mean=mean.tolist(),
        mcse=np.sqrt(w**2 @ (x - mean) ** 2).tolist(),
        evidence=evidence,
        ended=bool(ended),
        **costs,
    )
