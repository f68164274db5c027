"""Covariates of the tests, such as temperature: known, known with an error, or missing in some tests."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from fmu.posterior.data.estimated_sd import gaussian_sd
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Prior, prior_in
from fmu.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Covariate:
    """A quantity x that may change the structure from test to test.

    If x is missing or known only with an error, its true value is a parameter of theta.

    Attributes
    ----------
    name : str
    values : ndarray, shape (n_tests,)
        The known value in each test, or the median of its prior if the value is a parameter of theta.
    columns : ndarray of int, shape (n_tests,)
        For each test, the index of the value in theta. For a test with a known value the index is arbitrary but
        valid.
    is_inferred : ndarray of bool, shape (n_tests,)
        Whether the value is a parameter of theta.
    mean : float
        x₀, the mean of `values`.
    """

    name: str
    values: FloatArray
    columns: IntArray
    is_inferred: BoolArray
    mean: float

    @classmethod
    def of_tests(cls, name: str, tests: Sequence[Test], add: Callable[[Parameter, str], int]) -> Covariate:
        """Return the covariate `name` of the tests.

        If the true value in a test is not known, `add` adds it to theta as a parameter and returns its index. A
        missing value has a normal prior about the mean of the n known values. Its 95 % interval is the prediction
        interval of a further value, x̄ ± t_0.975(n − 1) s √(1 + 1/n) (Gelman et al. 2013, *Bayesian Data
        Analysis*, 3rd ed., section 3.2).
        """
        known = known_values(name, tests)
        mean, n = float(known.mean()), len(tests)
        values, columns, is_inferred = np.zeros(n), np.zeros(n, dtype=np.int64), np.zeros(n, dtype=bool)
        for t, test in enumerate(tests):
            given = test.covariates[name]
            given = Normal(_sd_of_another(known), mean=mean) if given is None else given
            prior, values[t] = prior_in(given), middle_of(given)
            is_inferred[t] = prior is not None
            if prior is not None:
                columns[t] = add(Parameter(f"{name} [{test.name}]", float(values[t]), prior=prior), test.name)
        columns[~is_inferred] = columns[is_inferred][0] if is_inferred.any() else 0
        # the mean over all tests: a missing value counts as the mean of the others
        return cls(name, values, columns, is_inferred, float(values.mean()))

    def at(self, theta: FloatArray) -> FloatArray:
        """Return the covariate's values in the tests, (n, n_tests) or (1, n_tests), at theta (n, n_parameters)."""
        if not self.is_inferred.any():
            return self.values[None]
        return np.where(self.is_inferred, theta[:, self.columns], self.values)

    def identity(self, test: int) -> Hashable:
        """Return a key. Tests with equal keys have equal covariate values at every theta."""
        return (True, int(self.columns[test])) if self.is_inferred[test] else (False, float(self.values[test]))


def _sd_of_another(known: FloatArray) -> float:
    """Return the sd of the Gaussian with the central 95 % interval of one more value, given the known ones."""
    n = len(known)
    return float(known.std(ddof=1) * gaussian_sd(n - 1) * np.sqrt(1.0 + 1.0 / n))


def middle_of(given: float | Prior) -> float:
    """Return the value itself if it is a number, or the median if it is a distribution."""
    return given.median_within(*given.support) if isinstance(given, Prior) else float(given)


def known_values(name: str, tests: Sequence[Test]) -> FloatArray:
    """Return a covariate's values (or medians) in the tests in which it is not missing, shape (n_known,)."""
    return np.array([middle_of(given) for test in tests if (given := test.covariates[name]) is not None])


def find_mistakes_of_covariate(name: str, of: str, tests: Sequence[Test]) -> list[str]:
    """Return error messages if the tests do not allow the parameter `of` to depend on the covariate `name`."""
    absent = [t for t, test in enumerate(tests) if name not in test.covariates]
    if absent:
        rule = f"must have {name}, on which {of} depends (got none)"
        return [f"tests.{t}.covariates: {rule}" for t in absent]
    uniform = [
        f"tests.{t}.covariates.{name}: must have a distribution without bounds, as fmu.Normal (got Uniform)"
        for t, test in enumerate(tests)
        if (prior := prior_in(test.covariates[name])) is not None and prior.needs_bounds
    ]
    if uniform:
        return uniform
    known = np.unique(known_values(name, tests))
    if len(known) < 2:
        got = "one value" if len(known) else "none"
        return [f"slopes.{of}: {name} must differ between tests (got {got})"]
    return []
