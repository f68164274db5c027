"""Checks of arguments at the public doors: every argument is what its annotation says, before anything is done.

`check_arguments` wraps a public function, or the constructor of a public class. Its annotations are the rules:
``float`` is a finite number, ``Positive`` a positive one, ``Literal`` one of its words, and
``Sequence[Parameter]`` a sequence of parameters. A string among the marks of ``Annotated`` is advice for whoever
breaks the rule. What annotations cannot say, such as that an upper bound exceeds a lower one, is left to the
function.
"""

from __future__ import annotations

import builtins
import inspect
import math
import numbers
import operator
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, wraps
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar, Union, get_args, get_origin

from annotated_types import Ge, Interval

from fmu.numbers import significant

_LONGEST = 80
_FILES = {
    "LogDensity": "fmu.load",
    "UpdatingProblem": "fmu.load",
    "DataTree": "fmu.load_trace",
}
"""How to load an object whose file is given in its place."""
_NAMES = {"DataTree": "a trace, as fmu.sample and fmu.load_trace return it"}


@dataclass(frozen=True)
class Unbounded:
    """Mark of a number that may be infinite, such as a bound."""


@dataclass(frozen=True)
class OwnRule:
    """Mark of an argument that the function itself compares with its rule, in words of its own."""


Bound = Annotated[float, Unbounded()]
"""A number or ±∞."""
Count = Annotated[int, Ge(1)]
Chains = Annotated[int, Interval(ge=1, le=100_000)]
Draws = Annotated[int, Interval(ge=1, le=1_000_000_000)]
Seed = Annotated[int, Ge(0)]
Workers = Annotated[int, Interval(ge=1, le=10_000)]


if TYPE_CHECKING:
    Place = Any
else:
    Place = int | str
    """A node: its number, or its name until nodes are numbered."""


class ArgumentError(ValueError):
    """A value that breaks a rule, of an argument or of a key in a file: ``key: rule (got value)`` and advice.

    Attributes
    ----------
    key : str
        The argument or key, with dots before its parts, as in ``frequencies_hz.2``; empty if the error is in no
        single one.
    rule : str
        What the value must be.
    value : str
        The value received, as the message shows it; empty if the message shows none.
    advice : str
        The rest of the message, such as what to do.
    """

    def __init__(self, key: str, rule: str, value: object = "", advice: str = "") -> None:
        self.key, self.rule, self.value, self.advice = key, rule, str(value), advice
        super().__init__(key, rule, self.value, advice)  # with these a copy is made in another process

    def __str__(self) -> str:
        got = f" (got {self.value})" if self.value else ""
        return f"{self.key}{': ' * bool(self.key)}{self.rule}{got}{self.advice}"

    @classmethod
    def of(cls, error: Exception) -> ArgumentError:
        """Return an error as a record; the text of an error of another kind becomes the rule of no key."""
        return error if isinstance(error, ArgumentError) else ArgumentError("", str(error))

    def at(self, key: str) -> Self:
        """Return the error of another key."""
        return type(self)(key, self.rule, self.value, self.advice)

    def under(self, place: str) -> Self:
        """Return the error with its key below a place: ``lower`` under ``parameters.1``."""
        return self.at(".".join(filter(None, (place, self.key))))

    def replace_key(self, old: str, new: str) -> Self:
        """Return the error with another key in place of an old one, also where the old one is the first part."""
        rest = f"{self.key}.".removeprefix(f"{old}.")
        return self if rest == f"{self.key}." else self.at(rest[:-1]).under(new)


class MissingFileError(ArgumentError, FileNotFoundError):
    """A file that does not exist or cannot be read, named by an argument or a key in a file."""

    __new__ = FileNotFoundError.__new__  # type: ignore[assignment]  # its objects are larger than a ValueError's


class Numbers:
    """The rule for ArrayLike and arrays: any value that NumPy turns into an array of numbers."""


