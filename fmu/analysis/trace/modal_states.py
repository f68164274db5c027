"""The modes of a structure before and after updating: frequencies, shapes and MAC."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.maxima.results import Maxima
from fmu.analysis.trace.reading import parameter_draws, with_group
from fmu.fem.modes.modal import mac
from fmu.progress.phases import advanced, phase
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.fem.modes.separable import SeparableModel
    from fmu.fem.pairing.paired_model import PairedStructure
    from fmu.posterior.problem import UpdatingProblem


GROUP = "modes"
"""Group of a trace that stores them."""
START, MEAN, MAXIMUM = "start", "posterior mean", "maximum"
MEASURED = "measured shapes, at the sensors"
"""Reference of the MAC if shapes were measured."""
_AXES = ("x", "y", "z")


def with_modes(trace: xr.DataTree, problem: UpdatingProblem, maxima: Maxima | None = None) -> xr.DataTree:
    """Return the trace with the modes before and after updating stored in it."""
    states = states_of(trace, problem, maxima)
    with phase("modes", len(states)):
        return with_group(trace, GROUP, modal_states(problem, states))


def states_of(trace: xr.DataTree, problem: UpdatingProblem, maxima: Maxima | None = None) -> dict[str, FloatArray]:
    """Return the parameter vectors compared, by name: start, posterior mean, highest maximum if known."""
    states = {START: problem.start, MEAN: parameter_draws(trace).mean(axis=(0, 1))}
    if maxima is not None:
        states[MAXIMUM] = maxima[0].theta
    return states


def modal_states(problem: UpdatingProblem, states: Mapping[str, ArrayLike]) -> xr.Dataset:
    """Solve the full model at given parameter vectors.

    Parameters
    ----------
    problem : UpdatingProblem
    states : mapping of str to array_like, shape (ndim,)
        Parameter vectors in SI units, by name; shapes are compared with those of the first.

    Returns
    -------
    xarray.Dataset
        ``theta`` (state, parameter); ``frequency`` (state, mode), Hz, paired with the measured modes. Of a
        structure given by its matrices also ``mac`` (state, reference_mode, mode): with the measured shapes at the
        sensors if there are any, else with the shapes of the first state at all translations, as
        ``mac.attrs["reference"]`` says. Where its geometry is known too, ``displacement`` (state, mode, node,
        direction), the largest of each mode being 1, ``coordinates`` (node, direction) in m and ``ends``
        (element, end), the nodes that each element joins.

    Raises
    ------
    ValueError
        If there is no state, or one does not have ndim parameters.
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
    model = problem.model.as_structure()
    if model is not None:
        shapes = _aligned(np.array([_shapes(model, point) for point in theta[:, : problem.n_structural]]))
        variables |= _shape_variables(problem, model.structure, shapes)
    return xr.Dataset(
        variables,
        coords={"state": list(states), "parameter": list(problem.names), "mode": labels, "reference_mode": labels},
    )


def _shapes(model: PairedStructure, theta: FloatArray) -> FloatArray:
    """Return the shapes of the modes, (n_dof, n_modes), at one theta."""
    shapes = model.full_shapes(theta)
    advanced()
    return shapes


def _aligned(shapes: FloatArray) -> FloatArray:
    """Return shapes (states, n_dof, n_modes) with the signs of the first state's."""
    sign = np.where(np.einsum("sdm,dm->sm", shapes, shapes[0]) < 0, -1.0, 1.0)
    return np.asarray(shapes * sign[:, None, :])


def _shape_variables(problem: UpdatingProblem, structure: SeparableModel, shapes: FloatArray) -> dict[str, Any]:
    if problem.data.shapes is None:
        seen, name = shapes[:, structure.translations], "modes before updating, at all translations"
        reference = seen[0]
    else:
        seen = structure.observation(problem.data.sensors).toarray() @ shapes
        reference, name = np.asarray(problem.data.shapes), MEASURED
    alike = mac(seen, reference)
    variables: dict[str, Any] = {"mac": (("state", "reference_mode", "mode"), alike, {"reference": name})}
    if structure.geometry is None:
        return variables
    nodes = np.asarray(structure.geometry.nodes)
    moved = np.zeros((len(shapes), shapes.shape[2], len(nodes), 3))
    for (node, direction), i in structure.dof_of.items():
        if direction in _AXES:
            moved[:, :, node, _AXES.index(direction)] = shapes[:, i]
    size = np.max(np.linalg.norm(moved, axis=3), axis=2)[..., None, None]
    return variables | {
        "displacement": (("state", "mode", "node", "direction"), moved / np.where(size > 0, size, 1.0)),
        "coordinates": (("node", "direction"), nodes, {"units": "m"}),
        "ends": (("element", "end"), np.asarray(structure.geometry.elements)),
        "direction": ("direction", list(_AXES)),
    }
