"""The modes of a model beside the measured ones, and how certain their pairing is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.modal import frequency_hz, is_rigid, mac, single_thread
from fmu.fem.modes.separable import selection
from fmu.fem.pairing.correlation import ALIKE, CLOSE, Correlation, close_groups
from fmu.fem.pairing.paired_structure import PairedStructure, structure_of
from fmu.fem.pairing.rules import assign
from fmu.numbers import MISSING, apart, change, fixed, given, hertz, share
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.data.modal_data import ModalData
    from fmu.posterior.problem import UpdatingProblem


RIVAL = 0.1
"""The MAC of the paired mode must exceed that of any other by this much."""


@dataclass(frozen=True)
class ComputedMode:
    """A mode of the model.

    Attributes
    ----------
    number : int or None
        Number in the sorted spectrum, from 1; None if the model gives paired frequencies only.
    frequency_hz : float
    measured : int or None
        The measured mode (from 0) that it is paired with.
    seen : bool
        Whether it moves a sensor.
    moves : str
        The directions with most of its kinetic energy: ``"z 98 %"``; empty if unknown.
    is_rigid : bool
        Whether it is a motion without strain, at 0 Hz.
    """

    number: int | None
    frequency_hz: float
    measured: int | None
    seen: bool = True
    moves: str = ""
    is_rigid: bool = False


def unlike(
    labels: tuple[str, ...], paired: list[int], alike: FloatArray | None, found: Correlation | None = None
) -> list[str]:
    """Return warnings on measured shapes that match no computed mode, or two: by MAC (n_modes, n_computed).

    Close modes that match as a space are left out.
    """
    doubts = []
    for k, column in enumerate(paired if alike is not None else []):
        if found is not None and found.subspace.get(k, 0.0) >= ALIKE:
            continue
        row = alike[k]  # type: ignore[index]  # there is one, or there is no column
        others = np.delete(np.arange(len(row)), column)
        if row[column] < ALIKE:
            doubts.append(
                f"Mode {labels[k]}: MAC {apart(row[column], ALIKE, sd=0.1)[0]} with computed mode {column + 1}, "
                f"below {ALIKE}."
            )
        rival = others[np.argmax(row[others])] if len(others) else column
        if rival != column and row[rival] > row[column] - RIVAL:
            doubts.append(
                f"Mode {labels[k]}: the sensors can hardly distinguish computed mode {column + 1} (MAC "
                f"{fixed(row[column], 2)}) from {rival + 1} (MAC {fixed(row[rival], 2)})."
            )
    return doubts


def close(
    labels: tuple[str, ...], paired: list[int], frequencies: FloatArray, seen: BoolArray, by_number: bool
) -> list[str]:
    """Return warnings on close computed modes: any two if paired by number, else those that move a sensor."""
    doubts, told = [], set()
    for k, column in enumerate(paired):
        for other in (column - 1, column + 1):
            pair = (min(column, other), max(column, other))
            if not 0 <= other < len(frequencies) or pair in told or not (by_number or seen[other]):
                continue
            distance = abs(frequencies[other] / frequencies[column] - 1.0)
            if distance < CLOSE:
                told.add(pair)
                doubts.append(
                    f"Mode {labels[k]}: computed modes {pair[0] + 1} and {pair[1] + 1} are {share(distance)} "
                    "apart in frequency, too close to tell which of them was measured."
                )
    return doubts


def warn_of_order(labels: tuple[str, ...], paired: list[int], measured: FloatArray) -> list[str]:
    """Return a warning if the paired modes are not in the order of the measured frequencies."""
    order = np.argsort(measured, kind="stable")
    numbers = [paired[k] for k in order]
    if numbers == sorted(numbers):
        return []
    return [
        "Measured and computed modes are in different orders: "
        + ", ".join(f"{labels[k]} is computed mode {paired[k] + 1}" for k in order)
        + "."
    ]


def note_unmeasured(found: Sequence[ComputedMode]) -> list[str]:
    """Return notes on rigid-body modes, and on unmeasured ones between the measured ones, seen or not."""
    last = max(i for i, mode in enumerate(found) if mode.measured is not None)
    rigid = [mode.number for mode in found if mode.is_rigid]
    notes = []
    if rigid:
        subject = (
            "mode 1 is a rigid-body motion" if len(rigid) == 1 else f"modes 1–{len(rigid)} are rigid-body motions"
        )
        notes.append(f"Computed {subject}; the first elastic mode is number {len(rigid) + 1}.")
    for seen, one, many in (
        (False, "moves no sensor", "move no sensor"),
        (True, "moves a sensor, but was not measured", "move a sensor, but were not measured"),
    ):
        numbers = [
            mode.number
            for mode in found[:last]
            if mode.measured is None and mode.seen == seen and not mode.is_rigid
        ]
        if numbers:
            subject, words = ("mode", one) if len(numbers) == 1 else ("modes", many)
            notes.append(f"Computed {subject} {ranges([n for n in numbers if n is not None])} {words}.")
    return notes


def ranges(numbers: Sequence[int]) -> str:
    """Return ascending numbers, runs of three and more as ranges: ``"1, 2, 5–9"``."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and runs[-1][-1] == number - 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    words = [f"{run[0]}–{run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs]
    return ", ".join(words)


