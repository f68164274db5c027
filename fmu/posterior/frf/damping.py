"""Structural damping models: modal ratios, Rayleigh damping, loss factors, dashpots, damping matrices.

Each ratio, loss factor or coefficient is known or inferred.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from fmu.arguments import ArgumentError, as_list, check_arguments
from fmu.durable_files import digest
from fmu.fem.frf.model import Damping
from fmu.fem.frf.proportional import Source
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.numbers import names_in_words, typed
from fmu.plain_data import mapping_in
from fmu.posterior.parameters import Parameter, parameter_in, value_and_parameter, value_or_name
from fmu.types import NotNegative, Plain


@check_arguments
@dataclass(frozen=True)
class ModalDamping:
    """Modal damping ratios: C = Σ_r 2 ζ_r ω_r M φ_r φ_rᵀ M.

    Attributes
    ----------
    ratios : float, Parameter, or sequence of float or Parameter
        Damping ratio ζ of all modes, or of each elastic mode in ascending order of frequency; the last ratio
        applies to all higher modes too. Modes of parts without a drive or a response are not counted.

    Raises
    ------
    ValueError
        If there is no ratio, or a known one is negative or not finite.
    """

    ratios: NotNegative | Parameter | Sequence[NotNegative | Parameter]

    def __post_init__(self) -> None:
        if not as_list(self.ratios):
            raise ArgumentError("ratios", "must have one damping ratio at least", "none")


@check_arguments
@dataclass(frozen=True)
class RayleighDamping:
    """Damping proportional to mass and stiffness: C = α M + β K.

    Attributes
    ----------
    alpha : float or Parameter, 1/s
    beta : float or Parameter, s

    Raises
    ------
    ValueError
        If a known coefficient is negative or not finite.
    """

    alpha: NotNegative | Parameter = 0.0
    beta: NotNegative | Parameter = 0.0


@check_arguments
@dataclass(frozen=True)
class StructuralDamping:
    """Loss factors: K (1 + i η), for the whole structure or for the stiffness that a parameter scales.

    Attributes
    ----------
    loss : float or Parameter
        Loss factor η of all stiffness that no parameter in `of` scales.
    of : mapping of str to float or Parameter
        Loss factor of the stiffness that a model parameter scales, keyed by parameter name. Such damping couples
        the modes of the undamped structure. Parameters that scale the same stiffness, such as E and Iy of a beam,
        must not have different loss factors.

    Raises
    ------
    ValueError
        If a known loss factor is negative or not finite.
    """

    loss: NotNegative | Parameter = 0.0
    of: Mapping[str, NotNegative | Parameter] = field(default_factory=dict)


@check_arguments
@dataclass(frozen=True)
class Dashpot:
    """A viscous damper between two points, or from a point to the ground. It couples the modes.

    Attributes
    ----------
    at : tuple of (place, direction)
        One end, written like a sensor.
    coefficient : float or Parameter, N·s/m (N·m·s/rad)
    to : tuple of (place, direction), optional
        The other end; the ground by default.

    Raises
    ------
    ValueError
        If a known coefficient is negative or not finite.
    """

    at: tuple[int | str, str]
    coefficient: NotNegative | Parameter
    to: tuple[int | str, str] | None = None


@check_arguments
@dataclass(frozen=True, eq=False)
class DampingMatrix:
    """A viscous damping matrix C from another program, multiplied by a coefficient. It couples the modes.

    Attributes
    ----------
    matrix : array_like or sparse, shape (n_dof, n_dof), N·s/m
        Symmetric, for the model's degrees of freedom in their order, `fmu.SeparableModel.dofs`. `fmu.read_model`
        orders, constrains and rotates the rows of a program's matrices; its result's ``rows.place`` does so for C.
    coefficient : float or Parameter

    Raises
    ------
    ValueError
        If the matrix is not real, square, symmetric and finite, or a known coefficient is negative or not finite.
    """

    matrix: Any
    coefficient: NotNegative | Parameter = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", Term(self.matrix, ()).matrix)
        if self.matrix.shape[0] != self.matrix.shape[1]:
            raise ArgumentError("matrix", "must be square", f"shape {self.matrix.shape}")
        asymmetry = abs(self.matrix - self.matrix.T).max() if self.matrix.nnz else 0.0
        if not (
            np.all(np.isfinite(self.matrix.data)) and asymmetry <= 1e-9 * abs(self.matrix.data).max(initial=0.0)
        ):
            raise ArgumentError("matrix", "must be symmetric and finite", f"asymmetry {typed(asymmetry)}")


DampingModel = ModalDamping | RayleighDamping | StructuralDamping | Dashpot | DampingMatrix
"""Damping settings; several are added up."""


def inferred_in(given: DampingModel | Sequence[DampingModel]) -> list[Parameter]:
    """Return the inferred parameters of damping models, each listed once."""
    found: list[Parameter] = []
    for one in as_list(given):
        for value in vars(one).values():
            table = mapping_in(value)
            parts = as_list(value) if table is None else table.values()
            found += [p for p in map(parameter_in, parts) if p is not None and p not in found]
    return found


def bind_damping(
    given: DampingModel | Sequence[DampingModel],
    model: SeparableModel,
    names: Sequence[str],
    places: Mapping[str, Any],
) -> Damping:
    """Return a model's damping. Its parameters are listed by `inferred_in`.

    Parameters
    ----------
    given : damping model or sequence of damping models
    model : SeparableModel
    names : sequence of str
        Names of the model's parameters.
    places : mapping of str to node
        Maps place names to nodes of the model.

    Raises
    ------
    ValueError
        If there is no damping, a parameter can be negative, a named parameter is unknown or does not change the
        stiffness, parameters that scale the same stiffness have different loss factors, an end of a dashpot does
        not move, a matrix does not fit, a kind of damping model other than dashpots and matrices occurs twice, or
        modal ratios are combined with damping that couples the modes.
    """
    models: list[DampingModel] = as_list(given)
    inferred = inferred_in(models)
    if not models:
        raise ArgumentError(
            "damping", "must have one damping model at least, such as fmu.ModalDamping(0.01)", "none"
        )

    def source(value: NotNegative | Parameter) -> Source:
        number, parameter = value_and_parameter(value)
        if parameter is None:
            return Source(number)
        if parameter.lower < 0.0:
            raise ArgumentError(f"damping.{parameter.name}.lower", "must be at least 0", parameter.lower)
        return Source(number, inferred.index(parameter))

    ratios: tuple[Source, ...] = ()
    alpha = beta = loss = Source(0.0)
    losses: dict[int, Source] = {}
    dashpots: list[tuple[sp.csr_array, Source]] = []
    for one in models:
        match one:
            case ModalDamping():
                values: list[float | Parameter] = as_list(one.ratios)
                ratios = tuple(map(source, values))
            case RayleighDamping():
                alpha, beta = source(one.alpha), source(one.beta)
            case StructuralDamping():
                loss = source(one.loss)
                for name, factor in one.of.items():
                    losses[_stiffness_of(model, names, name)] = source(factor)
                _require_one_loss(losses, model, names)
            case Dashpot():
                ends = [one.at] if one.to is None else [one.at, one.to]
                seen = model.observation([(places.get(str(place), place), way) for place, way in ends])
                row = seen[[0]] if one.to is None else seen[[0]] - seen[[1]]
                dashpots.append((sp.csr_array(row.T @ row), source(one.coefficient)))
            case DampingMatrix():
                if one.matrix.shape[0] != model.n_dof:
                    raise ArgumentError("damping.matrix", f"must be of {model.n_dof} rows", one.matrix.shape[0])
                dashpots.append((one.matrix, source(one.coefficient)))
    kinds = [type(one) for one in models if isinstance(one, ModalDamping | RayleighDamping | StructuralDamping)]
    twice = next((kind for kind in kinds if kinds.count(kind) > 1), None)
    if twice is not None:
        raise ArgumentError("damping", f"must have one {twice.__name__} at most", kinds.count(twice))
    if ratios and (losses or dashpots):
        raise ArgumentError(
            "damping",
            "modal ratios cannot be combined with dashpots, damping matrices or loss factors of parts, which "
            "couple the modes; use RayleighDamping or StructuralDamping(loss=…) beside them",
            ", ".join(type(one).__name__ for one in models),
        )
    return Damping(len(inferred), alpha, beta, loss, ratios, losses, tuple(dashpots))


def damping_as_dict(given: DampingModel) -> dict[str, Plain]:
    """Return a damping model as a dict of plain Python types: parameters by name, a matrix as a hash."""
    found: dict[str, Plain] = {"damping": type(given).__name__}
    for key, value in vars(given).items():
        if key == "matrix":
            array = sp.csr_array(value)
            parts = (array.indptr, array.indices, array.data)
            found["sha256"] = digest(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))
        elif (table := mapping_in(value)) is not None:
            found[key] = {name: value_or_name(one) for name, one in table.items()}
        elif isinstance(value, Sequence) and not isinstance(value, str):
            found[key] = [value_or_name(one) for one in value]
        else:
            found[key] = value_or_name(value)
    return found


def _require_one_loss(losses: Mapping[int, Source], model: SeparableModel, names: Sequence[str]) -> None:
    """Raise ArgumentError if parameters with different loss factors scale the same stiffness."""
    for term in model.K_terms:
        here = [j for j in sorted(losses) if term.powers[j]]
        if len({losses[j] for j in here}) > 1:
            raise ArgumentError(
                "damping.of",
                "must give stiffness that several parameters scale one loss factor: list one of them, or the same "
                "factor for all",
                f"those of {names_in_words([names[j] for j in here])}",
            )


def _stiffness_of(model: SeparableModel, names: Sequence[str], name: str) -> int:
    if name not in names:
        raise ArgumentError("damping.of", f"must name parameters among {', '.join(names)}", repr(name))
    j = list(names).index(name)
    if not any(term.powers[j] for term in model.K_terms):
        raise ArgumentError("damping.of", "must name parameters that change the stiffness", repr(name))
    return j
