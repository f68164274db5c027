"""Models given by a user's function: a surrogate, or a finite-element program called from Python.

The contract
------------
``function(theta)`` takes theta, an ndarray of shape (ndim,) in SI units, in the order of the parameters. It gives

- the natural frequencies in Hz, shape (n,), of any number of the model's modes; or
- ``{"frequencies": (n,), "shapes": (n_sensors, n), "gradient": (n, ndim)}``: only the first is required; or
- a tuple of these in that order, None for what is missing.

``shapes`` are mode shapes at the sensors of the measurement, in any scale: with them, and with measured ones, each
measured mode is paired with a computed one by MAC; otherwise by its number (from 1) in the order returned.
``gradient`` is ∂f/∂θ in Hz per SI unit; without it central differences are taken, which cost 2 ndim more calls.

For a batched function theta has the shape (n_points, ndim), and all results have a leading axis of n_points.

If the function raises, or returns numbers that are not finite, that point has failed and the run continues;
`BlackBoxModel.reasons` says why.
"""

from __future__ import annotations

import inspect
import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Interval
from numpy.typing import ArrayLike

from fmu.arguments import Count, check_arguments
from fmu.durable_files import digest
from fmu.engines.base import MAX_DEATHS, Engine, LostTaskError
from fmu.fem.programs.sources import source_digest
from fmu.fem.programs.store import Solve, SolveStore
from fmu.formats.shown import in_words, one_line, shown
from fmu.progress.phases import solved
from fmu.types import FloatArray

SLOW_S = 0.05
"""Seconds of a solve from which on answers are stored, and ``fmu run`` takes a surrogate."""
MOST_NUMBERS = 2**24
"""Largest array that the function may return."""
_PARTS = ("frequencies", "shapes", "gradient")
MOST_REASONS = 20
# Reasons kept for lookup by theta soon after a failure, and the longest message that is kept.
_MOST_LATEST = 10_000
_LONGEST = 500


def solves_of_a_surrogate(n_parameters: int) -> int:
    """Return how many solves a surrogate takes at most by default, and so the search of a slow function."""
    return 100 + 50 * n_parameters


class Answer(NamedTuple):
    """What the function returned at one theta: (m,) in Hz, and (n_sensors, m), (m, ndim) or None."""

    frequencies: FloatArray
    shapes: FloatArray | None = None
    gradient: FloatArray | None = None


class AnswerError(ValueError):
    """The function returned something of the wrong kind or shape."""


class Failure(NamedTuple):
    """A theta, shape (ndim,), at which the function failed, and why."""

    theta: FloatArray
    reason: str


