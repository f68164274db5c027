"""The measured values that are not used in updating but test the updated model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fmu.posterior.data.frf_data import FRFData
from fmu.types import BoolArray


def held_out(data: FRFData) -> BoolArray:
    """Return whether each value, (n_frfs, n_lines), tests the updated model.

    These are the values with a known error that are not used, at lines between the lowest and the highest line in
    use. The reduced model is not trained beyond these lines.
    """
    lines = np.asarray(data.frequencies_hz)
    in_use = lines[data.used.any(axis=0)]
    there = replace(data, use=None, band=None).used
    return np.asarray(there & ~data.used & (lines >= in_use[0]) & (lines <= in_use[-1]))
