"""What a run keeps of where it came from: the problem file, and what was asked for, to build and to resume it."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fmu.durable_files import write_durably

if TYPE_CHECKING:
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem

FILE, ORIGIN = "problem.toml", "run.json"
_ABOUT = (
    "Written by fmu run: the origin of problem.toml and the options of the run. The folder is relative to "
    "this file."
)


@dataclass(frozen=True)
class KeptProblem:
    """A problem file and what the run added to it.

    Attributes
    ----------
    file : Path
    folder : Path
        Where the files that it names are.
    pairing : str or None
        How the run paired modes; None to do as the file says.
    orders : mapping of str to JSON value
        What was asked for: samplers, draws, seed and so on.
    finished : tuple of str
        The samplers that are done.
    """

    file: Path
    folder: Path
    pairing: str | None
    orders: Mapping[str, Any] = field(default_factory=dict)
    finished: tuple[str, ...] = ()

    def load(self, engine: Engine | None = None) -> UpdatingProblem:
        """Return the problem, its reduced model trained by an engine; ConfigurationError if its file is broken."""
        from fmu import config

        return config.read(self.file).build(self.file.name, self.folder, self.pairing, engine=engine)


def keep(
    source: Path,
    directory: Path,
    pairing: str,
    orders: Mapping[str, Any] | None = None,
    finished: Sequence[str] = (),
    folder: Path | None = None,
) -> None:
    """Keep a problem file, verbatim, in the directory of its run, and what was asked for and is done.

    `folder` is where the files that it names are: its own, if not given.
    """
    folder = source.parent if folder is None else folder
    origin = {
        "about": _ABOUT,
        "file": source.name,
        "folder": Path(os.path.relpath(folder.resolve(), directory.resolve())).as_posix(),
        "pairing": pairing,
        "orders": dict(orders or {}),
        "finished": list(finished),
    }
    write_durably(directory / FILE, source.read_bytes())
    text = json.dumps(origin, indent=1, ensure_ascii=False) + "\n"
    write_durably(directory / ORIGIN, text.encode())


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
            raise ValueError(f"{directory} has no {FILE} with {ORIGIN}: give the problem file (--model)")
        return KeptProblem(model, model.parent, None)
    try:
        origin = json.loads((directory / ORIGIN).read_text(encoding="utf-8"))
        folder, pairing = str(origin["folder"]), str(origin["pairing"])
        orders, finished = dict(origin["orders"]), tuple(map(str, origin["finished"]))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{directory / ORIGIN} is not as fmu run wrote it ({error})") from error
    if model is not None:
        return KeptProblem(model, model.parent, pairing, orders, finished)
    return KeptProblem(directory / FILE, directory / folder, pairing, orders, finished)
