"""Estimate frequency response functions from repeated hits, or from time records by Welch's method."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np

from fmu.arguments import ArgumentError
from fmu.numbers import names_in_words, significant, typed
from fmu.posterior.data.frf.checks import complex_array
from fmu.types import BoolArray, ComplexArray, FloatArray

Estimator = Literal["H1", "H2"]
_SEGMENTS = 8
"""Default number of segments, without overlap, of a long record."""
_CORRELATED = 0.05
"""Smallest correlation of the errors at two lines for which they do not count as independent."""

_LEAST_KEPT = 0.5
"""Smallest energy of the force after the window, relative to that of a stationary force."""
_HIT = 0.05
"""Smallest value of (Σ e)²/(n Σ e²) for a force that is not a hit.

Here e is the mean square of the force at each of n samples. The value is about the share of the record that
contains the energy of the force.
"""
_AT_END, _OTHER = 0.05, 0.25
"""Two limits for a continuous random force.

The first is a share of the record at its end, where the mean square of the force must exceed half the mean square
in the whole record. The second is the smallest variance between the records, relative to the mean square.
"""
_CONTINUOUS = (
    "The force lasts up to the end of each record and differs from record to record: it is taken as periodic "
    "within a record. If it is a continuous random force, frequencies and damping are wrong: smooth the model's "
    'FRFs by dataclasses.replace(frfs, window=("boxcar", {T})).'
)
_UNEVEN = 0.001
"""Probability of a note on the force's spectrum if the force is even."""
_GAP, _PLACES = 2, 5
"""Largest distance, in lines, between changes of the force's spectrum at one place; most places in a note."""
_UNSMOOTHED = (
    "With H2 the smoothing by the window is not computed: segments must last about 20 decay times 1/(2π ζ f) of "
    "each resonance, or frequencies and damping are wrong. With H1 it is computed."
)


class Estimate(NamedTuple):
    """FRFs estimated from time records, at frequency lines of a segment's spectrum.

    Attributes
    ----------
    frequencies_hz : ndarray, shape (n_lines,)
        Line frequencies, from 0 Hz.
    values : ndarray of complex, shape (n_frfs, n_lines)
    coherence : ndarray, shape (n_frfs, n_lines)
    averages : float
        Number of independent averages.
    notes : tuple of str
        Sentences on lines that are left out, on a force that lasts up to the end of its records, and on H2.
    window : (str, float), optional
        Window and length (s) of the segments by which H1 is smoothed. None for H2, and if each segment is a whole
        record without a taper.
    residuals : iterator over ndarrays of complex, (n_segments, n_lines)
        For each FRF, (x/H − f) f*/|f| in the spectra f and x of each segment's force and response, computed on
        demand. A gain that differs from segment to segment changes them alike at all lines.
    change : ndarray, shape (n_lines,)
        For each line, the larger |Δ log S_ff| between this line and its two neighbours in the segments' spectrum.
    """

    frequencies_hz: FloatArray
    values: ComplexArray
    coherence: FloatArray
    averages: float
    notes: tuple[str, ...]
    window: tuple[str, float] | None
    residuals: Iterator[ComplexArray]
    change: FloatArray

    def notes_on_force(self, used: BoolArray) -> list[str]:
        """Return a list with a note if the force's spectrum changes between neighbouring lines at a used line.

        With n averages, the quotient of the spectra of an even force at two lines has the F distribution with 2 n
        and 2 n degrees of freedom, or less scatter. It is examined on both sides of each line. The mask `used`,
        shape (m,), is for the last m lines. The list is empty if `window` is None.
        """
        from scipy.stats import f

        first = len(self.change) - len(used)
        change = np.where(used, self.change[first:], 0.0)
        freedom = 2.0 * self.averages
        beyond = np.flatnonzero(change > np.log(f.isf(_UNEVEN / (4.0 * np.sum(used)), freedom, freedom)))
        if self.window is None or not len(beyond):
            return []
        runs = np.split(beyond, np.flatnonzero(np.diff(beyond) > _GAP) + 1)
        most = sorted((int(run[np.argmax(change[run])]) for run in runs), key=lambda at: -change[at])[:_PLACES]
        places = names_in_words([f"{significant(self.frequencies_hz[first + at], 4)} Hz" for at in sorted(most)])
        return [
            f"Near {places} the spectrum of the force changes up to {significant(np.exp(np.max(change)), 2)} "
            "times from one line to the next, as where an exciter yields to a resonance. Smoothing by the window "
            "takes it as even: the damping of resonances there may be wrong, and Σ r² too large, unless segments "
            "last about 20 decay times 1/(2π ζ f) of each resonance."
        ]


