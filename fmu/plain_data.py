"""Recognise tables, lists and numbers among plain Python values, as read from TOML or JSON.

This module imports nothing slow, not even NumPy, because the commands need it before they need numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def mapping_in(value: object) -> Mapping[str, Any] | None:
    """Return `value` if it is a mapping, such as a table in a file, otherwise None."""
    return value if isinstance(value, Mapping) else None


def list_in(value: object) -> list[Any] | None:
    """Return `value` if it is a list, otherwise None."""
    return value if isinstance(value, list) else None


def number_in(value: object) -> int | float | None:
    """Return `value` if it is a number, otherwise None. True and False count as numbers, as in Python."""
    return value if isinstance(value, int | float) else None
