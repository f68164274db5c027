"""What a slow program has computed, on disk: a small file per theta, written whole or not at all.

Any number of processes and runs share a store. Each theta is solved by one of them, and the others wait for it::

    for solve in SolveStore(folder):
        print(solve.theta, solve.frequencies, solve.seconds, solve.reason)
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from filelock import FileLock

from fmu.arguments import check_arguments
from fmu.durable_files import add_checksum, digest, payload_of, write_durably
from fmu.fem.pairing.correlation import CLOSE, subspace_mac
from fmu.formats.shown import quote
from fmu.numbers import significant
from fmu.types import FloatArray

TITLE = "fmu solve 1"
FAILED, RUNNING = "failed", "running"
_SUFFIX = ".json"
_ARRAYS = ("theta", "frequencies", "shapes", "gradient")

MOST_SCATTER = 1e-3
"""Largest relative difference of a frequency between two solves of one theta that is taken for a solver's scatter.
Iterative ones stop at 1e-4 or below; more is another model."""
_MOST_TURNED = 0.01
"""Of shapes, sin²: so far does such a scatter turn a mode towards one whose frequency is 1 % away."""
_ROUNDING = 1e-6
"""Differences that other processors may make, and that no posterior shows."""
_NO_MOTION = 1e-6


class StoreWarning(UserWarning):
    """A model does not give exactly what is stored."""


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


@check_arguments
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
        """Return the stored solve of a theta (n_parameters,); None if there is none, or its file is damaged."""
        for path in self._paths(theta):
            found = _read(path)
            if found is not None and found.theta.tobytes() == theta.tobytes():
                return found
        return None

    def keep(self, solve: Solve) -> None:
        """Store a solve; OSError if it cannot be written."""
        values = solve._asdict()
        lists = {name: None if values[name] is None else values[name].tolist() for name in _ARRAYS}
        payload = json.dumps(values | lists).encode()
        path = self._paths(solve.theta)[bool(solve.reason)]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, add_checksum(TITLE, payload))
        if not solve.reason:  # it may have failed before
            self._paths(solve.theta)[1].unlink(missing_ok=True)

    @contextmanager
    def only_one(self, theta: FloatArray) -> Iterator[None]:
        """Wait until no other process solves this theta, or these points (n, n_parameters) together.

        The system ends the lock of a process that dies.
        """
        path = self.running_folder(theta).with_suffix(".lock")
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path):
            yield
            with suppress(OSError):  # whoever waits for it finds the theta solved
                path.unlink()

    def running_folder(self, theta: FloatArray) -> Path:
        """Return a folder to run in, for the one process that solves this theta (`only_one`)."""
        return self.folder / RUNNING / self._paths(theta)[0].stem

    def failed_folder(self, theta: FloatArray) -> Path:
        """Return where the files of a failed solve are kept."""
        return self._paths(theta)[1].with_suffix("")

    def forget_failure(self, theta: FloatArray) -> None:
        """Remove what is stored of a theta that failed."""
        self._paths(theta)[1].unlink(missing_ok=True)

    def check(self, stored: Solve, frequencies: FloatArray, shapes: FloatArray | None) -> None:
        """Compare a stored solve with what the same theta gives now: frequencies (n_modes,) in Hz, and shapes.

        Raises
        ------
        ValueError
            If they differ more than by a solver's scatter.

        Warns
        -----
        StoreWarning
            If they differ by more than rounding.
        """
        found, kept = (
            [None if array is None else array.shape for array in arrays]
            for arrays in ((frequencies, shapes), (stored.frequencies, stored.shapes))
        )
        apart = _frequencies_apart(stored.frequencies, frequencies) if found == kept else np.nan
        differs = ""
        if found != kept:
            differs = f"arrays of the shapes {found}, and not {kept}"
        elif not apart <= MOST_SCATTER:
            now, then = (quote(f.tolist()) for f in (frequencies, stored.frequencies))
            differs = f"frequencies that differ by {significant(100.0 * apart, 2)} %: {now} Hz, and not {then}"
        elif shapes is not None and stored.shapes is not None:
            turned = _shapes_apart(stored.frequencies, stored.shapes, shapes)
            if turned > _MOST_TURNED:
                differs = f"a shape whose MAC with that stored is {significant(1.0 - turned, 2)}"
        remedy = f"if a file that it reads was changed, restore it, or delete {self.folder}"
        if differs:
            raise ValueError(
                f"must give what is stored; at the start {stored.theta.tolist()} it gives {differs}: {remedy}"
            )
        if apart > _ROUNDING:
            warnings.warn(
                f"at the start the model's frequencies differ by {significant(100.0 * apart, 2)} % from those "
                f"stored, which is taken for scatter of the solver: {remedy}",
                StoreWarning,
                stacklevel=2,
            )

    def _paths(self, theta: FloatArray) -> tuple[Path, Path]:
        """Return the file of a theta, where it was solved and where it failed."""
        name = f"{digest(theta.tobytes())[:32]}{_SUFFIX}"
        return self.folder / name, self.folder / FAILED / name


def _frequencies_apart(stored: FloatArray, given: FloatArray) -> float:
    """Return the largest relative difference of frequencies, NaN if some are not finite in one of them only.

    Frequencies below a hundredth of the highest, which may be those of rigid motions, count as that hundredth.
    """
    least = 0.01 * np.nanmax(stored, initial=0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.abs(given**2 - stored**2) / (2.0 * np.maximum(stored, least) ** 2)
    same = (given == stored) | (np.isnan(given) & np.isnan(stored))
    return float(np.max(np.where(same, 0.0, apart), initial=0.0))


def _shapes_apart(frequencies: FloatArray, stored: FloatArray, given: FloatArray) -> float:
    """Return the largest sin² between a shape and the stored ones (n_sensors, n_modes) of close frequencies.

    Close ones, within 1 % of the highest frequency, may turn into each other. Shapes without motion at the sensors
    do not count.
    """
    if not np.array_equal(np.isnan(given), np.isnan(stored)):
        return 1.0
    size = np.linalg.norm(given, axis=0)
    moves = (size > _NO_MOTION * np.nanmax(size, initial=0.0)) & np.isfinite(frequencies)
    apart = np.abs(frequencies[:, None] - frequencies)
    near = apart <= CLOSE * np.nanmax(frequencies, initial=0.0)
    known = np.nan_to_num(stored)
    return max(
        (1.0 - subspace_mac(given[:, [i]], known[:, near[i]])[0] for i in np.flatnonzero(moves)), default=0.0
    )


def _read(path: Path) -> Solve | None:
    """Return the solve in a file; None if there is none, or it is damaged."""
    try:
        held = json.loads(payload_of(TITLE, path.read_bytes()))
        given = {name: None if held.get(name) is None else np.array(held[name], dtype=float) for name in _ARRAYS}
        return Solve(**given, seconds=float(held["seconds"]), reason=str(held["reason"]))  # type: ignore[arg-type]
    except (OSError, ValueError, KeyError, TypeError):
        return None
