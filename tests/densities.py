"""Log-densities on which samplers fail, each normalised on its box, with exact moments and exact draws.

They are bent (`Banana`, `Helix`, `Funnel`), hollow (`Shell`), thin and apart (`Ridges`, `ThreeWidths`),
infinite at the walls (`Beta`) or heavy-tailed (`StudentT`, whose moments and evidence are those within its
box). The boxes of the others cut off less than 1e-8 of the probability.
"""

from __future__ import annotations

import numpy as np
from scipy import integrate, stats

from tests.samplers.targets import Target

LOG_2PI = np.log(2 * np.pi)


def log_normal(x, mean, sd):
    """Return log N(x; mean, sd²) and its derivative by x."""
    z = (x - mean) / sd
    return -0.5 * (z**2 + LOG_2PI) - np.log(sd), -z / sd


class Density(Target):
    """A normalised log-density on a box, with exact moments and draws.

    Attributes
    ----------
    name : str
    mean, sd : ndarray, shape (ndim,)
    log_evidence : float
        Logarithm of the integral over the box.
    has_one_maximum : bool
        Whether the points where the density is highest are connected, and it has no other maximum.
    has_light_tails : bool
        Whether it falls off at least as fast as an exponential along every ray, and is finite everywhere.
    """

    log_evidence = 0.0
    has_one_maximum = True
    has_light_tails = True
    sd: np.ndarray

    def draw(self, n, rng):
        """Return `n` exact, independent draws, shape (n, ndim)."""
        raise NotImplementedError


class Banana(Density):
    """x₁, x₃ ~ N(0, 1), x₂ ~ N(1.5 (x₁² − 1), 0.15²), x₄ ~ N(0.8 (x₃² − 1), 0.3²)."""

    name = "banana"
    bends, widths = np.array([1.5, 0.8]), np.array([0.15, 0.3])

    def __init__(self):
        super().__init__(4, lower=[-6.0, -4.0, -6.0, -4.0], upper=[6.0, 56.0, 6.0, 32.0])
        self.mean = np.zeros(4)
        self.sd = np.ones(4)
        self.sd[1::2] = np.sqrt(2 * self.bends**2 + self.widths**2)

    def value_and_slope(self, x):
        base, bent = x[:, ::2], x[:, 1::2]
        of_base, slope_base = log_normal(base, 0.0, 1.0)
        of_bent, slope_bent = log_normal(bent, self.bends * (base**2 - 1.0), self.widths)
        slope = np.empty_like(x)
        slope[:, ::2] = slope_base - slope_bent * self.bends * 2.0 * base
        slope[:, 1::2] = slope_bent
        return of_base.sum(axis=1) + of_bent.sum(axis=1), slope

    def draw(self, n, rng):
        x = rng.standard_normal((n, 4))
        x[:, 1::2] = self.bends * (x[:, ::2] ** 2 - 1.0) + self.widths * x[:, 1::2]
        return x


class Helix(Density):
    """A thin curved ridge: t ~ N(0, 1), x ~ N(sin 1.5 t, 0.05²), y ~ N(cos 1.5 t, 0.05²)."""

    name = "helix"
    pace, width = 1.5, 0.05

    def __init__(self):
        super().__init__(3, lower=[-6.0, -1.5, -1.5], upper=[6.0, 1.5, 1.5])
        c = np.exp(-0.5 * self.pace**2)  # E cos(a t) = exp(−a²/2)
        self.mean = np.array([0.0, 0.0, c])
        self.sd = np.sqrt([1.0, 0.5 * (1 - c**4) + self.width**2, 0.5 * (1 + c**4) - c**2 + self.width**2])

    def value_and_slope(self, x):
        t = x[:, 0]
        sin, cos = np.sin(self.pace * t), np.cos(self.pace * t)
        parts = [
            log_normal(t, 0.0, 1.0),
            log_normal(x[:, 1], sin, self.width),
            log_normal(x[:, 2], cos, self.width),
        ]
        value, (slope_t, slope_x, slope_y) = sum(part[0] for part in parts), (part[1] for part in parts)
        slope_t = slope_t - slope_x * self.pace * cos + slope_y * self.pace * sin
        return value, np.stack([slope_t, slope_x, slope_y], axis=1)

    def draw(self, n, rng):
        x = rng.standard_normal((n, 3))
        curve = np.stack([np.sin(self.pace * x[:, 0]), np.cos(self.pace * x[:, 0])], axis=1)
        x[:, 1:] = curve + self.width * x[:, 1:]
        return x


