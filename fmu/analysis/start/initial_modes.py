"""Compute the modes at the starting point, pair them with the measured modes, and warn of doubtful pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.start.pairing_doubts import (
    ComputedMode,
    close,
    correlate_shapes,
    find_reversed_sensor,
    note_unmeasured,
    unlike,
    warn_of_order,
    warn_of_units,
)
from fmu.engines.blas import single_thread
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.modal import (
    ModalSolution,
    assign,
    count_modes,
    frequency_hz,
    is_rigid,
    join_shapes,
    mac,
    solve_spectrum,
)
from fmu.fem.modes.separable import selection
from fmu.fem.pairing.correlation import Correlation
from fmu.fem.pairing.paired_structure import PairedStructure, structure_of
from fmu.numbers import MISSING, change, fixed, given, hertz, share
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd
    from scipy.sparse import csr_array

    from fmu.posterior.problem import UpdatingProblem


_SEEN = 1e-3
_MOST_TESTS = 5
"""Largest number of tests whose warnings are given in full."""
_BEYOND = 2


@dataclass(frozen=True, eq=False)
class InitialModes:
    """The lowest modes of a model, paired with the measured ones.

    Attributes
    ----------
    labels : tuple of str
        Labels of the measured modes.
    measured_hz : ndarray, shape (n_modes,)
    modes : tuple of ComputedMode
        Computed modes, in ascending order or in the order of a user's function, up to two beyond the last paired
        one.
    mac : ndarray, shape (n_modes, n_computed), or None
        MAC between measured and computed shapes at the sensors. None if no shapes were measured, the modes of a
        user's function are paired by number, or the model computes only paired modes, as for several tests.
    doubts : tuple of str
        Warnings about the pairing, one sentence each.
    notes : tuple of str
        Further remarks on the pairing.
    correlation : Correlation or None
        Comparison of the measured and computed shapes at the sensors; None if `mac` is None.
    mpc : ndarray, shape (n_modes,), or None
        Modal phase collinearity of the measured shapes; None if they were real, or the model computes only paired
        modes.
    turned : str
        A warning about a sensor whose opposite sign would put the pairing right; empty if there is none.
    """

    labels: tuple[str, ...]
    measured_hz: FloatArray
    modes: tuple[ComputedMode, ...]
    mac: FloatArray | None = None
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    correlation: Correlation | None = None
    mpc: FloatArray | None = None
    turned: str = ""
    _column: dict[int, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        columns = {mode.measured: c for c, mode in enumerate(self.modes) if mode.measured is not None}
        object.__setattr__(self, "_column", columns)

    def of(self, k: int) -> ComputedMode:
        """Return the computed mode that is paired with measured mode `k` (an index from 0)."""
        return self.modes[self._column[k]]

    def error_percent(self, k: int) -> float:
        """Return the relative error of the frequency computed for measured mode `k` (an index from 0), in %."""
        return 100.0 * (self.of(k).frequency_hz / float(self.measured_hz[k]) - 1.0)

    def subspace_mac(self, k: int) -> float:
        """Return the subspace MAC of measured mode `k` and the modes close to it.

        Return NaN if no mode is close to it, or if no shapes were compared.
        """
        return np.nan if self.correlation is None else self.correlation.subspace.get(k, np.nan)

    def table(self) -> pd.DataFrame:
        """Return a table with one row per computed mode.

        The columns are ``number``, ``computed_hz``, the label ``mode`` of the paired measured mode,
        ``measured_hz``, ``error_percent``, ``mac``, ``subspace_mac`` of its group of close modes
        (`fmu.fem.pairing.correlation`), ``mpc`` of a measured shape that was complex, ``moves`` (the directions
        with most kinetic energy) and ``seen`` (whether the mode moves a sensor). If a value does
        not exist, ``number`` is None, ``mode`` is empty, and any other number is NaN.
        """
        import pandas as pd

        rows = []
        for c, mode in enumerate(self.modes):
            k = mode.measured
            rows.append(
                {
                    "number": mode.number,
                    "computed_hz": mode.frequency_hz,
                    "mode": "" if k is None else self.labels[k],
                    "measured_hz": np.nan if k is None else float(self.measured_hz[k]),
                    "error_percent": np.nan if k is None else self.error_percent(k),
                    "mac": np.nan if k is None or self.mac is None else float(self.mac[k, c]),
                    "subspace_mac": np.nan if k is None else self.subspace_mac(k),
                    "mpc": np.nan if k is None or self.mpc is None else float(self.mpc[k]),
                    "moves": mode.moves,
                    "seen": mode.seen,
                }
            )
        return pd.DataFrame(rows)


def initial_modes(problem: UpdatingProblem) -> InitialModes:
    """Solve a problem's model at its starting point; return its modes, paired with the measured ones.

    Parameters
    ----------
    problem : UpdatingProblem

    Returns
    -------
    InitialModes
        Only the paired modes if the model computes no others, or if there are several tests.
    """
    point = problem.start
    labels = tuple(map(str, problem.data.labels))
    measured = np.asarray(problem.data.frequencies_hz, dtype=float)
    structural = problem.model_parameters(point[None])[0]
    structure, functions = structure_of(problem.model), problem.model.functions
    if structure is not None:
        return _of_structure(problem, structure, structural, labels, measured)
    if functions and problem.model.n_tests == 1:
        return _of_function(problem, functions[0], structural, labels, measured)
    frequencies = problem.frequencies(point)
    found = tuple(ComputedMode(None, float(frequencies[k]), int(k)) for k in range(len(frequencies)))
    if problem.model.n_tests > 1:
        return InitialModes(labels, measured, found, doubts=tuple(_doubts_of_tests(problem)))
    note = "The model itself pairs its modes with the measured ones."
    return InitialModes(labels, measured, found, notes=(note,))


def _doubts_of_tests(problem: UpdatingProblem) -> list[str]:
    """Return warnings about mode shapes and sensors of several tests.

    They are given in full for the first `_MOST_TESTS` tests that have warnings; one more sentence counts the
    others. The list is empty if shapes were not measured or the model gives none.
    """
    model = problem.model
    if problem.data.shapes is None or not model.gives_shapes:
        return []
    seen = model.observed(problem.model_parameters(problem.start[None]))
    doubts, concerned = [], []
    for t, test in enumerate(problem.tests):
        here = model.test_of_modes == t
        computed, measured = seen.shapes[0][:, here], np.asarray(test.data.shapes)
        structure = model.parts[0].structure
        correlation = correlate_shapes(test.data, structure, computed, seen.frequencies[0, here])
        labels = tuple(map(str, test.data.labels))
        said = [
            *unlike(labels, list(range(len(labels))), mac(computed, measured), correlation),
            *correlation.doubts_of_sensors(),
        ]
        if said:
            concerned.append(test.name)
        if len(concerned) <= _MOST_TESTS:
            doubts += [f"Test {test.name}: {one}" for one in said]
    if len(concerned) > _MOST_TESTS:
        doubts.append(f"{len(concerned) - _MOST_TESTS} more tests have such warnings, such as {concerned[-1]}.")
    return doubts


def _of_structure(
    problem: UpdatingProblem,
    model: PairedStructure,
    point: FloatArray,
    labels: tuple[str, ...],
    measured: FloatArray,
) -> InitialModes:
    spectrum, paired = _spectrum(model, point)
    frequencies = frequency_hz(spectrum.eigenvalues[0])
    with single_thread():
        shapes = join_shapes(model.blocks, point[None], spectrum)
    observation = model.structure.observation(problem.data.sensors) if problem.data.sensors else None
    seen = _find_seen(model, shapes, observation, spectrum.eigenvalues[0])
    moves = _moves(model, point, shapes)
    rigid = is_rigid(spectrum.eigenvalues[0])
    answers = {number: k for k, number in enumerate(paired)}
    found = tuple(
        ComputedMode(i + 1, float(frequencies[i]), answers.get(i), bool(seen[i]), moves[i], bool(rigid[i]))
        for i in range(len(frequencies))
    )
    alike = correlation = None
    if problem.data.shapes is not None and observation is not None:
        alike = mac(observation @ shapes, np.asarray(problem.data.shapes))
        seen_here = (observation @ shapes)[:, paired]
        correlation = correlate_shapes(problem.data, model.structure, seen_here, frequencies[paired])
    by_number = not model.by_shape
    doubts = [*unlike(labels, paired, alike, correlation), *close(labels, paired, frequencies, seen, by_number)]
    given = bool(problem.data.counterparts) and not by_number
    doubts += [] if given else warn_of_order(labels, paired, measured)
    notes = note_unmeasured(found)
    by_mac = None if given or by_number or observation is None else observation @ shapes
    compared = InitialModes(labels, measured, found, alike, tuple(doubts), tuple(notes), correlation)
    return _compare_shapes(compared, problem, by_mac)


def _of_function(
    problem: UpdatingProblem,
    function: BlackBoxModel,
    point: FloatArray,
    labels: tuple[str, ...],
    measured: FloatArray,
) -> InitialModes:
    """Return the modes that a user's function computes, in its own order, paired with the measured ones."""
    answer = function.at(point)
    alike = correlation = None
    if problem.model.by_shape and answer.shapes is not None:
        alike = mac(answer.shapes, np.asarray(problem.data.shapes))
        paired = [int(column) for column in assign(alike[None], answer.frequencies[None], measured)[0]]
        correlation = correlate_shapes(problem.data, None, answer.shapes[:, paired], answer.frequencies[paired])
    else:
        paired = [number - 1 for number in problem.data.numbers]
    answers = {number: k for k, number in enumerate(paired)}
    frequencies = answer.frequencies[: max(paired) + 1 + _BEYOND]
    found = tuple(ComputedMode(i + 1, float(f), answers.get(i)) for i, f in enumerate(frequencies))
    alike = None if alike is None else alike[:, : len(found)]
    seen = np.ones(len(found), dtype=bool)
    doubts = [*unlike(labels, paired, alike, correlation)]
    doubts += close(labels, paired, frequencies, seen, alike is None)
    doubts += warn_of_order(labels, paired, measured)
    how = "by number, in the order of the function" if alike is None else "by MAC with the measured shapes"
    notes = [f"Modes are paired {how}.", *(note_unmeasured(found) if alike is not None else ())]
    if problem.data.shapes is not None and answer.shapes is None:
        notes.append("The measured shapes are not used: the function returns no shapes.")
    by_mac = None if alike is None or answer.shapes is None else answer.shapes[:, : len(found)]
    compared = InitialModes(labels, measured, found, alike, tuple(doubts), tuple(notes), correlation)
    return _compare_shapes(compared, problem, by_mac)


