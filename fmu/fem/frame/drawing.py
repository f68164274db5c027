"""Line plots of structures in SVG, without any plotting library."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmu.fem.frame.changed_elements import changed_elements, geometry_of
from fmu.fem.modes.line_picture import LinePicture
from fmu.fem.modes.separable import SeparableModel
from fmu.types import BoolArray, Dof, FloatArray, IntArray

COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")
"""Okabe & Ito's colour-blind safe palette."""
UNCHANGED = "#6E6E6E"
WIDTH, _HEIGHT, _MARGIN = 560.0, 260.0, 26.0
_FLAT = 1e-6
_MOST_LINES = 300
"""Largest number of lines for which each line is a separate SVG element."""
_AXES = ("x", "y", "z")
SENSORS = ("sensor", "rotation")
"""Kinds of symbols for sensors of displacements and of rotations."""


@dataclass(frozen=True, eq=False)
class Sketch:
    """Lines and symbols that represent a structure in a plot.

    Attributes
    ----------
    nodes : ndarray, shape (n_nodes, 3), m
    elements : ndarray of int, shape (n_elements, 2)
    changed : ndarray of bool, shape (n_elements, n_parameters)
        Whether each parameter changes each element; see `changed_elements`.
    kinds : tuple of str
        Kind of each symbol: ``"arm"``, ``"spring"``, ``"support"``, ``"mass"``, ``"sensor"`` or ``"rotation"``, a
        sensor of a rotation.
    places : ndarray, shape (n_symbols, 3), m
        NaN for sensors at unknown places, which are not plotted.
    ends : ndarray, shape (n_symbols, 3)
        Far end of an arm or a spring, m; direction of a sensor, or the axis of the rotation that it measures. NaN
        for supports, masses and springs to the ground.
    owners : ndarray of int, shape (n_symbols,)
        Index of the first parameter that changes a spring's stiffness; −1 for all other springs and symbols.
    """

    nodes: FloatArray
    elements: IntArray
    changed: BoolArray
    kinds: tuple[str, ...]
    places: FloatArray
    ends: FloatArray
    owners: IntArray


def sketch(model: SeparableModel, sensors: Sequence[Dof] = ()) -> Sketch:
    """Return the sketch of a structure with its sensors, each given as (place, direction).

    Raises
    ------
    ValueError
        If the model has neither a geometry nor lines for plotting.
    """
    if model.geometry is None and model.picture is not None:
        return _sketch_picture(model.picture, sensors)
    geometry, nowhere = geometry_of(model), np.full(3, np.nan)
    nodes = np.asarray(geometry.nodes, dtype=float)
    at = {name: nodes[row] for name, row in geometry.row_of.items()}
    tips = {name: at[arm.node] + arm.offset for name, arm in model.arms.items()}
    place = at | tips  # a sensor may be at a node that is not in the mesh
    symbols = [("arm", at[model.arms[name].node], tip) for name, tip in tips.items()]
    n_arms = len(symbols)
    symbols += [("spring", nodes[a], nowhere if b is None else nodes[b]) for a, b in geometry.springs]
    symbols += [("support", nodes[node], nowhere) for node in _find_supports(model)]
    symbols += [("mass", nodes[node], nowhere) for node in geometry.masses]
    symbols += [(_kind_of(d), place.get(n, nowhere), axis_of(d)) for n, d in sensors]
    kinds = tuple(kind for kind, *_ in symbols)
    places, ends = (np.array([symbol[k] for symbol in symbols]).reshape(-1, 3) for k in (1, 2))
    owners = np.full(len(symbols), -1)
    for k, parameter in enumerate(geometry.spring_parameters, n_arms):
        owners[k] = -1 if parameter is None else parameter
    lines = np.searchsorted(geometry.drawn, geometry.elements)
    return Sketch(nodes[geometry.drawn], lines, changed_elements(model), kinds, places, ends, owners)


