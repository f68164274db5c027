"""Logarithmic coordinates in which skewed log-densities are more nearly quadratic."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmu.samplers.mixture.quadratic import Quadratic
from fmu.types import BoolArray, FloatArray

_BEND = 0.1
"""Distance from the lower bound, in scaled units, at which a bent coordinate turns from linear to logarithmic."""


@dataclass(frozen=True, eq=False)
class Warp:
    """Coordinate transformation that makes skewed posteriors nearly Gaussian: x = log(1 + (u − lower)/s) or x = u.

    The logarithm applies to the coordinates marked in `bent`; s is `_BEND`. Near the lower bound x is linear in u,
    so a posterior at the bound keeps its shape. Far from it x is logarithmic in u, so log-normal posteriors and
    the tails of inferred standard deviations become Gaussian.

    Attributes
    ----------
    lower, upper : ndarray, shape (ndim,)
        Bounds of u.
    bent : ndarray of bool, shape (ndim,)
        Mask of the logarithmic coordinates, which need a finite lower bound.
    """

    lower: FloatArray
    upper: FloatArray
    bent: BoolArray

    def to_x(self, u: FloatArray) -> FloatArray:
        """Return the coordinates x of points u; both have shape (..., ndim)."""
        with np.errstate(invalid="ignore"):  # inf - (-inf) in coordinates that are not bent
            return np.where(self.bent, np.log1p((u - self.lower) / _BEND), u)

    def to_u(self, x: FloatArray) -> FloatArray:
        """Return the points u with coordinates x, clipped to the bounds; both have shape (..., ndim)."""
        with np.errstate(over="ignore", invalid="ignore"):
            u = np.where(self.bent, self.lower + _BEND * np.expm1(np.where(self.bent, x, 0.0)), x)
        return np.clip(u, self.lower, self.upper)

    def stretch(self, u: FloatArray) -> FloatArray:
        """Return the derivatives du/dx of each coordinate at points u, shape (..., ndim)."""
        return np.where(self.bent, _BEND + u - np.where(self.bent, self.lower, 0.0), 1.0)

    def log_stretch(self, u: FloatArray) -> FloatArray:
        """Return log |du/dx| at points u (n, ndim), shape (n,)."""
        return np.asarray(np.sum(np.log(self.stretch(u)), axis=1))

    def quadratic(self, of_u: Quadratic) -> Quadratic:
        """Convert the second-order expansion of a log-density in u to the expansion of the log-density in x."""
        away = self.stretch(of_u.position)
        bent = self.bent.astype(float)
        return Quadratic(
            self.to_x(of_u.position),
            of_u.log_prob + float(np.sum(np.log(away))),
            of_u.gradient * away + bent,
            of_u.hessian * np.outer(away, away) - np.diag(bent * of_u.gradient * away),
            None if of_u.covariance is None else of_u.covariance / np.outer(away, away),
        )

    def straighten(self, of_x: Quadratic) -> Quadratic:
        """Convert the second-order expansion of a log-density in x to one in u; the inverse of `quadratic`."""
        u = self.to_u(of_x.position)
        away = self.stretch(u)
        slope = of_x.gradient - self.bent
        return Quadratic(
            u,
            of_x.log_prob - float(np.sum(np.log(away))),
            slope / away,
            (of_x.hessian + np.diag(self.bent * slope)) / np.outer(away, away),
            None if of_x.covariance is None else of_x.covariance * np.outer(away, away),
        )
