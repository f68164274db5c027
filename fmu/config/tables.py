"""Base classes and builders for the tables in a problem file.

`TomlTable` is the base class of all tables. If a table only collects the arguments of a constructor in this
library, its class is not written by hand: `declare_table` makes it from the constructor's annotations (keys,
types, ranges), defaults and docstring (descriptions). In the file, the value of a key with the type
``Annotated[Material, Of("material", Material)]`` is a table with E, nu and rho; here it is a `Material`.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, Union, get_args, get_origin, get_type_hints

import scipy.sparse as sp
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    StringConstraints,
    Tag,
    create_model,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from fmu.arguments import ArgumentError
from fmu.config.mistakes import BrokenError
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.separable import SeparableModel, separable_in
from fmu.fem.pairing.modal_model import ModalModel
from fmu.formats.matrices.limits import Labelled
from fmu.formats.modes.measured_modes import ModesError, Place
from fmu.formats.shown import quote
from fmu.numbers import names_in_words
from fmu.posterior.parameters import require_name
from fmu.types import NotNegative as NotNegative
from fmu.types import Positive as Positive

Maker = Callable[..., object]
"""A class of this library, or a function that returns an instance of such a class."""

Name = Annotated[str, StringConstraints(min_length=1, max_length=100, pattern=r"^[^/\x00-\x1f]+$")]
"""A name without slashes, because traces use names as paths."""


def _of_parameter(name: str) -> str:
    try:
        require_name(name)
    except ArgumentError as error:
        raise error.at("") from None
    return name


ParameterName = Annotated[Name, AfterValidator(_of_parameter)]
"""The name of a parameter, which must not have another meaning in a trace."""
FileName = Annotated[str, StringConstraints(min_length=1, max_length=1000, pattern=r"^[^\x00-\x1f]+$")]
"""The path of a file, relative to the folder of the TOML file."""
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


class Built(NamedTuple):
    """A model, its largest number of modes, and the node for each place named in the file.

    `place_matrix` brings a matrix from a file to the model's degrees of freedom, if the model was read from files
    too; its second argument is the key that gives the file.
    """

    model: SeparableModel | BlackBoxModel | ModalModel
    places: Mapping[str, Place]
    most_modes: float = math.inf
    place_matrix: Callable[[Labelled, str], sp.csr_array] | None = None

    def at(self, place: Place) -> Place:
        """Return the node for a named place; return any other place unchanged."""
        return self.places.get(str(place), place)

    @property
    def separable(self) -> SeparableModel | None:
        """The model if it has matrices, otherwise None."""
        return separable_in(self.model)


_KIND_OF: dict[type, str] = {
    str: "<text>",
    bool: "<switch>",
    int: "<number>",
    float: "<number>",
    dict: "<table>",
    BaseModel: "<table>",
}


def kind_of(value: object) -> str | None:
    """Return the kind of a TOML value, such as ``<number>``, or None if it has no kind.

    Angle brackets distinguish kinds from keys.
    """
    if isinstance(value, list):
        return "<rows>" if value and kind_of(value[0]) in ("<list>", "<rows>") else "<list>"
    return next((kind for cls, kind in _KIND_OF.items() if isinstance(value, cls)), None)


def build_value(value: Any) -> Any:
    """Return the object described by a table; return any other value unchanged."""
    return value.build() if isinstance(value, Declared) else value


def by_kind(words: str) -> Discriminator:
    """Return a pydantic discriminator that selects a type by the value's kind.

    `words` lists the kinds in messages.
    """
    return Discriminator(kind_of, custom_error_type="kind", custom_error_message=f"must be {words}")


Number = Annotated[Positive, Tag("<number>")]
Numbers = Annotated[list[Positive], Tag("<list>")]
NumberOrNumbers = Annotated[Number | Numbers, by_kind("a number or a list of numbers")]
SensorTable = Annotated[list[int | str], Field(min_length=2, max_length=2)]
"""A sensor: a list of a place and a direction."""


def one_length(what: str) -> AfterValidator:
    """Return a validator that rejects rows with different lengths.

    Its message says that each row has one value per `what`, such as "mode".
    """

    def check(rows: list[list[float]]) -> list[list[float]]:
        lengths = [len(row) for row in rows]
        if len(set(lengths)) > 1:
            raise ArgumentError("", f"must have rows of one length, one value per {what}", quote(lengths))
        return rows

    return AfterValidator(check)


@contextmanager
def reading(where: str) -> Iterator[None]:
    """Within a ``with`` block, raise errors in reading a file as a BrokenError at the key `where`.

    These are invalid contents of a file of modes or FRFs, and missing or unreadable files and libraries. Other
    errors pass.
    """
    try:
        yield
    except ModesError as error:
        raise BrokenError(*(ArgumentError(where, mistake) for mistake in error.mistakes)) from None
    except (OSError, ImportError) as error:
        raise BrokenError(ArgumentError.of(error).replace_key("path", "").under(where)) from None


class TomlTable(BaseModel):
    """Base class for tables in the file. It rejects unknown keys and values of the wrong type.

    The string below a key is its description in the schema that editors show (`fmu.config.problem`).
    """

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class Declared(TomlTable):
    """A table whose keys are the arguments of a constructor, or of one of several; see `declare_table`."""

    model_config = ConfigDict(use_attribute_docstrings=False)  # classes made at run time have no source
    makes: ClassVar[tuple[Maker, ...]] = ()
    tag: ClassVar[str] = ""
    is_complete: ClassVar[bool] = True
    """Whether the table contains all arguments; otherwise some of them are in other tables of the file."""
    renamed: ClassVar[Mapping[str, str]] = {}

    @property
    def called(self) -> str:
        """Kind of the table: the value of the key `tag`."""
        return str(dict(self)[self.tag])

    def given_arguments(self) -> dict[str, object]:
        """Return the constructor arguments given in the file, keyed by name."""
        given = self.model_fields_set - {self.tag}
        return {self.renamed.get(key, key): value for key, value in self if key in given}

    def build(self, **others: object) -> Any:
        """Call the constructor with the arguments in the file and `others`, which take precedence.

        Raises
        ------
        ValueError
            If the keys are not the arguments of one of the constructors, or the constructor rejects the values.
        """
        given = self.given_arguments() | others
        for make in self.makes:
            if required_arguments(make) <= given.keys() <= arguments(make).keys():
                return make(**given)
        raise ArgumentError("", f"must have either {_ways(self.makes)}", quote(list(given)))

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        if self.is_complete:
            self.build()
        return self


def declare_table(
    name: str,
    *makes: Maker,
    tag: str = "",
    in_a_file: Callable[[Any], object] | None = None,
    renamed: Mapping[str, str] | None = None,
) -> type[Declared]:
    """Create a table class whose keys, types, ranges, defaults and descriptions come from a constructor.

    Parameters
    ----------
    name : str
        Name of the table in the schema, and the value of the key `tag`.
    *makes : callable
        Constructors: classes or functions with annotations and a docstring. If there are several, the file gives
        the arguments of one of them.
    tag : str
        Name of an additional key, whose value is the kind of the table.
    in_a_file : callable, optional
        Maps an argument's annotation to the type of its key in the file, for annotations that are not TOML types.
        Returns None for an argument that is not a key.
    renamed : mapping of str to str, optional
        See `Of`.
    """
    described = {key: text for make in makes for key, text in _descriptions(make).items()}
    every = [arguments(make) for make in makes]
    key_of = {argument: key for key, argument in (renamed or {}).items()}
    keys: dict[str, Any] = {tag: (Literal[name], ...)} if tag else {}
    for names in every:
        for argument, (annotation, default) in names.items():
            is_required = all(argument in required_arguments(make) for make in makes)
            if not is_required and default is inspect.Parameter.empty:
                annotation, default = annotation | None, None
            annotation = Name if argument in key_of else (in_a_file or tuple_as_list)(annotation)
            if annotation is not None:
                field = Field(... if is_required else default, description=described.get(argument))
                keys[key_of.get(argument, argument)] = (annotation, field)
    documented = [inspect.getdoc(getattr(make, "__self__", make)) for make in makes]
    about = next(text for text in documented if text).partition("\n\n")[0].removeprefix("Return ")
    about = about[:1].upper() + about[1:]
    if len(makes) > 1:
        about += f" Give either {_ways(makes)}."
    table = create_model(name, __base__=Declared, __doc__=about, **keys)
    table.makes, table.tag, table.renamed, table.is_complete = makes, tag, renamed or {}, in_a_file is None
    return table


class OneOf:
    """A union of tables, selected by the value of a key: ``Annotated[Declared, OneOf("distribution", …)]``.

    Parameters
    ----------
    tag : str
        The key that selects the kind.
    kinds : mapping of str to tuple of callable
        The constructors for each kind, keyed by the value of `tag`; see `declare_table`.
    in_a_file : callable, optional
        See `declare_table`.
    others : sequence of table
        Further kinds, whose tables are not made from constructors.
    """

    def __init__(
        self,
        tag: str,
        kinds: Mapping[str, tuple[Maker, ...]],
        in_a_file: Callable[[Any], object] | None = None,
        others: Sequence[type[Declared]] = (),
    ) -> None:
        self._tag = tag
        self._tables = tuple(
            declare_table(name, *makes, tag=tag, in_a_file=in_a_file) for name, makes in kinds.items()
        ) + tuple(others)

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return handler(Annotated[Union[self._tables], Field(discriminator=self._tag)])  # noqa: UP007


class Of:
    """Annotation for an object that is built from a table: ``Annotated[Material, Of("material", Material)]``.

    Parameters
    ----------
    name : str
        Name of the table in the schema.
    *makes : callable
        See `declare_table`.
    **renamed : str
        Maps a key in the file to the constructor's argument that it replaces. The key's value must be a `Name`.
    """

    def __init__(self, name: str, *makes: Maker, **renamed: str) -> None:
        self._table = declare_table(name, *makes, renamed=renamed)

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(lambda table: table.build(), handler(self._table))


def inside(key: str, make: Maker) -> Maker:
    """Return a constructor whose only argument, named `key`, is built from a table with the arguments of `make`.

    With the key ``tube``, the file contains ``{ tube = { diameter = …, … } }``.
    """

    def take_argument(**given: object) -> object:
        return given[key]

    annotation = Annotated[object, Of(key, make)]
    take_argument.__annotations__ = {key: annotation}
    take_argument.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, annotation=annotation)]
    )
    return take_argument


def with_keys[Table: TomlTable](
    fields: Mapping[str, Any],
) -> Callable[[type[Table]], type[Table]]:
    """Return a decorator that adds keys to a table; `fields` maps key names to types, as in `create_model`."""
    return lambda table: create_model(table.__name__, __base__=table, __doc__=table.__doc__, **fields)


@cache
def required_arguments(make: Maker) -> set[str]:
    """Return the names of a constructor's required arguments."""
    return {key for key, (_, default) in arguments(make).items() if default is inspect.Parameter.empty}


