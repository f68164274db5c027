"""A parameter that scatters from test to test: its distribution over the tests, and scores that make it simple.

The value in test t is θ_t = F⁻¹(Φ(z_t)), with a score z_t and the distribution function F of a normal distribution
inside the bounds of the parameter. If F is that of the population, N(μ, σ²), the scores are standard normal and
independent of μ and σ before the measurement: the non-centred form of a hierarchical model, easy to sample where a
test tells little about its own value. If F is fixed, the scores are the values themselves in other units: the
centred form, easy to sample where a test tells its value well. Each test is between them with a weight w: F has
the mean w μ₀ + (1 − w) μ and the standard deviation σ₀^w σ^(1−w) (Papaspiliopoulos, Roberts & Sköld 2007,
*Statistical Science* 22, 59–73; Gorinova, Moore & Hoffman 2020, *ICML*, PMLR 119). The posterior of the values is
the same with any weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from fmu.arguments import check_arguments
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior
from fmu.posterior.priors.one_sided import HalfNormal
from fmu.types import FloatArray, Plain

Normals = tuple[FloatArray, FloatArray]
Slopes = tuple[FloatArray, FloatArray, FloatArray]

_SCATTER = 0.2
"""Standard deviation of the half-normal prior of a population's, relative to the start value."""
_HALF_LOG_2PI = 0.5 * float(np.log(2.0 * np.pi))


