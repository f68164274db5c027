"""Gaussian residuals that share latent errors: their joint density, its derivatives, and predictions.

Row i has the k residuals of a mode in a test,

r_i = A_i z_g(i) + a_i w + e_i,

with independent standard normal z_g (P numbers for each group g of rows), w (C numbers for all rows) and e_i (k
numbers). z and w are the latent errors, and A and a are their loadings. Given w, groups are independent of each
other. All factorised matrices have size P, k or C, whatever the number of rows. With M_g = I + Σ_i A_iᵀA_i
(Woodbury's identity), the quadratic form of X = (r, a) in a group is Σ_i X_iᵀX_i − BᵀM_g⁻¹B, B = Σ_i A_iᵀX_i. Then
w is integrated out of the sum over the groups in the same manner.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from fmu.fem.modes.stacks import nan_where_singular
from fmu.types import FloatArray, IntArray

MOST_SQUARES = 1e14
"""Largest sum of a row's squared residuals (in sds) at which the log-density is accurate to 0.01."""


class Slopes(NamedTuple):
    """Derivatives of a residual log-density with respect to the residuals and the latent errors' loadings.

    Attributes
    ----------
    by_residual : ndarray, shape (n, m, k)
        With respect to the residuals.
    by_loads : ndarray, shape (n, m, k, P)
        With respect to the loadings A of a group's errors.
    by_common : ndarray, shape (n, m, k, C)
        With respect to the loadings a of the common errors.
    """

    by_residual: FloatArray
    by_loads: FloatArray
    by_common: FloatArray


class _Order(NamedTuple):
    """Places of the rows in their groups.

    Attributes
    ----------
    later : ndarray of int, shape (l,)
        Indices of the rows that are not the first of their group.
    before : ndarray of int, shape (l,)
        For each of these, the index of the previous row in the same group.
    last : ndarray of int, shape (m,)
        For each row, the index of the last row in the same group.
    """

    later: IntArray
    before: IntArray
    last: IntArray


@lru_cache(maxsize=64)
def _order(group: tuple[int, ...]) -> _Order:
    """Return the places of m rows with these groups."""
    before, latest = [], dict[int, int]()
    for i, g in enumerate(group):
        before.append(latest.get(g, -1))
        latest[g] = i
    later = np.flatnonzero(np.array(before) >= 0)
    return _Order(later, np.array(before)[later], np.array([latest[g] for g in group]))


