"""Checks of a model against measured masses and static displacements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc, chdtri

from fmu.analysis.fit.check import QUANTITY, Check, probability
from fmu.analysis.trace.misfit import QUANTITIES
from fmu.numbers import significant, with_sd

if TYPE_CHECKING:
    import xarray as xr


def quantity_checks(trace: xr.DataTree, level: float) -> list[Check]:
    """Check whether the updated model reproduces each measured mass or displacement; return a `Check` for each.

    The probability of an error at least as large as that of a draw is averaged over the draws. It is compared with
    half the level, divided by the number of quantities.
    """
    group = trace[QUANTITIES].to_dataset()
    found, limit = [], level / (2 * group.sizes["datum"])
    for label in map(str, group["datum"].to_numpy()):
        datum = group.sel(datum=label)
        measured, sd, unit = float(datum["measured"]), float(datum["sd"]), str(datum["unit"].to_numpy())
        computed = datum["computed"].to_numpy().ravel()
        p = float(chdtrc(1.0, ((computed - measured) / sd) ** 2).mean())
        most = sd * float(np.sqrt(chdtri(1.0, limit)))
        given_by_model = with_sd(float(computed.mean()), float(computed.std()))
        values = f"{with_sd(measured, sd)} {unit}, computed {given_by_model} {unit}"
        found.append(
            Check(
                QUANTITY,
                label,
                values,
                f"p {significant(limit, 2)}",
                p,
                bool(p < limit),
                f"{significant(most, 2)} {unit}",
                f"{label}: the updated model does not give what was measured, {values} ({probability(p)})",
            )
        )
    return found
