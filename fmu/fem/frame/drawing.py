"""A structure as a line drawing in SVG, without any library."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np

from fmu.fem.modes.separable import Geometry, SeparableModel
from fmu.types import BoolArray, FloatArray

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
"""Okabe & Ito's colour-blind safe palette."""
UNCHANGED = "#6E6E6E"
_WIDTH, _HEIGHT, _MARGIN = 560.0, 260.0, 26.0
_FLAT = 1e-6
_AXES = ("x", "y", "z")
_ROTATIONS = ("rx", "ry", "rz")


def drawing(model: SeparableModel, sensors: Sequence[tuple[Any, str]] = ()) -> str:
    """Draw a structure: elements in the colour of the first parameter that changes them, and what is at the nodes.

    Squares are supports, discs masses, zigzags springs (rings between nodes at one place), arrows sensors.

    Parameters
    ----------
    model : SeparableModel
        With its geometry.
    sensors : sequence of (place, direction)
        Translations are marked by arrows, those of a rigid arm at its end.

    Returns
    -------
    str
        An SVG element.

    Raises
    ------
    ValueError
        If the model does not know its geometry.
    """
    geometry = _geometry(model)
    view = _view(geometry.nodes)
    at_node = {node: geometry.nodes[node] for node in range(len(geometry.nodes))}
    tips = {name: geometry.nodes[arm.node] + arm.offset for name, arm in model.arms.items()}
    points = at_node | tips
    place = dict(zip(points, _fitted(np.array(list(points.values())) @ view.T), strict=True))
    parts = [_line(place[model.arms[name].node], place[name], UNCHANGED, 1.5) for name in tips]
    parts += [
        _line(place[a], place[b], colour, 4)
        for (a, b), colour in zip(geometry.elements, element_colours(changed_elements(model)), strict=True)
    ]
    parts += [_spring(place[a], None if b is None else place[b]) for a, b in geometry.springs]
    parts += [_support(place[node]) for node in _supported(model)]
    parts += [_dot(place[node], 6, UNCHANGED) for node in geometry.masses]
    parts += [_arrow(place[n], _pointing(d) @ view.T) for n, d in sensors if d[-2:] not in _ROTATIONS]
    words = f"{len(at_node)} nodes, {len(geometry.elements)} elements, {len(sensors)} sensors"
    height = max(y for _, y in place.values()) + _MARGIN
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:.0f} {height:.0f}" role="img" '
        f'aria-label="The structure: {html.escape(words)}" style="width:100%;max-width:{_WIDTH:.0f}px">'
        f"{''.join(parts)}</svg>"
    )


def element_colours(changed: BoolArray) -> list[str]:
    """Return the colour of each element, from `changed_elements`: that of the first parameter that changes it."""
    first = [int(np.argmax(row)) if row.any() else None for row in changed]
    return [UNCHANGED if k is None else COLOURS[k % len(COLOURS)] for k in first]


def parameter_colours(model: SeparableModel) -> list[str | None]:
    """Return the colour of the elements that each parameter changes, None where it changes none."""
    changed = changed_elements(model)
    colours = element_colours(changed)
    return [colours[int(np.argmax(column))] if column.any() else None for column in changed.T]


def changed_elements(model: SeparableModel) -> BoolArray:
    """Return which parameter changes which element, shape (n_elements, n_parameters).

    It does where a term with it couples the element's ends, or where one end is held, loads the other.

    Raises
    ------
    ValueError
        If the model does not know its geometry.
    """
    elements = _geometry(model).elements
    dofs: dict[Any, list[int]] = {}
    for (node, _), i in model.dof_of.items():
        dofs.setdefault(node, []).append(i)
    ends = [(dofs.get(int(a), []), dofs.get(int(b), [])) for a, b in elements]
    changed = np.zeros((len(ends), model.n_parameters), dtype=bool)
    for term in (*model.K_terms, *model.M_terms):
        parameters = np.flatnonzero(term.powers)
        if not len(parameters):
            continue
        matrix, diagonal = term.matrix.tocsr(), term.matrix.diagonal()
        for e, (a, b) in enumerate(ends):
            if matrix[a][:, b].nnz > 0 if a and b else np.any(diagonal[a or b]):
                changed[e, parameters] = True
    return changed


