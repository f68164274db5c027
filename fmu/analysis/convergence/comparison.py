"""Samplers side by side: what each reached, and what it cost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.analysis.convergence.diagnosis import CONVERGED as CONVERGED
from fmu.analysis.convergence.diagnosis import Diagnosis, diagnose_all
from fmu.analysis.convergence.diagnostics import summary
from fmu.analysis.trace.conversion import check_trace

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem


def compare(traces: Mapping[str, xr.DataTree], problem: UpdatingProblem | None = None) -> pd.DataFrame:
    """Compare the traces of several samplers on one problem.

    What a sampler costs is what its user waits for: ``n_solves``, ``n_gradients`` and ``wall_s`` count the warm-up
    in, and so do ``ess_per_solve`` and ``ess_per_s``. The counts without it are attributes of each trace.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces under the names that the rows shall have.
    problem : UpdatingProblem, optional
        What was sampled. Its maxima are searched for, and a run that left out one that matters has not converged.
        Maxima that a trace keeps, and what the other runs on the same posterior found, count without it too.

    Returns
    -------
    pandas.DataFrame
        One row a sampler:

        - ``verdict``: ``"converged"``, or ``"not converged: "`` and the first reason of `fmu.diagnose`;
        - ``rhat_max``, ``ess_bulk_min``, ``ess_tail_min``: of the worst parameter, NaN if one is NaN;
        - ``mcse_over_sd_max``: largest standard error of a posterior mean over the posterior's sd;
        - ``accept_rate``: share of the retained draws that left the previous position;
        - ``divergences``: retained draws whose trajectory diverged, missing for samplers without trajectories;
        - ``n_solves``, ``n_gradients``, ``wall_s``: cost, warm-up included;
        - ``ess_per_solve``, ``ess_per_s``: the smallest bulk ESS per solve and per second of that cost.

    Raises
    ------
    ValueError
        If `traces` is empty or holds something else than traces.
    """
    if not isinstance(traces, Mapping) or not traces:
        raise ValueError(f"traces: must be a mapping of at least one name to a trace (got {traces!r:.60})")
    for name, trace in traces.items():
        check_trace(trace, f"traces.{name}")
    summaries = {name: summary(trace) for name, trace in traces.items()}
    return side_by_side(traces, summaries, diagnose_all(traces, problem, summaries))


def side_by_side(
    traces: Mapping[str, xr.DataTree], summaries: Mapping[str, pd.DataFrame], verdicts: Mapping[str, Diagnosis]
) -> pd.DataFrame:
    """Return the table of `compare`, where summaries and verdicts are at hand."""
    import pandas as pd

    rows = [_row(trace, summaries[name], verdicts[name]) for name, trace in traces.items()]
    table = pd.DataFrame(rows, index=pd.Index(list(traces), name="sampler"))
    table["divergences"] = table["divergences"].astype("Int64")
    return table


def _row(trace: xr.DataTree, table: pd.DataFrame, diagnosis: Diagnosis) -> dict[str, Any]:
    """Return one row of the comparison."""
    import pandas as pd

    stats = trace["sample_stats"]
    # to_numpy(), because pandas skips NaN where a NaN must win.
    ess = float(np.min(table["ess_bulk"].to_numpy()))
    solves, gradients = (
        int(trace.attrs[name]) + int(trace.attrs[f"warmup_{name}"]) for name in ("n_solves", "n_gradients")
    )
    wall_s = float(trace.attrs["wall_s"])
    return {
        "verdict": diagnosis.verdict,
        "rhat_max": float(np.max(table["rhat"].to_numpy())),
        "ess_bulk_min": ess,
        "ess_tail_min": float(np.min(table["ess_tail"].to_numpy())),
        "mcse_over_sd_max": float(np.max((table["mcse_mean"] / table["sd"]).to_numpy())),
        "accept_rate": float(stats["accepted"].mean()),
        "divergences": int(stats["diverging"].sum()) if "diverging" in stats else pd.NA,
        "n_solves": solves,
        "n_gradients": gradients,
        "wall_s": wall_s,
        "ess_per_solve": ess / solves if solves else np.nan,
        "ess_per_s": ess / wall_s if wall_s > 0 else np.nan,
    }
