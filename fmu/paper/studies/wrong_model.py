"""Repeat the experiments with a model that may be wrong.

The paper's likelihood assumes that the model is correct. Here the parameters may scatter from mode to mode
(`fmu.posterior.discrepancy.embedded`). Each mode is predicted from the other modes, with and without scatter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.held_out.modes import kept_table, with_left_out
from fmu.analysis.models.comparison import compare_traces
from fmu.numbers import MISSING, decimals, fixed, given, interval, share
from fmu.paper.experiment import PAIRED_BY, Result, rows_of
from fmu.paper.plan import Plan, Runs
from fmu.paper.studies.moments import moments, moments_table
from fmu.posterior.discrepancy.embedded import Discrepancy
from fmu.posterior.problem import UpdatingProblem
from fmu.progress import Report
from fmu.report.plots import BLACK, COLOURS, FONT, GREY, finish, new_figure
from fmu.samplers import make_sampler
from fmu.tables import data_frame, markdown_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

    from fmu.types import FloatArray


SAMPLER = "mixture"
WITHOUT, WITH = "without", "with"
NAMES = {WITHOUT: "without scatter", WITH: "with scatter"}
_COLUMNS = ("mean", "sd", "eti90_lb", "eti90_ub")
_SUMMARY = (
    "", "inside, without", "with", "rms error, sd, without", "with", "τ", "log-evidence, with less without",
)  # fmt: skip
_MODES = (
    "mode", "measured, Hz", "without: 90 %, Hz", "off by, sd", "with scatter: 90 %, Hz", "off by, sd",
)  # fmt: skip


@dataclass(frozen=True)
class WrongModel:
    """Tables that compare a model with and without parameter scatter over the modes.

    Attributes
    ----------
    title : str
        The measurement in words, used as a heading.
    name : str
        Name of the experiment, for example ``"young-shape"``.
    modes : DataFrame
        One row per measured mode. ``measured_hz`` is the measured frequency. Each model (`WITHOUT`, `WITH`)
        predicts this frequency from the other modes. ``*_mean``, ``*_sd``, ``*_eti90_lb`` and ``*_eti90_ub``
        describe the prediction in Hz. ``*_off`` is the measured frequency minus the predicted mean, in predictive
        standard deviations.
    parameters : DataFrame
        One row per parameter of the model with scatter, SI units: ``unit``, and the posterior mean and sd under
        each model.
    runs : DataFrame
        One row per model, with the columns of `fmu.compare_models`.
    """

    title: str
    name: str
    modes: pd.DataFrame
    parameters: pd.DataFrame
    runs: pd.DataFrame

    @classmethod
    def of(
        cls,
        title: str,
        name: str,
        problems: Mapping[str, UpdatingProblem],
        traces: Mapping[str, xr.DataTree],
    ) -> WrongModel:
        """Compare the models `WITHOUT` and `WITH` by leaving out each mode in turn.

        If the data are from a single test, the model is updated again without each mode in turn. Several tests
        have too many modes for this, so the draws are reweighted instead. If parameters have populations over the
        tests, each weight is an integral over the scores of the mode's test
        (`fmu.analysis.held_out.without_scores`).

        Raise ValueError if a trace has fewer than two measured modes, or if the traces do not have the same data.
        """
        known = {
            model: with_left_out(
                traces[model], problem, np.inf if len(problem.tests) == 1 or problem.is_hierarchical else 0.0
            )
            for model, problem in problems.items()
        }
        columns: dict[str, FloatArray] = {}
        for model, trace in known.items():
            table = kept_table(trace)
            if table is None:
                raise ValueError(f"traces.{model}: must be of two or more measured modes")
            columns["measured_hz"] = table["measured"].to_numpy()
            columns |= {f"{model}_{column}": table[column].to_numpy() for column in _COLUMNS}
            columns[f"{model}_off"] = ((table["measured"] - table["mean"]) / table["sd"]).to_numpy()
        modes = data_frame(columns, "mode", problems[WITH].data.labels)
        return cls(title, name, modes, moments(problems[WITH], known), compare_traces(known).table)


def allow_for_scatter(problem: UpdatingProblem) -> UpdatingProblem:
    """Return a copy of one of the paper's problems whose parameters may scatter from mode to mode."""
    return UpdatingProblem(
        problem.model, problem.data, problem.parameters, error="frequency", discrepancy=Discrepancy()
    )


def study_wrong_model(
    result: Result, plan: Plan, progress: Report | None = None
) -> tuple[xr.DataTree, WrongModel]:
    """Sample an experiment whose parameters may scatter; return the trace and a comparison with the long run."""
    from fmu.analysis.maxima.search import find_map

    problem = allow_for_scatter(result.problem)
    maxima = find_map(problem, plan.starts, plan.seed)
    runs = Runs(problem, maxima, plan.seed, f"{result.name}, scatter", plan.wrong.steps, progress)
    trace = runs.run("with scatter", make_sampler(SAMPLER), plan.wrong)
    runs.finish()
    title = f"section {result.published.section}, paired {PAIRED_BY[result.pairing]}"
    problems = {WITHOUT: result.problem, WITH: problem}
    return trace, WrongModel.of(title, result.name, problems, {WITHOUT: result.long[SAMPLER], WITH: trace})


