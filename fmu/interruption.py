"""Ctrl-C, and the signal that batch systems send before they kill: obeyed within seconds, wherever the work is."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

GRACE_S = 1.0
"""How long work that stops between two steps of its own may take over the step under way."""
_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM") if hasattr(signal, name))


class _Stop:
    """What is known of a stop, and who deals with it.

    Attributes
    ----------
    asked : bool
        Whether a signal has come.
    due : bool
        Whether a KeyboardInterrupt is to be raised as soon as nothing shields from it.
    polling, shields : int
        Nested blocks that ask for themselves, and nested blocks that must not be interrupted.
    """

    def __init__(self) -> None:
        self.asked = self.due = False
        self.polling = self.shields = 0
        self.before: dict[int, Any] = {}

    def listen(self, number: int) -> None:
        """Install the handler of a signal, and remember the one before."""
        self.before.setdefault(number, signal.signal(number, self.hear))

    def wait_no_longer(self) -> None:
        """Let no step be interrupted any more for having taken long."""
        if hasattr(signal, "setitimer") and signal.SIGALRM in self.before:
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def leave(self) -> None:
        """Put all handlers back."""
        self.wait_no_longer()
        for number, handler in self.before.items():
            # one that was not installed from Python cannot be put back
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def hear(self, number: int, frame: Any) -> None:
        """Take a signal: the handler."""
        first, self.asked = not self.asked, True
        if first and self.polling:
            print("Stopping after the step under way; once more to stop at once.", file=sys.stderr, flush=True)
            if hasattr(signal, "setitimer"):  # it is heard like a second signal
                self.listen(signal.SIGALRM)
                signal.setitimer(signal.ITIMER_REAL, GRACE_S)
            return
        self.due = True
        self.obey()

    def obey(self) -> None:
        """Raise the KeyboardInterrupt that is due, unless something shields from it."""
        if self.due and not self.shields:
            self.due = False
            raise KeyboardInterrupt


_current: _Stop | None = None


@contextmanager
def stoppable() -> Iterator[None]:
    """Have SIGINT and SIGTERM raise a KeyboardInterrupt, at once, anywhere but in `interruptible` and `shielded`.

    Signals reach the main thread only: elsewhere, and within another such block, nothing changes.
    """
    with _listening():
        yield


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Give a function that says whether a stop was asked for, by SIGINT or SIGTERM: to stop between two steps.

    A step that takes longer than `GRACE_S` is interrupted by a KeyboardInterrupt; so is any by a second signal.
    Within another such block both are asked. In another thread than the main one the function always says no.
    """
    with _listening() as stop:
        if stop is None:
            yield lambda: False
            return
        stop.polling += 1
        try:
            yield lambda: stop.asked
        finally:
            stop.polling -= 1
            if not stop.polling:  # it was obeyed
                stop.wait_no_longer()


def is_asked() -> bool:
    """Say whether a stop was asked for in the block under way, of whichever kind."""
    return _current is not None and _current.asked


@contextmanager
def shielded() -> Iterator[None]:
    """Put a KeyboardInterrupt off to the end of a block: files and memory have to agree with each other."""
    stop = _current if threading.current_thread() is threading.main_thread() else None
    if stop is None:
        yield
        return
    stop.shields += 1
    try:
        yield
    finally:
        stop.shields -= 1
    stop.obey()


@contextmanager
def _listening() -> Iterator[_Stop | None]:
    """Install the handlers, unless they are; give what they know, None in another thread than the main one."""
    global _current
    if threading.current_thread() is not threading.main_thread():
        yield None
        return
    if _current is not None:
        yield _current
        return
    _current = _Stop()
    try:
        for number in _SIGNALS:
            _current.listen(number)
        yield _current
    finally:
        stop, _current = _current, None
        stop.leave()
