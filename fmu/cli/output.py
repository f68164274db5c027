"""Files that commands write: a directory claimed before hours are spent, tables that are whole or absent."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


@contextmanager
def claimed(directory: Path, overwrite: bool) -> Iterator[Path]:
    """Make the output directory before hours are spent; take it away again if nothing came to be in it."""
    if os.path.lexists(directory) and not overwrite:
        raise ValueError(f"--out: {directory} exists; choose another directory or add --overwrite")
    made = [path for path in (directory, *directory.parents) if not path.exists()]
    try:
        make_writable(directory)
        yield directory
    except BaseException:
        for path in made:
            with suppress(OSError):  # it holds results
                path.rmdir()
        raise


def make_writable(directory: Path) -> None:
    """Make an output directory, if there is none; ValueError if it cannot be made, or not be written to."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        why = "" if os.access(directory, os.W_OK) else "no permission"
    except OSError as error:
        why = error.strerror or str(error)
    if why:
        raise ValueError(f"--out: must be a writable directory (got {directory}: {why})")


def write_csv(table: pd.DataFrame, path: Path) -> None:
    """Write a table so that the file appears complete or not at all."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        table.to_csv(unfinished)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