def _compare_shapes(found: InitialModes, problem: UpdatingProblem, by_mac: FloatArray | None) -> InitialModes:
    """Return `found` with the modal phase collinearity, and with warnings and notes on the mode shapes.

    `by_mac` (n_sensors, n_computed) are the computed shapes at the sensors; None if MAC does not pair the modes.
    """
    mpc = None if problem.data.mpc is None else np.asarray(problem.data.mpc)
    if found.correlation is None:
        return replace(found, mpc=mpc)
    alike = mac(found.correlation.computed, found.correlation.measured).diagonal()
    ratio = 1.0 + 0.01 * np.array([found.error_percent(k) for k in range(len(alike))])
    doubts = (*found.doubts, *warn_of_units(ratio, alike), *found.correlation.doubts_of_modes())
    notes = (*found.notes, *found.correlation.notes())
    measured = found.measured_hz
    turned = "" if by_mac is None else find_reversed_sensor(found.correlation, by_mac, found.modes, measured)
    return replace(found, doubts=doubts, notes=notes, mpc=mpc, turned=turned)


def _spectrum(model: PairedStructure, point: FloatArray) -> tuple[ModalSolution, list[int]]:
    """Return the lowest modes, up to two beyond the last paired one, and the columns of the paired modes."""
    pairs = model.modes(point[None])
    wanted = list(zip(pairs.block[0].tolist(), pairs.rank[0].tolist(), strict=True))
    total = count_modes(model.blocks)
    count = min(total, 2 * model.n_modes + _BEYOND)
    while True:
        with single_thread():
            spectrum = solve_spectrum(model.blocks, point[None], count)
        column = {
            key: i for i, key in enumerate(zip(spectrum.block[0].tolist(), spectrum.rank[0].tolist(), strict=True))
        }
        if count == total or all(key in column for key in wanted):
            paired = [column[key] for key in wanted]
            if count == total or max(paired) + _BEYOND < count:
                return spectrum.columns(np.arange(min(count, max(paired) + 1 + _BEYOND))), paired
        count = min(total, 2 * count)