@cache
def arguments(make: Maker) -> dict[str, tuple[Any, object]]:
    """Return the annotation and default of each constructor argument, keyed by name."""
    hints = get_type_hints(make.__init__ if inspect.isclass(make) else make, include_extras=True)
    made = (
        {}
        if not is_dataclass(make)
        else {one.name: one.default_factory() for one in fields(make) if one.default_factory is not MISSING}
    )
    given = inspect.signature(make).parameters
    return {key: (hints[key], made.get(key, argument.default)) for key, argument in given.items()}


def _ways(makes: tuple[Maker, ...]) -> str:
    """Return a phrase that lists, for each constructor, the arguments that not all constructors have."""
    every = [arguments(make) for make in makes]
    ways = [[key for key in names if any(key not in other for other in every)] for names in every]
    return ", or ".join(map(names_in_words, ways))


def _descriptions(make: Maker) -> dict[str, str]:
    """Return the description of each argument, from the docstring's Attributes or Parameters section."""
    text = inspect.getdoc(make) or ""
    section = re.search(r"(?:Attributes|Parameters)\n-+\n(.*?)(?:\n\n|\Z)", text, re.DOTALL)
    entries = re.findall(r"^([\w, ]+?) : .*\n((?:    .*\n?)*)", section[1] if section else "", re.MULTILINE)
    return {key: " ".join(about.split()) for keys, about in entries for key in keys.split(", ") if about.strip()}


