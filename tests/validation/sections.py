"""Sections of the page of a study, each kept as soon as it is written."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.validation.kept import completed, kept_lines


@dataclass
class Section:
    """A section of a page, and the seconds of one core that it took."""

    name: str
    text: str
    seconds: float


def write_sections(writers: Mapping[str, Callable[[], str]], file: Path | None) -> list[Section]:
    """Return the sections of a page; those that the file holds are not written again."""

    def write(name: str) -> Section:
        began = time.process_time()
        text = writers[name]()
        print(text, flush=True)
        return Section(name, text, time.process_time() - began)

    known = {one.name: one for one in (Section(**fields) for fields in kept_lines(file))}
    return completed(((name, name) for name in writers), known, write, file)
