"""Tasks on a Dask cluster: that of a scheduler's address, or processes of this machine.

The workers of a cluster need fmu and what else the tasks import, in the versions of the calling process.
"""

from __future__ import annotations

import asyncio
import logging
import os
import queue
import re
import signal
import threading
import uuid
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import Any, NamedTuple

import cloudpickle
import dask
import distributed

from fmu.engines.dask_worker import Parcel, QuietWorker, carry_out, unchanged
from fmu.engines.engine import MOST_DEATHS, ContextManager, Follow, InProcess, LostTaskError, Work
from fmu.engines.worker import Order, unpacked
from fmu.progress import Report

_ADDRESS = re.compile(r"tcp://[^\s/]+:\d+")
_LOCAL = re.compile(r"local:([1-9]\d*)")
# those that Dask gives handlers of their own
_LOGGERS = ("distributed", "distributed.client", "tornado.application")
_ANSWER_S = 10.0
_TICK_S = 1.0


class Flight(NamedTuple):
    """A task of a line, and how many workers died of it, or of another one at the same time.

    A task may also be lost with what it needs, by the fault of another: so whatever was lost is tried again alone.
    """

    line: int
    order: Order
    deaths: int = 0


class DaskCluster(ContextManager):
    """Workers of a Dask cluster, one task a thread of each.

    Parameters
    ----------
    cluster : str
        ``"tcp://host:port"``: the address of a scheduler; workers may come and go, and as long as there are none
        it is waited for them. ``"local:N"``: N processes of this machine, of one thread each, that end with the
        engine; a program that starts them needs ``if __name__ == "__main__":``.

    Raises
    ------
    ValueError
        If it is neither, or no scheduler answers within ten seconds.

    Notes
    -----
    When lines are abandoned, workers of this machine stop at once; those of a scheduler finish what they are at,
    and nobody looks at it. How often a task is done again after its worker died is a setting of the scheduler
    (``distributed.scheduler.allowed-failures``).
    """

    def __init__(self, cluster: str) -> None:
        local = _LOCAL.fullmatch(cluster)
        if local is None and _ADDRESS.fullmatch(cluster) is None:
            raise ValueError(f"--cluster: must be tcp://host:port or local:N (got {cluster})")
        self.name = cluster
        self._levels = {name: logging.getLogger(name).level for name in _LOGGERS}
        self._set_levels(dict.fromkeys(_LOGGERS, logging.CRITICAL))
        self._processes: Any = None
        try:
            if local is None:
                _check_scheduler(cluster)
            else:
                self._processes = _local_cluster(int(local[1]))
            self._client = distributed.Client(self._processes or cluster, timeout=_ANSWER_S, set_as_default=False)
        except BaseException:
            self._set_levels(self._levels)
            raise
        self._busy = threading.Lock()
        self._shared: tuple[Any, Any] | None = None
        self._flying: dict[str, tuple[Any, Flight]] = {}
        self._told: dict[str, int] = {}  # the number of a task's last message
        self._room = self.workers
        self._inbox: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._topic = f"fmu-{self._client.id}"
        self._client.subscribe_topic(self._topic, lambda event: self._inbox.put(("report", event[1])))
        if self._processes is not None:
            self._client.register_plugin(QuietWorker())

    def __repr__(self) -> str:
        return f"DaskCluster({self.name!r})"

    @property
    def workers(self) -> int:
        """How many tasks run at once with the workers that are there now, at least 1."""
        return max(1, sum(self._client.nthreads().values()))

    def run_tasks(
        self,
        work: Work,
        shared: Any,
        tasks: Sequence[Any],
        follow: Follow | None = None,
        report: Report | None = None,
    ) -> list[Any]:
        """Do the tasks of all lines, see `fmu.engines.engine.Engine.run_tasks`."""
        if not self._busy.acquire(blocking=False):
            return InProcess().run_tasks(work, shared, tasks, follow, report)
        results: list[Any] = [None] * len(tasks)
        waiting = deque(Flight(i, Order(work, task, report is not None)) for i, task in enumerate(tasks))
        try:
            while waiting or self._flying:
                self._take_off(waiting, shared)
                for flight, outcome in self._landed(report):
                    if outcome is None:
                        waiting.appendleft(flight)
                        continue
                    results[flight.line] = unpacked(outcome)
                    self._take_off(waiting, shared)  # no worker is idle while the caller looks at the result
                    following = None if follow is None else follow(flight.line, results[flight.line])
                    if following is not None:
                        waiting.append(Flight(flight.line, Order(work, following, report is not None)))
        except BaseException:
            self._abandon()
            raise
        finally:
            self._busy.release()
        return results

    def close(self) -> None:
        """Leave the cluster; processes of this machine end."""
        self._shared = None
        self._client.close()
        if self._processes is not None:
            self._processes.close()
        self._set_levels(self._levels)

    def _take_off(self, waiting: deque[Flight], shared: Any) -> None:
        """Submit as many tasks as there is room for: a task that waits at a worker would share its fate."""
        while waiting and len(self._flying) < self._room:
            if self._flying and (waiting[0].deaths or any(flight.deaths for _, flight in self._flying.values())):
                return
            order = Parcel(cloudpickle.dumps(waiting[0].order))
            key = f"fmu-{uuid.uuid4().hex}"
            common = self._common(shared)
            future = self._client.submit(
                carry_out, common, common.key, key, order, self._topic, key=key, pure=False
            )
            self._flying[key] = future, waiting.popleft()
            future.add_done_callback(lambda future: self._inbox.put(("done", future.key)))

    def _common(self, shared: Any) -> Any:
        """Return what all tasks share as a future, of a task of its own: workers give it to each other.

        If it dies with a worker, the scheduler has it made again; what a client scatters would be lost, and a
        broadcast waits for ever for a worker that has just died.
        """
        if (
            self._shared is None
            or self._shared[0] is not shared
            or self._shared[1].status not in ("pending", "finished")
        ):
            key, parcel = f"fmu-shared-{uuid.uuid4().hex}", Parcel(cloudpickle.dumps(shared))
            with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"}):
                self._shared = shared, self._client.submit(unchanged, parcel, key=key, pure=False)
        return self._shared[1]

    def _landed(self, report: Report | None) -> Iterator[tuple[Flight, bytes | None]]:
        """Wait for news, and give what has come back: the outcome, or None if it is to be tried again."""
        try:
            kind, content = self._inbox.get(timeout=_TICK_S)
        except queue.Empty:
            self._check_connection()
            self._room = self.workers
            gone = [key for key, (future, _) in self._flying.items() if future.status in ("cancelled", "lost")]
        else:
            if kind == "report":
                key, number, message = cloudpickle.loads(content)
                self._pass_on(key, number, message, report)
                return
            gone = [content]
        for key in gone:
            if key in self._flying:  # it is not of lines that were abandoned
                yield self._result(key, report)

    def _result(self, key: str, report: Report | None) -> tuple[Flight, bytes | None]:
        future, flight = self._flying[key]
        outcome, deaths = None, 0
        try:
            outcome, number, message = cloudpickle.loads(future.result().content)
            if message is not None and self._told.get(key) != number:
                self._pass_on(key, number, message, report)
        except CancelledError:  # lost with what it needs
            deaths = flight.deaths + 1
        except distributed.KilledWorker as error:
            deaths = flight.deaths + error.allowed_failures + 1
        if deaths >= MOST_DEATHS:
            raise LostTaskError(flight.line, "of a Dask cluster")
        del self._flying[key]
        self._told.pop(key, None)
        return flight._replace(deaths=deaths), outcome

    def _pass_on(self, key: str, number: int, message: tuple[Any, ...], report: Report | None) -> None:
        if key in self._flying and report is not None:
            self._told[key] = number
            report(*message)

    def _check_connection(self) -> None:
        if self._client.status != "running":
            raise RuntimeError(f"--cluster: the connection to the scheduler was lost (of {self.name})")

    @staticmethod
    def _set_levels(levels: Mapping[str, int]) -> None:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)

    def _abandon(self) -> None:
        """Forget the tasks under way; workers of this machine are stopped, and replaced."""
        if self._flying and self._client.status == "running":
            busy = {address for address, keys in self._client.processing().items() if keys}
            self._client.cancel([future for future, _ in self._flying.values()])
            for nanny in self._processes.workers.values() if self._processes is not None else ():
                if nanny.worker_address in busy and nanny.pid is not None:  # the nanny starts another one
                    os.kill(nanny.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        self._flying.clear()
        self._told.clear()


def _local_cluster(workers: int) -> Any:
    """Start processes of this machine, of one thread each."""
    settings = {
        "distributed.scheduler.allowed-failures": 0,  # every death is told, and counted here
        "distributed.scheduler.active-memory-manager.start": False,  # it would take away what the tasks share
    }
    with dask.config.set(settings):
        return distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL
        )


def _check_scheduler(address: str) -> None:
    """Raise a ValueError if there is no scheduler at an address.

    A client that gives up in vain complains once more when it is collected.
    """

    async def identity() -> Any:
        async with distributed.rpc(address, timeout=_ANSWER_S) as scheduler:
            return await asyncio.wait_for(scheduler.identity(), _ANSWER_S)

    try:
        with ThreadPoolExecutor(1) as thread:  # in a notebook this one has an event loop that runs
            kind = thread.submit(asyncio.run, identity()).result().get("type")
    except (OSError, ValueError, TimeoutError) as error:
        raise ValueError(f"--cluster: no scheduler answers (got {address})") from error
    if kind != "Scheduler":
        raise ValueError(f"--cluster: must be the address of a scheduler (got {address}, of a {kind})")
