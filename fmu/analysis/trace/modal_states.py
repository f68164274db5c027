"""Modes of the structure before and after updating: frequencies, mode shapes and MAC."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.maxima.results import Maxima
from fmu.analysis.trace.reading import has, parameter_draws, with_group
from fmu.fem.frame.drawing import SENSORS, Sketch, sketch
from fmu.fem.modes.modal import mac
from fmu.fem.pairing.expansion import serep
from fmu.fem.pairing.paired_structure import structure_of
from fmu.fem.reduced.reduced_structure import reduced_structures
from fmu.posterior.card import structure_sketch
from fmu.posterior.joint.model_in_tests import ModelInTests
from fmu.progress.phases import advance_phase, phase
from fmu.types import Dof, FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.fem.modes.separable import SeparableModel
    from fmu.posterior.data.modal_data import ModalData
    from fmu.posterior.problem import UpdatingProblem


GROUP = "modes"
_STRUCTURE = "structure"
"""Name of the trace group that stores the drawing of the structure if there are several tests."""
START, MEAN, MAXIMUM = "start", "posterior mean", "maximum"
MEASURED = "measured shapes, at the sensors"
"""MAC reference if shapes were measured."""
_AXES = ("x", "y", "z")
_MOST_COMPONENTS = 40
"""Largest number of translations stored for a structure without geometry.

If the structure has more, only those at sensors are stored."""


def with_modes(trace: xr.DataTree, problem: UpdatingProblem, maxima: Maxima | None = None) -> xr.DataTree:
    """Return the trace with the modes before and after updating added to it."""
    states = states_of(trace, problem, maxima)
    with phase("modes", len(states)):
        return with_group(trace, GROUP, modal_states(problem, states))


def states_of(trace: xr.DataTree, problem: UpdatingProblem, maxima: Maxima | None = None) -> dict[str, FloatArray]:
    """Return the parameter vectors to compare, keyed by state.

    The states are ``"start"``, before updating; ``"posterior mean"``; and ``"maximum"``, the highest maximum of
    the posterior. The last one is missing if `maxima` is None.
    """
    states = {START: problem.start, MEAN: parameter_draws(trace).mean(axis=(0, 1))}
    if maxima is not None:
        states[MAXIMUM] = maxima[0].theta
    return states


def modal_states(problem: UpdatingProblem, states: Mapping[str, ArrayLike]) -> xr.Dataset:
    """Return the modes of the structure at given parameter vectors.

    Parameters
    ----------
    problem : UpdatingProblem
    states : mapping of str to array_like, shape (ndim,)
        Parameter vectors in SI units, keyed by state. Without measured shapes, mode shapes are compared with
        those in the first state.

    Returns
    -------
    xarray.Dataset
        - Always: ``theta`` (state, parameter), and ``frequency`` (state, mode) in Hz, paired with the measured
          modes.

        For one test of a structure with system matrices, also:

        - ``mac`` (state, reference_mode, mode): the MAC with the measured shapes at the sensors. Without measured
          shapes, it is the MAC with the first state's shapes at all translations. ``mac.attrs["reference"]`` names
          the reference shapes.
        - If shapes were measured: ``component`` (state, mode, place), the computed shapes at the sensors, and
          ``measured`` (mode, place).
        - If the geometry is known: ``displacement`` (state, mode, node, direction). The largest displacement of
          each mode is 1, and ``component`` is divided by the same number.
        - If the geometry or lines for plotting are known: the variables that `sketch_of` reads.
        - If the geometry is known and shapes were measured: ``site`` (place, direction), the sensors' positions in
          m, and ``expanded`` (mode, node, direction), the measured shapes in their own scale, expanded to the
          nodes by the modes in the second state (the posterior mean in a trace). If there are too few sensors,
          ``expanded`` is missing.
        - If the geometry is not known: the largest value of ``component`` in each mode is 1. If there are at most
          40 translations, the places are all translations, even if no shapes were measured.

        For several tests that measured shapes at the same sensors, also:

        - ``of_test`` (mode), the name of the test; ``computed_in_test`` (state, mode, sensor) and
          ``measured_in_test`` (mode, sensor), the shapes at the sensors; and ``mac_in_test`` (state, mode), the
          MAC of each computed shape with the measured one.

    Raises
    ------
    ValueError
        If there is no state, or a state does not have ndim parameters.
    """
    import xarray as xr

    if not states:
        raise ValueError("states: at least one is needed (got none)")
    theta = np.array([np.asarray(point, dtype=float) for point in states.values()])
    labels = list(problem.data.labels)
    variables: dict[str, Any] = {
        "theta": (("state", "parameter"), theta),
        "frequency": (("state", "mode"), problem.frequencies(theta), {"units": "Hz"}),
    }
    model = structure_of(problem.model)
    if model is not None:
        structural = problem.model_parameters(theta)
        full, shapes = next(iter(reduced_structures(problem.model)), model), []
        for point in structural:
            shapes.append(full.shapes(point))
            advance_phase()
        variables |= _shape_variables(problem, model.structure, _align_signs(np.array(shapes)))
    elif problem.model.n_tests > 1 and problem.data.shapes is not None and problem.model.gives_shapes:
        variables |= _shapes_in_tests(problem, theta)
    return xr.Dataset(
        variables,
        coords={"state": list(states), "parameter": list(problem.names), "mode": labels, "reference_mode": labels},
    )


def _shapes_in_tests(problem: UpdatingProblem, theta: FloatArray) -> dict[str, Any]:
    """Return computed and measured mode shapes at all tests' sensors, and their MAC, as dataset variables."""
    seen = problem.model.observed(problem.model_parameters(theta)).shapes
    measured = np.asarray(problem.data.shapes)
    pairs = [mac(seen[:, :, [k]], measured[:, [k]])[:, 0, 0] for k in range(measured.shape[1])]
    return {
        "of_test": ("mode", [problem.tests[t].name for t in problem.model.test_of_modes]),
        "computed_in_test": (("state", "mode", "sensor"), seen.swapaxes(1, 2)),
        "measured_in_test": (("mode", "sensor"), measured.T),
        "mac_in_test": (("state", "mode"), np.stack(pairs, axis=1)),
        "sensor": sensor_names(problem.model.parts[0].structure, problem.data.sensors),
    }


