"""Densities made of a likelihood and a proper prior, with exact moments and evidence."""

from __future__ import annotations

import numpy as np


class Tempered:
    """A likelihood and a prior in a box; subclasses give `prior` and `likelihood`, values and gradients."""

    def __init__(self, lower, upper):
        self.lower, self.upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        self.ndim = len(self.lower)
        self.n_solves = self.n_gradients = 0

    def _counted(self, theta):
        if not np.all((theta >= self.lower) & (theta <= self.upper)):
            raise RuntimeError(f"asked outside the box: {theta}")
        self.n_solves += len(theta)
        return self.likelihood(theta)

    def log_prior(self, theta):
        return self.prior(theta)[0]

    def log_prior_and_grad(self, theta):
        return self.prior(theta)

    def log_likelihood(self, theta):
        return self._counted(theta)[0]

    def log_prob(self, theta):
        return self.log_prior(theta) + self.log_likelihood(theta)

    def log_prob_and_grad(self, theta):
        self.n_gradients += len(theta)
        (prior, prior_slope), (likelihood, slope) = self.prior(theta), self._counted(theta)
        return prior + likelihood, prior_slope + slope


class LinearGaussian(Tempered):
    """Data y = A θ + noise with a Gaussian prior: posterior and evidence in closed form."""

    sd, noise = 2.0, 0.1
    matrix = np.array([[1.0, 0.4, 0.0], [0.2, 1.0, 0.5], [0.3, 0.0, 1.0]])
    data = np.array([1.0, -0.5, 2.0])
    offset, scale = np.array([1.0, 0.0, -1.0]), np.array([2.0, 0.5, 3.0])

    def __init__(self):
        super().__init__(np.full(3, -np.inf), np.full(3, np.inf))
        precision = np.eye(3) / self.sd**2 + self.matrix.T @ self.matrix / self.noise**2
        self.covariance = np.linalg.inv(precision)
        self.mean = self.covariance @ self.matrix.T @ self.data / self.noise**2
        spread = self.noise**2 * np.eye(3) + self.sd**2 * self.matrix @ self.matrix.T
        self.log_evidence = -0.5 * (
            self.data @ np.linalg.solve(spread, self.data) + np.linalg.slogdet(2 * np.pi * spread)[1]
        )

    def prior(self, theta):
        value = -0.5 * np.sum(theta**2, axis=1) / self.sd**2 - 1.5 * np.log(2 * np.pi * self.sd**2)
        return value, -theta / self.sd**2

    def likelihood(self, theta):
        away = self.data - theta @ self.matrix.T
        value = -0.5 * np.sum(away**2, axis=1) / self.noise**2 - 1.5 * np.log(2 * np.pi * self.noise**2)
        return value, away @ self.matrix / self.noise**2

    def sample_prior(self, rng, n):
        return self.sd * rng.standard_normal((n, 3))


class InBox(Tempered):
    """Any log-density of a box as the likelihood under a uniform prior."""

    def __init__(self, target):
        super().__init__(target.lower, target.upper)
        self.target, self.mean, self.covariance = target, target.mean, target.covariance
        node, weight = np.polynomial.legendre.leggauss(200)
        x = np.stack([g.ravel() for g in np.meshgrid(node, node)], axis=1)
        points = (self.upper + self.lower) / 2 + (self.upper - self.lower) / 2 * x
        likelihood = np.exp(target.value_and_slope(points)[0])
        self.log_evidence = np.log(np.outer(weight, weight).ravel() @ likelihood / 4)

    def prior(self, theta):
        return np.full(len(theta), -np.sum(np.log(self.upper - self.lower))), np.zeros(theta.shape)

    def likelihood(self, theta):
        return self.target.value_and_slope(theta)

    def sample_prior(self, rng, n):
        return self.lower + (self.upper - self.lower) * rng.random((n, self.ndim))


class FarModes(Tempered):
    """Two narrow Gaussians far apart in a box with a uniform prior; the likelihood integrates to one."""

    weights, sd = np.array([0.7, 0.3]), np.array([0.1, 0.2])
    centres = np.array([[-6.0, 5.0], [6.0, -3.0]])

    def __init__(self):
        super().__init__([-10.0, -10.0], [10.0, 10.0])
        self.log_evidence = -np.log(400.0)

    def prior(self, theta):
        return np.full(len(theta), -np.log(400.0)), np.zeros(theta.shape)

    def likelihood(self, theta):
        away = self.centres - theta[:, None]
        parts = np.log(self.weights / (2 * np.pi * self.sd**2)) - 0.5 * np.sum(away**2, axis=2) / self.sd**2
        value = np.logaddexp(*parts.T)
        return value, np.sum(np.exp(parts - value[:, None])[..., None] * away / self.sd[:, None] ** 2, axis=1)

    def sample_prior(self, rng, n):
        return rng.uniform(-10.0, 10.0, (n, 2))


class Failing(LinearGaussian):
    """A model that fails in part of the prior, far from the posterior."""

    def likelihood(self, theta):
        value, slope = super().likelihood(theta)
        failed = theta[:, 0] > 4.0
        return np.where(failed, np.nan, value), np.where(failed[:, None], np.nan, slope)
