"""Simulation-based calibration of a sampler together with the posterior that it samples.

The truth is drawn from the truncated prior, and the data are drawn from the likelihood given the truth. The truth
and the posterior draws are then exchangeable, and the rank of the truth among L independent draws is uniform on
0, …, L. This holds for every parameter and for the log-likelihood, which reveals errors that the marginal
distributions of the parameters do not show.

Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788; Modrák et al. (2023), Bayesian Analysis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fmu.analysis.convergence.effective import ess_mean
from fmu.engines.base import Engine, InProcess
from fmu.fem.pairing.modal_model import ModalModel
from fmu.posterior.problem import UpdatingProblem
from fmu.progress import Report
from fmu.samplers import Run
from tests.validation.contenders import Contender
from tests.validation.storeys import DESIGN_HZ, PARAMETERS, problem, reduced_model

DRAWS = 63
"""L, the number of draws among which the truth is ranked: there are 64 possible ranks."""
QUANTITIES = (*(parameter.name for parameter in PARAMETERS), "log-likelihood")
MOST_EXTENSIONS = 5
"""Largest number of times that a run is extended to reach `DRAWS` effective draws."""
TOGETHER = 5
"""Replicates per task of an engine."""

Outcome = tuple[NDArray[np.int64], float, int]
"""Ranks of one truth, shape (quantities,), the smallest ESS and the number of draws."""


@dataclass(frozen=True)
class Calibration:
    """Ranks of the true values in all replicates.

    Attributes
    ----------
    ranks : ndarray of int, shape (replicates, quantities)
    ess : ndarray, shape (replicates,)
        Smallest effective sample size of the quantities.
    draws : ndarray of int, shape (replicates,)
        Number of draws of all chains before thinning.
    """

    ranks: NDArray[np.int64]
    ess: NDArray[np.float64]
    draws: NDArray[np.int64]


def calibrate(contender: Contender, replicates: int, seed: int, engine: Engine | None = None) -> Calibration:
    """Return the ranks of `replicates` truths, each with its own data and its own run including warm-up.

    Each replicate has its own random generator, from ``SeedSequence(seed).spawn(replicates)``, so the ranks are
    the same on every engine. Without an engine, the replicates run in this process.

    Raises
    ------
    RuntimeError
        If a run does not reach `DRAWS` effective draws.
    """
    model = reduced_model()
    seeds = np.random.SeedSequence(seed).spawn(replicates)
    tasks = [seeds[first : first + TOGETHER] for first in range(0, replicates, TOGETHER)]
    parts = (engine or InProcess()).run_tasks(_replicates, (contender, model), tasks)
    ranks, ess, draws = zip(*(outcome for part in parts for outcome in part), strict=True)
    return Calibration(np.array(ranks), np.array(ess), np.array(draws))


def _replicates(
    shared: tuple[Contender, ModalModel], seeds: Sequence[np.random.SeedSequence], report: Report | None
) -> list[Outcome]:
    """Return the outcomes of some replicates (the task of an engine)."""
    contender, model = shared
    return [_replicate(contender, model, seed) for seed in seeds]


def _replicate(contender: Contender, model: ModalModel, seed: np.random.SeedSequence) -> Outcome:
    """Return the outcome of one truth."""
    rng = np.random.default_rng(seed)
    prior = problem(model, DESIGN_HZ)  # only its prior is used, not its data
    truth = prior.sample_prior(rng, 1)
    posterior = problem(model, prior.simulate_data(rng, prior.frequencies(truth))[0])
    run = Run(
        posterior,
        contender.sampler,
        warmup=contender.calibration.warmup,
        chains=contender.calibration.chains,
        seed=int(rng.integers(2**31)),
        init="prior",
    )
    for _ in range(MOST_EXTENSIONS):
        result = run.extend(contender.calibration.draws)
        values = _quantities(posterior, result.posterior.position)
        ess = min(ess_mean(values[:, :, k], contender.sampler.walkers) for k in range(len(QUANTITIES)))
        if ess >= DRAWS:
            break
    else:
        raise RuntimeError(f"{contender.title}: {ess:.0f} effective draws after {result.draws} steps")
    flat = values.reshape(-1, len(QUANTITIES))
    thinned = flat[np.linspace(0, len(flat) - 1, DRAWS).round().astype(int)]
    ranks = np.sum(thinned < _quantities(posterior, truth[None])[0], axis=0)
    return ranks, ess, len(flat)


def _quantities(posterior: UpdatingProblem, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return parameters and log-likelihood, shape (chains, draws, quantities)."""
    theta = position.reshape(-1, posterior.ndim)
    values = np.column_stack([theta, posterior.log_likelihood(theta)])
    return values.reshape(*position.shape[:2], len(QUANTITIES))
