"""Reader for the lines of a Nastran deck, with each ``INCLUDE`` replaced by the included file's lines.

File names may be in quotes, and a quoted name may continue over several lines. A file is looked for in the deck's
folder and then in the folder of the including file. It must lie inside the deck's folder.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath

from fmu.formats.files import why_no_file
from fmu.formats.matrices.limits import LARGEST_FILE, RefusedError, text_lines
from fmu.formats.shown import quote

BULK_DATA = (".bdf", ".dat", ".nas")
"""Suffixes of Nastran decks."""
DEEPEST = 16
"""Largest depth of nested includes."""
MOST_FILES = 1000
LONGEST_NAME = 4096
_INCLUDE = re.compile(r"\s*INCLUDE(?=[\s'\"=])\s*=?\s*(.*)", re.IGNORECASE)


@dataclass
class _Count:
    """Number and total size of the files read so far for one deck."""

    files: int = 0
    size: int = 0


def deck_lines(path: Path) -> Iterator[str]:
    """Yield the lines of a deck, with the lines of included files inserted.

    Raises
    ------
    RefusedError
        If an included file does not exist, lies outside the deck's folder or includes itself; if there are too
        many files, or they are too large or nested too deeply; or if an INCLUDE entry is malformed.
    ValueError
        If a file is not text.
    """
    yield from _lines(path, path.parent.resolve(), (path.resolve(),), _Count())


def included_files(path: Path) -> list[Path]:
    """Return the paths of the files that a deck includes, without duplicates; see `deck_lines`."""
    folder, found = path.parent.resolve(), dict[Path, None]()
    for _ in _lines(path, folder, (path.resolve(),), _Count(), found):
        pass
    return [path.parent / file.relative_to(folder) for file in found]


def _lines(
    path: Path, folder: Path, within: tuple[Path, ...], count: _Count, found: dict[Path, None] | None = None
) -> Iterator[str]:
    """Yield the lines of a file and of the files that it includes.

    `within` is the chain of files from the deck to this file, in which each file includes the next. Included files
    are added to `found` if it is given. Raise RefusedError or ValueError under the same conditions as
    `deck_lines`.
    """
    count.files += 1
    count.size += path.stat().st_size
    if count.files > MOST_FILES or count.size > LARGEST_FILE:
        raise RefusedError(f"must have at most {MOST_FILES} files of {LARGEST_FILE} bytes in all by INCLUDE")
    with open(path, "rb") as file:
        lines = text_lines(file)
        for line in lines:
            include = _INCLUDE.match(line)
            if include is None:
                yield line
                continue
            name = _name(include[1], lines)
            if len(within) > DEEPEST:
                rule = f"must have at most {DEEPEST} files that include each other"
                raise RefusedError(f"{rule} (INCLUDE {quote(name)})")
            other = _inside(name, folder, path.parent.resolve())
            if other.resolve() in within:
                raise RefusedError(f"must not include a file within itself (INCLUDE {quote(name)})")
            if found is not None:
                found[other] = None
            yield from _lines(other, folder, (*within, other.resolve()), count, found)


def _name(text: str, lines: Iterator[str]) -> str:
    """Return the file name in an INCLUDE entry.

    A quoted name may continue on further lines; blanks at the line ends are dropped. Raise RefusedError if its
    closing quote is missing.
    """
    mark = text[:1]
    if mark not in ("'", '"'):
        return text.partition("$")[0].strip()
    name = text[1:]
    while mark not in name:
        further = next(lines, None)
        if further is None or len(name) > LONGEST_NAME:
            raise RefusedError(f"INCLUDE must have a name that ends with {mark} (got {quote(name[:80])})")
        name = name.rstrip() + further.strip()
    return name.partition(mark)[0].strip()


def _inside(name: str, folder: Path, beside: Path) -> Path:
    """Return the path of an included file, which is looked for in `folder` and then in `beside`.

    Raise RefusedError if the file does not exist, or lies outside `folder`.
    """
    name = name.replace("\\", "/")
    for base in (folder, beside):
        path = Path(os.path.normpath(base / name))
        try:
            is_inside = path.is_relative_to(folder) and path.resolve().is_relative_to(folder)
        except (OSError, RuntimeError, ValueError):  # a loop of links, or a NUL in the name
            raise RefusedError(f"INCLUDE must name a file (got {quote(name)})") from None
        if not is_inside or PureWindowsPath(name).drive:
            rule = f"must be inside the folder of the deck (INCLUDE {quote(name)})"
            raise RefusedError(f"{rule}: copy it there, and name it relative to the deck")
        if not why_no_file(path):
            return path
    raise RefusedError(f"INCLUDE must name a file ({why_no_file(folder / name)})")
