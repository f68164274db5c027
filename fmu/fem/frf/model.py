"""FRFs of a structure given by its matrices, computed with a reduced basis that is accurate in a parameter box."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fmu.durable_files import digest
from fmu.fem.frf.general import GeneralDamping, GeneralResponses
from fmu.fem.frf.proportional import ZERO, ModalResponses, ProportionalDamping, Source
from fmu.fem.frf.training import EXACT_LIMIT, TOLERANCE, Lines, TrainedFRFs, train
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import is_rigid
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.cache import load_basis, store_basis
from fmu.types import Dof, FloatArray

_STIFFER = 1e-9
"""Relative change in the band's highest eigenvalue that the fictitious mass of massless degrees of freedom may
cause."""


@dataclass(frozen=True, eq=False)
class Damping:
    """A structure's damping, expressed through its matrices.

    Attributes
    ----------
    n_values : int
        Number of damping parameters.
    alpha, beta, loss : Source
        Rayleigh's α in 1/s and β in s, and the loss factor of the whole structure.
    ratios : tuple of Source
        Damping ratios of the elastic modes in ascending order; the last ratio applies to all higher modes too.
        Must be empty if the damping couples the modes; in that case, ratios would be ignored.
    losses : dict of int to Source
        Loss factor of the stiffness that a model parameter scales, keyed by the parameter's index. Parameters
        that scale the same stiffness must have the same loss factor. All other stiffness has the loss factor
        `loss`.
    dashpots : tuple of (sparse, Source)
        Matrix (n_dof, n_dof) of each dashpot, and its coefficient in N·s/m.
    """

    n_values: int = 0
    alpha: Source = ZERO
    beta: Source = ZERO
    loss: Source = ZERO
    ratios: tuple[Source, ...] = ()
    losses: dict[int, Source] | None = None
    dashpots: tuple[tuple[sp.csr_array, Source], ...] = ()

    @property
    def couples_modes(self) -> bool:
        """Whether the damping couples the modes of the undamped structure."""
        return bool(self.losses or self.dashpots)


class FRFModel:
    """Receptances of a structure between points, as functions of its structural and damping parameters.

    Parameters
    ----------
    structure : SeparableModel
    responses, drives : sequence of (place, direction), length n_frfs
    damping : Damping
    start : ndarray, shape (n_parameters,)
        Structural parameters before updating.
    lower, upper : ndarray, shape (n_parameters,)
        The box in which the reduced model is trained.
    values : ndarray, shape (n_values,)
        Damping parameters used in training.
    lines : Lines
        Frequency lines at which the FRFs are needed, and the units of their errors.

    Attributes
    ----------
    full, block : FullBlock, ReducedBlock
        All blocks of the structure with a drive, a response or a dashpot, taken together as one block, and the
        same block reduced. If degrees of freedom have no mass, a small multiple of K is added to M.
    rows : sparse, shape (n_points, full.size)
        Matrix that maps displacements of `full` to displacements of the points. The points are all drives and
        responses; a point that occurs several times is included once.
    responses, drives : ndarray of int, shape (n_frfs,)
        Points of each FRF, as rows of `rows`.
    of_block : ProportionalDamping or GeneralDamping
        The damping projected onto the basis of `block`.
    points : ndarray, shape (n_points, block.size)
        `rows` projected onto the basis of `block`.
    error : float
        Error at the last training point, before the basis was truncated: the root of the summed squared errors of
        all FRFs at all lines, each divided by its unit. NaN if the basis has all degrees of freedom.
    is_confirmed : bool
        Whether the errors at the last few training points were all below the tolerance. True if the basis has all
        degrees of freedom.
    n_solves : int
        Number of points at which the full structure was solved; 0 if the basis has all degrees of freedom.

    Raises
    ------
    ValueError
        If a drive or response point involves no free degree of freedom.
    """

    def __init__(
        self,
        structure: SeparableModel,
        responses: Sequence[Dof],
        drives: Sequence[Dof],
        damping: Damping,
        start: FloatArray,
        lower: FloatArray,
        upper: FloatArray,
        values: FloatArray,
        lines: Lines,
    ) -> None:
        points = list(dict.fromkeys([*responses, *drives]))
        self.responses = np.array([points.index(one) for one in responses])
        self.drives = np.array([points.index(one) for one in drives])
        rows = structure.observation(points)
        touched = np.unique(rows.indices)
        parts = [dofs for dofs in structure.blocks if np.isin(dofs, touched).any()]
        for matrix, _ in damping.dashpots:
            ends = np.unique(matrix.indices)
            parts += [dofs for dofs in structure.blocks if np.isin(dofs, ends).any()]
        dofs = np.unique(np.concatenate(parts))
        self.rows = sp.csr_array(rows[:, dofs])
        full = FullBlock(structure, dofs)
        if full.massless:
            small = _STIFFER / float(np.max(lines.omega)) ** 2
            heavier = [Term(small * term.matrix, term.powers) for term in structure.K_terms]
            heavy = SeparableModel(structure.K_terms, (*structure.M_terms, *heavier), structure.dofs)
            full = FullBlock(heavy, dofs)
        self.full, self.damping = full, damping
        lam = full.eigenvalues(start[None], min(12, full.n_modes))[0]
        self.n_rigid = int(np.sum(is_rigid(lam))) if len(lam) > 1 else 0
        self.n_values = damping.n_values

        self.lines = lines
        trained = self._train_once(lower, upper, values)
        self.block, self.error = trained.block, trained.error
        self.is_confirmed, self.n_solves = trained.is_confirmed, trained.n_solves
        self.of_block, self.points = self._damping_of(self.block), self._at_points(self.block)

    def _train_once(self, lower: FloatArray, upper: FloatArray, values: FloatArray) -> TrainedFRFs:
        """Return the result of training. It comes from the cache if the same basis was trained before."""
        key = self._key(lower, upper, values)
        state = load_basis(key) if key else None
        if state is not None:
            block = ReducedBlock(self.full, state["basis"], state["basis"].shape[1])
            return TrainedFRFs(block, float(state["error"]), bool(state["is_confirmed"]), int(state["n_solves"]))
        found = train(self.full, self.rows, lower, upper, self.lines, lambda block: _OfBlock(self, block, values))
        if key:
            others = {name: np.asarray(getattr(found, name)) for name in ("error", "is_confirmed", "n_solves")}
            store_basis(key, {"basis": found.block.basis, **others})
        return found

    def _key(self, lower: FloatArray, upper: FloatArray, values: FloatArray) -> dict[str, str]:
        """Return the basis's cache key, or an empty dict if there is no reduced model."""
        if self.full.size <= EXACT_LIMIT:
            return {}
        lines, given = self.lines, self.damping
        terms = (*self.full.K_terms, *self.full.M_terms)
        matrices = [self.rows, *(term.matrix for term in terms), *(matrix for matrix, _ in given.dashpots)]
        arrays = [part for matrix in matrices for part in (matrix.indptr, matrix.indices, matrix.data)]
        arrays += [lines.omega, lines.unit, lower, upper, values, self.responses, self.drives]
        of_dashpots = [source for _, source in given.dashpots]
        sources = (given.alpha, given.beta, given.loss, given.ratios, given.losses, of_dashpots)
        settings = repr((sources, [term.powers for term in terms], TOLERANCE))
        contents = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
        return {"frfs": digest(settings.encode() + contents)}

    def at(self, theta: FloatArray, values: FloatArray) -> ModalResponses | GeneralResponses:
        """Return the frequency responses for structural parameters (n, p) and damping parameters (n, q)."""
        return self._respond(self.block, self.of_block, self.points, theta, values)

    def on(self, block: ReducedBlock) -> FRFModel:
        """Return a copy of the model that uses another reduced block."""
        other = copy(self)
        other.block, other.of_block, other.points = block, self._damping_of(block), self._at_points(block)
        return other

    def with_damping(self, damping: Damping) -> FRFModel:
        """Return a copy of the model that has other damping and the same reduced block."""
        other = copy(self)
        other.damping, other.n_values = damping, damping.n_values
        return other.on(self.block)

    def _respond(
        self,
        block: ReducedBlock,
        of_block: ProportionalDamping | GeneralDamping,
        points: FloatArray,
        theta: FloatArray,
        values: FloatArray,
    ) -> ModalResponses | GeneralResponses:
        places = points, self.responses, self.drives
        if isinstance(of_block, ProportionalDamping):
            return ModalResponses(block, of_block, theta, values, *places)
        return GeneralResponses(block, of_block, theta, values, *places)

    def _at_points(self, block: ReducedBlock) -> FloatArray:
        return np.asarray(block.coordinates(self.rows))

    def _damping_of(self, block: ReducedBlock) -> ProportionalDamping | GeneralDamping:
        """Return the damping projected onto the basis of `block`."""
        given = self.damping
        if not given.couples_modes:
            return ProportionalDamping(
                given.n_values, given.alpha, given.beta, given.loss, given.ratios, self.n_rigid
            )
        own = dict(given.losses or {})
        losses = []
        for term in self.full.K_terms:
            named = (own[j] for j, power in enumerate(term.powers) if power and j in own)
            losses.append(next(named, given.loss))
        V, dofs = block.basis, self.full.dofs
        dashpots = [V.T @ (matrix[dofs][:, dofs] @ V) for matrix, _ in given.dashpots]
        r = V.shape[1]
        return GeneralDamping(
            given.n_values,
            tuple(losses),
            np.array(dashpots).reshape(-1, r, r),
            tuple(source for _, source in given.dashpots),
            given.alpha,
            given.beta,
        )


class _OfBlock:
    """A model's FRFs for another reduced block, at fixed damping parameters; see `training.Bound`."""

    def __init__(self, model: FRFModel, block: ReducedBlock, values: FloatArray) -> None:
        self._model, self._block, self._values = model, block, values
        self._damping, self.points = model._damping_of(block), model._at_points(block)

    def at(self, theta: FloatArray) -> ModalResponses | GeneralResponses:
        values = np.tile(self._values, (len(theta), 1))
        return self._model._respond(self._block, self._damping, self.points, theta, values)

    def least_unit(self, point: int, unit: FloatArray) -> FloatArray:
        """Return, for each line, the smallest error unit of all FRFs that involve a point, shape (n_lines,).

        `unit` has shape (n_frfs, n_lines).
        """
        here = (self._model.responses == point) | (self._model.drives == point)
        return np.min(unit[here], axis=0)
