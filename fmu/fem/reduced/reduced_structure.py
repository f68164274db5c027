"""Structures whose modes are computed in a reduced basis within a parameter box, with bounds on their errors."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np

from fmu.box import find_inside
from fmu.engines.blas import single_thread
from fmu.fem.approximation import Approximation
from fmu.fem.modes.modal import ModalSolution, frequency_hz
from fmu.fem.modes.solver import LAPACK
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.paired_structure import PairedStructure, candidate_numbers, frequencies_of
from fmu.fem.pairing.prediction import Candidates, ModalPrediction, join_batches, with_rows
from fmu.fem.pairing.sensitivities import JoinedSensitivities, Sensitivities, Steps
from fmu.fem.reduced.confirming import confirm_blocks
from fmu.fem.reduced.points import Trained
from fmu.fem.reduced.training import LOOSE, Training
from fmu.progress.phases import count_solves
from fmu.types import BoolArray, Dof, FloatArray, IntArray

# Largest number of elements of an array in a batch of reduced solves: 128 MiB.
_MOST_NUMBERS = 2**24
# How often the training box may be enlarged, and how often points may be added where the model is inaccurate.
_WIDENED, _REFINED = 3, 20


class ReducedStructure(Approximation):
    """A structure solved in a reduced basis inside a box.

    Outside the box, and where a reduced solve fails, the full matrices are used.

    Parameters
    ----------
    truth : PairedStructure
        The structure with its full matrices.
    trained : Trained
        The result of training.

    Attributes
    ----------
    cheap : PairedStructure
        The same structure and measured modes, solved with the reduced blocks.
    confirmed : bool
        Whether training succeeded; see `Trained`.
    elsewhere : float or None
        The larger tolerance outside the part of the box where the posterior has noticeable mass, or None if one
        tolerance applies everywhere.
    """

    cheap: PairedStructure
    _truth: PairedStructure

    def __init__(self, truth: PairedStructure, trained: Trained) -> None:
        super().__init__(truth, truth.solved_by(trained.blocks, trained.pairing))
        self.rule, self.pairing = truth.rule, self.cheap.pairing
        self.confirmed, self.elsewhere = trained.confirmed, trained.elsewhere
        # the bounds have shape (1, n_parameters), like one theta, which saves broadcasting in NumPy
        self.lower, self.upper = trained.lower[None], trained.upper[None]
        self._corner = self.lower
        self._bound = trained.bound(truth.full_blocks)
        self._answer_by(self.cheap)

    def _answer_by(self, cheap: PairedStructure) -> None:
        self.cheap, self.full_solves = cheap, 0
        self.sizes = tuple(block.size for block in cheap.blocks if block.is_reduced)
        largest = max(self.sizes, default=1)
        self._at_once = max(1, _MOST_NUMBERS // (largest * max(largest, self.n_modes * self.n_parameters)))

    def __repr__(self) -> str:
        sizes = " + ".join(map(str, self.sizes))
        return f"ReducedStructure({self.structure!r}, {type(self.pairing).__name__}, {sizes} vectors)"

    @property
    def truth(self) -> PairedStructure:
        """The structure solved with its full matrices."""
        return self._truth

    def coarser(self, share: float) -> Self:
        """Return a model with only the leading vectors of each basis. These represent most of each mode.

        Parameters
        ----------
        share : float
            Fraction of the basis vectors to use; see `fmu.fem.reduced.basis.ReducedBlock.coarser`.

        Returns
        -------
        ReducedStructure
            The coarser model, or this model itself if no vector is removed.
        """
        blocks = tuple(block.coarser(share) for block in self.cheap.blocks)
        if all(one is other for one, other in zip(blocks, self.cheap.blocks, strict=True)):
            return self
        other = copy(self)
        other._answer_by(self._truth.solved_by(blocks, self.pairing))
        return other

    def extend(self, lower: FloatArray, upper: FloatArray) -> Self:
        """Return a rough model: a copy that uses the reduced basis in a larger box than it was trained for."""
        other = copy(self)
        other.lower, other.upper = np.minimum(lower, self.lower), np.maximum(upper, self.upper)
        return other

    def seen_by(self, sensors: tuple[Dof, ...]) -> Self:
        """Return a copy for which `observed` gives shapes at other sensors."""
        other = copy(self)
        other._truth = self._truth.seen_by(sensors)
        other._answer_by(self.cheap.seen_by(sensors))
        return other

    def with_tolerance_elsewhere(self, elsewhere: float) -> Self:
        """Return a copy with another tolerance where the posterior has no noticeable mass."""
        other = copy(self)
        other.elsewhere = elsewhere
        return other

    def within(self, theta: FloatArray) -> BoolArray:
        """Return a mask (n,) that is True where theta (n, n_parameters) lies in the reduced model's box."""
        return find_inside(theta, self.lower, self.upper)[0]

    def modes(self, theta: FloatArray, gradient: bool = False) -> ModalSolution:
        """Return the paired modes at theta (n, n_parameters), with eigenvalue gradients if `gradient`."""
        return self._answer(self._solve, self._truth.solve, theta, gradient)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the predicted frequencies and sensor shapes at theta (n, n_parameters).

        Derivatives are included if `gradient`.
        """
        return self._answer(self.cheap.see, self._truth.see, theta, gradient)

    def seen_candidates(self, theta: FloatArray, gradient: bool = False) -> Candidates:
        """Return all candidates for pairing with the measured modes at theta (n, n_parameters).

        Derivatives are included if `gradient`. Requires a pairing by shape, which may be soft.
        """
        return self._answer(self.cheap.choose, self._truth.choose, theta, gradient)

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, (n, n_modes), with NaN where a solve failed or λ is clearly negative."""
        return frequency_hz(self.modes(theta).eigenvalues)

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies in Hz, shape (n, n_modes), and exact gradients, shape (n, n_modes, n_parameters)."""
        return frequencies_of(self.modes(theta, gradient=True))

    def sensitivities(self, theta: FloatArray, steps: Steps, shapes: bool = False) -> Sensitivities:
        """Return the frequencies with exact first and second derivatives; see `ModalModel`."""
        count_solves(len(theta), with_gradients=True)
        with single_thread():
            within = self.within(theta)
            inside = np.where(within[:, None], theta, self._corner)
            rows = [slice(i, i + self._at_once) for i in range(0, max(1, len(theta)), self._at_once)]
            parts = [self.cheap.solve_sensitivities(inside[some], shapes) for some in rows]
            failed = np.concatenate([np.isnan(part.frequencies).any(axis=1) for part in parts]) | ~within
            if len(parts) == 1 and not failed.any():
                return parts[0]
            self.full_solves += int(np.sum(failed))
            full = self._truth.solve_sensitivities(theta[failed], shapes)
            return JoinedSensitivities(len(theta), [*zip(rows, parts, strict=True), (failed, full)])

    def candidates(self, theta: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
        """Return the eigenvalues of all modes that may be paired; see `PairedStructure.candidates`.

        Outside the box they come from the full matrices. Inside it, modes for which the basis was not trained are
        NaN.
        """
        count_solves(len(theta))
        counts, within = self._truth.candidate_counts(), self.within(theta)
        found = np.empty((len(theta), sum(counts.values())))
        self.full_solves += int(np.sum(~within))
        with single_thread():
            for model, rows in ((self._truth, ~within), (self.cheap, within)):
                found[rows] = model.spectra(theta[rows], counts)
        return found, *candidate_numbers(counts)

    def confirmed_modes(self, theta: FloatArray) -> ModalSolution:
        """Return the full model's modes at theta (n, n_parameters), reusing factors for large blocks.

        For blocks with at least `fmu.fem.modes.solver.LARGE` degrees of freedom, iterations start from the reduced
        model's modes. They end when the estimated relative frequency errors are below 1e-8. The number of
        eigenvalues is verified at the first point.
        """
        within = self.within(theta)
        if not within.any():
            return self._truth.modes(theta)
        found = self._confirmed.modes(np.where(within[:, None], theta, self._corner))
        return found if within.all() else with_rows(found, ~within, self._truth.modes(theta[~within]))

    def shapes(self, theta: FloatArray) -> FloatArray:
        """Return the full model's paired mode shapes, (n_dof, n_modes), at theta (n_parameters,).

        See `PairedStructure.shapes`, and `confirmed_modes` for large blocks.
        """
        return (self._confirmed if self.within(theta[None]).all() else self._truth).shapes(theta)

    @cached_property
    def _confirmed(self) -> PairedStructure:
        return self._truth.solved_by(confirm_blocks(self._bound), self.rule)

    def frequency_bound(self, theta: FloatArray) -> FloatArray:
        """Return bounds on the relative errors of the reduced model's frequencies, shape (n, n_modes).

        The bounds follow from the residuals of the paired modes at theta (n, n_parameters). They do not verify the
        ranks of these modes in the spectrum. A bound is infinite outside the box, or if none is known.
        `fmu.fem.reduced.residuals` explains which parts of the bound are proven and which are estimated. The cost
        is at most one linear solve per mode. The first call also factorises the matrix and computes modes of the
        full model at the anchor points, unless these are left from training.
        """
        with single_thread():
            inside = self.within(theta)
            bound = np.full((len(theta), self.n_modes), np.inf)
            if inside.any():
                bound[inside] = self._bound(theta[inside], self.cheap.solve(theta[inside]))
        return bound

    def configuration(self) -> dict[str, object]:
        """Return the data that identify the structure and its pairing, and hence determine the basis."""
        return self._truth.configuration()

    def _solve(self, theta: FloatArray, gradient: bool) -> ModalSolution:
        """Return the reduced model's modes. Only a few theta are solved at a time, to limit memory use."""
        if len(theta) <= self._at_once:
            return self.cheap.solve(theta, gradient)
        starts = range(0, len(theta), self._at_once)
        return join_batches([self.cheap.solve(theta[i : i + self._at_once], gradient) for i in starts])

    def _answer[Solution: (ModalSolution, ModalPrediction, Candidates)](
        self,
        reduced: Callable[[FloatArray, bool], Solution],
        full: Callable[[FloatArray, bool], Solution],
        theta: FloatArray,
        gradient: bool,
    ) -> Solution:
        """Return the reduced model's solution.

        Outside the box and on failure, the full model's solution replaces it.
        """
        count_solves(len(theta), with_gradients=gradient)
        with single_thread():
            within = (theta >= self.lower) & (theta <= self.upper)
            everywhere = np.count_nonzero(within) == within.size  # a tenth of what `all` takes on a small array
            # far outside its box the reduced model may overflow: such points are replaced by a corner of the box
            inside = theta if everywhere else np.where(within.all(axis=1, keepdims=True), theta, self._corner)
            found = reduced(inside, gradient)
            failed = found.failed
            if everywhere and np.count_nonzero(failed) == 0:
                return found
            rows = failed.any(axis=1) | ~within.all(axis=1)
            self.full_solves += int(np.sum(rows))
            return with_rows(found, rows, full(theta[rows], gradient))


