"""Structures given by their matrices, with modes that are paired with measured modes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from copy import copy
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from fmu.engines.blas import single_thread
from fmu.fem.modes.block import Block, Observation
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.full_block import FullBlock, full_blocks
from fmu.fem.modes.modal import ModalSolution, count_modes, frequency_gradient, frequency_hz, join_shapes
from fmu.fem.modes.separable import SeparableModel, selection
from fmu.fem.modes.solver import LAPACK, Matrix, sparse_solver
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import Candidates, ModalPrediction, predict_candidates, predict_modes
from fmu.fem.pairing.reference_modes import count_rigid, margin_for_shapes, reference_modes
from fmu.fem.pairing.rules import (
    SOFTNESS,
    IndexPairing,
    RankPairing,
    ShapePairing,
    SoftPairing,
)
from fmu.fem.pairing.sensitivities import Sensitivities, Steps, StructureSensitivities
from fmu.progress.phases import count_solves
from fmu.types import Dof, FloatArray, IntArray

PAIRINGS = ("shape", "index")
SOFT = "soft"


class PairedStructure(ModalModel):
    """A structure whose modes are paired with the measured modes; `of` builds one.

    Parameters
    ----------
    structure : SeparableModel
    blocks : tuple of Block
        Decoupled blocks of the structure, full or reduced, that are solved.
    rule : IndexPairing or ShapePairing
    n_modes : int
        Number of measured modes.
    sensors : sparse, shape (n_sensors, n_dof)
        From `SeparableModel.observation`.
    at_sensors : bool
        Whether the rule compares shapes at the sensors.
    pairing : RankPairing, optional
        Fixed ranks, if the rule is known to give the same ranks everywhere. Defaults to the rule itself.

    Attributes
    ----------
    softness : float
        Temperature for the weights of a soft pairing, otherwise 0.
    sensors : tuple of (node, direction)
        The sensors given to `seen_by`; otherwise empty.
    why_full : str
        Why there is no reduced model although one was trained, as a sentence; otherwise empty.
    """

    gives_shapes = True
    gives_shape_curvature = has_exact_curvature = True

    def __init__(
        self,
        structure: SeparableModel,
        blocks: tuple[Block, ...],
        rule: IndexPairing | ShapePairing,
        n_modes: int,
        sensors: sp.csr_array,
        at_sensors: bool,
        pairing: IndexPairing | ShapePairing | RankPairing | None = None,
    ) -> None:
        self.structure: SeparableModel = structure
        self.n_parameters, self.n_modes = structure.n_parameters, n_modes
        self.blocks, self.rule = blocks, rule
        self.by_shape, self.is_soft, self.softness = rule.by_shape, rule.is_soft, rule.softness
        self.pairing: IndexPairing | ShapePairing | RankPairing = pairing or rule
        self.why_full = ""
        self.sensors: tuple[Dof, ...] = ()
        self._sensors, self._at_sensors = sensors, at_sensors
        self._observed = self.pairing.observe(blocks)

    def __getstate__(self) -> dict[str, object]:
        """Return the state for pickling. It omits data that are recomputed on demand."""
        return {name: value for name, value in self.__dict__.items() if name not in ("rows", "_compared")}

    @classmethod
    def of(
        cls,
        model: SeparableModel,
        *,
        pairing: str,
        numbers: tuple[int, ...],
        elastic_from_hz: float | None = None,
        sensors: tuple[Dof, ...],
        reference: FloatArray,
        shapes: FloatArray | None = None,
        measured_hz: FloatArray | None = None,
        counterparts: tuple[int, ...] = (),
        softness: float = SOFTNESS,
    ) -> PairedStructure:
        """Return a model paired with a measurement. Reference modes are computed if the pairing needs them.

        Parameters
        ----------
        model : SeparableModel
        pairing : {"shape", "index", "soft"}
            ``"shape"``: one-to-one assignment by MAC with the measured shapes at the sensors. If no shapes were
            measured, the MAC is computed with the model's visible modes at `reference`, at all translations.
            ``"index"``: by `numbers` in the sorted spectrum. ``"soft"``: as ``"shape"``, but every measured mode
            is compared with all candidates, with weights.
        numbers : tuple of int
            Number (from 1) of each measured mode.
        elastic_from_hz : float, optional
            The lowest measured frequency, given if number 1 is the first elastic mode: modes far below this
            frequency are then rigid-body modes of a free structure. By default, `numbers` count rigid-body modes
            too. Used only by ``"index"``.
        sensors : tuple of (node, direction)
            Measured degrees of freedom. If empty, a mode that moves any translation is visible, and `observed`
            gives no shapes.
        reference : ndarray, shape (n_parameters,)
            Model parameters before updating.
        shapes : ndarray, shape (n_sensors, n_modes), optional
            Measured shapes.
        measured_hz : ndarray, shape (n_modes,), optional
            Measured frequencies, given with `shapes`. Modes up to 1.5 times the highest frequency are considered.
            The frequencies decide between modes that have the same shape at the sensors.
        counterparts : tuple of int, optional
            If no shapes were measured: for each measured mode, the number (from 1) of its counterpart among the
            modes at `reference` that the sensors can see. If empty, these are the lowest visible modes in order.
        softness : float
            Temperature for the weights of ``"soft"``: `fmu.fem.pairing.rules.SoftPairing`.

        Raises
        ------
        ValueError
            If the pairing is unknown, the model has too few modes, or none at `reference`, a sensor is not on the
            model, the sensors cannot see the modes, `numbers` are not distinct or not positive, or `softness` is
            not positive or not finite.
        """
        if pairing not in (*PAIRINGS, SOFT):
            raise ValueError(f"pairing: must be one of {(*PAIRINGS, SOFT)} (got {pairing!r})")
        full, n_modes = full_blocks(model), len(numbers)
        available = count_modes(full)
        if available < n_modes:
            raise ValueError(
                f"mass: the {n_modes} measured modes need as many of finite frequency: the mass matrix gives "
                f"{available}; give mass to more degrees of freedom"
            )
        seen = model.observation(sensors)
        rule: IndexPairing | ShapePairing
        if pairing == "index":
            n_rigid = 0
            if elastic_from_hz is not None:
                with single_thread():
                    n_rigid = count_rigid(full, reference, n_modes, elastic_from_hz)
            numbers = tuple(number + n_rigid for number in numbers)
            rule = IndexPairing(numbers, n_rigid)
            if max(numbers) > available:
                raise ValueError(f"numbers: must lie in 1..{available}, the modes of the model (got {numbers})")
            return cls(model, full, rule, n_modes, seen, shapes is not None)
        with single_thread():
            if shapes is not None:
                margin = margin_for_shapes(full, reference, seen, shapes, measured_hz)
                rule = ShapePairing(seen, shapes, margin, measured_hz)
            else:
                rows = selection(model.translations, model.n_dof)
                visible = seen if sensors else rows
                rule = reference_modes(full, reference, visible, rows, n_modes, counterparts, model)
        if pairing == SOFT:
            rule = SoftPairing(rule.rows, rule.shapes, rule.margin, rule.measured_hz, softness)
        return cls(model, full, rule, n_modes, seen, shapes is not None)

    @property
    def full_blocks(self) -> tuple[FullBlock, ...]:  # type: ignore[override]
        """Blocks that are not reduced."""
        return tuple(block for block in self.blocks if isinstance(block, FullBlock))

    def __repr__(self) -> str:
        return f"PairedStructure({self.structure!r}, {type(self.pairing).__name__})"

    def solved_by(
        self, blocks: tuple[Block, ...], pairing: IndexPairing | ShapePairing | RankPairing
    ) -> PairedStructure:
        """Return a model of the same structure and measurement, solved with other blocks and another pairing."""
        own = (self.rule, self.n_modes, self._sensors, self._at_sensors)
        return PairedStructure(self.structure, blocks, *own, pairing)

    def seen_by(self, sensors: tuple[Dof, ...]) -> PairedStructure:
        """Return a copy with the same pairing, for which `observed` gives shapes at other sensors."""
        own = (self.structure, self.blocks, self.rule, self.n_modes, self.structure.observation(sensors))
        other = PairedStructure(*own, self._at_sensors, self.pairing)
        other.sensors = sensors
        return other

    def kept_full(self, size: int) -> PairedStructure:
        """Return a copy whose `why_full` explains that a reduced model with `size` unknowns would not help."""
        other = copy(self)
        other.why_full = (
            f"The full model answers: a reduced one of {size} unknowns is not accurate within these bounds, and "
            "more unknowns would take as long as the full model."
        )
        return other

    @cached_property
    def rows(self) -> list[Matrix]:
        """Sensor rows of each block. They are computed on demand, because many problems do not use mode shapes."""
        return [block.coordinates(self._sensors[:, block.dofs]) for block in self.blocks]

    @cached_property
    def _compared(self) -> dict[int, Observation]:
        """Comparison coordinates and reference shapes, keyed by block; only for a pairing by shape.

        Shapes are compared at the sensors if shapes were measured, otherwise at all translations, which are
        compressed in a reduced block (`Block.compress_rows`).
        """
        assert self.rule.by_shape  # for the type checker
        found = {}
        for b in self.rule.observe(self.blocks):
            block, reference = self.blocks[b], self.rule.shapes
            rows = block.coordinates(self.rule.rows[:, block.dofs])
            found[b] = (rows, reference) if self._at_sensors else block.compress_rows(rows, reference)
        return found

    def solve(self, theta: FloatArray, gradient: bool = False) -> ModalSolution:
        """Return the same as `modes`, without counting the solves or limiting the number of threads."""
        return self.pairing.solve(self.blocks, theta, gradient, self._observed)

    def see(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the same as `observed`, without counting the solves or limiting the number of threads."""
        located = self.pairing.locate(self.blocks, theta, gradient, self._observed)
        return predict_modes(self.blocks, located, self.rows, theta, gradient)

    def choose(self, theta: FloatArray, gradient: bool = False) -> Candidates:
        """Return the same as `seen_candidates`, without counting the solves or limiting the number of threads."""
        assert self.rule.by_shape  # for the type checker
        return predict_candidates(self.blocks, self.rule, self._compared, self._at_sensors, theta, gradient)

    def modes(self, theta: FloatArray, gradient: bool = False) -> ModalSolution:
        """Return the paired modes at theta (n, n_parameters), with eigenvalue gradients if `gradient`."""
        return _solve_counted(self.solve, theta, gradient)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted frequencies and sensor shapes at theta (n, n_parameters).

        Derivatives are included if `gradient`.
        """
        return _solve_counted(self.see, theta, gradient)

    def seen_candidates(self, theta: FloatArray, gradient: bool = False) -> Candidates:
        """Return all candidates for pairing with the measured modes at theta (n, n_parameters).

        Derivatives are included if `gradient`. Requires a pairing by shape, which may be soft.
        """
        return _solve_counted(self.choose, theta, gradient)

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, (n, n_modes), with NaN where a solve failed or λ is clearly negative."""
        return frequency_hz(self.modes(theta).eigenvalues)

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies in Hz, shape (n, n_modes), and exact gradients, shape (n, n_modes, n_parameters)."""
        return frequencies_of(self.modes(theta, gradient=True))

    def sensitivities(self, theta: FloatArray, steps: Steps, shapes: bool = False) -> Sensitivities:
        """Return the frequencies with exact first and second derivatives; see `ModalModel`. `steps` is ignored."""
        count_solves(len(theta), with_gradients=True)
        with single_thread():
            return self.solve_sensitivities(theta, shapes)

    def solve_sensitivities(self, theta: FloatArray, shapes: bool) -> Sensitivities:
        """Return the same as `sensitivities`, without counting the solves or limiting the number of threads."""
        located = self.pairing.locate(self.blocks, theta, True, self._observed)
        counts, sensors = self.pairing.counts(self.blocks), self.rows if shapes else None
        return StructureSensitivities(self.blocks, located, counts, theta, sensors)

    def candidates(self, theta: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
        """Return the eigenvalues in (rad/s)² of all candidate modes, and of one more mode per block if it exists.

        Returns
        -------
        eigenvalues : ndarray, shape (n, n_candidates)
            NaN where a solve failed, and for modes for which a reduced model was not trained.
        block, rank : ndarray of int, shape (n_candidates,)
            Each mode's block index, and its index (from 0) within that block.
        """
        count_solves(len(theta))
        counts = self.candidate_counts()
        with single_thread():
            found = self.spectra(theta, counts)
        return found, *candidate_numbers(counts)

    def candidate_counts(self) -> dict[int, int]:
        """Return how many modes per block `candidates` gives, keyed by block index."""
        counts = self.rule.counts(self.blocks)
        return {b: min(count + 1, self.blocks[b].n_modes) for b, count in counts.items()}

    def spectra(self, theta: FloatArray, counts: Mapping[int, int]) -> FloatArray:
        """Return the lowest `counts[b]` eigenvalues of each block b in (rad/s)², shape (n, n_candidates).

        They are NaN where a solve failed, and for modes for which a reduced block was not trained.
        """
        parts = []
        for b, count in counts.items():
            found = np.full((len(theta), count), np.nan)
            n_trained = min(count, self.blocks[b].n_trained)
            if len(theta):
                found[:, :n_trained] = self.blocks[b].eigenvalues(theta, n_trained)
            parts.append(found)
        return np.concatenate(parts, axis=1)

    @property
    def solver(self) -> str:
        """Name of the solver for the largest block, without regard to LAPACK's solver for narrow bands.

        It is LAPACK for up to `DENSE_LIMIT` degrees of freedom, otherwise the sparse solver in use.
        """
        largest = max(block.size for block in self.blocks)
        return sparse_solver() if largest > DENSE_LIMIT else LAPACK

    def shapes(self, theta: FloatArray) -> FloatArray:
        """Return the mass-normalised shapes of the paired modes at theta (n_parameters,), shape (n_dof, n_modes).

        All blocks must be full. A shape is zero outside its mode's block, and NaN if its mode cannot be solved.
        """
        point = np.asarray(theta, dtype=float)[None]
        modes = self.modes(point)
        with single_thread():
            found = join_shapes(self.blocks, point, modes, self.rule.counts(self.blocks))
        found[:, modes.failed[0]] = np.nan
        return found

    def fingerprint(self) -> str:
        """Return a hash of all data that affect the frequencies."""
        digest = hashlib.sha256(repr((self.structure.dofs, type(self.rule).__name__)).encode())
        matrices = [(term.powers, term.matrix) for term in (*self.structure.K_terms, *self.structure.M_terms)]
        of_rule, its_matrices = self.rule.identity()
        digest.update(of_rule)
        for powers, matrix in (*matrices, *(((), matrix) for matrix in its_matrices)):
            entries = matrix.tocsr()
            digest.update(repr((powers, entries.shape)).encode())
            for part in (entries.indptr, entries.indices, entries.data):
                digest.update(np.ascontiguousarray(part).tobytes())
        return digest.hexdigest()

    def configuration(self) -> dict[str, object]:
        """Return data that identify the model, as plain Python types."""
        n_rigid = 0 if self.rule.by_shape else self.rule.n_rigid
        return {
            "structure": repr(self.structure),
            "pairing": type(self.rule).__name__,
            "sha256": self.fingerprint(),
        } | ({"n_rigid": n_rigid} if n_rigid else {})


def structure_of(model: ModalModel) -> PairedStructure | None:
    """Return the model's `truth` if it is a `PairedStructure`, otherwise None."""
    truth = model.truth
    return truth if isinstance(truth, PairedStructure) else None


def largest_block(model: ModalModel) -> int:
    """Return the number of degrees of freedom in a model's largest block, or 0 if it has no matrices."""
    structure = structure_of(model)
    return 0 if structure is None else max(block.size for block in structure.blocks)


def frequencies_of(modes: ModalSolution) -> tuple[FloatArray, FloatArray]:
    """Convert solved modes to frequencies in Hz, (n, n_modes), and gradients, (n, n_modes, n_parameters)."""
    assert modes.gradient is not None  # for the type checker: the caller has requested the gradients
    frequencies = frequency_hz(modes.eigenvalues)
    return frequencies, frequency_gradient(frequencies, modes.gradient)


def candidate_numbers(counts: Mapping[int, int]) -> tuple[IntArray, IntArray]:
    """Return block index and rank, (n,) each, of the lowest `counts[b]` modes of each block b."""
    ranks = np.concatenate([np.arange(count) for count in counts.values()])
    return np.repeat(list(counts), list(counts.values())), ranks


def _solve_counted[Solution](
    solve: Callable[[FloatArray, bool], Solution], theta: FloatArray, gradient: bool
) -> Solution:
    count_solves(len(theta), with_gradients=gradient)
    with single_thread():
        return solve(theta, gradient)
