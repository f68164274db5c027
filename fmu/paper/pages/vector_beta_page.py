"""The page and the figure of the study with a β for every mode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.numbers import fixed, given, share, with_sd
from fmu.paper.pages.run_sections import rows_of
from fmu.paper.vector_beta import RELATIVE, SCALAR, VECTOR, VectorBeta
from fmu.report.markdown import table
from fmu.report.plots import BLACK, COLOURS, FONT, GREY, finish, new_figure
from fmu.report.units import shown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REMARK = (
    "The three methods did not improve the first natural frequency because the same coefficient, β, was set for "
    "all of the natural frequencies. Choosing β as a vector, to weight the natural frequencies, would improve the "
    "first natural frequency results."
)
"""Section 5.1, the paragraphs behind Table 2."""
NAMES = {SCALAR: "scalar β = 1", VECTOR: f"vector β, σ = {share(RELATIVE)}"}


def vector_beta_page(studies: Sequence[VectorBeta]) -> str:
    """Return vector-beta.md."""
    parts = [
        "# A β for every mode\n",
        f"The paper, section 5.1, behind Table 2: *{REMARK}* It does not try.\n",
        "Here HMC repeats its long run, settings and seed the same, with β_i = 1/(2σ_i²) and σ_i = "
        f"{share(RELATIVE)} of each measured frequency, in place of β = 1, which is σ = 0.71 Hz on every mode. "
        "Frequencies are those of the model at the posterior mean, errors |f − f_m|/f_m, as in the paper.\n",
        "".join(f"- {outcome(study)}\n" for study in studies),
        "Where the model cannot fit all modes at once, β decides which of them give way.\n",
        "![error of each mode](vector-beta.png)\n",
    ]
    for study in studies:
        parts += [
            f"## {study.title[0].upper()}{study.title[1:]}\n",
            _runs(study),
            _modes(study),
            _parameters(study),
        ]
    return "\n".join(parts)


def outcome(study: VectorBeta) -> str:
    """Say in a line what became of mode 1, and at what price."""
    first, others = study.modes.iloc[0], study.modes.iloc[1:].max()
    return (
        f"{study.title}: {study.outcome}. Mode 1 is off by {fixed(first['initial_error'], 2)} % before "
        f"updating, {fixed(first['scalar_error'], 2)} % with the scalar β and "
        f"{fixed(first['vector_error'], 2)} % with the vector; the worst of the other modes by "
        f"{fixed(others['scalar_error'], 2)} % and {fixed(others['vector_error'], 2)} %."
    )


def _runs(study: VectorBeta) -> str:
    rows = [
        (NAMES[name], "yes" if row.converged else "**no**", fixed(row.rhat, 4), fixed(row.ess, 0))
        for name, row in rows_of(study.runs)
    ]
    failed = [f"- {NAMES[name]}: {reason}\n" for name, reasons in study.reasons.items() for reason in reasons]
    text = table(("HMC with", "converged", "R-hat", "bulk ESS"), rows, words=(0, 1))
    return text + "\n" + "".join(failed) if failed else text


def _modes(study: VectorBeta) -> str:
    header = ["mode", "measured, Hz"]
    for words in ("before updating", "published, HMC", *NAMES.values()):
        header += [f"{words}, Hz", "error, %"]
    rows = []
    for mode, row in rows_of(study.modes):
        cells = [mode, given(row.measured_hz), fixed(row.initial_hz, 2), fixed(row.initial_error, 2)]
        cells += [given(row.published_hz), given(row.published_error)]
        for name in NAMES:
            cells += [fixed(getattr(row, f"{name}_{of}"), 2) for of in ("hz", "error")]
        rows.append(cells)
    return table(header, rows)


def _parameters(study: VectorBeta) -> str:
    rows = []
    for name, row in rows_of(study.parameters):
        unit = shown(row.unit)
        moments = [[getattr(row, f"{b}_{of}") / unit.factor for of in ("mean", "sd")] for b in NAMES]
        cells = [with_sd(mean, sd) for mean, sd in moments]
        rows.append((unit.label(name), *cells))
    return "Posterior mean and standard deviation:\n\n" + table(("parameter", *NAMES.values()), rows)


def plot_vector_beta(studies: Sequence[VectorBeta], figure: Figure | None = None) -> Figure:
    """Draw the error of every mode with the scalar and with the vector β, one frame an experiment."""
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
