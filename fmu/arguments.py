"""Check that the arguments of public functions and classes match their annotations.

`check_arguments` wraps a public function or the constructor of a public class. The annotations are the rules:
``float`` requires a finite number, ``Positive`` a positive number, ``Literal`` one of the listed words, and
``Sequence[Parameter]`` a sequence of parameters. A string in the metadata of ``Annotated`` is advice that is
appended to the error message. Rules that annotations cannot express, such as that an upper bound must exceed a
lower bound, are checked by the function itself.
"""

from __future__ import annotations

import builtins
import inspect
import os
import warnings
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from functools import cache, wraps
from pathlib import Path
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
"""Function that loads an object, by the object's class; an error message names it if a path was given instead."""


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
    """Raised for an invalid argument or file key; its message is ``key: rule (got value)``, then advice.

    Attributes
    ----------
    key : str
        The argument or key, with parts separated by dots, as in ``frequencies_hz.2``; empty if the error does not
        concern a single key.
    rule : str
        The rule that the value must satisfy.
    value : str
        The value received, as shown in the message; empty if it is not shown.
    advice : str
        The rest of the message, such as how to correct the error.
    """

    def __init__(self, key: str, rule: str, value: object = "", advice: str = "") -> None:
        self.key, self.rule, self.value, self.advice = key, rule, str(value), advice
        super().__init__(key, rule, self.value, advice)  # these arguments allow pickling

    def __str__(self) -> str:
        got = f" (got {self.value})" if self.value else ""
        return f"{self.key}{': ' * bool(self.key)}{self.rule}{got}{self.advice}"

    @classmethod
    def of(cls, error: Exception) -> ArgumentError:
        """Return `error` as an ArgumentError. Any other exception's message becomes a rule with an empty key."""
        return error if isinstance(error, ArgumentError) else ArgumentError("", str(error))

    def at(self, key: str) -> Self:
        """Return a copy of the error with another key."""
        return type(self)(key, self.rule, self.value, self.advice)

    def under(self, place: str) -> Self:
        """Return a copy of the error with `place` put before its key.

        With the place ``parameters.1``, the key ``lower`` becomes ``parameters.1.lower``.
        """
        return self.at(".".join(filter(None, (place, self.key))))

    def replace_key(self, old: str, new: str) -> Self:
        """Return the error with `old` replaced by `new` at the beginning of its key.

        An error whose key does not begin with `old` is returned unchanged.
        """
        rest = f"{self.key}.".removeprefix(f"{old}.")
        return self if rest == f"{self.key}." else self.at(rest[:-1]).under(new)


def first_repeated(values: Sequence[Hashable]) -> int | None:
    """Return the index of the first value that is equal to an earlier one, or None if all values differ."""
    seen: set[Hashable] = set()
    for i, value in enumerate(values):
        if value in seen:
            return i
        seen.add(value)
    return None


class MissingFileError(ArgumentError, FileNotFoundError):
    """Raised if a file named by an argument, or by a key in another file, does not exist or cannot be read."""

    __new__ = FileNotFoundError.__new__  # type: ignore[assignment]  # its instances are larger than those of ValueError