def _pointing(direction: str) -> FloatArray:
    """Return the unit vector of ``"z"`` or ``"-z"``, shape (3,)."""
    unit = np.zeros(3)
    unit[_AXES.index(direction[-1])] = -1.0 if direction.startswith("-") else 1.0
    return unit


def _geometry(model: SeparableModel) -> Geometry:
    if model.geometry is None:
        raise ValueError("model: must have a geometry to be drawn (got none)")
    return model.geometry


def _view(nodes: FloatArray) -> FloatArray:
    """Return the picture's axes, shape (2, 3): a plane structure face on, others from a corner, z upwards."""
    extent = np.ptp(nodes, axis=0)
    is_flat = extent <= _FLAT * extent.max()
    if is_flat[1] or is_flat.sum() == 2:
        return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    if is_flat[2]:
        return np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    if is_flat[0]:
        return np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    return np.array([[0.87, 0.5, 0.0], [-0.25, 0.43, 0.87]])


def _fitted(points: FloatArray) -> FloatArray:
    """Return points (n, 2) in the picture, downwards from its top edge."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    room = np.array([_WIDTH, _HEIGHT]) - 2.0 * _MARGIN
    scale = np.min(room[extent > 0] / extent[extent > 0]) if np.any(extent > 0) else 1.0
    placed = _MARGIN + scale * (points - low)
    placed[:, 1] = placed[:, 1].max() + _MARGIN - placed[:, 1]
    return np.asarray(placed)


def _supported(model: SeparableModel) -> list[int]:
    """Return the nodes of elements that cannot move in every direction that others can."""
    free: dict[Any, set[str]] = {}
    for node, direction in model.dof_of:
        free.setdefault(node, set()).add(direction)
    most = max(len(directions) for directions in free.values())
    nodes = np.unique(_geometry(model).elements)
    return [int(node) for node in nodes if len(free.get(int(node), ())) < most]


def _line(a: FloatArray, b: FloatArray, colour: str, width: float) -> str:
    return (
        f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" stroke="{colour}" '
        f'stroke-width="{width:g}" stroke-linecap="round"/>'
    )


def _support(at: FloatArray) -> str:
    x, y = at - 7.0
    return f'<rect x="{x:.1f}" y="{y:.1f}" width="14" height="14" fill="none" stroke="#000" stroke-width="1.5"/>'


def _dot(at: FloatArray, radius: float, colour: str) -> str:
    return f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius:g}" fill="{colour}"/>'


def _spring(a: FloatArray, b: FloatArray | None) -> str:
    """Draw a zigzag, down to a line where it ends in the ground; a ring between two nodes at one place."""
    end = a + np.array([0.0, 22.0]) if b is None else b
    along = end - a
    length = float(np.linalg.norm(along))
    if length < _FLAT:
        return f'<circle cx="{a[0]:.1f}" cy="{a[1]:.1f}" r="6" fill="#fff" stroke="#000" stroke-width="1.5"/>'
    across = 5.0 * np.array([-along[1], along[0]]) / length
    steps = [(0.0, 0), (0.2, 0), (0.3, 1), (0.5, -1), (0.7, 1), (0.8, 0), (1.0, 0)]
    zigzag = " ".join(f"{x:.1f},{y:.1f}" for x, y in (a + t * along + side * across for t, side in steps))
    half = np.array([8.0, 0.0])
    ground = _line(end - half, end + half, "#000", 2) if b is None else ""
    return f'<polyline points="{zigzag}" fill="none" stroke="#000" stroke-width="1.5"/>' + ground


def _arrow(at: FloatArray, direction: FloatArray) -> str:
    """Draw an arrow in the direction of a sensor, a dot where it points at the reader."""
    along = direction * (1.0, -1.0)
    length = float(np.linalg.norm(along))
    if length < _FLAT:
        return _dot(at, 4, "#000")
    along = along / length
    across = np.array([-along[1], along[0]])
    tip = at + 18.0 * along
    head = " ".join(f"{x:.1f},{y:.1f}" for x, y in (tip, *(tip - 7.0 * along + s * 4.0 * across for s in (1, -1))))
    return _line(at, tip, "#000", 1.5) + f'<polygon points="{head}" fill="#000"/>'