@dataclass(frozen=True, eq=False)
class LatentErrors:
    """Residuals of m rows that share latent errors, at n points. The module docstring explains the notation.

    Attributes
    ----------
    residuals : ndarray, shape (n, m, k)
    loads : ndarray, shape (n, m, k, P)
        The loadings A.
    common : ndarray, shape (n, m, k, C)
        The loadings a; C may be 0.
    group : ndarray of int, shape (m,)
        The group of each row.
    """

    residuals: FloatArray
    loads: FloatArray
    common: FloatArray
    group: IntArray

    def terms(self) -> FloatArray:
        """Return each row's log-density given the rows before it, relative to independent residuals, (n, m).

        The terms sum to log N(r; 0, S) − log N(r; 0, I), where S is the covariance of all residuals. If all groups
        have one row and C is 0, each term is the log-density of its row alone. The squares of large residuals
        nearly cancel in a term, which is −∞ if their rounding errors would exceed 0.01.
        """
        squares = np.einsum("nmk,nmk->nm", self.residuals, self.residuals)
        with np.errstate(invalid="ignore"):  # rows without a density
            return np.where(squares > MOST_SQUARES, -np.inf, self._terms(squares))

    def _terms(self, squares: FloatArray) -> FloatArray:
        if self._is_single and not self.common.shape[-1]:
            S, r = self._variance, self.residuals[..., 0]
            return np.asarray(0.5 * (r**2 * (1.0 - 1.0 / S) - np.log(S)))
        log_det = self._grown(self._log_det)
        if not self.common.shape[-1]:
            return np.asarray(0.5 * (self._grown(self._explained)[..., 0, 0] - log_det))
        so_far = self._integrate_common(np.cumsum(self._grown(self._quadratic), axis=1))
        return np.asarray(0.5 * (squares - log_det) - 0.5 * np.diff(so_far, axis=1, prepend=0.0))

    def terms_given_others(self) -> FloatArray:
        """Return the log-density of each row given all other rows, relative to independent residuals, (n, m).

        With S as in `terms`, Q the row's block of S⁻¹ and g its part of S⁻¹r, it is ½ (|r|² − gᵀQ⁻¹g + log det Q).
        """
        z, w, of_z, of_both, of_w = self.given_residuals()
        F = np.concatenate([self.loads, self.common], axis=3)
        n, m, k, _ = F.shape
        mean = np.concatenate([z[:, self.last], np.broadcast_to(w[:, None], (n, m, w.shape[1]))], axis=2)
        own, both = of_z[:, self.last], of_both[:, self.last]
        of_w = np.broadcast_to(of_w[:, None], (n, m, *of_w.shape[1:]))
        covariance = np.block([[own, both], [np.swapaxes(both, 2, 3), of_w]])
        g = self.residuals - np.einsum("nmkf,nmf->nmk", F, mean)
        Q = np.eye(k) - F @ covariance @ np.swapaxes(F, 2, 3)
        square = np.einsum("nmk,nmk->nm", g, solve_positive(Q, g[..., None])[..., 0])
        squares = np.einsum("nmk,nmk->nm", self.residuals, self.residuals)
        return np.asarray(0.5 * (squares - square + np.linalg.slogdet(Q)[1]))

    def squares(self) -> FloatArray:
        """Return the sum of squares of each row's residuals, whitened given the rows before it, shape (n, m)."""
        quadratic = self._grown(self._quadratic)
        if not self.common.shape[-1]:
            return np.asarray(quadratic[..., 0, 0])
        so_far = self._integrate_common(np.cumsum(quadratic, axis=1), with_log_det=False)
        return np.asarray(np.diff(so_far, axis=1, prepend=0.0))

    def slopes(self) -> Slopes:
        """Return the derivatives of the summed `terms`.

        Let ẑ, ŵ and Cov be the mean and covariance of the latent errors given the residuals, F = (A, a) and e = r
        − F(ẑ, ŵ). The derivatives are F(ẑ, ŵ) with respect to r and e(ẑ, ŵ)ᵀ − F Cov with respect to F.
        """
        z, w, of_z, of_both, of_w = self.given_residuals()
        A, a, last = self.loads, self.common, self.last
        fitted = np.einsum("nmkp,nmp->nmk", A, z[:, last])
        left = A @ of_z[:, last]
        if not a.shape[-1]:
            by_loads = (self.residuals - fitted)[..., None] * z[:, last, None] - left
            return Slopes(fitted, by_loads, np.zeros_like(a))
        fitted = fitted + np.einsum("nmkc,nc->nmk", a, w)
        error = (self.residuals - fitted)[..., None]
        left = left + a @ np.swapaxes(of_both[:, last], 2, 3)
        right = A @ of_both[:, last] + a @ of_w[:, None]
        return Slopes(fitted, error * z[:, last, None] - left, error * w[:, None, None] - right)

    def given_residuals(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the distribution of the latent errors given the residuals.

        Returns
        -------
        z, w : ndarray, shapes (n, m, P) and (n, C)
            Means. For z, each group's last row has the mean given all rows; earlier rows have the mean given only
            some of them.
        of_z, of_both, of_w : ndarray, shapes (n, m, P, P), (n, m, P, C) and (n, C, C)
            Covariances of z, of z with w, and of w, given the same rows as the means.
        """
        of_z, mean = self._covariance, self._mean
        n, C = len(self.residuals), self.common.shape[-1]
        if not C:
            return mean[..., 0], np.empty((n, 0)), of_z, np.empty((*mean.shape[:3], 0)), np.empty((n, 0, 0))
        last = np.unique(self.last)
        total = np.sum(self._quadratic[:, last], axis=1)
        of_w = solve_positive(np.eye(C) + total[:, 1:, 1:], np.eye(C))
        w = np.einsum("ncd,nd->nc", of_w, total[:, 1:, 0])
        gain = mean[..., 1:]
        of_both = -gain @ of_w[:, None]
        z = mean[..., 0] - np.einsum("nmpc,nc->nmp", gain, w)
        return z, w, of_z - of_both @ np.swapaxes(gain, 2, 3), of_both, of_w

    def learnt_of_common(self) -> FloatArray:
        """Return I − Cov, (n, C, C), where Cov is the covariance of the common errors w given the residuals.

        It is computed as T(I + T)⁻¹ with T = Σ_g a_gᵀS_g⁻¹a_g, where a_g are the loadings a of group g and S_g is
        the covariance of its residuals given w. This is exact to rounding even if the loadings a are tiny.
        """
        last = np.unique(self.last)
        T = np.sum(self._quadratic[:, last, 1:, 1:], axis=1)
        return solve_positive(np.eye(T.shape[-1]) + T, T)

    def given_common(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the distribution of a group's own errors z, given its residuals and the common errors w.

        The result is valid only at the last row of each group.

        Returns
        -------
        mean, gain, covariance : ndarray, shapes (n, m, P), (n, m, P, C) and (n, m, P, P)
            Given w, the mean of z is ``mean`` − ``gain`` w.
        """
        return self._mean[..., 0], self._mean[..., 1:], self._covariance

    def whiten(self, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residuals whitened to unit covariance, (n, m, k), and their derivatives, (n, m, k, N).

        `slopes` are the derivatives of r. Each group's residuals are multiplied by the symmetric root S^(−½), so
        that each residual keeps its meaning. For a group's matrix A with AᵀA = VΛVᵀ, the root is I − A V h(Λ) VᵀAᵀ
        with h(λ) = (1 − 1/√(1 + λ))/λ. All residuals are then whitened for the common errors in the same way.
        """
        X = np.concatenate([self.residuals[..., None], self.common, slopes], axis=3)
        X = X - self.loads @ self._half(self._sum(np.swapaxes(self.loads, 2, 3) @ X))[:, self.last]
        C = self.common.shape[-1]
        a, rest = X[..., 1 : 1 + C], np.delete(X, np.s_[1 : 1 + C], axis=3)
        if C:
            gram = np.einsum("nmkc,nmkd->ncd", a, a)
            rest = rest - a @ (_half_root(gram) @ np.einsum("nmkc,nmkx->ncx", a, rest))[:, None]
        return rest[..., 0], rest[..., 1:]

    def _half(self, B: FloatArray) -> FloatArray:
        return np.asarray(_half_root(self._gram) @ B)

    @cached_property
    def _order(self) -> _Order:
        return _order(tuple(self.group.tolist()))

    @property
    def last(self) -> IntArray:
        """For each row, the index of the last row in the same group, shape (m,)."""
        return self._order.last

    @property
    def _later(self) -> IntArray:
        return self._order.later

    @property
    def _is_single(self) -> bool:
        """Whether every group consists of one row with one residual."""
        return self.residuals.shape[2] == 1 and not len(self._later)

    @cached_property
    def _variance(self) -> FloatArray:
        """Variances S = 1 + AAᵀ, shape (n, m), if each row has one residual."""
        return np.asarray(1.0 + np.einsum("nmkp,nmkp->nm", self.loads, self.loads))

    # In what follows, a row's group is the group's rows up to and including this row. Its z is integrated out.

    @cached_property
    def _with_common(self) -> FloatArray:
        """The matrices X = (r, a), shape (n, m, k, 1 + C)."""
        r = self.residuals[..., None]
        return np.concatenate([r, self.common], axis=3) if self.common.shape[3] else r

    @cached_property
    def _products(self) -> FloatArray:
        """B = Σ AᵀX of each row's group, shape (n, m, P, 1 + C)."""
        return self._sum(np.swapaxes(self.loads, 2, 3) @ self._with_common)

    @cached_property
    def _mean(self) -> FloatArray:
        """M⁻¹B of each row's group, shape (n, m, P, 1 + C)."""
        if self._is_single:  # the number S = 1 + AAᵀ is enough
            return np.swapaxes(self.loads, 2, 3) * (self._with_common / self._variance[..., None, None])
        return solve_positive(self._precision, self._products)

    @cached_property
    def _log_det(self) -> FloatArray:
        """Logarithm of det S of each row's group, shape (n, m), where S is the covariance of its rows given w."""
        return np.log(self._variance) if self._is_single else np.linalg.slogdet(self._precision)[1]

    @cached_property
    def _explained(self) -> FloatArray:
        """XᵀX − XᵀS⁻¹X of each row's group, shape (n, m, 1 + C, 1 + C)."""
        return np.asarray(np.swapaxes(self._products, 2, 3) @ self._mean)

    @cached_property
    def _quadratic(self) -> FloatArray:
        """XᵀS⁻¹X of each row's group, shape (n, m, 1 + C, 1 + C)."""
        X = self._with_common
        if self._is_single:
            return np.swapaxes(X, 2, 3) * (X / self._variance[..., None, None])
        return self._sum(np.swapaxes(X, 2, 3) @ X) - self._explained

    @cached_property
    def _precision(self) -> FloatArray:
        """Precision M of each group's latent errors z given the group's rows so far, shape (n, m, P, P).

        Entry i along the second axis accounts for the rows of the group up to row i.
        """
        return np.asarray(np.eye(self.loads.shape[3]) + self._gram)

    @cached_property
    def _gram(self) -> FloatArray:
        """Gram matrices AᵀA of the loadings, summed over the rows so far, (n, m, P, P); see `_precision`."""
        return self._sum(np.swapaxes(self.loads, 2, 3) @ self.loads)

    @cached_property
    def _covariance(self) -> FloatArray:
        """Covariance M⁻¹ of each group's latent errors z given the group's rows so far, (n, m, P, P)."""
        if not self._is_single:
            return solve_positive(self._precision, np.eye(self.loads.shape[3]))
        A = self.loads
        return np.asarray(np.eye(A.shape[3]) - np.swapaxes(A, 2, 3) * (A / self._variance[..., None, None]))

    def _sum(self, x: FloatArray) -> FloatArray:
        """Return cumulative sums of x within each group of rows, shape (n, m, …)."""
        if not len(self._later):
            return x
        total = x.copy()
        for g in np.unique(self.group[self._later]):
            rows = np.flatnonzero(self.group == g)
            total[:, rows] = np.cumsum(x[:, rows], axis=1)
        return total

    def _grown(self, total: FloatArray) -> FloatArray:
        """Return the increments of `total`, the cumulative sums within each group of rows, shape (n, m, …)."""
        if not len(self._later):
            return total
        found = total.copy()
        found[:, self._later] -= total[:, self._order.before]
        return found

    def _integrate_common(self, so_far: FloatArray, with_log_det: bool = True) -> FloatArray:
        """Integrate the common errors w out of the sums (n, m, 1 + C, 1 + C); return r's quadratic form (n, m).

        If `with_log_det` is True, the log-determinant is added.
        """
        N = np.eye(self.common.shape[-1]) + so_far[..., 1:, 1:]
        right = so_far[..., 1:, :1]
        found = so_far[..., 0, 0] - (so_far[..., :1, 1:] @ solve_positive(N, right))[..., 0, 0]
        return np.asarray(found + np.linalg.slogdet(N)[1] if with_log_det else found)


@dataclass(frozen=True, eq=False)
class KnownErrors(LatentErrors):
    """Residuals of m rows whose latent errors are known, so that the rows are independent.

    Attributes
    ----------
    z : ndarray, shape (n, m, P)
        The errors of each row's group.
    w : ndarray, shape (n, C)
        The common errors.
    """

    z: FloatArray
    w: FloatArray

    @property
    def fitted(self) -> FloatArray:
        """The part of the residuals that the latent errors explain, A z + a w, shape (n, m, k)."""
        own = np.einsum("nmkp,nmp->nmk", self.loads, self.z)
        return own + np.einsum("nmkc,nc->nmk", self.common, self.w)

    def terms(self) -> FloatArray:
        """Return each row's log-density relative to independent residuals, (n, m).

        It is log N(r; A z + a w, I) − log N(r; 0, I).
        """
        fitted = self.fitted
        return np.einsum("nmk,nmk->nm", fitted, self.residuals - 0.5 * fitted)

    def slopes(self) -> Slopes:
        """Return the derivatives of the summed `terms`."""
        fitted = self.fitted
        error = (self.residuals - fitted)[..., None]
        return Slopes(fitted, error * self.z[:, :, None], error * self.w[:, None, None])

    def whiten(self, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return r − A z − a w, shape (n, m, k), and the derivatives of r, which are unchanged."""
        return self.residuals - self.fitted, slopes


def _half_root(gram: FloatArray) -> FloatArray:
    """Return V h(Λ) Vᵀ for Gram matrices VΛVᵀ, shape (…, P, P); see `LatentErrors.whiten` for h.

    With s = √(1 + λ), h(λ) is computed as 1/(s (1 + s)), in which no digits cancel if λ is small. Entries of the
    Gram matrices that are not finite count as 0.
    """
    values, V = np.linalg.eigh(np.where(np.isfinite(gram), gram, 0.0))  # LAPACK fails at NaN
    s = np.sqrt(1.0 + np.maximum(values, 0.0))
    return np.asarray((V / (s * (1.0 + s))[..., None, :]) @ np.swapaxes(V, -1, -2))


def solve_positive(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solve systems with positive definite matrices (…, P, P); return the solutions (…, P, q).

    A solution is NaN where the factor loadings are so large that the matrix is singular to working precision.
    """
    return nan_where_singular(np.linalg.solve, matrix, right)
