"""The classes that an object holds, directly or through what it holds."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any


def classes_held(root: Any) -> list[str]:
    """Return the names of fmu's classes that an object holds in attributes, containers, partials and methods."""
    found: set[str] = set()
    seen: dict[int, Any] = {}
    left = [root]
    while left:
        here = left.pop()
        if id(here) not in seen:
            seen[id(here)] = here  # kept alive, so that no other object takes its id
            if type(here).__module__.startswith("fmu"):
                found.add(type(here).__name__)
            left += _parts(here)
    return sorted(found)


def _parts(here: Any) -> Iterator[Any]:
    if isinstance(here, type):
        return
    if isinstance(here, dict):
        yield from (part for item in here.items() for part in item)
    elif isinstance(here, list | tuple | set | frozenset):
        yield from here
    elif isinstance(here, partial):
        yield from (here.func, here.args, here.keywords)
    yield from filter(None, [getattr(here, "__self__", None)])
    if type(here).__module__.startswith("fmu"):
        yield from vars(here).values() if hasattr(here, "__dict__") else ()
