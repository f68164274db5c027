"""``[measurement.geometry]``: coordinates of measurement points, used to match the points to nodes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self

from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from fmu.arguments import ArgumentError
from fmu.config.mistakes import BrokenError
from fmu.config.tables import Built, FileName, Name, TomlTable, Vector, reading
from fmu.fem.pairing.matching import Matching, match_points
from fmu.formats.modes.csv import read_points
from fmu.formats.modes.measured_modes import Place
from fmu.formats.modes.uff_nodes import read_uff_points

WHERE = "measurement.geometry"
_UNIVERSAL = (".uff", ".unv")


class GeometryTable(TomlTable):
    """Coordinates of the measurement points, in the test's axes.

    If this table is given, sensors are at these points, and refer to them by name. The points are rotated and
    translated to fit the model, but never scaled or mirrored. Each sensor is placed at the node nearest to its
    point.
    """

    file: FileName | None = None
    """CSV table with columns point, x, y and z, or a universal file (.uff, .unv) with dataset 15 or 2411.

    Coordinates in other systems of the universal file (dataset 18 or 2420) are converted to its global axes.
    """
    points: Annotated[dict[Name, Vector], Field(min_length=1)] | None = None
    """Coordinates by point name, instead of a file."""
    unit: Literal["m", "mm", "cm", "in", "ft"] = "m"
    """Unit of the coordinates."""
    nodes: dict[Name, Place] = {}
    """Nodes of three or more points, if the fit alone is ambiguous, as for a symmetric structure."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.file is None) == (self.points is None):
            raise ValueError("must have either file or points")
        return self

    def build(self, folder: Path, built: Built) -> Matching:
        """Match the points to nodes.

        Raise BrokenError if this fails or if nodes have no coordinates.
        """
        model = built.separable
        if model is None or model.geometry is None:
            rule = "must be given with a model whose nodes have coordinates: of a frame, or exported with its mesh"
            raise BrokenError(ArgumentError(WHERE, rule))
        known = {point: built.at(place) for point, place in self.nodes.items()}
        try:
            return match_points(self._read(folder), model, self.unit, known)
        except ValueError as error:
            key, _, rule = str(error).partition(": ")
            if key not in ("nodes", "points"):
                key, rule = "points" if self.points else "file", str(error)
            raise BrokenError(ArgumentError(f"{WHERE}.{key}", rule)) from None

    def _read(self, folder: Path) -> Mapping[str, ArrayLike]:
        if self.points is not None:
            return self.points
        path = folder / str(self.file)
        with reading(f"{WHERE}.file"):
            return read_uff_points(path) if path.suffix.lower() in _UNIVERSAL else read_points(path)
