"""Identify modes from measured frequency response functions with sdypy-EMA's LSCF and LSFD methods.

These are the least-squares complex frequency method and the least-squares frequency domain method (Guillaume,
Verboven & Vanlanduit 1998, *Proceedings of ISMA 23*, 183).
"""

from __future__ import annotations

import contextlib
import io
import warnings
from typing import Any, NamedTuple

import numpy as np

from fmu.arguments import ArgumentError
from fmu.formats.modes.measured_modes import real_shapes
from fmu.formats.shown import in_words, names_shown
from fmu.numbers import given
from fmu.posterior.data.frf.peaks import KINDS, Peaks, Spectra, fill_gaps, pick_peaks
from fmu.posterior.data.modal_data import ModalData
from fmu.types import Dof, FloatArray

_EVEN = 1e-3
"""Largest deviation from even spacing of the lines, in spacings."""
_ORDERS_OF_A_MODE, _LEAST_ORDER, _LINES_OF_AN_ORDER = 4, 20, 4
_FEWEST_LINES = 40
_WIDTHS = 2.0
"""Number of half bandwidths, or of lines, within which a pole belongs to a resonance."""
_WINDOW_HZ = 2.0
"""Width of the window, Hz, in which sdypy-EMA finally looks for stable poles."""


class IdentifiedModes(NamedTuple):
    """Modes identified from the FRFs that share one reference.

    Attributes
    ----------
    modes : ModalData
        Frequencies and real mode shapes. The sensors are the points at the other ends of these FRFs.
    damping : ndarray, shape (n_modes,)
        Damping ratios.
    missed_hz : ndarray, shape (n_missed,)
        Frequencies of the resonances for which no stable pole was found.
    """

    modes: ModalData
    damping: FloatArray
    missed_hz: FloatArray


def identify(spectra: Spectra, k: int, n: int | None, reference: Dof | None, least_mpc: float) -> IdentifiedModes:
    """Identify modes from the FRFs that share one reference; see `fmu.FRFData.identify_modes`.

    The modes are sought at resonances that are picked from all FRFs, including those without the reference.

    Parameters
    ----------
    spectra : Spectra
    k : int
        The power of iω by which receptances were multiplied to obtain the measured FRFs.
    n : int, optional
        Largest number of modes.
    reference : (place, direction), optional
        The drive or the response that the FRFs to use have in common. Defaults to the most frequent one.
    least_mpc : float
        Smallest modal phase collinearity.

    Raises
    ------
    ImportError
        If sdypy-EMA is not installed.
    ValueError
        If there are too few lines, the lines are not evenly spaced at multiples of their spacing, no FRF has the
        reference, there is no resonance or no stable pole, sdypy-EMA fails, or a shape is too complex to be
        treated as real.
    """
    rows, sensors = _of_reference(spectra, reference)
    lines = np.flatnonzero(spectra.used[rows].any(axis=0))
    f = spectra.frequencies_hz[lines[0] : lines[-1] + 1]
    _check_lines(f)
    peaks = pick_peaks(spectra, n)
    if not len(peaks.frequencies_hz):
        raise ArgumentError("values", "must have a resonance", "no peak that stands out")
    measured = (fill_gaps(spectra) * (1j * spectra.omega) ** k)[rows, lines[0] : lines[-1] + 1]
    frequencies, damping, constants = _poles(f, measured, peaks, k)
    width = _width(f, peaks)
    found = (np.abs(frequencies - peaks.frequencies_hz) <= width) & (damping > 0.0) & (damping < 1.0)
    if not found.any():
        raise ArgumentError("values", "must have a stable pole at a resonance", "none", "; use pick_frequencies")
    shapes, mpc = real_shapes(constants[:, found], least_mpc)
    modes = ModalData(frequencies[found], sensors=sensors, shapes=shapes, mpc=mpc)
    return IdentifiedModes(modes, damping[found], peaks.frequencies_hz[~found])


