"""Save runs: the data saved for a group of chains, the checkpointer, and exceptions that end a run early."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

from fmu.engines.base import RunFailedError
from fmu.posterior.failures import Failure
from fmu.samplers.loop.group import GroupState
from fmu.samplers.loop.record import RunResult, Steps


class Interrupted(KeyboardInterrupt):
    """Raised when a run has stopped on request.

    Attributes
    ----------
    result : RunResult or None
        The draws so far; None if there are none.
    """

    def __init__(self, result: RunResult | None) -> None:
        super().__init__("the run was stopped")
        self.result = result


class TooManyFailuresError(RunFailedError):
    """Raised when too many of the solves have failed.

    Attributes
    ----------
    result : RunResult or None
        The draws so far; None if there are none.
    """

    def __init__(self, message: str, result: RunResult | None) -> None:
        super().__init__(message)
        self.result = result


class SavedGroup(NamedTuple):
    """Data of a group of chains when it was last saved.

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
    """Data of a group of chains that are yet to be saved.

    Attributes
    ----------
    group_state : GroupState
    elapsed_s : mapping of str to float
        Seconds that each phase of the run has taken so far.
    phase : str
    first : int
        Index in the phase at which `steps` begin.
    steps : Steps
    failures : list
        Points without a finite log-density that were found since the group was last saved.
    total : int
        Number of steps planned for the phase.
    """

    group_state: GroupState
    elapsed_s: Mapping[str, float]
    phase: str
    first: int
    steps: Steps
    failures: list[Failure]
    total: int


class Checkpointer(Protocol):
    """Saves the groups' draws and states, from which an interrupted run can be resumed.

    Attributes
    ----------
    most_steps : int
        Largest number of steps of a group that may be lost between two saves.
    most_seconds : float
        Largest time in s of a group's work that may be lost between two saves.
    """

    most_steps: int
    most_seconds: float

    def kept(self, group: int) -> SavedGroup | None:
        """Return the last saved data of a group, or None if it has never been saved."""
        ...

    def is_due(self, group: int, steps: int) -> bool:
        """Return True if a group must be saved, given the number of steps since it was last saved."""
        ...

    def keep(self, group: int, pending: PendingGroup) -> None:
        """Save the data that a group has accumulated since it was last saved."""
        ...
