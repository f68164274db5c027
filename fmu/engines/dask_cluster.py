"""An engine that runs tasks on the workers of a Dask cluster.

The workers need fmu and all other packages that the tasks import, in the same versions as the calling process.
"""

from __future__ import annotations

import asyncio
import logging
import queue
import re
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, ThreadPoolExecutor
from functools import cache

import cloudpickle
import dask
import distributed

from fmu.engines.base import RunFailedError
from fmu.engines.remote import (
    Message,
    Outcome,
    RemoteEngine,
    Shared,
    Task,
    carry_out,
    limit_blas_threads,
    pack_shared,
)
from fmu.progress import Report

_ADDRESS = re.compile(r"tcp://[^\s/]+:\d+")
# loggers with handlers of their own in Dask
_LOGGERS = ("distributed", "distributed.client", "tornado.application")
_CHECK_INTERVAL_S = 1.0
_limit_blas_threads_once = cache(limit_blas_threads)


class DaskCluster(RemoteEngine):
    """An engine that runs tasks on a Dask cluster, one task per worker thread.

    Workers may join and leave the cluster. Tasks wait while there are no workers. Dask's loggers are silenced
    until the engine is closed.

    Parameters
    ----------
    address : str
        Address of the scheduler, ``"tcp://host:port"``.
    answer_s : float
        Time in s within which the scheduler must answer.

    Raises
    ------
    ValueError
        If `address` does not have this form, or no scheduler answers in time.

    Notes
    -----
    Workers finish even abandoned tasks, so new tasks may have to wait. If a worker dies, the scheduler itself
    reruns its task, as often as the Dask setting ``distributed.scheduler.allowed-failures`` permits.
    If the connection to the scheduler is lost, `run_tasks` raises a `RunFailedError`.
    """

    def __init__(self, address: str, answer_s: float = 10.0) -> None:
        super().__init__()
        if _ADDRESS.fullmatch(address) is None:
            raise ValueError(f"--cluster: must be tcp://host:port (got {address})")
        self.address = address
        self._levels = {name: logging.getLogger(name).level for name in _LOGGERS}
        _set_levels(dict.fromkeys(_LOGGERS, logging.CRITICAL))
        try:
            _check_scheduler(address, answer_s)
            self._client = distributed.Client(address, timeout=answer_s, set_as_default=False)
        except BaseException:
            _set_levels(self._levels)
            raise
        self._shared: tuple[object, distributed.Future] | None = None  # the object for all tasks, and its future
        self._running: dict[str, tuple[distributed.Future, Task]] = {}  # by key: the future and the task
        self._last_report: dict[str, int] = {}  # by key: the number of the last report passed on
        self._n_threads = self.workers
        self._inbox: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()  # reports have no key
        self._topic = f"fmu-{self._client.id}"
        self._client.subscribe_topic(self._topic, lambda event: self._inbox.put(("", event[1])))

    def __repr__(self) -> str:
        return f"DaskCluster({self.address!r})"

    @property
    def workers(self) -> int:
        """Total number of threads of the connected workers, at least 1."""
        return max(1, sum(self._client.nthreads().values()))

    def free_memory(self) -> int | None:
        """Return None, because the memory of the workers' machines is not known."""
        return None

    def close(self) -> None:
        """Disconnect from the cluster, and restore the levels of Dask's loggers."""
        self._shared = None
        self._client.close()
        _set_levels(self._levels)

    def _start(self, waiting: deque[Task], shared: object) -> bool:
        """Submit waiting tasks, at most one per worker thread; return True if any task is running.

        A task queued at a worker would be lost with that worker. A task can also be lost because another task
        killed its worker. A lost task is therefore rerun alone: if a worker dies then, this task is the cause.
        """
        while waiting and len(self._running) < self._n_threads:
            if self._running and (waiting[0].deaths or any(task.deaths for _, task in self._running.values())):
                break
            packed = Bytes(waiting[0].pack())
            key = f"fmu-{uuid.uuid4().hex}"
            common = self._future(shared)
            future = self._submit(key, run_on_worker, common, common.key, key, packed, self._topic)
            self._running[key] = future, waiting.popleft()
            future.add_done_callback(lambda future: self._inbox.put((future.key, b"")))
        return bool(self._running)

    def _future(self, shared: object) -> distributed.Future:
        """Return a future for `shared`, made by a separate task whose result the workers copy from one another.

        If the result is lost with a worker, the scheduler reruns the task. Scattered data would be lost for good,
        and a broadcast would wait forever for a worker that has just died.
        """
        if (
            self._shared is None
            or self._shared[0] is not shared
            or self._shared[1].status not in ("pending", "finished")
        ):
            key, packed = f"fmu-shared-{uuid.uuid4().hex}", Bytes(pack_shared(shared))
            self._shared = shared, self._submit(key, return_argument, packed)
        return self._shared[1]

    def _submit(self, key: str, function: Callable[..., Bytes], *arguments: object) -> distributed.Future:
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"}):
            return self._client.submit(function, *arguments, key=key, pure=False)

    def _take_ended(self, report: Report | None) -> Iterator[tuple[Task, Outcome]]:
        try:
            key, content = self._inbox.get(timeout=_CHECK_INTERVAL_S)
        except queue.Empty:
            if self._client.status != "running":
                raise RunFailedError(f"--cluster: lost the connection to the scheduler ({self.address})") from None
            self._n_threads = self.workers
            ended = [key for key, (future, _) in self._running.items() if future.status in ("cancelled", "lost")]
        else:
            if not key:
                key, number, message = cloudpickle.loads(content)
                self._pass_on(key, number, message, report)
                return
            ended = [key]
        for key in ended:
            if key in self._running:  # false for an abandoned task
                outcome = self._outcome(key, report)
                self._last_report.pop(key, None)
                yield self._running.pop(key)[1], outcome

    def _outcome(self, key: str, report: Report | None) -> Outcome:
        how = f"on the Dask cluster {self.address}"
        try:
            outcome, number, message = cloudpickle.loads(self._running[key][0].result().content)
        except CancelledError:  # the task was lost together with data that it needs
            return Outcome(deaths=1, how=how)
        except distributed.KilledWorker as error:
            return Outcome(deaths=error.allowed_failures + 1, how=how)
        if message is not None and self._last_report.get(key) != number:
            self._pass_on(key, number, message, report)
        return Outcome(outcome)

    def _pass_on(self, key: str, number: int, message: Message, report: Report | None) -> None:
        if key in self._running and report is not None:
            self._last_report[key] = number
            report(*message)

    def _abandon(self) -> None:
        if self._running and self._client.status == "running":
            self._client.cancel([future for future, _ in self._running.values()])
        self._running.clear()
        self._last_report.clear()


