"""``[[error]]``: error models, and standard deviations that are inferred together with the parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, TypeGuard, get_args, get_type_hints

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Tag

from fmu.arguments import ArgumentError
from fmu.config.frf.damping import place_damping
from fmu.config.frf.errors import FRFTable
from fmu.config.mistakes import BrokenError
from fmu.config.tables import (
    Built,
    Declared,
    Name,
    Number,
    Numbers,
    OneOf,
    Positive,
    by_kind,
    kind_of,
    tuple_as_list,
)
from fmu.formats.shown import names_shown, quote
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors import ERROR_MODELS
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.errors.frequency import FrequencyErrors
from fmu.posterior.errors.noise import checked_beta
from fmu.posterior.errors.quantities import QuantityErrors
from fmu.posterior.errors.student import StudentErrors
from fmu.posterior.frf.errors import FRFErrors
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.quantities import Errors
from fmu.posterior.parameters import Parameter

Rows = Annotated[list[list[Positive]], Tag("<rows>")]
Named = Annotated[Name, Tag("<text>")]
Deviation = Annotated[
    Number | Numbers | Rows | Named, by_kind("a number, lists of numbers, or the name of a noise")
]
_Single = Annotated[Number | Named, by_kind("a number, or the name of a noise")]
IGNORED = "must not be given together with {}, as one of them would be ignored; delete one"
"""Rule for a second key that gives the standard deviations of the frequencies."""
OF_FREQUENCIES = (FrequencyErrors, StudentErrors)
_ARRAY = set(get_args(ArrayLike | None)) - {type(None)}


def _in_a_file(annotation: object) -> object:
    """Return the TOML type for an error model argument, such as a list of numbers for an array.

    An argument that may be a Parameter, such as an inferred standard deviation, is given by the name of a
    ``[[noise]]`` table. If it may also be a number or an array, the file may give numbers instead. An argument of
    any other type has the same type in the file, except that tuples become lists.
    """
    parts = set(get_args(annotation))
    is_array, optional = parts >= _ARRAY, type(None) in parts
    if not is_array and Parameter not in parts:
        return tuple_as_list(annotation)
    inferred: Any = Deviation if is_array else _Single if float in parts else Name
    found = inferred if Parameter in parts else list[Positive]
    return found | None if optional else found


ErrorTable = Annotated[
    Declared, OneOf("of", {name: (model,) for name, model in ERROR_MODELS.items()}, _in_a_file, (FRFTable,))
]


def build_error_models(
    tables: Sequence[Declared],
    noise: Mapping[str, Parameter],
    known: Sequence[str],
    read_frfs: Callable[..., tuple[list[FRFErrors], list[ArgumentError]]] | None,
) -> tuple[list[ErrorModel], list[ArgumentError]]:
    """Build the error models, and return them with the errors found in their tables.

    Parameters
    ----------
    tables : sequence of ErrorTable
    noise : mapping of str to Parameter
        Inferred standard deviations, keyed by name.
    known : sequence of str
        Names of all noise tables in file order; invalid tables have no entry in `noise`.
    read_frfs : callable or None
        Called with the index and table of each ``[[error]]`` for FRFs, and the inferred parameters as keyword
        arguments. Returns the FRF error models, and the errors in the table. None if there is no such table.
    """
    models: list[ErrorModel] = []
    found, used = [], set()
    rule = f"must be the name of a [[noise]] table: {names_shown(known) or 'there is none'}"
    for i, table in enumerate(tables):
        names = _noises(table)
        used |= set(names.values())
        found += [
            ArgumentError(f"error.{i}.{key}", rule, quote(name))
            for key, name in names.items()
            if name not in known
        ]
        inferred = {key: noise.get(name) for key, name in names.items()}
        if isinstance(table, FRFTable) and read_frfs is not None:
            of_frfs, wrong = read_frfs(i, table, **inferred)
            models += of_frfs
            found += wrong
            continue
        try:
            models.append(table.build(**inferred))
        except BrokenError as error:
            found += [mistake.under(f"error.{i}") for mistake in error.mistakes]
        except ArgumentError as error:
            if None not in inferred.values():  # otherwise the wrong name is the mistake
                found.append(error.under(f"error.{i}"))
    rule = "must be used as sd, model_sd or freedom of an [[error]]"
    found += [
        ArgumentError(f"noise.{i}.name", rule, quote(name)) for i, name in enumerate(known) if name not in used
    ]
    return models, found


def with_own_sd(tables: Sequence[Declared]) -> list[str]:
    """Return the keys of the standard deviations that ``[[error]]`` tables of frequencies give themselves."""
    of_frequencies = [(i, one) for i, one in enumerate(tables) if one.makes[0] in OF_FREQUENCIES]
    return [f"error.{i}.sd" for i, one in of_frequencies if one.given_arguments().get("sd") is not None]


def with_places(models: Sequence[ErrorModel], built: Built) -> list[ErrorModel]:
    """Return the error models with each place name replaced by its model node, and damping matrices placed.

    Error models of modes name no places, and are returned unchanged. Raise BrokenError if a damping matrix does
    not fit the model.
    """
    found = [one.at_places(built.places) if _are_of_quantities(one) else one for one in models]
    return [
        replace(one, damping=place_damping(one.damping, built)) if isinstance(one, FRFErrors) else one
        for one in found
    ]


def with_trust(data: ModalData, beta: ArrayLike) -> ModalData:
    """Return the data with the standard deviations √(1/(2β)) in Hz as their only uncertainty.

    β in 1/Hz² is the weight in eq. (4) of Boulkaibet et al. (`fmu.paper.published`). Raise ValueError if `beta` is
    not positive and finite, or is neither one number nor one per mode.
    """
    return replace(data, sd_hz=np.sqrt(0.5 / checked_beta(beta, data.n_modes)), covariance_hz2=None)


def is_of_modes(model: ErrorModel) -> bool:
    """Return True if an error model applies to modes.

    Return False if it applies to other quantities: masses, displacements or FRFs.
    """
    return not _are_of_quantities(model)


def _are_of_quantities(model: ErrorModel) -> TypeGuard[QuantityErrors]:
    return isinstance(model, QuantityErrors)


def _makes_quantities(table: Declared) -> bool:
    maker = table.makes[0]
    return isinstance(maker, type) and issubclass(maker, QuantityErrors)


def _noises(table: Declared) -> dict[str, str]:
    """Return the names of the noise tables to which an error table refers, keyed by the table's key."""
    hints = get_type_hints(table.makes[0])
    return {
        key: str(value)
        for key, value in table.given_arguments().items()
        if kind_of(value) == "<text>" and Parameter in get_args(hints.get(key))
    }