class _ByName(type):
    """Metaclass of stand-ins for classes that are imported only for type checking.

    A stand-in recognises instances by the name of their class or of a base class.
    """

    def __instancecheck__(cls, instance: object) -> bool:
        return any(one.__name__ == cls.__name__ for one in type(instance).__mro__)

    def __getattr__(cls, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return _ByName(name, (), {})

    def __getitem__(cls, of: object) -> type:
        return cls


class _Names(dict[str, object]):
    """Namespace in which annotations are evaluated: module globals, builtins, `fmu.types` and stand-ins."""

    def __missing__(self, name: str) -> object:
        if name in vars(builtins):
            return vars(builtins)[name]
        from fmu import types  # imported here because it imports NumPy, which most rules do not need

        return vars(types)[name] if name in vars(types) else _ByName(name, (), {})


def check_arguments[Door: Callable[..., object]](door: Door) -> Door:
    """Wrap a function or class so that every call checks its arguments against their annotations.

    An invalid argument raises a ValueError ``name: must be … (got …)``. A missing or unexpected argument raises a
    TypeError, as usual in Python. Arguments without an annotation, ``*args`` and ``**kwargs`` are not checked.
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
            return door(*args, **kwargs)  # raises the TypeError
        for name, value in given.items():
            if name in rules:
                _require(name, value, rules[name])
        return door(*args, **kwargs)

    return call  # type: ignore[return-value]


class OldNameWarning(FutureWarning):
    """Warns about an argument or a file key that has been renamed."""


def with_present_names(given: Mapping[str, Any], present: Mapping[str, str]) -> dict[str, Any]:
    """Return arguments, or a table from a file, with old names replaced by present names.

    An `OldNameWarning` is given for each name that is replaced. An old name is left as it is if its present name
    is also given.
    """
    old = [name for name in present if name in given and present[name] not in given]
    for name in old:
        text = f"{name} is now called {present[name]}: the old name still works; please replace it"
        warnings.warn(text, OldNameWarning, skip_file_prefixes=(f"{Path(__file__).parent}{os.sep}",))
    return {present[name] if name in old else name: value for name, value in given.items()}


def takes_old_names[Door: type](**present: str) -> Callable[[Door], Door]:
    """Return a class decorator that makes a constructor accept the old names of keyword arguments too.

    `present` maps each old name to the present one. An old name causes an `OldNameWarning`.
    """

    def decorate(door: Door) -> Door:
        init = door.__init__  # type: ignore[misc]

        @wraps(init)
        def call(self: object, *args: object, **kwargs: object) -> None:
            init(self, *args, **with_present_names(kwargs, present))

        door.__init__ = call  # type: ignore[misc]
        return door

    return decorate


def require(name: str, value: object, rule: object) -> None:
    """Raise ValueError unless a value conforms to an annotation."""
    _require(name, value, Rule.of(rule))


def _require(name: str, value: object, rule: Rule) -> None:
    mistake = _mistake(name, value, rule)
    if mistake is not None:
        raise mistake


def as_list[One](given: One | Sequence[One]) -> list[One]:
    """Return one value, or a sequence of values, as a list. A string or an array counts as one value."""
    if isinstance(given, Sequence) and not isinstance(given, str):
        return list(given)
    return [given]


def shown(value: object) -> str:
    """Format a value for a message, in one line of at most 80 characters. If its `repr` fails, name its type."""
    try:
        text = " ".join(repr(value).split())
    except Exception:  # whatever the user's own __repr__ raises
        text = f"a {type(value).__name__}"
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


@cache
def _rules(door: FunctionType) -> tuple[inspect.Signature, dict[str, Rule]]:
    """Return a function's signature, and the rules of its annotated arguments, keyed by name."""
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
    """Return the error if a value breaks a rule, or None if it does not."""
    rule = _with_text_as_path(rule)
    found = _check(name, value, rule)
    if found is True:
        return None
    return found or ArgumentError(name, f"must be {in_words(rule)}", shown(value), _advice(value, rule))


def _check(name: str, value: object, rule: Rule) -> ArgumentError | bool:
    """Return True if a value follows a rule. Otherwise return the error of its first wrong entry, or False.

    False means that the value as a whole breaks the rule. A value with an `OwnRule` counts as valid, because the
    function checks it itself. No error message is made for a whole value: formatting an array takes long, and the
    message is not needed if the value breaks one option of a union but follows another.
    """
    if rule.pick(OwnRule):
        return True
    if rule.options:
        found = [_check(name, value, _with_text_as_path(one)) for one in rule.options]
        if True in found:
            return True
        # errors in entries of a value of the right kind
        return next((one for one in found if isinstance(one, ArgumentError) and one.key != name), False)
    return is_kind(value, rule) and next(filter(None, _within(name, value, rule)), True)


def _with_text_as_path(rule: Rule) -> Rule:
    """Return the rule without ``str`` in a union with a path, so that text is checked as a path."""
    if not any(one.origin in PATHS for one in rule.options) or rule.pick(OwnRule):
        return rule
    kinds = tuple(one for one in get_args(rule.form) if one is not str)
    return rule if len(kinds) == len(rule.options) else Rule(Union[kinds])  # noqa: UP007


def _within(name: str, value: Any, rule: Rule) -> Iterator[ArgumentError | None]:
    """Yield an error for each wrong entry or key of a sequence or mapping, and for a tuple of the wrong length.

    Yield None for an entry that follows its rule.
    """
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
    """Return the advice for a value, preceded by a semicolon, or an empty string if there is none."""
    said = rule.pick(str)
    if isinstance(value, str | os.PathLike):
        names = [name_of(one.form) for one in rule.options or [rule]]
        loads = [_FILES[name] for name in names if name in _FILES]
        said += [f"load it first with {load}({os.fspath(value)!r})" for load in loads[:1]]
    return "".join(f"; {one}" for one in said)
