"""Log-densities whose moments are known exactly, each with at least two coordinates."""

from __future__ import annotations

import numpy as np

EULER = 0.5772156649015329


class Target:
    """A log-density with its exact mean and covariance, and a place to start from.

    `width` is its typical standard deviation in the samplers' scaled units: 1 where `scale` says so, less in a
    unit box.
    """

    name: str
    width = 1.0
    mean: np.ndarray
    covariance: np.ndarray
    start: np.ndarray

    def __init__(self, ndim, lower=None, upper=None):
        self.ndim = ndim
        self.lower = np.full(ndim, -np.inf) if lower is None else np.asarray(lower, dtype=float)
        self.upper = np.full(ndim, np.inf) if upper is None else np.asarray(upper, dtype=float)

    def value_and_slope(self, x):
        raise NotImplementedError

    def log_prob(self, theta):
        theta = np.asarray(theta, dtype=float)
        x = np.atleast_2d(theta)
        inside = np.all((x >= self.lower) & (x <= self.upper), axis=1)
        value = np.where(inside, self.value_and_slope(x)[0], -np.inf)
        return value if theta.ndim == 2 else float(value[0])

    def log_prob_and_grad(self, theta):
        theta = np.asarray(theta, dtype=float)
        value, slope = self.value_and_slope(np.atleast_2d(theta))
        return (value, slope) if theta.ndim == 2 else (float(value[0]), slope[0])

    def unbounded_view(self):
        """Scale by the standard deviation; a box is scaled to the unit box instead, from its bounds."""
        self.offset, self.scale = self.mean + 1.0, np.sqrt(np.diag(self.covariance))
        self.start = self.mean + 0.3 * self.scale

    def sample_prior(self, rng, n):
        """Points scattered around the mean, or uniform in the box."""
        if np.isfinite([self.lower, self.upper]).all():
            return self.lower + (self.upper - self.lower) * rng.random((n, self.ndim))
        x = self.mean + 0.5 * np.sqrt(np.diag(self.covariance)) * rng.standard_normal((n, self.ndim))
        return self.lower + np.abs(x - self.lower) if np.isfinite(self.lower).all() else x


class CorrelatedGaussian(Target):
    """Five coordinates of unlike scale, correlated by 0.7^|i−j|."""

    name = "gaussian"

    def __init__(self):
        super().__init__(5)
        sd = np.array([0.5, 1.0, 0.8, 1.5, 0.6])
        i = np.arange(5)
        self.mean = np.array([1.0, -2.0, 0.5, 3.0, 0.0])
        self.covariance = np.outer(sd, sd) * 0.7 ** np.abs(i[:, None] - i)
        self.precision = np.linalg.inv(self.covariance)
        self.unbounded_view()

    def value_and_slope(self, x):
        pull = (self.mean - x) @ self.precision
        return -0.5 * np.sum((self.mean - x) * pull, axis=1), pull


class Quadrature(Target):
    """Moments by Gauss-Legendre quadrature on a box of two coordinates."""

    nodes = 200
    width = 0.2

    def set_moments(self):
        node, weight = np.polynomial.legendre.leggauss(self.nodes)
        half, middle = (self.upper - self.lower) / 2, (self.upper + self.lower) / 2
        x = np.stack(
            [g.ravel() for g in np.meshgrid(*(m + h * node for m, h in zip(middle, half, strict=True)))], 1
        )
        w = np.outer(weight, weight).ravel() * np.exp(self.value_and_slope(x)[0])
        w /= w.sum()
        self.mean = w @ x
        self.covariance = (w[:, None] * (x - self.mean)).T @ (x - self.mean)
        self.start = self.mean


class TruncatedGaussian(Quadrature):
    """A correlated Gaussian whose centre lies outside the box: half its boundary carries mass."""

    name = "truncated"

    def __init__(self):
        super().__init__(2, lower=[-1.0, 0.0], upper=[1.0, 5.0])
        self.centre = np.array([0.7, -0.5])
        self.precision = np.linalg.inv(np.array([[0.6, 0.72], [0.72, 1.5]]))
        self.set_moments()

    def value_and_slope(self, x):
        pull = (self.centre - x) @ self.precision
        return -0.5 * np.sum((self.centre - x) * pull, axis=1), pull


class BoundedBeta(Quadrature):
    """Beta(2, 4) times Beta(1, 3), coupled by 1 + c (2x − 1)(2y − 1), on a box away from the origin.

    The density is a polynomial, so the quadrature is exact; it is largest at the wall y = lower and skewed.
    """

    name = "beta"
    coupling = 0.9

    def __init__(self):
        super().__init__(2, lower=[10.0, -3.0], upper=[12.0, -2.5])
        self.set_moments()

    def value_and_slope(self, x):
        width = self.upper - self.lower
        u, v = ((x - self.lower) / width).T
        c = self.coupling
        tie = 1 + c * (2 * u - 1) * (2 * v - 1)
        with np.errstate(divide="ignore"):
            value = np.log(u) + 3 * np.log1p(-u) + 2 * np.log1p(-v) + np.log(tie)
            slope_u = 1 / u - 3 / (1 - u) + 2 * c * (2 * v - 1) / tie
            slope_v = -2 / (1 - v) + 2 * c * (2 * u - 1) / tie
        return value, np.stack([slope_u, slope_v], axis=1) / width


