"""The modes of a model beside the measured ones, and how far their pairing is beyond doubt."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.modes.pairing_doubts import (
    COUNTERPARTS_GIVEN,
    TAKEN_FOR_GRANTED,
    ComputedMode,
    close,
    disordered,
    unlike,
    unmeasured,
)
from fmu.fem.modes.modal import frequency_hz, is_rigid, mac
from fmu.fem.modes.separable import selection
from fmu.fem.modes.threads import single_thread
from fmu.fem.pairing.paired_black_box import PairedBlackBox
from fmu.fem.pairing.paired_model import PairedStructure
from fmu.fem.pairing.rules import IndexPairing, assign
from fmu.numbers import share
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.problem import UpdatingProblem


_SEEN = 1e-3
_BEYOND = 2


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
    structural = point[: problem.model.n_parameters]  # behind them, what is uncertain of the errors
    if isinstance(problem.model, PairedStructure):
        return _of_structure(problem, problem.model, structural, labels, measured)
    if isinstance(problem.model, PairedBlackBox):
        return _of_function(problem.model, structural, labels, measured)
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
    doubts = [*unlike(labels, paired, alike), *close(labels, paired, frequencies, seen, by_number)]
    given = bool(problem.data.counterparts) and not by_number
    doubts += [] if given else disordered(labels, paired, measured)
    granted = COUNTERPARTS_GIVEN if given else TAKEN_FOR_GRANTED
    taken = [] if by_number or problem.data.shapes is not None else [granted]
    return InitialModes(labels, measured, found, alike, tuple(doubts), (*taken, *unmeasured(found)))


def _of_function(
    model: PairedBlackBox, point: FloatArray, labels: tuple[str, ...], measured: FloatArray
) -> InitialModes:
    """Return all modes that a function gives, in its order, and those that answer to the measured ones."""
    answer = model.black_box.at(point)
    alike = None
    if model.reference is not None and answer.shapes is not None:
        alike = mac(answer.shapes, model.reference)
        paired = [int(column) for column in assign(alike[None])[0]]
    else:
        paired = [number - 1 for number in model.numbers]
    answers = {number: k for k, number in enumerate(paired)}
    frequencies = answer.frequencies[: max(paired) + 1 + _BEYOND]
    found = tuple(ComputedMode(i + 1, float(f), answers.get(i)) for i, f in enumerate(frequencies))
    alike = None if alike is None else alike[:, : len(found)]
    seen = np.ones(len(found), dtype=bool)
    doubts = [*unlike(labels, paired, alike), *close(labels, paired, frequencies, seen, alike is None)]
    doubts += disordered(labels, paired, measured)
    how = "by number, in the order of the function" if alike is None else "by MAC with the measured shapes"
    notes = (f"Modes are paired {how}.", *(unmeasured(found) if alike is not None else ()))
    return InitialModes(labels, measured, found, alike, tuple(doubts), notes)


def _spectrum(model: PairedStructure, point: FloatArray) -> tuple[Any, list[int]]:
    """Return the lowest modes, up to two beyond the last that is paired, and the columns of the paired ones."""
    pairs = model.full_modes(point[None])
    wanted = list(zip(pairs.block[0].tolist(), pairs.rank[0].tolist(), strict=True))
    total = model.full.n_modes
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


def _seen(model: PairedStructure, shapes: FloatArray, observation: Any, eigenvalues: FloatArray) -> BoolArray:
    """Say which modes move a sensor, by the rule of `fmu.fem.pairing.rules.reference_modes`."""
    rows = selection(model.structure.translations, model.structure.n_dof)
    seen = np.abs((rows if observation is None else observation) @ shapes)
    elastic = ~is_rigid(eigenvalues)
    largest = np.max(np.abs(rows @ shapes), initial=0.0)
    return np.asarray(elastic & (np.max(seen, axis=0, initial=0.0) > _SEEN * largest))


def _moves(model: PairedStructure, point: FloatArray, shapes: FloatArray) -> list[str]:
    """Return for each mode the directions that hold its kinetic energy φᵢ(Mφ)ᵢ, the two largest shares."""
    directions = np.array([direction for _, direction in model.structure.dofs])
    names = [str(name) for name in dict.fromkeys(directions)]
    if len(names) < 2:
        return [""] * shapes.shape[1]
    energy = shapes * (model.structure.M(point) @ shapes)
    part = np.array([energy[directions == name].sum(axis=0) for name in names])
    words = []
    for column in part.T:
        order = np.argsort(-column)[:2]
        words.append(", ".join(f"{names[i]} {share(round(column[i], 2))}" for i in order if column[i] > 0.1))
    return words
