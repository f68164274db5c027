"""A run that is saved: the groups of its chains, what saves them, and the exceptions that end it early."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

from fmu.engines.base import RunFailedError
from fmu.posterior.failures import Failure
from fmu.samplers.loop.group import GroupState
from fmu.samplers.loop.record import RunResult, Steps


class Interrupted(KeyboardInterrupt):
    """A run was asked to stop, and has stopped between two steps.

    Attributes
    ----------
    result : RunResult or None
        The draws so far; None if the run was stopped in warm-up.
    """

    def __init__(self, result: RunResult | None) -> None:
        super().__init__("the run was stopped")
        self.result = result


class TooManyFailuresError(RunFailedError):
    """Too large a share of the solves failed.

    Attributes
    ----------
    result : RunResult or None
        The draws so far; None if there was only warm-up.
    """

    def __init__(self, message: str, result: RunResult | None) -> None:
        super().__init__(message)
        self.result = result


class SavedGroup(NamedTuple):
    """A group of chains as it was last saved.

    Attributes
    ----------
    group_state : GroupState
    elapsed_s : mapping of str to float
        Time that the phases of the run had taken by then.
    steps : iterable of (str, int, Steps)
        All steps that the group has taken: their phase, the number of the first one, and the steps.
    """

    group_state: GroupState
    elapsed_s: Mapping[str, float]
    steps: Iterable[tuple[str, int, Steps]]


class PendingGroup(NamedTuple):
    """What is to be saved of a group of chains.

    Attributes
    ----------
    group_state : GroupState
    elapsed_s : mapping of str to float
    phase : str
    first : int
        Number of the first of the steps in their phase.
    steps : Steps
    failures : list
        Points without a finite log-density since the group was last saved.
    total : int
        Planned steps of the phase.
    """

    group_state: GroupState
    elapsed_s: Mapping[str, float]
    phase: str
    first: int
    steps: Steps
    failures: list[Failure]
    total: int


class Checkpointer(Protocol):
    """Saves draws and the states of the groups, so that a run that dies can be resumed.

    Attributes
    ----------
    most_steps : int
        Most steps of a group that may be lost.
    most_seconds : float
        Most of its time that may be lost.
    """

    most_steps: int
    most_seconds: float

    def kept(self, group: int) -> SavedGroup | None:
        """Return a group as it was last saved, None if it was never saved."""
        ...

    def is_due(self, group: int, steps: int) -> bool:
        """Return whether a group is to be saved that has taken so many steps since it was last saved."""
        ...

    def keep(self, group: int, pending: PendingGroup) -> None:
        """Save what has happened to a group since it was last saved."""
        ...
