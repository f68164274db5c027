"""Ctrl-C (SIGINT), and SIGTERM, which batch systems send before they kill: both stop the work within seconds."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

GRACE_S = 1.0
"""How long the current step may take after a stop was requested."""
_Handler = Callable[[int, FrameType | None], None]
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_HAS_TIMER = os.name == "posix"


class _Stop:
    """The handlers of the signals, and the signals that have come.

    Attributes
    ----------
    asked : bool
        Whether a signal has come.
    due : bool
        Whether to raise a KeyboardInterrupt as soon as no block is shielded from it.
    polling, shields : int
        Number of nested `interruptible` blocks, and of nested `shielded` blocks.
    """

    def __init__(self) -> None:
        self.asked = self.due = False
        self.polling = self.shields = 0
        self.before: dict[int, _Handler | int | None] = {}

    def listen(self, number: int) -> None:
        """Install the handler of a signal, and remember the previous one."""
        self.before.setdefault(number, signal.signal(number, self.hear))

    def wait_no_longer(self) -> None:
        """Stop the timer that interrupts a long step."""
        if _HAS_TIMER and signal.SIGALRM in self.before:
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def leave(self) -> None:
        """Restore all previous handlers."""
        self.wait_no_longer()
        for number, handler in self.before.items():
            # None: it was not installed from Python, and cannot be restored
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def hear(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        first, self.asked = not self.asked, True
        if first and self.polling:
            print("Stopping after the current step; interrupt again to stop at once.", file=sys.stderr, flush=True)
            if _HAS_TIMER:  # its signal is handled like a second one
                self.listen(signal.SIGALRM)
                signal.setitimer(signal.ITIMER_REAL, GRACE_S)
            return
        self.due = True
        self.obey()

    def obey(self) -> None:
        """Raise the KeyboardInterrupt that is due, unless a block is shielded from it."""
        if self.due and not self.shields:
            self.due = False
            raise KeyboardInterrupt


_current: _Stop | None = None


@contextmanager
def stoppable() -> Iterator[None]:
    """Let SIGINT and SIGTERM raise a KeyboardInterrupt at once, except in `interruptible` and `shielded` blocks.

    Only the main thread handles signals: in another thread, or inside another such block, this does nothing.
    """
    with _listening():
        yield


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Give a function that returns whether SIGINT or SIGTERM has come, so that work can stop between two steps.

    A step that takes longer than `GRACE_S` after the signal is interrupted by a KeyboardInterrupt; a second signal
    interrupts at once. Such blocks can be nested: one signal stops both. In another thread than the main one the
    function always returns False.
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
            if not stop.polling:  # the work has stopped
                stop.wait_no_longer()


def is_asked() -> bool:
    """Return whether a signal has come in the present block, of whichever kind."""
    return _current is not None and _current.asked


@contextmanager
def shielded() -> Iterator[None]:
    """Delay a KeyboardInterrupt to the end of a block, in which files and memory must stay consistent."""
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
    """Install the handlers if they are not yet; give them, or None in another thread than the main one."""
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