@check_arguments
class BlackBoxModel:
    """A structure as a function from theta to its frequencies; `fmu.fem.black_box` has the contract.

    ``fmu.UpdatingProblem(fmu.BlackBoxModel(function, 2), data, parameters)`` pairs its modes with those measured.

    Parameters
    ----------
    function : callable
        theta (n_parameters,) -> frequencies in Hz; or with shapes and gradients too.
    n_parameters : int
    batched : bool
        Whether it takes theta (n_points, n_parameters), and returns arrays with a leading axis.
    step : float
        Step of the central differences, relative to the scale of each parameter (its range, where it has one).
    name : str, optional
        Name used where a problem is described.
    store : path-like, optional
        Folder of what was solved. Answers that took `SLOW_S` or longer are kept there, and none of them is
        computed twice, in this run or another; of a batched function, those whose call took so long per point.
        They are kept under a hash of the function's source file and of the user's own modules that it imports
        (`fmu.fem.programs.sources`). What else it depends on, such as data files, is not known: when a problem
        is built, the function is called at the start, and must give what is stored there (`at`).

    Attributes
    ----------
    solves : SolveStore or None
        What was solved, if there is a store.
    reasons : list of Failure
        The first twenty points at which the function failed.

    Raises
    ------
    ValueError
        If the function cannot be called, or a number is out of range.
    """

    place = "model.function"
    """The key of problem files that is named where the function fails."""
    loading_s = 1.0
    """A first call that takes less may have loaded modules for most of it."""
    sensors: tuple[tuple[Any, str], ...] = ()
    """Where its shapes are, if that can be chosen."""

    def __init__(
        self,
        function: Callable[[FloatArray], Any],
        n_parameters: Count,
        *,
        batched: bool = False,
        step: Annotated[float, Interval(gt=0.0, le=0.1)] = 1e-4,
        name: str | None = None,
        store: str | os.PathLike[str] | None = None,
    ) -> None:
        self.function = function
        self.n_parameters = int(n_parameters)
        self.batched = batched
        self.step = step
        self.name = name or _name_of(function)
        self._folder = None if store is None else Path(store).resolve()
        if self._folder is not None and not self.configuration().get("sha256"):
            raise ValueError(
                "store: the function must be in a file, so that a change of it is noticed (it is not)"
            )
        self.reasons: list[Failure] = []
        self._latest: dict[bytes, str] = {}
        self._engine: Engine | None = None
        self._is_fast = False
        self._took: dict[bytes, list[float]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the engine and the failures: a copy records its own."""
        return self.__dict__ | {"reasons": [], "_latest": {}, "_engine": None, "_took": {}}

    def __repr__(self) -> str:
        return f"BlackBoxModel({self.name}, {self.n_parameters} parameters)"

    def sees(self, sensor: tuple[Any, str]) -> bool:
        """Return True for every sensor (place, direction): only the function knows where its shapes are."""
        return True

    def at_sensors(self, sensors: Sequence[tuple[Any, str]]) -> BlackBoxModel:
        """Return the model with shapes at these sensors: itself, as the function has those of the measurement."""
        return self

    @property
    def solves(self) -> SolveStore | None:
        """What was solved, in this run and others; None if there is no store."""
        if self._folder is None:
            return None
        key = self.configuration() | {"step": None, "batched": None, "sensors": self.sensors}
        words = "".join(c if c.isalnum() else "-" for c in self.name)
        return SolveStore(self._folder / f"{words}-{digest(repr([*key.items()]).encode())[:12]}")

    def seconds_at(self, theta: FloatArray) -> float:
        """Return the seconds that a call at theta (n_parameters,) takes, even if it is stored or fails.

        They are measured once, by `at` if it has called the function there. After a first call of less than
        `loading_s` the second counts.
        """
        took = self._took.setdefault(theta.tobytes(), [])
        while not took or (len(took) == 1 and took[0] < self.loading_s):
            with suppress(Exception), self._timed(theta):
                self._again(theta)
        return took[-1]

    def answers(self, theta: FloatArray) -> list[Answer | None]:
        """Return the function's answers at theta (n, n_parameters), None where it fails; see `reasons`."""
        found: list[Answer | None] = []
        for point, (answer, reason) in zip(theta, self._tried(theta), strict=True):
            if answer is None:
                self.fail(point, reason)
            found.append(answer)
        return found

    @contextmanager
    def spread_over(self, engine: Engine) -> Iterator[BlackBoxModel]:
        """Within a with block, call the function at several theta in parallel, in the workers of an engine.

        Answers and failures are the same as in the calling process, in the same order. A theta that crashes its
        process three times has failed for that reason. A batched function gets all theta in one call and is not
        spread.

        Parameters
        ----------
        engine : Engine
            See `fmu.engine`. The function is sent to the workers: one of a module by its name, others by value.

        Examples
        --------
        ``with fmu.engine(workers=8) as engine, model.spread_over(engine): fmu.find_map(problem)``
        """
        before, self._engine = self._engine, engine
        try:
            yield self
        finally:
            self._engine = before

    def tried(self, theta: FloatArray) -> tuple[Answer | None, str]:
        """Return the function's answer at one theta (n_parameters,), or None and why it failed."""
        try:
            return self._answer(theta), ""
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # GeneratorExit and others of the user's own among them
            return None, _in_words(error)

    def at(self, theta: FloatArray) -> Answer:
        """Return the function's answer at one theta, shape (n_parameters,), where a problem starts.

        It is called there once in a process, even if its answer is stored, to see whether what is stored is still
        true. The stored answer is returned, so that a resumed run draws the same; a stored failure is forgotten.

        Raises
        ------
        ValueError
            If it fails there, or no longer gives what is stored (`fmu.fem.programs.store.MOST_SCATTER`).

        Warns
        -----
        StoreWarning
            If it gives what is stored, but not to all digits.
        """
        theta, store = np.asarray(theta, dtype=float), self.solves
        is_first = theta.tobytes() not in self._took
        stored = store.find(theta) if store is not None and is_first else None
        if store is not None and stored is not None and stored.reason:
            store.forget_failure(theta)
            stored = None
        try:
            with self._timed(theta) if is_first else nullcontext():
                answer = self._answer(theta) if stored is None else self._again(theta)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise ValueError(f"must work at the start {theta.tolist()} ({_in_words(error)})") from error
        if store is None or stored is None:
            return answer
        store.check(stored, answer.frequencies, answer.shapes)
        return _answer_of(stored)

    def fail(self, theta: FloatArray, reason: str) -> None:
        """Keep the reason why a theta failed: the first few permanently, others until many more have failed."""
        reason = reason if len(reason) <= _LONGEST else f"{reason[:_LONGEST]} …"
        if len(self.reasons) < MOST_REASONS:
            self.reasons.append(Failure(theta.copy(), reason))
        if len(self._latest) >= _MOST_LATEST:
            del self._latest[next(iter(self._latest))]
        self._latest[theta.tobytes()] = reason

    def reason_at(self, theta: FloatArray) -> str | None:
        """Return why a theta (n_parameters,) failed; None if it did not, or many later failures displaced it."""
        return self._latest.get(theta.tobytes())

    def configuration(self) -> dict[str, Any]:
        """Return the data that identify the model: the function's name, and a hash of its source."""
        return {"function": self.name, "batched": self.batched, "step": self.step, "sha256": self.sha256}

    @cached_property
    def sha256(self) -> str:
        """Hash of the user's source, see `source_digest`; a copy in another process has that of this one."""
        return source_digest(self.function)

    def _tried(self, theta: FloatArray) -> Iterator[tuple[Answer | None, str]]:
        """Yield `tried` at points (n, n_parameters): of one call, from the engine, or one after the other."""
        if self.batched and len(theta) > 1:
            try:
                together = self._found(theta)
            except KeyboardInterrupt:
                raise
            except BaseException:  # calls with one point at a time show which point is at fault
                together = []
            if together:
                solved(len(theta))
                yield from together
                return
        engine = None if self.batched or len(theta) < 2 else self._engine
        for one in map(self.tried, theta) if engine is None else _spread(self, theta, engine):
            solved()
            yield one

    def _answer(self, theta: FloatArray) -> Answer:
        """Return the answer at one theta (n_parameters,): from the store, or by calling the function."""
        [(answer, reason)] = self._found(theta[None])
        if answer is None:
            raise AnswerError(reason)
        return answer

    def _found(self, theta: FloatArray) -> list[tuple[Answer | None, str]]:
        """Return answers at points (n, n_parameters), or None and why it failed there when it was called before.

        The function is called for what is not stored; for one point, unless it is batched. The points of a call
        have one lock: of two processes that ask for the same ones, one calls. Batches that share only some points
        may solve these twice; a lock for each point would need as many open files.
        """
        store = None if self._folder is None or self._is_fast else self.solves  # a command has one of its own
        if store is None:
            return [(answer, "") for answer in self._called(theta)]
        found, missing = _looked_up(store, theta)
        if missing:
            with ExitStack() as stack:
                try:
                    stack.enter_context(store.only_one(theta[missing]))
                except OSError as error:
                    self._warn_of_store(error)
                    return [(answer, "") for answer in self._called(theta)]
                found, missing = _looked_up(store, theta)  # another process may have solved them meanwhile
                if missing:
                    found |= zip(missing, self._kept(store, theta[missing]), strict=True)
        solves = (found[i] for i in range(len(theta)))
        return [(None, solve.reason) if solve.reason else (_answer_of(solve), "") for solve in solves]

    def _kept(self, store: SolveStore, theta: FloatArray) -> list[Solve]:
        """Call the function at points (n, n_parameters); keep the answers, or why one fails, if that took long."""
        began, failure, nothing = time.perf_counter(), None, Answer(np.zeros(0))
        answers: Sequence[Answer] = [nothing] * len(theta)
        try:
            answers = self._called(theta)
        except Exception as error:
            failure = error
        seconds = time.perf_counter() - began
        reason = "" if failure is None else _in_words(failure)
        solves = [
            Solve(point, answer.frequencies, answer.shapes, seconds / len(theta), reason, answer.gradient)
            for point, answer in zip(theta, answers, strict=True)
        ]
        is_known = failure is None or len(theta) == 1  # which point is at fault
        if seconds / len(theta) >= SLOW_S and is_known:
            try:
                for solve in solves:
                    store.keep(solve)
            except OSError as error:
                self._warn_of_store(error)
        elif seconds < SLOW_S and failure is None:
            self._is_fast = True  # a store would slow it down
        if failure is not None:
            raise failure
        return solves

    def _warn_of_store(self, error: OSError) -> None:
        self._is_fast = True
        warnings.warn(f"store: solves cannot be kept in {self._folder} ({error})", stacklevel=2)

    def _again(self, theta: FloatArray) -> Answer:
        """Call the function at one theta (n_parameters,), whatever is stored."""
        return self._called(theta[None])[0]

    def _called(self, theta: FloatArray) -> Sequence[Answer]:
        """Return the answers at points (n, n_parameters), of which there is one unless the function is batched."""
        if self.batched:
            return checked(self.function(theta.copy()), self.n_parameters, len(theta))
        return checked(self.function(theta[0].copy()), self.n_parameters)

    @contextmanager
    def _timed(self, theta: FloatArray) -> Iterator[None]:
        """Keep the time of a call at a theta."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self._took.setdefault(theta.tobytes(), []).append(time.perf_counter() - began)


def _looked_up(store: SolveStore, theta: FloatArray) -> tuple[dict[int, Solve], list[int]]:
    """Return what is stored of points (n, n_parameters) by their number, and the numbers of those that are not."""
    found = {i: solve for i, point in enumerate(theta) if (solve := store.find(point)) is not None}
    return found, [i for i in range(len(theta)) if i not in found]


def _answer_of(solve: Solve) -> Answer:
    return Answer(solve.frequencies, solve.shapes, solve.gradient)


def _spread(model: BlackBoxModel, theta: FloatArray, engine: Engine) -> list[tuple[Answer | None, str]]:
    """Return `BlackBoxModel.tried` at points (n, n_parameters); a point that crashes its workers has failed."""
    found: dict[int, tuple[Answer | None, str]] = {}
    while len(found) < len(theta):
        missing = [i for i in range(len(theta)) if i not in found]

        def keep(i: int, result: tuple[Answer | None, str], missing: Sequence[int] = missing) -> None:
            found[missing[i]] = result

        try:
            engine.run_tasks(_try_there, model, [theta[i] for i in missing], keep)
        except LostTaskError as lost:
            found[missing[lost.sequence]] = (
                None,
                f"the process that called it died {MAX_DEATHS} times ({lost.how})",
            )
    return [found[i] for i in range(len(theta))]


def _try_there(model: BlackBoxModel, theta: FloatArray, _: object) -> tuple[Answer | None, str]:
    return model.tried(theta)


def _in_words(error: BaseException) -> str:
    """Return an exception in one line; for an `AnswerError` its text alone."""
    return one_line(str(error)) if isinstance(error, AnswerError) else in_words(error)


def _name_of(function: Any) -> str:
    return str(getattr(function, "__qualname__", type(function).__qualname__))


def checked(given: Any, n_parameters: int, n_points: int | None = None) -> list[Answer]:
    """Return the result of a function as a list of answers, one per point.

    Parameters
    ----------
    given : array_like, mapping or tuple
        See `fmu.fem.black_box`.
    n_parameters : int
    n_points : int, optional
        Points of a batched function. If not given, there is one point and no leading axis.

    Raises
    ------
    AnswerError
        If it has the wrong kind or shape.
    """
    if inspect.iscoroutine(given):
        given.close()  # otherwise Python warns that it was never awaited
        raise AnswerError("must return numbers (got a coroutine: the function must not be async)")
    lead = () if n_points is None else (n_points,)
    parts = _parts(given)
    frequencies = _real("frequencies", parts[0])
    if frequencies.ndim != len(lead) + 1 or frequencies.shape[:-1] != lead or frequencies.shape[-1] == 0:
        expected = ", ".join([*map(str, lead), "n"]) + ("" if lead else ",")
        raise AnswerError(f"frequencies: must have shape ({expected}) (got {frequencies.shape})")
    m = frequencies.shape[-1]
    shapes = None if parts[1] is None else _real("shapes", parts[1])
    if shapes is not None and (
        shapes.ndim != len(lead) + 2 or (*shapes.shape[:-2], shapes.shape[-1]) != (*lead, m)
    ):
        expected = ", ".join([*map(str, lead), "n_sensors", str(m)])
        raise AnswerError(f"shapes: must have shape ({expected}) (got {shapes.shape})")
    gradient = None if parts[2] is None else _real("gradient", parts[2])
    if gradient is not None and gradient.shape != (*lead, m, n_parameters):
        raise AnswerError(f"gradient: must have shape {(*lead, m, n_parameters)} (got {gradient.shape})")
    if n_points is None:
        return [Answer(frequencies, shapes, gradient)]
    none = [None] * n_points
    rows = (frequencies, none if shapes is None else shapes, none if gradient is None else gradient)
    return [Answer(*row) for row in zip(*rows, strict=True)]


def _parts(given: Any) -> list[Any]:
    """Return frequencies, shapes and gradient, None for what is missing."""
    if isinstance(given, Mapping):
        unknown = [key for key in given if key not in _PARTS]
        if unknown or "frequencies" not in given:
            raise AnswerError(
                f"must return frequencies, and may return shapes and gradient (got {shown(list(given))})"
            )
        return [given.get(part) for part in _PARTS]
    if isinstance(given, tuple) and any(np.ndim(part) > 0 for part in given):
        if len(given) > len(_PARTS):
            raise AnswerError(f"must return at most frequencies, shapes and gradient (got {len(given)} arrays)")
        return [*given, *[None] * (len(_PARTS) - len(given))]
    return [given, None, None]


def _real(name: str, given: ArrayLike) -> FloatArray:
    array = np.asarray(given)
    if array.dtype.kind not in "fiu":
        what = "nothing" if given is None else f"{type(given).__name__} of {array.dtype}"
        raise AnswerError(f"{name}: must be real numbers (got {what})")
    if array.size > MOST_NUMBERS:
        raise AnswerError(f"{name}: must be at most {MOST_NUMBERS} numbers (got {array.size})")
    return array.astype(float)
