"""A log-density in scaled coordinates: affine ones for samplers, and logarithms for ascents where they help."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmu.arguments import ArgumentError
from fmu.posterior.density import Posterior
from fmu.types import BoolArray, FloatArray, LogDensity

WIDE = 1.0
"""Standard deviation of a logarithm above which a prior spans decades: 95 % of it lie within a factor of 50."""
FARTHEST = 40.0
"""Standard deviations of a logarithm, where an ascent ends: there a prior is lower by 800 nats."""


class ScaledDensity:
    """A log-density in the coordinates u = (theta − offset)/scale, in which metrics and widths are of order one.

    Coordinates with two finite bounds lie in the unit box. Values are those of the density in theta; the Jacobian
    of an affine map is constant and left out.

    Parameters
    ----------
    density : LogDensity
        Its attributes `offset` and `scale`, shape (ndim,), are used if it has them. Otherwise they follow from the
        bounds: the unit box where both are finite, else offset 0 and scale 1.

    Raises
    ------
    ValueError
        If bounds, offset or scale have the wrong length, the bounds enclose nothing, or a scale is not positive.
    """

    is_log: BoolArray = np.zeros(1, dtype=bool)
    """Coordinates that are logarithms: none."""

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
        """Return u for theta of any leading shape."""
        return (theta - self.offset) / self.scale

    def to_theta(self, u: FloatArray) -> FloatArray:
        """Return theta for u in the scaled box, clipped so that rounding cannot move it out of the bounds."""
        return np.clip(self.offset + self.scale * u, self.theta_lower, self.theta_upper)

    def stretch(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives ∂θ/∂u, shape (ndim,), or (n, ndim) at theta of that shape."""
        return self.scale

    def log_prob(self, u: Any) -> Any:
        """Return the density's log_prob at u, shape (n, ndim), which must lie in the box."""
        return self.density.log_prob(self.to_theta(u))

    def log_prob_and_grad(self, u: Any) -> tuple[Any, Any]:
        """Return log_prob and its gradient with respect to u."""
        theta = self.to_theta(u)
        log_prob, gradient = self.density.log_prob_and_grad(theta)
        return log_prob, gradient * self.stretch(theta)

    def _vector(self, name: str) -> FloatArray:
        vector = np.asarray(getattr(self.density, name), dtype=float)
        if vector.shape != (self.ndim,):
            raise ArgumentError(name, f"must have shape ({self.ndim},), one entry per coordinate", vector.shape)
        return vector


class LogScaledDensity(ScaledDensity):
    """A log-density in coordinates that climb well: u = (log θ − mean)/sd where a log-normal prior is `WIDE`.

    Others are scaled as in `ScaledDensity`. The density is that of θ, so that its maxima are the same; there is no
    Jacobian. The box ends `FARTHEST` from the median. Where no prior is so wide, all is as in `ScaledDensity`, to
    the last bit.

    Along θ an ascent that has come far out stays there: a spring that is nearly rigid changes nothing, and the
    slope of the log-density falls with 1/θ. In log θ the prior is a parabola, which leads back.

    Attributes
    ----------
    is_log : ndarray of bool, shape (ndim,)
    """

    def __init__(self, problem: Posterior) -> None:
        forms = [p.prior.gaussian_form for p in problem.parameters] or [None] * problem.ndim
        logs = [form if form is not None and form.of_logarithm and form.sd > WIDE else None for form in forms]
        self.is_log = np.array([form is not None for form in logs])
        self._mean = np.array([0.0 if form is None else form.mean for form in logs])
        self._sd = np.array([1.0 if form is None else form.sd for form in logs])
        super().__init__(problem)
        self.lower = np.where(self.is_log, np.maximum(self.lower, -FARTHEST), self.lower)
        self.upper = np.where(self.is_log, np.minimum(self.upper, FARTHEST), self.upper)

    def to_scaled(self, theta: FloatArray) -> FloatArray:
        """Return u for theta of any leading shape."""
        with np.errstate(divide="ignore"):  # at the bound 0
            logs = (np.log(np.where(self.is_log, theta, 1.0)) - self._mean) / self._sd
        return np.where(self.is_log, logs, super().to_scaled(theta))

    def to_theta(self, u: FloatArray) -> FloatArray:
        """Return theta for u in the box, clipped so that rounding cannot move it out of the bounds."""
        with np.errstate(over="ignore"):
            from_logs = np.exp(self._mean + self._sd * np.where(self.is_log, u, 0.0))
        theta = np.where(self.is_log, from_logs, super().to_theta(u))
        return np.clip(theta, self.theta_lower, self.theta_upper)

    def stretch(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives ∂θ/∂u, shape (n, ndim), at theta of that shape."""
        return np.where(self.is_log, theta * self._sd, self.scale)


def ascent_coordinates(problem: Posterior) -> ScaledDensity:
    """Return the coordinates in which to climb: logarithms only if a prior spans decades."""
    with_logs = LogScaledDensity(problem)
    return with_logs if with_logs.is_log.any() else ScaledDensity(problem)
