"""Priors that use SciPy's distribution functions: the scaled beta, and any continuous one in ``scipy.stats``.

Probabilities are computed in the nearer tail, so that no digits are lost for bounds far out in a tail. The
probability between the bounds must exceed the smallest double, about 1e-308.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betainc, betaincinv, betaln, xlogy

from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import significant, typed
from fmu.posterior.priors.base import Prior
from fmu.types import FloatArray, Plain, Positive

_STEP, _EDGE = 1e-3, 1e-6


class InvertedPrior(Prior):
    """A prior defined by its distribution function F, its survival function 1 − F, and the inverses of both."""

    @abstractmethod
    def cdf(self, x: ArrayLike) -> FloatArray:
        """Return the distribution function F at each x."""

    @abstractmethod
    def sf(self, x: ArrayLike) -> FloatArray:
        """Return the survival function 1 − F at each x."""

    @abstractmethod
    def ppf(self, p: FloatArray) -> FloatArray:
        """Return the quantile F⁻¹(p) for each probability p."""

    @abstractmethod
    def isf(self, p: FloatArray) -> FloatArray:
        """Return the upper quantile for each probability p: the value at which 1 − F equals p."""

    def log_mass(self, lower: float, upper: float) -> float:
        """Return the log-probability between two bounds, or ``-inf`` if the probability underflows."""
        with np.errstate(all="ignore"):
            return float(np.log(self._mass(lower, upper)))

    def quantile(self, p: FloatArray, lower: float, upper: float) -> FloatArray:
        """Return quantiles of the distribution truncated to the bounds, at probabilities `p`."""
        with np.errstate(all="ignore"):
            mass = self._mass(lower, upper)
            below, above = self.cdf(lower) + p * mass, self.sf(upper) + (1.0 - p) * mass
            x = np.where(below < above, self.ppf(np.minimum(below, 1.0)), self.isf(np.minimum(above, 1.0)))
            return np.clip(x, lower, upper)

    def _mass(self, lower: float, upper: float) -> float:
        below, above = self.cdf(lower), self.sf(upper)
        mass = self.sf(lower) - above if below > above else self.cdf(upper) - below
        return max(float(mass), 0.0)


@check_arguments
@dataclass(frozen=True)
class ScaledBeta(InvertedPrior):
    """The beta distribution on an interval: density ∝ t^(a−1) (1 − t)^(b−1) with t = (x − low)/(high − low).

    If a or b is below 1, the density is infinite at the corresponding end. The distribution can then be sampled,
    but has no maximum.

    Attributes
    ----------
    a, b : float
        Shape parameters, dimensionless.
    low, high : float
        Ends of the interval, in the parameter's unit.

    Raises
    ------
    ValueError
        If a shape parameter is not positive and finite, or the ends are not finite with low < high.
    """

    a: Positive
    b: Positive
    low: float = 0.0
    high: float = 1.0

    def __post_init__(self) -> None:
        _require_order(self.low, self.high)

    @classmethod
    @check_arguments
    def from_mean(cls, mean: float, sd: Positive, low: float = 0.0, high: float = 1.0) -> ScaledBeta:
        """Return the prior on [low, high] with the given mean and standard deviation, in the parameter's unit.

        Raises
        ------
        ValueError
            If `low` is not below `high`, the mean is not between them, or the standard deviation is not positive
            or is too large for any beta distribution with this mean.
        """
        _require_order(low, high)
        if not low < mean < high:
            raise ArgumentError("mean", f"must lie between low {typed(low)} and high {typed(high)}", typed(mean))
        m, largest = (mean - low) / (high - low), np.sqrt((mean - low) * (high - mean))
        if not sd < largest:
            raise ArgumentError(
                "sd", f"must be below {significant(largest, 6)}, the limit for a beta with this mean", typed(sd)
            )
        total = (largest / sd) ** 2 - 1.0
        return cls(float(m * total), float((1.0 - m) * total), low, high)

    @property
    def support(self) -> tuple[float, float]:
        """Interval from `low` to `high`."""
        return self.low, self.high

    def log_pdf(self, x: FloatArray) -> FloatArray:
        """Return the normalised log-density at each x; ``-inf`` outside [low, high] or where p(x) is infinite."""
        t, s = self._parts(x)
        with np.errstate(all="ignore"):
            value = xlogy(self.a - 1.0, t) + xlogy(self.b - 1.0, s) + self._constant
        return np.where((t >= 0.0) & (s >= 0.0) & (value < np.inf), value, -np.inf)

    def log_pdf_gradient(self, x: FloatArray) -> FloatArray:
        """Return the derivative of the log-density, (a − 1)/(x − low) − (b − 1)/(high − x).

        The result is NaN outside [low, high] and at an end where the derivative is infinite.
        """
        t, s = self._parts(x)
        with np.errstate(all="ignore"):
            left = np.zeros_like(t) if self.a == 1.0 else (self.a - 1.0) / t
            right = np.zeros_like(s) if self.b == 1.0 else (self.b - 1.0) / s
            gradient = (left - right) / (self.high - self.low)
        return np.where((t >= 0.0) & (s >= 0.0) & np.isfinite(gradient), gradient, np.nan)

    def cdf(self, x: ArrayLike) -> FloatArray:
        """Return the distribution function F, the regularised incomplete beta function."""
        return betainc(self.a, self.b, np.clip(self._parts(x)[0], 0.0, 1.0))

    def sf(self, x: ArrayLike) -> FloatArray:
        """Return the survival function 1 − F at each x."""
        return betainc(self.b, self.a, np.clip(self._parts(x)[1], 0.0, 1.0))

    def ppf(self, p: FloatArray) -> FloatArray:
        """Return the quantile F⁻¹(p) for each probability p."""
        return np.asarray(self.low + (self.high - self.low) * betaincinv(self.a, self.b, p))

    def isf(self, p: FloatArray) -> FloatArray:
        """Return the upper quantile for each probability p: the value at which 1 − F equals p."""
        return np.asarray(self.high - (self.high - self.low) * betaincinv(self.b, self.a, p))

    def as_dict(self) -> dict[str, Plain]:
        """Return the prior's name and settings as a dict."""
        return {"distribution": "beta", "a": self.a, "b": self.b, "low": self.low, "high": self.high}

    def _parts(self, x: Any) -> tuple[FloatArray, FloatArray]:
        """Return t = (x − low)/(high − low) and 1 − t at each x.

        No digits are lost by cancellation where either of them is near zero.
        """
        width = self.high - self.low
        return np.asarray((x - self.low) / width), np.asarray((self.high - x) / width)

    @cached_property
    def _constant(self) -> float:
        return -float(betaln(self.a, self.b) + np.log(self.high - self.low))