def is_drawable(model: SeparableModel, most: float) -> bool:
    """Return True if the model can be plotted with at most `most` lines."""
    lines = model.picture.lines if model.geometry is None and model.picture is not None else None
    lines = model.geometry.elements if model.geometry is not None else lines
    return lines is not None and len(lines) <= most


def _sketch_picture(picture: LinePicture, sensors: Sequence[Dof]) -> Sketch:
    """Return the sketch of a `LinePicture`: its lines, and each sensor at the point with the same name.

    Sensors at other places are left out.
    """
    place = dict(zip(picture.names, np.asarray(picture.points, dtype=float), strict=True))
    seen = [(n, d) for n, d in sensors if n in place]
    places = np.array([place[n] for n, _ in seen]).reshape(-1, 3)
    ends = np.array([axis_of(d) for _, d in seen]).reshape(-1, 3)
    kinds = tuple(_kind_of(d) for _, d in seen)
    nodes = np.array(list(place.values()))
    return Sketch(nodes, np.asarray(picture.lines), picture.changed, kinds, places, ends, np.full(len(seen), -1))


def drawing(model: SeparableModel, sensors: Sequence[Dof] = ()) -> str:
    """Return a plot of a structure with its sensors as SVG; see `draw_svg`.

    Raise ValueError if there is nothing to plot.
    """
    return draw_svg(sketch(model, sensors))


def draw_svg(
    structure: Sketch,
    colours: Sequence[str] | None = None,
    said: str = "",
    spring_colours: Sequence[str] | None = None,
) -> str:
    """Return a plot of a sketch as SVG, with elements and springs in the colours of the parameters.

    Each element or spring has the colour of the first parameter that changes it. Squares are supports, discs are
    masses, zigzags are springs (rings between coincident nodes), thin lines are rigid arms, and arrows are sensors
    (dots if they point at the reader or away). Arrows with two heads are axes of sensors of rotations, by the
    right-hand rule (curved arrows if they point at the reader or away). Sensors at unknown places are not plotted.

    Parameters
    ----------
    structure : Sketch
    colours : sequence of str, length n_elements, optional
        Element colours, instead of the parameters' colours.
    said : str
        Description of the plot for readers who cannot see it.
    spring_colours : sequence of str, length n_parameters, optional
        Spring colours for each parameter, instead of the default colours.

    Returns
    -------
    str
        An SVG element.
    """
    view, kinds = view_of(structure.nodes).T, np.array(structure.kinds)
    tips = structure.ends[kinds == "arm"]
    n, fit = len(structure.nodes), _fit(np.concatenate([structure.nodes, tips]) @ view)
    place, places, ends = (fit(x @ view) for x in (structure.nodes, structure.places, structure.ends))
    colours = element_colours(structure.changed) if colours is None else colours
    parts = [_line(a, b, UNCHANGED, 1.5) for a, b in zip(places[kinds == "arm"], fit(tips @ view), strict=True)]
    parts += _lines(place[structure.elements], colours)
    towards_reader = np.cross(*view.T)
    pointings = structure.ends @ np.column_stack([view, towards_reader])
    symbols = zip(structure.kinds, places, ends, pointings, structure.owners, strict=True)
    for kind, a, b, pointing, owner in symbols:
        if kind == "spring":
            of_parameters = COLOURS if spring_colours is None else spring_colours
            parts.append(_spring(a, b, of_parameters[owner % len(of_parameters)] if owner >= 0 else ""))
        elif kind == "support":
            parts.append(_support(a))
        elif kind == "mass":
            parts.append(_dot(a, 6, UNCHANGED))
        elif kind in SENSORS and not np.isnan([*a, *pointing]).any():
            parts.append(_arrow(a, pointing[:2]) if kind == "sensor" else _rotation(a, pointing))
    n_sensors = np.sum(np.isin(kinds, SENSORS))
    words = said or f"{n} nodes, {len(structure.elements)} elements, {n_sensors} sensors"
    width, height = np.concatenate([place, fit(tips @ view)]).max(axis=0) + _MARGIN
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'aria-label="The structure: {html.escape(words)}" style="width:100%;max-width:{width:.0f}px">'
        f"{''.join(parts)}</svg>"
    )


