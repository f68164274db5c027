"""``prior = { … }`` of a parameter: what was known of it before the measurement."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from fmu.config.fields import Positive, TomlTable
from fmu.posterior.priors.base import Normal, Prior, Uniform
from fmu.posterior.priors.one_sided import HalfNormal, LogNormal
from fmu.posterior.priors.scipy_distributions import ScaledBeta


class UniformTable(TomlTable):
    """Constant between the bounds."""

    distribution: Literal["uniform"]

    def build(self) -> Prior:
        """Return the prior."""
        return Uniform()


class NormalTable(TomlTable):
    """Gaussian, cut off at the bounds: eq. (6) of the paper with α = 1/sd².

    A ``truncated-normal`` is the same, of which a bound is expected.
    """

    distribution: Literal["normal", "truncated-normal"]
    sd: Positive
    mean: float = 0.0

    def build(self) -> Prior:
        """Return the prior."""
        return Normal(self.sd, self.mean)


class HalfNormalTable(TomlTable):
    """The upper half of a Gaussian, from `at` on."""

    distribution: Literal["half-normal"]
    sd: Positive
    at: float = 0.0

    def build(self) -> Prior:
        """Return the prior."""
        return HalfNormal(self.sd, self.at)


class LogNormalTable(TomlTable):
    """Positive: by `mode` and `sd`, by `mean` and `sd`, or by `median` and `sigma`, the sd of the logarithm."""

    distribution: Literal["log-normal"]
    mode: Positive | None = None
    mean: Positive | None = None
    sd: Positive | None = None
    median: Positive | None = None
    sigma: Positive | None = None

    @model_validator(mode="after")
    def _buildable(self) -> Self:
        self.build()
        return self

    def build(self) -> Prior:
        """Return the prior; ValueError unless the settings are one of the pairs."""
        match self.mode, self.mean, self.sd, self.median, self.sigma:
            case float(mode), None, float(sd), None, None:
                return LogNormal.from_mode(mode, sd)
            case None, float(mean), float(sd), None, None:
                return LogNormal.from_mean(mean, sd)
            case None, None, None, float(median), float(sigma):
                return LogNormal(median, sigma)
        raise ValueError("must have either mode and sd, or mean and sd, or median and sigma")


class BetaTable(TomlTable):
    """On the interval from `low` to `high`: by the shapes `a` and `b`, or by `mean` and `sd`."""

    distribution: Literal["beta"]
    low: float
    high: float
    a: Positive | None = None
    b: Positive | None = None
    mean: float | None = None
    sd: Positive | None = None

    @model_validator(mode="after")
    def _buildable(self) -> Self:
        self.build()
        return self

    def build(self) -> Prior:
        """Return the prior; ValueError unless the settings are one of the pairs, and a beta has them."""
        match self.a, self.b, self.mean, self.sd:
            case float(a), float(b), None, None:
                return ScaledBeta(a, b, self.low, self.high)
            case None, None, float(mean), float(sd):
                return ScaledBeta.from_mean(mean, sd, self.low, self.high)
        raise ValueError("must have either a and b, or mean and sd")


PriorTable = Annotated[
    UniformTable | NormalTable | HalfNormalTable | LogNormalTable | BetaTable, Field(discriminator="distribution")
]
