"""The complete model discrepancy in the residuals of the modes: variances, loadings and their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.discrepancy.embedded import INDEPENDENT, EmbeddedScatter, Setting
from fmu.posterior.discrepancy.latent import LatentErrors
from fmu.posterior.discrepancy.modes import ModeErrors
from fmu.posterior.errors.base import ErrorTerm
from fmu.posterior.errors.slopes import residuals_of_term
from fmu.types import FloatArray, IntArray, Plain

type Take = Callable[[FloatArray, int], FloatArray]
"""A function that selects the used modes from an array along an axis."""


class Linearised(NamedTuple):
    """Residuals and their derivatives, in m rows. Each row is a mode in a test.

    Attributes
    ----------
    residuals : ndarray, shape (n, m, k)
        All residuals of the mode, one error model after the other.
    slopes : ndarray, shape (n, m, k, p)
        Derivatives with respect to the parameters in the test; p = 0 if the prediction has no derivatives.
    own, common : ndarray, shapes (n, m, k, Q) and (n, m, k, C)
        Derivatives with respect to the mode's Q own errors and the C errors that all modes share (`ModeErrors`).
    """

    residuals: FloatArray
    slopes: FloatArray
    own: FloatArray
    common: FloatArray


class Change(NamedTuple):
    """Derivatives of the rows' log-density, (n, m, …), with respect to the residuals and their slopes.

    Attributes
    ----------
    by_residual, by_slope, by_own, by_common : ndarray
        Shapes as in `Linearised`.
    by_value : ndarray, shape (n, m, p)
        With respect to the parameters, only through the magnitude of their scatter.
    by_noise : ndarray, shape (n, m, n_noise)
        With respect to inferred error sds, only through the magnitude of the discrepancy.
    """

    by_residual: FloatArray
    by_slope: FloatArray
    by_own: FloatArray
    by_common: FloatArray
    by_value: FloatArray
    by_noise: FloatArray

    def of(self, rows: Linearised) -> FloatArray:
        """Return the first-order change in each row's log-density, (n, m), caused by changes of all slopes.

        `rows` contains the changes; its residuals are ignored.
        """
        pairs = ((self.by_slope, rows.slopes), (self.by_own, rows.own), (self.by_common, rows.common))
        found = [np.einsum("nmkp,nmkp->nm", by, x) for by, x in pairs if x.shape[-1]]
        return np.asarray(sum(found, np.zeros(self.by_residual.shape[:2])))


@dataclass(frozen=True, eq=False)
class ModelErrors:
    """The complete model discrepancy: scatter of the model's parameters, and errors of the modes themselves.

    Attributes
    ----------
    scatters : tuple of EmbeddedScatter
        At least one (`EmbeddedScatter.none` if no parameter scatters), all for the same parameters.
    modes : tuple of ModeErrors
    """

    scatters: tuple[EmbeddedScatter, ...]
    modes: tuple[ModeErrors, ...] = ()

    @cached_property
    def scattered(self) -> IntArray:
        """Indices of the parameters that scatter."""
        return np.union1d(self.of_mode, self.in_common)

    @cached_property
    def of_mode(self) -> IntArray:
        """Indices of the E parameters with a part of the scatter that differs from mode to mode."""
        every = [one.scatters & (one.correlation != Setting(1.0)) for one in self.scatters]
        return np.flatnonzero(np.any(every, axis=0))

    @cached_property
    def in_common(self) -> IntArray:
        """Indices of the F parameters with a part of the scatter that is common to all modes."""
        every = [one.scatters & (one.correlation != INDEPENDENT) for one in self.scatters]
        return np.flatnonzero(np.any(every, axis=0))

    @property
    def n_common(self) -> int:
        """Number of errors that all modes share."""
        return len(self.in_common) + sum(one.n_common for one in self.modes)

    def as_list(self) -> list[Plain]:
        """Return the settings as a list of dicts with plain Python types."""
        scatters = [one.as_dict() for one in self.scatters if len(self.scattered)]
        return [*scatters, *(one.as_dict() for one in self.modes)]

    def linearise(
        self, terms: Sequence[ErrorTerm], seen: ModalPrediction, noise: FloatArray, take: Take
    ) -> Linearised:
        """Return the linearised residuals of the error models at a prediction; `take` selects the rows."""
        parts = [residuals_of_term(term, seen, noise, within=True) for term in terms]
        r = np.concatenate([part[0] for part in parts], axis=2)
        J = np.empty((*r.shape, 0)) if np.ndim(parts[0][1]) == 0 else np.concatenate([p[1] for p in parts], axis=2)
        units = [one.units(terms, seen, noise) for one in self.modes] or [(np.empty((*r.shape, 0)),) * 2]
        own, common = (_join([unit[i] for unit in units], 3) for i in (0, 1))
        return Linearised(*(take(x, 1) for x in (r, J, own, common)))

    def change_of_units(
        self, terms: Sequence[ErrorTerm], seen: ModalPrediction, noise: FloatArray, by_own: FloatArray
    ) -> FloatArray:
        """Differentiate a function of the modes' `units` with respect to the parameters.

        Return an array (n, m, p), or the number 0 if `modes` is empty. `by_own` is the function's derivative with
        respect to the units; see `ModeErrors.change_of_units`.
        """
        cuts = np.cumsum([one.n_own for one in self.modes])[:-1]
        parts = np.split(by_own, cuts, axis=3)
        found = [one.change_of_units(terms, seen, noise, of) for one, of in zip(self.modes, parts, strict=False)]
        return np.asarray(sum(found, np.zeros(())))

    def scale(self, values: FloatArray) -> FloatArray:
        """Return the unit s of each parameter's scatter, (…, p), at parameter `values` (…, p)."""
        return self.scatters[0].scale(values)

    def variances(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the variances of a mode's own errors, (n, E + Q), and of the common errors, (n, F + C).

        The scatter of the E and F parameters comes first, with variances in units of s². The Q own and C common
        errors of modes (`ModeErrors`) follow. `noise` has the inferred standard deviations, shape (n, n_noise).
        """
        own, common = _sum_pairs([one.variances(noise) for one in self.scatters])
        parts = [(own[:, self.of_mode], common[:, self.in_common]), *(one.variances(noise) for one in self.modes)]
        return _join([part[0] for part in parts], 1), _join([part[1] for part in parts], 1)

    def log_variance_slopes(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of log `variances` with respect to the inferred error sds.

        Their shapes are (n, n_noise, E + Q) and (n, n_noise, F + C). For parameters that scatter, they are 0 where
        a variance is 0.
        """
        values = _sum_pairs([one.variances(noise) for one in self.scatters])
        slopes = _sum_pairs([one.variance_slopes(noise) for one in self.scatters])
        scatter = [
            slope[..., k] / np.where(value > 0.0, value, 1.0)[:, None, k]
            for value, slope, k in zip(values, slopes, (self.of_mode, self.in_common), strict=True)
        ]
        parts = [scatter, *(one.log_variance_slopes(noise) for one in self.modes)]
        return _join([part[0] for part in parts], 2), _join([part[1] for part in parts], 2)

    def in_hz(
        self, slopes: FloatArray | None, measured: FloatArray, values: FloatArray, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return each frequency's derivatives, in Hz, with respect to the standard normal latent errors.

        Parameters
        ----------
        slopes : ndarray, shape (n, m, p), or None if no parameter scatters
            Derivatives of the frequencies.
        measured : ndarray, shape (m,), Hz
        values : ndarray, shape (n, m, p)
            The parameters in each mode's test.
        noise : ndarray, shape (n, n_noise)

        Returns
        -------
        own, common : ndarray, shapes (n, m, E + Q) and (n, m, F + C)
            With respect to the mode's own errors, and to the errors that all modes share.
        """
        variances, parts = self.variances(noise), (list[FloatArray](), list[FloatArray]())
        if slopes is not None and len(self.scattered):
            units = slopes * self.scale(values)
            parts = [units[..., self.of_mode]], [units[..., self.in_common]]
        for one in self.modes:
            for part, unit in zip(parts, one.in_hz(measured), strict=True):
                part.append(np.broadcast_to(unit, (len(noise), *unit.shape)))
        own, common = (
            np.concatenate(part, axis=2) * np.sqrt(variance)[:, None]
            for part, variance in zip(parts, variances, strict=True)
        )
        return own, common

    def latent(self, rows: Linearised, values: FloatArray, noise: FloatArray, group: IntArray) -> LatentErrors:
        """Build the `LatentErrors` for the residuals in `rows`; `values` (n, m, p) are each row's parameters."""
        loads, shared = (
            unit * np.sqrt(variance)[:, None, None] if unit.shape[-1] else unit
            for unit, variance in zip(self.units(rows, values), self.variances(noise), strict=True)
        )
        return LatentErrors(rows.residuals, loads, shared, group)

    def change(self, rows: Linearised, latent: LatentErrors, values: FloatArray, noise: FloatArray) -> Change:
        """Differentiate the summed terms of `latent`, which must have the same rows as `rows`."""
        found = latent.slopes()
        by_own, by_common = (
            by * np.sqrt(variance)[:, None, None]
            for by, variance in zip((found.by_loads, found.by_common), self.variances(noise), strict=True)
        )
        by_noise = np.zeros((*rows.residuals.shape[:2], noise.shape[1]))
        of_loads = (found.by_loads, latent.loads), (found.by_common, latent.common)
        for (by, loads), slopes in zip(of_loads, self.log_variance_slopes(noise), strict=True):
            if loads.shape[-1]:
                by_noise += 0.5 * np.sum(by * loads, axis=2) @ np.swapaxes(slopes, 1, 2)
        by_slope, by_value = np.zeros((*rows.residuals.shape, values.shape[-1])), np.zeros(values.shape)
        E, F = len(self.of_mode), len(self.in_common)
        if len(self.scattered):
            scale = self.scale(values)[:, :, None]
            by_slope[..., self.of_mode] = by_own[..., :E] * scale[..., self.of_mode]
            if F:
                by_slope[..., self.in_common] += by_common[..., :F] * scale[..., self.in_common]
            by_log = np.sum(by_slope * rows.slopes, axis=2)  # by log s of each parameter
            relative = self.scatters[0].relative
            by_value = np.where(relative, by_log / np.where(relative, values, 1.0), 0.0)
        return Change(found.by_residual, by_slope, by_own[..., E:], by_common[..., F:], by_value, by_noise)

    def units(self, rows: Linearised, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residuals that errors of unit size cause.

        The shapes are (n, m, k, E + Q) for a mode's own errors, and (n, m, k, F + C) for the common errors.
        """
        if not len(self.scattered):
            return rows.own, rows.common
        units = rows.slopes * self.scale(values)[:, :, None]
        return _join([units[..., self.of_mode], rows.own], 3), _join([units[..., self.in_common], rows.common], 3)

    def information(
        self, terms: Sequence[ErrorTerm], latent: LatentErrors, noise: FloatArray, take: Take
    ) -> FloatArray:
        """Return the approximate Fisher information on error sds, τ and correlations, shape (n, n_noise, n_noise).

        The exact information is ½ tr(S⁻¹ ∂S S⁻¹ ∂S), where S = I + FFᵀ is the covariance of the residuals and F
        are the loadings. The products FᵀS⁻¹F = I − Cov and S⁻¹F = F Cov are used, where Cov is the covariance of
        the latent errors given the residuals. Three kinds of terms are neglected: terms that link the measurement
        sds of two rows, the measurement sds and the common errors, or the own errors of two modes. The remaining
        terms with measurement sds are computed with the loadings of the modes' own errors only. The terms with
        measurement sds alone have the weight (q − 1)/q for a shape at q sensors, because the shape's scale is
        free. `take` selects the rows of `latent`.
        """
        E, by_common = self.log_variance_slopes(noise)
        _, _, of_z, of_both, _ = latent.given_residuals()
        last = np.unique(latent.last)
        K = np.sum((np.eye(of_z.shape[-1]) - of_z[:, last]) ** 2, axis=1)
        found = 0.5 * E @ K @ np.swapaxes(E, 1, 2)
        if by_common.shape[2]:
            across = 0.5 * E @ np.sum(of_both[:, last] ** 2, axis=1) @ np.swapaxes(by_common, 1, 2)
            found += 0.5 * by_common @ latent.learnt_of_common() ** 2 @ np.swapaxes(by_common, 1, 2)
            found += across + np.swapaxes(across, 1, 2)
        delta, share = _relative_changes(terms, noise)
        delta = take(delta, 1)
        if np.any(delta):
            A, cov = latent.loads, of_z[:, latent.last]
            inverse = np.eye(A.shape[2]) - A @ cov @ np.swapaxes(A, 2, 3)
            found += 0.5 * np.einsum("nmkd,nmkl,nmle->nde", share[:, None] * delta, inverse**2, delta)
            cross = 0.5 * np.einsum("nmkd,nmkl,nel->nde", delta, (A @ cov) ** 2, E)
            found += cross + np.swapaxes(cross, 1, 2)
        return np.asarray(found)


def _sum_pairs(pairs: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Add pairs of arrays."""
    one, other = pairs[0]
    for more, others in pairs[1:]:
        one, other = one + more, other + others
    return one, other


def _join(parts: Sequence[FloatArray], axis: int) -> FloatArray:
    """Concatenate arrays along an axis. If only one array is not empty, return it without a copy."""
    if len(parts) > 1:
        filled = [part for part in parts if part.shape[axis]]
        return filled[0] if len(filled) == 1 else np.concatenate(parts, axis=axis)
    return parts[0]


def _relative_changes(terms: Sequence[ErrorTerm], noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return relative variance derivatives (∂V/∂noise)/V, (n, m, k, n_noise), and a weight per residual (k,)."""
    parts, shares = [], []
    for term in terms:
        q, V = len(term.labels([""])), term.spread.variance(noise)
        part = np.zeros((len(noise), V.shape[-1], q, noise.shape[1]))
        for d, dV in term.spread.slopes(noise).items():
            part[..., d] = np.swapaxes((dV / V).reshape(len(noise), q, -1), 1, 2)
        parts.append(part)
        shares.append(np.full(q, term.n_data / q))
    return np.concatenate(parts, axis=2), np.concatenate(shares)
