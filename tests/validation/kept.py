"""Runs of a study kept in a file of JSON, one a line, from which an interrupted study is continued."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np


def kept_lines(file: Path | None, of_list: Callable[[list[Any]], Any] = tuple) -> list[dict[str, Any]]:
    """Return the fields of each run that the file holds, lists among them as `of_list`; none without a file."""
    lines = file.read_text(encoding="utf-8").splitlines() if file is not None and file.exists() else []
    return [
        {name: of_list(value) if isinstance(value, list) else value for name, value in json.loads(line).items()}
        for line in lines
    ]


def keep(file: Path | None, run: Any) -> None:
    """Add a run, a dataclass, to the file; without one, do nothing."""
    if file is not None:
        with file.open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(asdict(run), default=np.ndarray.tolist) + "\n")


def completed[Key, Job, Run](
    jobs: Iterable[tuple[Key, Job]], known: Mapping[Key, Run], make: Callable[[Job], Run], file: Path | None
) -> list[Run]:
    """Return the runs of all jobs, which come with their keys; those not known are made and added to the file."""
    runs = []
    for key, job in jobs:
        if key not in known:
            run = make(job)
            keep(file, run)
        else:
            run = known[key]
        runs.append(run)
    return runs