_SEEN = 1e-3
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
        Ascending, up to two beyond the last paired one.
    mac : ndarray, shape (n_modes, n_computed), or None
        MAC between measured and computed shapes at the sensors; None if no shapes were measured.
    doubts : tuple of str
        Warnings on the pairing, a sentence each.
    notes : tuple of str
        Further remarks on the pairing.
    correlation : Correlation or None
        Measured and computed shapes at the sensors, compared; None if no shapes were measured.
    mpc : ndarray, shape (n_modes,), or None
        Modal phase collinearity of measured shapes that were complex.
    """

    labels: tuple[str, ...]
    measured_hz: FloatArray
    modes: tuple[ComputedMode, ...]
    mac: FloatArray | None = None
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    correlation: Correlation | None = None
    mpc: FloatArray | None = None
    _column: dict[int, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        columns = {mode.measured: c for c, mode in enumerate(self.modes) if mode.measured is not None}
        object.__setattr__(self, "_column", columns)

    def of(self, k: int) -> ComputedMode:
        """Return the computed mode paired with measured mode `k` (from 0)."""
        return self.modes[self._column[k]]

    def error_percent(self, k: int) -> float:
        """Return the error of the computed frequency of measured mode `k`, in % of the measured one."""
        return 100.0 * (self.of(k).frequency_hz / float(self.measured_hz[k]) - 1.0)

    def subspace_mac(self, k: int) -> float:
        """Return the subspace MAC of the group of close modes that measured mode `k` is in; NaN if in none."""
        return np.nan if self.correlation is None else self.correlation.subspace.get(k, np.nan)

    def table(self) -> pd.DataFrame:
        """Return one row per computed mode: number, Hz, measured mode, error in %, MAC, energy, seen or not.

        ``subspace_mac`` belongs to a group of close modes (`fmu.fem.pairing.correlation`), ``mpc`` to a
        measured shape that was complex.
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


def initial_modes(problem: UpdatingProblem, theta: ArrayLike | None = None) -> InitialModes:
    """Solve the full model of a problem and return which of its modes are paired with the measured ones.

    Parameters
    ----------
    problem : UpdatingProblem
    theta : array_like, shape (ndim,), optional
        Parameters; the start if not given.

    Returns
    -------
    InitialModes
        The paired modes alone if the model gives no others.
    """
    point = problem.start if theta is None else np.asarray(theta, dtype=float)
    labels = tuple(map(str, problem.data.labels))
    measured = np.asarray(problem.data.frequencies_hz, dtype=float)
    structural = point[: problem.model.n_parameters]  # behind them, what is uncertain of the errors
    structure, functions = structure_of(problem.model), problem.model.functions
    if structure is not None:
        return _of_structure(problem, structure, structural, labels, measured)
    if functions and problem.model.n_tests == 1:
        return _of_function(problem, functions[0], structural, labels, measured)
    frequencies = problem.frequencies(point)
    found = tuple(ComputedMode(None, float(frequencies[k]), int(k)) for k in range(len(frequencies)))
    note = "The model itself pairs its modes with the measured ones."
    return InitialModes(labels, measured, found, notes=(note,))


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
        shapes = model.blocks.shapes(point[None], spectrum)
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
        correlation = correlate_shapes(problem.data, (observation @ shapes)[:, paired], frequencies[paired])
    by_number = not model.by_shape
    doubts = [*unlike(labels, paired, alike, correlation), *close(labels, paired, frequencies, seen, by_number)]
    given = bool(problem.data.counterparts) and not by_number
    doubts += [] if given else warn_of_order(labels, paired, measured)
    notes = note_unmeasured(found)
    return _compare_shapes(
        InitialModes(labels, measured, found, alike, tuple(doubts), tuple(notes), correlation), problem
    )