def _find_seen(
    model: PairedStructure, shapes: FloatArray, observation: csr_array | None, eigenvalues: FloatArray
) -> BoolArray:
    """Return a mask (n_modes,) of the elastic modes that move a sensor.

    If there are no sensors, these are the modes with any translation.
    """
    rows = selection(model.structure.translations, model.structure.n_dof)
    seen = np.abs((rows if observation is None else observation) @ shapes)
    elastic = ~is_rigid(eigenvalues)
    largest = np.max(np.abs(rows @ shapes), initial=0.0)
    return np.asarray(elastic & (np.max(seen, axis=0, initial=0.0) > _SEEN * largest))


def _moves(model: PairedStructure, point: FloatArray, shapes: FloatArray) -> list[str]:
    """Describe, for each mode, the two directions with the largest fractions of its kinetic energy, if above 10 %.

    The energy of a direction d is φ_dᵀ M_dd φ_d, which is not negative. Terms of M that couple directions, such as
    displacement and rotation in a consistent mass matrix, are left out: φ_dᵀ (Mφ)_d, which includes them, can
    exceed the total energy. The descriptions are empty if the model has only one direction.
    """
    directions = np.array([direction for _, direction in model.structure.dofs])
    names = [str(name) for name in dict.fromkeys(directions)]
    if len(names) < 2:
        return [""] * shapes.shape[1]
    M = model.structure.M(point)
    own = [np.where((directions == name)[:, None], shapes, 0.0) for name in names]
    part = np.array([np.sum(moving * (M @ moving), axis=0) for moving in own])
    part = part / part.sum(axis=0)
    words = []
    for column in part.T:
        order = np.argsort(-column)[:2]
        words.append(", ".join(f"{names[i]} {share(round(column[i], 2))}" for i in order if column[i] > 0.1))
    return words