def sensor_names(structure: SeparableModel | None, sensors: Sequence[Dof]) -> list[str]:
    """Return each sensor (place, direction) as text, with the place's name in the problem file if it has one."""
    names = {} if structure is None else structure.place_names
    return [f"{names.get(place, place)} {direction}" for place, direction in sensors]


def _align_signs(shapes: FloatArray) -> FloatArray:
    """Flip mode shapes (states, n_dof, n_modes) so that their signs agree with the first state's."""
    sign = np.where(np.einsum("sdm,dm->sm", shapes, shapes[0]) < 0, -1.0, 1.0)
    return np.asarray(shapes * sign[:, None, :])


def _shape_variables(problem: UpdatingProblem, structure: SeparableModel, shapes: FloatArray) -> dict[str, Any]:
    data = problem.data
    if data.shapes is None:
        seen, name = shapes[:, structure.translations], "modes before updating, at all translations"
        reference = seen[0]
    else:
        seen = structure.observation(data.sensors).toarray() @ shapes
        reference, name = np.asarray(data.shapes), MEASURED
    alike = mac(seen, reference)
    variables: dict[str, Any] = {"mac": (("state", "reference_mode", "mode"), alike, {"reference": name})}
    if structure.geometry is None:
        drawn = {} if structure.picture is None else _sketch_variables(sketch(structure, data.sensors))
        return variables | drawn | _components(structure, data, shapes)
    sketched = sketch(structure, data.sensors)
    moved = _displace_nodes(structure, shapes)
    size = np.max(np.linalg.norm(moved, axis=3), axis=2)
    size[size == 0] = 1.0
    variables |= _sketch_variables(sketched) | _components(structure, data, shapes, size)
    variables["displacement"] = (("state", "mode", "node", "direction"), moved / size[..., None, None])
    if data.shapes is not None:
        try:
            whole = serep(reference, structure.observation(data.sensors), shapes[min(1, len(shapes) - 1)])
            variables["expanded"] = (("mode", "node", "direction"), _displace_nodes(structure, whole[None])[0])
        except ValueError:  # too few sensors for so many modes
            pass
    if "component" in variables:
        sensors = zip(data.sensors, sketched.places[np.isin(sketched.kinds, SENSORS)], strict=True)
        site = {_without_sign(sensor): place for sensor, place in sensors}
        variables["site"] = (("place", "direction"), np.array(list(site.values())), {"units": "m"})
    return variables


