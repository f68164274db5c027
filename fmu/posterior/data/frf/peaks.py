"""Find resonances in measured frequency response functions with the complex mode indicator function (CMIF)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.types import BoolArray, ComplexArray, Dof, FloatArray

KINDS = ("receptance", "mobility", "accelerance")
"""Kinds of FRFs in order of the power k of iω by which the receptance is multiplied."""
PROMINENCE = 1.2
"""Smallest ratio of a peak to the higher of the adjacent valleys."""
_NOISE = 6.0
"""Smallest height of a peak above the higher of the adjacent valleys, in standard deviations of the noise."""
_NEAR = 0.3
"""Share of a peak's height down to which lines belong to the resonance."""
_OF_LARGEST = 0.25
"""Smallest ratio of a lower singular value to the largest one at a second mode."""
_WIDTHS = 3.0
"""Number of half bandwidths within which two peaks with the same shape belong to one mode."""
_MOST_LINES = 60
"""Largest number of lines on each side of a peak in a fit."""
_RESIDUAL_FROM = 9
"""Smallest number of lines for a fit with terms of the other modes."""
_NEIGHBOURS = 31
"""Number of lines over which noise is estimated if no standard deviation is known."""


class Peaks(NamedTuple):
    """Resonances in ascending order of frequency.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (m,)
    damping : ndarray, shape (m,)
        Damping ratios; NaN if neither a fit nor the half-power bandwidth gives one.
    """

    frequencies_hz: FloatArray
    damping: FloatArray


class Receptance(NamedTuple):
    """Receptances (n_frfs, n_lines) in m/N, and their standard deviations with the same shape, if known."""

    values: ComplexArray
    sd: FloatArray | None


class Spectra(NamedTuple):
    """Properties of measured FRFs that are needed to find resonances and to decide on warnings.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (n_lines,)
    receptance : ndarray of complex, shape (n_frfs, n_lines)
        NaN where there is no value.
    sd : ndarray, shape (n_frfs, n_lines), optional
        Standard deviation of the receptance's real part, and of its imaginary part.
    used : ndarray of bool, shape (n_frfs, n_lines)
        Whether the value is used.
    drives, responses : tuple of (place, direction)
        Drive and response of each FRF.
    labels : tuple of str
        Label of each FRF.
    """

    frequencies_hz: FloatArray
    receptance: ComplexArray
    sd: FloatArray | None
    used: BoolArray
    drives: tuple[Dof, ...]
    responses: tuple[Dof, ...]
    labels: tuple[str, ...]

    @property
    def n_frfs(self) -> int:
        """Number of FRFs."""
        return len(self.drives)

    @property
    def at_drive(self) -> BoolArray:
        """Mask (n_frfs,) of the driving-point FRFs, whose response is at the drive and along the same axis."""
        return np.array([response == drive for response, drive in self.axes])

    @property
    def omega(self) -> FloatArray:
        """Angular frequencies, rad/s, shape (n_lines,)."""
        return 2.0 * np.pi * self.frequencies_hz

    @property
    def signs(self) -> FloatArray:
        """Sign of each FRF, (n_frfs, 1): −1 if exactly one of drive and response has a minus sign, otherwise 1."""
        minus = [
            drive[1].startswith("-") != response[1].startswith("-")
            for drive, response in zip(self.drives, self.responses, strict=True)
        ]
        return np.where(minus, -1.0, 1.0)[:, None]

    @property
    def axes(self) -> list[tuple[Dof, Dof]]:
        """Response and drive of each FRF, with any minus sign removed from the directions."""
        return [
            ((response[0], response[1].removeprefix("-")), (drive[0], drive[1].removeprefix("-")))
            for drive, response in zip(self.drives, self.responses, strict=True)
        ]


class _Peak(NamedTuple):
    """A resonance: log prominence, angular frequency, damping ratio, and the shape at the responses."""

    prominence: float
    omega: float
    damping: float
    shape: ComplexArray

    def is_same(self, other: _Peak) -> bool:
        """Return True if the other peak is close and has a similar shape, so that both belong to one mode."""
        wide = _WIDTHS * max(np.nan_to_num((self.damping, other.damping))) * self.omega
        return bool(abs(self.omega - other.omega) < wide and abs(np.vdot(self.shape, other.shape)) ** 2 > 0.5)


