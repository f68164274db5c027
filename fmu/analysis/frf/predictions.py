"""The group of a trace with measured and predicted frequency response functions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.posterior.frf.term import FRFTerm
from fmu.progress.phases import by_parts
from fmu.types import ComplexArray, FloatArray

if TYPE_CHECKING:
    import xarray as xr

GROUP = "frfs"
_JUDGED, _DRAWN, _AT_ONCE = 500, 200, 16
"""Numbers of draws that are compared with the data, and that give the bands; number of draws solved together."""
_BAND = (0.05, 0.5, 0.95)


def frf_groups(problem: Any, position: FloatArray, rng: np.random.Generator) -> dict[str, xr.Dataset]:
    """Return a dict with the group ``frfs`` of a trace; empty if no frequency response functions were measured.

    Parameters
    ----------
    problem : UpdatingProblem
    position : ndarray, shape (chains, draws, ndim)
    rng : Generator
        For simulated errors of the measurement.

    Returns
    -------
    mapping of str to xarray.Dataset
        Dimensions: ``frf``, named by response and drive; ``line``, Hz; ``part``, the real and the imaginary part;
        ``sample``, evenly spaced draws. Variables: ``measured`` (frf, line, part) and ``sd`` (frf, line) in the
        units of the data, NaN where a line is not used; ``amplitude`` and ``phase`` (kind, quantile, frf, line),
        the quantiles 5, 50 and 95 % of the model's FRFs and of a new measurement; phases in degrees; ``squares``
        (sample, frf), which is chi-square with ``freedom`` (frf) degrees of freedom if the model is correct;
        ``frac`` (frf), the frequency response assurance criterion of the mean; ``gain`` and ``gain_sd`` (channel),
        the gain errors that are integrated out.
    """
    import xarray as xr

    terms: tuple[FRFTerm, ...] = problem.likelihood.responses
    if not terms:
        return {}
    (term,) = terms
    theta = position.reshape(-1, position.shape[-1])
    judged, drawn = (theta[np.unique(np.linspace(0, len(theta) - 1, n).astype(int))] for n in (_JUDGED, _DRAWN))
    squares = np.concatenate(by_parts("predictions", lambda part: term.squares(part, rng), judged, _AT_ONCE))
    computed = np.concatenate(by_parts("predictions", term.frfs, drawn, _AT_ONCE))
    measured, sd, used = term.data_in_units()
    simulated = term.simulate(computed, drawn, rng)
    amplitudes, phases = zip(*(_bands(part) for part in (computed, simulated)), strict=True)
    mean = computed.mean(axis=0)
    channels = [f"{place} {direction}" for place, direction in term.channels.names]
    gain, gain_sd = (part.mean(axis=0) for part in term.gains(judged[:_AT_ONCE]))
    dims = ("kind", "quantile", "frf", "line")
    variables = {
        "measured": (("frf", "line", "part"), np.stack([measured.real, measured.imag], axis=-1)),
        "sd": (("frf", "line"), np.where(used, sd, np.nan)),
        "amplitude": (dims, np.array(amplitudes)),
        "phase": (dims, np.array(phases), {"units": "degree"}),
        "squares": (("sample", "frf"), squares),
        "freedom": ("frf", 2 * used.sum(axis=1)),
        "frac": ("frf", _frac(np.where(used, measured, 0.0), np.where(used, mean, 0.0))),
        "gain": ("channel", gain),
        "gain_sd": ("channel", np.where(term.channels.gain_sd > 0.0, gain_sd, 0.0)),
    }
    names = {
        "frf": list(term.data.labels),
        "line": term.omega / (2.0 * np.pi),
        "part": ["real", "imaginary"],
        "kind": ["model", "measurement"],
        "quantile": list(_BAND),
        "channel": channels,
    }
    return {GROUP: xr.Dataset(variables, coords=names, attrs={"kind": term.data.kind})}


def _bands(frfs: ComplexArray) -> tuple[FloatArray, FloatArray]:
    """Return quantiles of amplitude and phase in degrees, (3, n_frfs, n_lines); phases lie around the median's."""
    middle = np.median(frfs.real, axis=0) + 1j * np.median(frfs.imag, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = np.angle(frfs / middle)
    phase = np.degrees(np.angle(middle) + np.quantile(away, _BAND, axis=0))
    return np.quantile(np.abs(frfs), _BAND, axis=0), phase


def _frac(measured: ComplexArray, computed: ComplexArray) -> FloatArray:
    """Return |Σ d H*|²/(Σ |d|² Σ |H|²) of each FRF (Heylen & Lammens 1996)."""
    cross = np.abs(np.sum(measured * np.conj(computed), axis=1)) ** 2
    size = np.sum(np.abs(measured) ** 2, axis=1) * np.sum(np.abs(computed) ** 2, axis=1)
    return np.asarray(cross / size)
