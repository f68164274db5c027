"""The page of the study of verdicts on the model, and its figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.fit.check import LEVEL, PREDICTED, RESIDUALS
from fmu.analysis.fit.model_fit import CONTRADICTED, NOT_CONTRADICTED, NOT_TESTABLE
from fmu.numbers import share
from fmu.report.plots.style import DPI, FONT, GREY, new_figure
from fmu.tables import markdown_table
from tests.validation.fit import CHAINS, DRAWS, FLOOR, MODE, NOISE_SPREAD, SD, SPREAD, STOREY, WARMUP, Rate, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_KINDS = {
    PREDICTED: ("#0072B2", "s", "a mode predicted from the others"),
    RESIDUALS: ("#D55E00", "^", "residuals"),
}


def write(study: Study, directory: Path) -> None:
    """Write ``fit.md`` and ``fit/rates.png`` into the directory."""
    (directory / "fit").mkdir(parents=True, exist_ok=True)
    plot_rates(study).savefig(directory / "fit" / "rates.png", dpi=DPI)
    (directory / "fit.md").write_text(page(study), encoding="utf-8")


def page(study: Study) -> str:
    """Return the page."""
    verdict = "**All gates pass.**"
    if study.failures:
        verdict = "**Gates that fail:**\n\n" + "\n".join(f"- {failure}" for failure in study.failures)
    first = study.right[0]
    found = [one for rate in study.all for one in rate.outcomes]
    return PAGE.format(
        verdict=verdict,
        k=first.count(CONTRADICTED),
        n=first.n,
        interval=_interval(first),
        level=share(LEVEL),
        right=_verdicts([*study.right]),
        few=_verdicts([*study.few]),
        curves="\n".join(_curve(name, rates) for name, rates in study.curves.items()),
        wrong=sum(rate.n for rates in study.curves.values() for rate in rates),
        sd=share(SD),
        spread=SPREAD,
        noise=NOISE_SPREAD,
        floor=FLOOR,
        storey=STOREY,
        mode=MODE,
        chains=CHAINS,
        warmup=WARMUP,
        draws=DRAWS,
        runs=len(found),
        converged=share(sum(one.converged for one in found) / len(found)),
        minutes=sum(one.seconds for one in found) / 60.0,
    )


def _interval(rate: Rate) -> str:
    low, high = rate.interval
    return f"{100 * low:.1f} to {100 * high:.1f} %"


def _verdicts(rates: list[Rate]) -> str:
    rows = [
        (
            rate.setting.label,
            str(rate.n),
            *(str(rate.count(verdict)) for verdict in (CONTRADICTED, NOT_CONTRADICTED, NOT_TESTABLE)),
            _interval(rate),
        )
        for rate in rates
    ]
    header = ("simulated", "problems", "contradicted", "not contradicted", "not testable",
              "95 % interval of the rate of “contradicted”")  # fmt: skip
    return markdown_table(header, rows)


def _curve(name: str, rates: Sequence[Rate]) -> str:
    rows = [
        (
            rate.setting.label,
            str(rate.n),
            str(rate.count(CONTRADICTED)),
            _interval(rate),
            *(share(rate.share(kind)) for kind in (PREDICTED, RESIDUALS)),
        )
        for rate in rates
    ]
    header = ("size", "problems", "contradicted", "95 % interval", "by a mode predicted from the others",
              "by the residuals")  # fmt: skip
    return f"### {name[0].upper()}{name[1:]}\n\n{markdown_table(header, rows)}"


def plot_rates(study: Study) -> Figure:
    """Draw the rate of "contradicted" over the size of each error, and of each kind of check."""
    figure = new_figure(9.6, 3.4)
    axes = figure.subplots(1, len(study.curves), sharey=True, squeeze=False)[0]
    right = study.right[0]
    for panel, (name, rates) in zip(axes, study.curves.items(), strict=True):
        x = np.array([float(rate.setting.label) for rate in rates])
        y = np.array([rate.count(CONTRADICTED) / rate.n for rate in rates])
        low, high = np.array([rate.interval for rate in rates]).T
        at, of_right = np.append(0.0, x), np.append(right.count(CONTRADICTED) / right.n, y)
        low, high = (np.append(end, ends) for end, ends in zip(right.interval, (low, high), strict=True))
        panel.errorbar(at, of_right, [of_right - low, high - of_right], color="black", marker="o", markersize=5,
                       linewidth=1.5, elinewidth=0.8, capsize=2, label="contradicted, 95 % interval")  # fmt: skip
        for kind, (colour, marker, label) in _KINDS.items():
            panel.plot(x, [rate.share(kind) for rate in rates], color=colour, marker=marker, markersize=4,
                       linewidth=1.0, linestyle="--", label=f"by {label}")  # fmt: skip
        panel.axhline(LEVEL, color=GREY, linewidth=0.8, linestyle=":", label=f"{share(LEVEL)}")
        panel.set_xlabel(name.replace(", ", ",\n"), fontsize=FONT)
        panel.tick_params(labelsize=FONT - 1)
        panel.set_ylim(-0.03, 1.03)
    axes[0].set_ylabel("share of the simulated problems", fontsize=FONT)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, fontsize=FONT - 1, frameon=False)
    return figure


PAGE = """# How often is a right model contradicted, and a wrong one?

Written by `python -m tests.validation.fit results` ({minutes:.0f} min of one processor, {runs} runs); every number
is computed. The verdict and its checks are described in
[fmu/analysis/fit/checks.py](../fmu/analysis/fit/checks.py).

{verdict}

Of {n} simulated problems whose model is right, {k} were contradicted (95 % interval of the rate: {interval}); the
checks promise at most {level}.

A shear building of eight storeys, its truth computed without fmu. The model has the stiffnesses of three groups of
storeys (1–2, 3–5, 6–8) as parameters, with log-normal priors of {spread:g}, and six measured frequencies with a
noise of {sd}. Where the noise is inferred, its prior is log-normal with {noise:g}. Each problem is updated by
Hamiltonian Monte Carlo, {chains} chains of {draws} draws after {warmup} of warm-up, and judged by `fmu.diagnose`.
So short, {converged} of the runs count as converged; on a page the verdicts of the others would be marked as
provisional.

## The model is right

{right}
The first two rows are what the level of {level} is promised for: truth and noise drawn as the priors and the error
model say. In the others the truth is where the priors hardly expect it, which is not promised.

## The model is wrong

{wrong} problems. The mass is missing from floor {floor}; storey {storey} is softer than the others of its group;
or the frequency of mode {mode} is off, to either side.

![Rate of contradicted models over the size of the error](fit/rates.png)

{curves}
Small errors are not found: the parameters follow them within what their priors and the noise allow.

## No more data than parameters

{few}
With no more data than parameters the model follows what was measured, whether it is right or not: the verdict is
“not testable”, unless a mode was held out, or the priors do not reach the data.
"""
