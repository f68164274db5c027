"""A prior for a quantity that may be nearly zero: a mixture of two normal distributions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit, log_ndtr, logit, ndtr, ndtri

from fmu.arguments import ArgumentError, check_arguments
from fmu.posterior.priors.base import Normal
from fmu.posterior.priors.scipy_distributions import InvertedPrior
from fmu.types import FloatArray, Plain, Positive

_HALVINGS = 60


@check_arguments
@dataclass(frozen=True)
class SpikeAndSlab(InvertedPrior):
    """A mixture of a wide normal distribution (the slab), with probability `share`, and a narrow one (the spike).

    The prior follows George & McCulloch 1993, *J. Am. Stat. Assoc.* 88, 881–889. The slab indicator is integrated
    out, so that the density is smooth and only the quantity itself is inferred.

    Attributes
    ----------
    share : float
        Probability of the slab, between 0 and 1.
    sd : float
        Standard deviation of the slab, in the parameter's unit.
    spike : float
        Standard deviation of the spike, in the parameter's unit: a quantity this small is practically zero.
    mean : float
        Mean of both distributions, in the parameter's unit.

    Raises
    ------
    ValueError
        If the share is not between 0 and 1, a standard deviation is not positive and finite, the mean is not
        finite, or the spike is not narrower than the slab.
    """

    share: float = 0.1
    sd: Positive = 0.3
    spike: Positive = 0.01
    mean: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.share < 1.0:
            raise ArgumentError("share", "must lie between 0 and 1", self.share)
        if not self.spike < self.sd:
            raise ArgumentError("spike", f"must be narrower than the slab, sd {self.sd}", self.spike)

    def log_pdf(self, x: FloatArray) -> FloatArray:
        """Return the normalised log-density at each x."""
        spike, slab = (Normal(sd, mean=self.mean).log_pdf(x) for sd in (self.spike, self.sd))
        return np.asarray(np.logaddexp(spike + np.log1p(-self.share), slab + np.log(self.share)))

    def log_pdf_gradient(self, x: FloatArray) -> FloatArray:
        """Return the derivative of the log-density at each x."""
        p = self.of_slab(x)
        return -(x - self.mean) * (p / self.sd**2 + (1.0 - p) / self.spike**2)

    def of_slab(self, x: FloatArray) -> FloatArray:
        """Return the probability that each value x comes from the slab."""
        with np.errstate(over="ignore"):
            z = (np.asarray(x) - self.mean) / self.spike
            ratio = 0.5 * z * z * (1.0 - (self.spike / self.sd) ** 2)
        return np.asarray(expit(ratio + np.log(self.spike / self.sd) + logit(self.share)))

    def cdf(self, x: ArrayLike) -> FloatArray:
        """Return the distribution function F at each x."""
        z = np.asarray(x) - self.mean
        return self.share * ndtr(z / self.sd) + (1.0 - self.share) * ndtr(z / self.spike)

    def sf(self, x: ArrayLike) -> FloatArray:
        """Return the survival function 1 − F at each x."""
        return self.cdf(2.0 * self.mean - np.asarray(x))

    def ppf(self, p: FloatArray) -> FloatArray:
        """Return the quantiles F⁻¹(p).

        They are found by bisection between the quantiles of the spike and of the slab.
        """
        ends = ndtri(np.asarray(p, dtype=float)) * np.array([self.spike, self.sd]).reshape(2, *[1] * np.ndim(p))
        low, high = ends.min(axis=0), ends.max(axis=0)
        target = logit(p)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            below = self._logit_cdf(middle) < target
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray(self.mean + 0.5 * (low + high))

    def isf(self, p: FloatArray) -> FloatArray:
        """Return the upper quantile for each probability p: the value at which 1 − F equals p."""
        return 2.0 * self.mean - self.ppf(p)

    def as_dict(self) -> dict[str, Plain]:
        """Return the prior's name and settings as a dict."""
        own = {"share": self.share, "sd": self.sd, "spike": self.spike, "mean": self.mean}
        return {"distribution": "spike-and-slab", **own}

    def _logit_cdf(self, z: FloatArray) -> FloatArray:
        """Return the log-odds log(F/(1 − F)) of the distribution function at mean + z, accurate in both tails."""
        weights = np.log([1.0 - self.share, self.share])
        below, above = (
            np.logaddexp(weights[0] + log_ndtr(s * z / self.spike), weights[1] + log_ndtr(s * z / self.sd))
            for s in (1.0, -1.0)
        )
        return np.asarray(below - above)
