"""Prior distributions of the parameters.

Reading order: base, one_sided, scipy_distributions, spike_and_slab, joint.
"""

from collections.abc import Callable, Mapping
from typing import Any

from fmu.posterior.priors.base import Normal, Prior, Uniform
from fmu.posterior.priors.one_sided import HalfNormal, LogNormal
from fmu.posterior.priors.scipy_distributions import ScaledBeta
from fmu.posterior.priors.spike_and_slab import SpikeAndSlab

PRIORS: dict[str, tuple[Callable[..., Prior], ...]] = {
    "uniform": (Uniform,),
    "normal": (Normal,),
    "truncated-normal": (Normal,),
    "half-normal": (HalfNormal,),
    "log-normal": (LogNormal.from_mode, LogNormal.from_mean, LogNormal),
    "beta": (ScaledBeta, ScaledBeta.from_mean),
    "spike-and-slab": (SpikeAndSlab,),
}
"""Constructors of priors by the value of ``distribution`` in a problem file.

The other keys of a prior in the file are the arguments of one of these constructors.
"""


def prior_of(settings: Mapping[str, Any]) -> Prior | None:
    """Return the prior described by a dict from `Prior.as_dict`, or None if `PRIORS` lacks its distribution."""
    classes = (one for one in PRIORS.get(str(settings["distribution"]), ()) if isinstance(one, type))
    arguments = {key: value for key, value in settings.items() if key != "distribution"}
    return next((one(**arguments) for one in classes), None)
