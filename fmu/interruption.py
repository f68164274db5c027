"""Ctrl-C, and the signal that batch systems send before they kill: to stop between two steps, not anywhere."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_current: threading.Event | None = None
_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM") if hasattr(signal, name))


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Give a function that says whether a stop was asked for, by SIGINT or SIGTERM.

    A second one stops at once, as a KeyboardInterrupt. Within another such block it is that one's function: who
    asks for a stop asks both. Signals reach the main thread only: elsewhere nothing changes, and the function
    always says no.
    """
    global _current
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    if _current is not None:
        yield _current.is_set
        return
    asked = _current = threading.Event()

    def hear(number: int, frame: Any) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()
        print("Stopping after the step under way; once more to stop at once.", file=sys.stderr, flush=True)

    before = {number: signal.signal(number, hear) for number in _SIGNALS}
    try:
        yield asked.is_set
    finally:
        _current = None
        for number, handler in before.items():
            # one that was not installed from Python cannot be put back
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
