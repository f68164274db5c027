"""Runs on disk: the draws and the state of the chains are saved during a run, so that it can be resumed.

Reading order: content (files), store, identity, lock; run_directory for ``fmu run``; status, words and web for
``fmu watch``.
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
    """Where a run is kept while it goes on, and how much of it may be lost when it is killed.

    Parameters
    ----------
    directory : path-like
        A directory of the run's own; made if there is none.
    draws : int
        A group of chains loses at most as many steps.
    seconds : float
        It loses at most what it has drawn in as many seconds, or in a single step that takes longer.

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