def without_sensors(structure: Sketch) -> Sketch:
    """Return the sketch without its sensors."""
    others = np.array([kind not in SENSORS for kind in structure.kinds], dtype=bool)
    kinds = tuple(kind for kind in structure.kinds if kind not in SENSORS)
    places, ends, owners = structure.places[others], structure.ends[others], structure.owners[others]
    return replace(structure, kinds=kinds, places=places, ends=ends, owners=owners)


def element_colours(changed: BoolArray) -> list[str]:
    """Return each element's colour: the colour of the first parameter that changes it, or grey if none does."""
    first = [int(np.argmax(row)) if row.any() else None for row in changed]
    return [UNCHANGED if k is None else COLOURS[k % len(COLOURS)] for k in first]


def parameter_colours(structure: Sketch) -> list[str | None]:
    """Return, for each parameter, the colour of the first element that it changes.

    If it changes no element, return the colour of its springs, or None if it is not the first parameter of any
    spring.
    """
    colours = element_colours(structure.changed)
    return [
        colours[int(np.argmax(column))]
        if column.any()
        else COLOURS[k % len(COLOURS)]
        if k in structure.owners
        else None
        for k, column in enumerate(structure.changed.T)
    ]


def view_of(nodes: FloatArray) -> FloatArray:
    """Return the two axes of the plot, shape (2, 3).

    Structures in a plane parallel to a coordinate plane are viewed face-on, and all others from a corner.
    """
    extent = np.ptp(nodes, axis=0)
    is_flat = extent <= _FLAT * extent.max()
    if is_flat[1]:
        return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    if is_flat[0]:
        return np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    if is_flat[2]:
        return np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return np.array([[0.87, 0.5, 0.0], [-0.25, 0.43, 0.87]])


def _kind_of(direction: str) -> str:
    return "rotation" if is_rotation(direction) else "sensor"


def is_rotation(direction: str) -> bool:
    """Return True for a direction such as ``"rx"`` or ``"-rx"``."""
    return "r" in direction


def axis_of(direction: str) -> FloatArray:
    """Return the unit vector (3,) of a direction such as ``"-z"``, or of the axis of one such as ``"rx"``."""
    unit = np.zeros(3)
    unit[_AXES.index(direction[-1])] = -1.0 if direction.startswith("-") else 1.0
    return unit


