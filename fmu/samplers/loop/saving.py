"""Saving of a run: the saved data of a group of chains, the checkpointer, and exceptions that end a run early."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

from fmu.engines.base import RunFailedError
from fmu.posterior.failures import Failure
from fmu.samplers.loop.group import GroupState
from fmu.samplers.loop.record import RunResult, Steps


class Interrupted(KeyboardInterrupt):
    """Raised when a run was asked to stop and has stopped.

    Attributes
    ----------
    result : RunResult or None
        The draws so far; None if there are none.
    """

    def __init__(self, result: RunResult | None) -> None:
        super().__init__("the run was stopped")
        self.result = result


class TooManyFailuresError(RunFailedError):
    """Raised when too large a share of the solves has failed.

    Attributes
    ----------
    result : RunResult or None
        The draws so far; None if there are none.
    """

    def __init__(self, message: str, result: RunResult | None) -> None:
        super().__init__(message)
        self.result = result


class SavedGroup(NamedTuple):
    """The last saved data of a group of chains.

    Attributes
    ----------
    group_state : GroupState
    elapsed_s : mapping of str to float
        Seconds that each phase of the run had taken when the group was saved.
    steps : iterable of (str, int, Steps)
        All steps that the group has taken: the phase, the index of the first step, and the steps.
    """

    group_state: GroupState
    elapsed_s: Mapping[str, float]
    steps: Iterable[tuple[str, int, Steps]]


class PendingGroup(NamedTuple):
    """Data of a group of chains that is to be saved.

    Attributes
    ----------
    group_state : GroupState
    elapsed_s : mapping of str to float
        Seconds that each phase of the run has taken so far.
    phase : str
    first : int
        Index of the first of the `steps` in the phase.
    steps : Steps
    failures : list
        Points without a finite log-density since the group was last saved.
    total : int
        Number of planned steps of the phase.
    """

    group_state: GroupState
    elapsed_s: Mapping[str, float]
    phase: str
    first: int
    steps: Steps
    failures: list[Failure]
    total: int


class Checkpointer(Protocol):
    """Saver of the draws and the states of the groups, from which a run that dies can be resumed.

    Attributes
    ----------
    most_steps : int
        Largest number of steps of a group that may be lost.
    most_seconds : float
        Largest number of seconds of a group's work that may be lost.
    """

    most_steps: int
    most_seconds: float

    def kept(self, group: int) -> SavedGroup | None:
        """Return the last saved data of a group; None if the group was never saved."""
        ...

    def is_due(self, group: int, steps: int) -> bool:
        """Return True if a group is to be saved after `steps` steps since the last save of the group."""
        ...

    def keep(self, group: int, pending: PendingGroup) -> None:
        """Save the data of a group since the last save of the group."""
        ...
