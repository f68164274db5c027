"""The errors of a model in the residuals of its modes: their size, and derivatives with respect to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.discrepancy.embedded import EmbeddedScatter
from fmu.posterior.discrepancy.latent import LatentErrors
from fmu.posterior.errors.base import ErrorTerm
from fmu.posterior.errors.slopes import residuals_of_term
from fmu.types import FloatArray, IntArray

type Take = Callable[[FloatArray, int], FloatArray]
"""A function that picks the rows of some modes from an array along an axis."""


class Linearised(NamedTuple):
    """The residuals of m rows, each a mode in a test, and what they are linear in.

    Attributes
    ----------
    residuals : ndarray, shape (n, m, k)
        All residuals of the mode, of one error model after the other.
    slopes : ndarray, shape (n, m, k, p)
        Derivatives by the parameters of the test.
    """

    residuals: FloatArray
    slopes: FloatArray

    @classmethod
    def of(
        cls,
        terms: Sequence[ErrorTerm],
        seen: ModalPrediction,
        noise: FloatArray,
        take: Take,
    ) -> Linearised:
        """Return the residuals of error models at a prediction."""
        parts = [residuals_of_term(term, seen, noise, within=True) for term in terms]
        r, J = parts[0] if len(parts) == 1 else (np.concatenate(x, axis=2) for x in zip(*parts, strict=True))
        return cls(take(r, 1), take(J, 1))


class Change(NamedTuple):
    """Derivatives of the log-density of rows, (n, m, …), where the residuals and their slopes change.

    Attributes
    ----------
    by_residual : ndarray, shape (n, m, k)
    by_slope : ndarray, shape (n, m, k, p)
    by_value : ndarray, shape (n, m, p)
        By the parameters, through the size of their scatter alone.
    by_noise : ndarray, shape (n, m, n_noise)
        By inferred standard deviations, through the size of the model's errors alone.
    """

    by_residual: FloatArray
    by_slope: FloatArray
    by_value: FloatArray
    by_noise: FloatArray

    def of(self, rows: Linearised) -> FloatArray:
        """Return Σ by_slope · slopes of each row, (n, m)."""
        return np.einsum("nmkp,nmkp->nm", self.by_slope, rows.slopes)


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """All errors of a model: the scatter of its parameters.

    Attributes
    ----------
    scatters : tuple of EmbeddedScatter
        At least one.
    """

    scatters: tuple[EmbeddedScatter, ...]

    @property
    def scattered(self) -> IntArray:
        """Indices of the parameters that scatter."""
        every = [(one.fixed > 0.0) | (one.number >= 0) for one in self.scatters]
        return np.flatnonzero(np.any(every, axis=0))

    def scale(self, values: FloatArray) -> FloatArray:
        """Return the unit s of the scatter of each parameter at values (…, p), of the same shape."""
        return self.scatters[0].scale(values)

    def variances(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return τ² of the parameters, (n, p), and its derivatives by noise, (n, n_noise, p)."""
        value, slopes = zip(*(one.variances(noise) for one in self.scatters), strict=True)
        return np.asarray(sum(value)), np.asarray(sum(slopes))

    def sizes(self, values: FloatArray, noise: FloatArray) -> FloatArray:
        """Return the standard deviations s τ of the parameters, (n, m, p), at values (n, m, p)."""
        return np.asarray(self.scale(values) * np.sqrt(self.variances(noise)[0])[:, None])

    def loads(self, slopes: FloatArray, values: FloatArray, noise: FloatArray) -> FloatArray:
        """Return A, (n, m, k, P), of the quantities whose slopes by the parameters are (n, m, k, p)."""
        T = self.sizes(values, noise)[:, :, None]
        return np.asarray(slopes[..., self.scattered] * T[..., self.scattered])

    def latent(self, rows: Linearised, values: FloatArray, noise: FloatArray, group: IntArray) -> LatentErrors:
        """Return the density of the residuals; values (n, m, p) are the parameters in the test of each row."""
        loads = self.loads(rows.slopes, values, noise)
        return LatentErrors(rows.residuals, loads, np.empty((*rows.residuals.shape, 0)), group)

    def change(self, rows: Linearised, latent: LatentErrors, values: FloatArray, noise: FloatArray) -> Change:
        """Return the derivatives of the sum of the terms of `latent`, which is of these rows."""
        found = latent.slopes()
        by_slope = np.zeros(rows.slopes.shape)
        T = self.sizes(values, noise)[:, :, None]
        by_slope[..., self.scattered] = found.by_loads * T[..., self.scattered]
        by_log = np.sum(by_slope * rows.slopes, axis=2)  # by log s and by log τ of each parameter
        relative = self.scatters[0].relative
        by_value = np.where(relative, by_log / np.where(relative, values, 1.0), 0.0)
        by_noise = np.einsum("nml,ndl->nmd", by_log, 0.5 * self._relative_slopes(noise))
        return Change(found.by_residual, by_slope, by_value, by_noise)

    def information(
        self, terms: Sequence[ErrorTerm], latent: LatentErrors, noise: FloatArray, take: Take
    ) -> FloatArray:
        """Return Fisher's information on standard deviations and τ, shape (n, n_noise, n_noise).

        It is ½ tr(S⁻¹ ∂S S⁻¹ ∂S), in which AᵀS⁻¹A = I − Cov and S⁻¹A = A Cov with the covariance Cov of z. What
        the same mode in another test tells about standard deviations is neglected, and of q sensors each counts
        by the part (q − 1)/q that is independent of the scale of a shape. `take` picks the rows of `latent`.
        """
        of_z = latent.given_residuals()[2]
        E = self._relative_slopes(noise)[..., self.scattered]
        K = np.eye(of_z.shape[-1]) - of_z[:, np.unique(latent.last)]
        found = 0.5 * E @ np.sum(K**2, axis=1) @ np.swapaxes(E, 1, 2)
        delta, share = _relative_changes(terms, noise)
        delta = take(delta, 1)
        if np.any(delta):
            A, cov = latent.loads, of_z[:, latent.last]
            inverse = np.eye(A.shape[2]) - A @ cov @ np.swapaxes(A, 2, 3)
            found += 0.5 * np.einsum("nmkd,nmkl,nmle->nde", share[:, None] * delta, inverse**2, delta)
            cross = 0.5 * np.einsum("nmkd,nmkl,nel->nde", delta, (A @ cov) ** 2, E)
            found += cross + np.swapaxes(cross, 1, 2)
        return np.asarray(found)

    def _relative_slopes(self, noise: FloatArray) -> FloatArray:
        """Return the derivatives of log τ² by the inferred standard deviations, (n, n_noise, p)."""
        value, slopes = self.variances(noise)
        return slopes / np.where(value > 0.0, value, 1.0)[:, None]


def _relative_changes(terms: Sequence[ErrorTerm], noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ∂V/∂noise / V of all residuals of the modes, (n, m, k, n_noise), and the share (k,) of each."""
    parts, shares = [], []
    for term in terms:
        q, V = len(term.labels([""])), term.spread.variance(noise)
        part = np.zeros((len(noise), V.shape[-1], q, noise.shape[1]))
        for d, dV in term.spread.slopes(noise).items():
            part[..., d] = np.swapaxes((dV / V).reshape(len(noise), q, -1), 1, 2)
        parts.append(part)
        shares.append(np.full(q, term.n_data / q))
    return np.concatenate(parts, axis=2), np.concatenate(shares)