@check_arguments
@dataclass(frozen=True)
class Population:
    """The values of a parameter in different tests are draws from one distribution, which is inferred.

    Attributes
    ----------
    distribution : {"normal", "log-normal"}
        Of the values over the tests, truncated to the bounds of the parameter. Of the normal one, mean and
        standard deviation (in the parameter's unit) are inferred; of the log-normal one the median, and the
        standard deviation of the logarithm. Mean or median has the parameter's own prior and bounds.
    sd : Prior, optional
        Prior of that standard deviation. By default half-normal: its own standard deviation is a fifth of the
        parameter's start value, or 0.2 for a logarithm.

    Raises
    ------
    ValueError
        If the distribution is unknown.
    """

    distribution: Literal["normal", "log-normal"] = "normal"
    sd: Prior | None = None

    def __post_init__(self) -> None:
        if self.distribution not in ("normal", "log-normal"):
            raise ValueError(f"distribution: must be normal or log-normal (got {self.distribution!r})")

    @property
    def of_logarithm(self) -> bool:
        """Whether the logarithm is normal."""
        return self.distribution == "log-normal"

    def parameters(self, of: Parameter) -> tuple[Parameter, Parameter]:
        """Return the inferred parameters of the distribution: its centre and its width.

        Raises
        ------
        ValueError
            If the parameter may be negative and the distribution is log-normal, or the default width has no size
            because the parameter starts at zero.
        """
        if self.of_logarithm and of.lowest <= 0.0:
            raise ValueError(f"{of.name}.lower: must be positive for a log-normal population (got {of.lower})")
        size = _SCATTER * (1.0 if self.of_logarithm else abs(of.start))
        if self.sd is None and size == 0.0:
            raise ValueError(f"{of.name}: a population about zero needs a prior of its sd (got none)")
        prior = HalfNormal(size) if self.sd is None else self.sd
        median = float(prior.quantile(np.array([0.5]), *prior.support)[0])
        centre, width = ("median", "log sd") if self.of_logarithm else ("mean", "sd")
        mean = Parameter(f"{of.name} {centre}", of.start, of.lower, of.upper, of.prior, of.unit)
        unit = "" if self.of_logarithm else of.unit
        return mean, Parameter(f"{of.name} {width}", median, max(0.0, prior.support[0]), np.inf, prior, unit)

    def values(
        self, z: FloatArray, centre: FloatArray, sd: FloatArray, lower: float, upper: float
    ) -> tuple[FloatArray, Slopes]:
        """Return the values whose scores are z, and their derivatives by score, centre and sd; all of one shape.

        Parameters
        ----------
        z, centre, sd : ndarray, broadcastable
        lower, upper : float
            Bounds of the values.
        """
        if not self.of_logarithm:
            return truncated_normal_values(z, centre, sd, lower, upper)
        with np.errstate(divide="ignore"):
            ends = np.log([max(lower, 0.0), upper])
        x, (by_z, by_m, by_s) = truncated_normal_values(z, np.log(centre), sd, *ends)
        value = np.exp(x)
        return value, (value * by_z, value * by_m / centre, value * by_s)

    def log_ratio(
        self, value: FloatArray, one: Normals, other: Normals, lower: float, upper: float
    ) -> tuple[FloatArray, Slopes, Slopes]:
        """Return the logarithm of the density of values in one population over that in another.

        Parameters
        ----------
        value : ndarray
        one, other : tuple of (ndarray, ndarray)
            Centre and sd of each.
        lower, upper : float
            Bounds of the values.

        Returns
        -------
        ratio : ndarray
        by_one, by_other : tuple of three ndarray
            Derivatives of the two log-densities by value, centre and sd; those of the second to be subtracted.
        """
        if not self.of_logarithm:
            (p, by_p), (q, by_q) = (truncated_normal_log_pdf(value, *of, lower, upper) for of in (one, other))
            return p - q, by_p, by_q
        with np.errstate(divide="ignore"):
            ends = np.log([max(lower, 0.0), upper])
        found = []
        for centre, sd in (one, other):
            p, (by_x, by_m, by_s) = truncated_normal_log_pdf(np.log(value), np.log(centre), sd, *ends)
            found.append((p, (by_x / value, by_m / centre, by_s)))
        return found[0][0] - found[1][0], found[0][1], found[1][1]

    def scores(
        self, value: FloatArray, centre: FloatArray, sd: FloatArray, lower: float, upper: float
    ) -> FloatArray:
        """Return the scores of values: the inverse of `values`."""
        if not self.of_logarithm:
            return truncated_normal_scores(value, centre, sd, lower, upper)
        with np.errstate(divide="ignore"):
            ends = np.log([max(lower, 0.0), upper])
        return truncated_normal_scores(np.log(value), np.log(centre), sd, *ends)

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings in plain Python types."""
        return {
            "distribution": self.distribution,
            "sd": None if self.sd is None else self.sd.as_dict(),
        }


def truncated_normal_values(
    z: FloatArray, mean: FloatArray, sd: FloatArray, lower: float, upper: float
) -> tuple[FloatArray, Slopes]:
    """Return x = F⁻¹(Φ(z)) for the normal distribution F truncated to the bounds, and ∂x/∂z, ∂x/∂mean, ∂x/∂sd.

    With α = (lower − mean)/sd and β = (upper − mean)/sd it is x = mean + sd q, where
    Φ(q) = Φ(α) Φ(−z) + Φ(β) Φ(z).

    Parameters
    ----------
    z, mean, sd : ndarray, broadcastable
    lower, upper : float
    """
    if np.isneginf(lower) and np.isposinf(upper):
        shape = np.broadcast_shapes(z.shape, mean.shape, sd.shape)
        return mean + sd * z, tuple(np.broadcast_to(x, shape) for x in (sd, np.ones(1), z))  # type: ignore[return-value]
    with np.errstate(over="ignore", divide="ignore", invalid="ignore", under="ignore"):
        alpha, beta = (lower - mean) / sd, (upper - mean) / sd
        # from the nearer tail, where the probability is not rounded to 1
        turned = z > 0.0
        a, b, t = np.where(turned, -beta, alpha), np.where(turned, -alpha, beta), -np.abs(z)
        log_p = np.logaddexp(log_ndtr(a) + log_ndtr(-t), log_ndtr(b) + log_ndtr(t))
        q = ndtri_exp(np.minimum(log_p, 0.0))
        log_phi = -0.5 * q**2
        by_a = np.exp(log_ndtr(-t) - 0.5 * a**2 - log_phi)  # ∂q/∂a and ∂q/∂b
        by_b = np.exp(log_ndtr(t) - 0.5 * b**2 - log_phi)
        by_t = np.exp(_log_mass(a, b) - 0.5 * t**2 - log_phi)
        moved = np.where(np.isfinite(a), by_a * a, 0.0) + np.where(np.isfinite(b), by_b * b, 0.0)
        sign = np.where(turned, -1.0, 1.0)
        q = sign * q
        return mean + sd * q, (sd * by_t, 1.0 - by_a - by_b, q - sign * moved)


def truncated_normal_log_pdf(
    x: FloatArray, mean: FloatArray, sd: FloatArray, lower: float, upper: float
) -> tuple[FloatArray, Slopes]:
    """Return the log-density of the normal distribution truncated to the bounds, and ∂/∂x, ∂/∂mean, ∂/∂sd.

    Parameters
    ----------
    x : ndarray
        Within the bounds.
    mean, sd : ndarray, broadcastable
    lower, upper : float
    """
    a = (x - mean) / sd
    value = -0.5 * a**2 - np.log(sd) - _HALF_LOG_2PI
    by_x, by_mean, by_sd = -a / sd, a / sd, (a**2 - 1.0) / sd
    if np.isneginf(lower) and np.isposinf(upper):
        return value, (by_x, by_mean, by_sd)
    with np.errstate(over="ignore", invalid="ignore", under="ignore", divide="ignore"):
        alpha, beta = (lower - mean) / sd, (upper - mean) / sd
        log_mass = _log_mass(alpha, beta)
        at_lower = np.exp(-0.5 * alpha**2 - _HALF_LOG_2PI - log_mass)  # densities at the bounds, times sd
        at_upper = np.exp(-0.5 * beta**2 - _HALF_LOG_2PI - log_mass)
        moved = np.where(np.isfinite(beta), at_upper * beta, 0.0) - np.where(
            np.isfinite(alpha), at_lower * alpha, 0.0
        )
        return value - log_mass, (by_x, by_mean + (at_upper - at_lower) / sd, by_sd + moved / sd)


def truncated_normal_scores(
    x: FloatArray, mean: FloatArray, sd: FloatArray, lower: float, upper: float
) -> FloatArray:
    """Return z = Φ⁻¹(F(x)) for the normal distribution F truncated to the bounds: the inverse of its values."""
    with np.errstate(over="ignore", invalid="ignore", under="ignore", divide="ignore"):
        a, alpha, beta = (x - mean) / sd, (lower - mean) / sd, (upper - mean) / sd
        total = _log_mass(alpha, beta)
        below, above = _log_mass(alpha, a) - total, _log_mass(a, beta) - total
        return np.where(below < above, ndtri_exp(np.minimum(below, 0.0)), -ndtri_exp(np.minimum(above, 0.0)))


def _log_mass(alpha: FloatArray, beta: FloatArray) -> FloatArray:
    """Return log(Φ(β) − Φ(α)), from the nearer tail."""
    turned = alpha > 0.0
    a, b = np.where(turned, -beta, alpha), np.where(turned, -alpha, beta)
    return np.asarray(log_ndtr(b) + np.log(-np.expm1(np.minimum(log_ndtr(a) - log_ndtr(b), 0.0))))
