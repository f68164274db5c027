"""Transform skewed log-densities to logarithmic coordinates, in which they are more nearly quadratic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fmu.samplers.mixture.quadratic import Quadratic
from fmu.types import BoolArray, FloatArray, LogDensity

_BEND = 0.1
"""Distance from the lower bound, in scaled units, at which a bent coordinate turns from linear to logarithmic."""
_GAIN = 0.02
"""Smallest gain in the mean log-density of a Gaussian, in nats, for which a coordinate is bent."""


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

    @classmethod
    def of_density(cls, density: LogDensity, bent: Sequence[bool]) -> Self:
        """Return the warp that makes the coordinates in the mask `bent` logarithmic.

        Raise ValueError if the mask does not have one value per coordinate, or marks one without a lower bound.
        """
        if len(bent) != density.ndim:
            raise ValueError(f"bent: must have {density.ndim} values, one per coordinate (got {len(bent)})")
        without = np.flatnonzero(np.array(bent) & ~np.isfinite(density.lower))
        if without.size:
            raise ValueError(f"bent.{without[0]}: must be False, as the coordinate has no lower bound (got True)")
        return cls(density.lower, density.upper, np.array(bent))

    @classmethod
    def fitting(cls, draws: FloatArray, lower: FloatArray, upper: FloatArray) -> Self:
        """Return the warp in which draws of u, shape (n, ndim), are most nearly Gaussian.

        Coordinates with a lower bound are bent one after the other, as long as this increases the likelihood of a
        Gaussian fitted to the draws. Box & Cox (1964), J. R. Stat. Soc. B 26, 211-252, choose powers in this way.
        """

        def log_likelihood(warp: Warp) -> float:
            covariance = np.cov(warp.to_x(draws), rowvar=False).reshape(len(lower), len(lower))
            return float(-0.5 * np.linalg.slogdet(covariance)[1] - np.mean(warp.log_stretch(draws)))

        best = cls(lower, upper, np.zeros(len(lower), dtype=bool))
        reached = log_likelihood(best)
        while (left := np.flatnonzero(np.isfinite(lower) & ~best.bent)).size:
            tried = [replace(best, bent=best.bent | (np.arange(len(lower)) == k)) for k in left]
            values = [log_likelihood(warp) for warp in tried]
            if not np.max(values) > reached + _GAIN:
                break
            best, reached = tried[int(np.argmax(values))], float(np.max(values))
        return best

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


class WarpedDensity:
    """A log-density of u in the coordinates x of a warp, including the Jacobian du/dx.

    Parameters
    ----------
    density : LogDensity
    warp : Warp
    """

    def __init__(self, density: LogDensity, warp: Warp) -> None:
        self.density, self.warp, self.ndim = density, warp, density.ndim
        self.lower, self.upper = warp.to_x(density.lower), warp.to_x(density.upper)
        self.solves_per_gradient = int(getattr(density, "solves_per_gradient", 1))

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log-density, shape (n,), at x (n, ndim)."""
        u = self.warp.to_u(x)
        return np.asarray(self.density.log_prob(u) + self.warp.log_stretch(u))

    def log_prob_and_grad(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density (n,) at x (n, ndim) and its gradient (n, ndim) with respect to x."""
        u = self.warp.to_u(x)
        log_prob, gradient = self.density.log_prob_and_grad(u)
        return log_prob + self.warp.log_stretch(u), gradient * self.warp.stretch(u) + self.warp.bent
