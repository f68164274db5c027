"""The check of a model against measured frequency response functions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from fmu.analysis.fit.check import RESPONSES, Check, probability
from fmu.analysis.frf.predictions import GROUP
from fmu.numbers import significant

if TYPE_CHECKING:
    import xarray as xr


def frf_checks(trace: xr.DataTree, level: float) -> list[Check]:
    """Return a list with one check per frequency response function: whether it differs by noise alone.

    At each draw, Σ r² over the lines is chi-square if the model is correct, and P(χ² ≥ Σ r²) is uniform; its mean
    over the draws is compared with half the level (`fmu.analysis.fit.checks`).
    """
    group = trace[GROUP].to_dataset()
    names, found = [str(name) for name in group["frf"].to_numpy()], []
    limit = level / (2 * len(names))
    for name in names:
        one = group.sel(frf=name)
        squares, freedom = one["squares"].to_numpy(), int(one["freedom"])
        if not freedom:
            continue
        p = float(chdtrc(freedom, squares).mean())
        times = float(np.sqrt(squares.mean() / freedom))
        frac, mean = float(one["frac"]), float(squares.mean())
        values = f"Σ r² = {significant(mean)}, {freedom} expected, FRAC {significant(frac)}"
        # a chi-square variable of many degrees of freedom is nearly normal
        largest = float(np.sqrt(1.0 + 3.0 * np.sqrt(2.0 / freedom)))
        found.append(
            Check(
                RESPONSES,
                f"FRF {name}",
                values,
                f"p {significant(limit, 2)}",
                p,
                bool(p < limit),
                f"errors {significant(largest)} times the noise",
                f"FRF {name}: the updated model differs from what was measured by {significant(times, 2)} times "
                f"the noise: {values} ({probability(p)})",
            )
        )
    return found
