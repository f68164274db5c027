"""Warn that measured frequency response functions may have the wrong kind, polarity or position.

Let H = (iω)^k × receptance, with k = 0 for a receptance, 1 for a mobility and 2 for an accelerance. A lightly
damped structure has these properties (Ewins 2000, *Modal Testing*, 2nd ed., chapter 2):

- Below the first resonance |H| is proportional to ω^k (supported structure) or to ω^(k − 2) (free structure).
  For a driving point, the phase of H below the first resonance is 90° ahead of the phase at a resonance (supported
  structure) or 90° behind it (free structure).
- At a resonance a receptance and an accelerance are imaginary, and a mobility is real.
- The real part of the mobility at a driving point is never negative, because the force supplies power.
- FRFs are reciprocal: H_jk = H_kj for a response at point j and a force at point k.

The module also warns of errors that the FRFs of one force have in common, because the likelihood assumes
independent errors, and of standard deviations that come from few hits or averages.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.numbers import fixed, share, significant, whole
from fmu.posterior.data.frf.correlation import ErrorCorrelation
from fmu.posterior.data.frf.peaks import KINDS, Spectra, lines_near, pick_peaks
from fmu.posterior.data.frf.student import squared_scores
from fmu.types import BoolArray

_PROMINENCE = 2.0
"""Smallest prominence of a resonance whose phase is considered."""
_OF_FIRST = 0.4
"""The slope is fitted to lines below this share of the first resonance."""
_FEWEST_LINES, _LEAST_RATIO = 5, 1.3
"""Smallest number of lines for the slope, and smallest ratio of their highest to their lowest frequency."""
_SLOPE_SD = 0.1
"""Largest standard deviation of a slope that counts."""
_WHOLE = 0.3
"""Largest distance between a slope and an integer; beyond it the slope is inconclusive."""
_CLEAR = 0.5
"""Smallest modulus of the mean phase at resonances, which is 1 if all of them agree."""
STANDS_OUT = 4.0
"""Number of standard deviations beyond which a value is certainly not noise."""
_PART, _PART_UNKNOWN = 0.1, 0.2
"""Smallest share of |H| at which a real part is considered, with and without standard deviations."""
_FEWEST_WRONG, _WRONG_SHARE = 3, 0.05
_RECIPROCAL = 0.1
"""Smallest relative difference of reciprocal FRFs that is reported if there are no standard deviations."""
_TOO_FAR = 5.0
"""Number of standard deviations by which χ² of reciprocal FRFs must exceed its mean for a warning."""
_FEWEST_FREEDOM = 8.0
_MATTERS = 1.1
"""Factor on standard deviations from which a correlation between FRFs is reported."""
_GAUSSIAN = 1e12  # degrees of freedom from which Student's distribution is the Gaussian


class _Signs(NamedTuple):
    """Evidence about the kind of FRF. An attribute is None or NaN if the FRFs do not determine it.

    Attributes
    ----------
    slope : float
        Exponent n in |H| ∝ ω^n below the first resonance.
    is_free : bool or None
        Whether the phases at driving points show that the structure is free.
    is_imaginary : bool or None
        Whether the FRFs are imaginary at resonances.
    """

    slope: float
    is_free: bool | None
    is_imaginary: bool | None

    def slope_fits(self, k: int) -> bool:
        """Return True if the slope is possible for FRFs of kind k, or unknown."""
        slopes = {None: (k, k - 2), False: (k,), True: (k - 2,)}[self.is_free]
        return bool(np.isnan(self.slope)) or round(self.slope) in slopes

    def phase_fits(self, k: int) -> bool:
        """Return True if the phase at resonances is possible for FRFs of kind k, or unknown."""
        return self.is_imaginary is None or self.is_imaginary == (k != 1)


def doubts(spectra: Spectra, k: int, freedom: float, correlation: ErrorCorrelation) -> tuple[str, ...]:
    """Return warnings that FRFs may have the wrong kind, polarity or position, or too small or uncertain sds.

    The power at driving points is judged only if the kind of the FRFs is not in doubt.

    Parameters
    ----------
    spectra : Spectra
    k : int
        The power of iω by which receptances were multiplied to obtain the measured FRFs.
    freedom : float
        Degrees of freedom with which the standard deviations were estimated.
    correlation : ErrorCorrelation
        Mean correlations between the relative errors of FRFs with the same force, and of lines.
    """
    of_kind = _kind_doubts(spectra, k)
    of_power = [] if of_kind else _power_doubts(spectra, k)
    few = []
    if freedom < _FEWEST_FREEDOM:
        few = [
            f"The standard deviations have {significant(freedom)} degrees of freedom only, too few for Gaussian "
            "errors. Measure at least 5 hits, or 5 averages."
        ]
    common = _common_doubts(spectra, correlation)
    return (*of_kind, *of_power, *_reciprocal_doubts(spectra, freedom), *common, *few)


def _common_doubts(spectra: Spectra, correlation: ErrorCorrelation) -> list[str]:
    """Return warnings if errors of lines, or of FRFs of one force, are too correlated to count as independent.

    If a gain causes the share ρ_L of the error variance (`correlation.of_lines`), the gain error of the mean FRF
    has the standard deviation √(2 ρ_L) s/|H|, where s is the standard deviation of the real part. The warning
    contains the median of this value over the used values.

    The mean of m values with the correlation ρ has √(1 + (m − 1) ρ) times the standard deviation of the mean of
    independent values. Here m is the mean, over the used FRFs, of the number of used FRFs with the same force. ρ
    is `correlation.of_frfs` minus ρ_L, because larger standard deviations do not account for a gain error.
    """
    told = []
    if correlation.of_lines and spectra.sd is not None:
        relative = np.median((spectra.sd / np.abs(spectra.receptance))[spectra.used])
        least = significant(float(relative * np.sqrt(2.0 * correlation.of_lines)), 2)
        told = [
            "The errors of an FRF are not independent from line to line: their mean correlation over hits is "
            f"{significant(correlation.of_lines, 2)}. Hits whose point, direction or calibration differs have "
            "different gains, which change all lines alike: intervals of parameters are too narrow. Improve the "
            f"hits, or give force_gain_sd to FRFErrors, {least} at least."
        ]
    forces = [drive for drive, is_used in zip(spectra.drives, spectra.used.any(axis=1), strict=True) if is_used]
    m = sum(map(forces.count, forces)) / len(forces)
    factor = float(np.sqrt(1.0 + (m - 1.0) * max(correlation.of_frfs - correlation.of_lines, 0.0)))
    if factor < _MATTERS:
        return told
    by = significant(factor, 2)
    return [
        *told,
        "The errors of FRFs of one force are not independent: their mean correlation over hits or segments is "
        f"{significant(correlation.of_frfs, 2)}. Noise of the force, other forces and leakage change all "
        "responses alike, at each line anew. Standard deviations of parameters are up to about "
        f"{by} times too small. Improve the force signal, or enlarge the errors: "
        f"dataclasses.replace(frfs, sd={by} * frfs.standard_deviation, correlation=0.0).",
    ]


def _kind_doubts(spectra: Spectra, k: int) -> list[str]:
    """Return a list with a warning if the FRFs do not fit their kind, otherwise an empty list.

    The evidence is the slope at low frequencies and the phase at resonances. There is no warning without
    resonances.
    """
    signs = _signs(spectra, k)
    if signs is None or (signs.slope_fits(k) and signs.phase_fits(k)):
        return []
    why = []
    if not signs.slope_fits(k):
        usual = {None: f"{k} or {k - 2}", False: str(k), True: str(k - 2)}[signs.is_free]
        slope = fixed(signs.slope, 1)
        why.append(f"below the first resonance they rise with the power {slope} of the frequency, not {usual}")
    if not signs.phase_fits(k):
        part, other = ("imaginary", "real") if signs.is_imaginary else ("real", "imaginary")
        why.append(f"at the resonances they are {part}, not {other}")
    fitting = [name for other, name in enumerate(KINDS) if signs.slope_fits(other) and signs.phase_fits(other)]
    advice = f"They look like {' or '.join(fitting)}" if fitting else "Check the channels and their delays"
    return [f"The FRFs are said to be {KINDS[k]}, but {', and '.join(why)}. {advice}."]


def _signs(spectra: Spectra, k: int) -> _Signs | None:
    """Return the evidence about the kind of FRF, or None if the FRFs have no resonance."""
    whole_range = spectra._replace(used=np.isfinite(spectra.receptance))
    peaks = pick_peaks(whole_range, prominence=_PROMINENCE).frequencies_hz
    if not len(peaks):
        return None
    measured = spectra.receptance * (1j * spectra.omega) ** k
    at = np.array([int(np.argmin(np.abs(spectra.frequencies_hz - peak))) for peak in peaks])
    height = np.sqrt(np.nansum(np.abs(spectra.receptance * spectra.omega) ** 2, axis=0))
    resonant = np.zeros((spectra.n_frfs, len(peaks)), dtype=complex)
    for j, i in enumerate(at.tolist()):
        near = lines_near(height, i)
        values = np.nan_to_num(measured[:, near])
        resonant[:, j] = np.trapezoid(values, spectra.omega[near], axis=1)  # ∫ dω/(λ − ω² + icω) is imaginary
    size = np.sum(np.abs(resonant) ** 2, axis=0)
    turn = float(np.mean((np.sum(resonant**2, axis=0) / size).real))
    slopes, ahead = [], 0.0
    is_drive = spectra.at_drive
    for i in np.flatnonzero(is_drive | ~is_drive.any()).tolist():
        low = spectra.used[i] & (spectra.frequencies_hz < _OF_FIRST * peaks[0])
        clear = _clear(spectra, i)
        unclear = np.flatnonzero(low & ~clear)
        low[: unclear[-1] + 1 if len(unclear) else 0] = False  # clear values among unclear ones are large errors
        f, h = spectra.frequencies_hz[low], measured[i, low]
        if len(f) < _FEWEST_LINES or f[-1] < _LEAST_RATIO * f[0]:
            continue
        relative = 0.0 if spectra.sd is None else spectra.sd[i, low] / np.abs(spectra.receptance[i, low])
        if np.linalg.norm(relative) / len(f) > _SLOPE_SD * np.std(np.log(f)):
            continue
        rise = np.log(np.abs(h) * (1.0 - (f / peaks[0]) ** 2))  # without the amplification by the first mode
        slopes.append(float(np.polyfit(np.log(f), rise, 1)[0]))
        if is_drive[i]:
            ahead += float((np.mean(h / np.abs(h)) * resonant[i].sum().conj() / np.abs(resonant[i]).sum()).imag)
    slope = float(np.median(slopes)) if slopes else np.nan
    known = abs(slope - np.round(slope)) < _WHOLE
    is_free = ahead < 0.0 if known and abs(ahead) > _CLEAR * int(is_drive.sum()) else None
    return _Signs(slope if known else np.nan, is_free, turn < 0.0 if abs(turn) > _CLEAR else None)


def _clear(spectra: Spectra, i: int) -> BoolArray:
    """Return a mask (n_lines,) of the lines at which FRF `i` stands out of the noise.

    If standard deviations are unknown, these are all lines with a value.
    """
    height = np.abs(spectra.receptance[i])
    if spectra.sd is None:
        return np.isfinite(height)
    return np.asarray(height > STANDS_OUT * np.nan_to_num(spectra.sd[i], nan=np.inf))


def _power_doubts(spectra: Spectra, k: int) -> list[str]:
    """Return a warning for each driving point at which the force seems to extract power.

    A line is examined if the real part of the mobility there is large enough to be judged. A point is reported if
    the real part is negative at `_FEWEST_WRONG` lines or more, and at a share `_WRONG_SHARE` or more of the
    examined lines.
    """
    other = "" if k == 1 else f", or if it is {'a receptance' if k else 'an accelerance'}, say so by its kind"
    told = []
    for i in np.flatnonzero(spectra.at_drive).tolist():
        mobility = 1j * spectra.omega * spectra.receptance[i] * spectra.signs[i]
        height, power = np.abs(mobility), mobility.real
        if spectra.sd is None:
            counts = (np.abs(power) > _PART_UNKNOWN * height) & (height > _PART * np.nanmax(height))
        else:
            least = np.maximum(STANDS_OUT * spectra.sd[i] * spectra.omega, _PART * height)
            counts = np.abs(power) > least
        n, negative = int(np.sum(counts)), int(np.sum(counts & (power < 0.0)))
        if negative < max(_FEWEST_WRONG, _WRONG_SHARE * n):
            continue
        label = f"The FRF {spectra.labels[i]} is of a driving point"
        if negative > (1.0 - _WRONG_SHARE) * n:
            told.append(
                f"{label}, but its phase is reversed: reverse the direction of its sensor or of its force, if the "
                f"polarity of a channel is wrong{other}."
            )
        else:
            told.append(
                f"{label}, but the sign of the power changes: it is negative at {whole(negative)} of {whole(n)} "
                "lines. Check the kind, whether force and sensor are at one point, and the delays of the channels."
            )
    return told


def _reciprocal_doubts(spectra: Spectra, freedom: float) -> list[str]:
    """Return a warning for each pair of reciprocal FRFs that differ by more than their errors explain.

    The difference of two FRFs has the variance V = s_1² + s_2². If the standard deviations s_1 and s_2 have ν
    degrees of freedom (`freedom`), V has ν V²/(s_1⁴ + s_2⁴) degrees of freedom, at most 2 ν (Satterthwaite).
    Without standard deviations, a median relative difference of `_RECIPROCAL` or more is reported.
    """
    row = {pair: i for i, pair in enumerate(spectra.axes)}
    values, told = spectra.receptance * spectra.signs, []
    for (response, drive), i in row.items():
        j = row.get((drive, response), i)
        if j <= i:
            continue
        both = spectra.used[i] & spectra.used[j]
        one, other = values[i, both], values[j, both]
        if not both.any():
            continue
        squares = np.abs(one - other) ** 2
        relative = float(np.median(np.sqrt(2.0 * squares / (np.abs(one) ** 2 + np.abs(other) ** 2))))
        explained = ""
        if spectra.sd is not None:
            variance = spectra.sd[i, both] ** 2 + spectra.sd[j, both] ** 2
            m = freedom * variance**2 / (spectra.sd[i, both] ** 4 + spectra.sd[j, both] ** 4)
            chi2, n = float(np.sum(squared_scores(squares / variance, m))), 2 * int(both.sum())
            if chi2 < n + _TOO_FAR * np.sqrt(2.0 * n):
                continue
            m = np.minimum(m, _GAUSSIAN)  # |e|²/V of Student's errors has the median m (2^(2/m) − 1)
            times = np.sqrt(np.median(squares / variance / (m * np.expm1(2.0 * np.log(2.0) / m))))
            explained = f", {significant(times, 2)} times what their standard deviations explain"
        elif relative < _RECIPROCAL:
            continue
        told.append(
            f"The reciprocal FRFs {spectra.labels[i]} and {spectra.labels[j]} differ by {share(relative)} "
            f"(median over the lines){explained}. Check the points, the directions and the calibration of both."
        )
    return told
