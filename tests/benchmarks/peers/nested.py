"""Nested samplers and samplers with flows, with their defaults: prior and likelihood over the unit cube."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np

from fmu.types import FloatArray
from tests.benchmarks.peers.posteriors import Target
from tests.benchmarks.peers.run import BudgetError, Meter, Run

MOST_CALLS, MOST_S = 100_000, 300.0
"""Likelihoods and processor seconds after which a run is stopped."""
Sampler = Callable[[Target, Callable[[FloatArray], Any], float, int], tuple[FloatArray, FloatArray, Any]]
"""A function that samples a target, given the likelihood on the unit cube, the effective draws and a seed, and
returns points of the cube, their log-weights, and the log-evidence with its error."""


def nested_run(target: Target, sampler: Sampler, seed: int, enough: float) -> Run:
    """Run a sampler. Its whole cost counts as draws: it has no separate warm-up."""
    meter = Meter(target, MOST_CALLS, MOST_S)
    log_likelihood = meter.limit(lambda u: target.problem.log_likelihood(target.of_unit_cube(u)))
    logging.disable(logging.WARNING)
    try:
        with meter.counting():
            u, log_w, evidence = sampler(target, log_likelihood, enough, seed)
    except BudgetError:
        nothing = [np.nan] * target.problem.ndim
        return Run(np.nan, nothing, nothing, draws=meter.read(), ended=False)
    finally:
        logging.disable(logging.NOTSET)
    w = np.exp(log_w - np.max(log_w))
    return Run.of_weights(target.of_unit_cube(u), w, draws=meter.read(), evidence=evidence)


def nautilus(target: Target, log_likelihood: Any, enough: float, seed: int) -> Any:
    """nautilus with its four networks, in batches."""
    import nautilus

    sampler = nautilus.Sampler(lambda u: u, log_likelihood, n_dim=target.problem.ndim, vectorized=True, seed=seed)
    sampler.run(n_eff=enough)
    u, log_w, _ = sampler.posterior()
    return u, log_w, (float(sampler.log_z), float(sampler.n_eff) ** -0.5)


def dynesty(target: Target, log_likelihood: Any, enough: float, seed: int) -> Any:
    """dynesty's dynamic sampler, which its documentation recommends for posteriors; a point at a time."""
    import dynesty

    sampler = dynesty.DynamicNestedSampler(
        log_likelihood, lambda u: u, target.problem.ndim, rstate=np.random.default_rng(seed)
    )
    sampler.run_nested(n_effective=int(enough), print_progress=False)
    found = sampler.results
    return found.samples, np.log(found.importance_weights() + 1e-300), (found.logz[-1], found.logzerr[-1])


def ultranest(target: Target, log_likelihood: Any, enough: float, seed: int) -> Any:
    """UltraNest's reactive sampler, in batches."""
    import ultranest

    np.random.seed(seed)  # noqa: NPY002  (UltraNest draws from NumPy's global state)
    names = [f"u{i}" for i in range(target.problem.ndim)]
    sampler = ultranest.ReactiveNestedSampler(names, log_likelihood, lambda u: u, vectorized=True)
    found = sampler.run(min_ess=enough, show_status=False, viz_callback=False)
    weighted = found["weighted_samples"]
    return weighted["points"], np.log(weighted["weights"] + 1e-300), (found["logz"], found["logzerr"])


def nessai(target: Target, log_likelihood: Any, enough: float, seed: int) -> Any:
    """nessai's importance nested sampler, with normalising flows."""
    from nessai.flowsampler import FlowSampler
    from nessai.livepoint import live_points_to_array
    from nessai.model import Model

    class Cube(Model):  # type: ignore[misc]
        def __init__(self) -> None:
            self.names = [f"u{i}" for i in range(target.problem.ndim)]
            self.bounds = dict.fromkeys(self.names, (0.0, 1.0))
            self.allow_vectorised = True

        def log_prior(self, x: Any) -> Any:
            return np.log(self.in_bounds(x), dtype=float)

        def log_likelihood(self, x: Any) -> Any:
            return log_likelihood(live_points_to_array(x, self.names))

        def to_unit_hypercube(self, x: Any) -> Any:
            return x.copy()

        def from_unit_hypercube(self, x: Any) -> Any:
            return x.copy()

    cube = Cube()
    with tempfile.TemporaryDirectory() as folder:
        sampler = FlowSampler(
            cube, output=folder, importance_nested_sampler=True, seed=seed, resume=False, plot=False,
            signal_handling=False,
        )  # fmt: skip
        sampler.run(plot=False, save=False)
        u = live_points_to_array(sampler.nested_samples, cube.names)
    return u, sampler.ns.log_posterior_weights, (sampler.ns.log_evidence, sampler.ns.log_evidence_error)


def pocomc(target: Target, log_likelihood: Any, enough: float, seed: int) -> Any:
    """pocoMC: preconditioned sequential Monte Carlo with normalising flows, in batches."""
    import pocomc
    from scipy.stats import uniform

    prior = pocomc.Prior([uniform()] * target.problem.ndim)
    sampler = pocomc.Sampler(prior, log_likelihood, vectorize=True, random_state=seed)
    sampler.run(n_total=int(enough), n_evidence=int(enough), progress=False)
    u, w, _, _ = sampler.posterior()
    log_z, error = sampler.evidence()
    return u, np.log(w + 1e-300), (float(log_z), float(error))
