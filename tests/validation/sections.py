"""Sections of the page of a study, each kept as soon as it is written."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from tests.validation.kept import Units, each


def write_sections(writers: Mapping[str, Callable[[], str]], units: Units) -> list[str]:
    """Return the sections of a page; those that are kept are not written again."""
    return units.completed("sections", each(writers), lambda name: writers[name]())
