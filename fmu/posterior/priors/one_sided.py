"""Priors bounded from below: the half-normal and the log-normal.

Both use the Gaussian distribution function, whose logarithm is accurate even for bounds far out in the tails.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import typed
from fmu.posterior.priors.base import GaussianForm, Normal, Prior
from fmu.types import FloatArray, Plain, Positive


@check_arguments
@dataclass(frozen=True)
class HalfNormal(Prior):
    """The upper half of a Gaussian: density ∝ exp(−(x − at)²/(2 sd²)) for x ≥ at.

    Attributes
    ----------
    sd : float
        Standard deviation of the whole Gaussian, in the parameter's unit.
    at : float
        The lower end, where the density is largest, in the parameter's unit.

    Raises
    ------
    ValueError
        If `sd` is not positive and finite, or `at` is not finite.
    """

    sd: Positive
    at: float = 0.0

    @property
    def gaussian_form(self) -> GaussianForm:
        """The whole Gaussian, with its density doubled."""
        return GaussianForm(self.at, self.sd, log_factor=float(np.log(2.0)))

    @property
    def support(self) -> tuple[float, float]:
        """Interval from `at` to infinity."""
        return self.at, np.inf

    def log_pdf(self, x: FloatArray) -> FloatArray:
        """Return the normalised log-density at each x; ``-inf`` below `at`."""
        return np.where(x >= self.at, self.gaussian.log_pdf(x) + np.log(2.0), -np.inf)

    def log_pdf_gradient(self, x: FloatArray) -> FloatArray:
        """Return the derivative of the log-density at each x, −(x − at)/sd²; NaN below `at`."""
        return np.where(x >= self.at, self.gaussian.log_pdf_gradient(x), np.nan)

    def log_mass(self, lower: float, upper: float) -> float:
        """Return the log-probability between two bounds."""
        return self.gaussian.log_mass(max(lower, self.at), upper) + float(np.log(2.0))

    def quantile(self, p: FloatArray, lower: float, upper: float) -> FloatArray:
        """Return quantiles of the distribution truncated to the bounds, at probabilities `p`."""
        return self.gaussian.quantile(p, max(lower, self.at), upper)

    def as_dict(self) -> dict[str, Plain]:
        """Return the prior's name and settings as a dict."""
        return {"distribution": "half-normal", "sd": self.sd, "at": self.at}

    @cached_property
    def gaussian(self) -> Normal:
        """The Gaussian of which this prior is the upper half."""
        return Normal(self.sd, mean=self.at)


@check_arguments
@dataclass(frozen=True)
class LogNormal(Prior):
    """The log-normal prior: for positive x, z = log(x/median)/sigma is a standard normal variable.

    Attributes
    ----------
    median : float
        Median, in the parameter's unit.
    sigma : float
        Standard deviation of log x, dimensionless.

    Raises
    ------
    ValueError
        If `median` or `sigma` is not positive and finite.
    """

    median: Positive
    sigma: Positive

    @classmethod
    @check_arguments
    def from_mean(cls, mean: Positive, sd: Positive) -> LogNormal:
        """Return the prior with the given mean and standard deviation, in the parameter's unit.

        Raises
        ------
        ValueError
            If `mean` or `sd` is not positive and finite, or `sd` is so small that (sd/mean)² underflows to zero
            (below about 1e-162 of the mean).
        """
        variance = np.logaddexp(0.0, 2.0 * (np.log(sd) - np.log(mean)))
        _require_width("mean", mean, sd, variance)
        return cls(float(mean * np.exp(-0.5 * variance)), float(np.sqrt(variance)))

    @classmethod
    @check_arguments
    def from_mode(cls, mode: Positive, sd: Positive) -> LogNormal:
        """Return the prior whose density is largest at `mode`, with the standard deviation `sd`.

        Both are in the parameter's unit. With v = exp(sigma²) − 1 the variance is mode² v (1 + v)³. This equation
        has one positive root v. It is solved for log v. See Beck & Au 2002, *J. Eng. Mech.* 128, 380–391.

        Raises
        ------
        ValueError
            If `mode` or `sd` is not positive and finite, or `sd` is so small that (sd/mode)² underflows to zero
            (below about 1e-162 of the mode).
        """
        from scipy.optimize import brentq

        log_ratio = 2.0 * (np.log(sd) - np.log(mode))
        highest = min(log_ratio, log_ratio / 4.0)  # because 1 + v exceeds both 1 and v
        log_v = brentq(
            lambda t: t + 3.0 * np.logaddexp(0.0, t) - log_ratio, highest - 3.0 * np.log(2.0), highest, xtol=1e-15
        )
        variance = np.logaddexp(0.0, log_v)
        _require_width("mode", mode, sd, variance)
        return cls(float(mode * np.exp(variance)), float(np.sqrt(variance)))

    @property
    def gaussian_form(self) -> GaussianForm:
        """The Gaussian density of log x."""
        return GaussianForm(self.gaussian.mean, self.gaussian.sd, of_logarithm=True)

    @property
    def support(self) -> tuple[float, float]:
        """Interval from 0 to infinity; the density vanishes at 0."""
        return 0.0, np.inf

    def log_pdf(self, x: FloatArray) -> FloatArray:
        """Return the normalised log-density at each x; ``-inf`` unless x is positive."""
        with np.errstate(divide="ignore", invalid="ignore"):
            log_x = np.log(x)
            return np.where(x > 0.0, self.gaussian.log_pdf(log_x) - log_x, -np.inf)

    def log_pdf_gradient(self, x: FloatArray) -> FloatArray:
        """Return the derivative of the log-density at each x, −(1 + z/sigma)/x; NaN unless x is positive."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.where(x > 0.0, (self.gaussian.log_pdf_gradient(np.log(x)) - 1.0) / x, np.nan)

    def log_mass(self, lower: float, upper: float) -> float:
        """Return the log-probability between two bounds."""
        return self.gaussian.log_mass(_log(lower), _log(upper))

    def quantile(self, p: FloatArray, lower: float, upper: float) -> FloatArray:
        """Return quantiles of the distribution truncated to the bounds, at probabilities `p`."""
        with np.errstate(over="ignore"):
            return np.clip(np.exp(self.gaussian.quantile(p, _log(lower), _log(upper))), lower, upper)

    def as_dict(self) -> dict[str, Plain]:
        """Return the prior's name and settings as a dict."""
        return {"distribution": "log-normal", "median": self.median, "sigma": self.sigma}

    @cached_property
    def gaussian(self) -> Normal:
        """The Gaussian distribution of log x."""
        return Normal(self.sigma, mean=float(np.log(self.median)))


def _log(bound: float) -> float:
    return float(np.log(bound)) if bound > 0.0 else -np.inf


def _require_width(name: str, value: float, sd: float, variance: float) -> None:
    """Raise ValueError if a log-normal prior is so narrow that its variance underflows to zero."""
    if not variance > 0.0:
        raise ArgumentError("sd", f"must not be negligible beside the {name} {typed(value)}", typed(sd))
