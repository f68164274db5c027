"""Select the values of measured FRFs that are left out of updating and serve to test the updated model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmu.posterior.data.frf_data import FRFData
from fmu.types import BoolArray


def held_out(data: FRFData) -> BoolArray:
    """Return a mask (n_frfs, n_lines) of the values that test the updated model.

    These are the unused values at lines between the lowest and the highest line in use, beyond which the reduced
    model is not trained. Values without a standard deviation are excluded if the data have standard deviations.
    """
    lines = np.asarray(data.frequencies_hz)
    in_use = lines[data.used.any(axis=0)]
    there = replace(data, use=None, band=None).used
    return np.asarray(there & ~data.used & (lines >= in_use[0]) & (lines <= in_use[-1]))
