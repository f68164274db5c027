"""Separate program runs that export the stiffness and mass of one property group at a time.

Let K(θ) = K_0 + Σ_j θ_j K_j. In a unit run one parameter has its starting value, and each other parameter has a
thousandth of its starting value. The matrix K_j then follows from the difference of two exports, in which the
other terms and their rounding errors are a thousand times smaller than at the starting values. The other
parameters are not zero, because programs refuse elements without stiffness and omit rows without stiffness.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

from filelock import FileLock

from fmu.durable_files import digest
from fmu.fem.programs.deck_run import DeckRun

UNIT = 1e-3
"""Value of all other parameters in a unit run, relative to their starting values."""
_CHECKED = 0.75
"""Value of all parameters in the run that checks the others, relative to their starting values."""


def unit_values(start: Mapping[str, float]) -> list[dict[str, float]]:
    """Return the parameter values for a run with low values, for all unit runs, and for a run that checks them.

    In the first run all values are low: `UNIT` times the starting values. In each of the next runs one parameter
    has its starting value, and all others are low. In the last run all values are in between; its matrices check
    the terms that are recovered from the other runs.
    """
    low = {name: UNIT * x for name, x in start.items()}
    alone = [low | {name: x} for name, x in start.items()]
    return [low, *alone, {name: _CHECKED * x for name, x in start.items()}]


def run_exports(
    run: DeckRun, values: Sequence[Mapping[str, float]], needed: Sequence[str], store: Path
) -> list[Path]:
    """Run the program once for each set of values, and return the folders that contain its output files.

    Runs with the same deck, command and inputs that are already stored are not repeated.

    Parameters
    ----------
    run : DeckRun
    values : sequence of mapping of str to float
        Parameter values, one mapping per run.
    needed : sequence of str
        Names of the files that the program must write. They may contain the placeholders ``{job}`` and ``{deck}``.
    store : Path
        Folder that contains the runs.

    Raises
    ------
    ValueError
        If a run fails or does not write one of these files. The message gives the parameter values and the last
        lines that the program printed.
    """
    key = repr([list(run.command), sorted(run.contents().items())])
    return [_run_once(run, one, needed, store, key) for one in values]


def _run_once(run: DeckRun, values: Mapping[str, float], needed: Sequence[str], store: Path, key: str) -> Path:
    text = (key + run.fill(values)).encode("utf-8", "surrogateescape")
    folder = store / f"{run.deck.stem}-{digest(text)[:16]}"
    store.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_name(f"{folder.name}.lock")):
        if folder.is_dir() and all(run.find_output(name, folder).is_file() for name in needed):
            return folder
        running = folder.with_name(f"{folder.name}.running")
        why = run.execute(values, running)
        missing = [name for name in needed if not run.find_output(name, running).is_file()]
        if not why and missing:
            why = f"it has written no {run.name(missing[0])}"
        if why:
            at = ", ".join(f"{name} = {x!r}" for name, x in values.items())
            failed = folder.with_name(f"{folder.name}.failed")
            raise ValueError(run.move_failed(f"at {at}: {run.explain(why, running)}", running, failed))
        shutil.rmtree(folder, ignore_errors=True)  # lacks a file that is needed now
        running.replace(folder)
    return folder
