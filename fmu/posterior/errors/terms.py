"""Error models bound to data: log-densities of computed modes with all their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.special import erf

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.noise import Spread
from fmu.posterior.errors.subspace import Groups, in_span
from fmu.types import FloatArray

_LOG_2PI = float(np.log(2.0 * np.pi))


class Evaluated(NamedTuple):
    """Log-densities of an error model at n parameter vectors, and what moves them.

    Attributes
    ----------
    terms : ndarray, shape (n, n_modes)
    by_frequency : ndarray, shape (n, n_modes), 1/Hz
    by_shape : ndarray, shape (n, n_sensors, n_modes), or None
    by_noise : mapping of int to ndarray, shape (n, n_modes)
        By each inferred standard deviation.
    """

    terms: FloatArray
    by_frequency: FloatArray | None = None
    by_shape: FloatArray | None = None
    by_noise: dict[int, FloatArray] | None = None


class Residuals(NamedTuple):
    """Errors over their standard deviations, and what moves them.

    Attributes
    ----------
    values : ndarray, shape (n, n_modes, q)
    by_frequency : ndarray, shape (n, n_modes, q), or None
    by_shape : ndarray, shape (n, n_modes, q, n_sensors), or None
    """

    values: FloatArray
    by_frequency: FloatArray | None = None
    by_shape: FloatArray | None = None


class ErrorTerm(Protocol):
    """An error model bound to data."""

    @property
    def needs_shapes(self) -> bool:
        """Whether the errors are of shapes."""
        ...

    def project(self, seen: ModalPrediction) -> ModalPrediction:
        """Return what of the modes seen the errors are of: what the other methods, and their derivatives, take."""
        ...

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the terms for inferred standard deviations (n, n_noise), with the derivatives if wanted."""
        ...

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the errors over their standard deviations: −½ Σ r² is the log-density but for normalisers."""
        ...

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Name the residuals: a mode after the other."""
        ...

    def information(self, noise: FloatArray) -> FloatArray:
        """Return Fisher's information on the inferred standard deviations, shape (n, n_noise, n_noise)."""
        ...

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        ...