def reduced_in(model: ModalModel) -> ReducedStructure | None:
    """Return the model if it is a `ReducedStructure`, otherwise None."""
    return model if isinstance(model, ReducedStructure) else None


def reduced_structures(model: ModalModel) -> list[ReducedStructure]:
    """Return the reduced models among the parts of a model."""
    return [part for part in map(reduced_in, model.parts) if part is not None]


def largest_tolerance_elsewhere(model: ModalModel) -> float | None:
    """Return the largest tolerance of a model's reduced parts where the posterior has no noticeable mass.

    Return None if no part has such a tolerance (`ReducedStructure.elsewhere`).
    """
    return max((of.elsewhere for of in reduced_structures(model) if of.elsewhere is not None), default=None)


def train(
    truth: PairedStructure,
    lower: FloatArray,
    upper: FloatArray,
    tolerance: float = 1e-6,
    inaccurate_points: Callable[[ReducedStructure], tuple[FloatArray, float] | None] | None = None,
    region: Callable[[ReducedStructure], FloatArray] | None = None,
    wider_box: Callable[[ReducedStructure], tuple[FloatArray, FloatArray] | None] | None = None,
) -> tuple[ReducedStructure | PairedStructure, dict[str, FloatArray]]:
    """Train a reduced model over a parameter box; see `fmu.fem.reduced.training.Training.run`.

    Within ``truth.spread_over(engine)``, lengthy solves run in the engine's workers.

    Parameters
    ----------
    truth : PairedStructure
    lower, upper : ndarray, shape (n_parameters,)
    tolerance : float
        Largest relative frequency error allowed at the points tried in the box.
    inaccurate_points : callable, optional
        Maps the current reduced model to the points (n, n_parameters) where it is too inaccurate for the caller,
        and to the factor by which the frequency errors there must decrease. Returns None if the model is accurate
        enough.
    region : callable, optional
        Maps the current reduced model to fresh points (n, n_parameters) in the part of the box where the posterior
        has noticeable mass. It is used if the basis for the whole box reaches its largest useful size. A second
        training then applies `tolerance` in that part only, and 1e-3 elsewhere; its model is returned if it
        succeeds.
    wider_box : callable, optional
        Maps the reduced model to the bounds of a larger box. Returns None unless too much of the posterior's mass
        lies outside the present box.

    Returns
    -------
    model : ReducedStructure or PairedStructure
        The reduced model or, if this is inaccurate and would save little, the full model with the reason in
        `why_full`.
    state : dict of str to ndarray
        The arrays from which `restore` rebuilds the same model.

    Raises
    ------
    SingularAnchorError
        If the structure has no modes in the middle of the box, or a displacement has neither stiffness nor mass.
    """
    with single_thread():
        for left in range(_WIDENED, -1, -1):
            training = Training(truth.full_blocks, truth.rule, lower, upper, tolerance)
            model = ReducedStructure(truth, training.run())
            wider = None if wider_box is None or not left else wider_box(model)
            if wider is None:
                break
            lower, upper = wider
        if training.is_cut() and region is not None and tolerance < LOOSE:
            narrow = Training(truth.full_blocks, truth.rule, lower, upper, LOOSE)
            narrow.run()
            part = None if narrow.is_cut() else _narrow(truth, narrow, tolerance, region)
            if part is not None:
                training, model = narrow, part
        for _ in range(0 if training.prefers_full() else _REFINED):
            inaccurate = None if inaccurate_points is None else inaccurate_points(model)
            if inaccurate is None or not training.is_accurate:
                break
            model = ReducedStructure(truth, training.refine(*inaccurate))
    if training.prefers_full():
        size = sum(of.size for of in training.reduced.values())
        return truth.kept_full(size), {"full": np.array(float(size))}
    if truth.solver == LAPACK:  # small blocks' anchors are recomputed quickly, as for a cached model
        model = ReducedStructure(truth, replace(training.current(), anchors={}))
    return model, training.state()


