"""Derive rules from type annotations, check values against them, and describe the rules in messages."""

from __future__ import annotations

import math
import numbers
import operator
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Protocol, Union, get_args, get_origin, runtime_checkable

from annotated_types import Ge, Gt, Interval, Le, Lt

from fmu.numbers import significant

_NAMES = {"DataTree": "a trace, as fmu.sample and fmu.load_trace return it"}


@dataclass(frozen=True)
class Unbounded:
    """Annotation metadata for a number that may be infinite, such as a bound."""


@dataclass(frozen=True)
class OwnRule:
    """Annotation metadata for an argument that the function itself checks, with its own message."""


class Numbers:
    """The type that replaces ``ArrayLike``, ``FloatArray`` and ``IntArray`` in rules.

    A value follows such a rule if NumPy converts it to an array of real numbers. Text, None and booleans are not
    accepted.
    """


@dataclass(frozen=True)
class Rule:
    """A rule for a value: the type in an annotation, and the metadata of ``Annotated``."""

    form: object
    marks: tuple[object, ...] = ()

    @classmethod
    def of(cls, annotation: object, marks: tuple[object, ...] = ()) -> Rule:
        """Return the rule of an annotation, with `marks` appended to its metadata."""
        if get_origin(annotation) is Annotated:
            annotation, *own = get_args(annotation)
            marks = (*own, *marks)
        return cls(annotation, marks)

    @cached_property
    def origin(self) -> Any:
        """The type without its parameters."""
        return get_origin(self.form) or self.form

    @cached_property
    def options(self) -> list[Rule]:
        """Rules of a union's members, at least one of which must hold. Empty if the type is not a union."""
        is_union = self.origin in (Union, UnionType)
        return [Rule.of(one, self.marks) for one in get_args(self.form)] if is_union else []

    @cached_property
    def parts(self) -> list[Rule]:
        """Rules of the type parameters, such as the rule for the entries of a sequence."""
        return [Rule.of(one) for one in get_args(self.form)]

    def pick[Mark](self, *kinds: type[Mark]) -> list[Mark]:
        """Return the metadata that are instances of the given classes."""
        return [mark for mark in self.marks if isinstance(mark, kinds)]

    @cached_property
    def limits(self) -> list[tuple[str, float]]:
        """Limits on a number, as pairs of comparison and value, such as ``("gt", 0.0)``."""
        marks: list[Gt | Ge | Lt | Le | Interval] = self.pick(Gt, Ge, Lt, Le, Interval)
        return [(key, end) for mark in marks for key, end in asdict(mark).items() if end is not None]


def is_kind(value: Any, rule: Rule) -> bool:
    """Return True if a value follows a rule that is not a union. The entries of a sequence are not checked."""
    origin = rule.origin
    if origin is Any:
        return True
    if origin in _KINDS:
        kind = _KINDS[origin]
        is_of_class = isinstance(value, kind.classes) and not isinstance(value, kind.others)
        return is_of_class and kind.holds(value, rule)
    if not isinstance(origin, type):
        return True
    members = vars(origin).get("__protocol_attrs__")
    if origin.__name__ == "LogDensity":  # not all samplers need a gradient
        members = ("log_prob", "ndim")
    elif isinstance(value, type):  # a class instead of an instance
        return origin is type
    return all(hasattr(value, member) for member in members) if members else isinstance(value, origin)


def _is_in_range(value: float, rule: Rule) -> bool:
    """Return True if a number is representable as a float, and within the limits of the rule.

    NaN is not in range, and infinity only if the rule has `Unbounded`.
    """
    try:
        number = float(value)
    except OverflowError:
        return False
    if math.isnan(number) or (math.isinf(number) and not rule.pick(Unbounded)):
        return False
    within = {"gt": operator.gt, "ge": operator.ge, "lt": operator.lt, "le": operator.le}
    return all(within[key](number, end) for key, end in rule.limits)


