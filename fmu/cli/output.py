"""Check output directories before a long computation starts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def claim_directory(directory: Path, overwrite: bool) -> Iterator[Path]:
    """Create an output directory for a ``with`` block. If the block fails, remove new directories that are empty.

    Raise ValueError if the directory cannot be written to. If `overwrite` is False, also raise it if the path is a
    file or a link, or the directory contains files other than those of a run that was killed in its first seconds.
    """
    if os.path.lexists(directory) and not overwrite and not _is_left_empty(directory):
        from fmu.config.kept import ORIGIN
        from fmu.runs.run_directory import FOLDER

        kept = (directory / FOLDER / ORIGIN).is_file()
        resume = (
            f"holds a run that has not ended: resume it with fmu run --resume {directory}, "
            if kept
            else "exists; "
        )
        raise ValueError(f"--out: {directory} {resume}choose another directory or add --overwrite")
    made = [path for path in (directory, *directory.parents) if not path.exists()]
    try:
        make_writable(directory)
        yield directory
    except BaseException:
        for path in made:
            with suppress(OSError):  # the directory holds results
                path.rmdir()
        raise


def _is_left_empty(directory: Path) -> bool:
    """Return True if a directory contains at most the files of a run that was killed in its first seconds."""
    from fmu.runs.lock import FILE, LOCK, PHASE

    if directory.is_symlink() or not directory.is_dir():
        return False
    return all(path.is_dir() or path.name in (FILE, LOCK, PHASE) for path in directory.rglob("*"))


def make_writable(directory: Path) -> None:
    """Create an output directory if it does not exist. Raise ValueError if it cannot be created or written to."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        why = "" if os.access(directory, os.W_OK) else "no permission"
    except OSError as error:
        why = error.strerror or str(error)
    if why:
        raise ValueError(f"--out: must be a writable directory (got {directory}: {why})")
