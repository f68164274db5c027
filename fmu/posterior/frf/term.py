"""Log-density of measured frequency response functions, its gradient and its information."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import replace

import numpy as np

from fmu.engines.blas import single_thread
from fmu.fem.frf.general import GeneralResponses
from fmu.fem.frf.model import FRFModel
from fmu.fem.frf.proportional import ModalResponses
from fmu.posterior.data.frf.student import squared_scores
from fmu.posterior.data.frf_data import FRFData
from fmu.posterior.frf.channels import Channels
from fmu.posterior.frf.misfit import Gains, Misfit, densities, slope_by_freedom, square
from fmu.posterior.frf.window import PER_LINE, Window
from fmu.posterior.parameters import Parameter
from fmu.progress.phases import count_solves
from fmu.types import BoolArray, ComplexArray, FloatArray, Plain

_LINES = 512
"""Number of lines in a block; fixed, so that no bit of a result depends on the size of a batch."""
_MOST_NUMBERS = 2**17
"""Largest number of array elements per block of lines, so that they stay in the processor's cache."""
GAUSSIAN = 500.0
"""Degrees of freedom from which Student's t distribution is replaced by the Gaussian."""
_LOG_2PI = float(np.log(2.0 * np.pi))


class FRFTerm:
    """Measured FRFs bound to a structure.

    Here theta consists of the term's own parameters: the structural parameters, followed by `inferred`.

    Attributes
    ----------
    data : FRFData
    model : FRFModel
    channels : Channels
    inferred : tuple of Parameter
        Inferred damping and channel parameters, and the relative model error if it is inferred.
    n_data : int
        Number of measured real numbers that are used.
    is_log : bool
        Whether the errors are in log H.

    Parameters
    ----------
    model_sd : float or None
        The relative model error σ; None if it is inferred.
    settings, of_test, per_line : dict, str and int
        The result of `as_dict`; the prefix of FRF names (the test's name and a colon, or empty); see `Window`.
    """

    has_discrepancy = False  # in the modes

    def __init__(
        self,
        data: FRFData,
        model: FRFModel,
        channels: Channels,
        inferred: tuple[Parameter, ...],
        is_log: bool,
        model_sd: float | None,
        settings: dict[str, Plain],
        of_test: str = "",
        per_line: int = PER_LINE,
    ) -> None:
        self.data, self.model, self.channels, self.inferred = data, model, channels, inferred
        self.is_log, self._model_sd, self._settings, self.of_test = is_log, model_sd, settings, of_test
        lines = data.used.any(axis=0)
        self.omega = 2.0 * np.pi * np.asarray(data.frequencies_hz)[lines]
        self.window = Window(self.omega, data.power, data.window, per_line)
        self._power = (1j * self.omega) ** data.power
        self._used = data.used[:, lines]
        # everything is computed for receptances; the density is that of the data in their own units
        measured, sd = data.as_receptance()
        self._measured = np.where(self._used, measured[:, lines], 1.0)
        self._variance = np.where(self._used, 0.0 if sd is None else sd[:, lines] ** 2, 1.0)
        units = np.log(np.abs(self._power))
        if self.is_log:
            self._variance = np.where(self._used, self._variance / np.abs(self._measured) ** 2, 1.0)
            units = units + np.log(np.abs(self._measured))
        self._constant = -float(np.sum(np.where(self._used, 2.0 * units + _LOG_2PI, 0.0)))
        with np.errstate(divide="ignore"):
            self._log_variance = np.log(self._variance)
        self._log_measured = np.log(self._measured)
        self.freedom = data.freedom if data.freedom < GAUSSIAN else np.inf
        if np.isfinite(self.freedom):  # the normaliser of Student's t density
            self._constant += int(np.sum(self._used)) * float(np.log1p(-2.0 / self.freedom))
        self.n_data = 2 * int(np.sum(self._used))
        self._first, self._wider = model.full.n_parameters, 0.0
        self._sd_column = self._first + len(inferred) - 1 if model_sd is None else None

    def widen(self, relative: float) -> FRFTerm:
        """Return the same term with an additional relative model error, for a search far from the maximum."""
        other = copy(self)
        other._wider = relative
        return other

    @property
    def roles(self) -> tuple[str, ...]:
        """Description in words of each parameter in `inferred`."""
        of_channels = ("channel",) * len(self.channels.parameters)
        of_model = ("error of the model",) * (self._model_sd is None)
        return ("damping",) * self.model.n_values + of_channels + of_model

    @property
    def relative_noise(self) -> float:
        """Median over the used values of the data's standard deviation divided by the measured |H|."""
        size = 1.0 if self.is_log else np.abs(self._measured)
        return float(np.median((np.sqrt(self._variance) / size)[self._used]))

    @property
    def _has_model_error(self) -> bool:
        return self._sd_column is not None or bool(self._model_sd)

    @property
    def _has_fixed_variance(self) -> bool:
        return not self._wider and not self._has_model_error

    def frfs(self, theta: FloatArray) -> ComplexArray:
        """Return the FRFs with inferred channel errors, (n, n_frfs, n_lines), SI units, at the lines in use."""
        with single_thread():
            parts = [
                self._predict(self._solve(theta[rows]), theta[rows], slice(None)) * self._power
                for rows in self._rows(len(theta), len(self.omega))
            ]
        return np.concatenate(parts) if parts else np.empty((0, *self._used.shape), dtype=complex)

    def drawn_frfs(self, every: FRFTerm, theta: FloatArray, rng: np.random.Generator) -> ComplexArray:
        """Return the FRFs, (n, n_frfs, n_lines), at the lines of the term `every`; a subclass adds errors."""
        return every.frfs(theta)

    def split(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Split theta (n, ndim) into structural parameters (n, p) and damping parameters (n, q)."""
        return theta[:, : self.model.full.n_parameters], theta[:, self._first : self._first + self.model.n_values]

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-density of the data, shape (n,), at theta (n, ndim)."""
        count_solves(len(theta))
        return self._evaluate(theta, False)[0]

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density (n,) and its gradient (n, ndim) at theta (n, ndim)."""
        count_solves(len(theta), with_gradients=True)
        return self._evaluate(theta, gradient=True)

    def with_use(self, use: BoolArray) -> FRFTerm:
        """Return the same term for the measured values at which `use`, (n_frfs, n_lines), is True."""
        data, own = replace(self.data, use=use, band=None), (self.is_log, self._model_sd, self._settings)
        return FRFTerm(data, self.model, self.channels, self.inferred, *own, self.of_test, self.window.per_line)

    def squares(self, theta: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return each FRF's sum of squared residuals over its used lines, (n, n_frfs), at theta (n, ndim).

        If the model is correct, the sum is chi-square distributed with two degrees of freedom per line. Gain
        errors that are integrated out are drawn. An error with Student's t distribution is replaced by its normal
        score.
        """
        solved = self._solve(theta)
        found = self._integrate_gains(theta, solved)
        drawn = found.best + rng.standard_normal(found.best.shape) / np.sqrt(found.precision)
        gain, total = drawn[:, self.channels.of_frf, None], np.zeros((len(theta), len(self._used)))
        for lines in self._blocks():
            H = self._predict(solved, theta, lines)
            V = self._variances(H, theta, lines)[0]
            squares = squared_scores(square(self._error(H, lines, gain)) / V, self._freedoms(V, lines))
            total += np.sum(np.where(self._used[:, lines], squares, 0.0), axis=2)
        return total

    def error_sd(self, frfs: ComplexArray, theta: FloatArray) -> FloatArray:
        """Return the sds (scales for Student's t) of errors in H or log H, (n, n_frfs, n_lines), at given FRFs."""
        sd = np.sqrt(self._variances(frfs / self._power, theta, slice(None))[0])
        return np.broadcast_to(sd if self.is_log else sd * np.abs(self._power), frfs.shape)

    def freedoms(self, frfs: ComplexArray, theta: FloatArray) -> FloatArray:
        """Return the degrees of freedom, (n, n_frfs, n_lines), of `error_sd` at given FRFs."""
        V = self._variances(frfs / self._power, theta, slice(None))[0]
        return np.broadcast_to(self._freedoms(V, slice(None)), frfs.shape)

    def distance(self, frfs: ComplexArray, theta: FloatArray) -> ComplexArray:
        """Return measured minus computed FRFs (or their logarithms), in units of `error_sd` and with its shape."""
        measured = self._measured * self._power
        error = measured - frfs
        if self.is_log:
            error = np.log(np.abs(measured / frfs)) + 1j * np.angle(measured / frfs)
        return np.asarray(error / self.error_sd(frfs, theta))

    def simulate(
        self, frfs: ComplexArray, theta: FloatArray, rng: np.random.Generator, gain: FloatArray | None = None
    ) -> ComplexArray:
        """Return simulated measurements, (n, n_frfs, n_lines), of the computed `frfs` at theta (n, ndim).

        Integrated gain errors are taken from `gain` (n, n_channels) or, if it is None, drawn from their prior.
        """
        noise = rng.standard_normal(frfs.shape) + 1j * rng.standard_normal(frfs.shape)
        error = self.error_sd(frfs, theta) * noise
        if np.isfinite(self.freedom):
            error *= np.sqrt((m := self.freedoms(frfs, theta)) / rng.chisquare(m))
        if gain is None:
            gain = self.channels.gain_sd * rng.standard_normal((len(frfs), len(self.channels.names)))
        seen = self.through_channels(frfs, gain)
        return seen * np.exp(error) if self.is_log else seen + error

    def through_channels(self, frfs: ComplexArray, gain: FloatArray) -> ComplexArray:
        """Apply the channels' gain errors (n, n_channels) to computed FRFs (n, n_frfs, n_lines)."""
        of_frf = gain[:, self.channels.of_frf, None]
        return np.asarray(frfs * (np.exp(of_frf) if self.is_log else 1.0 + of_frf))

    def gains(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and sd, (n, n_channels), of the integrated-out gain errors given the data; 0 for others."""
        found = self._integrate_gains(theta, self._solve(theta))
        return found.best, 1.0 / np.sqrt(found.precision)

    def _rows(self, n: int, lines: int = _LINES) -> list[slice]:
        f, r = self._used.shape[0], self.model.block.size
        at_once = max(1, _MOST_NUMBERS // (self.window.cost(min(lines, len(self.omega))) * (r + 4 * f)))
        return [slice(i, min(i + at_once, n)) for i in range(0, n, at_once)]

    def _blocks(self) -> Iterator[slice]:
        for i in range(0, len(self.omega), _LINES):
            yield slice(i, min(i + _LINES, len(self.omega)))

    def _solve(self, theta: FloatArray) -> ModalResponses | GeneralResponses:
        return self.model.at(*self.split(theta))

    def _predict(self, solved: ModalResponses | GeneralResponses, theta: FloatArray, lines: slice) -> ComplexArray:
        """Return the computed receptances with the inferred channel errors, (n, n_frfs, n_lines)."""
        return self.channels.multiply(self.window.frfs(solved, lines), theta, self.omega[lines])

    def _sd(self, theta: FloatArray) -> FloatArray:
        """Return the relative model error σ, shape (n, 1, 1), known or inferred."""
        if self._model_sd is None:
            return theta[:, self._sd_column, None, None]
        return np.full((len(theta), 1, 1), self._model_sd)

    def _variances(self, H: ComplexArray, theta: FloatArray, lines: slice) -> tuple[FloatArray, FloatArray]:
        """Return the error variances V and their logarithms, (n, n_frfs, n_lines) or (n_frfs, n_lines)."""
        if self._has_fixed_variance:
            return self._variance[:, lines], self._log_variance[:, lines]
        size = np.ones(1) if self.is_log else square(H)
        V = self._variance[:, lines] + (self._sd(theta) ** 2 + self._wider**2) * size
        return V, np.log(V)

    def _freedoms(self, V: FloatArray, lines: slice) -> FloatArray:
        """Return the degrees of freedom m = ν (V/s²)² of the variances V, with their shape; ν if σ is 0.

        s² has ν degrees of freedom and σ² |H|² is given (Satterthwaite 1946, Biometrics Bulletin 2, 110).
        """
        if np.isinf(self.freedom) or not self._has_model_error:
            return np.asarray(self.freedom)
        return np.asarray(self.freedom * (V / self._variance[:, lines]) ** 2)

    def _error(self, H: ComplexArray, lines: slice, gain: FloatArray) -> ComplexArray:
        """Return the errors in H or in log H, given the gain errors (n, n_frfs, 1)."""
        if not self.is_log:
            return np.asarray(self._measured[:, lines] - (H if self._has_known_gains else (1.0 + gain) * H))
        e = self._log_measured[:, lines] - np.log(H) - gain
        e.imag -= 2.0 * np.pi * np.round(e.imag / (2.0 * np.pi))
        return np.asarray(e)

    @property
    def _has_known_gains(self) -> bool:
        return not np.any(self.channels.gain_sd)

    def _misfit(
        self,
        H: ComplexArray,
        theta: FloatArray,
        lines: slice,
        gain: FloatArray,
        precision: FloatArray,
        slopes: bool,
    ) -> Misfit:
        """Return the log-densities for a block of lines, given gain errors and precisions, (n, n_frfs, 1)."""
        used = self._used[:, lines]
        V, log_V = self._variances(H, theta, lines)
        e = self._error(H, lines, gain)
        a, m = square(e), self._freedoms(V, lines)
        terms, k = densities(a, V, log_V, m, self.freedom)
        terms = terms * used
        if not slopes:
            return Misfit(terms, None, None)
        k = k * used
        weights: ComplexArray = np.asarray(np.conj(e) * k * (1.0 / H if self.is_log else 1.0 + gain))
        by_sd = None
        if not self._has_known_gains and not self.is_log:
            weights = weights - np.conj(H) * (used / (V * precision))
        if not self._has_fixed_variance:
            size, sd = np.ones(1) if self.is_log else square(H), self._sd(theta)
            by_variance = 0.5 * k * a / V - used / V + 0.5 * used * size / (V**2 * precision)
            if m.ndim:
                by_variance = by_variance + used * slope_by_freedom(a, V, m) * 2.0 * m / V  # ∂m/∂V = 2 m/V
            by_sd = 2.0 * sd * size * by_variance
            if not self.is_log:
                weights = weights + 2.0 * np.conj(H) * ((sd**2 + self._wider**2) * by_variance)
        return Misfit(terms, weights, by_sd)

    def _integrate_gains(self, theta: FloatArray, solved: ModalResponses | GeneralResponses) -> Gains:
        """Return the distribution of the gain errors that are integrated out, in one pass over all lines."""
        sd, n = self.channels.gain_sd, len(theta)
        known = sd == 0.0
        if known.all():
            return Gains(np.zeros((n, len(sd))), np.full((n, len(sd)), np.inf), np.zeros(n))
        sums = np.zeros((2, n, len(self.channels.of_frf)))
        for lines in self._blocks():
            H = self._predict(solved, theta, lines)
            V, used = self._variances(H, theta, lines)[0], self._used[:, lines]
            e = self._error(H, lines, np.zeros((1, 1, 1)))
            first, second = (e.real, 1.0) if self.is_log else (np.real(np.conj(H) * e), square(H))
            for k, part in enumerate(np.broadcast_arrays(first / V, second / V)):  # V may have no batch axis
                sums[k] += np.sum(np.where(used, part, 0.0), axis=2)
        channels = range(len(sd))
        of_channel = np.stack([np.sum(sums[:, :, self.channels.of_frf == j], axis=2) for j in channels], axis=2)
        some = np.where(known, 1.0, sd) ** 2
        precision = 1.0 / some + of_channel[1]
        best = of_channel[0] / precision
        log_density = np.where(known, 0.0, -0.5 * (best**2 / some + np.log(precision * some)))
        return Gains(np.where(known, 0.0, best), np.where(known, np.inf, precision), np.sum(log_density, axis=1))

    def _evaluate(self, theta: FloatArray, gradient: bool) -> tuple[FloatArray, FloatArray]:
        value, slope = np.empty(len(theta)), np.empty((len(theta), theta.shape[1] if gradient else 0))
        with single_thread(), np.errstate(all="ignore"):
            for rows in self._rows(len(theta)):
                value[rows], slope[rows] = self._evaluate_some(theta[rows], gradient)
        return value, slope

    def _evaluate_some(self, theta: FloatArray, gradient: bool) -> tuple[FloatArray, FloatArray]:
        solved, of_frf = self._solve(theta), self.channels.of_frf
        gains = self._integrate_gains(theta, solved)
        gain, precision = (part[:, of_frf, None] for part in (gains.best, gains.precision))
        value = gains.log_density + self._constant
        slope = np.zeros((len(theta), theta.shape[1] if gradient else 0))
        for lines in self._blocks():
            H = self._predict(solved, theta, lines)
            found = self._misfit(H, theta, lines, gain, precision, gradient)
            value = value + np.sum(np.sum(found.terms, axis=2), axis=1)
            if found.weights is None:
                continue
            self.window.add(solved, self.channels.multiply(found.weights, theta, self.omega[lines]), lines)
            if self.channels.parameters:
                self.channels.add_slopes(slope, theta, found.weights * H, self.omega[lines])
            if self._sd_column is not None and found.by_sd is not None:
                slope[:, self._sd_column] += np.sum(np.sum(found.by_sd, axis=2), axis=1)
        if gradient:
            p, q = self.model.full.n_parameters, self.model.n_values
            slope[:, :p], slope[:, self._first : self._first + q] = solved.gradient()
        return value, slope

    def information(self, theta: FloatArray) -> FloatArray:
        """Return the Fisher information on theta, (n, ndim, ndim), with the integrated gain errors eliminated."""
        found = np.zeros((len(theta), theta.shape[1], theta.shape[1]))
        with single_thread(), np.errstate(all="ignore"):
            for i in range(len(theta)):
                found[i] = self._information_at(theta[i : i + 1])
        return found

    def _information_at(self, theta: FloatArray) -> FloatArray:
        solved, channels, n = self._solve(theta), self.channels, theta.shape[1]
        gains = self._integrate_gains(theta, solved)
        p, q, first = self.model.full.n_parameters, self.model.n_values, self._first
        columns = [*range(p), *range(first, first + q)]
        found, mixed = np.zeros((n, n)), np.zeros((len(channels.names), n))
        for lines in self._blocks():
            omega, used = self.omega[lines], self._used[:, lines]
            H = self._predict(solved, theta, lines)
            V = np.broadcast_to(self._variances(H, theta, lines)[0], H.shape)[0]
            m = self._freedoms(V, lines)
            share = np.ones(1) if np.isinf(self.freedom) else (m - 2.0) / (m + 2.0)
            factors = channels.factors(theta, omega)[..., None]
            dH = np.zeros((*H.shape[1:], n), dtype=complex)
            dH[..., columns] = (self.window.slopes(solved, lines) * factors)[0]
            channels.set_columns(dH, theta[0], H[0], omega)
            along = dH / H[0, ..., None]  # ∂ log H
            sd, size = self._sd(theta)[0, 0, 0], np.abs(H[0]) ** 2
            rows = along if self.is_log else dH * (1.0 + gains.best[0, channels.of_frf, None, None])
            weight = np.where(used, share / V, 0.0)
            for part in (rows.real, rows.imag):
                found += np.einsum("flp,flq->pq", part * weight[..., None], part, optimize=True)
            relative = np.zeros((*V.shape, n))  # ∂V/V
            if not self.is_log and (sd or self._wider):
                relative += (2.0 * (sd**2 + self._wider**2) * size / V)[..., None] * along.real
            if self._sd_column is not None:
                relative[..., self._sd_column] = 2.0 * sd * (1.0 if self.is_log else size) / V
            relative = np.where(used[..., None], relative, 0.0)
            of_variance = relative * share[..., None] if m.ndim else relative
            found += np.einsum("flp,flq->pq", of_variance, relative, optimize=True)
            of_gain = along.real if self.is_log else np.real(np.conj(H[0, ..., None]) * rows)
            for f, j in enumerate(channels.of_frf):
                mixed[j] += weight[f] @ of_gain[f]
        return found - np.einsum("jp,jq->pq", mixed / gains.precision[0][:, None], mixed)

    def as_dict(self) -> dict[str, Plain]:
        """Return the data, the damping and the settings as a dict of plain Python types."""
        return self._settings
