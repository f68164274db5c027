"""Problem file templates: for each kind of model, a commented problem that runs without changes."""

from __future__ import annotations

import os
from pathlib import Path

_FOLDER = Path(__file__).parent / "templates"
_FILES = {
    "frame": ("frame.toml",),
    "matrices": ("matrices.toml", "K0.mtx", "K1.mtx", "K2.mtx", "M.mtx"),
    "exports": ("exports.toml", "nominal.pch", "e1.pch", "e2.pch", "check.pch", "plate.bdf", "plate.bdf.in"),
    "command": ("command.toml", "plate.inp.in"),
    "nastran": ("nastran.toml", "plate.bdf.in"),
    "opensees": ("opensees.toml", "portal.py"),
    "python": ("python.toml", "storeys.py"),
}

KINDS = tuple(_FILES)


def template(kind: str) -> str:
    """Return the text of the problem file for a kind of model, one of `KINDS`.

    Raises
    ------
    ValueError
        If there is no such kind.
    """
    return (_FOLDER / kind / files(kind)[0]).read_text(encoding="utf-8")


def files(kind: str) -> tuple[str, ...]:
    """Return the names of a template's files, with the problem file first; `kind` is one of `KINDS`.

    Raises
    ------
    ValueError
        If there is no such kind.
    """
    if kind not in _FILES:
        raise ValueError(f"kind: must be one of {', '.join(KINDS)} (got {kind!r})")
    return _FILES[kind]


def write_template(kind: str, directory: str | os.PathLike[str]) -> Path:
    """Write a problem file template, with the other files that it needs, to a directory.

    Parameters
    ----------
    kind : str
        Kind of model, one of `KINDS`.
    directory : path-like
        Directory for the files, created if it does not exist.

    Returns
    -------
    Path
        The problem file.

    Raises
    ------
    ValueError
        If there is no such kind, or one of its files already exists in the directory. Nothing is then written.
    """
    folder = Path(directory)
    taken = [name for name in files(kind) if os.path.lexists(folder / name)]
    if taken:
        raise ValueError(f"directory: {folder} already contains {', '.join(taken)}; choose another one")
    folder.mkdir(parents=True, exist_ok=True)
    for name in files(kind):
        (folder / name).write_bytes((_FOLDER / kind / name).read_bytes())
    return folder / files(kind)[0]
