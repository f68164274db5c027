"""Report all errors in a problem file at once, each with its location, the broken rule and the value received."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fmu.arguments import ArgumentError, Place
from fmu.formats.shown import list_mistakes, quote

if TYPE_CHECKING:
    from pydantic import ValidationError
    from pydantic_core import ErrorDetails

    from fmu.fem.modes.separable import SeparableModel

_NAME = r"[^\W\d]\w*"
FUNCTION = rf"^{_NAME}(\.{_NAME})*:{_NAME}(\.{_NAME})*$"
"""Pattern of ``module:function``."""
PYTHON_FILE = rf"^{_NAME}\.py$"
LONGEST_KEY = 40
_PATTERNS = {
    r"^[^/\x00-\x1f]+$": "must have no slash, line break or other control character",
    r"^[^\x00-\x1f]+$": "must have no line break or other control character",
    r"^\d{1,9}$": "must be the number of a node, of at most 9 digits",
    PYTHON_FILE: "must be a Python file beside this one, as portal.py",
    FUNCTION: 'must be "module:function", as in "storeys:modes"',
}
"""The rule, in words, for each string pattern."""


class BrokenError(Exception):
    """Raised when part of the problem cannot be built; `mistakes` is a tuple of the errors found."""

    def __init__(self, *mistakes: ArgumentError) -> None:
        self.mistakes = mistakes
        super().__init__(*mistakes)

    def __str__(self) -> str:
        return "; ".join(map(str, self.mistakes))


class Mistakes(list[ArgumentError]):
    """Collects errors in a problem file, so that all are reported together."""

    def add(self, key: str, rule: str, value: object = "") -> None:
        """Append an error at a key in the file: the rule that is broken, and the value received."""
        self.append(ArgumentError(key, rule, value))


class ConfigurationError(ValueError):
    """Raised when a problem file cannot be used.

    Attributes
    ----------
    source : str
        Name of the file.
    mistakes : tuple of ArgumentError
        All errors found in the file.
    """

    def __init__(self, source: str, mistakes: Sequence[ArgumentError]) -> None:
        self.source, self.mistakes = source, tuple(mistakes)
        super().__init__(source, self.mistakes)

    @property
    def headline(self) -> str:
        """Phrase with the file name and the number of errors."""
        n = len(self.mistakes)
        return f"{self.source}: {n} error{'s' if n > 1 else ''}"

    def __str__(self) -> str:
        return "\n".join([f"{self.headline}:", *(f"  {line}" for line in list_mistakes(self.mistakes))])


def place(parts: Sequence[int | str]) -> str:
    """Return a location in the file as dotted keys and indices, with long keys shortened."""
    return ".".join(
        str(part) if len(str(part)) <= LONGEST_KEY else f"{str(part)[:LONGEST_KEY]}…" for part in parts
    )


def of_validation(error: ValidationError) -> list[ArgumentError]:
    """Return pydantic's validation errors as a list of ArgumentErrors."""
    return [_of_one(one) for one in error.errors(include_url=False)]


def _of_one(error: ErrorDetails) -> ArgumentError:
    where = place(_in_the_file(error["loc"]))
    kind, value = error["type"], quote(error["input"])
    if kind == "extra_forbidden":
        return ArgumentError(where, "is not a known key")
    if kind == "missing":
        return ArgumentError(where, "is missing")
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        return _of_tag(where, error)
    if kind == "string_pattern_mismatch":
        return ArgumentError(where, _PATTERNS.get(error["ctx"]["pattern"], _as_rule(error["msg"])), value)
    if kind == "value_error":
        return ArgumentError.of(error["ctx"]["error"]).under(where)
    if kind == "kind":
        return ArgumentError(where, error["msg"], value)
    return ArgumentError(where, _as_rule(error["msg"]), value)


def _as_rule(message: str) -> str:
    """Reword a pydantic message ``Input should be …`` as the rule ``must be …``. Other messages stay the same."""
    subject, should, rest = message.partition(" after validation")[0].partition(" should ")
    return f"must {rest}" if should and subject in ("Input", "String", "List", "Dictionary") else message


def _of_tag(where: str, error: ErrorDetails) -> ArgumentError:
    """Return the error for a missing or invalid key that selects a table's kind."""
    context = error["ctx"]
    where = f"{where}.{context['discriminator'].strip("'")}"
    if "tag" not in context:
        return ArgumentError(where, "is missing")
    known = ", ".join(tag.strip("'") for tag in context["expected_tags"].split(", "))
    return ArgumentError(where, f"must be one of {known}", quote(context["tag"]))


def _in_the_file(where: tuple[int | str, ...]) -> list[int | str]:
    """Return a location without the parts that pydantic inserts: the kinds of values and of tables."""
    parts = [part for part in where if not str(part).startswith("<") and part != "[key]"]
    number = parts[1:2]
    of_slope = ["slopes", *parts[3:4]]
    of_law: list[list[int | str]] = [["prior"], ["kinks"], ["priors", *parts[6:7]]]
    of_parameter: list[list[int | str]] = [
        ["prior"],
        ["loss"],
        ["population", "sd"],
        ["population", "between"],
        ["onset", "date"],
        of_slope,
    ]
    of_parameter += [[*of_slope, *keys] for keys in of_law]
    several: list[list[int | str]] = [
        ["model"],
        *[["parameters", *number, *keys] for keys in of_parameter],
        ["noise", *number, "prior"],
        ["error", *number],
        ["damping", *number],
        ["tests", *number, "covariates", *parts[3:4]],
    ]
    for parent in several:
        kind = len(parent)
        if parts[:kind] == parent:
            parts = parts[:kind] + parts[kind + 1 :]
    return parts


def rule_of_sensors(model: SeparableModel | None, node: Place) -> str:
    """Return the rule to report for a sensor that `model` (None for a user's function) does not have."""
    if model is not None:
        nodes = {name for name, _ in (*model.dof_of, *model.motions)} | model.arms.keys()
        if node not in nodes and (model.geometry is None or node not in model.geometry.row_of):
            return "must be at a place that exists in the model"
    return "must be a point and a direction that are free to move"
