"""Solves of a callable, in memory and optionally on disk: the result or failure at each theta, and its duration.

The callable is a Python function, a program run or an OpenSees model. `Solves` calls it once per theta. No other
class handles batches, retries or workers.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import KW_ONLY, dataclass
from typing import NamedTuple

import numpy as np

from fmu.engines.base import MAX_DEATHS, Engine, LostTaskError
from fmu.engines.program import is_killed, wait_for_a_stop
from fmu.fem.programs.answers import Answer, AnswerError, read_answers
from fmu.fem.programs.store import Solve, SolveStore
from fmu.formats.shown import in_words, one_line
from fmu.interruption import is_asked
from fmu.progress.phases import count_solves
from fmu.types import FloatArray

SLOW_S = 0.05
"""Solve time, in seconds, from which solves are stored and ``fmu run`` uses a surrogate."""
MOST_REASONS = 20
MOST_BYTES = 2**28
# The length of the longest reason that is kept in memory, and the memory of a solve without its arrays, in bytes.
_LONGEST, _OVERHEAD = 500, 500
_NOTHING = Answer(np.zeros(0))


class Failure(NamedTuple):
    """A theta, shape (ndim,), at which the function failed, and the reason."""

    theta: FloatArray
    reason: str


@dataclass(eq=False, repr=False)
class Solves:
    """Solves of one callable: each is taken from memory, read from a store, or made by calling the callable.

    A pickled copy, such as one in another process, has no solves in memory.

    Parameters
    ----------
    call : callable
        ``call(theta)`` returns a result as described in `fmu.fem.black_box`, or raises an exception.
    n_parameters : int
    batched : bool
        Whether `call` takes theta of shape (n_points, n_parameters).
    store : SolveStore, optional
        Store for solves that took `least_s` or longer per point. It is no longer used once a successful solve
        takes less time. If two processes need the same points, only one of them calls the callable. Batches that
        share only some points may solve these twice, because one lock per point would need too many open files.
    least_s : float
        Shortest time per point, in seconds, for which a solve is stored.
    retries : int
        Largest number of times that a failed call is repeated.
    loading_s : float
        If the first call takes less time than this, in seconds, it may consist mostly of imports. A second call is
        then timed.
    lasting : type
        Class of the exceptions that would occur again in a repeated call, besides AnswerError. A failure is stored
        only if its exception is of this class or an AnswerError, and does not say that a program was killed from
        outside (`fmu.engines.program.is_killed`).
    is_outdated : callable, optional
        ``is_outdated(solve)`` returns True if a stored solve must be made again.
    most_bytes : int
        Memory limit for the solves; beyond it the oldest solves are removed.

    Attributes
    ----------
    reasons : list of Failure
        The first twenty failures.
    """

    call: Callable[[FloatArray], object]
    n_parameters: int
    _: KW_ONLY
    batched: bool = False
    store: SolveStore | None = None
    least_s: float = SLOW_S
    retries: int = 0
    loading_s: float = 1.0
    lasting: type[Exception] = Exception
    is_outdated: Callable[[Solve], bool] | None = None
    most_bytes: int = MOST_BYTES

    def __post_init__(self) -> None:
        self.reasons: list[Failure] = []
        self._known: dict[bytes, Solve] = {}
        self._bytes = 0
        self._first: bytes | None = None
        self._engine: Engine | None = None
        self._keeps = self.store is not None  # until the callable turns out to be faster than a store

    def __getstate__(self) -> dict[str, object]:
        return self.__dict__ | {"reasons": [], "_known": {}, "_bytes": 0, "_first": None, "_engine": None}

    def of(self, theta: FloatArray) -> list[Solve]:
        """Return the solves at points theta (n, n_parameters), in the same order; equal points share a solve.

        Failures are added to `reasons`.
        """
        keys = [point.tobytes() for point in theta]
        found = {key: self._known[key] for key in keys if key in self._known}
        missing = {key: i for i, key in enumerate(keys) if key not in found}
        if missing:
            for key, solve in zip(missing, self._make_all(theta[list(missing.values())]), strict=True):
                found[key] = self._remember(solve)
                if solve.reason:
                    self.note(solve.theta, solve.reason)
        return [found[key] for key in keys]

    def recall(self, theta: FloatArray) -> Solve | None:
        """Return the solve at theta (n_parameters,) if it is in memory, otherwise None. Nothing is called."""
        return self._known.get(theta.tobytes())

    def at_start(self, theta: FloatArray) -> Solve:
        """Return the solve at a problem's starting point theta (n_parameters,), and check earlier solves.

        With a store, the callable is called there once per process, even if a solve is stored. The stored solve is
        returned, so that a resumed run gives the same draws. A stored failure is removed. Without a store, the
        callable is called there for every problem. If its result has changed, all solves in memory are removed.

        Raises
        ------
        ValueError
            If the callable fails, or does not reproduce a stored solve (`fmu.fem.programs.store.MOST_SCATTER`).

        Warns
        -----
        StoreWarning
            If the callable reproduces a stored solve, but only to within the scatter of a solver.
        """
        known, store = self.recall(theta), self.store if self._keeps else None
        stored = None if store is None or known is not None else store.find(theta)
        if store is not None and stored is not None and stored.reason:
            stored = None
            with self._writing():
                store.forget_failure(theta)
        if known is not None and store is not None:
            solve = known
        elif known is None and stored is None:
            solve = self.make(theta)
        else:
            solve = self.repeat(theta)
        if known is not None and not _is_same(known, solve):
            self._known, self._bytes = {}, 0
        if solve.reason:
            self._remember(solve)
            raise ValueError(f"must work at the start {theta.tolist()} ({solve.reason})")
        if store is not None and stored is not None:
            store.check(stored, solve.frequencies, solve.shapes)
            solve = stored._replace(seconds=solve.seconds)
        return self._remember(solve)

    def seconds_at(self, theta: FloatArray) -> float:
        """Return the duration in seconds of a call at theta (n_parameters,), even if the call fails.

        If the first call was made there and took less than `loading_s`, a second call is timed.
        """
        solve = self.recall(theta) or self.of(theta[None])[0]
        if theta.tobytes() == self._first and solve.seconds < self.loading_s:
            self._first = b""
            solve = self._remember(solve._replace(seconds=self.repeat(theta).seconds))
        return solve.seconds

    def note(self, theta: FloatArray, reason: str) -> None:
        """Append a failure to `reasons`, unless the list is full or already contains it."""
        failure = Failure(theta.copy(), _shorten(reason))
        is_new = all(reason != failure.reason or not np.array_equal(at, theta) for at, reason in self.reasons)
        if len(self.reasons) < MOST_REASONS and is_new:
            self.reasons.append(failure)

    @contextmanager
    def spread_over(self, engine: Engine) -> Iterator[None]:
        """Within a ``with`` block, solve at several theta in parallel in an engine's workers.

        The solves and their order are the same as without an engine. A theta that crashes its process three times
        counts as failed. A batched callable receives all theta in one call in the calling process.
        """
        before, self._engine = self._engine, engine
        try:
            yield
        finally:
            self._engine = before

    def make(self, theta: FloatArray) -> Solve:
        """Return the solve at theta (n_parameters,), from the store or from a call. It is not stored in memory."""
        return self._look_up_or_call(theta[None])[0]

    def repeat(self, theta: FloatArray) -> Solve:
        """Call the callable again at theta (n_parameters,), and return the solve without storing it anywhere."""
        with self._lock(theta[None]):
            return self._call_at(theta[None], keep=False)[0]

    def _make_all(self, theta: FloatArray) -> Iterator[Solve]:
        """Yield the solves at points (n, n_parameters), made in one batch, by an engine, or one by one.

        If a batch fails, its points are solved one by one.
        """
        if self.batched and len(theta) > 1:
            together = self._look_up_or_call(theta)
            if together:
                count_solves(len(theta))
                yield from together
                return  # otherwise calls with one point at a time show which point is at fault
        engine = None if self.batched or len(theta) < 2 else self._engine
        for one in map(self.make, theta) if engine is None else self._spread(theta, engine):
            count_solves()
            yield one

    def _spread(self, theta: FloatArray, engine: Engine) -> list[Solve]:
        """Return the solves at points (n, n_parameters), made by workers.

        A point that crashes its worker three times counts as failed.
        """
        found: dict[int, Solve] = {}
        while len(found) < len(theta):
            missing = [i for i in range(len(theta)) if i not in found]

            def keep(i: int, solve: Solve, missing: Sequence[int] = missing) -> None:
                self._stop_if_asked(solve.reason, theta)
                found[missing[i]] = solve

            try:
                engine.run_tasks(_make_there, self, [theta[i] for i in missing], keep)
            except LostTaskError as lost:
                i = missing[lost.sequence]
                why = f"the process that called it died {MAX_DEATHS} times ({lost.how})"
                found[i] = Solve(theta[i], _NOTHING.frequencies, None, 0.0, why)
        return [found[i] for i in range(len(theta))]

    def _look_up_or_call(self, theta: FloatArray) -> list[Solve]:
        """Return the solves at points (n, n_parameters). All points that are not stored are solved in one call.

        The list is empty if that call fails for several points.
        """
        if not self._keeps:
            return self._call_at(theta)
        found = self._look_up(theta)
        if len(found) < len(theta):
            with self._lock(np.delete(theta, list(found), axis=0)):
                found = self._look_up(theta)  # another process may have solved them meanwhile
                missing = [i for i in range(len(theta)) if i not in found]
                called = self._call_at(theta[missing]) if missing else []
                if len(called) < len(missing):
                    return []
                found |= zip(missing, called, strict=True)
        return [found[i] for i in range(len(theta))]

    def _look_up(self, theta: FloatArray) -> dict[int, Solve]:
        """Return the stored solves at points (n, n_parameters) that are not outdated, keyed by point index."""
        if self.store is None or not self._keeps:
            return {}
        found = {i: solve for i, point in enumerate(theta) if (solve := self.store.find(point)) is not None}
        if self.is_outdated is None:
            return found
        return {i: solve for i, solve in found.items() if not self.is_outdated(solve)}

    @contextmanager
    def _lock(self, theta: FloatArray) -> Iterator[None]:
        """Within a ``with`` block, prevent other processes from solving the same points (n, n_parameters).

        Without a store, nothing is locked. If the lock cannot be created, a warning is issued and the store is no
        longer used.
        """
        with ExitStack() as stack:
            if self.store is not None and self._keeps:
                try:
                    stack.enter_context(self.store.only_one(theta))
                except OSError as error:
                    self._give_up(error)
            yield

    def _call_at(self, theta: FloatArray, keep: bool = True) -> list[Solve]:
        """Call the callable at points (n, n_parameters), and return the solves.

        If `keep`, solves that took `least_s` or longer are written to the store, except failures that may not
        occur again. The store is no longer used once a successful solve is faster. n is 1 unless the callable is
        batched. The list is empty if the call fails for several points, because the point at fault is then
        unknown.

        Raise KeyboardInterrupt if the call fails after a stop was requested, because the signal has also ended the
        programs that the callable runs.
        """
        if self._first is None:
            self._first = theta[0].tobytes()
        for _ in range(self.retries + 1):
            began, reason, is_lasting = time.perf_counter(), "", True
            answers = [_NOTHING] * len(theta)
            try:
                argument = theta.copy() if self.batched else theta[0].copy()
                answers = read_answers(
                    self.call(argument), self.n_parameters, len(theta) if self.batched else None
                )
            except KeyboardInterrupt:
                raise
            except AnswerError as error:
                reason = one_line(str(error))
            except BaseException as error:  # such as GeneratorExit and the user's own exceptions
                reason, is_lasting = in_words(error), isinstance(error, self.lasting)
                if is_killed(error):
                    is_lasting = False
                    wait_for_a_stop()
            seconds = (time.perf_counter() - began) / len(theta)
            self._stop_if_asked(reason, theta)
            if not reason:
                break
        if reason and len(theta) > 1:
            return []
        found = [
            Solve(point.copy(), answer.frequencies, answer.shapes, seconds, reason, answer.gradient)
            for point, answer in zip(theta, answers, strict=True)
        ]
        if keep and self._keeps:
            if seconds < self.least_s:
                self._keeps = bool(reason)  # a store would be slower than the callable
            elif is_lasting:
                self._write(found)
        return found

    def _stop_if_asked(self, reason: str, theta: FloatArray) -> None:
        """Raise KeyboardInterrupt if a call failed (`reason`) after a stop was requested.

        Stored failures at points theta (n, n_parameters) are then removed. A worker may have stored them, because
        it does not know of the stop.
        """
        if reason and is_asked():
            if self.store is not None and self._keeps:
                with self._writing():
                    for point in theta:
                        self.store.forget_failure(point)
            raise KeyboardInterrupt

    def _write(self, solves: Sequence[Solve]) -> None:
        assert self.store is not None  # narrowed for the type checker
        with self._writing():
            for solve in solves:
                self.store.keep(solve)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Keep no further solves on disk, and warn, if the store cannot be written."""
        try:
            yield
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        self._keeps = False
        where = None if self.store is None else self.store.folder.parent
        warnings.warn(f"store: solves cannot be kept in {where} ({error})", stacklevel=2)

    def _remember(self, solve: Solve) -> Solve:
        """Store a solve in memory in place of any earlier one at its theta, and return it.

        A long reason is shortened. The oldest solves are removed to make room.
        """
        if len(solve.reason) > _LONGEST:
            solve = solve._replace(reason=_shorten(solve.reason))
        key = solve.theta.tobytes()
        self._forget(key)
        self._bytes += _size(solve)
        self._known[key] = solve
        while self._bytes > self.most_bytes and len(self._known) > 1:
            self._forget(next(iter(self._known)))
        return solve

    def _forget(self, key: bytes) -> None:
        if key in self._known:
            self._bytes -= _size(self._known.pop(key))


def _make_there(solves: Solves, theta: FloatArray, _: object) -> Solve:
    return solves.make(theta)


def _size(solve: Solve) -> int:
    size = _OVERHEAD + len(solve.reason) + solve.theta.nbytes + solve.frequencies.nbytes
    return size + sum(array.nbytes for array in (solve.shapes, solve.gradient) if array is not None)


def _is_same(one: Solve, other: Solve) -> bool:
    """Return True if two solves have bitwise equal frequencies, shapes and gradients."""
    pairs = ((one.frequencies, other.frequencies), (one.shapes, other.shapes), (one.gradient, other.gradient))
    return all((a is b is None) or np.array_equal(a, b, equal_nan=True) for a, b in pairs)  # type: ignore[arg-type]


def _shorten(reason: str) -> str:
    return reason if len(reason) <= _LONGEST else f"{reason[:_LONGEST]} …"
