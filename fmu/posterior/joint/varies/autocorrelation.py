"""Population scores that are correlated in time. For evenly spaced tests they are an AR(1) process.

The test scores z_t, at times x_1 < x_2 < …, are a stationary Ornstein–Uhlenbeck process (Uhlenbeck & Ornstein
1930, *Phys. Rev.* 36, 823–841). Each score is standard normal, and two scores have the correlation
exp(−|x_i − x_j|/T), where T is the correlation time. With ρ_t = exp(−(x_t − x_(t−1))/T),

    z_1 ~ N(0, 1),    z_t | z_(t−1) ~ N(ρ_t z_(t−1), 1 − ρ_t²).

Given the previous score, a score does not depend on earlier ones, so the density of n scores takes O(n)
operations. The parameter value in a test depends only on the score of the same test. The innovations
e_t = (z_t − ρ_t z_(t−1)) / √(1 − ρ_t²) are independent and standard normal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Theta
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior, prior_in
from fmu.posterior.priors.one_sided import LogNormal
from fmu.types import BoolArray, FloatArray, IntArray

_SHORT = 3.0
"""Median time between tests, divided by the 5 % quantile of the default prior.

If T is this quantile, two tests the median time apart have the correlation exp(−3) = 0.05.
"""
_LEAST = 1e-3
"""Smallest T, relative to the shortest time between tests: the correlation is exp(−1000)."""
_QUANTILE = 1.6448536269514722  # of the standard normal distribution at 95 %


def times_of(by: str, tests: Sequence[Test], here: Sequence[int]) -> FloatArray:
    """Return the times of the tests with the indices `here`, shape (m,).

    They are the values of the covariate `by`, which must be a number in each of these tests. If `by` is empty,
    they are the positions of these tests among all tests, counted from 1.
    """
    if not by:
        return np.array(here) + 1.0
    return np.array([tests[t].covariates[by] for t in here], dtype=float)


def default_prior(times: FloatArray) -> LogNormal:
    """Return the default log-normal prior of the correlation time T for tests at ascending `times`.

    5 % of its probability lies below a third of the median time between tests, where scores are nearly
    independent. Another 5 % lies above the time from the first test to the last, where a slow change looks like a
    change of the mean.
    """
    low, high = np.median(np.diff(times)) / _SHORT, times[-1] - times[0]
    return LogNormal(float(np.sqrt(low * high)), float(np.log(high / low) / (2.0 * _QUANTILE)))


def find_mistakes_of_times(name: str, by: str, tests: Sequence[Test]) -> list[str]:
    """Return error messages if the tests have no valid times for the scores of the parameter `name`.

    The covariate `by` must be a number, different in each test in which the parameter is unknown. If `by` is
    empty, there is nothing to check.
    """
    if not by:
        return []
    here = [t for t, test in enumerate(tests) if name not in test.known]
    given = {t: tests[t].covariates.get(by) for t in here}
    rule = f"must have {by} as a number, as values of {name} are correlated in time"
    wrong = [t for t in here if tests[t].known_covariate(by) is None]
    if wrong:
        return [f"tests.{t}.covariates: {rule} (got {given[t]})" for t in wrong]
    found, seen = [], dict[object, int]()
    for t, x in given.items():
        if x in seen:
            rule = f"must differ from that of {tests[seen[x]].name!r}, as values of {name} are correlated in time"
            found.append(f"tests.{t}.covariates.{by}: {rule} (got {x} in both)")
        seen.setdefault(x, t)
    return found


N_STEPS, _LARGEST, _SMALLEST = 3, 2.0, 0.05
"""Number of random-walk steps in log T, largest standard deviation of a step, and ratio of smallest to largest."""


@dataclass(frozen=True, eq=False)
class InTime:
    """One population's scores as a process in time.

    Attributes
    ----------
    correlation_time : float or None
        T; None if it is inferred.
    column : int or None
        Index of T in theta; None if T is known.
    by : str
        The covariate that serves as time; empty if test numbers serve as time.
    order : ndarray of int, shape (m,)
        Indices of the tests with a score, in ascending order of time.
    times : ndarray, shape (m,)
        The times of these tests.
    """

    correlation_time: float | None
    column: int | None
    by: str
    order: IntArray
    times: FloatArray

    @classmethod
    def of_tests(
        cls, how: float | str | Prior, by: str, p: Parameter, of: int, theta: Theta, here: Sequence[int]
    ) -> InTime:
        """Return the population's scores as a process in time, after adding T to theta if it is inferred.

        `how` and `by` are the arguments `correlation_time` and `by` of `Population`; the other arguments are as in
        `Varies.in_tests`.
        """
        times = times_of(by, theta.tests, here)
        order = np.argsort(times, kind="stable")
        times = times[order]
        prior = default_prior(times) if how == "inferred" else prior_in(how)
        if prior is not None:
            name, least = f"{p.name} correlation time", max(0.0, prior.support[0])
            parameter = Parameter(name, prior.start_of(name), least, prior=prior)
            return cls(None, theta.add(parameter, "correlation time", of, by), by, np.array(here)[order], times)
        return cls(float(how), None, by, np.array(here)[order], times)  # type: ignore[arg-type]

    def correlation_times(self, theta: FloatArray) -> FloatArray:
        """Return the correlation time T, shape (n, 1), at theta (n, n_parameters).

        A very small T is replaced by a larger one at which the scores are already independent.
        """
        column = self.column
        found = np.full((len(theta), 1), self.correlation_time) if column is None else theta[:, [column]]
        return np.maximum(found, _LEAST * np.diff(self.times).min())

    def propose_time(
        self, rng: np.random.Generator, theta: FloatArray, parameters: Sequence[Parameter]
    ) -> tuple[FloatArray, FloatArray]:
        """Take one random-walk step in log T; return the new theta and the log-ratio of the priors, shape (n,).

        The ratio includes the Jacobian of log T. The step sizes are random, so that they suit both a precisely and
        a poorly known T. A step out of the bounds leaves theta unchanged, with the ratio −∞. If T is known, theta
        is returned with zeros.
        """
        column, n = self.column, len(theta)
        if column is None:
            return theta, np.zeros(n)
        p, found = parameters[column], theta.copy()
        step = _LARGEST * _SMALLEST ** rng.random(n) * rng.standard_normal(n)
        found[:, column] *= np.exp(step)
        inside = (found[:, column] > p.lower) & (found[:, column] < p.upper)
        found[~inside] = theta[~inside]
        now, new = (p.prior.log_pdf(at[:, column]) for at in (theta, found))
        return found, np.where(inside, new - now + step, -np.inf)

    def correlations(self, theta: FloatArray, gaps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the correlation ρ of scores separated by the times `gaps` (k,), and 1 − ρ², (n, k) each."""
        exponent = -gaps / self.correlation_times(theta)
        return np.exp(exponent), -np.expm1(2.0 * exponent)

    def between(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the correlation ρ of each score with the previous score, and 1 − ρ², both of shape (n, m − 1)."""
        return self.correlations(theta, np.diff(self.times))

    def log_density(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return each score's log-density given the previous score, relative to the standard normal density.

        Returns
        -------
        value : ndarray, shape (n, m)
            One term per score in z (n, m).
        by_score : ndarray, shape (n, m)
            Derivatives of the summed terms with respect to z.
        by_time : ndarray, shape (n,)
            Derivative of the summed terms with respect to T.
        """
        rho, left = self.between(theta)
        value, by_score = np.zeros_like(z), np.zeros_like(z)
        last, now = z[:, :-1], z[:, 1:]
        off = now - rho * last
        value[:, 1:] = -0.5 * (np.log(left) + off**2 / left - now**2)
        by_score[:, 1:] = now - off / left
        by_score[:, :-1] += rho * off / left
        by_rho = (rho + off * last - rho * off**2 / left) / left
        by_time = by_rho * rho * np.diff(self.times) / self.correlation_times(theta) ** 2
        return value, by_score, by_time.sum(axis=1)

    def precision(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the diagonal (n, m) and off-diagonal (n, m − 1) of the scores' tridiagonal precision matrix."""
        rho, left = self.between(theta)
        diagonal = np.ones((len(theta), len(self.order)))
        diagonal[:, 1:] += rho**2 / left
        diagonal[:, :-1] += rho**2 / left
        return diagonal, -rho / left

    def correlate(self, theta: FloatArray, e: FloatArray) -> FloatArray:
        """Return the correlated scores (n, m) that the innovations e (n, m) produce."""
        rho, left = self.between(theta)
        z = e.copy()
        for t in range(1, z.shape[1]):
            z[:, t] = rho[:, t - 1] * z[:, t - 1] + np.sqrt(left[:, t - 1]) * e[:, t]
        return z

    def innovations(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return the innovations (n, m) that produce the scores z (n, m)."""
        rho, left = self.between(theta)
        return np.concatenate([z[:, :1], (z[:, 1:] - rho * z[:, :-1]) / np.sqrt(left)], axis=1)

    def next_scores(
        self, theta: FloatArray, z: FloatArray, e: FloatArray, covariates: Mapping[str, float]
    ) -> FloatArray:
        """Return a further test's score (n,), given its innovation e (n,) and the other tests' scores z (n, m).

        `covariates` gives the time of the further test. The default is the time of the last test plus the median
        time between tests. If the time lies between two tests, the score depends on the scores of both. If it is
        the time of a test, the score is the score of that test.
        """
        time = covariates.get(self.by, float(self.times[-1] + np.median(np.diff(self.times))))
        k = int(np.searchsorted(self.times, time))
        before = (self.times[k - 1], z[:, k - 1]) if k else (-np.inf, 0.0)
        after = (self.times[k], z[:, k]) if k < len(self.times) else (np.inf, 0.0)
        gaps = np.array([time - before[0], after[0] - time])
        (rho, other), (left, of_other) = (one.T for one in self.correlations(theta, gaps))
        whole = left + of_other * rho**2  # 1 − (ρ ρ')², zero only where the times are equal
        if not gaps.all():
            return np.array(after[1])
        mean = (rho * of_other * before[1] + other * left * after[1]) / whole
        return np.asarray(mean + np.sqrt(left * of_other / whole) * e)


@dataclass(frozen=True)
class ScoresInTime:
    """Score density for several populations, some of which are correlated in time.

    Attributes
    ----------
    every : tuple of InTime or None
        Each population's scores in time; None if they are independent.
    n_tests : int
    """

    every: tuple[InTime | None, ...]
    n_tests: int

    @property
    def _each(self) -> list[tuple[int, InTime]]:
        return [(k, one) for k, one in enumerate(self.every) if one is not None]

    @property
    def columns(self) -> tuple[int, ...]:
        """Indices in theta of the inferred correlation times."""
        return tuple(column for _, one in self._each if (column := one.column) is not None)

    @property
    def times(self) -> set[str]:
        """Names of the covariates that serve as time."""
        return {one.by for _, one in self._each} - {""}

    def log_density(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return each test's score log-density, relative to independent normal scores, and its derivatives.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        z : ndarray, shape (n, n_tests, p)
            Scores.

        Returns
        -------
        value : ndarray, shape (n, n_tests)
        by_score : ndarray, shape (n, n_tests, p)
            Derivatives of the sum over the tests.
        by_columns : ndarray, shape (n, n_columns)
            Derivatives of the sum with respect to the parameters in `columns`.
        """
        value, by_score, by_columns = np.zeros(z.shape[:2]), np.zeros_like(z), []
        for k, one in self._each:
            of_one, by_score[:, one.order, k], by_time = one.log_density(theta, z[:, one.order, k])
            value[:, one.order] += of_one
            by_columns += [] if one.column is None else [by_time]
        return value, by_score, np.stack(by_columns, axis=1) if by_columns else np.zeros((len(z), 0))

    def precision(self, theta: FloatArray) -> FloatArray:
        """Return each score's precision given all other scores, minus 1.

        The result consists of diagonal matrices, shape (n, n_tests, p, p).
        """
        found = np.zeros((len(theta), self.n_tests, len(self.every), len(self.every)))
        for k, one in self._each:
            found[:, one.order, k, k] = one.precision(theta)[0] - 1.0
        return found

    def of_each(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return, for each test, the sum of the `log_density` terms that contain its scores, (n, n_tests)."""
        found = np.zeros(z.shape[:2])
        for k, one in self._each:
            terms = one.log_density(theta, z[:, one.order, k])[0]
            found[:, one.order] += terms
            found[:, one.order[:-1]] += terms[:, 1:]
        return found

    @cached_property
    def parts(self) -> list[BoolArray]:
        """Masks of tests, shape (n_tests,) each.

        Scores of the tests in one mask are independent, given the scores of all other tests.
        """
        beside: list[set[int]] = [set() for _ in range(self.n_tests)]
        for _, one in self._each:
            for a, b in pairwise(one.order.tolist()):
                beside[a].add(b)
                beside[b].add(a)
        part = np.full(self.n_tests, -1)
        for t, others in enumerate(beside):
            part[t] = next(k for k in range(self.n_tests) if k not in part[list(others)])
        return [part == k for k in range(part.max() + 1)]

    def draw_times(
        self, rng: np.random.Generator, theta: FloatArray, z: FloatArray, parameters: Sequence[Parameter]
    ) -> FloatArray:
        """Return a copy of theta after random-walk steps in each log T, given the scores z (n, n_tests, p)."""
        for k, one in self._each:
            for _ in range(N_STEPS):
                candidate, ratio = one.propose_time(rng, theta, parameters)
                now, new = (one.log_density(at, z[:, one.order, k])[0] for at in (theta, candidate))
                ratio = ratio + np.einsum("nt->n", new - now)
                theta = np.where((np.log(rng.random(len(z))) < ratio)[:, None], candidate, theta)
        return theta

    def correlate(self, theta: FloatArray, e: FloatArray) -> FloatArray:
        """Return the scores that the innovations e produce; both have shape (n, n_tests, p)."""
        z = e.copy()
        for k, one in self._each:
            z[:, one.order, k] = one.correlate(theta, e[:, one.order, k])
        return z

    def innovations(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return the innovations that produce the scores z, (n, n_tests, p); independent scores stay unchanged."""
        e = z.copy()
        for k, one in self._each:
            e[:, one.order, k] = one.innovations(theta, z[:, one.order, k])
        return e

    def next_scores(
        self, theta: FloatArray, z: FloatArray, e: FloatArray, covariates: Mapping[str, float]
    ) -> FloatArray:
        """Return a further test's scores (n, p), given its innovations e (n, p) and the other tests' scores z.

        `covariates` are as in `InTime.next_scores`.
        """
        found = e.copy()
        for k, one in self._each:
            found[:, k] = one.next_scores(theta, z[:, one.order, k], e[:, k], covariates)
        return found
