"""Turn resonances in frequency response functions into modes that can be paired with a model's modes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from annotated_types import Ge

from fmu.arguments import ArgumentError, Count, check_arguments
from fmu.numbers import hertz
from fmu.posterior.data.frf_data import FRFData
from fmu.posterior.data.held_out_lines import held_out
from fmu.posterior.data.modal_data import ModalData
from fmu.types import Positive

PICKED_SD = 0.01
"""Relative standard deviation of a picked frequency."""


@check_arguments
def pick_modes(
    data: FRFData,
    numbers: Sequence[Annotated[int, Ge(1)]] = (),
    n: Count | None = None,
    sd: Positive = PICKED_SD,
) -> ModalData:
    """Return the resonances in frequency response functions (FRFs) as modes for `fmu.UpdatingProblem`.

    If `fmu.FRFErrors` is the only error model, these modes do not count as data, because the FRFs already contain
    their information. They are paired with the model's modes, and the search for maxima starts with their
    likelihood. Resonances are picked at all lines between the lowest and the highest line in use.

    Parameters
    ----------
    data : FRFData
    numbers : sequence of int, optional
        For each resonance, the number of the model's mode. The modes are numbered from 1 among the elastic modes
        or, for pairing by shape, among the elastic modes that move a response point. Defaults to 1, 2, … in
        ascending order of frequency. Give the numbers if the test misses a mode.
    n : int, optional
        Largest number of resonances; the most prominent peaks are returned. Defaults to the length of `numbers`
        or, without numbers, to no limit.
    sd : float
        Relative standard deviation of the frequencies, which weights them in the search.

    Returns
    -------
    ModalData
        Frequencies, numbers and standard deviations, with the FRFs' responses as sensors.

    Raises
    ------
    ValueError
        If no resonance is found, the number of resonances differs from the length of `numbers`, or two of the
        numbers are equal.
    """
    between = replace(
        data, use=data.used | held_out(data), band=None
    )  # also resonances at lines that are left out of updating
    found = between.pick_frequencies(n or len(numbers) or None).frequencies_hz
    if not len(found):
        rule = "must have a resonance that stands out of the noise; give the frequencies of the modes instead"
        raise ArgumentError("data", rule, "none")
    if numbers and len(numbers) != len(found):
        at = ", ".join(hertz(*found.tolist()))
        raise ArgumentError(
            "numbers", f"must be {len(found)}, one per resonance that stands out, at {at} Hz", len(numbers)
        )
    sensors = tuple(dict.fromkeys(data.responses))
    given = tuple(numbers)
    return ModalData(found, given, sensors, sd_hz=sd * np.asarray(found), counterparts=given, counts_rigid=False)
