"""A deliberate fault, which at least one test must catch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fault:
    """One change of one file.

    Attributes
    ----------
    name : str
    file : str
        Within the project.
    old, new : str
        Text that occurs exactly once, and what takes its place.
    tests : tuple of str
        The files of tests that ought to notice.
    """

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
