"""Prior distributions of the parameters.

Reading order: base, one_sided, scipy_distributions.
"""

from collections.abc import Callable

from fmu.posterior.priors.base import Normal, Prior, Uniform
from fmu.posterior.priors.one_sided import HalfNormal, LogNormal
from fmu.posterior.priors.scipy_distributions import ScaledBeta

PRIORS: dict[str, tuple[Callable[..., Prior], ...]] = {
    "uniform": (Uniform,),
    "normal": (Normal,),
    "truncated-normal": (Normal,),
    "half-normal": (HalfNormal,),
    "log-normal": (LogNormal.from_mode, LogNormal.from_mean, LogNormal),
    "beta": (ScaledBeta, ScaledBeta.from_mean),
}
"""By the value of ``distribution`` in a problem file: a table has the arguments of one of the constructors."""
