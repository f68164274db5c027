"""Gaussian mixtures in curvilinear coordinates, for banana-shaped and ring-shaped densities."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln, logsumexp

from fmu.samplers.kernel import Tree
from fmu.samplers.mixture.bent import PENALTY, BentGaussians, fit_gaussians
from fmu.samplers.mixture.curve import Curve, fit_curve, thin_points
from fmu.samplers.mixture.warp import Warp
from fmu.types import FloatArray

_WIDE, _SAFE = 0.1, 0.05
"""Weight fractions of the wider copies, and of the t distribution."""
_WIDER, _DF = 1.5, 3.0
"""Width of the t distribution relative to the points, and its degrees of freedom."""
_MOST_POINTS = 6000
_NEGLIGIBLE = 1e-4
"""Weight of a point, relative to the mean weight, below which a fit ignores it."""


@dataclass(frozen=True, eq=False)
class CurvedMixture:
    """A normalised mixture: curved Gaussians, each with a wider copy, plus one t distribution that is not curved.

    The t distribution is defined on the curve's margins and is wider than the fitted points. It keeps an
    independence sampler's weights P/q bounded where a curved Gaussian extrapolates wrongly (Hesterberg 1995,
    Technometrics 37, 185-194). The mixture is not truncated at the bounds; draws outside them are rejected without
    an evaluation.

    Attributes
    ----------
    curve : Curve
    parts : BentGaussians
        The curved Gaussians, in the coordinates x of `curve`.
    mean : ndarray, shape (ndim,)
        Centre of the t distribution.
    factor : ndarray, shape (ndim, ndim)
        Cholesky factor of the t distribution's scale matrix.
    """

    curve: Curve
    parts: BentGaussians
    mean: FloatArray
    factor: FloatArray

    @property
    def weights(self) -> FloatArray:
        """Weights of the curved Gaussians, shape (k,)."""
        return self.parts.weights

    @property
    def gaussians(self) -> None:
        """Always None, because fits of ordinary Gaussians cannot refine this mixture."""

    @property
    def wide(self) -> float:
        """Fraction of each Gaussian's weight that its wider copy takes."""
        return _WIDE

    @property
    def _copies(self) -> tuple[FloatArray, FloatArray]:
        """Width factors of a Gaussian and its wider copy, and their weight fractions; both have shape (2,)."""
        return np.array([1.0, np.exp(0.5 * min(5.0 / len(self.mean), 2.5))]), np.array([1.0 - _WIDE, _WIDE])

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` independent draws, shape (n, ndim); some may lie outside the bounds."""
        wider, shares = self._copies
        part = rng.choice(len(self.weights), size=n, p=self.weights / self.weights.sum())
        z = rng.standard_normal((n, len(self.mean)))
        of_copy, is_safe = wider[(rng.random(n) >= shares[0]).astype(int)], rng.random(n) < _SAFE
        x = np.empty_like(z)
        for k in np.unique(part):
            x[part == k] = self.parts.to_x(of_copy[part == k, None] * z[part == k], int(k))
        u = self.curve.to_u(x)
        stretch = np.sqrt(_DF / rng.chisquare(_DF, n))[is_safe, None]
        u[is_safe] = self.curve.from_margins(self.mean + stretch * z[is_safe] @ self.factor.T)
        return u

    def log_density(self, u: FloatArray) -> FloatArray:
        """Return the normalised log-density, shape (n,), at points u (n, ndim) within the bounds."""
        if not len(u):
            return np.empty(0)
        wider, shares = self._copies
        x, log_slope = self.curve.to_x(u)
        each = self.parts.log_densities(x, wider) + np.log(shares)[:, None, None]
        y, of_margins = self.curve.margins(u)
        z = np.linalg.solve(self.factor, (y - self.mean).T)
        half = 0.5 * (_DF + len(z))
        constant = gammaln(half) - gammaln(0.5 * _DF) - 0.5 * len(z) * np.log(_DF * np.pi)
        constant -= np.sum(np.log(np.diag(self.factor)))
        safe = of_margins + constant - half * np.log1p(np.sum(z**2, axis=0) / _DF)
        bent = logsumexp(each, axis=(0, 1)) + log_slope
        return np.asarray(np.logaddexp(np.log1p(-_SAFE) + bent, np.log(_SAFE) + safe))

    def covariance_within(self, rng: np.random.Generator, n: int, warp: Warp | None = None) -> FloatArray:
        """Return the covariance of `n` draws that are clipped to the bounds, shape (ndim, ndim).

        It is the covariance of u or, if `warp` is given, of the coordinates of the warp.
        """
        u = np.clip(self.draw(rng, n), self.curve.lower, self.curve.upper)
        u = u if warp is None else warp.to_x(u)
        ndim = len(self.mean)
        return np.asarray(1e-12 * np.eye(ndim) + np.cov(u.T).reshape(ndim, ndim))

    def settings(self) -> Tree:
        """Return the `MixtureSampler` settings that specify this mixture, keyed by name."""
        return {"components": self}

    def arrays(self) -> dict[str, FloatArray]:
        """Return the arrays that define the mixture, keyed by name."""
        fields = {**vars(self.curve), **vars(self.parts), "mean": self.mean, "factor": self.factor}
        return {name: value.astype(float) for name, value in fields.items()}

    @classmethod
    def of_arrays(cls, arrays: Tree) -> CurvedMixture:
        """Restore a mixture from the result of `arrays`."""
        of_curve, of_parts = (
            {name: np.asarray(arrays[name]) for name in kind.__dataclass_fields__}
            for kind in (Curve, BentGaussians)
        )
        curve = Curve(**of_curve | {"order": of_curve["order"].astype(int)})
        return cls(curve, BentGaussians(**of_parts), np.asarray(arrays["mean"]), np.asarray(arrays["factor"]))


def fit_curved(u: FloatArray, weight: FloatArray, lower: FloatArray, upper: FloatArray) -> CurvedMixture:
    """Fit a `CurvedMixture` to points u (n, ndim) with weights (n,).

    Raise LinAlgError if there are too few points for a Gaussian, or the fit meets a singular matrix.
    """
    counts = weight > _NEGLIGIBLE * weight.mean()
    u, weight = thin_points(u[counts], weight[counts], _MOST_POINTS)
    curve = fit_curve(u, weight, lower, upper)
    parts, score = _fit_under(curve, u, weight)
    if curve.location.any():  # a sphere, for example, is fitted better by bent Gaussians alone
        straight = replace(curve, location=0.0 * curve.location, scale=0.0 * curve.scale)
        others, other_score = _fit_under(straight, u, weight)
        if other_score > score:
            curve, parts = straight, others
    y, _ = curve.margins(u)
    mean = weight @ y
    covariance = (weight * (y - mean).T) @ (y - mean)
    factor = _WIDER * np.linalg.cholesky(covariance + 1e-9 * np.diag(np.diag(covariance)))
    return CurvedMixture(curve, parts, mean, factor)


def _fit_under(curve: Curve, u: FloatArray, weight: FloatArray) -> tuple[BentGaussians, float]:
    """Fit curved Gaussians in the coordinates of `curve`; return them and their penalised mean log-likelihood."""
    x, log_slope = curve.to_x(u)
    parts, score = fit_gaussians(x, weight)
    n = np.count_nonzero(curve.location) + np.count_nonzero(curve.scale)
    return parts, score + float(weight @ log_slope - PENALTY * n * np.sum(weight**2))
