"""The answer: Markov-chain samplers, which see a log-density and nothing of finite elements."""

from __future__ import annotations

from .draws import Draws, RunResult
from .ensemble import Ensemble
from .hamiltonian import HamiltonianMonteCarlo
from .kernel import Info, Kernel, LogDensity, Sampler, State
from .metropolis import MetropolisHastings
from .proposals import Independence, LogNormalWalk, RandomWalk
from .run import Run, run
from .slice import Slice
from .tempering import Tempering

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
