"""Mistakes in a problem file: all reported together, each with its location, the rule and the value received."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from fmu.formats.shown import shown, told

if TYPE_CHECKING:
    from pydantic import ValidationError

_NAME = r"[^\W\d]\w*"
FUNCTION = rf"^{_NAME}(\.{_NAME})*:{_NAME}(\.{_NAME})*$"
"""The pattern of ``module:function``."""
PYTHON_FILE = rf"^{_NAME}\.py$"
LONGEST_KEY = 40
_KEY_FIRST = re.compile(r"(?:(\w+(?:\.\w+)*): )?(.*)", re.DOTALL)
_PATTERNS = {
    r"^[^/\x00-\x1f]+$": "must have no slash, line break or other control character",
    r"^[^\x00-\x1f]+$": "must have no line break or other control character",
    r"^\d{1,9}$": "must be the number of a node, of at most 9 digits",
    PYTHON_FILE: "must be a Python file beside this one, as portal.py",
    FUNCTION: 'must be "module:function", as in "storeys:modes"',
}
"""The rules behind the patterns of strings."""


class Mistake(NamedTuple):
    """A mistake: its location (``parameters.1.upper``), and the rule with the value received."""

    where: str
    rule: str

    def __str__(self) -> str:
        return f"{self.where}: {self.rule}" if self.where else self.rule

    @classmethod
    def of(cls, where: str, error: object) -> Self:
        """Return the library's ValueError ``key: rule (got value)`` as a mistake at that key of a table."""
        key, rule = _KEY_FIRST.fullmatch(str(error)).groups("")  # type: ignore[union-attr]
        return cls(".".join(part for part in (where, key) if part), rule)


class BrokenError(Exception):
    """Mistakes found while a part of the problem was built."""

    def __init__(self, mistakes: Sequence[Mistake]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__("; ".join(map(str, self.mistakes)))


class ConfigurationError(ValueError):
    """A problem file that cannot be used.

    Attributes
    ----------
    source : str
        The file.
    mistakes : tuple of Mistake
        All that were found.
    """

    def __init__(self, source: str, mistakes: Sequence[Mistake]) -> None:
        self.source, self.mistakes = source, tuple(mistakes)
        n = len(self.mistakes)
        super().__init__(f"{source}: {n} error{'s' if n > 1 else ''}")

    def __str__(self) -> str:
        return "\n".join([f"{super().__str__()}:", *(f"  {line}" for line in told(self.mistakes))])


def got(rule: str, value: Any) -> str:
    """Return a rule followed by the value received, shortened if it is long."""
    return f"{rule} (got {shown(value)})"


def place(parts: Sequence[int | str]) -> str:
    """Return a location in the file, with long keys shortened."""
    return ".".join(
        str(part) if len(str(part)) <= LONGEST_KEY else f"{str(part)[:LONGEST_KEY]}…" for part in parts
    )


def of_validation(error: ValidationError) -> list[Mistake]:
    """Return the errors of pydantic as mistakes."""
    return [_of_one(dict(one)) for one in error.errors(include_url=False)]


def _of_one(error: dict[str, Any]) -> Mistake:
    where = place(_in_the_file(error["loc"]))
    kind, value = error["type"], error["input"]
    if kind == "extra_forbidden":
        return Mistake(where, "is not a known key")
    if kind == "missing":
        return Mistake(where, "is missing")
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        return _of_tag(where, error)
    if kind == "string_pattern_mismatch":
        return Mistake(where, got(_PATTERNS.get(error["ctx"]["pattern"], _as_rule(error["msg"])), value))
    if kind == "value_error":
        return Mistake.of(where, error["ctx"]["error"])
    if kind == "kind":
        return Mistake(where, got(error["msg"], value))
    return Mistake(where, got(_as_rule(error["msg"]), value))


def _as_rule(message: str) -> str:
    """Return pydantic's ``Input should be …`` as ``must be …``."""
    subject, should, rest = message.partition(" after validation")[0].partition(" should ")
    return f"must {rest}" if should and subject in ("Input", "String", "List", "Dictionary") else message


def _of_tag(where: str, error: dict[str, Any]) -> Mistake:
    """Return the mistake in the key that selects the kind of a table."""
    context = error["ctx"]
    where = f"{where}.{context['discriminator'].strip("'")}"
    if "tag" not in context:
        return Mistake(where, "is missing")
    known = ", ".join(tag.strip("'") for tag in context["expected_tags"].split(", "))
    return Mistake(where, got(f"must be one of {known}", context["tag"]))


def _in_the_file(where: tuple[int | str, ...]) -> list[int | str]:
    """Return a location without the kinds of values and tables that pydantic inserts after a key."""
    parts = [part for part in where if not str(part).startswith("<") and part != "[key]"]
    number = parts[1:2]
    of_parameter = (["prior"], ["loss"], ["population", "sd"], ["slopes", *parts[3:4]])
    several = (
        ["model"],
        *(["parameters", *number, *keys] for keys in of_parameter),
        ["noise", *number, "prior"],
        ["error", *number],
    )
    for parent in several:
        kind = len(parent)
        if parts[:kind] == parent:
            return parts[:kind] + parts[kind + 1 :]
    return parts
