"""What goes on in a worker, whatever started it: one task after the other, and messages on how far it has come."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple

import cloudpickle

from fmu.engines.engine import Work
from fmu.progress import Report

_TICK_S = 0.1
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


class Order(NamedTuple):
    """A task, what to do with it, and whether anybody wants to know how far it has come."""

    work: Work
    task: Any
    reports: bool


class Outcome(NamedTuple):
    """The result of a task, or what it raised and where."""

    result: Any
    error: BaseException | None = None
    where: str = ""


class RemoteError(Exception):
    """Where in a worker an exception was raised: its cause, when it is raised in the calling process."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def serve(connection: Connection, path: list[str], folder: str) -> None:
    """Do what is ordered over a connection until its other end is closed.

    In comes ``("shared", bytes)`` or ``("order", bytes)``, pickled; out goes ``("report", message)`` any number of
    times an order, then ``("outcome", bytes)``.
    """
    ignore_interrupts()
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    sys.path[:] = path
    os.chdir(folder)
    one_thread()
    shared = Shared(b"")
    while True:
        try:
            kind, content = connection.recv()
            if kind == "shared":
                shared = Shared(content)
            else:
                connection.send(("outcome", carried_out(content, shared, connection.send)))
        except (EOFError, OSError):  # nobody is there any more
            return


class Shared:
    """What all tasks need, unpickled when the first asks for it: if that fails, the task has failed."""

    def __init__(self, pickled: bytes) -> None:
        self._pickled: bytes | None = pickled
        self._value: Any = None

    def __call__(self) -> Any:
        """Return it."""
        if self._pickled is not None:
            self._value = cloudpickle.loads(self._pickled)
            self._pickled = None
        return self._value


def carried_out(order: bytes, shared: Callable[[], Any], send: Callable[[tuple[str, Any]], None]) -> bytes:
    """Return the pickled outcome of a pickled order, and send messages on the way, at most ten a second."""
    try:
        work, task, reports = cloudpickle.loads(order)
        result = work(shared(), task, _throttled(send) if reports else None)
        return bytes(cloudpickle.dumps(Outcome(result)))
    except BaseException as error:
        where = traceback.format_exc()
        try:
            pickled = bytes(cloudpickle.dumps(Outcome(None, error, where)))
            cloudpickle.loads(pickled)
        except Exception:  # it does not travel: its words do
            words = RuntimeError(f"{type(error).__name__}: {error}")
            pickled = bytes(cloudpickle.dumps(Outcome(None, words, where)))
        return pickled


def unpacked(outcome: bytes) -> Any:
    """Return the result of a task, or raise what it raised."""
    result, error, where = cloudpickle.loads(outcome)
    if error is not None:
        raise error from RemoteError(where)
    return result


def one_thread() -> None:
    """Have BLAS use one thread here; in libraries that load later too, unless the user has said otherwise."""
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_limits

    for name in _THREADS:
        os.environ.setdefault(name, "1")
    threadpool_limits(1, "blas")


def ignore_interrupts() -> None:
    """Leave it to the calling process to hear an interrupt, which a terminal sends to every process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):  # it was blocked while the process started
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _throttled(send: Callable[[tuple[str, Any]], None]) -> Report:
    last = -_TICK_S

    def report(phase: str, done: int, total: int, info: Mapping[str, Any]) -> None:
        nonlocal last
        now = time.monotonic()
        if done >= total or now >= last + _TICK_S:
            last = now
            send(("report", (phase, done, total, dict(info))))

    return report