class SkewedGumbel(Target):
    """x = A z of three independent standard Gumbel variables: skewed and correlated."""

    name = "gumbel"

    def __init__(self):
        super().__init__(3)
        self.mixing = np.array([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [-0.5, 0.4, 0.7]])
        self.unmixing = np.linalg.inv(self.mixing)
        self.mean = self.mixing @ np.full(3, EULER)
        self.covariance = self.mixing @ self.mixing.T * np.pi**2 / 6
        self.unbounded_view()

    def value_and_slope(self, x):
        z = x @ self.unmixing.T
        tail = np.exp(-z)
        return -np.sum(z + tail, axis=1), (tail - 1) @ self.unmixing


class Banana(Target):
    """y ~ N(b (x² − a²), 1) over x ~ N(0, a²): uncorrelated and yet dependent."""

    name = "banana"
    a, b = 1.0, 0.5

    def __init__(self):
        super().__init__(2)
        self.mean = np.zeros(2)
        self.covariance = np.diag([self.a**2, 1 + 2 * self.b**2 * self.a**4])
        self.unbounded_view()

    def value_and_slope(self, x):
        r = x[:, 1] - self.b * (x[:, 0] ** 2 - self.a**2)
        value = -0.5 * (x[:, 0] / self.a) ** 2 - 0.5 * r**2
        return value, np.stack([-x[:, 0] / self.a**2 + 2 * self.b * r * x[:, 0], -r], axis=1)


class TwoModes(Target):
    """Two correlated Gaussians of unequal weight, near enough to be crossed: a saddle lies between them."""

    name = "two-modes"

    def __init__(self):
        super().__init__(2)
        self.weights = np.array([0.7, 0.3])
        self.centres = np.array([[-1.0, 0.0], [1.2, 1.5]])
        self.covariances = np.array([[[0.5, 0.2], [0.2, 0.4]], [[0.3, -0.15], [-0.15, 0.6]]])
        self.precisions = np.linalg.inv(self.covariances)
        self.mean = self.weights @ self.centres
        away = self.centres - self.mean
        self.covariance = np.einsum("k,kij->ij", self.weights, self.covariances) + away.T * self.weights @ away
        self.unbounded_view()

    def value_and_slope(self, x):
        pull = np.einsum("nki,kij->nkj", self.centres - x[:, None], self.precisions)
        parts = np.log(self.weights) - 0.5 * np.log(np.linalg.det(self.covariances))
        parts = parts - 0.5 * np.sum((self.centres - x[:, None]) * pull, axis=2)
        value = np.logaddexp(*parts.T)
        return value, np.sum(np.exp(parts - value[:, None])[:, :, None] * pull, axis=1)


class Funnel(Target):
    """v ~ N(0, s²) over the logarithm of the variance of the others, x ~ N(0, e^v) (Neal 2003, section 8).

    E[x²] = exp(s²/2). The funnel is a mild one: with s = 0.7 instead of Neal's 3 no sampler misses its neck, and
    the eighth moment, on which the error of an estimated MCSE of x² hangs, is small enough to trust it.
    """

    name = "funnel"
    s = 0.7

    def __init__(self, ndim=3):
        super().__init__(ndim)
        self.mean = np.zeros(ndim)
        self.covariance = np.diag([self.s**2, *(ndim - 1) * [np.exp(self.s**2 / 2)]])
        self.log_mass = 0.5 * ndim * np.log(2 * np.pi) + np.log(self.s)
        self.unbounded_view()

    def value_and_slope(self, x):
        v, rest = x[:, 0], x[:, 1:]
        with np.errstate(over="ignore", invalid="ignore"):  # far out in a neck that is never accepted
            precision = np.exp(-v)
            square = np.sum(rest**2, axis=1) * precision
            half = 0.5 * (self.ndim - 1)
            value = -0.5 * (v / self.s) ** 2 - 0.5 * square - half * v
            slope_v = -v / self.s**2 + 0.5 * square - half
            return value, np.column_stack([slope_v, -rest * precision[:, None]])


class Counting:
    """A density that counts what it is asked for, and refuses to be asked outside its box."""

    def __init__(self, target):
        self.target = target
        self.n_solves = 0
        self.n_gradients = 0

    def __getattr__(self, name):
        return getattr(self.target, name)

    def _count(self, theta):
        theta = np.asarray(theta)
        if not np.all((theta >= self.target.lower) & (theta <= self.target.upper)):
            raise RuntimeError(f"asked outside the box: {theta}")
        return len(theta)

    def log_prob(self, theta):
        self.n_solves += self._count(theta)
        return self.target.log_prob(theta)

    def log_prob_and_grad(self, theta):
        n = self._count(theta)
        self.n_solves += n
        self.n_gradients += n
        return self.target.log_prob_and_grad(theta)


ALL = (CorrelatedGaussian, TruncatedGaussian, BoundedBeta, SkewedGumbel, Banana, TwoModes, Funnel)
