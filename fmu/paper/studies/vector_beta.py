"""Test the paper's remark that a vector β, with one weight per mode, would improve the first frequency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.diagnosis import diagnose
from fmu.analysis.convergence.diagnostics import summary
from fmu.analysis.maxima.search import find_map
from fmu.numbers import fixed, given, share
from fmu.paper.experiment import PAIRED_BY, Result, directory_of, posterior_mean, rows_of
from fmu.paper.plan import Plan, Runs, long_settings
from fmu.paper.published import EXPERIMENTS
from fmu.paper.studies.moments import moments, moments_table
from fmu.progress import Report
from fmu.report.plots import BLACK, COLOURS, FONT, GREY, finish, new_figure
from fmu.tables import data_frame, markdown_table
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure


SAMPLER = "hmc"
RELATIVE = 0.01
"""Standard deviation of every frequency error relative to the measured frequency."""
SCALAR, VECTOR = "scalar", "vector"


def relative_weights(frequencies_hz: FloatArray) -> FloatArray:
    """Return each mode's weight β_i = 1/(2σ_i²) in 1/Hz², where σ_i is `RELATIVE` times the frequency."""
    return 1.0 / (2.0 * (RELATIVE * frequencies_hz) ** 2)


@dataclass(frozen=True)
class VectorBeta:
    """Tables that compare the results with a scalar β and with a vector β.

    Attributes
    ----------
    case, pairing : str
    modes : DataFrame
        One row per measured mode. Columns ``*_hz`` are frequencies in Hz, and columns ``*_error`` are errors
        |f − f_m|/f_m in %: ``measured`` (without error), ``initial``, ``published`` (the paper's HMC column), and
        ``scalar`` and ``vector`` (the model at the posterior mean with each β). Columns ``*_sigma_hz`` are the
        frequency error sd that corresponds to each β, in Hz.
    parameters : DataFrame
        One row per parameter, SI units: ``unit``, and the posterior mean and sd with each β.
    runs : DataFrame
        One row per β (`SCALAR`, `VECTOR`): ``converged``, the largest ``rhat``, and the smallest bulk ESS ``ess``.
    reasons : mapping of str to tuple of str
        The reasons why the run has not converged, keyed by β.
    """

    case: str
    pairing: str
    modes: pd.DataFrame
    parameters: pd.DataFrame
    runs: pd.DataFrame
    reasons: Mapping[str, tuple[str, ...]]

    @property
    def name(self) -> str:
        """Name of the experiment, for example ``"young-shape"``."""
        return directory_of(self.case, self.pairing)

    @property
    def title(self) -> str:
        """The experiment in words."""
        return f"section {EXPERIMENTS[self.case].section}, paired {PAIRED_BY[self.pairing]}"

    @property
    def outcome(self) -> str:
        """The verdict on whether the vector β reduces the error in mode 1.

        It is ``"confirmed"``, ``"not confirmed"`` or, unless both runs converged, ``"cannot be judged"``.
        """
        if not self.runs["converged"].all():
            return "cannot be judged"
        first = self.modes.iloc[0]
        return "confirmed" if first["vector_error"] < first["scalar_error"] else "not confirmed"


def sample_weighted(result: Result, plan: Plan, progress: Report | None = None) -> xr.DataTree:
    """Repeat an experiment's long HMC run with a separate weight for every mode, and return the trace.

    The sampler's settings, the lengths and the seed are the same as in the long run. The chains start at draws
    from the prior, and make jumps if several maxima are known (`fmu.sample`).
    """
    from fmu import cases

    beta = relative_weights(result.published.measured_hz)
    problem = cases.load(result.published.case, result.pairing, beta=beta)
    maxima, length = find_map(problem, plan.starts, plan.seed), plan.long[SAMPLER]
    runs = Runs(problem, maxima, plan.seed, f"{result.name}, vector β", length.steps, progress)
    trace = runs.run(f"{SAMPLER}, long run", long_settings(SAMPLER), length)
    runs.finish()
    return trace


def side_by_side(result: Result, weighted: xr.DataTree) -> VectorBeta:
    """Return tables that compare the long HMC run with the scalar β and the run from `sample_weighted`."""
    import pandas as pd

    traces = {SCALAR: result.long[SAMPLER], VECTOR: weighted}
    diagnoses = {SCALAR: result.diagnoses[SAMPLER], VECTOR: diagnose(weighted)}
    summaries = {name: summary(trace) for name, trace in traces.items()}
    runs = {
        name: (diagnoses[name].converged, table["rhat"].max(), table["ess_bulk"].min())
        for name, table in summaries.items()
    }
    return VectorBeta(
        case=result.published.case,
        pairing=result.pairing,
        modes=_mode_table(result, traces),
        parameters=moments(result.problem, traces),
        runs=pd.DataFrame.from_dict(runs, orient="index", columns=["converged", "rhat", "ess"]),
        reasons={name: diagnosis.reasons for name, diagnosis in diagnoses.items()},
    )


def _mode_table(result: Result, traces: Mapping[str, xr.DataTree]) -> pd.DataFrame:

    published, problem = result.published, result.problem
    printed, error = published.columns[SAMPLER], published.error_percent
    before = problem.frequencies(problem.start)
    columns = {"measured_hz": published.measured_hz, "initial_hz": before, "initial_error": error(before)}
    columns |= {"published_hz": printed.printed_hz, "published_error": printed.printed_errors}
    beta = {SCALAR: np.ones(len(before)), VECTOR: relative_weights(published.measured_hz)}
    for name, trace in traces.items():
        at_mean = problem.frequencies(posterior_mean(trace))
        columns[f"{name}_sigma_hz"] = 1.0 / np.sqrt(2.0 * beta[name])
        columns |= {f"{name}_hz": at_mean, f"{name}_error": error(at_mean)}
    return data_frame(columns, "mode", problem.data.labels)