def pick_peaks(spectra: Spectra, n: int | None = None, prominence: float = PROMINENCE) -> Peaks:
    """Return the resonances at the peaks of the complex mode indicator function (CMIF).

    The CMIF consists of the singular values of the mobility matrix (responses × drives) at each line (Shih, Tsuei,
    Allemang & Brown 1988, Mechanical Systems and Signal Processing 2, 367). A peak in the largest singular value
    counts if its line is in use, it exceeds the adjacent valleys by a factor, and it stands out from the noise. A
    peak in a lower singular value is a second mode if, in addition, it is not much smaller than the largest value,
    and has another shape and a separate resonance. Other peaks in lower singular values are ignored, because two
    modes may merely exchange their order there. If FRFs in the matrix were not measured, or were measured twice,
    the root sum of squares over all FRFs replaces the CMIF. Two modes within a half-power bandwidth are then one
    peak. Peaks that are close to each other and have similar shapes always count as one resonance.

    A peak's singular vectors combine the FRFs into a single FRF with one mode. A rational function of order two,
    fitted to the lines near the peak, gives the frequency and the damping ratio. If the fit fails, the frequency
    of the peak's line is used, and the half-power bandwidth gives the damping ratio.

    Parameters
    ----------
    spectra : Spectra
    n : int, optional
        Largest number of resonances; the most prominent peaks are returned.
    prominence : float
        Smallest ratio of a peak to the higher of the adjacent valleys.
    """
    from scipy.signal import find_peaks

    omega = spectra.omega
    mobility = 1j * omega * fill_gaps(spectra) * spectra.signs
    matrix = _matrix(mobility, spectra.axes)
    left, values, right = np.linalg.svd(matrix, full_matrices=False)
    noise = _noise(spectra, mobility)
    used = spectra.used.any(axis=0)
    found: list[_Peak] = []
    for k, curve in enumerate(values.T if len(omega) > 2 else []):
        at, of = find_peaks(np.log(np.maximum(curve, np.finfo(float).tiny)), prominence=np.log(prominence))
        for height, i in sorted(zip(of["prominences"].tolist(), at.tolist(), strict=True), reverse=True):
            stands_out = curve[i] * (1.0 - np.exp(-height)) > _NOISE * noise[i]
            if not (used[i] and stands_out and curve[i] >= _OF_LARGEST * values[i, 0]):
                continue
            near, shape = lines_near(curve, i), left[i, :, k]
            one = np.einsum("r,lrd,d->l", shape.conj(), matrix[near], right[i, k].conj()) / (1j * omega[near])
            fitted = _fit(omega[near], one)
            if k and not (fitted and _is_second(omega, values[:, 0], i, *fitted)):
                continue
            peak = _Peak(height, *(fitted or (float(omega[i]), _half_power(omega[near], curve[near]))), shape)
            if not any(peak.is_same(other) for other in found):
                found.append(peak)
    kept = sorted(sorted(found, key=lambda peak: -peak.prominence)[:n], key=lambda peak: peak.omega)
    frequencies = np.array([peak.omega for peak in kept]) / (2.0 * np.pi)
    return Peaks(frequencies, np.array([peak.damping for peak in kept]))


def _is_second(omega: FloatArray, first: FloatArray, i: int, resonance: float, damping: float) -> bool:
    """Return True if a peak at line i of a lower singular-value curve is a second mode.

    If two modes only exchange their order at the peak, the curve of the largest singular values, `first`, has a
    valley there. The `resonance` of a second mode, rad/s, must lie within two lines of the peak, and its
    half-power bandwidth must exceed the line spacing.
    """
    low, high = max(i - 2, 0), min(i + 2, len(omega) - 1)
    is_valley = 0 < int(np.argmin(first[low : high + 1])) < high - low
    is_wide = 2.0 * damping * resonance > omega[i] - omega[i - 1]
    return bool(omega[low] <= resonance <= omega[high] and is_wide and not is_valley)


def fill_gaps(spectra: Spectra) -> ComplexArray:
    """Return the receptances, (n_frfs, n_lines), with gaps interpolated between the adjacent lines.

    Gaps at either end of the spectrum take the nearest value.
    """
    filled = spectra.receptance.copy()
    for row in filled:
        missing = np.isnan(row)
        if missing.any():
            row[missing] = np.interp(
                spectra.frequencies_hz[missing], spectra.frequencies_hz[~missing], row[~missing]
            )
    return filled


