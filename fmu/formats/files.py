"""Checks before a file is read: whether there is one, and how large it is."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def why_no_file(path: Path) -> str:
    """Say why there is no regular file to read at a path; empty if there is one."""
    shown = str(path) if len(str(path)) <= 200 else f"{str(path)[:200]}…"
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: of a NUL in the name
        return f"no such file: {shown}"
    except OSError as error:  # of a loop of links, a name that is too long, a folder that is closed
        return f"{shown}: {(error.strerror or 'it cannot be read').lower()}"
    if stat.S_ISDIR(mode):
        return f"{shown} is a directory"
    if not stat.S_ISREG(mode):
        return f"{shown} is a pipe, a socket or a device"
    return "" if os.access(path, os.R_OK) else f"{shown}: no permission to read it"


def too_large(path: Path, most: int) -> str:
    """Return a complaint about a file of more than `most` bytes; empty if it has no more."""
    size = path.stat().st_size
    return f"must have at most {most} bytes (got {size})" if size > most else ""
