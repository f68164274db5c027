"""Whether the model fits the data, which no convergence of a sampler tells: a run can be converged and wrong."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.diagnostics import parameter_draws, parameter_names
from fmu.analysis.data.prediction import measured_tests, measurement_in_words, predict_frequencies
from fmu.analysis.modes.pairing_doubts import ALIKE
from fmu.analysis.trace.modal_states import GROUP, MEAN, MEASURED, START
from fmu.numbers import apart, fixed, given, share

if TYPE_CHECKING:
    import xarray as xr


NEAR_A_BOUND = 0.02
"""Part of the distance between the bounds."""
MORE_THAN_THE_PRIOR, LEAST_SHARE = 3.0, 0.05
INTERVAL = 0.99
_WITHIN = 2.0


def bound_warnings(trace: xr.DataTree) -> list[str]:
    """Name the parameters whose draws are piled up against a bound: the data ask for what the bounds forbid.

    They are where more than three times as much of the posterior as of the prior, and at least 5 %, lies within
    2 % of the bounds' distance of one of them, and their mean within two standard deviations of it.
    """
    constants, names, found = trace["constant_data"], parameter_names(trace), []
    lower, upper = (constants[side].to_numpy() for side in ("lower", "upper"))
    draws = parameter_draws(trace).reshape(-1, len(names))
    for k, name in enumerate(names):
        x, margin = draws[:, k], NEAR_A_BOUND * (upper[k] - lower[k])
        if not np.isfinite(margin):
            continue
        unit = trace["posterior"][name].attrs.get("units", "")
        for side, bound, sign in (("lower", lower[k], 1.0), ("upper", upper[k], -1.0)):
            near = float(np.mean(sign * (x - bound) < margin))
            before = _prior_share(trace, name, bound, sign, margin)
            is_close = sign * (x.mean() - bound) < _WITHIN * x.std()
            if near >= LEAST_SHARE and near > MORE_THAN_THE_PRIOR * before and is_close:
                found.append(
                    f"{name}: {share(near)} of the draws (prior: {share(before)}) lie within "
                    f"{share(NEAR_A_BOUND)} of the range from the {side} bound, {given(float(bound))} "
                    f"{unit}".rstrip()
                )
    return found


def _prior_share(trace: xr.DataTree, name: str, bound: float, sign: float, margin: float) -> float:
    """Return the share of the prior near a bound, that of a uniform one where no draws from the prior are."""
    if "prior" not in trace.children:
        return NEAR_A_BOUND
    return float(np.mean(sign * (trace["prior"][name].to_numpy() - bound) < margin))


def fit_warnings(trace: xr.DataTree) -> list[str]:
    """Name the measured modes that lie outside the interval in which a new measurement is predicted, eq. (10).

    Where the measurement is the mean of repeated tests, that is the interval of such a mean.

    Measurement noise is in it, and 99 % of the probability. Nothing can be said where there is no predictive
    distribution of frequencies: of the modal residual, and of a plain density.
    """
    if "posterior_predictive" not in trace.children or "frequency" not in trace["posterior_predictive"]:
        return []
    table = predict_frequencies(trace, INTERVAL)
    per_cent = f"{100 * INTERVAL:g}"
    columns = ("measured", f"noisy_eti{per_cent}_lb", f"noisy_eti{per_cent}_ub", "mean", "noisy_sd")
    tests = measured_tests(trace)
    found = []
    rows = zip(table.index, *(table[c] for c in columns), strict=True)
    for k, (mode, measured, low, high, mean, sd) in enumerate(rows):
        if not low <= measured <= high:
            how = "" if tests is None else f" ({measurement_in_words(tests[:, [k]])})"
            _, from_hz, to_hz, mean_hz = apart(measured, low, high, mean, sd=sd)
            found.append(
                f"mode {mode}: the measured frequency, {given(measured)} Hz{how}, is outside the "
                f"{share(INTERVAL)} prediction interval, {from_hz} to {to_hz} Hz (mean {mean_hz} Hz)"
            )
    return found


def shape_warnings(trace: xr.DataTree) -> list[str]:
    """Name the modes whose shape is not the measured one after updating: by MAC at the sensors, below `ALIKE`.

    Errors of shapes whose size is inferred grow until any shape is probable, so that no prediction tells it.
    """
    alike = measured_mac(trace)
    if alike is None:
        return []
    before, after = (np.diag(alike.sel(state=state)) for state in (START, MEAN))
    return [
        f"mode {mode} does not match the measured shape: MAC {fixed(b, 2)} before and {_below(a)} after "
        f"updating, below {ALIKE}"
        for mode, b, a in zip(alike["mode"].to_numpy(), before, after, strict=True)
        if a < ALIKE
    ]


def _below(mac: float) -> str:
    """Return a MAC that is below `ALIKE` so that this is seen."""
    return apart(mac, ALIKE, sd=0.1)[0]


def measured_mac(trace: xr.DataTree) -> xr.DataArray | None:
    """Return MAC (state, reference_mode, mode) with the measured shapes; None where the trace keeps none."""
    if GROUP not in trace.children or "mac" not in trace[GROUP]:
        return None
    found = trace[GROUP]["mac"].transpose("state", "reference_mode", "mode")
    return found if found.attrs["reference"] == MEASURED else None


def search_warnings(trace: xr.DataTree, highest: float) -> list[str]:
    """Say so if a draw has a higher log-probability than any maximum that was found."""
    reached = float(trace["sample_stats"]["lp"].max())
    if reached <= highest + 1e-3:
        return []
    draw, known = apart(reached, highest, sd=1.0)
    return [
        f"a draw has log-probability {draw}, above the highest maximum found, {known}: the search missed a "
        "maximum; use more starts"
    ]
