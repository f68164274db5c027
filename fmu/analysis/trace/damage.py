"""What a run says of damage: the loss of each parameter in each state, and how probable it is that it is large."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.analysis.trace.reading import has
from fmu.numbers import share, whole
from fmu.tables import data_frame

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

GROUP = "loss"
"""Group of a trace with the losses."""
ANY = "any"
"""The row of the largest loss in a state."""


def probably(p: float) -> str:
    """Return a probability estimated from draws in per cent: ``"32 %"``, and ``"< 1 %"`` or ``"> 99 %"``."""
    return "< 1 %" if p < 0.01 else "> 99 %" if p > 0.99 else f"{whole(round(100.0 * p))} %"


def damage(trace: xr.DataTree, beyond: Sequence[float] = (0.05, 0.1)) -> pd.DataFrame:
    """Return the losses d = 1 − θ/θ_reference of the parameters that vary between groups of tests.

    Parameters
    ----------
    trace : xarray.DataTree
        Of a `fmu.JointProblem` with parameters that vary by ``"group"`` or `fmu.Damage`.
    beyond : sequence of float
        Losses whose probability of being exceeded is wanted, between 0 and 1.

    Returns
    -------
    pandas.DataFrame
        A row for each state and parameter, and one for each state named ``"any"``: the largest loss of all.
        Columns ``mean``, ``sd``, ``eti90_lb`` and ``eti90_ub`` (the central 90 %), ``P(loss > 5 %)`` and so on.

    Raises
    ------
    ValueError
        If the trace has no losses, or a value of `beyond` is not between 0 and 1.
    """
    wrong = [x for x in beyond if not 0.0 <= x < 1.0]
    if wrong:
        raise ValueError(f"beyond: must be between 0 and 1, such as 0.05 (got {wrong[0]})")
    if not has(trace, GROUP):
        raise ValueError("trace: has no losses, as it has no parameter that varies between groups of tests")
    losses = trace[GROUP].to_dataset()
    names = [str(name) for name in losses.data_vars]
    rows: list[Any] = []
    index: list[tuple[str, str]] = []
    for state in losses["state"].to_numpy().tolist():
        draws = np.stack([losses[name].sel(state=state).to_numpy().ravel() for name in names])
        for name, values in zip((*names, ANY), (*draws, draws.max(axis=0)), strict=True):
            low, high = np.quantile(values, (0.05, 0.95))
            rows.append([values.mean(), values.std(ddof=1), low, high, *(np.mean(values > x) for x in beyond)])
            index.append((state, name))
    columns = ["mean", "sd", "eti90_lb", "eti90_ub", *(f"P(loss > {share(x)})" for x in beyond)]
    found = data_frame(dict(zip(columns, np.array(rows).T, strict=True)), "parameter", np.arange(len(rows)))
    import pandas

    found.index = pandas.MultiIndex.from_tuples(index, names=["state", "parameter"])
    return found
