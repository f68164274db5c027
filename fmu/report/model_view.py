"""Interactive views of the structure and its modes, coloured by parameter changes or losses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.information import not_informed
from fmu.analysis.trace.damage import probably
from fmu.analysis.trace.modal_states import GROUP, MEAN, START, sketch_of
from fmu.analysis.trace.reading import constant, has
from fmu.fem.frame.drawing import UNCHANGED, Sketch
from fmu.numbers import change, given, hertz, share
from fmu.report.document import View
from fmu.report.packed import Rounded
from fmu.report.plots.modes import measured_at, scaled_to_mean
from fmu.report.plots.style import colour
from fmu.report.run import ReportedRun
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

MOST_LINES = 20_000
"""Largest number of elements of a structure that is shown."""
_MOST_NUMBERS = 300_000
"""Largest number of displacement values on a page; for a large mesh only the first modes are kept."""
_DETAILED = 2000
"""Largest number of nodes with 16-bit displacements; larger meshes have 8 bits, accurate to about a pixel."""
_CORNER = (0.6, 0.45)


def model_view(run: ReportedRun) -> View | None:
    """Return a view of the structure with its modes, coloured by the parameter changes.

    Return None if the trace has no geometry or no displacements, or if the structure has more than `MOST_LINES`
    elements. A large mesh is shown with its first modes only.
    """
    found = sketch_of(run.trace)
    if found is None or len(found.elements) > MOST_LINES or not has(run.trace, GROUP, "displacement"):
        return None
    modes = run.trace[GROUP].to_dataset()
    n_modes = max(1, min(modes.sizes["mode"], _MOST_NUMBERS // (6 * len(found.nodes))))
    modes = modes.isel(mode=slice(n_modes))
    names, tips = run.names[: found.changed.shape[1]], _changes(run)
    content = _structure(found, names, {name: words for name, (_, _, words) in tips.items()})
    content |= {
        "modes": _labels(run, modes),
        "shapes": _shapes(modes),
        "colourings": _colourings(run, found, names),
        "colour": colour(str(run.trace.attrs["sampler"])),
        "view": _view(found.nodes, modes["displacement"].to_numpy()),
    }
    content |= _sensors(found, modes)
    shown = "" if n_modes == run.trace[GROUP].sizes["mode"] else f" The first {n_modes} modes."
    caption = (
        "Drag to turn, click and scroll to zoom; keys: arrows, +, −, space, Page Up, Page Down. Grey: before "
        f"updating, at the start. Thick: after it, at the posterior mean.{shown}"
    )
    return View("structure", content, caption)


def damage_view(found: Sketch, names: Sequence[str], table: pd.DataFrame, beyond: str) -> View:
    """Return a view of the structure, coloured by each parameter's loss and by the probability of a large loss.

    Parameters
    ----------
    found : Sketch
        The structure.
    names : sequence of str
        Structural parameters, in the order of the columns in ``found.changed``.
    table : pandas.DataFrame
        One row per state and parameter. The columns are the mean and the standard deviation of the loss,
        ``eti90_lb``, ``eti90_ub``, and the probability that the loss is larger than `beyond`.
    beyond : str
        The loss threshold as text, such as ``"5 %"``.
    """
    said: dict[str, list[str]] = {}
    colourings = []
    for state, losses in table.groupby(level=0, sort=False):
        lost = losses.droplevel(0)
        each = {name: lost.loc[name].to_numpy(dtype=float) for name in names if name in lost.index}
        for name, (mean, sd, *_, p) in each.items():
            loss = f"{name} in {state}: loss {share(float(mean))} ± {share(float(sd))} (sd)"
            said.setdefault(name, []).append(f"{loss}, P(loss > {beyond}) = {probably(float(p))}")
        for what, column in (("mean loss", 0), (f"P(loss > {beyond})", -1)):
            # a negative mean loss is a gain and counts as 0; −1 marks parameters that are not in the table
            of_parameter = np.array(
                [np.maximum(each[name][column], 0.0) if name in each else -1.0 for name in names]
            )
            largest = np.where(found.changed, of_parameter, -1.0).max(axis=1)
            values = np.where(largest < 0.0, np.nan, largest)  # NaN too where P is withheld
            if np.isfinite(values).any():
                colourings.append(colour_scale(f"{state}: {what}", values, False))
    content = _structure(found, names, {name: "; ".join(words) for name, words in said.items()})
    content |= {"modes": [], "shapes": {}, "colourings": colourings, "colour": UNCHANGED, "view": _CORNER}
    content |= _sensors(found, None)
    caption = "Drag to turn, click and scroll to zoom; keys: arrows, + and −. Point at an element for its losses."
    return View("damage", content, caption)


def _structure(found: Sketch, names: Sequence[str], said: Mapping[str, str]) -> dict[str, object]:
    """Return nodes, elements, element groups and a text for each group as a dict.

    The elements in a group are changed by the same parameters.
    """
    combinations, groups = np.unique(found.changed, axis=0, return_inverse=True)
    tips = [
        "; ".join(said[name] for name, is_changed in zip(names, row, strict=True) if is_changed and name in said)
        or "no parameter is known to change this element"
        for row in combinations
    ]
    label = f"The structure: {len(found.nodes)} nodes, {len(found.elements)} elements."
    return {
        "label": label,
        "nodes": found.nodes,
        "ends": found.elements,
        "groups": groups.ravel(),
        "tips": tips,
    }


def _changes(run: ReportedRun) -> dict[str, tuple[float, float, str]]:
    """Return each parameter's change relative to its start value, its sd, and a text with both, keyed by name.

    For a parameter that the data did not inform, the change and its sd are NaN, and the text says so. Other
    parameters are omitted if their start value is zero or unknown.
    """
    left, found = not_informed(run.trace), {}
    for name in run.names:
        start = constant(run.trace, "start", name)
        if name in left:
            found[name] = (np.nan, np.nan, f"{name}: not informed by the data")
        elif start and np.isfinite(start):
            mean, sd = (float(run.summary[column][name]) for column in ("mean", "sd"))
            ratio, spread = mean / start - 1.0, sd / abs(start)
            found[name] = (ratio, spread, f"{name}: {change(ratio)} ± {share(spread)} (sd)")
    return found


def _colourings(run: ReportedRun, found: Sketch, names: Sequence[str]) -> list[dict[str, object]]:
    """Return two colour scales: the largest parameter change in each element, and its standard deviation.

    The list is empty if no change of a parameter is known.
    """
    known = _changes(run)
    ratio, spread = (np.array([known.get(name, (np.nan,) * 2)[k] for name in names]) for k in (0, 1))
    of_element = np.where(found.changed & np.isfinite(ratio), np.abs(ratio), -1.0)
    if not np.any(of_element >= 0):
        return []
    largest, is_known = np.argmax(of_element, axis=1), of_element.max(axis=1) >= 0
    values = np.where(is_known, ratio[largest], np.nan)
    return [
        colour_scale("Change of the parameter", values, True),
        colour_scale("Standard deviation of the change", np.where(is_known, spread[largest], np.nan), False),
    ]


def colour_scale(label: str, values: FloatArray, both: bool) -> dict[str, object]:
    """Return a dict that describes a colour scale for `values`, shape (n_elements,).

    The values are fractions, and NaN for elements without a value. The scale is symmetric about zero if `both` is
    True; otherwise it starts at zero.
    """
    largest = float(np.nanmax(np.abs(values)))
    ends = (change(-largest), change(largest)) if both else ("0 %", share(largest))
    return {"label": label, "values": values, "scale": largest, "both": both, "ends": ends}


def _labels(run: ReportedRun, modes: xr.Dataset) -> list[dict[str, str]]:
    """Return a dict of texts for each mode: its label, and its frequencies (before updating, after it, measured).

    The text for the measured frequency is empty if the trace has no measured frequencies.
    """
    measured = None if run.prediction is None else run.prediction["measured"].to_numpy()
    labels = []
    for k, label in enumerate(modes["mode"].to_numpy().astype(str)):
        hz = hertz(*(float(modes["frequency"].sel(state=state)[k]) for state in (START, MEAN)))
        seen = "" if measured is None else f"{given(float(measured[k]))} Hz"
        labels.append({"label": label, "before": f"{hz[0]} Hz", "after": f"{hz[1]} Hz", "measured": seen})
    return labels


def _shapes(modes: xr.Dataset) -> dict[str, object]:
    """Return displacements (mode, node, direction) as a dict: before updating, at the posterior mean, measured.

    The measured shapes are expanded to all nodes. They are omitted if the trace has no expanded shapes, or if
    there are more than `_DETAILED` nodes.
    """
    bits = 16 if modes.sizes["node"] <= _DETAILED else 8
    moved = modes["displacement"].transpose("state", "mode", "node", "direction")
    found = {key: moved.sel(state=state).to_numpy() for key, state in (("start", START), ("mean", MEAN))}
    if "expanded" in modes and bits > 8:  # on a large mesh the arrows at the sensors are clearer
        each = (scaled_to_mean(modes.isel(mode=k), "expanded") for k in range(modes.sizes["mode"]))
        found["expanded"] = np.stack([one for one in each if one is not None])
    return {key: Rounded(values, bits) for key, values in found.items()}


def _sensors(found: Sketch, modes: xr.Dataset | None) -> dict[str, object]:
    """Return a dict with the sensor positions and the measured displacements at the sensors.

    If no shapes were measured, or `modes` is None, the dict contains the sensor directions and the nearest nodes
    instead.
    """
    if modes is not None and "measured" in modes and "site" in modes:
        seen = [measured_at(modes.isel(mode=k)) for k in range(modes.sizes["mode"])]
        places = next(one[0] for one in seen if one is not None)
        moved = np.stack([np.zeros_like(places) if one is None else one[1] for one in seen])
        return {"sites": places, "measured": np.nan_to_num(moved), "directions": np.zeros(0), "near": np.zeros(0)}
    kinds = np.array(found.kinds)
    is_drawn = (kinds == "sensor") & np.isfinite(found.places).all(axis=1) & np.isfinite(found.ends).all(axis=1)
    places = found.places[is_drawn]
    near = np.array([np.argmin(np.sum((found.nodes - at) ** 2, axis=1)) for at in places], dtype=int)
    return {"sites": places, "measured": None, "directions": found.ends[is_drawn], "near": near}


def _view(nodes: FloatArray, displacement: FloatArray) -> tuple[float, float]:
    """Return the azimuth and elevation of the view in rad.

    A straight horizontal structure is seen at right angles to its motion, any other structure from a corner.
    """
    wide = np.ptp(nodes, axis=0) > 1e-6 * np.ptp(nodes, axis=0).max()
    moves = int(np.argmax(np.sum(displacement.reshape(-1, 3) ** 2, axis=0)))
    if wide.sum() == 1 and not wide[2]:
        yaw = 0.0 if wide[0] else np.pi / 2
        return (yaw - 0.15, 0.2) if moves == 2 else (yaw, 1.3)
    return _CORNER
