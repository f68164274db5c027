"""Expected information on the parameters from a modal test, with the model linearised at draws.

At each draw, the parameters are scaled so that their covariance before the test is the identity matrix. Sensor q
reads y = a_i φ_i(θ)_q + e in mode i, with an unknown scale a_i. Let φ_i and its derivatives J_i be divided, row by
row, by the standard deviation of e. The mode shapes then add to the information matrix

    Σ_i [ J_iᵀJ_i − (J_iᵀφ_i)(φ_iᵀJ_i) / (φ_iᵀφ_i) ],

where the second term is lost because the scales are unknown. One more sensor, with row (φ, j) in a mode, adds

    r rᵀ with r = (j − φ b) / √(1 + φ²/N), N = φ_iᵀφ_i and b = J_iᵀφ_i / N.

Here N and b are computed from the sensors that were placed before it. This is the recursion of least squares. Let
A be the sum of the identity matrix and all information. The expected information gain about all parameters is then
½ E log det A, where E is the mean over the draws.

References
----------
Lindley (1956), *Ann. Math. Statist.* 27, 986–1005; Papadimitriou (2004), *J. Vib. Control* 10, 1637–1665.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmu.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Readings:
    """Linearised mode-shape readings at the candidate sensors, at n draws of p parameters.

    Attributes
    ----------
    prior : ndarray, shape (n, p, p)
        Information before any sensor is placed: the identity matrix plus the information of the frequencies.
    shapes : ndarray, shape (n, rows, modes)
        Mode shapes divided by the standard deviations of their errors; the last row is zero.
    slopes : ndarray, shape (n, rows, modes, p)
        Derivatives of these shapes with respect to the scaled parameters.
    groups : ndarray of int, shape (n_candidates, d)
        Rows of each candidate: one for a uniaxial sensor, up to three for a triaxial one, padded with −1.
    target : ndarray, shape (n, t, p), or None
        Combinations of the scaled parameters that matter; None if all parameters matter equally.
    """

    prior: FloatArray
    shapes: FloatArray
    slopes: FloatArray
    groups: IntArray
    target: FloatArray | None = None

    def start(self) -> State:
        """Return the information before any sensor is placed."""
        n, _, m, p = self.slopes.shape
        return State(self.prior, np.zeros((n, m, p)), np.zeros((n, m)))

    def with_sensors(self, chosen: Sequence[int], state: State | None = None) -> State:
        """Return the information in `state` plus the information of sensors at the candidates in `chosen`.

        By default, `state` is the information before any sensor is placed (`start`).
        """
        found = self.start() if state is None else state
        for k in chosen:
            for row in self.groups[k][self.groups[k] >= 0]:
                found = found.with_row(self.shapes[:, row], self.slopes[:, row])
        return found

    def value(self, state: State) -> float:
        """Return the expected information gain in nats, about the target or, without one, about all parameters."""
        if self.target is None:
            return 0.5 * float(np.mean(np.linalg.slogdet(state.matrix)[1]))
        left = self.target @ np.linalg.solve(state.matrix, np.swapaxes(self.target, 1, 2))
        before = self.target @ np.swapaxes(self.target, 1, 2)
        return 0.5 * float(np.mean(np.linalg.slogdet(before)[1] - np.linalg.slogdet(left)[1]))

    def value_of(self, chosen: Sequence[int]) -> float:
        """Return the expected information gain, in nats, of measuring the chosen candidates."""
        return self.value(self.with_sensors(chosen))

    def gains(self, state: State) -> FloatArray:
        """Return the increase in `value` due to each candidate, shape (n_candidates,).

        With a candidate's new rows R and P = A⁻¹, log det A grows by log det(I + R P Rᵀ). If a target T matters,
        the growth is log det(I + R P Rᵀ) − log det(I + R (P − V) Rᵀ) with V = P Tᵀ (T P Tᵀ)⁻¹ T P.
        """
        whole, rest = self._factors(state)
        found = np.zeros(len(self.groups))
        for i in range(len(whole)):  # one draw at a time, so that its arrays stay in the processor's cache
            rows = self._new_rows(i, state)
            found += _log_det_of_one_plus(rows @ whole[i])
            if rest is not None and rest.shape[2]:
                found -= _log_det_of_one_plus(rows @ rest[i])
        return 0.5 * found / len(whole)

    def weights_of_directions(self, state: State) -> FloatArray:
        """Return F (n, p, t) such that F Fᵀ = V, the derivative of 2 `value` with respect to A, at each draw.

        Without a target, V is A⁻¹ and t is p.
        """
        whole, rest = self._factors(state)
        if rest is None:
            return whole
        T = self.target
        assert T is not None  # for the type checker: there is a rest only with a target
        W = np.swapaxes(whole, 1, 2) @ np.swapaxes(T, 1, 2)
        return np.asarray(whole @ np.linalg.qr(W)[0])

    def _factors(self, state: State) -> tuple[FloatArray, FloatArray | None]:
        """Return C (n, p, p) with C Cᵀ = P, and D (n, p, p − t) with D Dᵀ = P − V, where `gains` defines P and V.

        D is None if there is no target.
        """
        L = np.linalg.cholesky(state.matrix)
        C = np.swapaxes(np.linalg.inv(L), 1, 2)
        if self.target is None:
            return C, None
        W = np.swapaxes(C, 1, 2) @ np.swapaxes(self.target, 1, 2)
        Q = np.linalg.qr(W, mode="complete")[0]
        return C, C @ Q[:, :, W.shape[2] :]

    def _new_rows(self, i: int, state: State) -> FloatArray:
        """Return the information rows r that each candidate adds at draw i, (n_candidates, d · modes, p)."""
        b, N = state.lost[i, None], state.size[i, None]
        parts = []
        for t, column in enumerate(self.groups.T):
            phi, j = self.shapes[i, column], self.slopes[i, column]
            total = N + phi**2
            share = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0.0)
            off = j - phi[..., None] * b
            parts.append(off * np.sqrt(N * share)[..., None])
            if t + 1 < self.groups.shape[1]:
                b, N = b + (phi * share)[..., None] * off, total
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)


@dataclass(frozen=True, eq=False)
class State:
    """Information from the sensors placed so far, at each draw. The module docstring defines the symbols.

    Attributes
    ----------
    matrix : ndarray, shape (n, p, p)
        Information matrix A.
    lost : ndarray, shape (n, modes, p)
        The vector b of each mode.
    size : ndarray, shape (n, modes)
        The number N of each mode.
    """

    matrix: FloatArray
    lost: FloatArray
    size: FloatArray

    def with_row(self, phi: FloatArray, j: FloatArray) -> State:
        """Return the information after adding one row of shapes, phi (n, modes), and slopes, j (n, modes, p)."""
        total = self.size + phi**2
        share = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0.0)
        off = j - phi[..., None] * self.lost
        r = off * np.sqrt(self.size * share)[..., None]
        return State(self.matrix + np.swapaxes(r, 1, 2) @ r, self.lost + (phi * share)[..., None] * off, total)

    def covariance(self) -> FloatArray:
        """Return A⁻¹, the covariance of the scaled parameters after the test, shape (n, p, p)."""
        return np.asarray(np.linalg.inv(self.matrix))


def _log_det_of_one_plus(rows: FloatArray) -> FloatArray:
    """Return log det(I + R Rᵀ) for each matrix R (n, k, p), shape (n,), using the smaller of R Rᵀ and RᵀR."""
    n, k, p = rows.shape
    size = min(k, p)
    first = rows if k <= p else np.swapaxes(rows, 1, 2)
    G = np.moveaxis(first @ np.swapaxes(first, 1, 2), 0, 2).copy()
    G[range(size), range(size)] += 1.0
    # elimination in all matrices at once: LAPACK takes several times as long for thousands of small ones
    found = np.zeros(n)
    for i in range(size):
        pivot = G[i, i]
        found += np.log(pivot)
        scaled = G[i + 1 :, i] / pivot
        G[i + 1 :, i + 1 :] -= scaled[:, None] * G[i, i + 1 :][None]
    return found
