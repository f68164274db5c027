"""The modes of a model beside the measured ones, and how far their pairing is beyond doubt."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.fem.modal import RIGID, frequency_hz, mac
from fmu.fem.pairing import IndexPairing
from fmu.fem.separable import selection
from fmu.fem.structure import PairedStructure
from fmu.fem.threads import single_thread

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.problem import UpdatingProblem

FloatArray = NDArray[np.float64]

ALIKE = 0.8
"""MAC below which two shapes are hardly of one mode."""
RIVAL = 0.1
"""How much more MAC the mode chosen must have than any other."""
CLOSE = 0.01
"""Relative distance of two frequencies below which they are hard to tell apart."""
_SEEN = 1e-3
_BEYOND = 2


@dataclass(frozen=True)
class ComputedMode:
    """A mode of the model.

    Attributes
    ----------
    number : int or None
        In the sorted spectrum, from 1; None where a model gives paired frequencies alone.
    frequency_hz : float
    measured : int or None
        The measured mode (from 0) that it answers to.
    seen : bool
        Whether a sensor moves in it.
    moves : str
        The directions that hold most of its kinetic energy: ``"z 98 %"``; empty where they are not known.
    """

    number: int | None
    frequency_hz: float
    measured: int | None
    seen: bool = True
    moves: str = ""


@dataclass(frozen=True, eq=False)
class InitialModes:
    """The lowest modes of a model, and the measured ones that they answer to.

    Attributes
    ----------
    labels : tuple of str
        Of the measured modes.
    measured_hz : ndarray, shape (n_modes,)
    modes : tuple of ComputedMode
        Ascending, up to two beyond the last that is paired.
    mac : ndarray, shape (n_modes, n_computed), or None
        Of measured with computed shapes at the sensors, where shapes were measured.
    doubts : tuple of str
        What makes the pairing doubtful, a sentence each.
    notes : tuple of str
        What else there is to know of it.
    """

    labels: tuple[str, ...]
    measured_hz: FloatArray
    modes: tuple[ComputedMode, ...]
    mac: FloatArray | None = None
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    _column: dict[int, int] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        columns = {mode.measured: c for c, mode in enumerate(self.modes) if mode.measured is not None}
        object.__setattr__(self, "_column", columns)

    def of(self, k: int) -> ComputedMode:
        """Return the computed mode that answers to measured mode `k` (from 0)."""
        return self.modes[self._column[k]]

    def error_percent(self, k: int) -> float:
        """Return how much higher the model's frequency of measured mode `k` is than the measured one, %."""
        return 100.0 * (self.of(k).frequency_hz / float(self.measured_hz[k]) - 1.0)

    def table(self) -> pd.DataFrame:
        """Return one row a computed mode: number, Hz, what it answers to, error in %, MAC, energy, seen or not."""
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
                    "moves": mode.moves,
                    "seen": mode.seen,
                }
            )
        return pd.DataFrame(rows)


def initial_modes(problem: UpdatingProblem, theta: ArrayLike | None = None) -> InitialModes:
    """Solve a problem's full model and say which of its modes answer to the measured ones.

    Parameters
    ----------
    problem : UpdatingProblem
    theta : array_like, shape (ndim,), optional
        Where: at the start if not given.

    Returns
    -------
    InitialModes
        Of a model that gives no more than paired frequencies, those alone.
    """
    point = problem.start if theta is None else np.asarray(theta, dtype=float)
    labels = tuple(map(str, problem.data.labels))
    measured = np.asarray(problem.data.frequencies_hz, dtype=float)
    if isinstance(problem.model, PairedStructure):
        return _of_structure(problem, problem.model, point, labels, measured)
    frequencies = problem.frequencies(point)
    found = tuple(ComputedMode(None, float(frequencies[k]), int(k)) for k in range(len(frequencies)))
    note = "The model itself says which of its modes answer to the measured ones."
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
    shapes = _shapes(model, point, spectrum)
    observation = model.structure.observation(problem.data.sensors) if problem.data.sensors else None
    seen = _seen(model, shapes, observation, spectrum.eigenvalues[0])
    moves = _moves(model, point, shapes)
    answers = {number: k for k, number in enumerate(paired)}
    found = tuple(
        ComputedMode(i + 1, float(frequencies[i]), answers.get(i), bool(seen[i]), moves[i])
        for i in range(len(frequencies))
    )
    alike = None
    if problem.data.shapes is not None and observation is not None:
        alike = mac(observation @ shapes, np.asarray(problem.data.shapes))
    by_number = isinstance(model.rule, IndexPairing)
    doubts = [*_unlike(labels, paired, alike), *_close(labels, paired, frequencies, seen, by_number)]
    doubts += _disordered(labels, paired, measured)
    return InitialModes(labels, measured, found, alike, tuple(doubts), tuple(_notes(problem, by_number, found)))


def _spectrum(model: PairedStructure, point: FloatArray) -> tuple[Any, list[int]]:
    """Return the lowest modes, up to two beyond the last that is paired, and the columns of the paired ones."""
    pairs = model.full_modes(point[None])
    wanted = list(zip(pairs.block[0].tolist(), pairs.rank[0].tolist(), strict=True))
    total = sum(block.size for block in model.full.blocks)
    count = min(total, 2 * model.n_modes + _BEYOND)
    while True:
        with single_thread():
            spectrum = model.full.spectrum(point[None], count)
        column = {
            key: i for i, key in enumerate(zip(spectrum.block[0].tolist(), spectrum.rank[0].tolist(), strict=True))
        }
        if count == total or all(key in column for key in wanted):
            paired = [column[key] for key in wanted]
            if count == total or max(paired) + _BEYOND < count:
                return spectrum.columns(np.arange(min(count, max(paired) + 1 + _BEYOND))), paired
        count = min(total, 2 * count)


