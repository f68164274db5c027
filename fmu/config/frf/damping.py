"""``[[damping]]``: structural damping, either known or inferred from frequency response functions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import scipy.sparse as sp
from pydantic import Field, Tag

from fmu.arguments import ArgumentError, as_list
from fmu.config.mistakes import BrokenError, Mistakes
from fmu.config.parameters import SETTINGS, ParameterTable
from fmu.config.tables import Built, Declared, FileName, Name, NotNegative, OneOf, by_kind, reading, tuple_as_list
from fmu.formats.matrices.limits import Labelled
from fmu.formats.matrices.read import read_labelled
from fmu.formats.models.assembly import place_matrix
from fmu.formats.models.exported import Rows
from fmu.formats.shown import names_shown, quote
from fmu.posterior.frf.damping import (
    DampingMatrix,
    DampingModel,
    Dashpot,
    ModalDamping,
    RayleighDamping,
    StructuralDamping,
)
from fmu.posterior.parameters import Parameter

_Number = Annotated[NotNegative, Tag("<number>")]
_Named = Annotated[Name, Tag("<text>")]
Amount = Annotated[_Number | _Named, by_kind("a number from 0, or the name of one of the [[parameters]]")]
_Amounts = Annotated[list[Amount], Field(min_length=1), Tag("<list>")]
Amounts = Annotated[
    _Number | _Named | _Amounts,
    by_kind("a number from 0, the name of one of the [[parameters]], or a list of them"),
]
_INFERRED = NotNegative | Parameter
_IN_A_FILE: dict[object, object] = {
    _INFERRED: Amount,
    _INFERRED | Sequence[_INFERRED]: Amounts,
    Mapping[str, _INFERRED]: dict[Name, Amount],
    Any: FileName,
}
_WITHOUT_NAMES = ("at", "to", "matrix")
"""Keys whose text values are not names of parameters."""


def _in_a_file(annotation: object) -> object:
    """Return the TOML type for a damping model argument; a parameter is given by its name."""
    return _IN_A_FILE.get(annotation) or tuple_as_list(annotation)


DampingTable = Annotated[
    Declared,
    OneOf(
        "kind",
        {
            "modal": (ModalDamping,),
            "rayleigh": (RayleighDamping,),
            "structural": (StructuralDamping,),
            "dashpot": (Dashpot,),
            "matrix": (DampingMatrix,),
        },
        _in_a_file,
    ),
]


def names_in(tables: Sequence[Declared]) -> Iterator[tuple[str, str]]:
    """Yield the key and name of each parameter that the damping tables refer to."""
    for i, table in enumerate(tables):
        for key, value in table.given_arguments().items():
            if key not in _WITHOUT_NAMES:
                yield from _names(f"damping.{i}.{key}", value)


def _names(where: str, value: object) -> Iterator[tuple[str, str]]:
    """Yield the key and name of each parameter in `value`: a number, a name, or a list or table of these.

    The key of `value` itself is `where`.
    """
    match value:
        case str():
            yield where, value
        case list():
            for i, one in enumerate(value):
                yield from _names(f"{where}.{i}", one)
        case dict():
            for name, one in value.items():
                yield from _names(f"{where}.{name}", one)


def structural(parameters: Sequence[ParameterTable], damping: Sequence[Declared]) -> list[ParameterTable]:
    """Return the structural parameters: the parameters to which no damping table refers."""
    named = {name for _, name in names_in(damping)}
    return [table for table in parameters if table.name not in named]


def mistakes_of_damping(
    parameters: Sequence[ParameterTable], damping: Sequence[Declared], has_tests: bool
) -> list[ArgumentError]:
    """Return the errors found in the damping tables and parameters.

    Damping parameters may vary between tests only if `has_tests` is True.
    """
    found, known = Mistakes(), [table.name for table in parameters]
    used = {name for _, name in names_in(damping)}
    rule = f"must be the name of one of the [[parameters]]: {names_shown(known)}"
    for where, name in names_in(damping):
        if name not in known:
            found.add(where, rule, quote(name))
    of_structure = [i for i, name in enumerate(known) if name not in used]
    for i, table in enumerate(parameters):
        if table.name not in used:
            continue
        if of_structure and i < of_structure[-1]:
            found.add(f"parameters.{i}.name", "must come after the parameters of the structure", quote(table.name))
        own = ["name", "start", "lower", "upper", "unit", "prior"]
        own += ["varies", *SETTINGS, "slopes"] if has_tests else []
        for key in sorted(table.model_fields_set - set(own)):
            found.add(f"parameters.{i}.{key}", "must not be given for a parameter of the damping")
    if not of_structure:
        found.add("parameters", "must have a parameter of the structure too", names_shown(known))
    return found


@dataclass(frozen=True, eq=False)
class ReadMatrix(DampingMatrix):
    """A damping matrix from a file, before its rows are placed on the model's degrees of freedom.

    Attributes
    ----------
    read : Labelled
        The matrix with the names of its rows, if the file has them.
    key : str
        The problem file's key that gives it.
    """

    read: Labelled = field(kw_only=True)
    key: str = field(kw_only=True)


def place_damping(given: DampingModel | Sequence[DampingModel], built: Built) -> list[DampingModel]:
    """Return damping models with matrices from files on the model's degrees of freedom.

    The rows are ordered, constrained, supported and rotated like the rows of the stiffness and mass. If the model
    was not read from files, named rows are put in its order, and rows without names must already be in this order.
    Raise BrokenError if the rows do not fit.
    """
    models: list[DampingModel] = as_list(given)
    found: list[DampingModel] = []
    for one in models:
        if isinstance(one, ReadMatrix) and built.separable is not None:
            model = built.separable
            unit = Rows(model.dofs, sp.eye_array(model.n_dof, format="csr"))
            place = built.place_matrix or partial(place_matrix, rows=unit)
            is_in_order = built.place_matrix is None and one.read.dofs is None
            try:
                matrix = one.matrix if is_in_order else place(one.read, one.key)
            except ValueError as error:
                raise BrokenError(ArgumentError.of(error)) from error
            one = DampingMatrix(matrix, one.coefficient)
        found.append(one)
    return found


def build_damping(
    tables: Sequence[Declared], parameters: Mapping[str, Parameter], folder: Path
) -> list[DampingModel]:
    """Build the damping models. Raise BrokenError if a file cannot be read or a table is invalid.

    Parameters
    ----------
    tables : sequence of DampingTable
    parameters : mapping of str to Parameter
        The problem's parameters, keyed by name; they include the damping parameters.
    folder : Path
        Folder to which file names are relative.
    """

    def of(value: Any) -> Any:
        match value:
            case str():
                return parameters[value]
            case list():
                return [of(one) for one in value]
            case dict():
                return {name: of(one) for name, one in value.items()}
        return value

    models: list[DampingModel] = []
    found: list[ArgumentError] = []
    for i, table in enumerate(tables):
        given = table.given_arguments()
        amounts = {key: of(value) for key, value in given.items() if key not in _WITHOUT_NAMES}
        read = None
        try:
            with reading(f"damping.{i}.matrix"):
                if "matrix" in given:
                    read = read_labelled(folder / str(given["matrix"]))
                    amounts["matrix"] = read.matrix
            model: DampingModel = table.build(**amounts)
            if read is not None:
                model = ReadMatrix(**vars(model), read=read, key=f"damping.{i}.matrix")
            models.append(model)
        except BrokenError as error:
            found += error.mistakes
        except ValueError as error:
            found.append(ArgumentError.of(error).replace_key("variable", "matrix").under(f"damping.{i}"))
    if found:
        raise BrokenError(*found)
    return models
