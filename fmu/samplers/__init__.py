"""The answer: Markov-chain samplers, which see a log-density and nothing of finite elements."""

from __future__ import annotations

from fmu.samplers.ensemble import Ensemble
from fmu.samplers.hmc.hmc import HamiltonianMonteCarlo
from fmu.samplers.kernel import Info, Kernel, Sampler, State
from fmu.samplers.loop.draws import Draws, RunResult
from fmu.samplers.loop.run import Run, run
from fmu.samplers.metropolis import MetropolisHastings
from fmu.samplers.proposals import Independence, LogNormalWalk, RandomWalk
from fmu.samplers.slice import Slice
from fmu.samplers.tempering.tempering import Tempering
from fmu.types import LogDensity

__all__ = [
    "Draws",
    "Ensemble",
    "HamiltonianMonteCarlo",
    "Independence",
    "Info",
    "Kernel",
    "LogDensity",
    "LogNormalWalk",
    "MetropolisHastings",
    "RandomWalk",
    "Run",
    "RunResult",
    "Sampler",
    "Slice",
    "State",
    "Tempering",
    "named",
    "run",
]


def named(name: str) -> Sampler:
    """Return a sampler with its default settings.

    Parameters
    ----------
    name : {"mh", "slice", "hmc", "emcee", "tempering"}

    Raises
    ------
    ValueError
        If the name is unknown, with those that are known.
    """
    samplers: dict[str, type[Sampler]] = {
        kind.name: kind for kind in (MetropolisHastings, Slice, HamiltonianMonteCarlo, Ensemble, Tempering)
    }
    if name not in samplers:
        raise ValueError(f"sampler: must be one of {', '.join(samplers)} (got {name!r})")
    return samplers[name]()
