"""The numbers of one experiment as tables: parameters, frequencies, comparison."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.paper.convergence import solves_at_this_pace
from fmu.paper.plan import PAPER_SAMPLERS
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.paper.experiment import Result


CI_PROB = 0.9


def posterior_mean(trace: xr.DataTree) -> FloatArray:
    """Return the mean of all draws kept, shape (ndim,), SI units."""
    from fmu.analysis.convergence.diagnostics import parameter_draws

    return parameter_draws(trace).mean(axis=(0, 1))


def parameter_table(result: Result) -> pd.DataFrame:
    """Return the paper's parameter table (1 or 3) beside ours, one row a parameter, SI units.

    Columns: ``unit``; ``published_*``; ``maximum`` (of the posterior); ``paper_*``, the means under the paper's
    protocol; ``long_*_mean``, ``_sd``, ``_mcse`` and the ends of the interval, of the long runs; the same of the
    ``reference`` without an interval.
    """
    import pandas as pd

    from fmu.analysis.convergence.diagnostics import interval_columns, summary

    columns: dict[str, object] = {"unit": result.problem.units}
    for name, column in result.published.columns.items():
        columns[f"published_{name}"] = column.printed_theta
    columns["maximum"] = result.maxima[0].theta
    for name, trace in result.paper.items():
        columns[f"paper_{name}"] = posterior_mean(trace)
    lower, upper = interval_columns(CI_PROB)
    for name, trace in result.long.items():
        table = summary(trace, CI_PROB)
        for statistic in ("mean", "sd", "mcse_mean", lower, upper):
            columns[f"long_{name}_{statistic.removesuffix('_mean')}"] = table[statistic].to_numpy()
    for statistic in ("mean", "sd", "mcse"):
        columns[f"reference_{statistic}"] = getattr(result.reference, statistic)
    return pd.DataFrame(columns, index=pd.Index(result.problem.names, name="parameter"))


def frequency_table(result: Result) -> pd.DataFrame:
    """Return the paper's frequency table (2 or 4) beside ours, one row a measured mode.

    Frequencies in Hz (``*_hz``) and errors |f − f_m|/f_m in % (``*_error``): ``published_*`` as printed;
    ``recomputed_*`` from the published parameters, with this experiment's pairing; ``maximum_*`` at the highest
    maximum of the posterior; ``paper_*`` and ``long_*`` of the model at our posterior mean. ``long_*_predictive``
    with its interval is the posterior predictive distribution of a new measurement, eq. (10).
    """
    import pandas as pd

    from fmu.analysis.convergence.diagnostics import interval_columns
    from fmu.analysis.data.prediction import predict_frequencies

    error, frequencies = result.published.error_percent, result.problem.frequencies
    columns: dict[str, object] = {"measured_hz": result.published.measured_hz}
    for name, column in result.published.columns.items():
        columns[f"published_{name}_hz"] = column.printed_hz
        columns[f"published_{name}_error"] = column.printed_errors
        recomputed = frequencies(column.theta)
        columns[f"recomputed_{name}_hz"] = recomputed
        columns[f"recomputed_{name}_error"] = error(recomputed)
    columns["maximum_hz"] = result.maxima[0].frequencies
    columns["maximum_error"] = error(result.maxima[0].frequencies)
    lower, upper = interval_columns(CI_PROB)
    for kind, traces in (("paper", result.paper), ("long", result.long)):
        for name, trace in traces.items():
            at_mean = frequencies(posterior_mean(trace))
            columns[f"{kind}_{name}_hz"] = at_mean
            columns[f"{kind}_{name}_error"] = error(at_mean)
            if kind == "long":
                predicted = predict_frequencies(trace, CI_PROB)
                columns[f"long_{name}_predictive"] = predicted["mean"].to_numpy()
                columns[f"long_{name}_predictive_{lower}"] = predicted[f"noisy_{lower}"].to_numpy()
                columns[f"long_{name}_predictive_{upper}"] = predicted[f"noisy_{upper}"].to_numpy()
    return pd.DataFrame(columns, index=pd.Index(result.problem.data.labels, name="mode"))


def comparison_table(result: Result) -> pd.DataFrame:
    """Return `fmu.compare` of the long runs with what the paper's protocol cost beside it, one row a sampler.

    ``sampling_solves`` and ``ess_per_sampling_solve`` leave the warm-up out.
    ``needed_solves``: model solves, warm-up counted, after which the long run passed for converged at every length
    looked at, missing if it never did; ``paper_solves``: what the paper's protocol took; ``paper_needed_solves``:
    what the paper's settings would take, at the pace they have in the posterior, for the effective sample size
    that the verdict asks for, missing where no run tells where the posterior is; ``paper_error``: how far
    its means lie from the reference (the largest over the parameters, in posterior sd); ``published_error``:
    the same of the published vector.
    """
    table = result.comparison.copy()
    off = {s: _distance(result, posterior_mean(trace)) for s, trace in result.paper.items()}
    published = {s: _distance(result, result.published.columns[s].theta) for s in PAPER_SAMPLERS}
    cost = {s: int(trace.attrs["n_solves"]) for s, trace in result.paper.items()}
    table["sampling_solves"] = [int(trace.attrs["n_solves"]) for trace in result.long.values()]
    table["ess_per_sampling_solve"] = table["ess_bulk_min"] / table["sampling_solves"]
    table["needed_solves"] = [result.needed[s].solves for s in table.index]
    table["needed_draws"] = [result.needed[s].draws for s in table.index]
    table["paper_solves"] = [cost.get(s) for s in table.index]
    pace = {s: solves_at_this_pace(trace) for s, trace in result.pace.items()}
    table["paper_needed_solves"] = [pace.get(s) for s in table.index]
    for column in ("needed_solves", "needed_draws", "paper_solves", "paper_needed_solves"):
        table[column] = table[column].astype("Int64")
    table["paper_error"] = [off.get(s, np.nan) for s in table.index]
    table["published_error"] = [published.get(s, np.nan) for s in table.index]
    return table


def agreement(result: Result) -> tuple[float, float, tuple[str, ...]]:
    """Return how well the converged long runs agree, and which they are.

    Returns
    -------
    in_sd, in_mcse : float
        Largest difference of two posterior means over all parameters: in posterior sd, and in standard errors of
        that difference. NaN with fewer than two converged runs.
    samplers : tuple of str
    """
    from fmu.analysis.convergence.diagnostics import summary

    names = tuple(s for s in result.long if result.is_converged(s))
    tables = [summary(result.long[s]) for s in names]
    in_sd = in_mcse = np.nan
    for i, one in enumerate(tables):
        for other in tables[:i]:
            difference = np.abs(one["mean"].to_numpy() - other["mean"].to_numpy())
            error = np.hypot(one["mcse_mean"].to_numpy(), other["mcse_mean"].to_numpy())
            in_sd = float(np.fmax(in_sd, np.max(difference / result.reference.sd)))
            in_mcse = float(np.fmax(in_mcse, np.max(difference / error)))
    return in_sd, in_mcse, names


def _distance(result: Result, theta: FloatArray) -> float:
    return float(np.max(np.abs(theta - result.reference.mean) / result.reference.sd))
