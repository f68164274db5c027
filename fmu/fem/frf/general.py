"""Damping that couples the modes: loss factors for parts of the structure, and dashpots.

The dynamic stiffness is D(ω) = K' + i ω C − ω² M. In the complex symmetric K' = Σ_k (1 + i η_k) c_k K_k, each
stiffness term c_k K_k has a loss factor η_k. The viscous part C = α M + β K + Σ_d c_d C_d contains Rayleigh
damping and the dashpots, each with a coefficient c_d and a matrix C_d. On the reduced basis, the inverse of D is a
sum over the poles s_r of the quadratic eigenproblem (s² M + s C + K') x = 0, which is solved as a linear
eigenproblem of twice the size (Tisseur & Meerbergen 2001, *SIAM Review* 43, 235–286):

    H_jk(ω) = Σ_r x_jr x_kr / (i ω − s_r),      x_rᵀ (2 s_r M + C) x_r = 1.

Here x_jr is the displacement of point j in the eigenvector x_r. The derivatives need only the derivatives of the
matrices: dH_jk = −u_jᵀ dD u_k, where u_k(ω) = D(ω)⁻¹ b_k is the response to a unit force b_k at point k.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmu.fem.frf.proportional import ZERO, Source
from fmu.fem.reduced.basis import ReducedBlock
from fmu.types import ComplexArray, FloatArray, IntArray

_AGREES = 1e-8
"""Relative difference between the sum over poles and a direct solve above which every line is solved directly."""


@dataclass(frozen=True, eq=False)
class GeneralDamping:
    """Damping by loss factors of stiffness terms, dashpots and Rayleigh damping, projected onto a reduced basis.

    Attributes
    ----------
    n_values : int
        Number of damping parameters.
    losses : tuple of Source
        Loss factor of each stiffness term in the reduced block.
    dashpots : ndarray, shape (n_dashpots, r, r)
        Projected matrices C_d.
    viscous : tuple of Source
        The coefficient c_d of each dashpot, N·s/m.
    alpha, beta : Source
        α in 1/s, β in s.
    """

    n_values: int
    losses: tuple[Source, ...]
    dashpots: FloatArray
    viscous: tuple[Source, ...] = ()
    alpha: Source = ZERO
    beta: Source = ZERO


class GeneralResponses:
    """FRFs of a structure with coupled modes; parameters and methods as in `ModalResponses`.

    If the poles at a parameter vector cannot be found accurately, the responses at this parameter vector are
    computed by a direct solve at every line.
    """

    def __init__(
        self,
        block: ReducedBlock,
        damping: GeneralDamping,
        theta: FloatArray,
        values: FloatArray,
        points: FloatArray,
        responses: IntArray,
        drives: IntArray,
    ) -> None:
        self.block, self.damping, self.theta, self.values = block, damping, theta, values
        self._points, self._responses, self._drives = points, responses, drives
        self.K, self.M = block.matrices(theta)
        eta = np.concatenate([source.at(values) for source in damping.losses], axis=1)
        self._parts = block.stiffness_terms(theta)  # (n, n_terms, r, r)
        self.loss = np.einsum("nk,nkij->nij", eta, self._parts)
        self.C = damping.alpha.at(values)[:, :, None] * self.M + damping.beta.at(values)[:, :, None] * self.K
        for source, dashpot in zip(damping.viscous, damping.dashpots, strict=True):
            self.C = self.C + source.at(values)[:, :, None] * dashpot
        self._eta = eta
        self._poles = [
            self._solve(K, C, M) for K, C, M in zip(self.K + 1j * self.loss, self.C, self.M, strict=True)
        ]
        n, r = self.K.shape[:2]
        self._sums = np.zeros((3, n, r, r), dtype=complex)

    @staticmethod
    def _solve(K: ComplexArray, C: FloatArray, M: FloatArray) -> tuple[ComplexArray, ComplexArray] | None:
        """Return the poles (2 r,) and eigenvectors (r, 2 r), or None if they do not reproduce a direct solve.

        Return None also if a matrix is not finite, or the eigenproblem or the direct solve fails.
        """
        r = len(M)
        if not (np.all(np.isfinite(K)) and np.all(np.isfinite(C)) and np.all(np.isfinite(M))):
            return None
        try:
            inverse = np.linalg.inv(M)
            A = np.block([[np.zeros((r, r)), np.eye(r)], [-inverse @ K, -inverse @ C]])
            poles, vectors = np.linalg.eig(A)
            at = 0.7 * float(np.median(np.abs(poles.imag)))
            exact = np.linalg.inv(K + 1j * at * C - at**2 * M)
        except np.linalg.LinAlgError:
            return None
        x = vectors[:r]
        size = np.einsum("ir,ij,jr->r", x, C, x) + 2.0 * poles * np.einsum("ir,ij,jr->r", x, M, x)
        with np.errstate(divide="ignore", invalid="ignore"):
            x = x / np.sqrt(size)
        if not np.all(np.isfinite(x)):
            return None
        found = (x / (1j * at - poles)) @ x.T
        return (poles, x) if np.max(np.abs(found - exact)) <= _AGREES * np.max(np.abs(exact)) else None

    def displacements(self, omega: FloatArray) -> ComplexArray:
        """Return displacements per unit force at each point, in basis coordinates, (n, n_points, r, n_lines).

        If a direct solve fails at one line, the displacements at this parameter vector are NaN at all lines.
        """
        n, r = self.K.shape[:2]
        found = np.empty((n, len(self._points), r, len(omega)), dtype=complex)
        for i, solved in enumerate(self._poles):
            if solved is None:
                D = (self.K[i] + 1j * self.loss[i]) + 1j * omega[:, None, None] * self.C[i]
                D = D - omega[:, None, None] ** 2 * self.M[i]
                try:
                    u = np.linalg.solve(D, np.broadcast_to(self._points.T, (len(omega), r, len(self._points))))
                except np.linalg.LinAlgError:
                    u = np.full((len(omega), r, len(self._points)), np.nan + 0j)
                found[i] = u.transpose(2, 1, 0)
                continue
            poles, x = solved
            resonances = 1.0 / (1j * omega - poles[:, None])
            for q, seen in enumerate(self._points @ x):
                found[i, q] = x @ (seen[:, None] * resonances)
        return found

    def frfs(self, omega: FloatArray) -> ComplexArray:
        """Return the receptances, shape (n, n_frfs, n_lines), at lines ω in rad/s. `add` reuses the solution."""
        self._omega, self._u = omega, self.displacements(omega)
        rows = self._points[self._responses]
        return np.einsum("fr,nfrl->nfl", rows, self._u[:, self._drives])

    def add(self, weights: ComplexArray) -> None:
        """Add the last `frfs` call's contribution to the derivatives of a scalar L; see `ModalResponses.add`."""
        one = np.ones(len(self._omega), dtype=complex)
        for power, factor in enumerate((one, 1j * self._omega, -(self._omega**2) * one)):
            for f, (j, k) in enumerate(zip(self._responses, self._drives, strict=True)):
                left = (weights[:, f] * factor)[:, None] * self._u[:, j]
                self._sums[power] -= left @ np.swapaxes(self._u[:, k], 1, 2)

    def gradient(self) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of L, summed over all calls of `add`; see `ModalResponses.gradient`."""
        damping, (by_K, by_C, by_M) = self.damping, self._sums
        alpha, beta = (source.at(self.values)[:, :, None] for source in (damping.alpha, damping.beta))
        # each stiffness term has its own loss factor
        forms = np.einsum("nij,kij->nk", by_K, self.block.terms[0])
        of_terms = forms.real - self._eta * forms.imag
        found = self.block.pull_back_terms(self.theta, of_terms)
        found = found + self.block.pull_back(self.theta, (beta * by_C).real, (by_M + alpha * by_C).real)
        of_damping = np.zeros(self.values.shape)

        def add_slope(source: Source, value: FloatArray) -> None:
            if source.column is not None:
                of_damping[:, source.column] += value

        of_losses = -np.einsum("nij,nkij->nk", by_K, self._parts).imag
        for k, source in enumerate(damping.losses):
            add_slope(source, of_losses[:, k])
        for k, source in enumerate(damping.viscous):
            add_slope(source, np.einsum("nij,ij->n", by_C.real, damping.dashpots[k]))
        add_slope(damping.alpha, np.einsum("nij,nij->n", by_C.real, self.M))
        add_slope(damping.beta, np.einsum("nij,nij->n", by_C.real, self.K))
        return found, of_damping

    def slopes(self, omega: FloatArray) -> ComplexArray:
        """Return the FRF derivatives ∂H at lines ω, (n, n_frfs, n_lines, p + q); see `ModalResponses.slopes`."""
        u, damping = self.displacements(omega), self.damping
        n, r = self.K.shape[:2]
        p = self.theta.shape[1]
        identity = np.broadcast_to(np.eye(r), (n, r, r))
        dK, dM = self.block.changes(self.theta, identity)
        dT = self.block.stiffness_changes(self.theta, self._eta)
        alpha, beta = (source.at(self.values)[:, None, :, None] for source in (damping.alpha, damping.beta))
        of_K, of_C, of_M = dK + 1j * dT, beta * dK + alpha * dM, dM
        zero = np.zeros((n, damping.n_values, r, r))
        loss, C = zero.astype(complex), zero.copy()
        for k, source in enumerate(damping.losses):
            if source.column is not None:
                loss[:, source.column] += 1j * self._parts[:, k]
        for k, source in enumerate(damping.viscous):
            if source.column is not None:
                C[:, source.column] += damping.dashpots[k]
        for source, matrix in ((damping.alpha, self.M), (damping.beta, self.K)):
            if source.column is not None:
                C[:, source.column] += matrix
        of_K = np.concatenate([of_K, loss], axis=1)
        of_C, of_M = np.concatenate([of_C, C], axis=1), np.concatenate([of_M, zero], axis=1)
        found = np.empty((n, len(self._drives), len(omega), p + damping.n_values), dtype=complex)
        for f, (j, k) in enumerate(zip(self._responses, self._drives, strict=True)):
            x, y = u[:, j], u[:, k]
            for q in range(found.shape[-1]):
                moved = of_K[:, q] @ y + of_C[:, q] @ (1j * omega * y) - of_M[:, q] @ (omega**2 * y)
                found[:, f, :, q] = -np.sum(x * moved, axis=1)
        return found
