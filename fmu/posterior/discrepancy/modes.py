"""Model discrepancy in the modes themselves: relative frequency errors, and errors of shape components.

The frequency of mode i has the relative error σ (√ρ w + √(1 − ρ) z_i) with standard normal w and z_i. The part
√ρ w is common to all modes, so that the errors of two modes have the correlation ρ. The shape of mode i, whose
largest component is 1, has the errors σ_s L z at the sensors. LLᵀ has the correlations exp(−d/ℓ) between sensors
at a distance d that measure in the same direction, and −exp(−d/ℓ) if one of them is turned round, as ``"z"`` and
``"-z"``; other pairs of sensors are independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmu.fem.modes.separable import RigidArm, SeparableModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.discrepancy.embedded import INDEPENDENT, MOST, Discrepancy, Setting
from fmu.posterior.errors.base import ErrorTerm
from fmu.posterior.errors.frequency import FrequencyTerm
from fmu.posterior.errors.noise import NoiseIndex
from fmu.posterior.errors.shape import ShapeTerm
from fmu.posterior.errors.slopes import split_by_term
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.one_sided import HalfNormal
from fmu.types import Dof, FloatArray, Plain


@dataclass(frozen=True, eq=False)
class ModeErrors:
    """Model discrepancy in the modes, bound to their measurement errors.

    Attributes
    ----------
    sd, correlation : Setting or None
        σ and ρ; None if frequencies have no measurement errors.
    shape_sd : Setting or None
        σ_s; None if shapes have no measurement errors.
    root : ndarray, shape (n_sensors, n_sensors)
        L; the identity without a correlation length.
    length : float or None
        ℓ, m; None if errors at different sensors are independent.
    """

    sd: Setting | None
    correlation: Setting | None
    shape_sd: Setting | None
    root: FloatArray
    length: float | None = None

    @classmethod
    def of(
        cls,
        settings: Discrepancy,
        index: NoiseIndex,
        terms: Sequence[ErrorTerm],
        sensors: Sequence[Dof],
        structure: SeparableModel | None,
    ) -> ModeErrors:
        """Bind the settings to error terms and sensors; `index` is as in `Discrepancy.bind`.

        Raise ValueError if an inferred number has the name of another parameter.
        """
        prior, most = HalfNormal(settings.prior_sd), MOST * settings.prior_sd

        def size(name: str, known: float | None) -> Setting:
            if known is not None:
                return Setting(known)
            return Setting(0.0, index(Parameter(name, 0.5 * settings.prior_sd, 0.0, most, prior)))

        sd = correlation = shape_sd = None
        if any(term.of_frequencies for term in terms):
            sd = size(settings.label, settings.sd)
            correlation = settings.correlation_over_modes(index)
        if any(term.needs_shapes for term in terms):
            shape_sd = size(f"{settings.label} shapes", settings.shape_sd)
        alike = np.eye(len(sensors))
        if settings.length is not None:
            sign = np.array([-1.0 if direction.startswith("-") else 1.0 for _, direction in sensors])
            alike = np.outer(sign, sign) * np.exp(-_distances(sensors, structure) / settings.length)
            alike += 1e-10 * np.eye(len(alike))  # sensors may be at one place
        return cls(sd, correlation, shape_sd, np.linalg.cholesky(alike), settings.length)

    @property
    def n_own(self) -> int:
        """Number of each mode's own errors."""
        return (self.sd is not None) + (0 if self.shape_sd is None else len(self.root))

    @property
    def n_common(self) -> int:
        """Number of errors that all modes share."""
        return 0 if self.correlation is None or self.correlation == INDEPENDENT else 1

    def units(
        self, terms: Sequence[ErrorTerm], seen: ModalPrediction, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the residuals caused by unit errors, (n, n_modes, k, n_own) and (n, n_modes, k, n_common).

        They are 0 for residuals of quantities other than frequencies and shapes.
        """
        own, common = [], []
        for term in terms:
            V = term.spread.variance(noise)
            n, m = len(noise), V.shape[-1]
            q = len(term.labels([""]))
            part = np.zeros((n, m, q, self.n_own), dtype=V.dtype)
            shared = np.zeros((n, m, q, self.n_common), dtype=V.dtype)
            if isinstance(term, FrequencyTerm):
                unit = (2.0 if term.kind == "eigenvalue" else term.measured) / np.sqrt(V)
                part[:, :, 0, 0] = unit
                shared[:, :, 0] = unit[..., None]
            elif isinstance(term, ShapeTerm):
                columns, psi, _ = self._of_shapes(term, seen, noise)
                along = np.sum(psi[..., None] * columns, axis=2) / np.sum(psi**2, axis=2)[..., None]
                part[..., self.n_own - len(self.root) :] = columns - psi[..., None] * along[:, :, None]
            own.append(part)
            common.append(shared)
        return np.concatenate(own, axis=2), np.concatenate(common, axis=2)

    def change_of_units(
        self, terms: Sequence[ErrorTerm], seen: ModalPrediction, noise: FloatArray, by_own: FloatArray
    ) -> FloatArray:
        """Differentiate a function of each mode's own `units` with respect to the parameters.

        Return an array (n, n_modes, n_parameters). The units of frequencies are constant. For shapes they are U =
        C − ψψᵀC/ψᵀψ, with ψ = φ/σ and a C that does not depend on θ. Let G be the derivatives `by_own` of the
        function with respect to the units, (n, n_modes, k, n_own). Its derivatives with respect to ψ are then
        −(G Cᵀψ + C Gᵀψ)/ψᵀψ + 2 ψ (ψᵀG Cᵀψ)/(ψᵀψ)².
        """
        found = np.zeros((*by_own.shape[:2], np.asarray(seen.frequency_slopes).shape[-1]))
        for term, by in zip(terms, split_by_term(terms, by_own), strict=True):
            if isinstance(term, ShapeTerm):
                (C, psi, root), G = self._of_shapes(term, seen, noise), by[..., self.n_own - len(self.root) :]
                size = np.sum(psi**2, axis=2)[..., None]
                of_C, of_G = (np.sum(psi[..., None] * x, axis=2) for x in (C, G))
                by_psi = -np.sum(G * of_C[:, :, None] + C * of_G[:, :, None], axis=3) / size
                by_psi += 2.0 * psi * np.sum(of_C * of_G, axis=2)[..., None] / size**2
                found += np.einsum("nms,nsmk->nmk", root * by_psi, np.asarray(seen.shape_slopes))
        return found

    def _of_shapes(
        self, term: ShapeTerm, seen: ModalPrediction, noise: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return C, ψ = φ/σ and 1/σ, where φ are the computed shapes and σ the measurement sds at the q sensors.

        C contains the residuals that unit shape errors cause before the shape is rescaled: L, times the largest
        component of the measured shape, divided by σ. The arrays have the shapes (n, n_modes, q, q) for C, and
        (n, n_modes, q) for ψ and 1/σ; the first axis of C and 1/σ has the length 1 if σ is known.
        """
        root = np.swapaxes(term.spread.inverse_sd(noise), 1, 2)
        largest = np.max(np.abs(term.unit), axis=0)[:, None, None]
        return root[..., None] * (largest * self.root), root * np.swapaxes(seen.shapes, 1, 2), root

    def variances(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the variances of a mode's own errors, (n, n_own), and of the common errors, (n, n_common)."""
        own, common = np.empty((len(noise), self.n_own)), np.empty((len(noise), self.n_common))
        if self.sd is not None and self.correlation is not None:
            sd, rho = self.sd.at(noise), self.correlation.at(noise)
            own[:, 0] = sd**2 * (1.0 - rho)
            common[:] = (sd**2 * rho)[:, None]
        if self.shape_sd is not None:
            own[:, self.n_own - len(self.root) :] = (self.shape_sd.at(noise) ** 2)[:, None]
        return own, common

    def log_variance_slopes(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of log `variances` with respect to the inferred error sds.

        Their shapes are (n, n_noise, n_own) and (n, n_noise, n_common).
        """
        by_own, by_common = (np.zeros((*noise.shape, k)) for k in (self.n_own, self.n_common))
        if self.sd is not None and self.correlation is not None:
            sd, rho = self.sd.at(noise), self.correlation.at(noise)
            if self.sd.number >= 0:
                by_own[:, self.sd.number, 0] = 2.0 / sd
                by_common[:, self.sd.number] = (2.0 / sd)[:, None]
            if self.correlation.number >= 0:
                by_own[:, self.correlation.number, 0] = -1.0 / (1.0 - rho)
                by_common[:, self.correlation.number] = (1.0 / rho)[:, None]
        if self.shape_sd is not None and self.shape_sd.number >= 0:
            first = self.n_own - len(self.root)
            by_own[:, self.shape_sd.number, first:] = (2.0 / self.shape_sd.at(noise))[:, None]
        return by_own, by_common

    def in_hz(self, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return each frequency's error in Hz per unit error, (n_modes, n_own) and (n_modes, n_common)."""
        own = np.zeros((len(measured), self.n_own))
        if self.sd is not None:
            own[:, 0] = measured
        return own, np.repeat(measured[:, None], self.n_common, axis=1)

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        kept = {"sd": self.sd, "correlation": self.correlation, "shape_sd": self.shape_sd}
        return {
            "kind": "modes",
            **{key: one.as_dict() for key, one in kept.items() if one is not None},
            "root": self.root.tolist(),
        }


def _distances(sensors: Sequence[Dof], structure: SeparableModel | None) -> FloatArray:
    """Return the distances between sensors in m, shape (n_sensors, n_sensors).

    The distance between two sensors is infinite if their directions differ (``"z"`` and ``"-z"`` are the same), or
    if one of the places has no coordinates in the model.
    """
    q = len(sensors)
    found = np.where(np.eye(q) > 0.0, 0.0, np.inf)
    geometry = None if structure is None else structure.geometry
    if structure is None or geometry is None:
        return found
    places: list[FloatArray | None] = []
    for place, _ in sensors:
        arm = place if isinstance(place, RigidArm) else RigidArm(place, (0.0, 0.0, 0.0))
        row = geometry.row_of.get(arm.node)
        places.append(None if row is None else np.asarray(geometry.nodes)[row] + np.array(arm.offset))
    for i, (here, (_, direction)) in enumerate(zip(places, sensors, strict=True)):
        for j, (there, (_, other)) in enumerate(zip(places, sensors, strict=True)):
            same = direction.removeprefix("-") == other.removeprefix("-")
            if here is not None and there is not None and same:
                found[i, j] = np.linalg.norm(here - there)
    return found
