"""A parameter of the structure that depends on covariates of the tests, however it varies otherwise."""

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
    """A parameter of the structure that depends on covariates too: θ = θ₀ Π (1 + b (x − x₀)).

    Attributes
    ----------
    of : InTests
        θ₀, the value where every covariate is at its mean over the tests.
    columns : tuple of int
        Number in theta of the relative slope b of each covariate.
    covariates : ndarray, shape (n_covariates, n_tests)
        x − x₀.
    names : tuple of str
    means : tuple of float
        x₀ of each.
    """

    of: InTests
    columns: tuple[int, ...]
    covariates: FloatArray
    names: tuple[str, ...]
    means: tuple[float, ...]

    @classmethod
    def of_covariates(cls, of: InTests, p: Parameter, number: int, theta: Theta, by: Mapping[str, Prior]) -> Trend:
        """Add the slope of a parameter of the structure by each covariate; return its values with them.

        Parameters
        ----------
        of : InTests
        p : Parameter
        number : int
            Its number in the structure.
        theta : Theta
        by : mapping of str to Prior
            The prior of the slope by each covariate.
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
        """The parameter where every covariate is at its mean over the tests."""
        return self.of

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
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
        """Return an object that is equal in two tests if the value always is."""
        return self.of.identity(test), *self.covariates[:, test].tolist()

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        low, high = self.of.box(lower, upper)
        for k, x in zip(self.columns, self.covariates, strict=True):
            factors = 1.0 + np.stack([lower[k] * x, upper[k] * x])
            corners = np.stack([end * factor for end in (low, high) for factor in factors])
            low, high = corners.min(axis=0), corners.max(axis=0)
        return low, high

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the values (n,) in one more test."""
        value = self.of.next_test(theta, like, future)
        for name, mean, column in zip(self.names, self.means, self.columns, strict=True):
            value = value * (1.0 + theta[:, column] * (future.covariates.get(name, mean) - mean))
        return value

    def after(self, n: int) -> Self:
        """Return the parameter with its scores behind `n` parameters of theta."""
        return replace(self, of=self.of.after(n))

    def refer_to(self, references: Mapping[int, tuple[FloatArray, tuple[float, float]]]) -> Self:
        """Return the parameter with scores that refer to others."""
        return replace(self, of=self.of.refer_to(references))
