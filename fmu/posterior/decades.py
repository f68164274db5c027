"""Coordinates of an ascent: logarithms where a prior spans decades, as of the stiffness of a joint or a spring."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.protocol import Problem

WIDE = 1.0
"""Standard deviation of a logarithm above which a prior spans decades: 95 % of it lie within a factor of 50."""
FARTHEST = 40.0
"""Standard deviations of a logarithm, where an ascent ends: there a prior is lower by 800 nats."""


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

    def __init__(self, problem: Problem) -> None:
        forms = [p.prior.gaussian_form for p in problem.parameters] or [None] * problem.ndim
        logs = [form if form is not None and form.of_logarithm and form.sd > WIDE else None for form in forms]
        self.is_log = np.array([form is not None for form in logs])
        self._mean = np.array([0.0 if form is None else form.mean for form in logs])
        self._sd = np.array([1.0 if form is None else form.sd for form in logs])
        super().__init__(problem)
        if self.is_log.any():
            self.lower = np.where(self.is_log, np.maximum(self.lower, -FARTHEST), self.lower)
            self.upper = np.where(self.is_log, np.minimum(self.upper, FARTHEST), self.upper)

    def to_scaled(self, theta: FloatArray) -> FloatArray:
        """Return u for theta of any leading shape."""
        u = super().to_scaled(theta)
        if not self.is_log.any():
            return u
        with np.errstate(divide="ignore"):  # at the bound 0
            logs = (np.log(np.where(self.is_log, theta, 1.0)) - self._mean) / self._sd
        return np.where(self.is_log, logs, u)

    def to_theta(self, u: FloatArray) -> FloatArray:
        """Return theta for u in the box, clipped so that rounding cannot move it out of the bounds."""
        theta = super().to_theta(u)
        if not self.is_log.any():
            return theta
        with np.errstate(over="ignore"):
            from_logs = np.exp(self._mean + self._sd * np.where(self.is_log, u, 0.0))
        return np.where(self.is_log, np.clip(from_logs, self.theta_lower, self.theta_upper), theta)

    def stretch(self, theta: FloatArray) -> FloatArray:
        """Return ∂θ/∂u of each coordinate, shape (ndim,) or that of theta (n, ndim)."""
        return np.where(self.is_log, theta * self._sd, self.scale) if self.is_log.any() else self.scale
