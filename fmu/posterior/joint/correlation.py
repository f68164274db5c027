"""Model the correlation between the populations of several parameters with a Gaussian copula.

The scores z_t of all populations in test t are standard normal with the correlation matrix R. The log-density of
the copula,

    log c(z_t) = −½ log det R − ½ z_tᵀ (R⁻¹ − I) z_t,

is added to the log-density of the test's values. Each parameter keeps its own distribution and bounds. R is built
from the partial correlations ρ_ij of parameters i < j given the parameters before i. If the partial correlations
have certain independent beta distributions, the density of R is proportional to (det R)^(η − 1) (Lewandowski,
Kurowicka & Joe 2009, *J. Multivar. Anal.* 100, 1989–2001, section 2.4).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.scipy_distributions import ScaledBeta
from fmu.types import BoolArray, FloatArray, IntArray

MOST = 0.999
"""The largest absolute value of a partial correlation."""
_START = 0.95
"""The largest absolute value of a partial correlation at a starting point."""


@dataclass(frozen=True)
class Correlation:
    """Correlation matrix of p populations, parametrised by partial correlations.

    Attributes
    ----------
    columns : tuple of int
        Indices in theta of the partial correlations ρ_12, ρ_13, ρ_23, ρ_14, …
    scored : ndarray of bool, shape (n_tests, p)
        Whether a test has a score in a population. Missing scores are integrated out.
    """

    columns: tuple[int, ...]
    scored: BoolArray
    _last: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def factor(self, theta: FloatArray) -> FloatArray:
        """Return the correlation matrix's Cholesky factor, shape (n, p, p), at theta (n, n_parameters)."""
        return self._at(theta)[0]

    def log_density(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the copula's log-density in each test, and its derivatives.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        z : ndarray, shape (n, n_tests, p)
            Scores.

        Returns
        -------
        value : ndarray, shape (n, n_tests)
        by_score : ndarray, shape (n, n_tests, p)
        by_correlation : ndarray, shape (n, p (p - 1) / 2)
            Derivatives of the sum over the tests with respect to the partial correlations.
        """
        L, slopes, blocks = self._at(theta)
        value, by_score, by_R = np.zeros(z.shape[:2]), np.zeros_like(z), np.zeros_like(L)
        for here, tests, block, inverse, log_det in blocks:
            of = z[:, tests][:, :, here]
            turned = np.einsum("nij,ntj->nti", inverse, of)
            value[:, tests] = -0.5 * log_det[:, None] - 0.5 * np.einsum("nti,nti->nt", of, turned - of)
            by_score[np.ix_(range(len(z)), tests, here)] = of - turned
            by_R[block] += 0.5 * (np.einsum("nti,ntj->nij", turned, turned) - len(tests) * inverse)
        by_L = 2.0 * np.einsum("nij,njk->nik", by_R, L)
        return value, by_score, np.einsum("nij,nkij->nk", by_L, slopes)

    def precision(self, theta: FloatArray) -> FloatArray:
        """Return the inverse correlation matrix minus I for each test, shape (n, n_tests, p, p).

        For each test, only the scores that it has are included in the matrix that is inverted. Entries for missing
        scores are zero.
        """
        n_tests, p = self.scored.shape
        found = np.zeros((len(theta), n_tests, p, p))
        for here, tests, _, inverse, _ in self._at(theta)[2]:
            found[np.ix_(range(len(theta)), tests, here, here)] = (inverse - np.eye(len(here)))[:, None]
        return found

    def log_det(self, theta: FloatArray) -> FloatArray:
        """Return the log-determinant of each test's score correlation matrix, shape (n, n_tests)."""
        found = np.zeros((len(theta), len(self.scored)))
        for _, tests, _, _, log_det in self._at(theta)[2]:
            found[:, tests] = log_det[:, None]
        return found

    def gradient_of_moments(self, theta: FloatArray, moments: FloatArray) -> FloatArray:
        """Return the gradient of the scores' expected log-density with respect to the partial correlations.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        moments : ndarray, shape (n, n_tests, p, p)
            Expected second moments of each test's scores.

        Returns
        -------
        ndarray, shape (n, p (p - 1) / 2)
            Gradient of the sum over the tests.
        """
        L, slopes, blocks = self._at(theta)
        by_R = np.zeros_like(L)
        for here, tests, block, inverse, _ in blocks:
            total = moments[:, tests].sum(axis=1)[:, here[:, None], here]
            by_R[block] += 0.5 * (inverse @ total @ inverse - len(tests) * inverse)
        return np.einsum("nij,nkij->nk", 2.0 * by_R @ L, slopes)

    def of_scores(self, second_moments: FloatArray) -> FloatArray:
        """Return the partial correlations, (p (p − 1) / 2,), of scores with the given second moments (p, p).

        They are clipped to ±`_START`.
        """
        return np.clip(partial_correlations(np.linalg.cholesky(second_moments)), -_START, _START)

    @cached_property
    def _patterns(self) -> list[tuple[IntArray, IntArray]]:
        """Population indices and test indices for each set of tests that have scores in the same populations.

        Tests with fewer than two scores are left out.
        """
        found = [
            (np.flatnonzero(one), np.flatnonzero((self.scored == one).all(axis=1)))
            for one in np.unique(self.scored, axis=0)
        ]
        return [(here, tests) for here, tests in found if len(here) > 1]

    def _at(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, list[Any]]:
        """Return the Cholesky factor at theta (n, n_parameters), its derivatives, and a list of the `_blocks`.

        The result for the last correlations is cached.
        """
        rho = theta[:, self.columns]
        if not np.array_equal(self._last.get("rho", ()), rho):
            L, slopes = self._factors(rho)
            self._last.update(rho=rho, found=(L, slopes, list(self._blocks(L))))
        found: tuple[FloatArray, FloatArray, list[Any]] = self._last["found"]
        return found

    def _blocks(self, L: FloatArray) -> Iterator[Any]:
        """Yield the block of the correlation matrix for each of the `_patterns`.

        Each item has the population indices, the test indices, the index that selects the block, the block's
        inverse and its log-determinant.
        """
        R = L @ np.swapaxes(L, 1, 2)
        for here, tests in self._patterns:
            block = np.ix_(range(len(R)), here, here)
            yield here, tests, block, np.linalg.inv(R[block]), np.linalg.slogdet(R[block])[1]

    def _factors(self, rho: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the correlation matrix's Cholesky factor L, and its derivatives.

        The shapes are (n, p, p), and (n, p (p - 1) / 2, p, p) with one row per partial correlation.

        L_ji = ρ_ij √(1 − ρ_1j²) … √(1 − ρ_(i−1)j²), with ρ_jj = 1.
        """
        p = self.scored.shape[1]
        L, slopes = np.zeros((len(rho), p, p)), np.zeros((len(rho), rho.shape[1], p, p))
        L[:, 0, 0] = 1.0
        first = 0
        for j in range(1, p):
            of = rho[:, first : first + j]
            left = np.cumprod(np.concatenate([np.ones((len(of), 1)), np.sqrt(1.0 - of**2)], axis=1), axis=1)
            L[:, j, : j + 1] = np.concatenate([of, np.ones((len(of), 1))], axis=1) * left
            for k in range(j):
                slopes[:, first + k, j, k] = left[:, k]
                slopes[:, first + k, j, k + 1 : j + 1] = (
                    -L[:, j, k + 1 : j + 1] * (of[:, k] / (1.0 - of[:, k] ** 2))[:, None]
                )
            first += j
        return L, slopes


def partial_correlations(factor: FloatArray) -> FloatArray:
    """Return the partial correlations ρ_12, ρ_13, ρ_23, … of covariance matrices, shape (…, p (p − 1) / 2).

    Parameters
    ----------
    factor : ndarray, shape (…, p, p)
        Square roots A of the matrices A Aᵀ. Rows may have any scale.
    """
    # ρ_ij given the variables before i: correlation of rows i and j after removing the rows before them
    L = np.swapaxes(np.linalg.qr(np.swapaxes(factor, -1, -2), mode="r"), -1, -2)
    L = L * np.sign(np.einsum("...ii->...i", L))[..., None, :]
    left = np.sqrt(np.cumsum(L[..., ::-1] ** 2, axis=-1)[..., ::-1])
    pairs = [(i, j) for j in range(L.shape[-1]) for i in range(j)]
    return np.stack([L[..., j, i] / left[..., j, i] for i, j in pairs], axis=-1)


def correlations(names: Sequence[str], eta: float) -> list[Parameter]:
    """Return the partial correlations between the populations `names` as parameters with the LKJ(η) prior."""
    found, p = [], len(names)
    for j in range(1, p):
        for i in range(j):
            given = f" given {', '.join(names[:i])}" if i else ""
            shape = eta + 0.5 * (p - 2 - i)
            prior = ScaledBeta(shape, shape, -1.0, 1.0)
            found.append(Parameter(f"{names[i]} {names[j]} correlation{given}", 0.0, -MOST, MOST, prior))
    return found
