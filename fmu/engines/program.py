"""Run a user's program with a time limit. On POSIX systems, kill it when the calling process ends."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from fmu.formats.shown import one_line
from fmu.interruption import GRACE_S, is_asked
from fmu.numbers import typed

TOO_LONG = "took longer than the time limit"
_TOLD, _LINES, _TAIL = 300, 5, 2**13
_SENT = ("SIGHUP", "SIGINT", "SIGKILL", "SIGTERM", "SIGXCPU")
KILLED_CODES = frozenset(
    code for name in _SENT if hasattr(signal, name) for n in [int(getattr(signal, name))] for code in (-n, 128 + n)
)
"""Return codes of programs that were killed from outside: by a user, a batch system, or for lack of memory.

A shell whose program is ended by signal n returns 128 + n. Signals that a program's own fault causes, such as
SIGSEGV and SIGABRT, are not among them."""

# This script runs between fmu and the program, on POSIX. It kills the program when its own standard input, a pipe
# from fmu, is closed. The system closes the pipe even if fmu is killed. The script starts no shell and imports
# little, so that it needs only 20 ms.
_ENDED_WITH_ITS_PARENT = """
import _thread, os, signal, sys
def wait_for_the_end():
    os.read(0, 1)
    os.killpg(0, signal.SIGKILL)
try:
    null = [(os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0)]
    program = os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ, file_actions=null)
except OSError as error:
    sys.exit(f"{sys.argv[1]} cannot be started: {error.strerror}")
_thread.start_new_thread(wait_for_the_end, ())
code = os.waitstatus_to_exitcode(os.waitpid(program, 0)[1])
if code < 0:
    signal.signal(-code, signal.SIG_DFL) if -code != signal.SIGKILL else None
    os.kill(os.getpid(), -code)
os._exit(code)
"""


def run_program(
    command: Sequence[str],
    folder: Path,
    output: Path,
    timeout_s: float,
) -> str:
    """Run a program until it ends; return why it failed, or an empty string if it succeeded.

    Parameters
    ----------
    command : sequence of str
        Path of the program and its arguments, which no shell interprets.
    folder : Path
        Working directory of the program.
    output : Path
        File to which standard output and standard error are written.
    timeout_s : float
        Time limit in s, after which the program is killed. On POSIX systems, the processes that it started are
        killed too.

    Raises
    ------
    OSError
        If the output file cannot be opened, or the process cannot be created. On POSIX systems, a program that
        cannot be started leads to a returned reason, not to an error.
    """
    watched = [sys.executable, "-I", "-S", "-c", _ENDED_WITH_ITS_PARENT] if os.name == "posix" else []
    with open(output, "wb") as file:
        process = subprocess.Popen(
            [*watched, *command],
            cwd=folder,
            stdin=subprocess.PIPE,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    late = threading.Event()

    def end() -> None:
        late.set()
        _kill(process)

    timer = threading.Timer(timeout_s, end)
    timer.daemon = True
    timer.start()
    try:
        code = process.wait()
    except BaseException:
        _kill(process)
        process.wait()
        raise
    finally:
        timer.cancel()
        if process.stdin is not None:
            process.stdin.close()
    if late.is_set():
        return f"{TOO_LONG} of {typed(timeout_s)} s"
    return _why(code) if code else ""


def was_killed(reason: str) -> bool:
    """Return True if a reason from `run_program`, or a text that contains it, gives one of `KILLED_CODES`."""
    return any(re.search(rf"\b{_why(code)}\b", reason) for code in KILLED_CODES)


def is_killed(error: BaseException) -> bool:
    """Return True if an exception means that a program was killed from outside.

    This is so for a ChildProcessError, and for a CalledProcessError with one of `KILLED_CODES`.
    """
    if isinstance(error, subprocess.CalledProcessError):
        return error.returncode in KILLED_CODES
    return isinstance(error, ChildProcessError)


def wait_for_a_stop() -> None:
    """Wait until a stop is requested, at most twice `GRACE_S`.

    The signal that killed a program may reach this process later. A worker does not know of the stop, but the
    calling process abandons the worker's task within `GRACE_S`.
    """
    end = time.monotonic() + 2.0 * GRACE_S
    while time.monotonic() < end and not is_asked():
        time.sleep(0.02)


def _why(code: int) -> str:
    if code < 0:
        with suppress(ValueError):
            return f"was ended by {signal.Signals(-code).name}"
    return f"ended with exit code {code}"


def last_lines(output: Path) -> str:
    """Return the last lines that a program printed, at most five, joined into one line.

    Lines without letters or digits are skipped, and only the last 300 characters are kept. The text is empty if
    the program printed nothing or the file cannot be read.
    """
    try:
        with open(output, "rb") as file:
            file.seek(max(0, output.stat().st_size - _TAIL))
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return ""
    lines = [line.strip() for line in text.splitlines() if any(map(str.isalnum, line))]
    told = one_line(" / ".join(lines[-_LINES:]), _TAIL)
    return told if len(told) <= _TOLD else f"… {told[-_TOLD:]}"


def _kill(process: subprocess.Popen[bytes]) -> None:
    if os.name != "posix":
        process.kill()
        return
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
