"""Predict a model's modes, which replace measured modes while a test is planned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
from annotated_types import Interval

from fmu.arguments import ArgumentError, check_arguments
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.types import Dof, Positive


@check_arguments
def expected_modes(
    model: SeparableModel | BlackBoxModel,
    parameters: Sequence[Parameter],
    n_modes: Annotated[int, Interval(ge=1, le=10_000)] = 6,
    frequency_sd: Positive = 0.005,
    sensors: Sequence[Dof] = (),
) -> ModalData:
    """Return a model's modes before updating, as data for a problem whose test has not been made yet.

    Parameters
    ----------
    model : SeparableModel or BlackBoxModel
    parameters : sequence of Parameter
        Parameters of the model, used at their starting values.
    n_modes : int
        Number of modes: the lowest elastic modes of a SeparableModel, or the first modes that a BlackBoxModel
        returns.
    frequency_sd : float
        Relative standard deviation of the frequency measurement errors.
    sensors : sequence of (place, direction)
        Required for a BlackBoxModel: the sensors at which it returns shapes, in the order of the rows of the
        shapes. Ignored for a SeparableModel.

    Returns
    -------
    ModalData
        Frequencies with their standard deviations and, for a BlackBoxModel, shapes.

    Raises
    ------
    ValueError
        If the model has too few modes, or a BlackBoxModel does not return shapes at these sensors.
    """
    start = np.array([p.start for p in parameters], dtype=float)
    if isinstance(model, SeparableModel):
        if n_modes > model.n_dof:
            raise ArgumentError("n_modes", f"must be at most {model.n_dof}, the degrees of freedom", n_modes)
        numbers = tuple(range(1, n_modes + 1))
        paired = PairedStructure.of(model, pairing="shape", numbers=numbers, sensors=(), reference=start)
        frequencies = paired.frequencies(start[None])[0]
        return ModalData(frequencies, sd_hz=frequency_sd * frequencies)
    answer = model.at_sensors(tuple(sensors)).at(start)
    if answer.shapes is None or len(answer.shapes) != len(sensors):
        rows = "none" if answer.shapes is None else f"{len(answer.shapes)} rows"
        raise ArgumentError("sensors", "must be one for each row of shapes that the function gives", rows)
    if len(answer.frequencies) < n_modes:
        raise ArgumentError("n_modes", f"must be at most {len(answer.frequencies)}, as the model gives", n_modes)
    frequencies = answer.frequencies[:n_modes]
    return ModalData(
        frequencies, sensors=tuple(sensors), shapes=answer.shapes[:, :n_modes], sd_hz=frequency_sd * frequencies
    )