def _of_reference(spectra: Spectra, reference: Dof | None) -> tuple[list[int], tuple[Dof, ...]]:
    """Return the row indices of the FRFs with the reference at one end, and the points at their other ends.

    The reference defaults to the drive or the response that most FRFs share. If it is the drive of some FRFs and
    the response of others, return only the larger of these two groups. Raise ValueError if no FRF has it.
    """
    ends = (spectra.drives, spectra.responses)
    groups: dict[tuple[int, Dof], list[int]] = {}
    for end, points in enumerate(ends):
        for row, point in enumerate(points):
            groups.setdefault((end, point), []).append(row)
    fitting = {key: rows for key, rows in groups.items() if reference is None or key[1] == tuple(reference)}
    if not fitting:
        there = names_shown([f"{place} {direction}" for _, (place, direction) in groups])
        raise ArgumentError("reference", f"must be a drive or a response, one of {there}", repr(reference))
    (end, _), rows = max(fitting.items(), key=lambda group: len(group[1]))
    return rows, tuple(ends[1 - end][row] for row in rows)


def _check_lines(f: FloatArray) -> None:
    """Raise ValueError unless there are enough frequency lines, evenly spaced at multiples of their spacing."""
    advice = "; pick_frequencies takes any lines"
    if len(f) < _FEWEST_LINES:
        raise ArgumentError("frequencies_hz", f"must be at least {_FEWEST_LINES} lines in use", len(f), advice)
    spacing = (f[-1] - f[0]) / (len(f) - 1)
    if np.abs(f / spacing - np.round(f[0] / spacing) - np.arange(len(f))).max() > _EVEN:
        rule = "must be evenly spaced, at multiples of the spacing"
        raise ArgumentError("frequencies_hz", rule, f"{given(f[0])}, {given(f[1])}, … Hz", advice)


def _width(f: FloatArray, peaks: Peaks) -> FloatArray:
    """Return the largest distance in Hz between each resonance and a pole that belongs to it, shape (n_peaks,)."""
    spacing = (f[-1] - f[0]) / (len(f) - 1)
    return _WIDTHS * np.fmax(spacing, peaks.damping * peaks.frequencies_hz)


def _poles(f: FloatArray, measured: Any, peaks: Peaks, k: int) -> tuple[FloatArray, FloatArray, Any]:
    """Return frequencies in Hz (m,), damping ratios (m,) and modal constants (n_frfs, m) of poles near peaks.

    Raise ImportError if sdypy-EMA is not installed, and ValueError if it finds no stable pole or fails.
    """
    try:
        from sdypy import EMA
    except ImportError:
        raise ImportError("modes are identified by sdypy-EMA: install fmu[ema]") from None
    n_before = round(float(f[0] * (len(f) - 1) / (f[-1] - f[0])))
    padded = np.pad(measured, ((0, 0), (n_before, 0)))  # sdypy-EMA may be off by a line when it pads
    # its window for stable poles has a fixed width in Hz: the frequencies are scaled so that it fits the peaks
    scale = _WINDOW_HZ / float(np.min(_width(f, peaks)))
    axis = np.linspace(0.0, f[-1] * scale, padded.shape[1])
    order = max(_LEAST_ORDER, _ORDERS_OF_A_MODE * len(peaks.damping))
    settings = {"lower": axis[n_before], "upper": axis[-1], "frf_form": KINDS[k]}
    with warnings.catch_warnings(), contextlib.redirect_stderr(io.StringIO()):  # hide its progress bars
        warnings.simplefilter("ignore")
        try:
            model = EMA.Model(padded, axis, pol_order_high=min(order, len(f) // _LINES_OF_AN_ORDER), **settings)
            model.get_poles(show_progress=False)
            model.select_closest_poles(list(peaks.frequencies_hz * scale), f_window=int(_WINDOW_HZ))
            constants = model.get_constants(f_lower=axis[n_before], f_upper=model.freq[-1])[1]
        except Exception as error:  # whatever sdypy-EMA raises where it finds no stable pole
            raise ArgumentError("values", f"sdypy-EMA must find their poles ({in_words(error)})") from error
    n = len(peaks.damping)
    return np.asarray(model.nat_freq) / scale, np.asarray(model.nat_xi), np.asarray(constants)[:, :n]