class Gaussians(Density):
    """A mixture of Gaussians: weights (k,), centres (k, ndim), covariances (k, ndim, ndim)."""

    has_one_maximum = False

    def __init__(self, weights, centres, covariances, half_width):
        weights, centres, covariances = (np.asarray(a, dtype=float) for a in (weights, centres, covariances))
        super().__init__(len(centres[0]), *(s * np.full(len(centres[0]), half_width) for s in (-1.0, 1.0)))
        self.weights, self.centres, self.covariances = weights, centres, covariances
        self.precisions = np.linalg.inv(covariances)
        self.log_scale = np.log(weights) - 0.5 * (np.linalg.slogdet(covariances)[1] + self.ndim * LOG_2PI)
        self.mean = weights @ centres
        variances = np.diagonal(covariances, axis1=1, axis2=2)
        self.sd = np.sqrt(weights @ (variances + (centres - self.mean) ** 2))

    def value_and_slope(self, x):
        away = self.centres - x[:, None]
        pull = np.einsum("nki,kij->nkj", away, self.precisions)
        parts = self.log_scale - 0.5 * np.sum(away * pull, axis=2)
        value = np.logaddexp.reduce(parts, axis=1)
        return value, np.sum(np.exp(parts - value[:, None])[:, :, None] * pull, axis=1)

    def draw(self, n, rng):
        k = rng.choice(len(self.weights), size=n, p=self.weights)
        factors = np.linalg.cholesky(self.covariances)
        return self.centres[k] + np.einsum("nij,nj->ni", factors[k], rng.standard_normal((n, self.ndim)))


class Ridges(Gaussians):
    """Two thin straight ridges in three dimensions, across each other and apart: sd 0.5 along, 0.02 across."""

    name = "ridges"
    along, across = 0.5, 0.02

    def __init__(self):
        directions = np.array([[1.0, 1.0, 0.3], [1.0, -1.0, 0.0]])
        directions /= np.linalg.norm(directions, axis=1)[:, None]
        covariances = [
            self.across**2 * np.eye(3) + (self.along**2 - self.across**2) * np.outer(d, d) for d in directions
        ]
        super().__init__([0.6, 0.4], [[0.0, 0.0, 0.6], [0.0, 0.0, -0.6]], covariances, 4.0)


class ThreeWidths(Gaussians):
    """Three modes in five dimensions, of widths 0.02, 0.1 and 0.6: a search easily sees only one of them."""

    name = "three-widths"

    def __init__(self):
        centres = np.array([[2.0, 2.0, 2.0, 2.0, 2.0], [-2.0, 1.0, -1.0, 2.0, 0.0], [0.0, -2.0, 1.0, -1.0, -1.0]])
        covariances = [width**2 * np.eye(5) for width in (0.02, 0.1, 0.6)]
        super().__init__([0.3, 0.2, 0.5], centres, covariances, 6.0)


class Shell(Density):
    """A hollow sphere in three dimensions: log p = −(r − 1)²/(2 · 0.02²) + constant."""

    name = "shell"
    width = 0.02

    def __init__(self):
        super().__init__(3, lower=np.full(3, -1.5), upper=np.full(3, 1.5))
        s = self.width
        # ∫ r² e^{−(r−1)²/2s²} dr = √2π s (1 + s²), and with r⁴: √2π s (1 + 6 s² + 3 s⁴); the rest is e^{−1250}
        self.log_mass = np.log(4 * np.pi * np.sqrt(2 * np.pi) * s * (1 + s**2))
        self.mean = np.zeros(3)
        self.sd = np.full(3, np.sqrt((1 + 6 * s**2 + 3 * s**4) / (1 + s**2) / 3))

    def value_and_slope(self, x):
        r = np.maximum(np.linalg.norm(x, axis=1), 1e-300)
        z = (r - 1.0) / self.width
        return -0.5 * z**2 - self.log_mass, -(z / self.width / r)[:, None] * x

    def draw(self, n, rng):
        away = rng.standard_normal((n, 3))
        away /= np.linalg.norm(away, axis=1)[:, None]
        r = 1.0 + self.width * rng.standard_normal(2 * n + 100)
        r = r[1.5 * rng.random(len(r)) < r**2][:n]  # the area of a sphere grows as r²
        return r[:, None] * away


