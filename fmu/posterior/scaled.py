"""A log-density in affinely scaled coordinates, which samplers and optimisers work in."""

from __future__ import annotations

from typing import Any

import numpy as np

from fmu.types import FloatArray, LogDensity


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

    def __init__(self, density: LogDensity) -> None:
        self.density = density
        self.ndim = density.ndim
        by_differences = 1 if hasattr(density, "log_prob_and_grad") else 2 * density.ndim + 1
        self.solves_per_gradient = int(getattr(density, "solves_per_gradient", by_differences))
        self.theta_lower, self.theta_upper = (self._vector(name) for name in ("lower", "upper"))
        if not np.all(self.theta_lower < self.theta_upper):
            raise ValueError(f"upper: must exceed lower {self.theta_lower} (got {self.theta_upper})")
        if hasattr(density, "offset") and hasattr(density, "scale"):
            self.offset, self.scale = self._vector("offset"), self._vector("scale")
        else:
            boxed = np.isfinite(self.theta_lower) & np.isfinite(self.theta_upper)
            self.offset = np.where(boxed, self.theta_lower, 0.0)
            self.scale = np.where(boxed, self.theta_upper - self.theta_lower, 1.0)
        if not (np.all(np.isfinite(self.offset)) and np.all(np.isfinite(self.scale)) and np.all(self.scale > 0)):
            raise ValueError(
                f"scale: must be positive and finite, and offset finite (got {self.scale}, {self.offset})"
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
        """Return ∂θ/∂u of each coordinate, shape (ndim,) or that of theta (n, ndim)."""
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
            raise ValueError(
                f"{name}: must have shape ({self.ndim},), one entry per coordinate (got {vector.shape})"
            )
        return vector
