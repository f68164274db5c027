"""Disk storage for the solves of a slow program: a small file per theta, written atomically.

Any number of processes can share a store. Each theta is solved by one process, and the others wait for it. All
solves in a store can be read in a loop::

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
"""Largest relative frequency difference between two solves at one theta that is attributed to the solver's
scatter. Iterative solvers stop at 1e-4 or below; a larger difference means another model."""
_MOST_TURNED = 0.01
"""Largest sin² of the angle between a new shape and the stored shapes. A frequency change of `MOST_SCATTER` can
rotate a shape this far towards the shape of a mode whose frequency is 1 % higher."""
_ROUNDING = 1e-6
"""Relative frequency difference that another processor may cause. It is too small to change a posterior."""
_NO_MOTION = 1e-6
"""Norm of a shape at the sensors, relative to the largest one, below which the shape counts as zero there."""


class StoreWarning(UserWarning):
    """Issued when a model reproduces a stored solve to within a solver's scatter, but not to rounding."""


class Solve(NamedTuple):
    """A program's result at one theta, or the reason why it failed.

    Attributes
    ----------
    theta : ndarray, shape (n_parameters,)
    frequencies : ndarray, shape (n_modes,)
        Frequencies in Hz; empty if the solve failed.
    shapes : ndarray, shape (n_sensors, n_modes), or None
    seconds : float
        Time that the program took.
    reason : str
        Why the solve failed; empty if it succeeded.
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
    """Stored solves of one model; iterating yields every undamaged `Solve`, in no particular order.

    Parameters
    ----------
    folder : path-like
        Folder of the store, created when it is first needed. Failures are in its subfolder ``failed``;
        delete that subfolder to have them solved again.

    Raises
    ------
    ValueError
        If `folder` is not a path.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder)

    def __iter__(self) -> Iterator[Solve]:
        paths = [*self.folder.glob(f"*{_SUFFIX}"), *(self.folder / FAILED).glob(f"*{_SUFFIX}")]
        return (solve for solve in map(_read, sorted(paths)) if solve is not None)

    def find(self, theta: FloatArray) -> Solve | None:
        """Return the stored solve at theta (n_parameters,), or None if it is missing or its file is damaged."""
        for path in self._paths(theta):
            found = _read(path)
            if found is not None and found.theta.tobytes() == theta.tobytes():
                return found
        return None

    def keep(self, solve: Solve) -> None:
        """Write a solve to disk, and remove an earlier failure at its theta if it succeeded.

        Raise OSError if the file cannot be written.
        """
        values = solve._asdict()
        lists = {name: None if values[name] is None else values[name].tolist() for name in _ARRAYS}
        payload = json.dumps(values | lists).encode()
        path = self._paths(solve.theta)[bool(solve.reason)]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, add_checksum(TITLE, payload))
        if not solve.reason:  # an earlier solve may have failed
            self._paths(solve.theta)[1].unlink(missing_ok=True)

    @contextmanager
    def only_one(self, theta: FloatArray) -> Iterator[None]:
        """Wait for a lock, and hold it within a ``with`` block, so that no other process solves theta.

        theta is one point (n_parameters,), or the points (n, n_parameters) of a batch. If a process dies, the
        operating system releases its lock.
        """
        path = self.running_folder(theta).with_suffix(".lock")
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path):
            yield
            with suppress(OSError):  # a process that waits for the lock then finds the theta solved
                path.unlink()

    def running_folder(self, theta: FloatArray) -> Path:
        """Return the folder in which the program runs for theta, given as in `only_one`.

        Use it only with the lock from `only_one`.
        """
        return self.folder / RUNNING / self._paths(theta)[0].stem

    def failed_folder(self, theta: FloatArray) -> Path:
        """Return the folder for the files of a failed solve at theta (n_parameters,)."""
        return self._paths(theta)[1].with_suffix("")

    def forget_failure(self, theta: FloatArray) -> None:
        """Remove the stored failure at theta (n_parameters,), if there is one."""
        self._paths(theta)[1].unlink(missing_ok=True)

    def check(self, stored: Solve, frequencies: FloatArray, shapes: FloatArray | None) -> None:
        """Check that a stored solve agrees with a new one at the same theta.

        The new solve has `frequencies` (n_modes,) in Hz, and `shapes` (n_sensors, n_modes) or None.

        Raises
        ------
        ValueError
            If the two solves have arrays of different shapes, or their frequencies or mode shapes differ by more
            than a solver's scatter (`MOST_SCATTER`, `_MOST_TURNED`).

        Warns
        -----
        StoreWarning
            If the frequencies differ by more than rounding.
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
        """Return the two paths at which a solve at theta may be stored: one if it succeeded, one if it failed."""
        name = f"{digest(theta.tobytes())[:32]}{_SUFFIX}"
        return self.folder / name, self.folder / FAILED / name


def _frequencies_apart(stored: FloatArray, given: FloatArray) -> float:
    """Return the largest relative difference in frequency, or NaN if a frequency is NaN in only one array.

    The difference is |f² − s²|/(2d²), which is about |f − s|/d. Here s is the stored frequency, and d is the
    larger of s and a hundredth of the highest stored frequency, because low frequencies may belong to rigid-body
    modes.
    """
    least = 0.01 * np.nanmax(stored, initial=0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.abs(given**2 - stored**2) / (2.0 * np.maximum(stored, least) ** 2)
    same = (given == stored) | (np.isnan(given) & np.isnan(stored))
    return float(np.max(np.where(same, 0.0, apart), initial=0.0))


def _shapes_apart(frequencies: FloatArray, stored: FloatArray, given: FloatArray) -> float:
    """Return the largest sin² of the angle between a new shape and the stored shapes with close frequencies.

    Both arrays have shape (n_sensors, n_modes). Modes whose frequencies differ by at most 1 % of the highest
    frequency may mix, so each shape is compared with their span. Shapes that are zero at the sensors are not
    compared. Return 1 if the two arrays have NaN in different places.
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
    """Return the solve in a file, or None if the file is missing or damaged."""
    try:
        held = json.loads(payload_of(TITLE, path.read_bytes()))
        given = {name: None if held.get(name) is None else np.array(held[name], dtype=float) for name in _ARRAYS}
        return Solve(**given, seconds=float(held["seconds"]), reason=str(held["reason"]))  # type: ignore[arg-type]
    except (OSError, ValueError, KeyError, TypeError):
        return None
