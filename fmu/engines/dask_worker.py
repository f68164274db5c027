"""What goes on in a worker of a Dask cluster."""

from __future__ import annotations

import threading
from functools import cache
from typing import Any

import cloudpickle
from distributed import WorkerPlugin, get_worker

from fmu.engines.worker import Shared, carried_out, ignore_interrupts, one_thread

_kept = threading.local()


class Parcel:
    """Bytes that Dask has no reason to look into.

    Parameters
    ----------
    content : bytes
    """

    def __init__(self, content: bytes) -> None:
        self.content = content


class QuietWorker(WorkerPlugin):
    """Has the workers of this machine leave interrupts to the calling process."""

    name = "fmu"

    def setup(self, worker: Any) -> None:
        """Ignore interrupts."""
        ignore_interrupts()


def unchanged(parcel: Parcel) -> Parcel:
    """Return what is given."""
    return parcel


def carry_out(shared: Parcel, name: str, key: str, order: Parcel, topic: str) -> Parcel:
    """Carry out an order, and report under a topic: (order's key, number of the message, message), pickled.

    What tasks share has a `name`, by which a worker knows whether it has unpickled it before.
    The last message goes with the outcome: there is no order between what is reported and what is returned.
    """
    _one_thread()
    sent = 0
    last: Any = None

    def send(message: tuple[str, Any]) -> None:
        nonlocal sent, last
        sent, last = sent + 1, message[1]
        get_worker().log_event(topic, cloudpickle.dumps((key, sent, last)))

    outcome = carried_out(order.content, _unpickled(shared, name), send)
    return Parcel(cloudpickle.dumps((outcome, sent, last)))


def _unpickled(parcel: Parcel, name: str) -> Shared:
    """Return what tasks share, unpickled once a thread: they may not want to share it with each other."""
    if getattr(_kept, "name", None) != name:
        _kept.name, _kept.shared = name, Shared(parcel.content)
    return _kept.shared


@cache
def _one_thread() -> None:
    one_thread()