class _ByName(type):
    """A class that is not imported, as only type checkers need it: its instances are known by its name."""

    def __instancecheck__(cls, instance: Any) -> bool:
        return any(one.__name__ == cls.__name__ for one in type(instance).__mro__)

    def __getattr__(cls, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return _ByName(name, (), {})

    def __getitem__(cls, of: Any) -> type:
        return cls


class _Names(dict[str, Any]):
    """The names in an annotation: its module's, Python's, fmu's types, and stand-ins for the rest."""

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            return getattr(builtins, name)
        from fmu import types  # it takes NumPy, which rules of words and whole numbers do without

        return getattr(types, name) if hasattr(types, name) else _ByName(name, (), {})


def check_arguments[Door: Callable[..., Any]](door: Door) -> Door:
    """Return a function or class whose arguments are compared with their annotations at every call.

    What it then raises is a ValueError ``name: must be … (got …)``. Arguments that are missing, or that there are
    none of, stay Python's TypeErrors.
    """
    if inspect.isclass(door):
        door.__init__ = check_arguments(door.__init__)  # type: ignore[method-assign]
        return door

    @wraps(door)
    def call(*args: Any, **kwargs: Any) -> Any:
        signature, rules = _rules(door)
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:
            return door(*args, **kwargs)  # which says what is missing
        for name, value in given.items():
            if name in rules:
                require(name, value, rules[name])
        return door(*args, **kwargs)

    return call  # type: ignore[return-value]


def require(name: str, value: Any, rule: Any) -> None:
    """Raise ValueError unless a value is what an annotation says."""
    mistake = _mistake(name, value, rule)
    if mistake is not None:
        raise mistake


def shown(value: Any) -> str:
    """Return a value for a message: one line of at most 80 characters."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # whatever the user's own __repr__ raises
        text = f"a {type(value).__name__}"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


@cache
def _rules(door: Callable[..., Any]) -> tuple[inspect.Signature, dict[str, Any]]:
    """Return the signature of a function, and the annotation of each argument that has a rule."""
    signature = inspect.signature(door)
    arrays = dict.fromkeys(("ArrayLike", "FloatArray", "IntArray"), Numbers)
    names = _Names({"os": os} | door.__globals__ | arrays)
    rules = {}
    for name, parameter in signature.parameters.items():
        rule = parameter.annotation
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD) or rule is parameter.empty:
            continue
        rules[name] = eval(rule, {}, names) if isinstance(rule, str) else rule
    return signature, rules


def _mistake(name: str, value: Any, rule: Any) -> ArgumentError | None:
    """Return how a value breaks a rule; None if it does not."""
    marks: tuple[Any, ...] = ()
    if get_origin(rule) is Annotated:
        rule, *more = get_args(rule)
        marks = tuple(more)
    if any(isinstance(mark, OwnRule) for mark in marks):
        return None
    if get_origin(rule) in (Union, UnionType):
        options = get_args(rule)
        if str in options and any(_is_path_rule(one) for one in options):  # text is then a path, too
            return _mistake(name, value, Union[tuple(one for one in options if one is not str)])  # noqa: UP007
        found = [_mistake(name, value, Annotated[(one, *marks)] if marks else one) for one in get_args(rule)]
        if None in found:
            return None
        within = [
            one for one in found if one is not None and one.key != name
        ]  # of an entry, where the kind is right
        if within:
            return within[0]
    elif _is_kind(value, rule, marks):
        return next(filter(None, _within(name, value, rule)), None)
    words = _in_words(Annotated[(rule, *marks)] if marks else rule)
    return ArgumentError(name, f"must be {words}", shown(value), _advice(value, rule, marks))


def _is_kind(value: Any, rule: Any, marks: tuple[Any, ...] = ()) -> bool:
    """Return whether a value is of the kind of a rule that is no union, whatever its entries are."""
    origin = get_origin(rule) or rule
    if origin is Any or isinstance(origin, TypeVar):
        return True
    if origin is None or origin is NoneType:
        return value is None
    if origin is Literal:
        return isinstance(value, str | int) and value in get_args(rule)
    if origin is float or origin is int:
        return _is_number(value, origin is int, marks)
    if origin is str:
        return isinstance(value, str) and "\0" not in value
    if _is_path_rule(rule):
        return isinstance(value, str | os.PathLike) and "\0" not in (text := os.fspath(value)) and text != ""
    if origin is bool:
        return isinstance(value, bool) or type(value).__name__ == "bool"  # NumPy's
    if origin is Numbers:
        return _is_numeric(value, marks)
    if origin in (Sequence, tuple, list):
        return _is_sequence(value)
    if origin in (Collection, Iterable):
        return isinstance(value, origin) and not isinstance(value, str | bytes)
    if origin is Callable:
        return callable(value)
    if not isinstance(origin, type):
        return True
    if origin.__name__ == "LogDensity":  # a gradient is not needed by all samplers
        return hasattr(value, "log_prob") and hasattr(value, "ndim")
    if isinstance(value, type):  # a class in place of its object
        return origin is type
    if getattr(origin, "_is_protocol", False) and not getattr(origin, "_is_runtime_protocol", False):
        return all(hasattr(value, member) for member in origin.__protocol_attrs__)  # type: ignore[attr-defined]
    return isinstance(value, origin)


def _within(name: str, value: Any, rule: Any) -> Iterator[ArgumentError | None]:
    """Yield how entries of a sequence or a mapping break their rules, None for one that does not."""
    origin, of = get_origin(rule), get_args(rule)
    if origin is tuple and of and of[-1] is not Ellipsis:
        if len(value) != len(of):
            yield ArgumentError(name, f"must have {len(of)} entries", shown(value))
            return
        for i, (entry, one) in enumerate(zip(value, of, strict=True)):
            yield _mistake(f"{name}.{i}", entry, one)
    elif origin in (Sequence, tuple, list, Collection) and of:
        for i, entry in enumerate(value):
            yield _mistake(f"{name}.{i}", entry, of[0])
    elif origin is Mapping:
        for key, entry in value.items():
            if _mistake(name, key, of[0]):
                yield ArgumentError(f"{name}.{key}", f"must have a key that is {_in_words(of[0])}", shown(key))
            yield _mistake(f"{name}.{key}", entry, of[1])


def _is_number(value: Any, whole: bool, marks: tuple[Any, ...]) -> bool:
    """Return whether a value is a number, whole if need be, in the range of the marks."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral if whole else numbers.Real):
        return False
    try:
        number = float(value)
    except OverflowError:
        return False
    if math.isnan(number) or (math.isinf(number) and not any(isinstance(one, Unbounded) for one in marks)):
        return False
    return all(_is_in_range(number, one) for one in _limits(marks))


def _limits(marks: tuple[Any, ...]) -> Iterator[Any]:
    for mark in marks:
        yield from mark if isinstance(mark, Interval) else (mark,)


def _is_in_range(number: float, limit: Any) -> bool:
    within = {"gt": operator.gt, "ge": operator.ge, "lt": operator.lt, "le": operator.le}
    return all(holds(number, getattr(limit, key)) for key, holds in within.items() if hasattr(limit, key))


def _is_path_rule(rule: Any) -> bool:
    return (get_origin(rule) or rule) in (os.PathLike, Path)


def _is_numeric(value: Any, marks: tuple[Any, ...]) -> bool:
    """Return whether NumPy makes an array of numbers of a value, without words or truth values for numbers."""
    import numpy as np

    if isinstance(value, str | bytes | Mapping | set | frozenset | type | None):
        return False
    try:
        array = np.asarray(value)
        if array.dtype.kind == "O":
            if any(one is None or isinstance(one, str) for one in array.ravel()):
                return False
            array = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return False
    if array.dtype.kind not in "iuf":
        return False
    return not marks or (array.size > 0 and all(_is_number(one, False, marks) for one in array.ravel().tolist()))


def _is_sequence(value: Any) -> bool:
    if isinstance(value, str | bytes | Mapping):
        return False
    if getattr(value, "ndim", 1) == 0:
        return False
    return isinstance(value, Sequence) or (hasattr(value, "__len__") and hasattr(value, "__getitem__"))


_KINDS = {
    float: "a finite number",
    int: "a whole number",
    bool: "True or False",
    str: "text",
    NoneType: "None",
    None: "None",
    Numbers: "numbers (an array or a list)",
    Mapping: "a mapping",
    Callable: "a function",
    os.PathLike: "a path",
    Path: "a path",
}


def _in_words(rule: Any) -> str:
    """Return a rule in words: ``"a positive finite number or None"``."""
    marks: tuple[Any, ...] = ()
    if get_origin(rule) is Annotated:
        rule, *more = get_args(rule)
        marks = tuple(more)
    origin = get_origin(rule) or rule
    if origin in (Union, UnionType):
        parts = [_in_words(Annotated[(one, *marks)] if marks else one) for one in get_args(rule)]
        parts = list(dict.fromkeys(parts))
        return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} or {parts[-1]}"
    if origin is Literal:
        return f"one of {', '.join(map(repr, get_args(rule)))}"
    if origin in (float, int):
        return _number_in_words(origin is int, marks)
    if origin is Numbers and marks:
        return f"{_number_in_words(False, marks).removeprefix('a ')}s, in an array or a list"
    if origin in (Sequence, tuple, list, Collection, Iterable):
        of = get_args(rule)
        return f"a sequence, each entry {_in_words(of[0])}" if of else "a sequence"
    if origin in _KINDS:
        return _KINDS[origin]
    name = getattr(origin, "__name__", str(origin))
    return _NAMES.get(name) or f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"


