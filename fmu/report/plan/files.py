"""Write the files of a planned test: a page, sensors as CSV and universal files, and a measurement to fill in."""

from __future__ import annotations

import os
from collections.abc import Hashable
from pathlib import Path

import numpy as np

from fmu.analysis.plan.result import Plan
from fmu.arguments import check_arguments
from fmu.formats.modes.measured_modes import is_node
from fmu.formats.modes.uff import write_test_geometry
from fmu.numbers import significant, typed
from fmu.report.files import OutputDirectory
from fmu.report.pages import INDEX, render
from fmu.report.plan.page import plan_page
from fmu.sampling.simulated_updates import SimulatedTests

SENSORS, GEOMETRY, MEASUREMENT = "sensors.csv", "geometry.uff", "measurement.toml"


@check_arguments
def write_plan(plan: Plan, directory: str | os.PathLike[str], simulated: SimulatedTests | None = None) -> Path:
    """Write a plan's page, sensors, a measurement table to fill in and, if coordinates are known, its geometry.

    The files are ``index.html``, ``sensors.csv``, ``measurement.toml`` and, if the plan has coordinates,
    ``geometry.uff``.

    Parameters
    ----------
    plan : Plan
    directory : path-like
        Output directory, created if it does not exist.
    simulated : SimulatedTests, optional
        The result of `fmu.simulate_plan`, shown on the page.

    Returns
    -------
    Path
        Path to ``index.html`` in that directory.

    Raises
    ------
    ValueError
        If a file that fmu did not write would be overwritten, `directory` is a file, or the manifest in it is
        invalid.
    """
    output = OutputDirectory(directory)
    page = f"{INDEX}.html"
    names = [page, SENSORS, MEASUREMENT, *([GEOMETRY] if plan.places is not None else [])]
    output.check(names)
    with output.stage_files() as stage:
        (stage / page).write_text(render(plan_page(plan, simulated)), encoding="utf-8")
        plan.sensor_table().to_csv(stage / SENSORS)
        (stage / MEASUREMENT).write_text(measurement_table(plan), encoding="utf-8")
        if plan.places is not None:
            points = plan.places[list(plan.every)]
            (stage / GEOMETRY).write_text(write_test_geometry(points), encoding="ascii")
    return output.root / page


def measurement_table(plan: Plan) -> str:
    """Return the text of a problem file's ``[measurement]`` table with all sensors of the plan.

    The model's predictions take the place of the measured frequencies and shapes. If the problem's error model
    gives the standard deviations of the frequencies, a comment contains the planned ones instead of a key.
    Modes that the sensors do not see are left out, because shapes of zeros cannot be read.
    """
    seen, modes = plan.design.found.nominal, list(plan.design.modes)
    f = seen.frequencies[0, modes]
    rows = plan.design.candidates.rows(plan.every)
    shapes = seen.shapes[0][rows][:, modes]
    largest = np.max(np.abs(shapes), axis=0)
    is_seen = largest > 0.0
    f, sds, shapes = f[is_seen], (f * plan.frequency_sd)[is_seen], shapes[:, is_seen] / largest[is_seen]
    unseen = [str(i + 1) for i in np.array(modes)[~is_seen]]
    term = plan.problem.likelihood.frequency_term
    sd = f"sd = [{', '.join(typed(float(f'{x:.6g}')) for x in sds)}]  # Hz, expected"
    if term is not None and term.has_own_sd:
        sd = f"# The [[error]] of the problem file gives the standard deviations. The plan expects:\n# {sd}"
    lines = [
        "# Replace frequencies and shapes, which the model predicts before updating, by what is measured.",
        *(f"# The sensors do not see mode {mode}, which is left out." for mode in unseen),
        "[measurement]",
        f"frequencies = [{', '.join(significant(float(x), 6) for x in f)}]  # Hz",
        sd,
        f"labels = [{', '.join(_quote(str(i + 1)) for i in np.array(modes)[is_seen])}]",
        "sensors = [",
        *(f"    [{_quote(place)}, {_quote(direction)}]," for place, direction in plan.named_sensors),
        "]",
        "shapes = [",
        *(f"    [{', '.join(f'{x:.4f}' for x in shape)}]," for shape in shapes.T),
        "]",
    ]
    return "\n".join(lines) + "\n"


def _quote(value: Hashable) -> str:
    """Return a node or a name in TOML notation."""
    if is_node(value):
        return str(value)
    text = str(value).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{text}"'
