"""Losses of stiffness between a reference state and later ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmu.arguments import check_arguments
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Prior
from fmu.types import Plain

_LOWEST, _HIGHEST = -0.5, 0.95
_SD = 0.3


@check_arguments
@dataclass(frozen=True)
class Damage:
    """A parameter that each later group of tests has lost a share d of: θ = θ_reference (1 − d).

    The first test's group is the reference, unless the problem says otherwise. A negative loss is a gain: noise
    gives it where there is no damage, so that losses are not biased upwards.

    Attributes
    ----------
    prior : Prior, optional
        Of each loss, between −0.5 and 0.95; normal about 0 with a standard deviation of 0.3 by default. Where few
        parameters are expected to be damaged, `fmu.SpikeAndSlab(share)` with the probability that one is: it pulls
        small losses to nothing and leaves large ones alone. (A horseshoe prior does the same with scales that are
        inferred. Precise tests tie them to the losses so closely that HMC did not converge.)
    """

    prior: Prior | None = None

    def loss(self, of: Parameter, state: str) -> Parameter:
        """Return the loss of a parameter in a state."""
        prior = Normal(_SD) if self.prior is None else self.prior
        start = float(np.clip(0.0, max(_LOWEST, prior.support[0]), min(_HIGHEST, prior.support[1])))
        return Parameter(f"{of.name} loss [{state}]", start, _LOWEST, _HIGHEST, prior)

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings in plain Python types."""
        return {"prior": None if self.prior is None else self.prior.as_dict()}
