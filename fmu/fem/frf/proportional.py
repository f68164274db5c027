"""Damping that does not couple the modes of the undamped structure, with FRFs from one real eigenproblem.

With mass-normalised shapes φ_r and eigenvalues λ_r = ω_r², the receptance between the points j and k is

    H_jk(ω) = Σ_r φ_jr φ_kr g_r(ω),      g_r = 1 / (λ_r − ω² + i (ω c_r + h_r)),

with the viscous part c_r = α + β λ_r + 2 ζ_r ω_r (Rayleigh's α and β, modal ratios ζ_r) and the hysteretic part
h_r = η λ_r (loss factor η of the whole structure); Ewins, *Modal Testing*, 2nd ed. 2000, chapter 2.

Derivatives with respect to K and M need no derivatives of shapes. For symmetric changes dK, dM in modal
coordinates,

    dH_jk = Σ_rs φ_jr φ_ks (f_rs dK_rs − (½ (g_r + g_s) + ½ (λ_r + λ_s) f_rs) dM_rs),

with the divided difference f_rs = (g_r − g_s)/(λ_r − λ_s) = −g_r g_s (1 + i ω C_rs + i E_rs), where C_rs and E_rs
are the divided differences of c and h (Daleckii & Krein 1965). The product stays finite where eigenvalues
coincide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fmu.fem.reduced.basis import ReducedBlock
from fmu.types import ComplexArray, FloatArray, IntArray

CLOSE = 1e-4
"""Difference between two eigenvalues, relative to their sum, below which divided differences are computed as
products."""


class Source(NamedTuple):
    """A damping coefficient: a constant, or one of the damping parameters.

    Attributes
    ----------
    value : float
        The constant; ignored if the coefficient is a parameter.
    column : int or None
        Index of the parameter among the damping parameters, or None if the coefficient is a constant.
    """

    value: float
    column: int | None = None

    def at(self, values: FloatArray) -> FloatArray:
        """Return the coefficient, shape (n, 1), for damping parameters (n, q)."""
        if self.column is None:
            return np.full((len(values), 1), self.value)
        return values[:, self.column : self.column + 1]


ZERO = Source(0.0)


class Rates(NamedTuple):
    """Damping of each mode, and its derivatives with respect to the mode's eigenvalue.

    Attributes
    ----------
    viscous, hysteretic : ndarray, shape (n, r)
        c_r in rad/s and h_r in (rad/s)².
    viscous_slope, hysteretic_slope : ndarray, shape (n, r)
        ∂c_r/∂λ_r and ∂h_r/∂λ_r.
    """

    viscous: FloatArray
    hysteretic: FloatArray
    viscous_slope: FloatArray
    hysteretic_slope: FloatArray


@dataclass(frozen=True)
class ProportionalDamping:
    """Modal damping c_r = α + β λ_r + 2 ζ_r ω_r and h_r = η λ_r.

    Attributes
    ----------
    n_values : int
        Number of damping parameters.
    alpha, beta, loss : Source
        α in 1/s, β in s, and the loss factor η.
    ratios : tuple of Source
        Damping ratios of the elastic modes in ascending order; the last ratio applies to all higher modes too.
        Empty if there are none.
    n_rigid : int
        Number of rigid-body modes. They precede the elastic modes, and no ratio damps them.
    """

    n_values: int
    alpha: Source = ZERO
    beta: Source = ZERO
    loss: Source = ZERO
    ratios: tuple[Source, ...] = ()
    n_rigid: int = 0

    def _ratio_of(self, r: int) -> IntArray:
        """Return, for each of the r modes, the index in `ratios` of its damping ratio, shape (r,).

        Rigid-body modes have the first ratio, which has no effect because their ω is 0. All indices are −1 if
        there are no ratios.
        """
        return np.clip(np.arange(r) - self.n_rigid, 0, len(self.ratios) - 1)

    def _zeta(self, values: FloatArray, r: int) -> FloatArray:
        if not self.ratios:
            return np.zeros((len(values), r))
        return np.concatenate([source.at(values) for source in self.ratios], axis=1)[:, self._ratio_of(r)]

    def rates(self, lam: FloatArray, values: FloatArray) -> Rates:
        """Return the modal damping for ascending eigenvalues `lam` (n, r) and damping parameters (n, q)."""
        omega, zeta = np.sqrt(np.maximum(lam, 0.0)), self._zeta(values, lam.shape[1])
        beta, loss = self.beta.at(values), self.loss.at(values)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_ratio = np.where(omega > 0.0, zeta / omega, 0.0)
        return Rates(
            self.alpha.at(values) + beta * lam + 2.0 * zeta * omega,
            loss * lam,
            beta + by_ratio,
            loss + np.zeros_like(lam),
        )

    def pull_back(
        self, lam: FloatArray, values: FloatArray, viscous: FloatArray, hysteretic: FloatArray
    ) -> FloatArray:
        """Return the derivatives of a scalar with respect to the damping parameters, (n, q), by the chain rule.

        `viscous` and `hysteretic`, shape (n, r), are its derivatives with respect to c_r and h_r.
        """
        found = np.zeros(values.shape)
        omega = np.sqrt(np.maximum(lam, 0.0))
        for source, part in (
            (self.alpha, viscous),
            (self.beta, viscous * lam),
            (self.loss, hysteretic * lam),
        ):
            if source.column is not None:
                found[:, source.column] += np.sum(part, axis=1)
        of = self._ratio_of(lam.shape[1])
        for k, source in enumerate(self.ratios):
            if source.column is not None:
                found[:, source.column] += np.sum((2.0 * viscous * omega)[:, of == k], axis=1)
        return found

    def slopes(self, lam: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of c_r and h_r with respect to the damping parameters, (n, r, q) each."""
        n, r = lam.shape
        viscous, hysteretic = np.zeros((n, r, self.n_values)), np.zeros((n, r, self.n_values))
        omega = np.sqrt(np.maximum(lam, 0.0))
        for source, into, part in (
            (self.alpha, viscous, np.ones_like(lam)),
            (self.beta, viscous, lam),
            (self.loss, hysteretic, lam),
        ):
            if source.column is not None:
                into[:, :, source.column] += part
        of = self._ratio_of(r)
        for k, source in enumerate(self.ratios):
            if source.column is not None:
                viscous[:, of == k, source.column] += 2.0 * omega[:, of == k]
        return viscous, hysteretic

    def differences(self, lam: FloatArray, values: FloatArray, rates: Rates) -> tuple[FloatArray, FloatArray]:
        """Return the divided differences C_rs of c and E_rs of h between all modes, each of shape (n, r, r).

        For two modes with the same ratio, C is exact even if their eigenvalues are almost equal. For two modes
        with different ratios, the divided difference does not exist if the eigenvalues are equal. For equal or
        almost equal eigenvalues, the mean of the two ratios is therefore used for both modes.
        """
        omega, zeta = np.sqrt(np.maximum(lam, 0.0)), self._zeta(values, lam.shape[1])
        total = omega[:, :, None] + omega[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            by_omega = np.where(total > 0.0, 1.0 / total, 0.0)
        mean = 0.5 * (zeta[:, :, None] + zeta[:, None])
        viscous = self.beta.at(values)[:, :, None] + 2.0 * mean * by_omega
        gap, unequal = lam[:, :, None] - lam[:, None], zeta[:, :, None] - zeta[:, None]
        apart = (np.abs(gap) > CLOSE**2 * (lam[:, :, None] + lam[:, None])) & (unequal != 0.0)
        # 2 (ζ_r ω_r − ζ_s ω_s) = 2 ζ̄ (ω_r − ω_s) + (ω_r + ω_s) (ζ_r − ζ_s)
        viscous += np.divide(unequal * total, gap, out=np.zeros_like(gap), where=apart)
        return viscous, np.broadcast_to(self.loss.at(values)[:, :, None], gap.shape)


class ModalResponses:
    """FRFs and their derivatives from one reduced block of a structure, at n parameter vectors.

    Parameters
    ----------
    block : ReducedBlock
    damping : ProportionalDamping
    theta, values : ndarray, shape (n, p) and (n, q)
        Structural and damping parameters.
    points : ndarray, shape (n_points, r)
        Drive and response points projected onto the basis, one row per point.
    responses, drives : ndarray of int, shape (n_frfs,)
        Points of each FRF, as rows of `points`.
    """

    def __init__(
        self,
        block: ReducedBlock,
        damping: ProportionalDamping,
        theta: FloatArray,
        values: FloatArray,
        points: FloatArray,
        responses: IntArray,
        drives: IntArray,
    ) -> None:
        self.block, self.damping, self.theta, self.values = block, damping, theta, values
        self.lam, self.phi = lam, phi = block.modes(theta, block.size)
        self.rates = damping.rates(lam, values)
        self._seen = points @ phi  # (n, n_points, r)
        self._at = self._seen[:, responses], self._seen[:, drives]
        self.amplitudes = self._at[0] * self._at[1]  # (n, f, r)
        n, f, r = self.amplitudes.shape
        # Re Σ w g, Re Σ w g², Im Σ w g² and Re Σ iω w g² over the lines
        self._sums = np.zeros((4, n, f, r))
        self._pairs = self._close_pairs()
        self._of_pairs = np.zeros((len(self._pairs[0]), f))

    def _close_pairs(self) -> tuple[IntArray, IntArray, IntArray]:
        gap = np.abs(self.lam[:, :, None] - self.lam[:, None])
        size = np.abs(self.lam[:, :, None]) + np.abs(self.lam[:, None])
        i, r, s = np.nonzero(np.triu(gap <= CLOSE * size, 1))
        return i, r, s

    def _resonances(self, omega: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the real and imaginary parts of the resonance factors g_r(ω), shape (n, r, n_lines) each."""
        # in place: at many lines the time goes into memory, not into arithmetic
        stiff = self.lam[:, :, None] - omega**2
        lossy = self.rates.viscous[:, :, None] * omega
        lossy += self.rates.hysteretic[:, :, None]
        size = stiff * stiff
        size += lossy * lossy
        stiff /= size
        lossy /= size
        return stiff, np.negative(lossy, out=lossy)

    def frfs(self, omega: FloatArray) -> ComplexArray:
        """Return the receptances, shape (n, n_frfs, n_lines), at lines ω in rad/s. `add` reuses the solution."""
        self._omega, self._g = omega, self._resonances(omega)
        found = np.empty((*self.amplitudes.shape[:2], len(omega)), dtype=complex)
        found.real, found.imag = (self.amplitudes @ part for part in self._g)
        return found

    def displacements(self, omega: FloatArray) -> ComplexArray:
        """Return displacements per unit force at each point, in basis coordinates, (n, n_points, r, n_lines)."""
        x, y = self._resonances(omega)
        return np.asarray(self.phi[:, None] @ (self._seen[..., None] * (x + 1j * y)[:, None]))

    def add(self, weights: ComplexArray) -> None:
        """Add the contribution of the lines in the last `frfs` call to the derivatives of a scalar function L.

        The weights w = ∂L/∂Re H − i ∂L/∂Im H have shape (n, n_frfs, n_lines), so that dL = Re Σ w dH.
        """
        u, v = np.ascontiguousarray(weights.real), np.ascontiguousarray(weights.imag)
        x, y = self._g
        real, imaginary = np.swapaxes(x * x - y * y, 1, 2), np.swapaxes(2.0 * x * y, 1, 2)
        self._sums[0] += u @ np.swapaxes(x, 1, 2) - v @ np.swapaxes(y, 1, 2)
        self._sums[1] += u @ real - v @ imaginary
        self._sums[2] += u @ imaginary + v @ real
        self._sums[3] -= (self._omega * u) @ imaginary + (self._omega * v) @ real
        if len(self._pairs[0]):
            i, r, s = self._pairs
            C, E = self._differences
            g = x + 1j * y
            both = g[i, r] * g[i, s] * (1.0 + 1j * (self._omega * C[i, r, s, None] + E[i, r, s, None]))
            self._of_pairs -= np.einsum("pfl,pl->pf", weights[i], both).real

    @property
    def _differences(self) -> tuple[FloatArray, FloatArray]:
        return self.damping.differences(self.lam, self.values, self.rates)

    def gradient(self) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of L with respect to the parameters, for all lines added so far by `add`.

        The first array, (n, p), is for the structural parameters. The second, (n, q), is for the damping
        parameters.
        """
        T, square, turned, of_viscous = self._sums
        A = self.amplitudes
        viscous = -np.sum(A * of_viscous, axis=1)
        hysteretic = np.sum(A * turned, axis=1)  # −Re(i x) = Im x
        of_value = (
            -np.sum(A * square, axis=1)
            + self.rates.viscous_slope * viscous
            + self.rates.hysteretic_slope * hysteretic
        )
        at, to = self._at
        lam = self.lam
        gap = lam[:, :, None] - lam[:, None]
        i, r, s = self._pairs
        gap[i, r, s] = gap[i, s, r] = 1.0
        k = np.arange(lam.shape[1])
        gap[:, k, k] = 1.0
        of_r, of_s = self._split(at, to, T)
        F = (of_r - of_s) / gap
        F[:, k, k] = of_value
        if len(i):
            product = 0.5 * (at[i, :, r] * to[i, :, s] + at[i, :, s] * to[i, :, r])
            F[i, r, s] = F[i, s, r] = np.sum(product * self._of_pairs, axis=1)
        M = -(0.5 * (of_r + of_s) + 0.5 * (lam[:, :, None] + lam[:, None]) * F)
        by_K, by_M = (self.phi @ part @ np.swapaxes(self.phi, 1, 2) for part in (F, M))
        of_damping = self.damping.pull_back(lam, self.values, viscous, hysteretic)
        return self.block.pull_back(self.theta, by_K, by_M), of_damping

    @staticmethod
    def _split(at: FloatArray, to: FloatArray, T: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return Σ_f ½ (φ_jr φ_ks + φ_kr φ_js) T_fr over all FRFs f, and its transpose, each of shape (n, r, s).

        `at` and `to` are the shapes φ at the two points j and k of each FRF.
        """
        one = 0.5 * (np.swapaxes(at * T, 1, 2) @ to + np.swapaxes(to * T, 1, 2) @ at)
        return one, np.swapaxes(one, 1, 2)

    def slopes(self, omega: FloatArray) -> ComplexArray:
        """Return the FRF derivatives ∂H at lines ω in rad/s, shape (n, n_frfs, n_lines, p + q).

        The derivatives are with respect to the p structural parameters, and then the q damping parameters.
        """
        x, y = self._resonances(omega)
        g = x + 1j * y
        dK, dM = self.block.changes(self.theta, self.phi)
        C, E = self._differences
        at, to = self._at
        lam = self.lam
        mean = 0.5 * (lam[:, :, None] + lam[:, None])
        D = dK - mean[:, None] * dM
        n, p = D.shape[:2]
        found = np.empty((n, at.shape[1], len(omega), p + self.damping.n_values), dtype=complex)
        for f in range(at.shape[1]):
            x, y = at[:, f, :, None] * g, to[:, f, :, None] * g
            left, right = at[:, f, :, None], to[:, f, :, None]
            for j in range(p):
                plain, viscous, hysteretic = D[:, j], D[:, j] * C, D[:, j] * E
                sum_ = (plain + 1j * hysteretic) @ y + (1j * viscous) @ (omega * y)
                total = -np.sum(x * sum_, axis=1)
                total -= 0.5 * np.sum(x * (dM[:, j] @ right) + (dM[:, j] @ left) * y, axis=1)
                found[:, f, :, j] = total
        if self.damping.n_values:
            viscous, hysteretic = self.damping.slopes(lam, self.values)
            squared = self.amplitudes[..., None] * (g**2)[:, None]  # (n, f, r, l)
            found[..., p:] = -1j * (
                np.einsum("nfrl,nrq->nflq", squared * omega, viscous)
                + np.einsum("nfrl,nrq->nflq", squared, hysteretic)
            )
        return found