def _fit(points: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return a function that maps points (n, 2), y upwards, to plot coordinates.

    The plot contains all `points`.
    """
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    room = np.array([WIDTH, _HEIGHT]) - 2.0 * _MARGIN
    scale = np.min(room[extent > 0] / extent[extent > 0]) if np.any(extent > 0) else 1.0
    bottom = _MARGIN + scale * extent[1]

    def fit_view(points: FloatArray) -> FloatArray:
        x, y = scale * (points - low).T
        return np.stack([_MARGIN + x, bottom - y], axis=1)

    return fit_view


def _find_supports(model: SeparableModel) -> list[int]:
    """Return the rows of the element nodes that can move in fewer directions than the freest node.

    Rotations are ignored in a mesh from another program, because its nodes may lack rotations without being fixed.
    """
    geometry = geometry_of(model)
    free: dict[int, set[str]] = {}
    for row, direction, _ in model.locate_motions():
        if geometry.ids is None or direction in _AXES:
            free.setdefault(row, set()).add(direction)
    most = max((len(directions) for directions in free.values()), default=0)
    return [int(row) for row in np.unique(geometry.elements) if len(free.get(int(row), ())) < most]


def _lines(ends: FloatArray, colours: Sequence[str]) -> list[str]:
    """Return SVG elements for lines (n, 2, 2): one per line or, if there are many, one path per colour."""
    if len(ends) <= _MOST_LINES:
        return [_line(a, b, colour, 4) for (a, b), colour in zip(ends, colours, strict=True)]
    parts: dict[str, list[str]] = {}
    for (a, b), colour in zip(ends, colours, strict=True):
        parts.setdefault(colour, []).append(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}")
    return [
        f'<path d="{"".join(part)}" fill="none" stroke="{colour}" stroke-width="1.2" stroke-linecap="round"/>'
        for colour, part in parts.items()
    ]


def _line(a: FloatArray, b: FloatArray, colour: str, width: float) -> str:
    return (
        f'<line x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}" stroke="{colour}" '
        f'stroke-width="{width:g}" stroke-linecap="round"/>'
    )


def _support(at: FloatArray) -> str:
    x, y = at - 7.0
    line = 'fill="none" stroke="currentColor" stroke-width="1.5"'
    return f'<rect x="{x:.1f}" y="{y:.1f}" width="14" height="14" {line}/>'


def _dot(at: FloatArray, radius: float, colour: str) -> str:
    return f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius:g}" fill="{colour}"/>'


def _spring(a: FloatArray, b: FloatArray, colour: str = "") -> str:
    """Return a spring as SVG: a zigzag, with a ground line if b is NaN, or a ring if a and b coincide.

    A spring whose stiffness is set by a parameter is thicker and has the parameter's colour.
    """
    stroke = f'stroke="{colour or "currentColor"}" stroke-width="{3 if colour else 1.5}"'
    is_grounded = np.isnan(b).any()
    end = a + np.array([0.0, 22.0]) if is_grounded else b
    along = end - a
    length = float(np.linalg.norm(along))
    if length < _FLAT:
        return f'<circle cx="{a[0]:.1f}" cy="{a[1]:.1f}" r="6" style="fill:var(--paper,#fff)" {stroke}/>'
    across = 5.0 * np.array([-along[1], along[0]]) / length
    steps = [(0.0, 0), (0.2, 0), (0.3, 1), (0.5, -1), (0.7, 1), (0.8, 0), (1.0, 0)]
    zigzag = " ".join(f"{x:.1f},{y:.1f}" for x, y in (a + t * along + side * across for t, side in steps))
    half = np.array([8.0, 0.0])
    ground = _line(end - half, end + half, "currentColor", 2) if is_grounded else ""
    return f'<polyline points="{zigzag}" fill="none" {stroke}/>' + ground


def _arrow(at: FloatArray, direction: FloatArray, heads: int = 1) -> str:
    """Return a sensor as SVG: an arrow in its direction (2,), or a dot if it points at the reader or away."""
    along = direction * (1.0, -1.0)
    length = float(np.linalg.norm(along))
    if length < _FLAT:
        return _dot(at, 4, "currentColor")
    along = along / length
    tip = at + (12.0 + 6.0 * heads) * along
    tips = (_head(tip - 6.0 * k * along, along) for k in range(heads))
    return _line(at, tip, "currentColor", 1.5) + "".join(tips)


def _rotation(at: FloatArray, axis: FloatArray) -> str:
    """Return a sensor of a rotation as SVG: a two-headed arrow, or a curved one if its axis is along the view.

    The components of `axis` (3,) are to the right, upwards and towards the reader.
    """
    if np.linalg.norm(axis[:2]) >= _FLAT:
        return _arrow(at, axis[:2], heads=2)
    side, sweep = (1.0, 0) if axis[2] > 0 else (-1.0, 1)
    x, y = at
    arc = f"M{x + 9.0 * side:.1f} {y:.1f}A9 9 0 1 {sweep} {x:.1f} {y + 9.0:.1f}"
    line = 'fill="none" stroke="currentColor" stroke-width="1.5"'
    return f'<path d="{arc}" {line}/>' + _head(np.array([x + 7.0 * side, y + 9.0]), np.array([side, 0.0]))


def _head(tip: FloatArray, along: FloatArray) -> str:
    across = np.array([-along[1], along[0]])
    corners = (tip, *(tip - 7.0 * along + s * 4.0 * across for s in (1, -1)))
    return f'<polygon points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in corners)}" fill="currentColor"/>'
