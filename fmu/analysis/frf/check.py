"""Checks of a model against measured FRFs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from fmu.analysis.fit.check import HELD_OUT, RESPONSES, Check, probability
from fmu.analysis.frf.channel_errors import explain_by_channel
from fmu.analysis.frf.predictions import GROUP
from fmu.numbers import share, significant, whole

if TYPE_CHECKING:
    import xarray as xr


def frf_checks(trace: xr.DataTree, level: float) -> list[Check]:
    """Check for each FRF whether noise alone explains the misfit; return one `Check` per FRF that is used.

    At each draw, Σ r² over the lines is chi-square if the model is correct, and P(χ² ≥ Σ r²) is uniform. Its mean
    over the draws is compared with half the level (`fmu.analysis.fit.checks`), divided by the number of FRFs.
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
        explained = explain_by_channel(one) if p < limit else ""
        cause = f"; {explained}" if explained else ""
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
                f"the noise: {values} ({probability(p)}){cause}",
            )
        )
    return found


def has_held_out(trace: xr.DataTree) -> bool:
    """Return True if some measured FRF values were held out to test the model."""
    return bool(trace[GROUP]["held_freedom"].to_numpy().any())


def held_out_checks(trace: xr.DataTree, level: float) -> list[Check]:
    """Check the predictions of FRF values not used in updating; return one `Check` per FRF with such values.

    The squared distance of these values from their prediction, noise included, is chi-square if the model is
    correct (`fmu.analysis.frf.predictions`). The level is divided by the number of these FRFs.
    """
    group = trace[GROUP].to_dataset()
    tested = group.isel(frf=np.flatnonzero(group["held_freedom"].to_numpy()))
    names, found = [str(name) for name in tested["frf"].to_numpy()], []
    limit = level / len(names)
    for name in names:
        one = tested.sel(frf=name)
        squares, freedom = float(one["held_squares"]), int(one["held_freedom"])
        p, inside = float(chdtrc(freedom, squares)), int(one["held_inside"])
        of_intervals = f"{share(2 * inside / freedom)} of {whole(freedom // 2)} in their 90 % intervals"
        values = f"χ² = {significant(squares)}, {freedom} expected"
        largest = float(np.sqrt(1.0 + 3.0 * np.sqrt(2.0 / freedom)))
        found.append(
            Check(
                HELD_OUT,
                f"FRF {name}, values not used",
                f"{values}; {of_intervals}",
                f"p {significant(limit, 2)}",
                p,
                bool(p < limit),
                f"errors {significant(largest)} times those of the prediction",
                f"FRF {name}: values not used in updating differ from their prediction: {values}, {of_intervals} "
                f"({probability(p)})",
            )
        )
    return found
