"""The lock of a directory, which one process has at a time, and notes for ``fmu watch``, which takes no lock."""

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
# fields of /proc/PID/stat, counted behind the number and the name
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
        When it began there, in seconds since 1970.
    birth : str
        When the process was started, to tell it from a later one with the same number; empty if not known.
    """

    host: str
    pid: int
    began: float
    birth: str

    def is_alive(self) -> bool | None:
        """Return whether the process still exists; None if that cannot be known from here."""
        if self.host != socket.gethostname() or os.name != "posix":
            return None
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:  # of another user
            pass
        return not self.birth or self.birth == _birth(self.pid)


class DirectoryLock:
    """The lock of a directory, which the system releases when its process dies.

    Parameters
    ----------
    directory : Path
    refusal : str
        Message of the error if another process has the lock.

    Raises
    ------
    ValueError
        If another process has it.
    """

    def __init__(self, directory: Path, refusal: str) -> None:
        self._directory = directory
        self._lock = FileLock(directory / LOCK, timeout=0)
        try:
            self._lock.acquire()
        except Timeout:
            raise ValueError(refusal) from None

    def release(self) -> None:
        """Release the lock; a second call does nothing."""
        if self._lock.is_locked:
            leave(self._directory)
        self._lock.release()


def announce(directory: Path) -> None:
    """Note that this process runs in a directory; if the disk is full, there is no note."""
    pid = os.getpid()
    here = ProcessInfo(socket.gethostname(), pid, time.time(), _birth(pid))
    with suppress(OSError):
        write_durably(directory / FILE, json.dumps(asdict(here)).encode())


def leave(directory: Path) -> None:
    """Remove the note of this process; a note that stays behind is of a process that was killed."""
    with suppress(OSError):
        for name in (PHASE, FILE):
            (directory / name).unlink(missing_ok=True)


def present(directory: Path) -> ProcessInfo | None:
    """Return the process that runs in a directory or was killed there; None if there is no (readable) note."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        held = json.loads((directory / FILE).read_text(encoding="utf-8"))
        return ProcessInfo(str(held["host"]), int(held["pid"]), float(held["began"]), str(held["birth"]))
    return None


class PhaseNote:
    """A note of the phase under way; there is none between two phases.

    Parameters
    ----------
    directory : Path
    """

    def __init__(self, directory: Path) -> None:
        self._path = directory / PHASE
        self._noted = ("", 0.0)

    def note(self, phase: str, done: int, total: int) -> None:
        """Note how far a phase has got, at most twice a second; an empty name means no phase."""
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
    """Return the phase under way, its steps done and in all; None if there is no (readable) note."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        held = json.loads((directory / PHASE).read_text(encoding="utf-8"))
        return str(held["phase"]), int(held["done"]), int(held["total"])
    return None


def _birth(pid: int) -> str:
    """Return when the system and the process were started; empty without /proc, or if the process has ended."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        behind_name = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2]
        fields = behind_name.split()
        return "" if fields[0] in _ENDED else f"{boot} {fields[_SINCE_BOOT]}"
    except (OSError, IndexError):
        return ""
