"""Tabulate the posterior means and standard deviations from several runs side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fmu.analysis.convergence.diagnostics import summary
from fmu.numbers import MISSING, customary_unit, with_sd
from fmu.paper.experiment import rows_of
from fmu.tables import data_frame, markdown_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem


def moments(problem: UpdatingProblem, traces: Mapping[str, xr.DataTree]) -> pd.DataFrame:
    """Return a table of the posterior mean and sd of each parameter of `problem` in each run, SI units.

    There is one row per parameter. The columns are ``unit`` and, for each run, ``*_mean`` and ``*_sd``, where * is
    the run's name. The values are NaN for parameters that are not in the run's trace.
    """
    columns: dict[str, object] = {"unit": problem.units}
    for name, trace in traces.items():
        table = summary(trace).reindex(list(problem.names))
        columns |= {f"{name}_{of}": table[of].to_numpy() for of in ("mean", "sd")}
    return data_frame(columns, "parameter", problem.names)


def moments_table(parameters: pd.DataFrame, names: Mapping[str, str]) -> str:
    """Return the table from `moments` as text for a page, in customary units.

    `names` maps each run to the title of its column.
    """
    rows = []
    for parameter, row in rows_of(parameters):
        unit = customary_unit(row["unit"])
        pairs = [[row[f"{name}_{of}"] / unit.factor for of in ("mean", "sd")] for name in names]
        cells = [with_sd(mean, sd) if mean == mean else MISSING for mean, sd in pairs]
        rows.append((unit.label(parameter), *cells))
    return "Posterior mean and standard deviation:\n\n" + markdown_table(("parameter", *names.values()), rows)
