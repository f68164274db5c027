"""The samplers under validation, each as a user gets it: what they are not told, they learn in warm-up."""

from __future__ import annotations

from dataclasses import dataclass

from fmu.samplers import Ensemble, HamiltonianMonteCarlo, MetropolisHastings, MixtureSampler, Sampler, Slice
from fmu.samplers.mixture.mixture import with_jumps


@dataclass(frozen=True)
class Length:
    """How long a run is.

    Attributes
    ----------
    chains : int
        Chains, or ensembles.
    warmup, draws : int
        Steps.
    """

    chains: int
    warmup: int
    draws: int


@dataclass(frozen=True)
class Contender:
    """A sampler, what the tables call it, and how long it runs.

    Attributes
    ----------
    title : str
    sampler : Sampler
    calibration : Length
        Short runs, drawn on where they do not suffice.
    replicate : Length
        Runs of some hundred autocorrelation times, whose ESS is worth checking.
    """

    title: str
    sampler: Sampler
    calibration: Length
    replicate: Length


CONTENDERS = (
    Contender("Metropolis–Hastings", MetropolisHastings(), Length(16, 250, 150), Length(4, 300, 3000)),
    Contender("slice, hyperrectangle", Slice("hyperrectangle"), Length(16, 120, 80), Length(4, 200, 1500)),
    Contender("slice, coordinate", Slice("coordinate"), Length(16, 60, 30), Length(4, 200, 500)),
    Contender("HMC", HamiltonianMonteCarlo(), Length(16, 100, 20), Length(4, 200, 500)),
    Contender("emcee, stretch", Ensemble(16), Length(4, 60, 80), Length(1, 200, 1500)),
    Contender(
        "emcee, DE and snooker",
        Ensemble(16, {"de": 0.8, "snooker": 0.2}),
        Length(4, 60, 40),
        Length(1, 200, 1000),
    ),
    Contender("HMC with jumps", with_jumps(HamiltonianMonteCarlo()), Length(16, 100, 20), Length(4, 200, 500)),
    Contender("mixture", MixtureSampler(), Length(16, 100, 20), Length(4, 200, 500)),
)