def _of_function(
    problem: UpdatingProblem,
    function: BlackBoxModel,
    point: FloatArray,
    labels: tuple[str, ...],
    measured: FloatArray,
) -> InitialModes:
    """Return all modes that a function gives, in its order, and which are paired with the measured ones."""
    answer = function.at(point)
    alike = correlation = None
    if problem.model.by_shape and answer.shapes is not None:
        alike = mac(answer.shapes, np.asarray(problem.data.shapes))
        paired = [int(column) for column in assign(alike[None])[0]]
        correlation = correlate_shapes(problem.data, answer.shapes[:, paired], answer.frequencies[paired])
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
    notes = (f"Modes are paired {how}.", *(note_unmeasured(found) if alike is not None else ()))
    return _compare_shapes(
        InitialModes(labels, measured, found, alike, tuple(doubts), notes, correlation), problem
    )


def correlate_shapes(data: ModalData, computed: FloatArray, frequencies_hz: FloatArray) -> Correlation:
    """Return measured shapes beside those computed at the sensors (n_sensors, n_modes), paired with them."""
    sensors = tuple(f"{place} {direction}" for place, direction in data.sensors)
    groups = close_groups(data.frequencies_hz, frequencies_hz)
    return Correlation(sensors, tuple(map(str, data.labels)), np.asarray(data.shapes), computed, groups)


def _compare_shapes(found: InitialModes, problem: UpdatingProblem) -> InitialModes:
    """Add the doubts and notes that the shapes at the sensors raise, and their MPC."""
    mpc = None if problem.data.mpc is None else np.asarray(problem.data.mpc)
    if found.correlation is None:
        return replace(found, mpc=mpc)
    doubts = (*found.doubts, *found.correlation.doubts_of_modes())
    return replace(found, doubts=doubts, notes=(*found.notes, *found.correlation.notes()), mpc=mpc)


def _spectrum(model: PairedStructure, point: FloatArray) -> tuple[Any, list[int]]:
    """Return the lowest modes, up to two beyond the last paired one, and the columns of the paired ones."""
    pairs = model.modes(point[None])
    wanted = list(zip(pairs.block[0].tolist(), pairs.rank[0].tolist(), strict=True))
    total = model.blocks.n_modes
    count = min(total, 2 * model.n_modes + _BEYOND)
    while True:
        with single_thread():
            spectrum = model.blocks.spectrum(point[None], count)
        column = {
            key: i for i, key in enumerate(zip(spectrum.block[0].tolist(), spectrum.rank[0].tolist(), strict=True))
        }
        if count == total or all(key in column for key in wanted):
            paired = [column[key] for key in wanted]
            if count == total or max(paired) + _BEYOND < count:
                return spectrum.columns(np.arange(min(count, max(paired) + 1 + _BEYOND))), paired
        count = min(total, 2 * count)


def _find_seen(model: PairedStructure, shapes: FloatArray, observation: Any, eigenvalues: FloatArray) -> BoolArray:
    """Find the modes that move a sensor, by the rule of `fmu.fem.pairing.rules.reference_modes`."""
    rows = selection(model.structure.translations, model.structure.n_dof)
    seen = np.abs((rows if observation is None else observation) @ shapes)
    elastic = ~is_rigid(eigenvalues)
    largest = np.max(np.abs(rows @ shapes), initial=0.0)
    return np.asarray(elastic & (np.max(seen, axis=0, initial=0.0) > _SEEN * largest))


def _moves(model: PairedStructure, point: FloatArray, shapes: FloatArray) -> list[str]:
    """Return for each mode the directions that hold its kinetic energy, the two largest shares.

    The energy of a direction d is φ_dᵀ M_dd φ_d, which is not negative. What couples directions, as displacement
    and rotation in a consistent mass matrix, belongs to none of them: φ_dᵀ (Mφ)_d, which includes it, can exceed
    the whole.
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
    """Return a table of text, one row per computed mode, with dashes where nothing applies.

    Three or more rigid-body modes share a row, and so do three or more in a row that move no sensor.
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
