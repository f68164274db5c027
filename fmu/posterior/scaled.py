"""Log-densities in scaled coordinates, which are affine or, for log-normal priors, logarithmic."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmu.arguments import ArgumentError
from fmu.posterior.density import Posterior
from fmu.types import BoolArray, FloatArray, LogDensity

WIDE = 0.3
"""Standard deviation of log θ above which ascents use log θ (with 0.3, the central 95 % span a factor of 3)."""
FARTHEST = 40.0
"""Largest distance from the median, in sds of log θ, where the log-density of log θ is 800 below its maximum."""


class ScaledDensity:
    """A log-density in the coordinates u = (theta − offset)/scale, in which its width is of order one.

    The values are log-densities of theta, not of u. The two differ only by a constant, because the map is
    affine.

    Parameters
    ----------
    density : LogDensity
        Its attributes `offset` and `scale`, shape (ndim,), are used if they exist. Otherwise a coordinate between
        two finite bounds is scaled to lie between 0 and 1; other coordinates have offset 0 and scale 1.

    Raises
    ------
    ValueError
        If bounds, offset or scale have the wrong length, an upper bound does not exceed the lower bound, a scale
        is not positive and finite, or an offset is not finite.
    """

    is_log: BoolArray = np.zeros(1, dtype=bool)
    """Mask of the coordinates that are logarithms; here there are none."""

    def __init__(self, density: LogDensity) -> None:
        self.density = density
        self.ndim = density.ndim
        by_differences = 1 if hasattr(density, "log_prob_and_grad") else 2 * density.ndim + 1
        self.solves_per_gradient = int(getattr(density, "solves_per_gradient", by_differences))
        self.theta_lower, self.theta_upper = (self._vector(name) for name in ("lower", "upper"))
        if not np.all(self.theta_lower < self.theta_upper):
            raise ArgumentError("upper", f"must exceed lower {self.theta_lower}", self.theta_upper)
        if hasattr(density, "offset") and hasattr(density, "scale"):
            self.offset, self.scale = self._vector("offset"), self._vector("scale")
        else:
            boxed = np.isfinite(self.theta_lower) & np.isfinite(self.theta_upper)
            self.offset = np.where(boxed, self.theta_lower, 0.0)
            self.scale = np.where(boxed, self.theta_upper - self.theta_lower, 1.0)
        if not (np.all(np.isfinite(self.offset)) and np.all(np.isfinite(self.scale)) and np.all(self.scale > 0)):
            raise ArgumentError(
                "scale", "must be positive and finite, and offset finite", f"{self.scale}, {self.offset}"
            )
        self.lower = self.to_scaled(self.theta_lower)
        self.upper = self.to_scaled(self.theta_upper)

    def to_scaled(self, theta: FloatArray) -> FloatArray:
        """Return the scaled coordinates u for theta; both have the shape (..., ndim)."""
        return (theta - self.offset) / self.scale

    def to_theta(self, u: FloatArray) -> FloatArray:
        """Return theta (..., ndim) for u in the box, clipped so that rounding cannot move it out of the bounds."""
        return np.clip(self.offset + self.scale * u, self.theta_lower, self.theta_upper)

    def stretch(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives ∂θ/∂u: here the constant `scale` (ndim,), in subclasses possibly (n, ndim)."""
        return self.scale

    def log_prob(self, u: Any) -> Any:
        """Return the log-density, shape (n,), at u (n, ndim), which must lie in the box."""
        return self.density.log_prob(self.to_theta(u))

    def log_prob_and_grad(self, u: Any) -> tuple[Any, Any]:
        """Return the log-density (n,) at u (n, ndim) and its gradient (n, ndim) with respect to u."""
        theta = self.to_theta(u)
        log_prob, gradient = self.density.log_prob_and_grad(theta)
        return log_prob, gradient * self.stretch(theta)

    def _vector(self, name: str) -> FloatArray:
        vector = np.asarray(getattr(self.density, name), dtype=float)
        if vector.shape != (self.ndim,):
            raise ArgumentError(name, f"must have shape ({self.ndim},), one entry per coordinate", vector.shape)
        return vector