@check_arguments
@dataclass(frozen=True, repr=False)
class ScipyPrior(InvertedPrior):
    """A prior from any continuous distribution of ``scipy.stats``, such as ``ScipyPrior(gumbel_r(loc=2.0))``.

    Attributes
    ----------
    distribution : scipy.stats distribution
        The distribution of the parameter in its unit, with its arguments ("frozen"), each a number.

    Raises
    ------
    ValueError
        If `distribution` is not a frozen continuous distribution of ``scipy.stats``, or its arguments
        are out of range.

    Notes
    -----
    The gradient of the log-density is a five-point central difference, with an error of fourth order. Let h be
    half the width of the central 68 % interval. The step is 1e-3 times the smaller of two lengths: the distance to
    the nearer end of the support, and the larger of h and the distance to the median. The relative error is about
    1e-9. At points closer than 1e-6 h to an end, the gradient at that distance is used.
    """

    distribution: Any

    def __post_init__(self) -> None:
        from scipy.stats import rv_continuous

        if not isinstance(getattr(self.distribution, "dist", None), rv_continuous):
            rule = "must be a frozen distribution, such as scipy.stats.gumbel_r(loc=2.0) or rv_histogram(h)()"
            raise ArgumentError("distribution", rule, repr(self.distribution))
        is_one = np.ndim(self.distribution.median()) == 0
        if not (is_one and np.all(np.isfinite(self._central)) and self._spread > 0.0):
            raise ArgumentError("distribution", "its arguments must be numbers in range", repr(self))

    def __repr__(self) -> str:
        settings = [*map(repr, self.distribution.args), *(f"{k}={v!r}" for k, v in self.distribution.kwds.items())]
        return f"ScipyPrior({self._name}({', '.join(settings)}))"

    @property
    def support(self) -> tuple[float, float]:
        """Interval outside which the distribution has no density."""
        low, high = self.distribution.support()
        return float(low), float(high)

    def log_pdf(self, x: FloatArray) -> FloatArray:
        """Return the normalised log-density at each x; ``-inf`` outside the support or where p(x) is infinite."""
        with np.errstate(all="ignore"):
            value = self.distribution.logpdf(x)
        return np.where(value < np.inf, value, -np.inf)

    def log_pdf_gradient(self, x: FloatArray) -> FloatArray:
        """Return the derivative of the log-density at each x: by finite differences, or 0 for a histogram.

        The result is NaN where the difference quotient is not finite, and where `log_pdf` is ``-inf``.
        """
        from scipy.stats import rv_histogram

        if isinstance(self.distribution.dist, rv_histogram):  # a difference across an edge would be a false slope
            return np.where(np.isfinite(self.log_pdf(x)), 0.0, np.nan)
        low, high = self.support
        with np.errstate(all="ignore"):
            centre = np.clip(x, low + _EDGE * self._spread, high - _EDGE * self._spread)
            spread = np.maximum(self._spread, np.abs(centre - self._central[1]))
            h = _STEP * np.minimum(spread, np.minimum(centre - low, high - centre))
            h = (centre + h) - centre  # the step after rounding
            steps = np.array([-2.0, -1.0, 1.0, 2.0]).reshape(4, *np.ones(np.ndim(x), dtype=int))
            f = self.distribution.logpdf(centre + steps * h)
            slope = (f[0] - 8.0 * f[1] + 8.0 * f[2] - f[3]) / (12.0 * h)
            return np.where(np.isfinite(slope) & np.isfinite(self.log_pdf(x)), slope, np.nan)

    def cdf(self, x: ArrayLike) -> FloatArray:
        """Return the distribution function F at each x."""
        return self.distribution.cdf(x)

    def sf(self, x: ArrayLike) -> FloatArray:
        """Return the survival function 1 − F at each x."""
        return self.distribution.sf(x)

    def ppf(self, p: FloatArray) -> FloatArray:
        """Return the quantile F⁻¹(p) for each probability p."""
        return np.asarray(self.distribution.ppf(p))

    def isf(self, p: FloatArray) -> FloatArray:
        """Return the upper quantile for each probability p: the value at which 1 − F equals p."""
        return np.asarray(self.distribution.isf(p))

    def as_dict(self) -> dict[str, Plain]:
        """Return the name, arguments and quantiles of the distribution as a dict.

        The quantiles distinguish distributions that share a name.
        """
        arguments = {f"argument {i + 1}": _plain(value) for i, value in enumerate(self.distribution.args)}
        arguments |= {key: _plain(value) for key, value in sorted(self.distribution.kwds.items())}
        return {"distribution": f"scipy.stats.{self._name}", **arguments, "quantiles": _plain(self._central)}

    @property
    def _name(self) -> str:
        return str(self.distribution.dist.name or type(self.distribution.dist).__name__)

    @cached_property
    def _central(self) -> FloatArray:
        with np.errstate(all="ignore"):
            return np.asarray(self.distribution.ppf(np.array([0.16, 0.5, 0.84])))

    @cached_property
    def _spread(self) -> float:
        return float(0.5 * (self._central[2] - self._central[0]))


def _require_order(low: float, high: float) -> None:
    if not low < high:
        raise ArgumentError("high", f"must exceed low {typed(low)}", typed(high))


def _plain(value: Any) -> Any:
    return np.asarray(value, dtype=float).tolist()
