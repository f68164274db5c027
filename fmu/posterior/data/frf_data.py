"""Measured frequency response functions (FRFs) and their uncertainty."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from annotated_types import Gt, Interval
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, Count, OwnRule, check_arguments, shown
from fmu.durable_files import digest
from fmu.formats.modes.measured_modes import LEAST_MPC, Collinearity
from fmu.posterior.data.frf.checks import (
    check_rows,
    check_used,
    checked_bools,
    checked_coherence,
    checked_dofs,
    checked_frequencies,
    checked_sd,
    checked_values,
)
from fmu.posterior.data.frf.correlation import ErrorCorrelation, correlation_of_errors
from fmu.posterior.data.frf.doubts import STANDS_OUT, doubts
from fmu.posterior.data.frf.estimates import Estimator, average_hits, estimate_frfs, sd_of_coherence, window_values
from fmu.posterior.data.frf.identification import IdentifiedModes, identify
from fmu.posterior.data.frf.peaks import KINDS, Peaks, Receptance, Spectra, pick_peaks
from fmu.types import BoolArray, ComplexArray, Dof, FloatArray, Plain

FRFKind = Literal["receptance", "mobility", "accelerance", "dynamic-stiffness"]
_CONVERTED = "The dynamic stiffness of each FRF was converted to its reciprocal, the receptance."


@check_arguments
@dataclass(frozen=True, eq=False)
class FRFData:
    """Frequency response functions (FRFs) measured in a test, and their uncertainty.

    An FRF is the response at one point divided by the force at another, at each frequency line of a spectrum.
    Units are SI: m/N, m/s/N or m/s²/N; rotations are in rad, moments in N·m.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (n_lines,)
        Line frequencies in ascending order. They need not be evenly spaced. A line at 0 Hz is dropped.
    values : ndarray of complex, shape (n_frfs, n_lines)
        One FRF per row. NaN or 0 marks a missing value, which is not used; zeros are replaced by NaN.
    drives, responses : tuple of (place, direction)
        Node and direction (x, y, z, rx, ry or rz, with or without a minus) of each FRF's force and response.
    kind : {"receptance", "mobility", "accelerance", "dynamic-stiffness"}
        Displacement, velocity or acceleration per force; or force per displacement. A dynamic stiffness is
        converted to its reciprocal, the receptance. This is correct if it is the quotient of one force and one
        response, with no other force applied, but not if it is an entry in the inverse of a receptance matrix.
    sd : ndarray, shape (n_frfs, n_lines), optional
        Standard deviation of the real part, and of the imaginary part, in the unit of `values`. A scalar applies
        to all values; one number per FRF, shape (n_frfs, 1), applies to all its lines. NaN and 0 mean missing.
    coherence : ndarray, shape (n_frfs, n_lines), optional
        Ordinary coherence γ², from 0 to 1. Without `sd`, real and imaginary parts have the standard deviation
        |H| √((1 − γ²)/(2 γ² (averages − 1))), cf. Bendat & Piersol (2010, § 9.2.4). 0, 1 and NaN are not used.
    averages : float, optional
        Number of independent averages behind the coherence; it must be greater than 1.
    use : ndarray of bool, shape (n_lines,) or (n_frfs, n_lines), optional
        The lines to use in updating. Defaults to all lines. The other lines validate the updated model.
    band : (float, float), optional
        Lowest and highest frequency to use, Hz.
    hits : int, optional
        Number of repeated hits whose scatter gave `sd`, at the value with the fewest hits; see `from_hits`.
    correlation, correlation_of_lines : float
        Mean correlations between relative errors of FRFs with the same force, and between distant lines of an FRF,
        if significant; see `doubts`.
    notes : tuple of str
        Sentences on data that were converted, dropped or not used.
    window : (str, float), optional
        Window (as in `from_records`) and length in s of the segments from which H1 of a random test was estimated:
        the model's FRFs are smoothed likewise (`fmu.posterior.frf.window`). None for hits and periodic forces.

    Raises
    ------
    ValueError
        If shapes differ, frequencies are negative or do not ascend, a place or direction is invalid, an FRF has no
        values, two FRFs have the same points, an sd is negative or infinite, a coherence is not from 0 to 1, only
        one of `coherence` and `averages` is given, the window is unknown, the band is empty, or no value is used.
    """

    frequencies_hz: ArrayLike
    values: Annotated[ArrayLike, OwnRule()]
    drives: tuple[tuple[Any, str], ...]
    responses: tuple[tuple[Any, str], ...]
    kind: FRFKind = "accelerance"
    sd: ArrayLike | None = None
    coherence: ArrayLike | None = None
    averages: Annotated[float, Gt(1.0)] | None = None
    use: Annotated[ArrayLike | None, OwnRule()] = None
    band: tuple[float, float] | None = None
    hits: Count | None = None
    notes: tuple[str, ...] = ()
    window: tuple[str, Annotated[float, Gt(0.0)]] | None = None
    correlation: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0
    correlation_of_lines: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0

    def __post_init__(self) -> None:
        frequencies = checked_frequencies(self.frequencies_hz)
        values = checked_values(self.values, len(frequencies))
        shape = values.shape
        for name in ("drives", "responses"):
            object.__setattr__(self, name, checked_dofs(name, getattr(self, name), shape[0]))
        sd = None if self.sd is None else checked_sd(self.sd, shape)
        coherence = checked_coherence(self.coherence, self.averages, shape)
        use = None if self.use is None else checked_bools("use", self.use, shape)
        if self.window is not None:
            window_values(self.window[0], 4)
        notes = list(self.notes)
        kept = frequencies > 0.0
        if not kept.all():
            notes.append("The line at 0 Hz is dropped: an FRF has no resonance there, and sensors drift.")
        if self.kind == "dynamic-stiffness":
            with np.errstate(divide="ignore", invalid="ignore"):
                sd = None if sd is None else sd / np.abs(values) ** 2
                values = 1.0 / values
            notes.append(_CONVERTED)
            object.__setattr__(self, "kind", "receptance")
        missing = ~np.isfinite(values) | (values == 0.0)
        arrays = {"frequencies_hz": frequencies, "values": np.where(missing, np.nan, values), "sd": sd}
        arrays |= {"coherence": coherence, "use": use}
        for name, array in arrays.items():
            if array is not None:
                array = np.array(array[..., kept])
                array.flags.writeable = False
            object.__setattr__(self, name, array)
        self._check_lines(notes)
        object.__setattr__(self, "notes", tuple(dict.fromkeys(notes)))

    def _check_lines(self, notes: list[str]) -> None:
        """Append notes on missing values and sds. Raise ValueError if an FRF or the selection is invalid."""
        missing = np.isnan(np.asarray(self.values))
        notes += check_rows(self.labels, missing)
        if self.band is not None and not 0.0 <= self.band[0] < self.band[1]:
            raise ArgumentError("band", "must have a lower frequency below its upper one", shown(self.band))
        name = "use" if self.band is None else "band"
        of_sd = "coherence" if self.sd is None else "sd"
        notes += check_used(np.asarray(self.frequencies_hz), self._chosen & ~missing, self.used, name, of_sd)

    @classmethod
    @check_arguments
    def from_hits(
        cls,
        frequencies_hz: ArrayLike,
        values: Annotated[ArrayLike, OwnRule()],
        drives: tuple[tuple[Any, str], ...],
        responses: tuple[tuple[Any, str], ...],
        kind: FRFKind = "accelerance",
        **options: Any,
    ) -> Self:
        """Return the mean FRFs over repeated hits, with their standard deviation from the scatter.

        The mean's error divided by `sd` has Student's t distribution with 2 (hits − 1) degrees of freedom. An
        exponential window exp(−t/τ) damps like `fmu.RayleighDamping(2/τ)`; add this to the structure's damping.

        Parameters
        ----------
        frequencies_hz : array_like, shape (n_lines,)
        values : array_like of complex, shape (n_hits, n_frfs, n_lines)
            The FRFs of each hit; NaN or 0 where a hit failed. Values from fewer than two hits are not used.
        drives, responses, kind
            The class attributes with these names. Dynamic stiffnesses are inverted before they are averaged.
        **options
            The class attributes ``use``, ``band`` and ``notes``.

        Raises
        ------
        ValueError
            If no value has two hits, the hits are equal, or the arguments of the class are invalid.
        """
        mean, sd, hits, residuals = average_hits(values, kind == "dynamic-stiffness")
        averaged: FRFKind = kind
        if kind == "dynamic-stiffness":
            averaged, options["notes"] = "receptance", (*options.get("notes", ()), _CONVERTED)
        made = cls(frequencies_hz, mean, drives, responses, averaged, sd, hits=hits, **options)
        return made._with_correlation(residuals, hits)

    @classmethod
    @check_arguments
    def from_records(
        cls,
        force: ArrayLike,
        response: ArrayLike,
        sampling_hz: Annotated[float, Interval(gt=0.0, le=1e9)],
        drives: tuple[tuple[Any, str], ...],
        responses: tuple[tuple[Any, str], ...],
        kind: FRFKind = "accelerance",
        *,
        estimator: Estimator = "H1",
        window: str = "hann",
        segment: Count | None = None,
        overlap: Annotated[float, Interval(ge=0.0, lt=1.0)] = 0.5,
        **options: Any,
    ) -> Self:
        """Estimate FRFs from time records of one force and the responses to it.

        H1 = S_fx/S_ff is correct if the noise is in the responses, and H2 = S_xx/S_xf if it is in the force. The
        sds follow from the coherence. Only lines with independent errors are kept: every second one with a Hann
        window or segments that overlap by a half, all with a boxcar and no overlap.

        Parameters
        ----------
        force : array_like, shape (n_samples,) or (n_records, n_samples)
            One long record, or one per hit from before the hit until the response has decayed, in N.
        response : array_like, shape (n_frfs, n_samples) or (n_records, n_frfs, n_samples)
            Displacements (m), velocities (m/s) or accelerations (m/s²), depending on `kind`.
        sampling_hz : float, Hz
        drives, responses, kind
            The class attributes; all drives must be equal, and `kind` must not be "dynamic-stiffness".
        estimator : {"H1", "H2"}
        window : str
            Name of each segment's window in `scipy.signal.get_window`. Records of hits need "boxcar"; if they were
            multiplied by exp(−t/τ), add `fmu.RayleighDamping` with alpha = 2/τ to the damping.
        segment : int, optional
            Number of samples per segment. Defaults to an eighth of a long record, or the whole record of a hit.
        overlap : float
            Share of a segment that the next segment overlaps, from 0 to less than 1.
        **options
            ``use``, ``band`` and ``notes`` of the class. If ``use`` is given, all lines are kept.

        Raises
        ------
        ValueError
            If the shapes or drives differ, a record is too short or not finite, the force is zero throughout, the
            window is unknown or not for hits, there is only one segment, or the class rejects its arguments.
        """
        if kind == "dynamic-stiffness":
            raise ArgumentError("kind", 'must be "receptance", "mobility" or "accelerance"', repr(kind))
        if len(set(drives)) > 1:
            raise ArgumentError("drives", "must be the same for all FRFs of one force", shown(drives))
        all_lines = options.get("use") is not None
        found = estimate_frfs(force, response, sampling_hz, estimator, window, segment, overlap, all_lines)
        options["notes"] = (*options.get("notes", ()), *found.notes)
        options = dict[str, Any](coherence=found.coherence, averages=found.averages, window=found.window) | options
        made = cls(found.frequencies_hz, found.values, drives, responses, kind, **options)
        made = replace(made, notes=(*made.notes, *found.notes_on_force(made.used.any(axis=0))))
        return made._with_correlation(found.residuals, found.averages)

    def _with_correlation(self, residuals: Iterable[ComplexArray], n: float) -> Self:
        """Return the same FRFs with the correlations of the errors of n hits or segments, at clear values."""
        clear = self.used & (np.abs(np.asarray(self.values)) > STANDS_OUT * self.standard_deviation)
        found = correlation_of_errors(residuals, clear, self.drives, n)
        return replace(self, correlation=found.of_frfs, correlation_of_lines=found.of_lines)

    @property
    def power(self) -> int:
        """Power of iω that converts a receptance to this kind of FRF: 0, 1 (mobility) or 2 (accelerance)."""
        return KINDS.index(self.kind)

    @property
    def n_frfs(self) -> int:
        """Number of FRFs."""
        return len(self.drives)

    @property
    def n_lines(self) -> int:
        """Number of frequency lines."""
        return len(np.asarray(self.frequencies_hz))

    @property
    def labels(self) -> tuple[str, ...]:
        """Response and drive of each FRF as text: ``"tip z / root y"``."""
        pairs = zip(self.responses, self.drives, strict=True)
        return tuple(f"{response[0]} {response[1]} / {drive[0]} {drive[1]}" for response, drive in pairs)

    @cached_property
    def used(self) -> BoolArray:
        """Mask (n_frfs, n_lines) of values in `use` and `band` that exist and whose sd, if known, is positive."""
        there, sd = self._chosen & np.isfinite(np.asarray(self.values)), self._sd
        return there if sd is None else np.asarray(there & np.isfinite(sd) & (sd > 0.0))

    @property
    def standard_deviation(self) -> FloatArray:
        """Standard deviation of the real part, and of the imaginary part, shape (n_frfs, n_lines), SI units.

        Raise ValueError if neither `sd` nor `coherence` was given.
        """
        if self._sd is None:
            advice = "; give coherence and averages instead, use FRFData.from_hits, or infer the sd"
            raise ArgumentError("sd", "must be known", "None", advice)
        return self._sd

    @property
    def freedom(self) -> float:
        """Degrees of freedom with which each sd was estimated; infinite if it is not from hits or a coherence."""
        if self.hits is not None:
            return 2.0 * (self.hits - 1)
        return 2.0 * (self.averages - 1.0) if self.sd is None and self.averages is not None else np.inf

    @cached_property
    def _chosen(self) -> BoolArray:
        """Mask of the values in `use` and `band`, shape (n_frfs, n_lines)."""
        use = np.asarray(True if self.use is None else self.use)
        within = np.asarray(True) if self.band is None else self._within([self.band])
        return np.broadcast_to(use & within, (self.n_frfs, self.n_lines))

    @property
    def _spectra(self) -> Spectra:
        f, points = np.asarray(self.frequencies_hz), (self.drives, self.responses)
        return Spectra(f, *self.as_receptance(), self.used, *points, self.labels)

    @cached_property
    def _sd(self) -> FloatArray | None:
        if self.sd is not None or self.coherence is None or self.averages is None:
            return None if self.sd is None else np.asarray(self.sd)
        return sd_of_coherence(np.asarray(self.values), np.asarray(self.coherence), self.averages)

    def _within(self, bands: Sequence[tuple[float, float]]) -> BoolArray:
        f, more = np.asarray(self.frequencies_hz), 1.0 + 1e-5  # files have six digits
        return np.asarray(np.any([(low <= f * more) & (f <= high * more) for low, high in bands], axis=0))

    @check_arguments
    def with_bands(self, bands: Sequence[tuple[float, float]]) -> Self:
        """Return the same FRFs with fewer lines in use: only lines in at least one of the bands (low, high), Hz.

        Raise ValueError if `bands` is empty, or no line is left.
        """
        if len(bands) == 0:
            raise ArgumentError("bands", "must have a band (low, high)", "none")
        return replace(self, use=self._chosen & self._within(bands), band=None)

    @check_arguments
    def without_lines(self, mask: Annotated[ArrayLike, OwnRule()]) -> Self:
        """Return the same FRFs, but do not use the values where `mask`, (n_lines,) or (n_frfs, n_lines), is True.

        Raise ValueError if the mask is not boolean, has another shape, or leaves no line.
        """
        return replace(self, use=self._chosen & ~checked_bools("mask", mask, self._chosen.shape), band=None)

    def as_receptance(self) -> Receptance:
        """Return the receptances H/(iω)^k, where k is `power`, and their sds (None if unknown)."""
        omega = 2.0 * np.pi * np.asarray(self.frequencies_hz)
        values = np.asarray(self.values) / (1j * omega) ** self.power
        return Receptance(values, None if self._sd is None else self._sd / omega**self.power)

    @check_arguments
    def pick_frequencies(self, n: Count | None = None) -> Peaks:
        """Return the resonances' frequencies in Hz and damping ratios, (m,) each, in ascending order of frequency.

        They are starting values, not data. With `n`: only the n most prominent (`fmu.posterior.data.frf.peaks`).
        """
        return pick_peaks(self._spectra, n)

    @check_arguments
    def identify_modes(
        self, n: Count | None = None, *, reference: Dof | None = None, least_mpc: Collinearity = LEAST_MPC
    ) -> IdentifiedModes:
        """Identify modes from the FRFs with one reference: frequencies and shapes as `fmu.ModalData`, and damping.

        sdypy-EMA fits the modes at the resonances of `pick_frequencies` (`fmu.posterior.data.frf.identification`).

        Parameters
        ----------
        n : int, optional
            Largest number of modes.
        reference : (place, direction), optional
            The drive that the FRFs have in common (for a roving hammer, the response). Default: the most frequent.
        least_mpc : float
            Smallest modal phase collinearity (`fmu.formats.modes.measured_modes.real_shapes`).

        Raises
        ------
        ValueError
            If the lines are too few or not evenly spaced at multiples of their spacing, no FRF has the reference,
            there is no resonance or no stable pole, or a shape is too complex to be treated as real.
        ImportError
            If sdypy-EMA is not installed: install fmu[ema].
        """
        return identify(self._spectra, self.power, n, reference, least_mpc)

    def doubts(self) -> tuple[str, ...]:
        """Return warnings that the kind, polarity or position of FRFs may be wrong, or their sds unsuitable.

        The evidence is described in `fmu.posterior.data.frf.doubts`.
        """
        of_errors = ErrorCorrelation(self.correlation, self.correlation_of_lines)
        return doubts(self._spectra, self.power, self.freedom, of_errors)

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings and a hash of the measured numbers as a dict of plain Python types."""
        frequencies = np.asarray(self.frequencies_hz)
        arrays = [frequencies, np.asarray(self.values), self.used, *([] if self._sd is None else [self._sd])]
        return {
            "kind": self.kind,
            "drives": [list(drive) for drive in self.drives],
            "responses": [list(response) for response in self.responses],
            "n_lines": self.n_lines,
            "n_used": int(self.used.sum()),
            "frequencies_hz": [float(frequencies[0]), float(frequencies[-1])],
            "freedom": None if np.isinf(self.freedom) else float(self.freedom),
            **({} if self.window is None else {"window": list(self.window)}),
            "sha256": digest(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)),
        }