def _number_in_words(whole: bool, marks: tuple[Any, ...]) -> str:
    limits = list(_limits(marks))
    kind = "whole number" if whole else "number"
    if not whole and not any(isinstance(one, Unbounded) for one in marks):
        kind = "finite number"
    if any(getattr(one, "gt", None) == 0 for one in limits):
        kind = f"positive {kind}"
    words = {"gt": "above", "ge": "of at least", "lt": "below", "le": "of at most"}
    ranges = [
        f"{word} {significant(getattr(one, key))}"
        for one in limits
        for key, word in words.items()
        if hasattr(one, key) and not (key == "gt" and one.gt == 0)
    ]
    return f"a {kind}{' ' * bool(ranges)}{' and '.join(ranges)}"


def _advice(value: Any, rule: Any, marks: tuple[Any, ...]) -> str:
    """Return the advice, after a semicolon; nothing if there is none."""
    said = [mark for mark in marks if isinstance(mark, str)]
    if isinstance(value, str | os.PathLike):
        options = get_args(rule) if get_origin(rule) in (Union, UnionType) else (rule,)
        loads = [_FILES[name] for one in options if (name := getattr(one, "__name__", "")) in _FILES]
        said += [f"load it first with {load}({os.fspath(value)!r})" for load in loads[:1]]
    return "".join(f"; {one}" for one in said)
