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
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache, wraps
from types import FunctionType
from typing import TYPE_CHECKING, Annotated, Any, Self, Union, get_args, get_origin

from annotated_types import Ge, Interval

from fmu.rules import PATHS, Rule, Unbounded, in_words, is_kind, name_of
from fmu.rules import Numbers as Numbers
from fmu.rules import OwnRule as OwnRule

_LONGEST = 80
_FILES = {
    "LogDensity": "fmu.load",
    "UpdatingProblem": "fmu.load",
    "DataTree": "fmu.load_trace",
}
"""How to load an object whose file is given in its place."""


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


class _ByName(type):
    """A class that is not imported, as only type checkers need it: its instances are known by its name."""

    def __instancecheck__(cls, instance: object) -> bool:
        return any(one.__name__ == cls.__name__ for one in type(instance).__mro__)

    def __getattr__(cls, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return _ByName(name, (), {})

    def __getitem__(cls, of: object) -> type:
        return cls


class _Names(dict[str, object]):
    """The names in an annotation: its module's, Python's, fmu's types, and stand-ins for the rest."""

    def __missing__(self, name: str) -> object:
        if name in vars(builtins):
            return vars(builtins)[name]
        from fmu import types  # it takes NumPy, which rules of words and whole numbers do without

        return vars(types)[name] if name in vars(types) else _ByName(name, (), {})


def check_arguments[Door: Callable[..., object]](door: Door) -> Door:
    """Return a function or class whose arguments are compared with their annotations at every call.

    What it then raises is a ValueError ``name: must be … (got …)``. Arguments that are missing, or that there are
    none of, stay Python's TypeErrors.
    """
    if inspect.isclass(door):
        door.__init__ = check_arguments(door.__init__)  # type: ignore[method-assign]
        return door

    @wraps(door)
    def call(*args: object, **kwargs: object) -> object:
        signature, rules = _rules(door)
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:
            return door(*args, **kwargs)  # which says what is missing
        for name, value in given.items():
            if name in rules:
                _require(name, value, rules[name])
        return door(*args, **kwargs)

    return call  # type: ignore[return-value]


def require(name: str, value: object, rule: object) -> None:
    """Raise ValueError unless a value is what an annotation says."""
    _require(name, value, Rule.of(rule))


def _require(name: str, value: object, rule: Rule) -> None:
    mistake = _mistake(name, value, rule)
    if mistake is not None:
        raise mistake


def shown(value: object) -> str:
    """Return a value for a message: one line of at most 80 characters."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # whatever the user's own __repr__ raises
        text = f"a {type(value).__name__}"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


@cache
def _rules(door: FunctionType) -> tuple[inspect.Signature, dict[str, Rule]]:
    """Return the signature of a function, and the rule of each argument that has one."""
    signature = inspect.signature(door)
    arrays = dict.fromkeys(("ArrayLike", "FloatArray", "IntArray"), Numbers)
    names = _Names({"os": os} | door.__globals__ | arrays)
    rules = {}
    for name, parameter in signature.parameters.items():
        rule = parameter.annotation
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD) or rule is parameter.empty:
            continue
        rules[name] = Rule.of(eval(rule, {}, names) if isinstance(rule, str) else rule)
    return signature, rules


def _mistake(name: str, value: object, rule: Rule) -> ArgumentError | None:
    """Return how a value breaks a rule; None if it does not."""
    if rule.pick(OwnRule):
        return None
    options = rule.options
    if options:
        kinds = get_args(rule.form)
        if str in kinds and any(one.origin in PATHS for one in options):  # text is then a path, too
            return _mistake(name, value, Rule(Union[tuple(one for one in kinds if one is not str)]))  # noqa: UP007
        found = [_mistake(name, value, one) for one in options]
        if None in found:
            return None
        within = [
            one for one in found if one is not None and one.key != name
        ]  # of an entry, where the kind is right
        if within:
            return within[0]
    elif is_kind(value, rule):
        return next(filter(None, _within(name, value, rule)), None)
    return ArgumentError(name, f"must be {in_words(rule)}", shown(value), _advice(value, rule))


def _within(name: str, value: Any, rule: Rule) -> Iterator[ArgumentError | None]:
    """Yield how entries of a sequence or a mapping break their rules, None for one that does not."""
    origin, of = get_origin(rule.form), rule.parts
    if origin is tuple and of and of[-1].form is not Ellipsis:
        if len(value) != len(of):
            yield ArgumentError(name, f"must have {len(of)} entries", shown(value))
            return
        for i, (entry, one) in enumerate(zip(value, of, strict=True)):
            yield _mistake(f"{name}.{i}", entry, one)
    elif origin in (Sequence, tuple, list, Collection) and of:
        for i, entry in enumerate(value):
            yield _mistake(f"{name}.{i}", entry, of[0])
    elif origin is Mapping:
        of_key, of_entry = of
        for key, entry in value.items():
            if _mistake(name, key, of_key):
                yield ArgumentError(f"{name}.{key}", f"must have a key that is {in_words(of_key)}", shown(key))
            yield _mistake(f"{name}.{key}", entry, of_entry)


def _advice(value: object, rule: Rule) -> str:
    """Return the advice, after a semicolon; nothing if there is none."""
    said = rule.pick(str)
    if isinstance(value, str | os.PathLike):
        names = [name_of(one.form) for one in rule.options or [rule]]
        loads = [_FILES[name] for name in names if name in _FILES]
        said += [f"load it first with {load}({os.fspath(value)!r})" for load in loads[:1]]
    return "".join(f"; {one}" for one in said)
