"""Models paired with the measured modes: what each can do, and the structure behind a certified reduced model."""

from __future__ import annotations

import copy
import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Protocol, Self

import numpy as np

from fmu.engines.base import Engine
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.full_block import full_model
from fmu.fem.modes.modal import BlockModel, ModalSolution, frequency_gradient, frequency_hz, single_thread
from fmu.fem.modes.separable import SeparableModel, selection
from fmu.fem.modes.solver import LAPACK, sparse_solver
from fmu.fem.pairing.prediction import Candidates, CandidateView, ModalPrediction, SensorView, joined, with_rows
from fmu.fem.pairing.rules import (
    SOFTNESS,
    SPARE,
    IndexPairing,
    RankPairing,
    ShapePairing,
    SoftPairing,
    count_rigid,
    reference_modes,
)
from fmu.fem.programs.solves import Failure
from fmu.fem.reduced.confirming import confirmed_model
from fmu.fem.reduced.residuals import FrequencyBound
from fmu.fem.reduced.training import LOOSE, Trained, Training
from fmu.formats.shown import in_words
from fmu.progress.phases import solved
from fmu.types import BoolArray, FloatArray, IntArray

PAIRINGS = ("shape", "index")
SOFT = "soft"
# Numbers of an array in a batch of reduced solves: 128 MiB.
_MOST_NUMBERS = 2**24
# How often the box of training may become larger.
_WIDENED = 3


class FrequencyMap(Protocol):
    """What a model of the user's own has to be: a map from parameters to the frequencies of the measured modes.

    ``observed``, ``gives_shapes``, ``configuration``, ``solves_per_gradient`` and ``reasons`` are used as
    `ModalModel` describes them, where it has them.

    Attributes
    ----------
    n_parameters, n_modes : int
    """

    n_parameters: int
    n_modes: int

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), at theta (n, n_parameters); NaN where a solve failed."""
        ...

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters)."""
        ...


