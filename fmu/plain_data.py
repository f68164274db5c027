"""Values of plain Python types, as a file of TOML or JSON has them, told apart by one function each.

This module imports neither NumPy nor anything else that is slow: the commands need it before they need numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def mapping_in(value: object) -> Mapping[str, Any] | None:
    """Return a value that is a mapping, as a table of a file is; None for any other value."""
    return value if isinstance(value, Mapping) else None


def list_in(value: object) -> list[Any] | None:
    """Return a value that is a list; None for any other value."""
    return value if isinstance(value, list) else None


def number_in(value: object) -> int | float | None:
    """Return a value that is a number, as true and false are in Python; None for any other value."""
    return value if isinstance(value, int | float) else None