class LogScaledDensity(ScaledDensity):
    """A log-density in coordinates for ascents, which are logarithmic for parameters with wide log-normal priors.

    If the standard deviation sd of log θ exceeds `wide` in a log-normal prior, u = (log θ − mean)/sd, where mean
    is the mean of log θ. Other coordinates are scaled as in `ScaledDensity`. The values are log-densities of θ,
    without a Jacobian, so that the maxima are those of the density of θ. In a logarithmic coordinate, the box ends
    at most `FARTHEST` standard deviations from the median. If there is no such prior, all values equal those of
    `ScaledDensity` to the last bit.

    In θ, an ascent that has moved far out does not return, because a nearly rigid spring does not influence the
    modes and the slope of the log-density decreases as 1/θ. In log θ the log-prior is a parabola, whose slope
    leads back.

    Attributes
    ----------
    is_log : ndarray of bool, shape (ndim,)
        Mask of the coordinates that are logarithms.
    """

    def __init__(self, problem: Posterior, wide: float = WIDE) -> None:
        forms = [p.prior.gaussian_form for p in problem.parameters] or [None] * problem.ndim
        logs = [form if form is not None and form.of_logarithm and form.sd > wide else None for form in forms]
        self.is_log = np.array([form is not None for form in logs])
        self._mean = np.array([0.0 if form is None else form.mean for form in logs])
        self._sd = np.array([1.0 if form is None else form.sd for form in logs])
        super().__init__(problem)
        self.lower = np.where(self.is_log, np.maximum(self.lower, -FARTHEST), self.lower)
        self.upper = np.where(self.is_log, np.minimum(self.upper, FARTHEST), self.upper)

    def to_scaled(self, theta: FloatArray) -> FloatArray:
        """Return the scaled coordinates u for theta; both have the shape (..., ndim)."""
        with np.errstate(divide="ignore"):  # at the bound 0
            logs = (np.log(np.where(self.is_log, theta, 1.0)) - self._mean) / self._sd
        return np.where(self.is_log, logs, super().to_scaled(theta))

    def to_theta(self, u: FloatArray) -> FloatArray:
        """Return theta (..., ndim) for u in the box, clipped so that rounding cannot move it out of the bounds."""
        with np.errstate(over="ignore"):
            from_logs = np.exp(self._mean + self._sd * np.where(self.is_log, u, 0.0))
        theta = np.where(self.is_log, from_logs, super().to_theta(u))
        return np.clip(theta, self.theta_lower, self.theta_upper)

    def stretch(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives ∂θ/∂u, shape (n, ndim), at theta (n, ndim)."""
        return np.where(self.is_log, theta * self._sd, self.scale)


def scaled_density(density: LogDensity) -> ScaledDensity:
    """Return a density in scaled coordinates, or the density itself if it is already scaled."""
    return density if isinstance(density, ScaledDensity) else ScaledDensity(density)


class LogarithmicDensity:
    """The posterior density of u, the coordinates of `LogScaledDensity`, for samplers. It includes the Jacobian.

    All parameters with log-normal priors have logarithmic coordinates, because the density of θ is skewed, whereas
    the density of log θ is nearly Gaussian.

    Parameters
    ----------
    problem : Posterior
    """

    def __init__(self, problem: Posterior) -> None:
        self._of = LogScaledDensity(problem, wide=0.0)
        self.ndim, self.lower, self.upper = self._of.ndim, self._of.lower, self._of.upper
        self.to_scaled, self.to_theta = self._of.to_scaled, self._of.to_theta
        self.solves_per_gradient = self._of.solves_per_gradient

    def log_prob(self, u: FloatArray) -> FloatArray:
        """Return the log-density, shape (n,), at u (n, ndim), which must lie in the box."""
        return np.asarray(self._of.log_prob(u) + self._log_jacobian(u))

    def log_prob_and_grad(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density (n,) at u (n, ndim) and its gradient (n, ndim) with respect to u."""
        log_prob, gradient = self._of.log_prob_and_grad(u)
        theta = self.to_theta(u)
        of_jacobian = self._of.stretch(theta) / np.where(self._of.is_log, theta, np.inf)
        return log_prob + self._log_jacobian(u), gradient + of_jacobian

    def _log_jacobian(self, u: FloatArray) -> FloatArray:
        return np.asarray(np.sum(np.log(self._of.stretch(self.to_theta(u))), axis=-1))


def clip_to_support(scaled: ScaledDensity, problem: Posterior) -> ScaledDensity:
    """Limit theta in `scaled` to `Posterior.support`, where the log-prior is finite; return `scaled` itself."""
    scaled.theta_lower, scaled.theta_upper = problem.support
    return scaled


def ascent_coordinates(problem: Posterior) -> ScaledDensity:
    """Return the scaled density for ascents. Parameters with wide log-normal priors are scaled logarithmically.

    At a bound where the density vanishes, such as a standard deviation of 0, theta stays just inside.
    """
    with_logs = LogScaledDensity(problem)
    scaled = with_logs if with_logs.is_log.any() else ScaledDensity(problem)
    return clip_to_support(scaled, problem)
