"""Compare the exact gradient of a log-probability with finite differences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.differences import both_sides
from fmu.numbers import significant
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.problem import UpdatingProblem


AGREE = 1e-4
"""Largest relative difference up to which the gradient counts as correct."""
_STEPS = (1e-3, 1e-4, 1e-5)
_RANDOM = 2
_SMALL = 1e-3


@dataclass(frozen=True, eq=False)
class GradientCheck:
    """A gradient compared with central differences, in scaled coordinates of order one.

    Attributes
    ----------
    names : tuple of str
        Parameter names.
    points : tuple of str
        Descriptions of the points.
    theta : ndarray, shape (n, ndim), SI units
        The points.
    exact, difference : ndarray, shape (n, ndim)
        ∂log P/∂u with u = (θ − offset)/scale. Of several step lengths, the differences use the one that agrees
        best.
    """

    names: tuple[str, ...]
    points: tuple[str, ...]
    theta: FloatArray
    exact: FloatArray
    difference: FloatArray

    @property
    def relative_error(self) -> FloatArray:
        """Error of each gradient component, divided by the gradient's size at the point, shape (n, ndim).

        The size is the largest absolute component at the point. It is at least a thousandth of the largest at any
        point, because the gradient vanishes near a maximum, and at least 1.
        """
        largest = np.max(np.abs(self.exact), axis=1, initial=0.0, where=np.isfinite(self.exact))
        size = np.maximum(np.maximum(largest, _SMALL * np.max(largest)), 1.0)
        return np.abs(self.exact - self.difference) / size[:, None]

    @property
    def largest(self) -> float:
        """Largest relative error; NaN or infinite if a component could not be computed."""
        return float(np.max(self.relative_error))

    @property
    def agrees(self) -> bool:
        """Whether the largest relative error is at most `AGREE`."""
        return self.largest <= AGREE

    def sentence(self) -> str:
        """Return a sentence on how well gradient and differences agree, and where they differ most.

        If an error is not finite, the sentence says where.
        """
        errors = self.relative_error
        if not np.all(np.isfinite(errors)):
            i, j = np.argwhere(~np.isfinite(errors))[0]
            what = "central difference" if np.isfinite(self.exact[i, j]) else "gradient"
            return f"The {what} is not finite for {self.names[j]} at {self.points[i]}."
        i, j = np.unravel_index(np.argmax(errors), errors.shape)
        where = f"for {self.names[j]} at {self.points[i]}"
        if self.agrees:
            size = significant(self.largest, 2)
            return (
                f"The gradient agrees with central differences: the largest relative difference is {size}, "
                f"{where}."
            )
        return (
            f"The gradient disagrees with central differences: the relative difference is "
            f"{significant(self.largest, 2)} {where}. Either it is wrong, or the model is not smooth there."
        )

    def table(self) -> pd.DataFrame:
        """Return a table with one row per point and parameter: ``exact``, ``difference``, ``relative_error``."""
        import pandas as pd

        index = pd.MultiIndex.from_product([self.points, self.names], names=["point", "parameter"])
        columns = {"exact": self.exact, "difference": self.difference, "relative_error": self.relative_error}
        return pd.DataFrame({name: values.ravel() for name, values in columns.items()}, index=index)


def check_gradient(problem: UpdatingProblem, seed: int = 1) -> GradientCheck:
    """Compare the gradient with central differences at the starting point and at two random prior draws.

    Points nearer to a bound than the longest step are moved away from it.

    Parameters
    ----------
    problem : UpdatingProblem
    seed : int
        Seed of the random points.

    Returns
    -------
    GradientCheck
        At each point, the best of three step lengths is used: long steps suffer from truncation, short ones from
        rounding.
    """
    density = ScaledDensity(problem)
    theta = np.vstack([problem.start, problem.sample_prior(np.random.default_rng(seed), _RANDOM)])
    # far enough from the bounds for a step to either side
    u = np.clip(density.to_scaled(theta), density.lower + max(_STEPS), density.upper - max(_STEPS))
    exact = np.asarray(density.log_prob_and_grad(u)[1])
    n, ndim = u.shape
    tried = []
    for h in _STEPS:
        ends, distance = both_sides(u, np.full(ndim, h), density.lower, density.upper)
        above, below = np.asarray(density.log_prob(ends.reshape(-1, ndim))).reshape(2, n, ndim)
        with np.errstate(invalid="ignore"):  # −inf on both sides where the model fails
            tried.append((above - below) / distance)
    error = np.max(np.abs(np.array(tried) - exact), axis=2)
    nearest = np.argmin(np.where(np.isfinite(error), error, np.inf), axis=0)
    difference = np.array(tried)[nearest, np.arange(n)]
    points = ("the start", *(f"random point {i + 1}" for i in range(_RANDOM)))
    return GradientCheck(problem.names, points, density.to_theta(u), exact, difference)