REMARK = (
    "The three methods did not improve the first natural frequency because the same coefficient, β, was set for "
    "all of the natural frequencies. Choosing β as a vector, to weight the natural frequencies, would improve the "
    "first natural frequency results."
)
"""The remark in section 5.1 of the paper, after Table 2."""
NAMES = {SCALAR: "scalar β = 1", VECTOR: f"vector β, σ = {share(RELATIVE)}"}


def vector_beta_page(studies: Sequence[VectorBeta]) -> str:
    """Return the Markdown text of vector-beta.md."""
    parts = [
        "# A β for every mode\n",
        f"The paper, section 5.1, after Table 2: *{REMARK}* It does not test this.\n",
        "Here HMC repeats its long run with the same lengths and seed, from draws of the prior and with jumps "
        "between maxima where there are several, with β_i = 1/(2σ_i²) and σ_i = "
        f"{share(RELATIVE)} of each measured frequency, in place of β = 1, which is σ = 0.71 Hz on every mode. "
        "Frequencies are those of the model at the posterior mean, errors |f − f_m|/f_m, as in the paper.\n",
        "".join(f"- {outcome(study)}\n" for study in studies),
        "The model cannot fit all modes at once; β decides which of them fit worse.\n",
        "![error of each mode](vector-beta.png)\n",
    ]
    for study in studies:
        parts += [
            f"## {study.title[0].upper()}{study.title[1:]}\n",
            _runs(study),
            _modes(study),
            moments_table(study.parameters, NAMES),
        ]
    return "\n".join(parts)


def outcome(study: VectorBeta) -> str:
    """Return sentences on how the error in mode 1 changes, and on the other modes' largest errors."""
    first, others = study.modes.iloc[0], study.modes.iloc[1:].max()
    return (
        f"{study.title}: {study.outcome}. Mode 1 is off by {fixed(first['initial_error'], 2)} % before "
        f"updating, {fixed(first['scalar_error'], 2)} % with the scalar β and "
        f"{fixed(first['vector_error'], 2)} % with the vector; the worst of the other modes by "
        f"{fixed(others['scalar_error'], 2)} % and {fixed(others['vector_error'], 2)} %."
    )


def _runs(study: VectorBeta) -> str:
    rows = [
        (NAMES[name], "yes" if row["converged"] else "**no**", fixed(row["rhat"], 4), fixed(row["ess"], 0))
        for name, row in rows_of(study.runs)
    ]
    failed = [f"- {NAMES[name]}: {reason}\n" for name, reasons in study.reasons.items() for reason in reasons]
    text = markdown_table(("HMC with", "converged", "R-hat", "bulk ESS"), rows, words=(0, 1))
    return text + "\n" + "".join(failed) if failed else text


def _modes(study: VectorBeta) -> str:
    header = ["mode", "measured, Hz"]
    for words in ("before updating", "published, HMC", *NAMES.values()):
        header += [f"{words}, Hz", "error, %"]
    rows = []
    for mode, row in rows_of(study.modes):
        cells = [mode, given(row["measured_hz"]), fixed(row["initial_hz"], 2), fixed(row["initial_error"], 2)]
        cells += [given(row["published_hz"]), given(row["published_error"])]
        for name in NAMES:
            cells += [fixed(row[f"{name}_{of}"], 2) for of in ("hz", "error")]
        rows.append(cells)
    return markdown_table(header, rows)


def plot_vector_beta(studies: Sequence[VectorBeta], figure: Figure | None = None) -> Figure:
    """Plot each mode's error before updating, as published, and with each β, in one panel per experiment."""
    figure = figure or new_figure(3.4 * len(studies) + 0.6, 4.2)
    frames = figure.subplots(1, len(studies), sharey=True, squeeze=False)[0]
    looks = {
        "initial": ("before updating", GREY, "white", "s"),
        "published": ("published, HMC", BLACK, "white", "D"),
        SCALAR: (f"HMC, {NAMES[SCALAR]}", COLOURS["hmc"], "white", "o"),
        VECTOR: (f"HMC, {NAMES[VECTOR]}", COLOURS["hmc"], COLOURS["hmc"], "o"),
    }
    for axes, study in zip(frames, studies, strict=True):
        x = np.arange(len(study.modes))
        for k, (name, (label, edge, face, marker)) in enumerate(looks.items()):
            at, error = x + 0.18 * (k - 1.5), study.modes[f"{name}_error"].to_numpy()
            axes.vlines(at, 0.0, error, color=edge, linewidth=1.2, alpha=0.5)
            axes.plot(at, error, linestyle="none", marker=marker, markersize=6, color=edge, markerfacecolor=face,
                      label=label, clip_on=False)  # fmt: skip
        labels = [f"{mode}\n{given(hz)}" for mode, hz in study.modes["measured_hz"].items()]
        axes.set_xticks(x, labels)
        axes.set_xlabel("mode, measured frequency in Hz", fontsize=FONT)
        axes.set_title(study.title, fontsize=FONT)
        finish(axes)
    frames[0].set_ylim(bottom=0.0)
    frames[0].set_ylabel("|computed − measured|/measured, %", fontsize=FONT)
    handles, words = frames[0].get_legend_handles_labels()
    figure.legend(handles, words, loc="outside lower center", ncols=2, fontsize=FONT - 1, frameon=False)
    return figure