class ModalModel:
    """A model paired with the measured modes, and what it can do beside giving their frequencies.

    The defaults are those of a model that gives frequencies with exact gradients, and nothing else.

    Attributes
    ----------
    n_parameters, n_modes : int
    name : str
        Name used where a problem is described.
    structure : SeparableModel or None
        Its matrices, if it has them.
    black_box : BlackBoxModel or None
        The user's function that answers, if it is one.
    gives_shapes : bool
        Whether `observed` tells what the sensors see.
    is_soft : bool
        Whether all candidates answer to every measured mode, with weights (`fmu.fem.pairing.rules.SoftPairing`).
    is_uncertain : bool
        Whether `observed` gives the variances of the model's own errors, as of a surrogate; it then gives
        frequencies alone where there are no shapes.
    by_shape : bool
        Whether modes are paired by MAC, not by number.
    solves_per_gradient, solves_per_shape_gradient : int
        What `frequencies_and_gradient` and `observed` with derivatives cost at one theta, in solves: 1 where
        derivatives are exact.
    full_solves : int
        How often the full model had to answer where there is a reduced one.
    record : mapping of str to number or str
        Of a surrogate: its certificate and what it cost (`fmu.analysis.certificate.certify`).
    n_tests : int
        For how many tests it is solved at one theta.
    """

    n_parameters: int
    n_modes: int
    n_tests = 1
    name = "model"
    structure: SeparableModel | None = None
    black_box: BlackBoxModel | None = None
    gives_shapes = False
    is_soft = False
    is_uncertain = False
    by_shape = False
    solves_per_gradient = 1
    solves_per_shape_gradient = 1
    full_solves = 0
    record: Mapping[str, Any] = MappingProxyType({})

    @property
    def reduced_sizes(self) -> tuple[int, ...]:
        """Unknowns of each block of the reduced model; empty if there is none."""
        return ()

    @property
    def reasons(self) -> Sequence[Failure]:
        """The first points at which a user's function failed, and why."""
        return ()

    @property
    def functions(self) -> tuple[BlackBoxModel, ...]:
        """Return the users' functions that answer; none of a model of another kind."""
        return () if self.black_box is None else (self.black_box,)

    @contextmanager
    def spread_over(self, engine: Engine | None) -> Iterator[None]:
        """Within a with block, call users' functions in the workers of an engine, if there are any."""
        with ExitStack() as stack:
            for function in () if engine is None else self.functions:
                stack.enter_context(function.spread_over(engine))  # type: ignore[arg-type]
            yield

    def seconds_at(self, theta: FloatArray) -> float | None:
        """Return the seconds that a user's function takes at a theta (n_parameters,), None without one."""
        return None if self.black_box is None else self.black_box.seconds_at(theta)

    def reason_at(self, theta: FloatArray) -> str | None:
        """Return why a user's function gave no frequencies at theta (n_parameters,); None if not known."""
        return None

    def as_structure(self) -> PairedStructure | None:
        """Return the model with what only a structure given by its matrices can do, None if it is not one."""
        return None

    def structures(self) -> tuple[PairedStructure, ...]:
        """Return the structures given by their matrices that it consists of; none if it is of another kind."""
        structure = self.as_structure()
        return () if structure is None else (structure,)

    def matrices_of(self, k: int) -> tuple[SeparableModel, int] | None:
        """Return the matrices that parameter `k` of theta changes, and its number there; None without any."""
        return None if self.structure is None or k >= self.n_parameters else (self.structure, k)

    def failed_tests(self, theta: FloatArray) -> Iterator[tuple[str, ModalModel, FloatArray]]:
        """Yield the tests without frequencies at a theta (n_parameters,): name, model, and its own parameters.

        None of a model of one test. Of a user's function all are given: it knows where it has failed.
        """
        yield from ()

    def coarser(self, share: float) -> Self:
        """Return a cheaper and less accurate model, by a share of the reduced basis; itself if there is none."""
        return self

    def of_modes(self, theta: FloatArray, of: Callable[[Any, FloatArray], FloatArray]) -> FloatArray:
        """Return what `of` makes of each structure and its own parameters, for every measured mode.

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)
            Other parameters may follow those of the model.
        of : callable
            ``of(structure, parameters)`` returns an array (n, modes, …).

        Returns
        -------
        ndarray, shape (n, n_modes, …)
        """
        return of(self, theta[:, : self.n_parameters])

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes), at theta (n, n_parameters); NaN where a solve failed."""
        raise NotImplementedError

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters)."""
        raise NotImplementedError

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return frequencies and shapes at the sensors, at theta (n, n_parameters), with derivatives if wanted."""
        raise NotImplementedError

    def full_frequencies(self, theta: FloatArray) -> FloatArray:
        """Return `frequencies` by the full model, where a reduced one answers otherwise."""
        return self.frequencies(theta)

    def full_observed(self, theta: FloatArray) -> ModalPrediction:
        """Return `observed` by the full model, where a reduced one answers otherwise."""
        return self.observed(theta)

    def configuration(self) -> Any:
        """Return the data that identify the model, in plain Python types."""
        raise NotImplementedError


class GivenModel(ModalModel):
    """A user's own `FrequencyMap` as a `ModalModel`; anything that it does not define takes its default."""

    def __init__(self, given: Any) -> None:
        self.given = given
        self.n_parameters, self.n_modes = given.n_parameters, given.n_modes
        self.name = type(given).__name__
        self.gives_shapes = hasattr(given, "observed") and getattr(given, "gives_shapes", True)
        self.solves_per_gradient = int(getattr(given, "solves_per_gradient", 1))
        self.solves_per_shape_gradient = self.solves_per_gradient

    def __repr__(self) -> str:
        return repr(self.given)

    @property
    def reasons(self) -> Sequence[Failure]:
        """The failures that the user's model has recorded."""
        return getattr(self.given, "reasons", ())

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return the user's frequencies; ValueError if the method raises or returns something else."""
        return self._real("frequencies", self._call("frequencies", theta), (len(theta), self.n_modes))

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the user's frequencies and gradients; ValueError as `frequencies` raises."""
        method, shape = "frequencies_and_gradient", (len(theta), self.n_modes)
        given = self._call(method, theta)
        if not (isinstance(given, tuple) and len(given) == 2):
            raise ValueError(f"model: {self.name}.{method} must return two arrays (got {type(given).__name__})")
        return self._real(method, given[0], shape), self._real(method, given[1], (*shape, self.n_parameters))

    def _call(self, method: str, theta: FloatArray) -> Any:
        try:
            return getattr(self.given, method)(theta)
        except Exception as error:
            raise ValueError(
                f"model: {self.name}.{method} must return NaN where a solve fails, and not raise "
                f"(got {in_words(error)}, at {theta[:1].tolist()})"
            ) from error

    def _real(self, method: str, given: Any, shape: tuple[int, ...]) -> FloatArray:
        array = np.asarray(given)
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise ValueError(
                f"model: {self.name}.{method} must return real numbers of shape {shape} "
                f"(got {array.dtype} of shape {array.shape})"
            )
        return array.astype(float, copy=False)

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return the user's prediction at the sensors."""
        return self.given.observed(theta, gradient)

    def configuration(self) -> Any:
        """Return the user's description, else the name of the class."""
        describe = getattr(self.given, "configuration", None)
        return describe() if callable(describe) else f"{type(self.given).__module__}.{self.name}"


