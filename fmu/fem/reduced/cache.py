"""Disk cache for trained reduced bases, each stored under a hash of the problem for which it was trained.

If a file is missing, is damaged or was written by an incompatible version of fmu, the basis is trained again. The
cache is in the user's cache directory, or in the directory given by the environment variable ``FMU_CACHE_DIR``. If
that variable is set but empty, nothing is cached.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import platformdirs

from fmu.durable_files import add_checksum, digest, payload_of, write_durably
from fmu.types import FloatArray

# Increased whenever the stored arrays or the training change.
_VERSION = 14
_TITLE = "fmu basis 1"


def load_basis(key: object) -> dict[str, FloatArray] | None:
    """Return the arrays that `store_basis` stored for `key`, or None if the file is missing or damaged.

    `key` is serialised as JSON. The result is also None if nothing is cached.
    """
    path = _path(key)
    if path is None:
        return None
    try:
        payload = payload_of(_TITLE, path.read_bytes())
        with np.load(io.BytesIO(payload), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, zipfile.BadZipFile, KeyError):
        return None


def store_basis(key: object, state: dict[str, FloatArray]) -> None:
    """Store the arrays `state` for `key` atomically. Do nothing if there is no cache or it cannot be written."""
    path = _path(key)
    if path is None:
        return
    buffer = io.BytesIO()
    np.savez(buffer, **state)  # type: ignore[arg-type]
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, add_checksum(_TITLE, buffer.getvalue()))


def _path(key: object) -> Path | None:
    root = os.environ.get("FMU_CACHE_DIR")
    if root == "":
        return None
    directory = Path(root) if root else Path(platformdirs.user_cache_dir("fmu"))
    text = json.dumps([_VERSION, key], sort_keys=True)
    return directory / f"basis-{digest(text.encode())}.npz"
