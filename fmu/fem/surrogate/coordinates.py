"""Coordinates in which modal quantities are nearly linear: logarithms of positive parameters, scaled to −1 … 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmu.types import BoolArray, FloatArray

FARTHEST = 9.0
"""Value of |x| beyond which a parameter has no further effect, four widths of the box away from its edge: the
logarithm of zero is infinite, and an extrapolation so far out is meaningless."""


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Map between theta in a box and scaled coordinates x, applied to each parameter separately.

    The map is x = (g(θ) − c)/w, where g(θ) is log θ or θ, and c and w are the centre and half the width of the
    interval between the values of g at the two bounds. An eigenvalue is a linear form in the stiffnesses divided
    by a linear form in the masses (the Rayleigh quotient). Its logarithm is therefore nearly linear in the
    logarithms of the stiffnesses and masses.

    Attributes
    ----------
    lower, upper : ndarray, shape (n_parameters,)
        Bounds of the box, which are mapped to −1 and 1. Points theta outside the box are mapped too.
    is_log : ndarray of bool, shape (n_parameters,)
        Whether g is the logarithm, for each parameter.
    """

    lower: FloatArray
    upper: FloatArray
    is_log: BoolArray

    @classmethod
    def of_box(cls, lower: FloatArray, upper: FloatArray, positive: BoolArray) -> Coordinates:
        """Return coordinates for a box.

        A parameter is logarithmic if it is marked in `positive` (n_parameters,) and its lower bound is above zero.
        """
        return cls(lower, upper, positive & (lower > 0.0))

    def to_x(self, theta: FloatArray) -> FloatArray:
        """Convert theta to x, both of shape (n, n_parameters); |x| is limited to `FARTHEST`."""
        return np.clip(self._map_without_limit(theta), -FARTHEST, FARTHEST)

    def to_theta(self, x: FloatArray) -> FloatArray:
        """Convert x to theta, both of shape (n, n_parameters); −1 and 1 give the bounds of the box exactly."""
        low, high = self._g(self.lower), self._g(self.upper)
        g = 0.5 * (high + low) + 0.5 * x * (high - low)
        theta = np.where(self.is_log, np.exp(np.where(self.is_log, g, 0.0)), g)
        return np.where(x == -1.0, self.lower, np.where(x == 1.0, self.upper, theta))

    def slope(self, theta: FloatArray) -> FloatArray:
        """Return ∂x/∂θ for each parameter at theta, both of shape (n, n_parameters); it is 0 beyond `FARTHEST`."""
        half = 0.5 * (self._g(self.upper) - self._g(self.lower))
        goes_on = np.abs(self._map_without_limit(theta)) < FARTHEST
        return np.where(goes_on, 1.0, 0.0) / np.where(self.is_log & goes_on, theta, 1.0) / half

    def _map_without_limit(self, theta: FloatArray) -> FloatArray:
        low, high = self._g(self.lower), self._g(self.upper)
        return (2.0 * self._g(theta) - (high + low)) / (high - low)

    def _g(self, theta: FloatArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.where(self.is_log, np.log(np.where(self.is_log, theta, 1.0)), theta)