def tuple_as_list(annotation: object) -> Any:
    """Return a list type for a tuple type, because TOML has no tuples; return any other type unchanged."""
    parts = get_args(annotation)
    if type(None) in parts and any(get_origin(part) is tuple for part in parts):
        return tuple_as_list(next(part for part in parts if get_origin(part) is tuple)) | None
    if get_origin(annotation) is not tuple:
        return annotation
    item, n = Union[tuple(dict.fromkeys(parts))], len(parts)  # noqa: UP007
    return Annotated[list[item], Field(min_length=n, max_length=n), AfterValidator(tuple)]  # type: ignore[valid-type]


def for_toml(part: dict[str, Any]) -> dict[str, Any]:
    """Return part of the schema, simplified for editors.

    It omits null (which TOML does not have), the titles that pydantic adds, and line breaks in descriptions.
    """
    found: dict[str, Any] = {}
    for key, value in part.items():
        is_text = isinstance(value, str)  # otherwise it is a field with this name
        if (key, value) == ("default", None) or (key == "title" and is_text):
            continue
        if key == "description" and is_text:
            found[key] = " ".join(value.replace("``", "`").split())
        elif key == "anyOf" and {"type": "null"} in value:
            rest = [item for item in value if item != {"type": "null"}]
            found |= rest[0] if len(rest) == 1 else {"anyOf": rest}
        else:
            found[key] = value
    return found
