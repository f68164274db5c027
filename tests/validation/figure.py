"""The figure of simulation-based calibration: distribution functions of the ranks minus the uniform one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from fmu.report.plots.style import FONT, GREY, PALE, colour, new_figure, tint
from tests.validation.bands import UniformRanks
from tests.validation.calibration import DRAWS, QUANTITIES, Calibration
from tests.validation.contenders import CONTENDERS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

USUAL = 0.05
"""Level of the second band, a usual level that is easy to judge by eye."""


def plot_calibration(calibrations: Mapping[str, Calibration], level: float) -> Figure:
    """Draw one panel per sampler and quantity, with the band of `level` and a band of 95 %."""
    names = {contender.title: contender.sampler.name for contender in CONTENDERS}
    figure = new_figure(2.6 * len(QUANTITIES) + 0.6, 1.45 * len(calibrations) + 0.8)
    axes = figure.subplots(len(calibrations), len(QUANTITIES), sharex=True, sharey=True, squeeze=False)
    for row, (title, found) in zip(axes, calibrations.items(), strict=True):
        uniform = UniformRanks(len(found.ranks), DRAWS)
        z, n = np.concatenate([[0.0], uniform.points, [1.0]]), uniform.replicates
        for panel, ranks in zip(row, found.ranks.T, strict=True):
            for at, shade, label in ((level, PALE, f"gate (level {level:.1e})"), (USUAL, tint(GREY, 0.7), "95 %")):
                band = uniform.simultaneous_band(at)
                lowest, highest = (np.concatenate([[0], edge, [n]]) / n - z for edge in band)
                panel.fill_between(z, lowest, highest, color=shade, linewidth=0, label=label)
            ecdf = np.concatenate([[0], uniform.counts(ranks), [n]]) / n
            panel.plot(z, ecdf - z, color=colour(names[title]), linewidth=1.5)
            panel.axhline(0.0, color=GREY, linewidth=0.6)
            panel.tick_params(labelsize=FONT - 1)
        row[0].set_ylabel(title.replace(", ", ",\n").replace("–", "–\n"), fontsize=FONT)
    for panel, quantity in zip(axes[0], QUANTITIES, strict=True):
        panel.set_title(quantity, fontsize=FONT + 1)
    axes[0, 0].set_xlim(0.0, 1.0)
    axes[0, 0].set_xticks([0.0, 0.5, 1.0], ["0", "0.5", "1"])
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, fontsize=FONT - 1, frameon=False,
                  title="simultaneous bands", title_fontsize=FONT - 1)  # fmt: skip
    figure.supxlabel(f"rank of the true value among {DRAWS} draws, scaled to 0…1", fontsize=FONT)
    figure.supylabel("ECDF of the ranks minus uniform", fontsize=FONT)
    return figure
