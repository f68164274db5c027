"""Compare measured and computed mode shapes after a run: the MAC of each mode, and the sensors that disagree."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.modal_states import GROUP, MEAN, MEASURED, START
from fmu.analysis.trace.reading import has
from fmu.fem.pairing.correlation import ALIKE, Correlation
from fmu.numbers import apart, fixed

if TYPE_CHECKING:
    import xarray as xr


MOST_TESTS = 5
"""Largest number of tests whose sensors are named."""


def measured_mac(trace: xr.DataTree) -> xr.DataArray | None:
    """Return the MAC between a single test's mode shapes and the computed ones, or None if the trace stores none.

    The dimensions are (state, reference_mode, mode).
    """
    if not has(trace, GROUP, "mac"):
        return None
    found = trace[GROUP]["mac"].transpose("state", "reference_mode", "mode")
    return found if found.attrs["reference"] == MEASURED else None


def paired_mac(trace: xr.DataTree) -> list[tuple[str, float, float]]:
    """Return, for each measured mode shape, the mode's name and its MAC before and after updating.

    The list is empty if the trace stores no MAC with measured shapes. This is so if no shapes were measured, or if
    the model of a single test is not given by matrices. Modes of several tests are named ``"test: mode"``.
    """
    alike = measured_mac(trace)
    if alike is not None:
        before, after = (np.diag(alike.sel(state=state)).tolist() for state in (START, MEAN))
    elif has(trace, GROUP, "mac_in_test"):
        pairs = trace[GROUP].to_dataset()["mac_in_test"]
        before, after = (pairs.sel(state=state).to_numpy().tolist() for state in (START, MEAN))
    else:
        return []
    return list(zip(map(str, trace[GROUP]["mode"].to_numpy()), before, after, strict=True))


def shape_warnings(trace: xr.DataTree) -> list[str]:
    """Return a sentence on each mode whose MAC with the measured shape is below `ALIKE` after updating.

    If the size of the shape errors is inferred, it grows until any mode shape is probable, and predictions do not
    show the misfit.
    """
    return [
        f"mode {mode} does not match the measured shape: MAC {fixed(before, 2)} before and {below(after)} after "
        f"updating, below {ALIKE}"
        for mode, before, after in paired_mac(trace)
        if after < ALIKE
    ]


def below(mac: float) -> str:
    """Format a MAC value with enough digits to show whether it is below `ALIKE`."""
    return apart(mac, ALIKE, sd=0.1)[0]


def correlations_of(trace: xr.DataTree, state: str) -> dict[str, Correlation]:
    """Compare each test's mode shapes with the model in one state; return the comparisons keyed by test name.

    A single test has the key ``""``. Sensors at which a mode was not measured are left out. The dict is empty if
    the trace stores no measured shapes.
    """
    if not has(trace, GROUP):
        return {}
    modes = trace[GROUP].to_dataset()
    labels = modes["mode"].to_numpy().astype(str)
    names, place = ("component", "measured"), "place"
    if "measured_in_test" in modes:
        names, place = ("computed_in_test", "measured_in_test"), "sensor"
    if names[1] not in modes:
        return {}
    computed, measured = (modes[name].transpose(..., place, "mode") for name in names)
    shapes, seen = computed.sel(state=state).to_numpy(), measured.to_numpy()
    known = np.isfinite(seen).all(axis=1)
    sensors = tuple(modes[place].to_numpy()[known].astype(str).tolist())
    of_test = modes["of_test"].to_numpy().astype(str) if "of_test" in modes else np.full(len(labels), "")
    found = {}
    for name in dict.fromkeys(of_test.tolist()):
        here = of_test == name
        own = tuple(label.removeprefix(f"{name}: ") for label in labels[here].tolist())
        found[name] = Correlation(sensors, own, seen[known][:, here], shapes[known][:, here])
    return found


def sensor_warnings(trace: xr.DataTree) -> list[str]:
    """Return warnings about suspect sensors in a run with several tests, for at most `MOST_TESTS` tests.

    If more tests have such warnings, a last sentence says how many. The model is taken at the posterior mean. The
    sensors of a single test are described in its report instead.
    """
    found = {name: one.doubts_of_sensors() for name, one in correlations_of(trace, MEAN).items() if name}
    concerned = [name for name, doubts in found.items() if doubts]
    said = [f"Test {name}: {doubt}" for name in concerned[:MOST_TESTS] for doubt in found[name]]
    left = len(concerned) - MOST_TESTS
    if left > 0:
        said.append(f"{left} more tests have such warnings about sensors, such as {concerned[-1]}.")
    return said
