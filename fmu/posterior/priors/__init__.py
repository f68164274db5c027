"""Prior distributions of the parameters.

Reading order: base, one_sided, scipy_distributions.
"""

from fmu.posterior.priors.base import Normal, Uniform
from fmu.posterior.priors.one_sided import HalfNormal, LogNormal
from fmu.posterior.priors.scipy_distributions import ScaledBeta

PRIORS = {
    "uniform": Uniform,
    "normal": Normal,
    "truncated-normal": Normal,
    "half-normal": HalfNormal,
    "log-normal": (LogNormal.from_mode, LogNormal.from_mean, LogNormal),
    "beta": (ScaledBeta, ScaledBeta.from_mean),
}
"""By their names in problem files: what makes each of the keys beside ``distribution``, one or one of several."""
