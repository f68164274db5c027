"""What a slow program has computed, on disk: a small file per theta, written whole or not at all.

Any number of processes and runs share a store. Each theta is solved by one of them, and the others wait for it::

    for solve in SolveStore(folder):
        print(solve.theta, solve.frequencies, solve.seconds, solve.reason)
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from filelock import FileLock

from fmu.durable_files import digest, payload_of, signed, write_durably
from fmu.types import FloatArray

TITLE = "fmu solve 1"
FAILED, RUNNING = "failed", "running"
_SUFFIX = ".json"
_ARRAYS = ("theta", "frequencies", "shapes", "gradient")


class Solve(NamedTuple):
    """What came of one theta.

    Attributes
    ----------
    theta : ndarray, shape (n_parameters,)
    frequencies : ndarray, shape (n_modes,)
        Hz; empty if it failed.
    shapes : ndarray, shape (n_sensors, n_modes), or None
    seconds : float
        Time that the program took.
    reason : str
        Why it failed; empty if it did not.
    gradient : ndarray, shape (n_modes, n_parameters), or None
    """

    theta: FloatArray
    frequencies: FloatArray
    shapes: FloatArray | None
    seconds: float
    reason: str = ""
    gradient: FloatArray | None = None


class SolveStore:
    """The solves of one model; iterating gives them all, in no particular order.

    Parameters
    ----------
    folder : Path
        Made when the first solve is kept. What failed is in ``failed/``: without it, it is solved again.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __iter__(self) -> Iterator[Solve]:
        paths = [*self.folder.glob(f"*{_SUFFIX}"), *(self.folder / FAILED).glob(f"*{_SUFFIX}")]
        return (solve for solve in map(_read, sorted(paths)) if solve is not None)

    def find(self, theta: FloatArray) -> Solve | None:
        """Return what is stored of a theta (n_parameters,); None if there is nothing, or its file is damaged."""
        for path in self._paths(theta):
            found = _read(path)
            if found is not None and found.theta.tobytes() == theta.tobytes():
                return found
        return None

    def keep(self, solve: Solve) -> None:
        """Store a solve; OSError if it cannot be written."""
        arrays = {name: getattr(solve, name) for name in _ARRAYS}
        lists = {name: None if array is None else array.tolist() for name, array in arrays.items()}
        payload = json.dumps({**solve._asdict(), **lists}).encode()
        path = self._paths(solve.theta)[bool(solve.reason)]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, signed(TITLE, payload))
        if not solve.reason:  # it may have failed before
            self._paths(solve.theta)[1].unlink(missing_ok=True)

    @contextmanager
    def only_one(self, theta: FloatArray) -> Iterator[Path]:
        """Wait until no other process solves this theta; give a name for a folder to run in, which no other has.

        The system ends the lock of a process that dies, and the next one that asks for this theta has its folder.
        """
        name = self._paths(theta)[0].stem
        running = self.folder / RUNNING
        running.mkdir(parents=True, exist_ok=True)
        lock = FileLock(running / f"{name}.lock")
        with lock:
            yield running / name
            with suppress(OSError):  # whoever waits for it finds the theta solved
                (running / f"{name}.lock").unlink()

    def failed_folder(self, theta: FloatArray) -> Path:
        """Return where the files of a failed solve are kept."""
        return self._paths(theta)[1].with_suffix("")

    def _paths(self, theta: FloatArray) -> tuple[Path, Path]:
        """Return the file of a theta, where it was solved and where it failed."""
        name = f"{digest(theta.tobytes())[:32]}{_SUFFIX}"
        return self.folder / name, self.folder / FAILED / name


def _read(path: Path) -> Solve | None:
    """Return the solve in a file; None if there is none, or it is damaged."""
    try:
        held = json.loads(payload_of(TITLE, path.read_bytes()))
        given = {name: None if held.get(name) is None else np.array(held[name], dtype=float) for name in _ARRAYS}
        return Solve(**given, seconds=float(held["seconds"]), reason=str(held["reason"]))  # type: ignore[arg-type]
    except (OSError, ValueError, KeyError, TypeError):
        return None
