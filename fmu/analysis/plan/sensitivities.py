"""Modes and their derivatives at all candidate sensors of a planned test, at draws of the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fmu.arguments import ArgumentError
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.fem.reduced.anchors import SingularAnchorError
from fmu.fem.reduced.reduced_structure import reduced_in, train
from fmu.progress.phases import phase
from fmu.types import BoolArray, Dof, FloatArray

SPARE = 2
"""Number of modes computed above the measured ones, because pairing could confuse them with measured modes."""
SHAPE_ERROR = 1e-3
"""Largest error allowed in a reduced model's mode shapes at the candidates, relative to the largest component."""
UNSEEN = 1e-6
"""A candidate does not see a mode if it moves less than this fraction of the mode's largest displacement."""
_FULL = 100  # up to this size, full solves at all draws take less time than training
_TOLERANCES = (1e-6, 1e-8)
_CHECKED = 3


@dataclass(frozen=True)
class Certificate:
    """Errors of the reduced model at draws for which the full model was also solved.

    Attributes
    ----------
    frequency : float
        Largest relative frequency error.
    shape : float
        Largest mode-shape error at a candidate, relative to the shape's largest component at the candidates.
    draws : int
        Number of these draws.
    size : int
        Number of unknowns in the reduced model.
    """

    frequency: float
    shape: float
    draws: int
    size: int

    @property
    def ok(self) -> bool:
        """Whether the mode-shape error is at most `SHAPE_ERROR`."""
        return self.shape <= SHAPE_ERROR


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Modes and their derivatives at n draws, at all candidate channels.

    Attributes
    ----------
    seen : ModalPrediction
        Frequencies (n, m), mode shapes (n, rows, m) and their derivatives with respect to the parameters; the last
        modes may be spare.
    nominal : ModalPrediction
        The same modes at the reference parameters, n = 1, without derivatives.
    model : ModalModel
        Model that computed the modes; it may be reduced.
    n_solves : int
        Solves of `model` at the draws, or calls of a user's function.
    certificate : Certificate or None
        Errors of the reduced model; None if the model is not reduced.
    kept : ndarray of bool, shape (n_draws,), or None
        Mask of the draws in `seen`. At the other draws a solve failed or a mode had no derivative. None if `seen`
        has all draws.
    """

    seen: ModalPrediction
    nominal: ModalPrediction
    model: ModalModel
    n_solves: int
    certificate: Certificate | None = None
    kept: BoolArray | None = None


def paired_with_itself(
    structure: SeparableModel, start: FloatArray, sensors: Sequence[Dof], n_modes: int
) -> PairedStructure:
    """Pair a structure by shape with its own lowest elastic modes at `start`, observed at the sensors.

    Up to `SPARE` modes above these are added if the structure has them.

    Raises
    ------
    ValueError
        If the structure has too few modes.
    """
    for spare in range(SPARE, -1, -1):
        try:
            paired = PairedStructure.of(
                structure,
                pairing="shape",
                numbers=tuple(range(1, n_modes + spare + 1)),
                sensors=(),
                reference=start,
            )
        except ValueError:
            if not spare:
                rule = "must be modes of finite frequency that the model has, rigid-body modes not counted"
                raise ArgumentError("modes", rule, f"mode {n_modes}") from None
        else:
            return paired.seen_by(tuple(sensors))
    raise AssertionError("unreachable")


def pick_modes(
    structure: SeparableModel, start: FloatArray, sensors: Sequence[Dof], modes: int | Sequence[int]
) -> tuple[tuple[int, ...], PairedStructure]:
    """Return the 0-based indices of the modes to measure, and the structure paired with its modes.

    The structure is paired with all modes up to the last one to measure, and with spare ones
    (`paired_with_itself`).

    Parameters
    ----------
    structure : SeparableModel
    start : ndarray, shape (n_parameters,)
    sensors : sequence of (place, direction)
        All candidate channels.
    modes : int or sequence of int
        Number of modes, starting from the lowest that the candidates see; or 0-based indices.

    Raises
    ------
    ValueError
        If the structure has too few modes, or the candidates do not see one of the given modes or see too few.
    """
    count = modes if isinstance(modes, int) else max(modes) + 1
    while True:
        try:
            paired = paired_with_itself(structure, start, sensors, count)
        except ArgumentError:
            if isinstance(modes, int) and count > modes:
                rule = f"must see {modes} modes of the model"
                raise ArgumentError("candidates", rule, "fewer", "; add candidates, or plan fewer modes") from None
            raise
        everywhere = np.max(np.abs(paired.shapes(start)[structure.translations]), axis=0)
        seen = np.max(np.abs(paired.observed(start[None]).shapes[0]), axis=0, initial=0.0) > UNSEEN * everywhere
        if not isinstance(modes, int):
            unseen = next((i for i in modes if not seen[i]), None)
            if unseen is not None:
                rule = f"must include a place and a direction in which mode {unseen + 1} moves"
                raise ArgumentError("candidates", rule, "none", "; add candidates, or leave the mode out of modes")
            return tuple(modes), paired
        found = tuple(int(i) for i in np.flatnonzero(seen[:count])[:modes])
        if len(found) == modes:
            return found, paired
        count += modes - len(found)


def of_structure(paired: PairedStructure, theta: FloatArray, start: FloatArray) -> Sensitivities:
    """Return the sensitivities of a structure with system matrices, at theta (n, n_parameters).

    If the structure has more than 100 DOFs and there are more than three draws, a reduced model is trained for the
    range of the draws. If reduction is not possible or would not pay, the full model is solved instead. The
    reduced basis covers all DOFs, so it gives mode shapes at all candidates. The reduced model's mode shapes are
    compared with the full model's at the first three draws. If they differ too much, the model is reduced again
    with a smaller tolerance, and the result is used even if its certificate is not ok. Raise ValueError if no draw
    has all derivatives.
    """
    nominal = paired.observed(start[None])
    n = len(theta)
    if paired.structure.n_dof <= _FULL or n <= _CHECKED:
        with phase("derivatives at draws", n):
            return _complete(paired, paired.observed(theta, True), nominal, n)
    full = None
    found = None
    for tolerance in _TOLERANCES:
        with phase("training"):
            try:
                trained, _ = train(paired, np.min(theta, axis=0), np.max(theta, axis=0), tolerance)
            except SingularAnchorError:
                break
        model = reduced_in(trained)
        if model is None:
            break
        with phase("derivatives at draws", n):
            seen = model.observed(theta, True)
        with phase("certificate", _CHECKED):
            full = paired.observed(theta[:_CHECKED]) if full is None else full
        found = seen, _compare(seen, full, sum(model.sizes)), model
        if found[1].ok:
            break
    if found is None:
        with phase("derivatives at draws", n):
            return _complete(paired, paired.observed(theta, True), nominal, n)
    return replace(_complete(found[2], found[0], nominal, n), certificate=found[1])


def of_model(model: ModalModel, theta: FloatArray, start: FloatArray) -> Sensitivities:
    """Return the sensitivities of a user's function or a surrogate, at theta (n, n_parameters).

    Raise ValueError if no draw has all derivatives.
    """
    with phase("derivatives at draws", len(theta)):
        seen = model.observed(theta, True)
    return _complete(model, seen, model.observed(start[None]), model.solves_per_shape_gradient * len(theta))


def _complete(model: ModalModel, seen: ModalPrediction, nominal: ModalPrediction, n_solves: int) -> Sensitivities:
    """Return the sensitivities at the draws that have all derivatives. Raise ValueError if no draw has them."""
    assert seen.frequency_slopes is not None  # for the type checker: derivatives were requested
    assert seen.shape_slopes is not None
    parts = (seen.frequencies, seen.frequency_slopes, seen.shapes, seen.shape_slopes)
    good = np.all([np.isfinite(part).reshape(len(part), -1).all(axis=1) for part in parts], axis=0)
    if not good.any():
        f = nominal.frequencies[0]
        close = int(np.argmin(np.diff(f) / f[1:])) if len(f) > 1 else 0
        raise ArgumentError(
            "problem",
            "modes must have derivatives at some draws of the parameters",
            f"none at {len(good)} draws; at the start modes {close + 1} and {close + 2} are closest",
        )
    kept = ModalPrediction(seen.frequencies[good], seen.shapes[good], parts[1][good], parts[3][good])
    return Sensitivities(kept, nominal, model, n_solves, None, None if good.all() else good)


def _compare(seen: ModalPrediction, full: ModalPrediction, size: int) -> Certificate:
    n = len(full.frequencies)
    reduced = seen.shapes[:n]
    sign = np.where(np.sum(reduced * full.shapes, axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    largest = np.max(np.abs(full.shapes), axis=1, keepdims=True)
    off = np.abs(sign * reduced - full.shapes) / np.where(largest > 0.0, largest, 1.0)
    frequency = np.max(np.abs(seen.frequencies[:n] / full.frequencies - 1.0))
    return Certificate(float(frequency), float(np.max(off)), n, size)