_MANY = 3
_OF_PAIRS = ("measured, Hz", "error", "MAC", "subspace MAC", "MPC")


def modes_as_text(found: InitialModes) -> pd.DataFrame:
    """Return a text table with one row per computed mode, and dashes in cells that do not apply.

    Three or more successive modes share a row if they are rigid-body modes, or if they move no sensor. Columns
    that apply to no mode are left out.
    """
    import pandas as pd

    rows = []
    for (is_idle, _), group in groupby(
        found.modes, key=lambda mode: (not mode.seen and mode.measured is None, mode.is_rigid)
    ):
        modes = list(group)
        rows += [_many(modes)] if is_idle and len(modes) >= _MANY else [_one(found, mode) for mode in modes]
    table = pd.DataFrame(rows, dtype=object).fillna(MISSING)
    unknown = [] if found.modes[0].number is not None else ["number"]
    unknown += [] if found.mac is not None else ["MAC"]
    unknown += [] if found.correlation is not None and found.correlation.subspace else ["subspace MAC"]
    unknown += [] if found.mpc is not None else ["MPC"]
    unknown += [] if any(mode.moves for mode in found.modes) else ["moves"]
    return table.drop(columns=unknown)


def _one(found: InitialModes, mode: ComputedMode) -> dict[str, str]:
    row = {"number": str(mode.number), "computed, Hz": _hz(mode.frequency_hz)}
    if mode.measured is None:
        row["measured mode"] = (
            "rigid body" if mode.is_rigid else "not measured" if mode.seen else "moves no sensor"
        )
        return row | dict.fromkeys(_OF_PAIRS, MISSING) | {"moves": mode.moves}
    k = mode.measured
    measured = found.measured_hz[k]
    row["computed, Hz"] = hertz(mode.frequency_hz, measured=measured)[0]
    row |= {"measured mode": found.labels[k], "measured, Hz": given(measured)}
    row["error"] = change(found.error_percent(k) / 100.0)
    row["MAC"] = MISSING if found.mac is None else fixed(found.mac[k, found.modes.index(mode)], 2)
    row["subspace MAC"] = fixed(found.subspace_mac(k), 2)
    row["MPC"] = MISSING if found.mpc is None else fixed(found.mpc[k], 2)
    return row | {"moves": mode.moves}


def _many(modes: Sequence[ComputedMode]) -> dict[str, str]:
    first, last = modes[0], modes[-1]
    ends = f"{_hz(first.frequency_hz)} to {_hz(last.frequency_hz)}"
    return {
        "number": f"{first.number}–{last.number}",
        "computed, Hz": _hz(0.0) if first.is_rigid else ends,
        "measured mode": f"{len(modes)} rigid-body modes" if first.is_rigid else f"{len(modes)} move no sensor",
        **dict.fromkeys((*_OF_PAIRS, "moves"), MISSING),
    }


def _hz(frequency: float) -> str:
    return hertz(frequency)[0]