def as_modal_model(given: FrequencyMap) -> ModalModel:
    """Return a model that is already paired as a `ModalModel`; a user's own model is wrapped."""
    return given if isinstance(given, ModalModel) else GivenModel(given)


class PairedStructure(ModalModel):
    """The frequencies of a SeparableModel's modes that answer to the measured ones; `of` builds one.

    Parameters
    ----------
    model : SeparableModel
    full : BlockModel
        Its unreduced blocks.
    rule : IndexPairing or ShapePairing
    n_modes : int
        Number of measured modes.
    sensors : sparse, shape (n_sensors, n_dof)
        From `SeparableModel.observation`.
    at_sensors : bool
        Whether the rule compares shapes at the sensors.

    Attributes
    ----------
    reduced : BlockModel or None
        Set by `train`: it answers inside the trained box, the full model elsewhere.
    pairing : IndexPairing, ShapePairing or RankPairing
        The rule, or fixed ranks where training found it constant.
    confirmed : bool
        Whether training ended because fresh points of the box were within the tolerance.
    elsewhere : float or None
        The tolerance outside the part of the box that matters, if training kept that one there alone.
    full_solves : int
        How often the full model had to answer since `train`.
    why_full : str
        Why there is no reduced model although one was trained, a sentence; else empty.
    softness : float
        Temperature of the weights of a soft pairing, else 0.
    """

    gives_shapes = True

    def __init__(
        self,
        model: SeparableModel,
        full: BlockModel,
        rule: IndexPairing | ShapePairing,
        n_modes: int,
        sensors: Any,
        at_sensors: bool,
    ) -> None:
        self.structure: SeparableModel = model
        self.n_parameters, self.n_modes = model.n_parameters, n_modes
        self.full, self.rule = full, rule
        self.by_shape, self.is_soft, self.softness = rule.by_shape, rule.is_soft, rule.softness
        self.reduced: BlockModel | None = None
        self.confirmed = True
        self.elsewhere: float | None = None
        self.full_solves, self.why_full = 0, ""
        # of the box in which the reduced model answers, as rows, like one theta: it spares NumPy's broadcasting
        self._lower = self._upper = self._corner = np.empty((1, model.n_parameters))
        self.pairing: IndexPairing | ShapePairing | RankPairing = rule
        self._sensors, self._at_sensors = sensors, at_sensors
        self._solve_full = rule.bind(full)
        self._confirmed: Callable[[FloatArray], ModalSolution] | None = None
        self._see_full = self._see_reduced = SensorView(full, self._solve_full, sensors)
        if rule.by_shape:
            self._full_candidates = self._reduced_candidates = CandidateView(full, rule, at_sensors)

    @classmethod
    def of(
        cls,
        model: SeparableModel,
        *,
        pairing: str,
        numbers: tuple[int, ...],
        elastic_from_hz: float | None = None,
        sensors: tuple[tuple[Any, str], ...],
        reference: FloatArray,
        shapes: FloatArray | None = None,
        counterparts: tuple[int, ...] = (),
        softness: float = SOFTNESS,
    ) -> PairedStructure:
        """Return a model paired with a measurement; the reference modes are solved for.

        Parameters
        ----------
        model : SeparableModel
        pairing : {"shape", "index", "soft"}
            ``"shape"``: one-to-one assignment by MAC, with the measured shapes at the sensors or, where none were
            measured, at all translations with the modes of the model at `reference` that the sensors can see.
            ``"index"``: by `numbers` in the sorted spectrum. ``"soft"``: as ``"shape"``, and `seen_candidates`
            gives all modes that might have answered.
        numbers : tuple of int
            Number (from 1) of each measured mode.
        elastic_from_hz : float, optional
            The lowest measured frequency, where 1 is the number of the first elastic mode: modes at a vanishing
            share of it are the rigid-body modes of a free structure. If not given, the numbers count these too.
        sensors : tuple of (node, direction)
            What was measured; all translations if empty.
        reference : ndarray, shape (n_parameters,)
            The model before updating.
        shapes : ndarray, shape (n_sensors, n_modes), optional
            Measured shapes.
        counterparts : tuple of int, optional
            Where no shapes were measured: which of the modes at `reference` that the sensors can see, from 1, each
            measured one answers to; the lowest in ascending order if empty.
        softness : float
            Temperature of the weights of ``"soft"``: `fmu.fem.pairing.rules.SoftPairing`.

        Raises
        ------
        ValueError
            For an unknown pairing, a sensor off the model, or modes that the sensors cannot see.
        """
        if pairing not in (*PAIRINGS, SOFT):
            raise ValueError(f"pairing: must be one of {(*PAIRINGS, SOFT)} (got {pairing!r})")
        full, n_modes = full_model(model), len(numbers)
        if full.n_modes < n_modes:
            raise ValueError(
                f"mass: the {n_modes} measured modes need as many of finite frequency: the mass matrix gives "
                f"{full.n_modes}; give mass to more degrees of freedom"
            )
        seen = model.observation(sensors)
        rule: IndexPairing | ShapePairing
        if pairing == "index":
            with single_thread():
                n_rigid = 0
                if elastic_from_hz is not None:
                    n_rigid = count_rigid(full, reference, n_modes, elastic_from_hz)
            numbers = tuple(number + n_rigid for number in numbers)
            rule = IndexPairing(numbers, n_rigid)
            if max(numbers) > full.n_modes:
                raise ValueError(f"numbers: must lie in 1..{full.n_modes}, the modes of the model (got {numbers})")
            return cls(model, full, rule, n_modes, seen, shapes is not None)
        with single_thread():
            if shapes is not None:
                rule = ShapePairing(seen, shapes, SPARE + count_rigid(full, reference, n_modes))
            else:
                rows = selection(model.translations, model.n_dof)
                visible = seen if sensors else rows
                rule = reference_modes(full, reference, visible, rows, n_modes, counterparts)
        if pairing == SOFT:
            rule = SoftPairing(rule.rows, rule.shapes, rule.margin, softness)
        return cls(model, full, rule, n_modes, seen, shapes is not None)

    def __repr__(self) -> str:
        reduced = "not reduced" if self.reduced is None else f"reduced to {list(self.reduced_sizes)}"
        return f"PairedStructure({self.structure!r}, {type(self.pairing).__name__}, {reduced})"

    @property
    def reduced_sizes(self) -> tuple[int, ...]:
        """Unknowns of each block of the reduced model; empty if there is none."""
        blocks = () if self.reduced is None else self.reduced.blocks
        return tuple(block.size for block in blocks if block.is_reduced)

    def as_structure(self) -> PairedStructure:
        """Return the model itself."""
        return self

    def coarser(self, share: float) -> Self:
        """Return the model with the leading vectors of each basis only, which carry most of the modes.

        Parameters
        ----------
        share : float
            The share of the vectors. A basis of as many vectors as its block has unknowns keeps all of them.

        Returns
        -------
        PairedStructure
            This model itself, if nothing is left out.
        """

        def leading(block: Any, size: int) -> Any:
            few = max(block.n_trained, math.ceil(share * block.size))
            return block.truncated(few) if block.is_reduced and few < block.size < size else block

        if self.reduced is None:
            return self
        sizes = [block.size for block in self.full.blocks]
        blocks = tuple(leading(block, size) for block, size in zip(self.reduced.blocks, sizes, strict=True))
        if all(one is other for one, other in zip(blocks, self.reduced.blocks, strict=True)):
            return self
        other = copy.copy(self)
        other._answer_by(replace(self.reduced, blocks=blocks))
        return other

    def train(
        self,
        lower: FloatArray,
        upper: FloatArray,
        tolerance: float = 1e-6,
        inaccurate_points: Callable[[], tuple[FloatArray, float] | None] | None = None,
        engine: Engine | None = None,
        region: Callable[[], FloatArray] | None = None,
        wider_box: Callable[[], tuple[FloatArray, FloatArray] | None] | None = None,
    ) -> dict[str, FloatArray]:
        """Train the reduced model over a box; see `fmu.fem.reduced.training.Training.run`.

        Parameters
        ----------
        lower, upper : ndarray, shape (n_parameters,)
        tolerance : float
            Largest relative error of a frequency at any point of the box that was tried.
        inaccurate_points : callable, optional
            Returns points (n, n_parameters) at which the reduced model, as trained so far, is not good enough for
            a purpose of one's own, and by what factor errors of frequencies there should be smaller; None where
            it is good enough.
        engine : Engine, optional
            Solves the full model at several points at once.
        region : callable, optional
            Returns fresh points (n, n_parameters) of the part of the box that matters, by the reduced model as
            trained so far. Where a basis for the whole box would not pay, the tolerance is kept in that part, and
            elsewhere 1e-3.
        wider_box : callable, optional
            Returns the limits of a larger box, if a reduced model trained for this one shows that much of what
            matters lies outside; None if it does not.

        Returns
        -------
        dict of str to ndarray
            What `restore` needs to have the same reduced model again.
        """
        training = Training(self.full, self.rule, lower, upper, tolerance, engine=engine)
        with single_thread():
            whole = training.run()
            self._install(whole)
            for _ in range(_WIDENED if wider_box is not None else 0):
                wider = wider_box()  # type: ignore[misc]
                if wider is None:
                    break
                lower, upper = wider
                training = Training(self.full, self.rule, lower, upper, tolerance, engine=engine)
                whole = training.run()
                self._install(whole)
            if training.is_cut() and region is not None and tolerance < LOOSE:
                narrow = Training(self.full, self.rule, lower, upper, LOOSE, engine=engine)
                self._install(narrow.run())
                for trained in () if narrow.is_cut() else narrow.narrowed(tolerance, region):
                    self._install(trained)
                if narrow.is_cut() or not narrow.confirmed:
                    self._install(whole)
                else:
                    training = narrow
            for _ in range(20 if inaccurate_points is not None and not training.prefers_full() else 0):
                inaccurate = inaccurate_points()  # type: ignore[misc]
                if inaccurate is None or not training.is_accurate:
                    break
                self._install(training.refined(*inaccurate))
        if training.prefers_full():
            return self._answer_by_full(sum(of.size for of in training.reduced.values()))
        return training.state()

    def train_at(self, theta: FloatArray, lower: FloatArray, upper: FloatArray) -> dict[str, FloatArray]:
        """Have a reduced model answer in a box that was trained at points theta (n, n_parameters) of it alone.

        Its errors elsewhere are for the caller to examine. Returns what `restore` needs.
        """
        training = Training(self.full, self.rule, lower, upper, LOOSE)
        with single_thread():
            self._install(training.at(theta))
        return training.state()

    def restore(self, state: dict[str, FloatArray]) -> None:
        """Install a reduced model that `train` returned earlier, for the same structure and pairing."""
        if "full" in state:
            self._answer_by_full(int(state["full"]))
            return
        with single_thread():
            self._install(Training.restored(self.full, self.rule, state))

    def modes(self, theta: FloatArray, gradient: bool = False) -> ModalSolution:
        """Return the paired modes at theta (n, n_parameters), with the gradients of the eigenvalues if wanted."""
        return self._answered(self._reduced_modes, self._solve_full, theta, gradient)

    def within(self, theta: FloatArray) -> BoolArray:
        """Say, shape (n,), where the reduced model answers; nowhere if there is none."""
        if self.reduced is None:
            return np.zeros(len(theta), dtype=bool)
        return np.asarray(np.all((theta >= self._lower) & (theta <= self._upper), axis=1))

    @contextmanager
    def extrapolating(self, lower: FloatArray, upper: FloatArray) -> Iterator[None]:
        """Have the reduced model answer in a larger box for as long as a block lasts: for a first look there."""
        trained = self._lower, self._upper
        self._lower, self._upper = np.minimum(lower, trained[0]), np.maximum(upper, trained[1])
        try:
            yield
        finally:
            self._lower, self._upper = trained

    def candidates(self, theta: FloatArray) -> tuple[FloatArray, IntArray, IntArray]:
        """Return all modes that might have answered to a measured one, and one more a block.

        Returns
        -------
        eigenvalues : ndarray, shape (n, n_candidates)
            NaN where a solve failed, and for modes that the reduced model was not trained for.
        block, rank : ndarray of int, shape (n_candidates,)
        """
        counts = {
            b: min(count + 1, self.full.blocks[b].n_modes) for b, count in self.rule.counts(self.full).items()
        }
        found = np.full((len(theta), sum(counts.values())), np.nan)
        within = self.within(theta)
        solved(len(theta))
        with single_thread():
            for model, rows in ((self.full, ~within), (self.reduced, within)):
                start = 0
                for b, count in counts.items():
                    if model is not None and rows.any():
                        n_trained = min(count, model.blocks[b].n_trained)
                        found[rows, start : start + n_trained] = model.blocks[b].eigenvalues(
                            theta[rows], n_trained
                        )
                    start += count
        ranks = np.concatenate([np.arange(count) for count in counts.values()])
        return found, np.repeat(list(counts), list(counts.values())), ranks

    def full_modes(self, theta: FloatArray) -> ModalSolution:
        """Return the modes of the full model, paired by the rule itself: what every certificate compares with."""
        return self._by_full(self._solve_full, theta)

    def confirmed_modes(self, theta: FloatArray) -> ModalSolution:
        """Return `full_modes` at theta (n, n_parameters), of large structures by what training has factorised.

        From `fmu.fem.reduced.confirming.LARGE` degrees of freedom on the reduced model's modes are where the
        iterations begin. They end when the frequencies have ten digits and the eigenvalues have been counted.
        """
        within = self.within(theta)
        if not within.any():
            return self.full_modes(theta)
        if self._confirmed is None:
            self._confirmed = self.rule.bind(confirmed_model(self._bound))
        found = self._by_full(self._confirmed, np.where(within[:, None], theta, self._corner))
        return found if within.all() else with_rows(found, ~within, self.full_modes(theta[~within]))

    def full_frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies by the full model."""
        return frequency_hz(self.full_modes(theta).eigenvalues)

    def frequency_bound(self, theta: FloatArray) -> FloatArray:
        """Return how far the reduced model's frequencies may be off, relative, shape (n, n_modes).

        By the residuals of its modes at theta (n, n_parameters), for the modes that it pairs: their number in
        the spectrum is not examined. Infinite where there is no bound. What is proven of it and what is
        estimated: `fmu.fem.reduced.residuals`. It costs a solve of linear equations a mode, not an eigenproblem;
        the matrix is factorised at the first call.

        Raises
        ------
        ValueError
            If there is no reduced model.
        """
        if self.reduced is None:
            raise ValueError("frequency_bound: there is no reduced model; train one first")
        with single_thread():
            inside = self.within(theta)
            bound = np.full((len(theta), self.n_modes), np.inf)
            if inside.any():
                bound[inside] = self._bound(theta[inside], self._solve_reduced(theta[inside]))
        return bound

    @property
    def solver(self) -> str:
        """Name of what factorises the largest matrices of the full model."""
        largest = max(block.size for block in self.full.blocks)
        return sparse_solver() if largest > DENSE_LIMIT else LAPACK

    def full_shapes(self, theta: FloatArray) -> FloatArray:
        """Return the paired modes' shapes by the full model, shape (n_dof, n_modes), at theta (n_parameters,).

        Mass-normalised; zero in the blocks that a mode does not move, NaN where a solve failed.
        """
        point = np.asarray(theta, dtype=float)[None]
        modes = self.full_modes(point)
        with single_thread():
            return self.full.shapes(point, modes, self.rule.counts(self.full))

    def observed(self, theta: FloatArray, gradient: bool = False) -> ModalPrediction:
        """Return frequencies and shapes at the sensors, at theta (n, n_parameters), with derivatives if wanted."""
        return self._answered(self._see_reduced, self._see_full, theta, gradient)

    def full_observed(self, theta: FloatArray) -> ModalPrediction:
        """Return frequencies and shapes at the sensors by the full model, paired by the rule itself."""
        return self._by_full(self._see_full, theta)

    def seen_candidates(self, theta: FloatArray, gradient: bool = False) -> Candidates:
        """Return all modes that might answer to a measured one, at theta (n, n_parameters).

        With derivatives if wanted; for a pairing by shape, soft or not.
        """
        return self._answered(self._reduced_candidates, self._full_candidates, theta, gradient)

    def full_seen_candidates(self, theta: FloatArray) -> Candidates:
        """Return all modes that might answer to a measured one by the full model."""
        return self._by_full(self._full_candidates, theta)

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes); NaN where a solve failed."""
        return frequency_hz(self.modes(theta).eigenvalues)

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters), exact."""
        modes = self.modes(theta, gradient=True)
        assert modes.gradient is not None  # narrowed for the type checker: asked for above
        frequencies = frequency_hz(modes.eigenvalues)
        return frequencies, frequency_gradient(frequencies, modes.gradient)

    def fingerprint(self) -> str:
        """Return a hash of everything that the frequencies depend on."""
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

    def configuration(self) -> dict[str, Any]:
        """Return the data that identify the model, in plain Python types."""
        n_rigid = 0 if self.rule.by_shape else self.rule.n_rigid
        return {
            "structure": repr(self.structure),
            "pairing": type(self.rule).__name__,
            "sha256": self.fingerprint(),
        } | ({"n_rigid": n_rigid} if n_rigid else {})

    def _install(self, trained: Trained) -> None:
        self.pairing, self.confirmed = trained.pairing, trained.confirmed
        self.elsewhere, self._confirmed = trained.elsewhere, None
        self._lower, self._upper = trained.lower[None], trained.upper[None]
        self._corner = self._lower
        self._bound = FrequencyBound(self.full, trained.model, trained.lower, trained.upper, trained.anchors)
        self._answer_by(trained.model)

    def _answer_by_full(self, size: int) -> dict[str, FloatArray]:
        """Have the full model answer: a reduced one of `size` vectors was not accurate and would save little."""
        self.reduced, self.pairing, self.confirmed, self.elsewhere = None, self.rule, True, None
        self._see_reduced = self._see_full
        if self.rule.by_shape:
            self._reduced_candidates = self._full_candidates
        self.full_solves = 0
        self.why_full = (
            f"The full model answers: a reduced one of {size} unknowns is not accurate within these bounds, and "
            "more unknowns would take as long as the full model."
        )
        return {"full": np.array(float(size))}

    def _answer_by(self, reduced: BlockModel) -> None:
        self.reduced, self.why_full = reduced, ""
        largest = max(self.reduced_sizes, default=1)
        self._at_once = max(1, _MOST_NUMBERS // (largest * max(largest, self.n_modes * self.n_parameters)))
        self._solve_reduced = self.pairing.bind(reduced)
        self._see_reduced = SensorView(reduced, self._solve_reduced, self._sensors)
        if self.rule.by_shape:
            self._reduced_candidates = CandidateView(reduced, self.rule, self._at_sensors)
        self.full_solves = 0

    def _reduced_modes(self, theta: FloatArray, gradient: bool) -> ModalSolution:
        """Return the reduced model's modes, a few theta at a time where their matrices would take much memory."""
        if len(theta) <= self._at_once:
            return self._solve_reduced(theta, gradient)
        starts = range(0, len(theta), self._at_once)
        return joined([self._solve_reduced(theta[i : i + self._at_once], gradient) for i in starts])

    def _by_full[Solution](self, solve: Callable[[FloatArray], Solution], theta: FloatArray) -> Solution:
        solved(len(theta))
        with single_thread():
            return solve(theta)

    def _answered[Solution: (ModalSolution, ModalPrediction, Candidates)](
        self,
        reduced: Callable[[FloatArray, bool], Solution],
        full: Callable[[FloatArray, bool], Solution],
        theta: FloatArray,
        gradient: bool,
    ) -> Solution:
        """Return the reduced model's solution, and the full one's outside the trained box and on failure."""
        solved(len(theta), with_gradients=gradient)
        with single_thread():
            if self.reduced is None:
                return full(theta, gradient)
            within = (theta >= self._lower) & (theta <= self._upper)
            everywhere = np.count_nonzero(within) == within.size  # a tenth of what `all` takes on a small array
            # far outside its box the reduced model may overflow: a corner stands in for such points
            inside = theta if everywhere else np.where(within.all(axis=1, keepdims=True), theta, self._corner)
            found = reduced(inside, gradient)
            failed = found.failed
            if everywhere and np.count_nonzero(failed) == 0:
                return found
            rows = failed.any(axis=1) | ~within.all(axis=1)
            self.full_solves += int(np.sum(rows))
            return with_rows(found, rows, full(theta[rows], gradient))


def elsewhere(structures: Sequence[PairedStructure]) -> float | None:
    """Return the largest tolerance of structures outside the part of the box that matters, None without one."""
    return max((of.elsewhere for of in structures if of.elsewhere is not None), default=None)
