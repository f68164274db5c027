"""Page and figure of the study of verdicts on the model."""

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
from tests.validation.fit import (
    CHAINS,
    DRAWS,
    FLOOR,
    FOUND,
    MODE,
    NOISE_SPREAD,
    SD,
    SPREAD,
    STOREY,
    WARMUP,
    Rate,
    Study,
)

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
    first = study.right[0]
    count = f"{first.count(CONTRADICTED)} of {first.n}"
    verdict = f"**{count} simulated problems with a correct model were contradicted. "
    if study.failures:
        verdict += "Gates that fail:**\n\n" + "\n".join(f"- {failure}" for failure in study.failures)
    else:
        verdict += "All gates pass.**"
    found = [one for rate in study.all for one in rate.outcomes]
    return PAGE.format(
        verdict=verdict,
        interval=_interval(first),
        level=share(LEVEL),
        required=share(FOUND),
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
    header = ("size of the error", "problems", "contradicted", "95 % interval of the rate",
              "failed: a mode predicted from the others", "failed: residuals")  # fmt: skip
    return f"### {name[0].upper()}{name[1:]}\n\n{markdown_table(header, rows)}"


def plot_rates(study: Study) -> Figure:
    """Draw the rate of "contradicted", in all and by each kind of check, over the size of each error."""
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
                       linewidth=1.0, linestyle="--", label=f"failed: {label}")  # fmt: skip
        panel.axhline(LEVEL, color=GREY, linewidth=0.8, linestyle=":", label=f"level, {share(LEVEL)}")
        panel.set_xlabel(name.replace(", ", ",\n"), fontsize=FONT)
        panel.tick_params(labelsize=FONT - 1)
        panel.set_ylim(-0.03, 1.03)
    axes[0].set_ylabel("fraction of the simulated problems", fontsize=FONT)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, fontsize=FONT - 1, frameon=False)
    return figure


PAGE = """# False alarms and power of the verdict on the model

How often does `fmu.diagnose` contradict a correct model, and how often a wrong one? {verdict}

The 95 % interval of the rate of these false alarms is {interval}; the checks promise at most {level}
([fmu/analysis/fit/checks.py](../fmu/analysis/fit/checks.py)). The study has three gates. The number of false
alarms must be compatible with {level}. The largest error of each kind must be found in at least {required} of the
problems. With no more data than parameters, every verdict must be “contradicted” or, in general, “not testable”
(“not contradicted” if a mode was held out).

The simulated structure is a shear building of eight storeys, computed without fmu. The model has the stiffnesses
of three groups of storeys (1–2, 3–5, 6–8) as parameters, with log-normal priors (sd {spread:g} of the logarithm).
Six frequencies are measured with a noise of {sd}. If the noise is inferred, its prior is log-normal (sd {noise:g}
of the logarithm). All {runs} problems are updated by Hamiltonian Monte Carlo ({chains} chains of {draws} draws
after {warmup} steps of warm-up), in {minutes:.0f} minutes of processor time. The runs are short: {converged} of
them count as converged. In practice, the verdicts of the others would be marked as provisional.

## Correct models

{right}
The level of {level} holds for the first two rows, in which true values and noise are drawn from the priors and
the error model. In the last two rows, the true values are improbable under the priors, and the level is not
promised.

## Wrong models

{wrong} problems have one of three errors: a mass on floor {floor} that the model lacks, a stiffness of storey
{storey} below the rest of its group, or an error of the frequency of mode {mode}, with either sign.

![Rate of contradicted models over the size of the error](fit/rates.png)

{curves}
Small errors are not found, because the parameters can follow them within their priors and the noise.

## No more data than parameters

{few}
A model with no fewer parameters than data can follow the measurement, whether the model is correct or not. The
verdict is therefore “not testable”, unless a mode was held out or the priors exclude the data.
"""
