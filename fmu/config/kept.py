"""The problem file that a run keeps, and where it came from: what it takes to build the problem again."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

FILE, ORIGIN = "problem.toml", "run.json"
_ABOUT = "Written by fmu run: where problem.toml came from. The folder is relative to this file's."


class KeptProblem(NamedTuple):
    """A problem file and what the run added to it.

    Attributes
    ----------
    file : Path
    folder : Path
        Where the files that it names are.
    pairing : str or None
        How the run paired modes; None to do as the file says.
    """

    file: Path
    folder: Path
    pairing: str | None


def keep(source: Path, directory: Path, pairing: str) -> None:
    """Keep a problem file, verbatim, in the directory of its run."""
    origin = {
        "about": _ABOUT,
        "file": source.name,
        "folder": Path(os.path.relpath(source.resolve().parent, directory.resolve())).as_posix(),
        "pairing": pairing,
    }
    (directory / FILE).write_bytes(source.read_bytes())
    (directory / ORIGIN).write_text(json.dumps(origin, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def kept(directory: Path, model: Path | None = None) -> KeptProblem:
    """Return the problem that a run kept.

    Parameters
    ----------
    directory : Path
        Of the run.
    model : Path, optional
        The problem file to take instead, where the kept one is missing or the files that it names have moved.

    Raises
    ------
    ValueError
        If the run kept no problem file, or what it kept is not as `keep` wrote it.
    """
    if not (directory / ORIGIN).is_file() or not (directory / FILE).is_file():
        if model is None:
            raise ValueError(f"{directory} keeps no {FILE} with {ORIGIN}: give the problem's file (--model)")
        return KeptProblem(model, model.parent, None)
    try:
        origin = json.loads((directory / ORIGIN).read_text(encoding="utf-8"))
        folder, pairing = str(origin["folder"]), str(origin["pairing"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{directory / ORIGIN} is not as fmu run wrote it ({error})") from error
    if model is not None:
        return KeptProblem(model, model.parent, pairing)
    return KeptProblem(directory / FILE, directory / folder, pairing)
