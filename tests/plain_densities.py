"""Eleven log-densities that samplers should manage, each normalised on its box, with exact moments.

Skewed, correlated, bounded, kinked or of several modes; see `tests.densities` for those on which samplers fail.
The boxes cut off less than 5e-5 of the probability, which changes moments far less than draws show.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from tests.densities import Density, Gaussians, log_normal

EULER, GUMBEL_VARIANCE = 0.5772156649015329, np.pi**2 / 6


class Sheared(Density):
    """z = Ax of independent z_i with known densities; A is lower triangular with a unit diagonal.

    Subclasses give the logarithm of the density of z and its slope, and mean and variance of each z_i.
    """

    def __init__(self, A, of_z, lower, upper):
        self.A = np.asarray(A, dtype=float)
        super().__init__(len(self.A), lower=lower, upper=upper)
        mean, variance = of_z
        back = np.linalg.inv(self.A)
        self.mean = back @ mean
        self.sd = np.sqrt(back**2 @ variance)

    def value_and_slope(self, x):
        value, slope = self.of_z(x @ self.A.T)
        return value.sum(axis=1), slope @ self.A


class Gumbels(Sheared):
    """Skewed: Gumbel(0, 1), and another around 0.6 times it."""

    name = "gumbels"

    def __init__(self):
        moments = np.full(2, EULER), np.full(2, GUMBEL_VARIANCE)
        super().__init__([[1.0, 0.0], [-0.6, 1.0]], moments, [-4.0, -5.0], [22.0, 32.0])

    def of_z(self, z):
        return -z - np.exp(-z), np.exp(-z) - 1.0


class Gammas(Density):
    """Γ(3, 1), Γ(2, 1) and Γ(5, 1), bounded by zero."""

    name, shapes = "gammas", np.array([3.0, 2.0, 5.0])

    def __init__(self):
        super().__init__(3, lower=np.zeros(3), upper=np.full(3, 20.0))
        self.mean, self.sd = self.shapes, np.sqrt(self.shapes)

    def value_and_slope(self, x):
        with np.errstate(divide="ignore"):
            value = (self.shapes - 1) * np.log(x) - x - special.gammaln(self.shapes)
            return value.sum(axis=1), (self.shapes - 1) / x - 1.0


class Correlated(Gaussians):
    """A Gaussian in four coordinates, correlated by 0.9^|i−j|."""

    name, has_one_maximum = "correlated", True

    def __init__(self):
        i = np.arange(4)
        super().__init__([1.0], np.zeros((1, 4)), [0.9 ** np.abs(i[:, None] - i)], 6.0)


class AtWall(Density):
    """Exponential decay from the wall of a box in three coordinates: rates 1, 2 and 4."""

    name, rates = "at-wall", np.array([1.0, 2.0, 4.0])

    def __init__(self):
        super().__init__(3, lower=np.zeros(3), upper=12.0 / self.rates)
        self.mean = self.sd = 1.0 / self.rates

    def value_and_slope(self, x):
        return (np.log(self.rates) - self.rates * x).sum(axis=1), np.broadcast_to(-self.rates, x.shape).copy()


class Logistics(Sheared):
    """Two logistic coordinates, the second sheared by the first."""

    name = "logistics"

    def __init__(self):
        moments = np.zeros(2), np.full(2, np.pi**2 / 3)
        super().__init__([[1.0, 0.0], [0.7, 1.0]], moments, np.full(2, -36.0), np.full(2, 36.0))

    def of_z(self, z):
        return -np.abs(z) - 2 * np.log1p(np.exp(-np.abs(z))), -np.tanh(0.5 * z)


class Quartic(Density):
    """exp(−x⁴) in three coordinates: flat in the middle, steep outside."""

    name = "quartic"

    def __init__(self):
        super().__init__(3, lower=np.full(3, -4.0), upper=np.full(3, 4.0))
        self.constant = np.log(2 * special.gamma(1.25))
        self.mean = np.zeros(3)
        self.sd = np.full(3, np.sqrt(special.gamma(0.75) / special.gamma(0.25)))

    def value_and_slope(self, x):
        return (-(x**4) - self.constant).sum(axis=1), -4.0 * x**3


class Uniform(Density):
    """Flat in a box of four coordinates."""

    name = "uniform"

    def __init__(self):
        super().__init__(4, lower=np.zeros(4), upper=np.array([1.0, 2.0, 5.0, 0.1]))
        self.mean, self.sd = 0.5 * self.upper, self.upper / np.sqrt(12.0)

    def value_and_slope(self, x):
        return np.full(len(x), -np.log(self.upper).sum()), np.zeros_like(x)


class Laplaces(Sheared):
    """A kink at the top: two Laplace coordinates, the second sheared by the first."""

    name = "laplaces"

    def __init__(self):
        super().__init__(
            [[1.0, 0.0], [0.8, 1.0]], (np.zeros(2), np.full(2, 2.0)), np.full(2, -36.0), np.full(2, 36.0)
        )

    def of_z(self, z):
        return -np.abs(z) - np.log(2.0), -np.sign(z)


class Pair(Gaussians):
    """Two Gaussians in two coordinates at x0 = −2 and 2, of weights 0.7 and 0.3."""

    name = "pair"

    def __init__(self, sd=0.5):
        super().__init__([0.7, 0.3], [[-2.0, 0.0], [2.0, 0.0]], [sd**2 * np.eye(2)] * 2, 6.0)


class FourModes(Gaussians):
    """Four Gaussians in two coordinates, of weights 0.55, 0.25, 0.15 and 0.05 and unequal widths."""

    name = "four-modes"

    def __init__(self):
        covariances = [w**2 * np.array([[1.0, 0.5], [0.5, 1.0]]) for w in (0.5, 0.4, 0.3, 0.3)]
        super().__init__([0.55, 0.25, 0.15, 0.05], [[-2, -2], [2, 2], [-2, 2], [2, -2]], covariances, 6.0)


class BentLittle(Density):
    """x₁ ~ N(0, 1), x₂ ~ N(0.5 (x₁² − 1), 0.6²)."""

    name, bend, width = "bent-little", 0.5, 0.6

    def __init__(self):
        super().__init__(2, lower=[-6.5, -5.0], upper=[6.5, 25.0])
        self.mean, self.sd = np.zeros(2), np.array([1.0, np.sqrt(2 * self.bend**2 + self.width**2)])

    def value_and_slope(self, x):
        one, slope_1 = log_normal(x[:, 0], 0.0, 1.0)
        two, slope_2 = log_normal(x[:, 1], self.bend * (x[:, 0] ** 2 - 1.0), self.width)
        return one + two, np.stack([slope_1 - slope_2 * 2 * self.bend * x[:, 0], slope_2], axis=1)


ALL = (
    Gumbels, Gammas, Correlated, AtWall, Logistics, Quartic, Uniform, Laplaces, Pair, FourModes, BentLittle,
)  # fmt: skip
