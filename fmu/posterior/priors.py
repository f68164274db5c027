"""Priors: what was known of one parameter before the measurement, cut off by its bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtri_exp

FloatArray = NDArray[np.float64]


class Prior(Protocol):
    """A one-dimensional distribution, before the bounds truncate it."""

    def log_pdf(self, x: FloatArray) -> FloatArray:
        """Return the normalised log-density."""
        ...

    def log_pdf_gradient(self, x: FloatArray) -> FloatArray:
        """Return its derivative."""
        ...

    def log_mass(self, lower: float, upper: float) -> float:
        """Return the logarithm of the probability between two bounds."""
        ...

    def draw(self, rng: np.random.Generator, n: int, lower: float, upper: float) -> FloatArray:
        """Draw from the distribution truncated to the bounds."""
        ...

    def scale(self, lower: float, upper: float) -> tuple[float, float]:
        """Return the offset and the size of the affine coordinate in which the parameter is of order one."""
        ...

    def box(self, lower: float, upper: float) -> tuple[float, float]:
        """Return the finite interval on which a reduced model has to be good."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        ...


@dataclass(frozen=True)
class Normal:
    """The Gaussian prior of eq. (6): density ∝ exp(−α/2 (x − mean)²), with α = 1/sd².

    Attributes
    ----------
    sd : float
        Standard deviation in the parameter's unit.
    mean : float
        The paper's centre is 0.
    """

    sd: float
    mean: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sd) and self.sd > 0):
            raise ValueError(f"sd: must be positive and finite (got {self.sd})")
        if not np.isfinite(self.mean):
            raise ValueError(f"mean: must be finite (got {self.mean})")

    @classmethod
    def from_alpha(cls, alpha: float, mean: float = 0.0) -> Normal:
        """Return the prior with the paper's coefficient α = 1/sd²."""
        if not (np.isfinite(alpha) and alpha > 0):
            raise ValueError(f"alpha: must be positive and finite (got {alpha})")
        return cls(sd=float(alpha) ** -0.5, mean=mean)

    def log_pdf(self, x: FloatArray) -> FloatArray:
        """Return the normalised log-density, eq. (6) with (7)."""
        with np.errstate(over="ignore"):
            z = (x - self.mean) / self.sd
            return -0.5 * z * z - np.log(self.sd) - 0.5 * np.log(2.0 * np.pi)

    def log_pdf_gradient(self, x: FloatArray) -> FloatArray:
        """Return −α (x − mean)."""
        with np.errstate(over="ignore"):
            return -(x - self.mean) / self.sd**2

    def log_mass(self, lower: float, upper: float) -> float:
        """Return log(Φ(b) − Φ(a)) without cancellation in either tail."""
        a, b = (lower - self.mean) / self.sd, (upper - self.mean) / self.sd
        if a > 0:
            a, b = -b, -a
        with np.errstate(divide="ignore", invalid="ignore"):  # bounds so far out or so close that nothing is left
            return float(log_ndtr(b) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(b))))

    def draw(self, rng: np.random.Generator, n: int, lower: float, upper: float) -> FloatArray:
        """Draw by inversion of the truncated distribution function."""
        a, b = (lower - self.mean) / self.sd, (upper - self.mean) / self.sd
        flip = a > 0
        if flip:
            a, b = -b, -a
        u = rng.uniform(size=n)
        with np.errstate(divide="ignore"):
            z = ndtri_exp(np.logaddexp(log_ndtr(a) + np.log1p(-u), log_ndtr(b) + np.log(u)))
        return np.clip(self.mean + self.sd * (-z if flip else z), lower, upper)

    def scale(self, lower: float, upper: float) -> tuple[float, float]:
        """Return the box where there is one, else mean and standard deviation."""
        if np.isfinite(upper - lower):
            return lower, upper - lower
        return self.mean, self.sd

    def box(self, lower: float, upper: float) -> tuple[float, float]:
        """Return the bounds, or four standard deviations from where the prior is densest if that is nearer."""
        densest = min(max(self.mean, lower), upper)
        return max(lower, densest - 4.0 * self.sd), min(upper, densest + 4.0 * self.sd)

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        return {"distribution": "normal", "mean": self.mean, "sd": self.sd}


@dataclass(frozen=True)
class Uniform:
    """Constant between the bounds, which must both be finite."""

    def log_pdf(self, x: FloatArray) -> FloatArray:
        """Return 0: `log_mass` carries the normalisation."""
        return np.zeros_like(x)

    def log_pdf_gradient(self, x: FloatArray) -> FloatArray:
        """Return 0."""
        return np.zeros_like(x)

    def log_mass(self, lower: float, upper: float) -> float:
        """Return the logarithm of the width."""
        return float(np.log(upper - lower))

    def draw(self, rng: np.random.Generator, n: int, lower: float, upper: float) -> FloatArray:
        """Draw uniformly."""
        return rng.uniform(lower, upper, size=n)

    def scale(self, lower: float, upper: float) -> tuple[float, float]:
        """Return lower bound and width."""
        return lower, upper - lower

    def box(self, lower: float, upper: float) -> tuple[float, float]:
        """Return the bounds."""
        return lower, upper

    def as_dict(self) -> dict[str, Any]:
        """Return the name."""
        return {"distribution": "uniform"}
