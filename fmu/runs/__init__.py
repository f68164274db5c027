"""Runs on disk. Draws and chain states are saved during a run, so that it can be resumed.

Reading order: content (files), store, identity, lock; run_directory and maxima for ``fmu run``; reading, status,
words and web for ``fmu watch``; predictions for ``fmu predict``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from annotated_types import Ge

from fmu.arguments import Count, check_arguments


@check_arguments
@dataclass(frozen=True)
class Checkpoint:
    """The directory in which a run is saved while it is running, and how often it is saved.

    Parameters
    ----------
    directory : path-like
        A directory for this run only, created if it does not exist.
    draws : int
        Largest number of steps that each group of chains loses if the run is killed.
    seconds : float
        Largest sampling time in s that each group of chains loses if the run is killed. If a single step takes
        longer, the group loses this step.

    Raises
    ------
    ValueError
        If a number is out of range.
    """

    directory: str | os.PathLike[str]
    draws: Count = 1000
    seconds: Annotated[float, Ge(0.0)] = 30.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "directory", Path(self.directory))
