"""Lines for plotting structures that are known only by their matrices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmu.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class LinePicture:
    """Lines between named points, used only for plots.

    Attributes
    ----------
    names : sequence of str
        Point names; a sensor at a place of the same name is plotted at that point.
    points : ndarray, shape (n_points, 3), m
    lines : ndarray of int, shape (n_lines, 2)
        Indices of the points at both ends of each line.
    changed : ndarray of bool, shape (n_lines, n_parameters)
        Whether each parameter changes the part of the structure that a line represents.

    Raises
    ------
    ValueError
        If the shapes of the arrays are inconsistent, or there are no lines.
    """

    names: Sequence[str]
    points: FloatArray
    lines: IntArray
    changed: BoolArray

    def __post_init__(self) -> None:
        if np.shape(self.points) != (len(self.names), 3):
            raise ValueError(f"points: must have x, y, z for each name (got shape {np.shape(self.points)})")
        if np.shape(self.lines) != (len(self.changed), 2) or not len(self.lines):
            raise ValueError(f"lines: must be two points for each row of changed (got {np.shape(self.lines)})")

    def of(self, parameters: Sequence[int]) -> LinePicture:
        """Return the same lines for a subset of the parameters, given by their indices."""
        return replace(self, changed=self.changed[:, list(parameters)])
