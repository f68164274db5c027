"""Trained reduced bases on disk, under a hash of the problem that they were trained for.

If a file is missing, damaged or of another version, the basis is trained again. The cache is in the user's cache
directory, or in the directory given by the environment variable ``FMU_CACHE_DIR``; if that variable is empty,
nothing is cached.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import platformdirs

from fmu.types import FloatArray

# Raised whenever what is stored, or how it is trained, changes.
_VERSION = 10


def load_basis(key: object) -> dict[str, FloatArray] | None:
    """Return the basis that `store_basis` stored for `key` (JSON-able), or None."""
    path = _path(key)
    if path is None:
        return None
    try:
        content = path.read_bytes()
        digest, payload = content[:32], content[32:]
        if hashlib.sha256(payload).digest() != digest:
            return None
        with np.load(io.BytesIO(payload), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, zipfile.BadZipFile, KeyError):
        return None


def store_basis(key: object, state: dict[str, FloatArray]) -> None:
    """Store `state` for `key`, atomically; nothing happens if the cache cannot be written."""
    path = _path(key)
    if path is None:
        return
    buffer = io.BytesIO()
    np.savez(buffer, **state)  # type: ignore[arg-type]
    payload = buffer.getvalue()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(hashlib.sha256(payload).digest() + payload)
        os.replace(file.name, path)
    except OSError:
        return


def _path(key: object) -> Path | None:
    root = os.environ.get("FMU_CACHE_DIR")
    if root == "":
        return None
    directory = Path(root) if root else Path(platformdirs.user_cache_dir("fmu"))
    text = json.dumps([_VERSION, key], sort_keys=True)
    return directory / f"basis-{hashlib.sha256(text.encode()).hexdigest()}.npz"
