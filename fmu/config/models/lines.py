"""``[model.points]`` and ``[[model.lines]]``: lines for plotting a structure that is given by matrices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from fmu.arguments import ArgumentError
from fmu.config.mistakes import Mistakes
from fmu.config.parameters import ParameterTable
from fmu.config.tables import Name, TomlTable
from fmu.fem.modes.line_picture import LinePicture
from fmu.formats.shown import names_shown, quote


class LineTable(TomlTable):
    """A line between two points, which represents a member in plots.

    ``parameters`` are the names of the parameters that change the member. The line has the colour of the parameter
    that comes first in theta.
    """

    points: Annotated[list[Name], Field(min_length=2, max_length=2)]
    parameters: list[Name] = []


def mistakes_of_lines(
    points: Mapping[str, object], lines: Sequence[LineTable], parameters: Sequence[ParameterTable], has_mesh: bool
) -> list[ArgumentError]:
    """Return the errors found in the lines for plotting.

    Lines must name known points and parameters. It is an error if there are points without any line, or points or
    lines although the model has a mesh.
    """
    names = [parameter.name for parameter in parameters]
    found = Mistakes()
    for i, line in enumerate(lines):
        at = f"model.lines.{i}"
        for key, given, known in (("points", line.points, list(points)), ("parameters", line.parameters, names)):
            found += [
                ArgumentError(f"{at}.{key}", f"must name one of {names_shown(known)}", quote(name))
                for name in given
                if name not in known
            ]
    if (points or lines) and has_mesh:
        found.add("model.lines" if lines else "model.points", "must be left out: mesh gives the pictures")
    elif points and not lines:
        found.add("model.points", "must be joined by [[model.lines]]")
    return found


def picture_of(
    points: Mapping[str, Sequence[float]], lines: Sequence[LineTable], parameters: Sequence[ParameterTable]
) -> LinePicture | None:
    """Return the structure as lines for plotting, or None if there are no lines."""
    if not lines:
        return None
    names = list(points)
    ends = np.array([[names.index(name) for name in line.points] for line in lines])
    changed = np.array([[table.name in line.parameters for table in parameters] for line in lines], dtype=bool)
    return LinePicture(names, np.array([points[name] for name in names], dtype=float), ends, changed)