@dataclass(frozen=True, eq=False)
class FrequencyTerm:
    """Errors of frequencies; `measured` (n_modes,) in Hz, see `fmu.posterior.errors.models.FrequencyErrors`."""

    kind: str
    measured: FloatArray
    spread: Spread
    needs_shapes: bool = False

    def project(self, seen: ModalPrediction) -> ModalPrediction:
        """Return the modes as they are seen."""
        return seen

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the terms, see `ErrorTerm`."""
        error, slope = self._errors(seen.frequencies)
        V = self.spread.variance(noise)
        terms = -0.5 * (error**2 / V + np.log(V) + _LOG_2PI)
        if not gradient:
            return Evaluated(terms)
        by_V = 0.5 * (error**2 / V - 1.0) / V
        by_noise = {k: by_V * dV for k, dV in self.spread.slopes(noise).items()}
        return Evaluated(terms, -error / V * slope, None, by_noise)

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the residuals, see `ErrorTerm`."""
        error, slope = self._errors(seen.frequencies)
        sd = np.sqrt(self.spread.variance(noise))
        return Residuals((error / sd)[..., None], (slope / sd)[..., None])

    def simulate(self, rng: np.random.Generator, frequencies: FloatArray, noise: FloatArray) -> FloatArray:
        """Return measured frequencies (n, n_modes) for computed ones, in Hz."""
        error = np.sqrt(self.spread.variance(noise)) * rng.standard_normal(frequencies.shape)
        if self.kind == "eigenvalue":
            # what f^m must be for ε to be that; below −1 there is none
            return np.asarray(frequencies / np.sqrt(1.0 + np.maximum(error, -0.99)))
        return np.asarray(frequencies + error)

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Name the residuals, see `ErrorTerm`."""
        return [f"{mode}, frequency" for mode in modes]

    def information(self, noise: FloatArray) -> FloatArray:
        """Return Fisher's information, see `ErrorTerm`."""
        return self.spread.information(noise)

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        return {"error": f"{self.kind} frequency", "spread": self.spread.as_dict()}

    def _errors(self, f: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ε, in Hz but for eigenvalues, and ∂ε/∂f."""
        if self.kind == "eigenvalue":
            return (f / self.measured) ** 2 - 1.0, 2.0 * f / self.measured**2
        return f - self.measured, np.ones_like(f)


@dataclass(frozen=True, eq=False)
class ShapeTerm:
    """Errors of shapes; `unit` (n_sensors, n_modes) measured, see `fmu.posterior.errors.models.ShapeErrors`."""

    unit: FloatArray
    spread: Spread
    needs_shapes: bool = True

    def project(self, seen: ModalPrediction) -> ModalPrediction:
        """Return the modes as they are seen."""
        return seen

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the terms, see `ErrorTerm`."""
        s, u = seen.shapes, self.unit
        Lam = 1.0 / self.spread.variance(noise)
        weighted, size = np.sum(Lam * s**2, axis=1), np.sum(s**2, axis=1)
        a = np.sum(Lam * u * s, axis=1) / weighted
        error = u - a[:, None] * s
        log_det = np.sum(np.log(Lam), axis=1) - np.log(weighted / size)
        terms = 0.5 * (log_det - np.sum(Lam * error**2, axis=1) - (len(u) - 1) * _LOG_2PI)
        if not gradient:
            return Evaluated(terms)
        by_shape = a[:, None] * Lam * error - Lam * s / weighted[:, None] + s / size[:, None]
        by_Lam = 0.5 * (1.0 / Lam - error**2 - s**2 / weighted[:, None])
        by_noise = {k: np.sum(-by_Lam * Lam**2 * dV, axis=1) for k, dV in self.spread.slopes(noise).items()}
        return Evaluated(terms, None, by_shape, by_noise)

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the residuals, see `ErrorTerm`."""
        s, u = seen.shapes, self.unit
        root = 1.0 / np.sqrt(self.spread.variance(noise))
        Lam = root**2
        weighted = np.sum(Lam * s**2, axis=1)
        a = np.sum(Lam * u * s, axis=1) / weighted
        values = np.swapaxes(root * (u - a[:, None] * s), 1, 2)
        da = np.swapaxes((Lam * u - 2.0 * a[:, None] * Lam * s) / weighted[:, None], 1, 2)
        s, root = np.swapaxes(s, 1, 2), np.swapaxes(root, 1, 2)
        by_shape = -root[..., None] * (a[..., None, None] * np.eye(len(u)) + s[..., None] * da[..., None, :])
        return Residuals(values, None, by_shape)

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Name the residuals, see `ErrorTerm`."""
        return [f"{mode}, sensor {k + 1}" for mode in modes for k in range(len(self.unit))]

    def information(self, noise: FloatArray) -> FloatArray:
        """Return Fisher's information, see `ErrorTerm`."""
        return (1.0 - 1.0 / len(self.unit)) * self.spread.information(noise)

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        return {"error": "shape", "spread": self.spread.as_dict()}


@dataclass(frozen=True, eq=False)
class MACTerm:
    """Errors 1 − MAC; `unit` (n_sensors, n_modes) measured, see `fmu.posterior.errors.models.MACErrors`."""

    unit: FloatArray
    spread: Spread
    needs_shapes: bool = True
    groups: Groups = ()

    def project(self, seen: ModalPrediction) -> ModalPrediction:
        """Return the modes, those of a group as what their span has of the measured ones."""
        return in_span(seen, self.unit, self.groups) if self.groups else seen

    def evaluate(self, seen: ModalPrediction, noise: FloatArray, gradient: bool) -> Evaluated:
        """Return the terms, see `ErrorTerm`."""
        error, slope = self._errors(seen.shapes)
        V = self.spread.variance(noise)
        z = 1.0 / np.sqrt(2.0 * V)
        terms = np.log(2.0) - 0.5 * (error**2 / V + np.log(V) + _LOG_2PI) - np.log(erf(z))
        if not gradient:
            return Evaluated(terms)
        by_V = 0.5 * (error**2 / V - 1.0) / V + 2.0 / np.sqrt(np.pi) * np.exp(-(z**2)) * z**3 / erf(z)
        by_noise = {k: by_V * dV for k, dV in self.spread.slopes(noise).items()}
        return Evaluated(terms, None, (-error / V)[:, None] * slope, by_noise)

    def residuals(self, seen: ModalPrediction, noise: FloatArray) -> Residuals:
        """Return the residuals, see `ErrorTerm`."""
        error, slope = self._errors(seen.shapes)
        sd = np.sqrt(self.spread.variance(noise))
        return Residuals((error / sd)[..., None], None, np.swapaxes(slope / sd[:, None], 1, 2)[:, :, None])

    def labels(self, modes: Sequence[str]) -> list[str]:
        """Name the residuals, see `ErrorTerm`."""
        return [f"{mode}, MAC" for mode in modes]

    def information(self, noise: FloatArray) -> FloatArray:
        """Return Fisher's information, see `ErrorTerm`."""
        return self.spread.information(noise)

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        together = {"together": [list(group) for group in self.groups]} if self.groups else {}
        return {"error": "MAC", "spread": self.spread.as_dict(), **together}

    def _errors(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return 1 − MAC, shape (n, n_modes), and its derivative by the shapes, (n, n_sensors, n_modes)."""
        cross, size = np.sum(self.unit * s, axis=1), np.sum(s**2, axis=1)
        a = (cross / size)[:, None]
        return 1.0 - cross**2 / size, -2.0 * a * (self.unit - a * s)
