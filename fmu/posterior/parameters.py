"""Updating parameters: name, unit, bounds, start and what was known of them before the measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
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


@dataclass(frozen=True)
class Parameter:
    """One uncertain quantity of the model.

    Attributes
    ----------
    name : str
    start : float
        Where the model stands before updating, in `unit`.
    lower, upper : float
        Bounds; they truncate the prior.
    prior : Prior
        `Uniform` by default, which needs finite bounds.
    unit : str
        SI unit, for labels; empty for a factor.
    group : str
        Parameters of one group may share their α in eq. (6), see `share_alpha`.

    Raises
    ------
    ValueError
        If a bound, the start or the prior does not fit the others.
    """

    name: str
    start: float
    lower: float = -np.inf
    upper: float = np.inf
    prior: Prior = field(default_factory=Uniform)
    unit: str = ""
    group: str = ""

    def __post_init__(self) -> None:
        if not self.name or "/" in self.name:
            raise ValueError(f"name: must not be empty or contain '/' (got {self.name!r})")
        if not self.lower < self.upper:
            raise ValueError(f"{self.name}.upper: must exceed lower {self.lower:g} (got {self.upper:g})")
        if not (np.isfinite(self.start) and self.lower <= self.start <= self.upper):
            bounds = f"[{self.lower:g}, {self.upper:g}]"
            raise ValueError(f"{self.name}.start: must be finite and within {bounds} (got {self.start:g})")
        if isinstance(self.prior, Uniform) and not np.isfinite(self.upper - self.lower):
            raise ValueError(
                f"{self.name}.prior: a uniform prior needs finite bounds (got [{self.lower}, {self.upper}])"
            )
        if not np.isfinite(self.prior.log_mass(self.lower, self.upper)):
            raise ValueError(f"{self.name}.prior: must have probability between the bounds (got none)")


def share_alpha(parameters: Sequence[Parameter], alpha: Mapping[str, float]) -> tuple[Parameter, ...]:
    """Give every group of parameters its α of eq. (6).

    Parameters
    ----------
    parameters : sequence of Parameter
    alpha : mapping of group name to float
        α = 1/σ² in the parameters' units; parameters of groups not named keep their prior.

    Raises
    ------
    ValueError
        If a group has no parameter.
    """
    unused = set(alpha) - {p.group for p in parameters}
    if unused:
        raise ValueError(f"alpha: every group needs a parameter (none in {sorted(unused)})")
    return tuple(
        replace(p, prior=Normal.from_alpha(alpha[p.group])) if p.group in alpha else p for p in parameters
    )


class JointPrior:
    """The product of the parameters' priors, truncated to the bounds and normalised over them.

    Gaussian priors, the common case, are evaluated as one array.
    """

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        is_normal = [isinstance(p.prior, Normal) for p in parameters]
        self._normal = np.flatnonzero(is_normal)
        normals = [p.prior for p in parameters if isinstance(p.prior, Normal)]
        # a row, like one theta, which spares it NumPy's broadcasting
        self._mean = np.array([prior.mean for prior in normals])[None]
        self._precision = np.array([prior.sd for prior in normals]) ** -2.0
        self._others = [(j, p.prior) for j, p in enumerate(parameters) if not is_normal[j]]
        log_mass = sum(p.prior.log_mass(p.lower, p.upper) for p in parameters)
        self._weight = -0.5 * self._precision
        self._constant = 0.5 * float(np.sum(np.log(self._precision / (2.0 * np.pi)))) - log_mass

    def log_pdf(self, theta: FloatArray) -> FloatArray:
        """Return the log-density, shape (n,), at theta (n, ndim) inside the bounds."""
        # `take` gives C order, in which a row is summed in the same order whatever the batch; einsum does not warn
        # where it overflows
        z = theta.take(self._normal, axis=1) - self._mean
        value = self._constant + np.einsum("nj,nj,j->n", z, z, self._weight)
        for j, prior in self._others:
            value = value + prior.log_pdf(theta[:, j])
        return value

    def log_pdf_gradient(self, theta: FloatArray) -> FloatArray:
        """Return its gradient, shape (n, ndim)."""
        gradient = np.empty_like(theta)
        with np.errstate(over="ignore"):
            gradient[:, self._normal] = -self._precision * (theta[:, self._normal] - self._mean)
        for j, prior in self._others:
            gradient[:, j] = prior.log_pdf_gradient(theta[:, j])
        return gradient
