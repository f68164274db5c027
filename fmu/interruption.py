"""Stop work within seconds after Ctrl-C (SIGINT), or after a batch system's SIGTERM."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

GRACE_S = 1.0
"""Time in s that the current step is allowed after a stop was requested."""
_Handler = Callable[[int, FrameType | None], None]
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_HAS_TIMER = os.name == "posix"


class _Stop:
    """The signal handler that all blocks in this module share, and its state.

    Attributes
    ----------
    asked : bool
        Whether a signal has been received.
    due : bool
        Whether a KeyboardInterrupt is pending because a signal arrived in a `shielded` block.
    polling, shields : int
        Numbers of `interruptible` and of `shielded` blocks that are currently open.
    before : dict of int to callable, int or None
        The previous handler of each signal, as returned by `signal.signal`.
    """

    def __init__(self) -> None:
        self.asked = self.due = False
        self.polling = self.shields = 0
        self.before: dict[int, _Handler | int | None] = {}

    def listen(self, number: int) -> None:
        """Install the handler for a signal, and store the handler that it replaces."""
        self.before.setdefault(number, signal.signal(number, self.hear))

    def wait_no_longer(self) -> None:
        """Cancel the timer that would interrupt a long step."""
        if _HAS_TIMER and signal.SIGALRM in self.before:
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def leave(self) -> None:
        """Restore all previous handlers."""
        self.wait_no_longer()
        for number, handler in self.before.items():
            # None: the handler was not installed from Python, and cannot be restored
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def hear(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal.

        The first signal in an `interruptible` block prints a message, and requests a stop after the current step,
        which may take `GRACE_S` longer. Any other signal interrupts at once, or at the end of a `shielded` block.
        """
        first, self.asked = not self.asked, True
        if first and self.polling:
            print("Stopping after the current step; interrupt again to stop at once.", file=sys.stderr, flush=True)
            if _HAS_TIMER:  # the timer's signal is handled like a second interruption
                self.listen(signal.SIGALRM)
                signal.setitimer(signal.ITIMER_REAL, GRACE_S)
            return
        self.due = True
        self.obey()

    def obey(self) -> None:
        """Raise any pending KeyboardInterrupt, unless a block is shielded from it."""
        if self.due and not self.shields:
            self.due = False
            raise KeyboardInterrupt


_current: _Stop | None = None


@contextmanager
def stoppable() -> Iterator[None]:
    """Make SIGINT and SIGTERM raise KeyboardInterrupt at once within a block.

    Inside `interruptible` and `shielded` blocks, the exception is delayed as described in their docstrings. Only
    the main thread handles signals, so a block in another thread has no effect. A block within another `stoppable`
    or `interruptible` block has no effect either.
    """
    with _listening():
        yield


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns True after SIGINT or SIGTERM, so that work can stop between two steps.

    If a step takes longer than `GRACE_S` after the signal, a KeyboardInterrupt interrupts it, provided that the
    system has a timer. A second signal interrupts at once. Blocks can be nested: one signal stops all of them.
    Outside the main thread the function always returns False.
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
    """Return True if a stop was requested by a signal in the current `stoppable` or `interruptible` block."""
    return _current is not None and _current.asked


@contextmanager
def shielded() -> Iterator[None]:
    """Delay a KeyboardInterrupt until the end of a block that must leave files and memory consistent.

    If the block raises another exception, the delayed KeyboardInterrupt replaces that exception. The delay works
    only inside a `stoppable` or `interruptible` block, in the main thread.
    """
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
    """Install the signal handlers for a block, unless an outer block has installed them, and yield their state.

    Yield None outside the main thread.
    """
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