class _Thread(threading.local):
    """The shared object that this worker thread unpickled last. Every thread has its own copy."""

    name = ""
    shared = Shared(b"")


_thread = _Thread()


class Bytes:
    """A wrapper around bytes that keeps Dask from inspecting them.

    Parameters
    ----------
    content : bytes
    """

    def __init__(self, content: bytes) -> None:
        self.content = content


def return_argument(packed: Bytes) -> Bytes:
    """Return the argument unchanged."""
    return packed


def run_on_worker(shared: Bytes, name: str, key: str, task: Bytes, topic: str) -> Bytes:
    """Run a task on a worker; return the pickled outcome, and the number and content of the last report.

    Each report is sent as an event of `topic` with the key of the task and the number of the report. The `name` of
    the shared object shows whether this thread has already unpickled it. The last report is also returned with the
    outcome, because an event may arrive after the result.
    """
    _limit_blas_threads_once()
    number = 0
    last: Message | None = None

    def send(report: Message) -> None:
        nonlocal number, last
        number, last = number + 1, report
        distributed.get_worker().log_event(topic, cloudpickle.dumps((key, number, last)))

    if _thread.name != name:
        _thread.name, _thread.shared = name, Shared(shared.content)
    outcome = carry_out(task.content, _thread.shared, send)
    return Bytes(cloudpickle.dumps((outcome, number, last)))


def _set_levels(levels: Mapping[str, int]) -> None:
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


def _check_scheduler(address: str, answer_s: float) -> None:
    """Raise ValueError if no scheduler answers at `address` within `answer_s` seconds.

    This check comes first because a client that cannot connect prints a second error when it is garbage-collected.
    """

    async def identity() -> dict[str, object]:
        async with distributed.rpc(address, timeout=answer_s) as scheduler:
            return await asyncio.wait_for(scheduler.identity(), answer_s)

    try:
        with ThreadPoolExecutor(1) as thread:  # the calling thread may have a running event loop, as in a notebook
            kind = thread.submit(asyncio.run, identity()).result().get("type")
    except (OSError, ValueError, TimeoutError) as error:
        raise ValueError(f"--cluster: no scheduler answers (got {address})") from error
    if kind != "Scheduler":
        raise ValueError(f"--cluster: must be the address of a scheduler (got {address}, of a {kind})")