def _is_numeric(value: object, rule: Rule) -> bool:
    """Return True if NumPy converts a value to an array of numbers within the limits of the rule.

    Text, None and booleans are not accepted as numbers. If the rule has limits, the array must not be empty.
    """
    import numpy as np

    try:
        array = np.asarray(value)
        items = () if hasattr(value, "dtype") else np.asarray(value, dtype="O").ravel()
        if any(type(one) in (bool, np.bool_) for one in items):
            return False
        if array.dtype.kind == "O":
            if any(isinstance(one, str | None) for one in array.ravel()):
                return False
            array = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return False
    if array.dtype.kind not in "iuf":
        return False
    return not rule.marks or (array.size > 0 and all(_is_in_range(one, rule) for one in array.ravel().tolist()))


@runtime_checkable
class _Indexed(Protocol):
    """A sequence, or another object that can be indexed like one, such as an array."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int) -> object: ...


class _Kind(NamedTuple):
    """A type's description in words, and the test for its values.

    A value must be an instance of one of `classes` but of none of `others`, and `holds` must return True.
    """

    words: str
    classes: tuple[type, ...] = (object,)
    others: tuple[type, ...] = ()
    holds: Callable[..., bool] = lambda value, rule: True


def _is_path(value: str | os.PathLike[str], rule: Rule) -> bool:
    text = os.fspath(value)
    return "\0" not in text and text != ""


def _has_entries(value: object, rule: Rule) -> bool:
    return getattr(value, "ndim", 1) != 0


PATHS = (os.PathLike, Path)
_SEQUENCES = (Sequence, tuple, list)
_KINDS = {
    int: _Kind("a whole number", (numbers.Integral,), (bool,), _is_in_range),
    float: _Kind("a finite number", (numbers.Real,), (bool,), _is_in_range),
    bool: _Kind("True or False", holds=lambda value, rule: type(value).__name__ == "bool"),  # NumPy's too
    str: _Kind("text", (str,), holds=lambda value, rule: "\0" not in value),
    Literal: _Kind("a word", (str, int), holds=lambda value, rule: value in get_args(rule.form)),
    Numbers: _Kind("numbers (an array or a list)", holds=_is_numeric),
    Mapping: _Kind("a mapping", (Mapping,)),
    Callable: _Kind("a function", holds=lambda value, rule: callable(value)),
}
_KINDS |= dict.fromkeys((None, NoneType), _Kind("None", (NoneType,)))
_KINDS |= dict.fromkeys(PATHS, _Kind("a path", (str, os.PathLike), holds=_is_path))
_KINDS |= {one: _Kind("a sequence", (one,), (str, bytes)) for one in (Collection, Iterable)}
_KINDS |= dict.fromkeys(_SEQUENCES, _Kind("a sequence", (_Indexed,), (str, bytes, Mapping), _has_entries))


def in_words(rule: Rule) -> str:
    """Describe a rule in words, such as ``"a positive finite number or None"``."""
    origin, of = rule.origin, rule.parts
    if rule.options:
        parts = list(dict.fromkeys(map(in_words, rule.options)))
        return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} or {parts[-1]}"
    if origin is Literal:
        return f"one of {', '.join(map(repr, get_args(rule.form)))}"
    if origin in (float, int):
        return _number_in_words(origin is int, rule)
    if origin is Numbers and rule.marks:
        return f"{_number_in_words(False, rule).removeprefix('a ')}s, in an array or a list"
    if origin in (*_SEQUENCES, Collection, Iterable) and of:
        return f"a sequence, each entry {in_words(of[0])}"
    if origin in _KINDS:
        return _KINDS[origin].words
    name = name_of(origin)
    return _NAMES.get(name) or f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"


def name_of(kind: object) -> str:
    """Return the name of a class, or the text of a type without a name."""
    return getattr(kind, "__name__", str(kind))


def _number_in_words(whole: bool, rule: Rule) -> str:
    limits = rule.limits
    kind = "whole number" if whole else "number" if rule.pick(Unbounded) else "finite number"
    if ("gt", 0) in limits:
        kind = f"positive {kind}"
    words = {"gt": "above", "ge": "of at least", "lt": "below", "le": "of at most"}
    ranges = [f"{words[key]} {significant(end)}" for key, end in limits if (key, end) != ("gt", 0)]
    return f"a {kind}{' ' * bool(ranges)}{' and '.join(ranges)}"
