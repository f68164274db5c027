"""Lock a directory so that only one process uses it, and write notes for ``fmu watch``, which needs no lock."""

from __future__ import annotations

import json
import os
import socket
import time
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from fmu.durable_files import write_durably

FILE, LOCK, PHASE = "at-work.json", "lock", "phase.json"
_NOTED_S = 0.5
# fields of /proc/PID/stat, counted from the field after the process name
_SINCE_BOOT = 22 - 3
_ENDED = "ZX"


@dataclass(frozen=True)
class ProcessInfo:
    """The process that runs in a directory.

    Attributes
    ----------
    host : str
    pid : int
    began : float
        Time at which the process began to use the directory, in s since 1970.
    birth : str
        Start time of the process, which distinguishes it from later processes with the same pid; empty if unknown.
    """

    host: str
    pid: int
    began: float
    birth: str

    def is_alive(self) -> bool | None:
        """Return True if the process exists, and False if it has ended.

        Return None if it runs on another host, or if the system is not POSIX.
        """
        if self.host != socket.gethostname() or os.name != "posix":
            return None
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:  # the process belongs to another user
            pass
        return not self.birth or self.birth == _birth(self.pid)


class DirectoryLock:
    """A lock on a directory, which the operating system releases if the process that holds it dies.

    Parameters
    ----------
    directory : Path
    refusal : str
        Message of the ValueError if the lock is taken.

    Raises
    ------
    ValueError
        If the lock is already held, by another process or by this one.
    """

    def __init__(self, directory: Path, refusal: str) -> None:
        self._directory = directory
        self._lock = FileLock(directory / LOCK, timeout=0)
        try:
            self._lock.acquire()
        except Timeout:
            raise ValueError(refusal) from None

    def release(self) -> None:
        """Remove this process's notes, and release the lock. Calling this again does nothing."""
        if self._lock.is_locked:
            leave(self._directory)
        self._lock.release()


def announce(directory: Path) -> None:
    """Write a note that this process is running in a directory. Errors such as a full disk are ignored."""
    pid = os.getpid()
    here = ProcessInfo(socket.gethostname(), pid, time.time(), _birth(pid))
    with suppress(OSError):
        write_durably(directory / FILE, json.dumps(asdict(here)).encode())


def leave(directory: Path) -> None:
    """Remove this process's notes from a directory, and ignore errors.

    A process that is killed leaves its notes behind.
    """
    with suppress(OSError):
        for name in (PHASE, FILE):
            (directory / name).unlink(missing_ok=True)


def present(directory: Path) -> ProcessInfo | None:
    """Return the process that is running in a directory or was killed in it, or None if no note is readable."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        held = json.loads((directory / FILE).read_text(encoding="utf-8"))
        return ProcessInfo(str(held["host"]), int(held["pid"]), float(held["began"]), str(held["birth"]))
    return None


class PhaseNote:
    """A note in a directory about the current phase. Between two phases there is no note.

    Parameters
    ----------
    directory : Path
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / PHASE
        self._noted = ("", 0.0)

    def note(self, phase: str, done: int, total: int) -> None:
        """Write a phase's progress to the note. Remove the note if `phase` is empty.

        A new phase is written at once, and its progress at most twice a second. Errors in writing are ignored.
        """
        now = time.monotonic()
        name, at = self._noted
        if name == phase and now < at + _NOTED_S:
            return
        self._noted = phase, now
        with suppress(OSError):  # if the disk is full, there is no note
            if phase:
                unfinished = self._path.with_name(f".{PHASE}.part")
                unfinished.write_text(json.dumps({"phase": phase, "done": done, "total": total}))
                os.replace(unfinished, self._path)
            elif name:
                self._path.unlink(missing_ok=True)


def noted_phase(directory: Path) -> tuple[str, int, int] | None:
    """Return the current phase's name, completed steps and total steps, or None if no note is readable."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        held = json.loads((directory / PHASE).read_text(encoding="utf-8"))
        return str(held["phase"]), int(held["done"]), int(held["total"])
    return None


def _birth(pid: int) -> str:
    """Return a process's boot identifier and start time.

    The result is empty if the process has ended or the system has no /proc.
    """
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        behind_name = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2]
        fields = behind_name.split()
        return "" if fields[0] in _ENDED else f"{boot} {fields[_SINCE_BOOT]}"
    except (OSError, IndexError):
        return ""