class Beta(Density):
    """Beta(½, ½) in three independent coordinates on [0, 1]: infinite at every wall."""

    name = "beta-half"
    has_one_maximum = False
    has_light_tails = False

    def __init__(self):
        super().__init__(3, lower=np.zeros(3), upper=np.ones(3))
        self.mean, self.sd = np.full(3, 0.5), np.full(3, np.sqrt(0.125))

    def value_and_slope(self, x):
        x = np.clip(x, 0.0, 1.0)
        with np.errstate(divide="ignore"):  # on a wall the density is infinite
            value = -0.5 * np.sum(np.log(x) + np.log1p(-x), axis=1) - 3 * np.log(np.pi)
            return value, -0.5 / x + 0.5 / (1.0 - x)

    def draw(self, n, rng):
        return np.sin(0.5 * np.pi * rng.random((n, 3))) ** 2


class Funnel(Density):
    """Neal's funnel (2003, section 8): v ~ N(0, 3²), and seven x ~ N(0, e^v); within |v| < 18 and |x| < 5e4."""

    name = "neal-funnel"
    has_light_tails = False
    s = 3.0

    def __init__(self):
        super().__init__(8, lower=np.array([-18.0, *7 * [-5e4]]), upper=np.array([18.0, *7 * [5e4]]))
        self.mean = np.zeros(8)
        self.sd = np.array([self.s, *7 * [np.exp(self.s**2 / 4)]])  # E x² = E e^v = exp(s²/2)

    def value_and_slope(self, x):
        v, rest = x[:, 0], x[:, 1:]
        precision = np.exp(-v)
        square = np.sum(rest**2, axis=1) * precision
        value = log_normal(v, 0.0, self.s)[0] - 0.5 * (square + 7 * v + 7 * LOG_2PI)
        slope_v = -v / self.s**2 + 0.5 * square - 3.5
        return value, np.column_stack([slope_v, -rest * precision[:, None]])

    def draw(self, n, rng):
        v = self.s * rng.standard_normal((n, 1))
        return np.concatenate([v, np.exp(0.5 * v) * rng.standard_normal((n, 7))], axis=1)


class StudentT(Density):
    """Independent t distributions of three degrees of freedom in four coordinates, cut off at ±100."""

    name = "student-t"
    has_light_tails = False
    df, bound = 3.0, 100.0

    def __init__(self):
        super().__init__(4, lower=np.full(4, -self.bound), upper=np.full(4, self.bound))
        self.inside = stats.t.cdf(self.bound, self.df) - stats.t.cdf(-self.bound, self.df)
        square, _ = integrate.quad(lambda x: x**2 * stats.t.pdf(x, self.df), -self.bound, self.bound, limit=500)
        self.mean, self.sd = np.zeros(4), np.full(4, np.sqrt(square / self.inside))
        self.constant = 4 * (stats.t.logpdf(0.0, self.df) - np.log(self.inside))

    def value_and_slope(self, x):
        half = 0.5 * (self.df + 1.0)
        value = self.constant - half * np.sum(np.log1p(x**2 / self.df), axis=1)
        return value, -2.0 * half * x / (self.df + x**2)

    def draw(self, n, rng):
        low = stats.t.cdf(-self.bound, self.df)
        return stats.t.ppf(low + self.inside * rng.random((n, 4)), self.df)


ALL = (Banana, Helix, Ridges, ThreeWidths, Shell, Beta, Funnel, StudentT)
