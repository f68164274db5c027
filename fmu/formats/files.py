"""Checks made before a file is read: that it exists, and that it is not too large."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def why_no_file(path: Path) -> str:
    """Return why a path is not a readable regular file, or an empty string if it is one."""
    shown = str(path) if len(str(path)) <= 200 else f"{str(path)[:200]}…"
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError, ValueError):  # ValueError: the name contains a NUL
        return f"no such file: {shown}"
    except OSError as error:  # a loop of links, a name that is too long, a folder without permission
        return f"{shown}: {(error.strerror or 'it cannot be read').lower()}"
    if stat.S_ISDIR(mode):
        return f"{shown} is a directory"
    if not stat.S_ISREG(mode):
        return f"{shown} is a pipe, a socket or a device"
    return "" if os.access(path, os.R_OK) else f"{shown}: no permission to read it"


def too_large(path: Path, most: int) -> str:
    """Return an error message if a file has more than `most` bytes, otherwise an empty string."""
    size = path.stat().st_size
    return f"must have at most {most} bytes (got {size})" if size > most else ""