def _matrix(mobility: ComplexArray, axes: list[tuple[Dof, Dof]]) -> ComplexArray:
    """Return the FRFs as matrices (n_lines, n_responses, n_drives).

    If some FRFs are missing or were measured twice, return all FRFs as a single column (n_lines, n_frfs, 1).
    """
    responses, drives = (list(dict.fromkeys(column)) for column in zip(*axes, strict=True))
    if len(set(axes)) < len(responses) * len(drives) or len(axes) > len(set(axes)):
        return np.ascontiguousarray(mobility.T)[:, :, None]
    matrix = np.empty((mobility.shape[1], len(responses), len(drives)), dtype=complex)
    for row, (response, drive) in zip(mobility, axes, strict=True):
        matrix[:, responses.index(response), drives.index(drive)] = row
    return matrix


def _noise(spectra: Spectra, mobility: ComplexArray) -> FloatArray:
    """Return the largest standard deviation of the mobilities at each line, shape (n_lines,).

    Missing standard deviations count as 0. If all are unknown, they are estimated from the running median of the
    squared second differences over the lines, or are set to zero with fewer than `_NEIGHBOURS` lines.
    """
    from scipy.ndimage import median_filter

    if spectra.sd is not None:
        sd = np.where(np.isfinite(spectra.sd), spectra.sd, 0.0) * spectra.omega
        return np.asarray(sd.max(axis=0))
    n = mobility.shape[1]
    if n < _NEIGHBOURS:
        return np.zeros(n)
    bend = np.max(np.abs(np.diff(mobility, 2, axis=1)) ** 2, axis=0) / (12.0 * np.log(2.0))
    return np.sqrt(np.pad(median_filter(bend, _NEIGHBOURS), 1, mode="edge"))


def lines_near(curve: FloatArray, i: int) -> slice:
    """Return the slice of lines around the peak at line i.

    On each side, the slice ends with the first line below `_NEAR` times the height of the peak. It has at most
    `_MOST_LINES` lines on each side and, if the spectrum has them, at least three.
    """
    ends = []
    for side in (curve[i::-1], curve[i:]):
        side = side[: _MOST_LINES + 1]
        low = np.flatnonzero(side < _NEAR * side[0])
        end = int(low[0]) + 1 if len(low) else len(side)
        ends.append(min(max(end, 4), len(side)))
    return slice(i - ends[0] + 1, i + ends[1])


def _fit(omega: FloatArray, h: ComplexArray) -> tuple[float, float] | None:
    """Return the angular frequency and damping ratio of a receptance with one mode, or None if the fit fails.

    Let x = ω/ω_0, where ω_0 is the angular frequency of the middle line. The equation h (k − x² + i c x) = p_0 +
    p_1 x + p_2 x² is linear in the real k and c and the complex p. The terms with p_1 and p_2 represent the other
    modes and are omitted if there are few lines.
    """
    at, scale = omega[len(omega) // 2], np.abs(h).max()
    x, g = omega / at, h / scale
    powers = [x**j for j in range(3 if len(x) >= _RESIDUAL_FROM else 1)]
    terms = np.stack([g, 1j * x * g, *(-power for power in powers), *(-1j * power for power in powers)], axis=1)
    right = x**2 * g
    k, c = np.linalg.lstsq(np.concatenate([terms.real, terms.imag]), np.concatenate([right.real, right.imag]))[0][
        :2
    ]
    if k > 0.0 and 0.0 < c < 1.0 and x[0] <= np.sqrt(k) <= x[-1]:
        return float(at * np.sqrt(k)), float(c / (2.0 * np.sqrt(k)))
    return None


def _half_power(omega: FloatArray, height: FloatArray) -> float:
    """Return the damping ratio (ω_2 − ω_1)/(2 ω_r), where ω_1 and ω_2 are the half-power points.

    The peak is at ω_r. At the half-power points, the height is 1/√2 of the peak's height. Return NaN if the height
    does not fall that far on both sides.
    """
    i = int(np.argmax(height))
    level = height[i] / np.sqrt(2.0)
    ends = []
    for direction in (-1, 1):
        side = np.arange(i, -1 if direction < 0 else len(height), direction)
        low = np.flatnonzero(height[side] < level)
        if not len(low):
            return float("nan")
        inner, outer = side[low[0] - 1], side[low[0]]
        part = (height[inner] - level) / (height[inner] - height[outer])
        ends.append(omega[inner] + part * (omega[outer] - omega[inner]))
    return float((ends[1] - ends[0]) / (2.0 * omega[i]))
