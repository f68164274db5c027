"""Compute a run's summary, diagnosis and costs once for all report pages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from fmu.analysis.convergence.comparison import compare_runs
from fmu.analysis.convergence.diagnosis import Diagnosis, maxima_of
from fmu.analysis.prediction import predict_frequencies
from fmu.analysis.trace.reading import check_trace, has, parameter_names, problem_of, walkers_of, without_scores
from fmu.numbers import Unit
from fmu.posterior.parameters import prior_in_words
from fmu.report.document import breaking_at_commas
from fmu.report.plots.style import TITLES, unit_of

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.maxima.results import Maxima


@dataclass(frozen=True, eq=False)
class ReportedRun:
    """A trace with its summary, diagnosis and costs.

    Attributes
    ----------
    name : str
        The trace's key in the mapping given to `runs_of`.
    trace : xarray.DataTree
        The trace. If it has more than `fmu.analysis.trace.reading.MANY` parameters, the test scores are removed.
    summary : pandas.DataFrame
        The result of ``fmu.summary(trace)`` for the trace with all parameters.
    diagnosis : Diagnosis
    costs : pandas.Series
        This run's row in the comparison table of `fmu.analysis.convergence.comparison.compare_runs`.
    maxima : Maxima or None
        The maxima stored in the trace; None if there are none.
    prediction : pandas.DataFrame or None
        The result of ``predict_frequencies(trace)``; None if the trace has no computed or no measured frequencies.
    """

    name: str
    trace: xr.DataTree
    summary: pd.DataFrame
    diagnosis: Diagnosis
    costs: pd.Series
    maxima: Maxima | None
    prediction: pd.DataFrame | None

    @property
    def title(self) -> str:
        """Full name of the sampler if the run is named after a sampler, otherwise the run's name."""
        return TITLES.get(self.name, self.name)

    @property
    def sampler(self) -> str:
        """Full name of the sampler."""
        return TITLES.get(str(self.trace.attrs["sampler"]), str(self.trace.attrs["sampler"]))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return parameter_names(self.trace)

    def unit(self, name: str) -> Unit:
        """Return the unit in which the report shows the parameter `name`."""
        return unit_of(self.trace, name)

    def value(self, name: str, column: str) -> float:
        """Return a summary entry for the parameter `name`, in the unit in which the report shows it."""
        return float(self.summary[column][name]) / self.unit(name).factor

    @property
    def problem(self) -> dict[str, Any]:
        """The problem's configuration, as `UpdatingProblem.configuration` returns it.

        For a density that is not an `UpdatingProblem`, the dict contains only the entries that the trace records.
        """
        return problem_of(self.trace)

    @property
    def priors(self) -> dict[str, str]:
        """Each parameter's prior in words (`prior_in_words`). Parameters whose prior is unknown are omitted."""
        known = (p for p in self.problem.get("parameters", ()) if "prior" in p)
        return {p["name"]: breaking_at_commas(prior_in_words(p["prior"], p["unit"])) for p in known}

    @property
    def chains_in_words(self) -> str:
        """Number and length of the chains, and length of the warm-up, in words."""
        posterior, walkers = self.trace["posterior"], walkers_of(self.trace)
        chains, steps = posterior.sizes["chain"], posterior.sizes["draw"] // walkers
        many = "" if chains == 1 else "s"
        kind = f"chain{many}" if walkers == 1 else f"ensemble{many} of {walkers} walkers"
        return f"{chains} {kind}, {steps} steps each, after {self.trace.attrs['warmup']} of warm-up"


def runs_of(traces: Mapping[str, xr.DataTree]) -> dict[str, ReportedRun]:
    """Return each trace's `ReportedRun`, after comparing the traces with each other.

    Raises
    ------
    ValueError
        If `traces` is empty, or contains objects that are not traces, or traces of different problems.
    """
    if not traces:
        raise ValueError("traces: at least one is needed (got none)")
    for name, trace in traces.items():
        check_trace(trace, f"traces.{name}")
    problems = {str(trace.attrs["problem"]) for trace in traces.values()}
    if len(problems) > 1:
        raise ValueError(f"traces: must be of one problem (got {', '.join(sorted(problems))})")
    summaries, verdicts, comparison = compare_runs(traces)
    costs = comparison.T
    return {
        name: ReportedRun(
            name,
            without_scores(trace),
            summaries[name],
            verdicts[name],
            costs[name],
            maxima_of(trace),
            _predict(trace),
        )
        for name, trace in traces.items()
    }


def _predict(trace: xr.DataTree) -> pd.DataFrame | None:
    has_frequencies = has(trace, "posterior_predictive") and has(trace, "observed_data")
    return predict_frequencies(trace) if has_frequencies else None
