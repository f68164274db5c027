"""Trends of a structural parameter with covariates of the tests, in addition to any other variation."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from fmu.posterior.joint.varies.base import Future, InTests, Slope, Theta
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior
from fmu.types import FloatArray


@dataclass(frozen=True)
class Trend(InTests):
    """A structural parameter that also depends on covariates x: θ = θ₀ Π (1 + b (x − x₀)).

    Attributes
    ----------
    of : InTests
        θ₀, the value if every covariate has its mean over the tests.
    columns : tuple of int
        For each covariate, the index in theta of the relative slope b.
    covariates : ndarray, shape (n_covariates, n_tests)
        The differences x − x₀.
    names : tuple of str
        Names of the covariates.
    means : tuple of float
        For each covariate, the mean x₀ over the tests.
    """

    of: InTests
    columns: tuple[int, ...]
    covariates: FloatArray
    names: tuple[str, ...]
    means: tuple[float, ...]

    @classmethod
    def of_covariates(cls, of: InTests, p: Parameter, number: int, theta: Theta, by: Mapping[str, Prior]) -> Trend:
        """Add one slope per covariate to theta; return the structural parameter with these trends.

        Parameters
        ----------
        of : InTests
            The structural parameter without trends.
        p : Parameter
            The same parameter as for a single test.
        number : int
            Index of `p` among the parameters of the structure.
        theta : Theta
            The slopes are added to it.
        by : mapping of str to Prior
            The prior of the slope, by the name of the covariate.
        """
        columns, away, means = [], [], []
        for covariate, prior in by.items():
            x = np.array([test.covariates[covariate] for test in theta.tests])
            away.append(x - x.mean())
            means.append(float(x.mean()))
            at = float(np.clip(0.0, *prior.support))
            slope = Parameter(f"{p.name} per {covariate}", at, prior=prior)
            columns.append(theta.add(slope, "slope", number, covariate))
        return cls(of, tuple(columns), np.array(away), tuple(by), tuple(means))

    @property
    def base(self) -> InTests:
        """The parameter without trends: its value if every covariate has its mean over the tests."""
        return self.of

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values (n, n_tests) in all tests at theta (n, n_parameters), and their derivatives."""
        value, slopes = self.of(theta)
        factors = 1.0 + theta[:, self.columns, None] * self.covariates
        product = np.prod(factors, axis=1)
        found = [Slope(slope.columns, slope.values * product) for slope in slopes]
        for k, column in enumerate(self.columns):
            others = np.prod(np.delete(factors, k, axis=1), axis=1)
            columns = np.full(self.covariates.shape[1], column)
            found.append(Slope(columns, value * self.covariates[k] * others))
        return value * product, found

    def identity(self, test: int) -> Hashable:
        """Return a key that is equal for two tests if the value in them is equal at every theta."""
        return self.of.identity(test), *self.covariates[:, test].tolist()

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper limits of the values, (n_tests,) each, for limits of theta (n_parameters,)."""
        low, high = self.of.box(lower, upper)
        for k, x in zip(self.columns, self.covariates, strict=True):
            factors = 1.0 + np.stack([lower[k] * x, upper[k] * x])
            corners = np.stack([end * factor for end in (low, high) for factor in factors])
            low, high = corners.min(axis=0), corners.max(axis=0)
        return low, high

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the values (n,) in a further test, with its covariates."""
        value = self.of.next_test(theta, like, future)
        for name, mean, column in zip(self.names, self.means, self.columns, strict=True):
            value = value * (1.0 + theta[:, column] * (future.covariates.get(name, mean) - mean))
        return value

    def after(self, n: int) -> Self:
        """Return the parameter with the indices of its scores increased by `n`."""
        return replace(self, of=self.of.after(n))

    def refer_to(self, references: Mapping[int, tuple[FloatArray, tuple[float, float]]]) -> Self:
        """Return the parameter with another centring and reference of its scores."""
        return replace(self, of=self.of.refer_to(references))