def wrong_model_page(studies: Sequence[WrongModel]) -> str:
    """Return the Markdown text of model-error.md."""
    parts = [
        "# A model that may be wrong\n",
        "The data contradict the model in all experiments of the paper: no parameters fit all modes. The paper's "
        "likelihood trusts the model nevertheless, and its posterior is too narrow. Here each mode sees "
        "parameters of its own, θ (1 + τ z) with independent standard normal z (`fmu.Discrepancy()`, "
        "`[[discrepancy]]`); the scatter τ is inferred, with a half-normal prior of "
        "standard deviation 10 %. All else is as before.\n",
        f"{HOW_TO_READ}\n",
        summary_table(studies),
        "![each mode predicted by the others](model-error.png)\n",
    ]
    for study in studies:
        parts += [f"## {study.title[0].upper()}{study.title[1:]}\n", modes_table(study), runs_sentence(study)]
        parts += [moments_table(study.parameters, NAMES)]
    return "\n".join(parts)


HOW_TO_READ = (
    "Each measured mode is predicted by the others: the model is updated without the mode. Intervals are of the "
    "measurement and hold 90 % of the prediction. *Inside*: measured frequencies within them. *Off by*: distance "
    "of the measured frequency from the mean of the prediction, in standard deviations of the prediction. The "
    "difference of the log-evidences is in favour of the scatter where it is positive."
)


def summary_table(studies: Sequence[WrongModel]) -> str:
    """Return a table with one row per study: modes inside their intervals, errors, τ and log-evidence gain."""
    rows = []
    for study in studies:
        every, tau = dict(rows_of(study.runs)), dict(rows_of(study.parameters))["tau"]
        less, more = runs = [every[model] for model in NAMES]
        rows.append([
            study.title,
            *(f"{run['inside']} of {run['held_out']}" for run in runs),
            *(fixed(np.sqrt(run["sum_z2"] / max(run["held_out"], 1)), 1) for run in runs),
            f"{share(tau['with_mean'])} ± {share(tau['with_sd'])}",
            fixed(more["log_evidence"] - less["log_evidence"], 1),
        ])  # fmt: skip
    return markdown_table(_SUMMARY, rows)


def modes_table(study: WrongModel) -> str:
    """Return a table of the measured modes, each predicted from the other modes, without and with scatter."""
    rows = []
    for mode, row in rows_of(study.modes):
        cells = [mode, given(row["measured_hz"])]
        for model in NAMES:
            low, high, sd, off = (row[f"{model}_{of}"] for of in ("eti90_lb", "eti90_ub", "sd", "off"))
            cells += [interval(low, high, decimals(sd)) if np.isfinite(sd) else MISSING, fixed(off, 1)]
        rows.append(cells)
    return markdown_table(_MODES, rows)


def runs_sentence(study: WrongModel) -> str:
    """Return a sentence on each run: whether it has converged, and the verdict on the model."""
    said, runs = [], dict(rows_of(study.runs))
    for model, words in NAMES.items():
        run = runs[model]
        state = "converged" if run["converged"] else "**not converged**"
        said.append(f"{words[0].upper()}{words[1:]}: {state}; the model is {run['verdict']}.")
    return " ".join(said) + "\n"


def plot_wrong_model(studies: Sequence[WrongModel], figure: Figure | None = None) -> Figure:
    """Plot the errors, in %, with which each measured frequency is predicted from the other modes.

    There is one panel per experiment, with means and 90 % intervals of the predictions without and with scatter.
    """
    figure = figure or new_figure(7.6, 2.6 * ((len(studies) + 1) // 2) + 0.8)
    frames = figure.subplots((len(studies) + 1) // 2, 2, sharex=True, squeeze=False).ravel()
    looks = {WITHOUT: (GREY, "s"), WITH: (COLOURS[SAMPLER], "o")}
    for axes, study in zip(frames, studies, strict=False):
        x, measured = np.arange(len(study.modes)), study.modes["measured_hz"].to_numpy()
        axes.axhline(0.0, color=BLACK, linewidth=1.0, label="measured")
        for k, (model, (colour, marker)) in enumerate(looks.items()):
            mean, low, high = (
                100.0 * (study.modes[f"{model}_{of}"].to_numpy() / measured - 1.0)
                for of in ("mean", "eti90_lb", "eti90_ub")
            )
            at = x + 0.24 * (k - 0.5)
            axes.vlines(at, low, high, color=colour, linewidth=2.0)
            axes.plot(at, mean, linestyle="none", marker=marker, markersize=6, color=colour, label=NAMES[model])
        axes.set_xticks(x, [f"{mode}\n{given(hz)}" for mode, hz in study.modes["measured_hz"].items()])
        axes.set_title(study.title, fontsize=FONT)
        finish(axes)
    for axes in frames[len(studies) :]:
        axes.set_visible(False)
    for axes in frames[-2:]:
        axes.set_xlabel("mode, measured frequency in Hz", fontsize=FONT)
    for axes in frames[::2]:
        axes.set_ylabel("error of the prediction, %", fontsize=FONT)
    handles, words = frames[0].get_legend_handles_labels()
    figure.legend(handles, words, loc="outside lower center", ncols=3, fontsize=FONT - 1, frameon=False)
    return figure