def _narrow(
    truth: PairedStructure,
    training: Training,
    tolerance: float,
    region: Callable[[ReducedStructure], FloatArray],
) -> ReducedStructure | None:
    """Continue training in a region of the box; return the model, or None if training does not succeed there."""
    models: list[ReducedStructure] = []
    for trained in training.narrow(tolerance, lambda: region(models[-1])):
        models.append(ReducedStructure(truth, trained))
    return models[-1] if training.confirmed else None


def train_at(
    truth: PairedStructure, theta: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[ReducedStructure, dict[str, FloatArray]]:
    """Train a reduced model only at points theta (n, n_parameters) in a box, without checking it at other points.

    Return the model, and the state from which `restore` rebuilds it. Raise NoModesError if no solve succeeds, or
    SingularAnchorError as `train` does.
    """
    training = Training(truth.full_blocks, truth.rule, lower, upper, LOOSE)
    with single_thread():
        return ReducedStructure(truth, training.at(theta)), training.state()


def restore(truth: PairedStructure, state: dict[str, FloatArray]) -> ReducedStructure | PairedStructure:
    """Rebuild the model that `train` or `train_at` returned earlier for the same structure and pairing."""
    if "full" in state:
        return truth.kept_full(int(state["full"]))
    with single_thread():
        return ReducedStructure(truth, Training.restore(truth.full_blocks, truth.rule, state))
