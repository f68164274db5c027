"""Saved copies of a run's problem file and options, used to resume the run and to rebuild its model."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from fmu.durable_files import write_durably

if TYPE_CHECKING:
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem

FILE, ORIGIN = "problem.toml", "run.json"
_ABOUT = (
    "Written by fmu run: the origin of problem.toml and the options of the run. The folder is relative to "
    "this file."
)


class Orders(TypedDict, total=False):
    """Options given to ``fmu run``. Options that did not exist in an earlier version may be missing."""

    samplers: Sequence[str]
    draws: int | None
    until_ess: float | None
    max_solves: int
    warmup: int | None
    chains: int
    groups: int | None
    seed: int
    starts: int | None
    init: str
    surrogate: bool | None
    exact: bool
    max_failure_rate: float
    keep_draws: int
    keep_seconds: float
    design: str
    """Hash of the model solves to which the surrogate was fitted."""


@dataclass(frozen=True)
class KeptProblem:
    """A problem file, and the options with which it was run.

    Attributes
    ----------
    file : Path
        The problem file.
    folder : Path
        Directory to which file names in the problem file are relative.
    pairing : str or None
        How modes are paired, or None to use the setting in the file.
    orders : Orders
        Run options: samplers, draws, seed and so on.
    finished : tuple of str
        Samplers that have finished.
    """

    file: Path
    folder: Path
    pairing: str | None
    orders: Orders = field(default_factory=Orders)
    finished: tuple[str, ...] = ()

    def load(self, engine: Engine | None = None) -> UpdatingProblem:
        """Return the updating problem. If `engine` is given, its workers train the reduced model.

        Raise ConfigurationError if the problem cannot be built, and FileNotFoundError if its file is missing.
        """
        from fmu import config

        return config.read(self.file).build(self.file.name, self.folder, self.pairing, engine=engine)

    def save(self, directory: Path) -> None:
        """Write a copy of the problem file and the run options to a directory, for `read_saved` to read."""
        origin = {
            "about": _ABOUT,
            "file": self.file.name,
            "folder": Path(os.path.relpath(self.folder.resolve(), directory.resolve())).as_posix(),
            "pairing": self.pairing,
            "orders": dict(self.orders),
            "finished": list(self.finished),
        }
        write_durably(directory / FILE, self.file.read_bytes())
        text = json.dumps(origin, indent=1, ensure_ascii=False) + "\n"
        write_durably(directory / ORIGIN, text.encode())


def read_saved(directory: Path, model: Path | None = None) -> KeptProblem:
    """Read the problem and the options that a run saved.

    If the saved problem file or the saved options are missing, the result has `model` and no options.

    Parameters
    ----------
    directory : Path
        The run's directory.
    model : Path, optional
        Problem file to use instead of the saved one, for example if that is missing or its input files have moved.

    Raises
    ------
    ValueError
        If the saved problem file or the saved options are missing and `model` is None, or if the saved options are
        not in the form in which `KeptProblem.save` wrote them.
    """
    if not (directory / ORIGIN).is_file() or not (directory / FILE).is_file():
        if model is None:
            raise ValueError(f"{directory} has no {FILE} with {ORIGIN}: give the problem file (--model)")
        return KeptProblem(model, model.parent, None)
    try:
        origin = json.loads((directory / ORIGIN).read_text(encoding="utf-8"))
        folder, pairing = str(origin["folder"]), None if origin["pairing"] is None else str(origin["pairing"])
        orders = Orders(**origin["orders"])
        finished = tuple(map(str, origin["finished"]))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{directory / ORIGIN} is not as fmu run wrote it ({error})") from error
    if model is not None:
        return KeptProblem(model, model.parent, pairing, orders, finished)
    return KeptProblem(directory / FILE, directory / folder, pairing, orders, finished)
