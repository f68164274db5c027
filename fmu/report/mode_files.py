"""Write updated and measured mode shapes for ParaView (VTU) and for modal-testing software (UFF)."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.expansion import Expanded, expand
from fmu.fem.pairing.paired_structure import structure_of
from fmu.formats.decks import MEASURED_MODES, MESH_MODES, UPDATED_MODES
from fmu.formats.modes.uff import write_uff
from fmu.formats.modes.vtu import cells, write_vtu
from fmu.numbers import given, hertz, share
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

_AXES = ("x", "y", "z")
_KEPT = 0.9
"""Smallest share of a measured shape that its expansion must keep; a smaller share causes a warning."""


def write_modes(problem: UpdatingProblem, theta: FloatArray, folder: Path) -> list[str]:
    """Write the structure's mode shapes at `theta` (ndim,), and the measured mode shapes, to `folder`.

    ``modes.vtu`` contains the mesh and the displacements in each updated mode and in each measured mode. Measured
    modes are expanded by SEREP (`fmu.fem.pairing.expansion`) and scaled to the updated mode; they are left out if
    the expansion fails. Two universal files are written if pyuff is installed. ``updated.uff`` contains nodes
    (dataset 2411), elements (2412) and updated modes (55). ``measured.uff``, which is written if shapes were
    measured, contains the sensor locations (2411) and the measured modes (55). Nothing is written if the model is
    not a structure with a geometry, or if there are several tests.

    Returns
    -------
    list of str
        Warnings about the files, one sentence each.
    """
    paired = structure_of(problem.model)
    if paired is None or paired.structure.geometry is None:
        return []
    model, geometry, data = paired.structure, paired.structure.geometry, problem.data
    structural = problem.model_parameters(theta[None])[0]
    shapes, hz = paired.shapes(structural), problem.frequencies(theta)
    vectors = {f"updated {label}: {hertz(f)[0]} Hz": _move_nodes(model, x)
               for label, f, x in zip(data.labels, hz, shapes.T, strict=True)}  # fmt: skip
    found, remarks = _expand_shapes(problem, model, structural, shapes)
    if found is not None:
        seen = model.observation(data.sensors)
        for label, f, x, y in zip(
            data.labels, np.asarray(data.frequencies_hz), shapes.T, found.shapes.T, strict=True
        ):
            scale = float((seen @ x) @ (seen @ y)) / float(np.sum((seen @ y) ** 2))
            vectors[f"measured {label}: {given(f)} Hz, expanded"] = _move_nodes(model, scale * y)
    places, ids = np.asarray(geometry.nodes, dtype=float), list(geometry.row_of)
    elements: list[list[int]] = np.asarray(geometry.elements).tolist()
    kinds = ["line"] * len(elements)
    if geometry.mesh is not None:
        elements = [[geometry.row_of[node] for node in element] for element in geometry.mesh.elements]
        kinds = list(geometry.mesh.kinds)
    write_vtu(folder / MESH_MODES, places, elements, kinds, vectors, {"node": np.array(ids)})
    if find_spec("pyuff") is None:
        return remarks
    numbers = range(1, len(data.labels) + 1)
    corners = [(cell, tuple(ids[node] for node in nodes)) for cell, nodes in cells(elements, kinds)]
    by_id = dict(zip(ids, places, strict=True))
    motions = [(ids[row], direction) for row, direction, _ in model.locate_motions()]
    seen = model.observation(motions) @ shapes
    write_uff(folder / UPDATED_MODES, hz, seen, motions, numbers, places=by_id, elements=corners)
    if data.shapes is not None:
        used = dict.fromkeys(place for place, _ in data.sensors)
        beside = {
            place: max(ids) + 1 + k for k, place in enumerate(place for place in used if place in model.arms)
        }
        tips = {place: by_id[model.arms[place].node] + model.arms[place].offset for place in beside}
        write_uff(
            folder / MEASURED_MODES, data.frequencies_hz, data.shapes, data.sensors, numbers,
            {number: place for place, number in beside.items()},
            {place: where for place, where in (by_id | tips).items() if place in used},
        )  # fmt: skip
    return remarks


def _move_nodes(model: SeparableModel, shape: FloatArray) -> FloatArray:
    """Return the displacements of all mesh nodes, shape (n_nodes, 3), for a mode shape (n_dof,)."""
    assert model.geometry is not None
    moved = np.zeros((len(model.geometry.nodes), 3))
    for row, direction, seen_by in model.locate_motions():
        if direction in _AXES:
            moved[row, _AXES.index(direction)] = sum(weight * shape[i] for i, weight in seen_by.items())
    return moved


def _expand_shapes(
    problem: UpdatingProblem, model: SeparableModel, theta: FloatArray, shapes: FloatArray
) -> tuple[Expanded | None, list[str]]:
    """Return the measured shapes, expanded to all degrees of freedom, and a list of warnings.

    The first item is None if no shapes were measured or if the expansion fails. A warning lists the modes whose
    expansion keeps less than `_KEPT` of the measured shape.
    """
    data = problem.data
    if data.shapes is None:
        return None, []
    try:
        found = expand(model, theta, shapes, data.sensors, data.shapes, data.frequencies_hz)
    except ValueError as error:
        return None, [f"The measured shapes are not on the mesh: {error}."]
    few = [f"{label} ({share(kept)})" for label, kept in zip(data.labels, found.kept, strict=True) if kept < _KEPT]
    told = (
        f"Expanded, the measured shapes keep less than {share(_KEPT)} of what was measured: mode {', '.join(few)}."
    )
    return found, [told] if few else []