def _displace_nodes(structure: SeparableModel, shapes: FloatArray) -> FloatArray:
    """Return displacements of drawn nodes, (states, n_modes, n_nodes, 3), for shapes (states, n_dof, n_modes)."""
    assert structure.geometry is not None
    row_of_drawn = {int(row): i for i, row in enumerate(structure.geometry.drawn)}
    moved = np.zeros((len(shapes), shapes.shape[2], len(row_of_drawn), 3))
    for row, direction, seen_by in structure.locate_motions():
        if direction in _AXES and row in row_of_drawn:
            motion = sum(weight * shapes[:, i] for i, weight in seen_by.items())
            moved[:, :, row_of_drawn[row], _AXES.index(direction)] = motion
    return moved


def _without_sign(sensor: Dof) -> Dof:
    """Return the degree of freedom that a sensor measures, without the sensor's polarity."""
    return sensor[0], sensor[1].removeprefix("-")


def _components(
    structure: SeparableModel, data: ModalData, shapes: FloatArray, size: FloatArray | None = None
) -> dict[str, Any]:
    """Return computed and measured mode shapes as dataset variables, or an empty dict if there are no places.

    If the structure has no geometry and at most 40 translations, the places are all translations. Otherwise they
    are the sensors of the measured shapes. Measured shapes are NaN at places without a sensor. The computed shapes
    are divided by `size` (states, n_modes) or, if `size` is None, by the absolute value of their largest
    component.
    """
    sign = [-1.0 if direction.startswith("-") else 1.0 for _, direction in data.sensors]
    measured: dict[Dof, FloatArray] = {}
    if data.shapes is not None:
        rows = np.asarray(data.shapes) * np.array(sign)[:, None]
        measured = dict(zip(map(_without_sign, data.sensors), rows, strict=True))
    places = list(measured)
    if structure.geometry is None and len(structure.translations) <= _MOST_COMPONENTS:
        places = [structure.dofs[i] for i in structure.translations]
    if not places:
        return {}
    seen = structure.observation(places).toarray() @ shapes
    if size is None:
        size = np.max(np.abs(seen), axis=1)
        size[size == 0] = 1.0
    nothing = np.full(shapes.shape[2], np.nan)
    found: dict[str, Any] = {
        "component": (("state", "mode", "place"), (seen / size[:, None]).swapaxes(1, 2)),
        "place": sensor_names(structure, places),
    }
    if measured:
        found["measured"] = (("mode", "place"), np.array([measured.get(place, nothing) for place in places]).T)
    return found


def _sketch_variables(found: Sketch) -> dict[str, Any]:
    """Return the sketch of a structure as dataset variables, which `sketch_of` reads."""
    variables = {
        "coordinates": (("node", "direction"), found.nodes, {"units": "m"}),
        "ends": (("element", "end"), found.elements),
        "changed": (("element", "structural"), found.changed.astype(np.int8)),
        "direction": ("direction", list(_AXES)),
    }
    if found.kinds:
        variables["symbol"] = ("symbol", list(found.kinds))
        variables["symbol_place"] = (("symbol", "direction"), found.places, {"units": "m"})
        variables["symbol_end"] = (("symbol", "direction"), found.ends)
        variables["symbol_parameter"] = ("symbol", found.owners)
    return variables


def drawn_structure(problem: UpdatingProblem) -> dict[str, xr.Dataset]:
    """Return the sketch of a structure with several tests as a trace group in a dict.

    The dict is empty if the model has no matrices, or has neither geometry nor lines for plotting. `sketch_of`
    reads the group.
    """
    import xarray as xr

    found = structure_sketch(problem) if isinstance(problem.model, ModelInTests) else None
    if found is None:
        return {}
    names = [parameter.name for parameter in problem.layout.structural]
    return {_STRUCTURE: xr.Dataset(_sketch_variables(found), coords={"structural": names})}


def sketch_of(trace: xr.DataTree) -> Sketch | None:
    """Return the sketch of the structure, or None if the trace stores none.

    A trace stores none if the model has neither geometry nor lines for plotting, or if an older version of fmu
    wrote the trace.
    """
    group = next((name for name in (GROUP, _STRUCTURE) if has(trace, name, "changed")), None)
    if group is None:
        return None
    modes = trace[group].to_dataset()
    kinds = tuple(map(str, modes["symbol"].to_numpy())) if "symbol" in modes else ()
    places, ends = (
        modes[name].to_numpy() if kinds else np.empty((0, 3)) for name in ("symbol_place", "symbol_end")
    )
    nodes, elements = modes["coordinates"].to_numpy(), modes["ends"].to_numpy()
    owners = modes["symbol_parameter"].to_numpy() if "symbol_parameter" in modes else np.full(len(kinds), -1)
    return Sketch(nodes, elements, modes["changed"].to_numpy().astype(bool), kinds, places, ends, owners)
