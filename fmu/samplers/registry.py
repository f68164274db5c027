"""Registry of the samplers, keyed by name. Adding a sampler takes one file, and one line here."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fmu.samplers.kernel import Sampler

SAMPLERS = {
    "mh": "metropolis.MetropolisHastings",
    "slice": "slice.Slice",
    "hmc": "hmc.HamiltonianMonteCarlo",
    "emcee": "ensemble.Ensemble",
    "mixture": "mixture.mixture.MixtureSampler",
    "gibbs": "gibbs.gibbs.GibbsSampler",
    "tempering": "tempering.tempering.Tempering",
}
"""Module and class of each sampler's settings, keyed by name; a module is imported when it is first used."""
COMPARED = ("mh", "slice", "hmc", "emcee", "mixture")
"""Names of the samplers that ``fmu compare`` runs."""
BASELINE = "emcee"
"""Name of the sampler to whose cost the other samplers' costs are compared."""


def sampler_class(name: str) -> type[Sampler]:
    """Return a sampler's settings class. Raise ValueError, listing the known names, if `name` is unknown."""
    if name not in SAMPLERS:
        raise ValueError(f"sampler: must be one of {', '.join(SAMPLERS)} (got {name!r})")
    module, _, kind = SAMPLERS[name].rpartition(".")
    found: type[Sampler] = getattr(import_module(f"fmu.samplers.{module}"), kind)
    return found


def local_samplers() -> tuple[str, ...]:
    """Return the names of the samplers that take local steps."""
    return tuple(name for name in SAMPLERS if sampler_class(name).is_local)


def plan_steps(name: str, warmup: int | None, draws: int | None) -> tuple[int, int]:
    """Return the numbers of warm-up steps and draws of a run, with defaults for those that are None.

    If `draws` is None, the defaults depend on the sampler, and convergence is first checked after these draws; an
    unknown sampler then raises ValueError. If `draws` is given, the default is 1000 warm-up steps.
    """
    from fmu.samplers.kernel import Sampler

    usual, first = (Sampler if draws is not None else sampler_class(name)).first
    return usual if warmup is None else warmup, first if draws is None else draws


def make_sampler(name: str) -> Sampler:
    """Return a sampler with default settings. Raise ValueError, listing the known names, if `name` is unknown."""
    return sampler_class(name)()