def beside_tests(
    tables: Sequence[Declared], models: Sequence[ErrorModel], measured: Mapping[str, ModalData]
) -> list[ArgumentError]:
    """Return an error for each ``sd`` given with repeated tests, whose scatter already determines the errors.

    One of the two would otherwise be ignored. `measured` has the data of each test, keyed by the phrase that names
    its repeated tests in the message.
    """
    rule = (
        "must not be given together with {}, whose scatter gives the error of their mean. Leave it out and "
        "use model_sd for the model error, or replace tests by frequencies (the means) with an sd"
    )
    of_modes = [(i, one) for i, one in enumerate(tables) if not _makes_quantities(one)]
    return [
        ArgumentError(f"error.{i}.sd", rule.format(of), quote(table.given_arguments()["sd"]))
        for (i, table), model in zip(of_modes, filter(is_of_modes, models), strict=True)
        for of, data in measured.items()
        if model.sd is not None and data.tests is not None and model.data_give_sd(data)
    ]


def vanishing(
    noise: Mapping[str, Parameter],
    models: Sequence[ErrorModel],
    data: ModalData,
    parameters: Mapping[str, Parameter],
) -> list[ArgumentError]:
    """Return an error for each inferred standard deviation that may make the posterior of one test unbounded.

    `noise` has these standard deviations, and `parameters` the structural parameters, in file order; see
    `fmu.posterior.joint.quantities.Errors.find_vanishing`.
    """
    errors = Errors.of(models)
    layout = Layout.of_one([*parameters.values(), *errors.damping_parameters()], data)
    found, names = errors.find_vanishing(layout, len(parameters)), list(noise)
    return [
        ArgumentError(f"noise.{names.index(name)}.lower", rule, quote(noise[name].lower))
        for name, rule in found.items()
    ]