def _shapes(model: PairedStructure, point: FloatArray, spectrum: Any) -> FloatArray:
    """Return the mass-normalised shapes of the modes of a spectrum, shape (n_dof, n_computed)."""
    shapes = np.zeros((model.structure.n_dof, spectrum.block.shape[1]))
    with single_thread():
        for b in np.unique(spectrum.block[0]):
            columns = np.flatnonzero(spectrum.block[0] == b)
            ranks = spectrum.rank[0, columns]
            block = model.full.blocks[b]
            shapes[np.ix_(block.dofs, columns)] = block.modes(point[None], int(ranks.max()) + 1)[1][0][:, ranks]
    return shapes


def _seen(
    model: PairedStructure, shapes: FloatArray, observation: Any, eigenvalues: FloatArray
) -> NDArray[np.bool_]:
    """Say which modes move a sensor, by the rule of `fmu.fem.pairing.reference_modes`."""
    rows = selection(model.structure.translations, model.structure.n_dof)
    seen = np.abs((rows if observation is None else observation) @ shapes)
    elastic = eigenvalues > RIGID * eigenvalues[-1]
    largest = np.max(np.abs(rows @ shapes), initial=0.0)
    return np.asarray(elastic & (np.max(seen, axis=0, initial=0.0) > _SEEN * largest))


def _moves(model: PairedStructure, point: FloatArray, shapes: FloatArray) -> list[str]:
    """Return for each mode the directions that hold its kinetic energy φᵢ(Mφ)ᵢ, the two largest shares."""
    directions = np.array([direction for _, direction in model.structure.dofs])
    names = [str(name) for name in dict.fromkeys(directions)]
    if len(names) < 2:
        return [""] * shapes.shape[1]
    energy = shapes * (model.structure.M(point) @ shapes)
    share = np.array([energy[directions == name].sum(axis=0) for name in names])
    words = []
    for column in share.T:
        order = np.argsort(-column)[:2]
        words.append(", ".join(f"{names[i]} {100 * column[i]:.0f} %" for i in order if column[i] > 0.1))
    return words


def _unlike(labels: tuple[str, ...], paired: list[int], alike: FloatArray | None) -> list[str]:
    doubts = []
    for k, column in enumerate(paired if alike is not None else []):
        row = alike[k]  # type: ignore[index]  # there is one, or there is no column
        others = np.delete(np.arange(len(row)), column)
        if row[column] < ALIKE:
            doubts.append(
                f"Mode {labels[k]}: MAC {row[column]:.2f} with computed mode {column + 1}, below {ALIKE}."
            )
        rival = others[np.argmax(row[others])] if len(others) else column
        if rival != column and row[rival] > row[column] - RIVAL:
            doubts.append(
                f"Mode {labels[k]}: the sensors hardly tell computed mode {column + 1} (MAC {row[column]:.2f}) "
                f"from {rival + 1} (MAC {row[rival]:.2f})."
            )
    return doubts


def _close(
    labels: tuple[str, ...], paired: list[int], frequencies: FloatArray, seen: NDArray[np.bool_], by_number: bool
) -> list[str]:
    """Name computed modes that are hardly apart: any two if pairing is by number, else those that sensors see."""
    doubts, told = [], set()
    for k, column in enumerate(paired):
        for other in (column - 1, column + 1):
            pair = (min(column, other), max(column, other))
            if not 0 <= other < len(frequencies) or pair in told or not (by_number or seen[other]):
                continue
            apart = abs(frequencies[other] / frequencies[column] - 1.0)
            if apart < CLOSE:
                told.add(pair)
                doubts.append(
                    f"Mode {labels[k]}: computed modes {pair[0] + 1} and {pair[1] + 1} are {100 * apart:.2g} % "
                    "apart; which of them was measured, their frequencies do not tell."
                )
    return doubts


def _disordered(labels: tuple[str, ...], paired: list[int], measured: FloatArray) -> list[str]:
    order = np.argsort(measured, kind="stable")
    numbers = [paired[k] for k in order]
    if numbers == sorted(numbers):
        return []
    return [
        "Measured and computed modes come in different orders: "
        + ", ".join(f"{labels[k]} is computed mode {paired[k] + 1}" for k in order)
        + "."
    ]


def _notes(problem: UpdatingProblem, by_number: bool, found: tuple[ComputedMode, ...]) -> list[str]:
    last = max(i for i, mode in enumerate(found) if mode.measured is not None)
    idle = [mode for mode in found[:last] if mode.measured is None]
    notes = []
    if not by_number and problem.data.shapes is None:
        notes.append(
            "No shapes were measured: that the measured modes are the lowest that the sensors see, in this order, "
            "is taken for granted."
        )
    for seen, words in ((False, "move no sensor"), (True, "move a sensor, but were not measured")):
        numbers = [str(mode.number) for mode in idle if mode.seen == seen]
        if numbers:
            one = len(numbers) == 1
            subject = f"Computed mode {numbers[0]}" if one else f"Computed modes {', '.join(numbers)}"
            notes.append(
                f"{subject} {words.replace('move', 'moves', 1).replace('were', 'was') if one else words}."
            )
    return notes
