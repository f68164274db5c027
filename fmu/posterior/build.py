"""Construct the paired model and the likelihood of an updating problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, as_list, shown
from fmu.engines.blas import single_thread
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.modal import count_modes, frequency_hz, solve_spectrum
from fmu.fem.modes.separable import separable_in
from fmu.fem.pairing.modal_model import ModalModel, Model, as_modal_model
from fmu.fem.pairing.paired_black_box import PairedBlackBox
from fmu.fem.pairing.paired_structure import SOFT, PairedStructure, structure_of
from fmu.fem.pairing.rules import SOFTNESS
from fmu.numbers import significant
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.discrepancy.embedded import Discrepancy
from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood
from fmu.posterior.errors.base import ErrorModel, Likelihood
from fmu.posterior.errors.frequency import BetaFrequencyErrors
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.errors.mixture import MixtureLikelihood
from fmu.posterior.errors.quantities import QuantityErrors, QuantityTerm
from fmu.posterior.errors.residual import ModalResidual
from fmu.posterior.frf.likelihood import FRFLikelihood, FRFsOfTest
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.quantities import Errors, StructureInTest, bind_quantities
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray

ERRORS = ("frequency", "modal-residual")
_SAME = 1e-4
"""Relative difference of frequencies below which two modes may be the same."""


def check_names(parameters: Sequence[Parameter]) -> None:
    """Raise ValueError if two parameters share a name."""
    names = [p.name for p in parameters]
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ArgumentError("parameters", "names must be distinct", f"twice: {twice}")


def check_held(layout: Layout, model: ModalModel) -> None:
    """Raise ValueError if no parameter is updated, or if a model without matrices has one that is not updated."""
    if layout.held and not layout.parameters:
        raise ArgumentError("parameters", "one at least must be updated", "none")
    if layout.held and any(structure_of(part) is None for part in model.parts):
        rule = f"must be true for every parameter of a model without matrices ({model.name})"
        raise ArgumentError(f"{next(iter(layout.held))}.updated", rule, False)


def modal_model_in(model: Model, n_sensors: int) -> ModalModel | None:
    """Return `model` as a `ModalModel` that pairs its modes itself; None for a SeparableModel or BlackBoxModel.

    If `model` returns mode shapes, they must be at the `n_sensors` sensors at which shapes were measured. Raise
    ValueError if a model of another kind has no method frequencies(theta).
    """
    if separable_in(model) is not None or isinstance(model, BlackBoxModel):
        return None
    if not callable(getattr(model, "frequencies", None)):
        raise ArgumentError(
            "model",
            "must be a SeparableModel, a BlackBoxModel or an object with frequencies(theta), "
            "n_parameters and n_modes",
            shown(model),
        )
    return as_modal_model(cast("Any", model), n_sensors)


def paired_model(
    model: Model,
    data: ModalData,
    parameters: Sequence[Parameter],
    pairing: str,
    softness: float = SOFTNESS,
) -> ModalModel:
    """Return the model that maps theta to the frequencies and shapes paired with the measured modes.

    Parameters
    ----------
    model : SeparableModel, BlackBoxModel or ModalModel
        A `ModalModel` is already paired.
    data : ModalData
    parameters : sequence of Parameter
        Parameters of the model.
    pairing : {"shape", "index", "soft"}
    softness : float
        Temperature τ of the weights exp(MAC/τ), for soft pairing.

    Raises
    ------
    ValueError
        If the model does not fit the parameters, the data or the pairing, or the data have numbers or counterparts
        that the pairing does not follow.
    """
    structure, function = separable_in(model), model if isinstance(model, BlackBoxModel) else None
    shapes = None if data.shapes is None else np.asarray(data.shapes)
    paired: Any = modal_model_in(model, 0 if shapes is None else len(shapes))
    if pairing == SOFT and structure is None:
        raise ArgumentError("pairing", "soft needs a SeparableModel, with slopes of shapes", type(model).__name__)
    n, n_tests = len(parameters), 1 if paired is None else paired.n_tests
    if model.n_parameters != n * n_tests:
        raise ArgumentError("parameters", f"the model takes {model.n_parameters // n_tests}", n)
    start = np.array([p.start for p in parameters], dtype=float)
    if function is not None:
        paired = PairedBlackBox.of(
            function.at_sensors(() if shapes is None else data.sensors),
            pairing=pairing,
            start=start,
            numbers=data.numbers,
            shapes=shapes,
            measured_hz=np.asarray(data.frequencies_hz),
            lower=np.array([p.lower for p in parameters]),
            upper=np.array([p.upper for p in parameters]),
            scale=np.array([p.prior.scale(p.lower, p.upper)[1] for p in parameters]),
        )
    elif structure is not None:
        names = tuple(p.name for p in parameters)
        if structure.names not in (None, names):
            raise ArgumentError("parameters", f"must be the model's, in its order {structure.names}", names)
        paired = PairedStructure.of(
            structure,
            pairing=pairing,
            numbers=data.numbers,
            elastic_from_hz=None if data.counts_rigid else float(np.asarray(data.frequencies_hz).min()),
            sensors=data.sensors,
            reference=start,
            shapes=shapes,
            measured_hz=np.asarray(data.frequencies_hz),
            counterparts=data.counterparts,
            softness=softness,
        )
    if paired.n_modes != data.n_modes:
        raise ArgumentError("data", f"the model pairs {paired.n_modes} modes", data.n_modes)
    if structure is not None or function is not None:
        _check_choice(paired, data, start)
    return paired


def _check_choice(paired: Any, data: ModalData, start: FloatArray) -> None:
    """Raise ValueError if the data choose modes in a way that the pairing does not follow.

    Pairing by number ignores counterparts. They must be equal to the numbers, unless the user gave numbers too.
    Pairing by shape ignores numbers. If the user gave numbers, but neither shapes nor counterparts, the numbers
    must belong to the modes that pairing by shape takes at `start` (n_parameters,).
    """
    if not paired.by_shape:
        if data.counterparts and data.counterparts != data.numbers and not data.counts_rigid:
            rule = "must not be given where modes are paired by number; give numbers"
            raise ArgumentError("counterparts", rule, data.counterparts)
        return
    if data.shapes is not None or data.counterparts or not data.counts_rigid:
        return
    numbers, blocks, point = np.array(data.numbers), paired.full_blocks, start[None]
    available = count_modes(blocks)
    if numbers.max() > available:
        raise ArgumentError("numbers", f"must lie in 1..{available}, the modes of the model", data.numbers)
    with single_thread():
        taken = frequency_hz(paired.solve(point).eigenvalues[0])
        named = frequency_hz(solve_spectrum(blocks, point, int(numbers.max())).eigenvalues[0, numbers - 1])
    differ = np.abs(named - taken) > _SAME * taken
    if differ.any():
        k = int(np.argmax(differ))
        rule = (
            'must be those of the modes that pairing = "shape" takes if no shapes were measured: at the start, '
            f"mode {data.labels[k]} is paired with {significant(taken[k], 4)} Hz, but number {numbers[k]} has "
            f'{significant(named[k], 4)} Hz; choose modes by counterparts, or set pairing = "index"'
        )
        raise ArgumentError("numbers", rule, data.numbers)


def likelihood_of(
    error: str | ErrorModel | Sequence[ErrorModel],
    beta: ArrayLike | None,
    model: Any,
    paired: ModalModel,
    data: ModalData,
    parameters: Sequence[Parameter],
    discrepancy: Discrepancy | Sequence[Discrepancy],
    layout: Layout,
) -> Likelihood:
    """Return the likelihood of an updating problem.

    Parameters
    ----------
    error : str, ErrorModel or sequence of ErrorModel
        See `fmu.posterior.problem.UpdatingProblem`.
    beta : float or array_like, optional
        β = 1/(2σ²) for error models given by name.
    model, paired : SeparableModel, BlackBoxModel or ModalModel
        The user's model, and the same model paired with the data.
    data : ModalData
    parameters : sequence of Parameter
        Parameters of the model.
    discrepancy : Discrepancy or sequence of Discrepancy
    layout : Layout
        The tests, and the structural parameters in each test as functions of theta.

    Raises
    ------
    ValueError
        If an error model or discrepancy is unknown or does not fit the data or the model, if modes are the data
        but none of them is used, or if `beta` does not apply.

    Notes
    -----
    Mass and displacement errors are added to the mode errors. If only mass or displacement errors are given, the
    frequencies keep their default errors. If only frequency response function errors are given, the modes are not
    part of the likelihood. They are still paired, and the search for maxima starts with the likelihood of the
    modes.
    """
    given: Sequence[Any] = as_list(error)
    errors_of, structure = Errors.of(error), separable_in(model)
    if errors_of.of_frfs:
        return _likelihood_of_frfs(given, beta, model, paired, data, parameters, discrepancy, layout)
    if data.used is not None and not len(data.used):
        raise ArgumentError("use", "must be true for at least one mode", list(data.use))
    if isinstance(error, str) and error not in ERRORS:
        raise ArgumentError("error", f"must be one of {ERRORS}, or error models", repr(error))
    discrepancies = tuple(as_list(discrepancy))
    if discrepancies and (error == "modal-residual" or paired.is_soft):
        got = "the modal residual" if error == "modal-residual" else "soft pairing"
        raise ArgumentError("discrepancy", "needs errors of frequencies or shapes, paired one to one", got)
    if error == "modal-residual":
        if structure is None:
            raise ArgumentError("error", "the modal residual needs a SeparableModel", type(model).__name__)
        start = np.array([p.start for p in parameters], dtype=float)
        return ModalResidual(structure, data, start, 1.0 if beta is None else beta)
    if not given or not all(
        one in ("frequency", *errors_of.of_quantities.values()) or hasattr(one, "bind") for one in given
    ):
        raise ArgumentError(
            "error", f"must be one of {ERRORS}, or error models such as fmu.FrequencyErrors(sd=0.01)", shown(error)
        )
    others = list(errors_of.of_quantities.values())
    errors = [one for one in given if one not in others and one != "frequency"]
    if not errors:
        errors = [BetaFrequencyErrors(beta)]
    elif beta is not None:
        raise ArgumentError("beta", "must not be given together with error models, which have sd", beta)
    if not others and not discrepancies:
        make: Any = MixtureLikelihood if paired.is_soft else ModalLikelihood
        likelihood: Likelihood = make(paired, data, errors)
        return likelihood
    if others and len(layout.tests) == 1 and (paired.is_soft or structure is None):
        got = "soft pairing" if paired.is_soft else type(model).__name__
        raise ArgumentError("error", "a mass or a displacement needs a SeparableModel, paired one to one", got)
    quantities: Sequence[QuantityTerm]
    if len(layout.tests) == 1:
        _check_single(others)
        quantities = [one.bind_structure(model, parameters) for one in others]
    else:
        quantities = bind_quantities(errors_of.of_quantities, model, layout)
    if discrepancies:
        return DiscrepantLikelihood(paired, data, errors, quantities, discrepancies, layout)
    return ModalLikelihood(paired, data, errors, quantities)


def _likelihood_of_frfs(
    given: Sequence[Any],
    beta: ArrayLike | None,
    model: Any,
    paired: ModalModel,
    data: ModalData,
    parameters: Sequence[Parameter],
    discrepancy: Discrepancy | Sequence[Discrepancy],
    layout: Layout,
) -> Likelihood:
    """Return the joint likelihood of frequency response functions and of any modes for which errors are given.

    Raise ValueError if a single test has several FRFErrors, or if the model, the tests or a discrepancy do not
    allow frequency response functions.
    """
    errors = Errors.of(given)
    of_frfs = list(errors.of_frfs.values())
    if len(layout.tests) == 1:
        if paired.is_soft or separable_in(model) is None:
            rule = "frequency response functions need a SeparableModel, paired one to one"
            raise ArgumentError("error", rule, "soft pairing" if paired.is_soft else type(model).__name__)
        if len(of_frfs) > 1:
            rule = (
                "must have one FRFErrors at most; give all frequency response functions of a test as one FRFData"
            )
            raise ArgumentError("error", rule, len(of_frfs))
        _check_single(of_frfs)
    others = [one for one in given if one not in of_frfs]
    of_modes = errors.of_modes != "frequency"  # given explicitly, not by default
    discrepancies = tuple(as_list(discrepancy))
    if discrepancies and len(layout.tests) > 1:
        rule = "is for frequency response functions of a single test, or for tests of modes alone"
        raise ArgumentError("discrepancy", rule, f"{len(layout.tests)} tests")
    if discrepancies and of_modes:
        rule = "needs errors of modes, or of frequency response functions, but not both"
        raise ArgumentError("discrepancy", rule, "both")
    if len(discrepancies) > 1:
        rule = 'of frequency response functions must be one, of kind "modes"'
        raise ArgumentError("discrepancy", rule, len(discrepancies))
    if not (of_modes or any(data.use)):  # data of another problem with FRFs only
        data = replace(data, use=())
    modal: Any = likelihood_of(others or "frequency", beta, model, paired, data, parameters, (), layout)
    if not of_modes:
        modal = modal.using(np.zeros(0, dtype=np.int64))
    every = []
    for one in of_frfs:
        here = StructureInTest(model, list(parameters), 0, np.arange(len(parameters)))
        if len(layout.tests) > 1:
            here = StructureInTest.of(one.test, model, layout)
        try:
            term = one.bind_frfs(here.structure, here.parameters, *discrepancies)
        except ValueError as error:
            if one.test is None:
                raise
            raise ArgumentError.of(error).under(f"error.{given.index(one)}") from error
        names = [p.name for p in layout.structural]
        of_damping = [names.index(p.name) for p in term.inferred[: term.model.n_values] if p.name in names]
        every.append(FRFsOfTest(term, here.test, np.concatenate([here.numbers, of_damping]).astype(np.int64)))
    return FRFLikelihood(modal, every, len(layout.structural), len(layout.tests))


def _check_single(given: Sequence[QuantityErrors]) -> None:
    """Raise ArgumentError if an error model names a test although there is only one."""
    named = [one.test for one in given if one.test is not None]
    if named:
        raise ArgumentError("test", "must not be given where there is one test only", repr(named[0]))