def sd_of_coherence(values: ComplexArray, coherence: FloatArray, averages: float) -> FloatArray:
    """Return the standard deviations |H| √((1 − γ²)/(2 γ² (n − 1))) of the FRFs' real (and imaginary) parts.

    H are the FRFs, and γ² is the coherence estimated from the same n independent averages. For large n this is the
    formula of Bendat & Piersol (2010, *Random Data*, 4th ed., section 9.2.4), which has n. The divisor is n − 1
    because the estimate of H leaves n − 1 complex residuals. The error of H1 in standard deviations then has
    Student's distribution with 2 (n − 1) degrees of freedom. Where γ² = 0, the standard deviations are infinite,
    or NaN if H = 0. All arrays have the shape (n_frfs, n_lines).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.abs(values) * np.sqrt((1.0 - coherence) / (2.0 * coherence * (averages - 1.0))))


def average_hits(values: Any, invert: bool) -> tuple[ComplexArray, FloatArray, int, ComplexArray]:
    """Return the mean (n_frfs, n_lines) of repeated FRFs, its sd, the number of hits, and the residuals.

    With n hits at a line, each hit's real and imaginary part have the variance s² = Σ |H_j − mean|²/(2 (n − 1)).
    The standard deviation of the mean is s/√n.

    Parameters
    ----------
    values : array_like of complex, shape (n_hits, n_frfs, n_lines)
        NaN or 0 where a hit failed.
    invert : bool
        Whether to average the reciprocals, for dynamic stiffnesses.

    Returns
    -------
    mean : ndarray of complex, shape (n_frfs, n_lines)
        NaN at a line with fewer than two hits.
    sd : ndarray, shape (n_frfs, n_lines)
        Standard deviation of the mean's real part, and of its imaginary part; NaN where the mean is NaN.
    hits : int
        Smallest number of hits averaged at a line. Lines with fewer than two hits do not count.
    residuals : ndarray of complex, shape (n_frfs, n_hits, n_lines)
        H_j/mean − 1; 0 where a hit failed.

    Raises
    ------
    ValueError
        If `values` are not numbers or have a wrong shape, no line has two hits, or the hits do not differ.
    """
    hits = complex_array("values", values)
    if hits.ndim != 3 or hits.size == 0:
        raise ArgumentError("values", "must have shape (n_hits, n_frfs, n_lines)", hits.shape)
    there = np.isfinite(hits) & (hits != 0.0)
    hits = np.where(there, hits, 1.0)
    hits = np.where(there, 1.0 / hits if invert else hits, 0.0)
    n = there.sum(axis=0)
    if n.max() < 2:
        rule = "must have at least 2 hits with a value at a line"
        raise ArgumentError("values", rule, int(n.max()), "; give FRFData the sd or the coherence of a single FRF")
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = hits.sum(axis=0) / n
        squares = np.sum(np.where(there, np.abs(hits - mean) ** 2, 0.0), axis=0)
        residuals = np.where(there, hits / mean - 1.0, 0.0).swapaxes(0, 1)
        sd = np.where(n > 1, np.sqrt(squares / (2.0 * (n - 1) * n)), np.nan)
    if not np.any(sd > 0.0):
        raise ArgumentError(
            "values", "the hits must differ: their scatter is the standard deviation", "equal hits"
        )
    return np.where(n > 1, mean, np.nan), sd, int(n[n > 1].min()), residuals


def estimate_frfs(
    force: Any,
    response: Any,
    sampling_hz: float,
    estimator: Estimator,
    window: str,
    segment: int | None,
    overlap: float,
    every_line: bool,
) -> Estimate:
    """Estimate FRFs from one force and the responses to it; see `fmu.FRFData.from_records`.

    Unless `every_line` is True, only lines with nearly uncorrelated errors are returned; see `independent_lines`.

    The spectra are computed in `scipy.signal` by Welch's method (1967, IEEE Transactions on Audio and
    Electroacoustics 15, 70). H1 is H smoothed by the squared spectrum |W|² of the window, which
    `fmu.posterior.frf.window` allows for. Overlapping segments are correlated; see `independent_averages`.

    Raises
    ------
    ValueError
        If the shapes differ, a record is not finite or shorter than a segment, a segment has fewer than 4 samples,
        the force is zero throughout, the window is unknown or not for the force, or there is only one segment.
    """
    from scipy.signal import csd, spectrogram, welch

    f, x = _records(force, response)
    n_records, n_samples = f.shape
    n = segment or (n_samples if n_records > 1 else n_samples // _SEGMENTS)
    if not 4 <= n <= n_samples:
        raise ArgumentError("segment", f"must be from 4 samples to the {n_samples} of a record", n)
    weights, step = window_values(window, n), n - int(overlap * n)
    _check_window(window, weights, np.lib.stride_tricks.sliding_window_view(f, n, axis=1)[:, ::step], n_samples)
    n_segments = (n_samples - n) // step + 1
    averages = independent_averages(weights, step, n_segments) * n_records
    if averages <= 1.0:
        advice = "; shorten the segment, or give more records"
        raise ArgumentError("segment", "must give at least two averages", f"{n} of {n_samples} samples", advice)
    settings = {"fs": sampling_hz, "window": weights, "noverlap": n - step}
    lines, of_force = welch(f, **settings)
    s_ff = of_force.mean(axis=0)
    s_xx = welch(x, **settings)[1].mean(axis=0)
    s_fx = csd(f[:, None, :], x, **settings)[1].mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = s_fx / s_ff if estimator == "H1" else s_xx / s_fx.conj()
        coherence = np.clip(np.abs(s_fx) ** 2 / (s_ff * s_xx), 0.0, 1.0)
        steps = np.nan_to_num(np.abs(np.diff(np.log(s_ff), prepend=np.nan, append=np.nan)), nan=0.0)
    k = 1 if every_line else independent_lines(weights, step, n_segments)
    note = f"One of {k} lines is kept: the window {window!r} correlates errors at closer ones; `use` keeps all."
    notes, leaks = [note] * (k > 1), None if n == n_samples and window == "boxcar" else (window, n / sampling_hz)
    if leaks is None and _is_continuous(f):
        notes.append(_CONTINUOUS.format(T=typed(n / sampling_hz)))
    if leaks and estimator == "H2":
        notes.append(_UNSMOOTHED)
        leaks = None

    def spectra(records: FloatArray) -> ComplexArray:
        of_segments = spectrogram(records, **settings, mode="complex")[2]  # (n_records, n_lines, n_segments)
        return np.asarray(np.moveaxis(of_segments, 1, 2).reshape(-1, len(lines))[:, ::k])

    def residuals() -> Iterator[ComplexArray]:
        one = spectra(f)
        size = np.abs(one)
        phase = one / np.where(size > 0.0, size, 1.0)
        for i, H in enumerate(values[:, ::k]):
            with np.errstate(divide="ignore", invalid="ignore"):
                yield spectra(x[:, i]) / H * phase.conj() - size

    change = np.maximum(steps[:-1], steps[1:])[::k]
    means = lines[::k], values[:, ::k], coherence[:, ::k]
    return Estimate(*means, averages, tuple(notes), leaks, residuals(), change)


def window_values(name: str, n: int) -> FloatArray:
    """Return the n values of a window of `scipy.signal.get_window`.

    Raise ArgumentError if there is no such window, or it is exponential: SciPy's default for its time constant is
    one sample.
    """
    from scipy.signal import get_window

    if name in ("exponential", "poisson"):
        advice = (
            '; multiply the records of hits by exp(-t/τ) before, use "boxcar", and add '
            "fmu.RayleighDamping(alpha=2/τ) to the damping of the structure"
        )
        raise ArgumentError("window", "must not be exponential: its time constant is unknown", repr(name), advice)
    try:
        return np.asarray(get_window(name, n))
    except (ValueError, TypeError) as error:
        raise ArgumentError("window", "must be a window of scipy.signal.get_window", repr(name)) from error


def _check_window(name: str, window: FloatArray, forces: FloatArray, n_samples: int) -> None:
    """Raise ArgumentError if a window does not suit the forces in the segments, shape (n_records, n_segments, n).

    The window must leave at least half of the energy that it leaves of a stationary force. It must be constant if
    each segment is a whole record and the hits come at the same time in all records.
    """
    at = np.mean(forces**2, axis=(0, 1))
    removes = window**2 @ at < _LEAST_KEPT * np.mean(window**2) * np.sum(at)
    in_few = len(window) == n_samples and np.sum(at) ** 2 < _HIT * len(at) * np.sum(at**2)
    if removes or (in_few and np.ptp(window) > 0.0):
        rule = 'must be "boxcar" for records of hits: others weigh the hit and its response differently'
        raise ArgumentError("window", rule, repr(name))


def _is_continuous(forces: FloatArray) -> bool:
    """Return True if forces, (n_records, n), last up to the end of the records and differ between records."""
    at = np.mean(forces**2, axis=0)
    last = at[-max(1, int(_AT_END * len(at))) :]
    return bool(np.mean(last) > 0.5 * np.mean(at) and np.mean(np.var(forces, axis=0)) > _OTHER * np.mean(at))


def independent_lines(window: FloatArray, step: int, n_segments: int) -> int:
    """Return the smallest distance, in lines, at which the errors of FRFs are nearly uncorrelated.

    Let the window have n values w_i. The spectra of white noise at lines k apart, in segments j steps apart,
    have the covariance c_jk = Σ_i w_i w_{i + j step} exp(2πi k i/n). The error of an FRF is a product of
    the spectra of force and noise, averaged over K segments. It has the covariance Σ_j (1 − |j|/K) |c_jk|² over
    −K < j < K. If segments do not overlap, the correlation for k = 1 and 2 is 4/9 and 1/36 with a Hann window, and
    0 with a boxcar. If they overlap by a half, it is 0.46 and 0.04 (Hann), and 0.13 and 0 (boxcar). The arguments
    are as in `independent_averages`.
    """
    n, covariance = len(window), np.zeros(len(window) // 2 + 1)
    for j in range(min(n_segments, -(-n // step))):
        both = np.fft.rfft(window[: n - j * step] * window[j * step :], n)
        covariance += (1.0 if j == 0 else 2.0) * (1.0 - j / n_segments) * np.abs(both) ** 2
    return int(np.argmax(covariance[1:] < _CORRELATED * covariance[0])) + 1


def independent_averages(window: FloatArray, step: int, n_segments: int) -> float:
    """Return the number of independent segments whose average has the same variance as the overlapping segments.

    This is K/(1 + 2 Σ_j (1 − j/K) ρ_j) for K segments and a window with values w_i, with
    ρ_j = (Σ_i w_i w_{i + j step})²/(Σ_i w_i²)² (Welch 1967, IEEE Transactions on Audio and Electroacoustics
    15, 70).

    Parameters
    ----------
    window : ndarray, shape (n_samples,)
    step : int
        Number of samples between the starts of successive segments.
    n_segments : int
    """
    n, power = len(window), float(window @ window)
    j = np.arange(1, min(n_segments, -(-n // step)))
    rho = np.array([float(window[k * step :] @ window[: n - k * step]) / power for k in j]) ** 2
    return float(n_segments / (1.0 + 2.0 * np.sum((1.0 - j / n_segments) * rho)))


def _records(force: Any, response: Any) -> tuple[FloatArray, FloatArray]:
    """Return the forces as (n_records, n_samples) and the responses as (n_records, n_frfs, n_samples).

    Raise ValueError if the shapes differ, a sample is not finite, or the force is zero throughout.
    """
    f, x = np.asarray(force, dtype=float), np.asarray(response, dtype=float)
    if f.ndim not in (1, 2) or f.size == 0:
        raise ArgumentError("force", "must have shape (n_samples,) or (n_records, n_samples)", f.shape)
    if x.ndim != f.ndim + 1 or x.shape[-1] != f.shape[-1] or x.shape[:-2] != f.shape[:-1] or x.size == 0:
        shape = ", ".join([str(f.shape[0])] * (f.ndim - 1) + ["n_frfs", str(f.shape[-1])])
        raise ArgumentError("response", f"must have shape ({shape})", x.shape)
    for name, array in (("force", f), ("response", x)):
        if not np.all(np.isfinite(array)):
            raise ArgumentError(name, "must be finite; cut the record where a sensor failed", "NaN or infinity")
    if not np.any(f):
        raise ArgumentError("force", "must not be zero at every sample", "0")
    return (f[None], x[None]) if f.ndim == 1 else (f, x)
