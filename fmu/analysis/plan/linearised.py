"""Linearise a planned test for each kind of model: candidate sensors, modes and derivatives."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fmu.analysis.plan.before import Before
from fmu.analysis.plan.candidates import (
    Candidates,
    find_candidates,
    group_candidates,
    require_places,
    require_sensors,
)
from fmu.analysis.plan.model_errors import with_errors
from fmu.analysis.plan.sensitivities import (
    UNSEEN,
    Sensitivities,
    of_model,
    of_structure,
    paired_with_itself,
    pick_modes,
)
from fmu.arguments import ArgumentError
from fmu.fem.modes.changes import Change, changed_model
from fmu.fem.modes.modal import assign, mac
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.paired_structure import PairedStructure, structure_of
from fmu.types import Dof, FloatArray


@dataclass(frozen=True, eq=False)
class Wishes:
    """The user's requirements on sensors, modes and second tests; see `fmu.plan`.

    Attributes
    ----------
    candidates : sequence of (place, direction), or None
    mounted : sequence of (place, direction)
    exclude : collection of place
    triaxial : bool
    costs : mapping of place to float
    modes : int or tuple of int
        Number of modes, or their 0-based indices.
    changes : mapping of str to Change
    """

    candidates: Sequence[Dof] | None
    mounted: Sequence[Dof]
    exclude: Collection[Any]
    triaxial: bool
    costs: Mapping[Any, float]
    modes: int | tuple[int, ...]
    changes: Mapping[str, Change]

    @property
    def of_sensors(self) -> tuple[Sequence[Dof], Collection[Any], bool, Mapping[Any, float]]:
        """Arguments `mounted`, `exclude`, `triaxial` and `costs` of `find_candidates`."""
        return self.mounted, self.exclude, self.triaxial, self.costs


@dataclass(frozen=True, eq=False)
class Linearised:
    """A planned test, linearised at the draws.

    Attributes
    ----------
    found : Sensitivities
        Modes, with derivatives with respect to the parameters of `Before` and the latent errors of the model
        (`fmu.analysis.plan.model_errors`).
    candidates : Candidates
    modes : tuple of int
        Modes to be measured, as indices into the modes of `found`.
    structure : SeparableModel or None
        Structure in the planned test; None for a model without matrices.
    places : ndarray, shape (n_candidates, 3), m, or None
        Coordinates of the candidates; None if they are unknown.
    energy : ndarray, shape (rows,), or None
        Kinetic energy of the modes at each channel; None for a model without matrices.
    second : dict
        For each change, the sensitivities of the changed structure and the indices of its modes.
    """

    found: Sensitivities
    candidates: Candidates
    modes: tuple[int, ...]
    structure: SeparableModel | None = None
    places: FloatArray | None = None
    energy: FloatArray | None = None
    second: Mapping[str, tuple[Sensitivities, tuple[int, ...]]] = field(default_factory=dict)


def linearise(before: Before, wishes: Wishes) -> Linearised:
    """Linearise a planned test at the draws of its parameters.

    Raises
    ------
    ValueError
        As in `fmu.plan`, if the model does not permit this test.
    """
    known = structure_of(before.model)
    if known is not None:
        return _with_matrices(before, known, wishes)
    return _without_matrices(before, wishes)


def _with_matrices(before: Before, known: PairedStructure, wishes: Wishes) -> Linearised:
    """Linearise the test of a structure that has system matrices."""
    structure, start, theta = known.structure, before.start, before.values(before.draws)
    there = find_candidates(structure, wishes.candidates, *wishes.of_sensors)
    picked, paired = pick_modes(structure, start, there.sensors, wishes.modes)
    nominal = paired.observed(start[None]).shapes[0][:, list(picked)]
    there = _moving(there, nominal, are_named=wishes.candidates is not None)
    paired = paired.seen_by(there.sensors)
    second = {}
    for name, change in wishes.changes.items():
        of_change, modes = _of_change(name, change, paired, theta, start, picked)
        second[name] = _by_psi(before, of_change, modes), modes
    return Linearised(
        _by_psi(before, of_structure(paired, theta, start), picked),
        there,
        picked,
        structure,
        there.places(structure),
        kinetic_energies(paired, start, picked),
        second,
    )


def _without_matrices(before: Before, wishes: Wishes) -> Linearised:
    """Linearise the test of a user's function or a surrogate, whose candidates are the sensors in the data.

    Raise ValueError if the test has changes, the model gives no mode shapes, a mode, sensor or place is not in the
    data, a sensor is given twice, a cost is not positive, or no candidate is left. Raise it also if a mode to be
    measured moves none of the candidates, none of these modes moves a candidate, or no draw has all derivatives.
    """
    if wishes.changes:
        raise ArgumentError("changes", "need a model with matrices", before.model.name)
    there = _own_candidates(before, wishes.candidates, *wishes.of_sensors)
    picked = tuple(range(wishes.modes)) if isinstance(wishes.modes, int) else wishes.modes
    if max(picked) >= before.model.n_modes:
        raise ArgumentError("modes", f"must be at most {before.model.n_modes}, as in the data", max(picked) + 1)
    found = of_model(before.model, before.values(before.draws), before.start)
    rows = [before.data.sensors.index(sensor) for sensor in there.sensors]
    for i in picked:
        if not np.any(found.nominal.shapes[0][rows, i]):
            rule = f"must include a place and a direction in which mode {i + 1} moves"
            raise ArgumentError("candidates", rule, "none")
    _moving(there, found.nominal.shapes[0][rows][:, list(picked)], are_named=True)
    seen, nominal = found.seen, found.nominal
    assert seen.shape_slopes is not None  # for the type checker: derivatives were requested
    found = replace(
        found,
        seen=replace(seen, shapes=seen.shapes[:, rows], shape_slopes=seen.shape_slopes[:, rows]),
        nominal=replace(nominal, shapes=nominal.shapes[:, rows]),
    )
    return Linearised(_by_psi(before, found, picked), there, picked)


def _by_psi(before: Before, found: Sensitivities, modes: Sequence[int]) -> Sensitivities:
    """Convert derivatives with respect to the model parameters to derivatives with respect to ψ and errors."""
    here = before.at(found.kept)
    return replace(found, seen=with_errors(here, found.seen, here.chain(found.seen), modes))


def _moving(there: Candidates, shapes: FloatArray, are_named: bool) -> Candidates:
    """Return the candidates without the channels that no measured mode moves.

    Raise ValueError if no measured mode moves one of the mounted sensors or, if `are_named` is True, one of the
    candidates. Raise it also if no candidate is left.
    """
    largest = np.max(np.abs(shapes), axis=0)
    still = ~np.any(np.abs(shapes) > UNSEEN * largest, axis=1)
    for k, rows in enumerate(there.groups):
        if still[rows[rows >= 0]].all() and (are_named or k in there.mounted):
            key = "mounted" if k in there.mounted else "candidates"
            sensor = repr(list(there.sensors[rows[0]]))
            raise ArgumentError(key, "must be moved by a mode to be measured, not as", sensor, "; remove it")
    if not still.any():
        return there
    lost, mounted = {there.sensors[row] for row in np.flatnonzero(still)}, there.rows(there.mounted)
    free = [sensor for row, sensor in enumerate(there.sensors) if sensor not in lost and row not in mounted]
    fixed = [there.sensors[row] for row in mounted if there.sensors[row] not in lost]
    costs = {there.sensors[rows[0]][0]: cost for rows, cost in zip(there.groups, there.cost, strict=True)}
    kept = {place: cost for place, cost in costs.items() if any(place == one for one, _ in (*free, *fixed))}
    return group_candidates(free, fixed, (), there.groups.shape[1] > 1, kept)


def _own_candidates(
    before: Before,
    candidates: Sequence[Dof] | None,
    mounted: Sequence[Dof],
    exclude: Collection[Any],
    triaxial: bool,
    costs: Mapping[Any, float],
) -> Candidates:
    """Return the candidates of a model that has no matrices, which are the sensors of the problem's data.

    Raise ValueError if the model gives no mode shapes, a sensor or place is not in the data, a sensor is given
    twice, a cost is not positive, or no candidate is left.
    """
    own = before.data.sensors
    if not (before.model.gives_shapes and own):
        rule = "must give shapes at the sensors of its data, which are the candidates of a model without matrices"
        raise ArgumentError("problem", rule, before.model.name)
    require_sensors(candidates, mounted, lambda one: tuple(one) in own, "must be a sensor of the problem's data")
    require_places({place for place, _ in own}, exclude, costs)
    return group_candidates(own if candidates is None else candidates, mounted, exclude, triaxial, costs)


def _of_change(
    name: str,
    change: Change,
    paired: PairedStructure,
    theta: FloatArray,
    start: FloatArray,
    picked: tuple[int, ...],
) -> tuple[Sensitivities, tuple[int, ...]]:
    """Return the sensitivities of the changed structure at the same candidates, and its modes to measure.

    For each mode that is measured on the unchanged structure, the most similar mode of the changed structure is
    chosen, by MAC at the candidates. Raise ValueError, with `name` in its message, if the change does not suit the
    structure, or the changed structure has too few modes or no draw with all derivatives.
    """
    before = paired.observed(start[None]).shapes[0][:, list(picked)]
    try:
        changed = changed_model(paired.structure, change.masses, change.springs)
        found = of_structure(paired_with_itself(changed, start, paired.sensors, max(picked) + 1), theta, start)
    except ValueError as error:
        raise ArgumentError.of(error).under(f"changes.{name}") from None
    return found, tuple(int(i) for i in assign(np.nan_to_num(mac(found.nominal.shapes[0], before))[None])[0])


def kinetic_energies(paired: PairedStructure, start: FloatArray, modes: Sequence[int]) -> FloatArray:
    """Return the kinetic energy φ_q (Mφ)_q at each channel q, summed over `modes`, shape (rows,)."""
    phi = paired.shapes(start)[:, list(modes)]
    rows = paired.structure.observation(paired.sensors)
    return np.asarray(np.sum((rows @ phi) * (rows @ (paired.structure.M(start) @ phi)), axis=1))
