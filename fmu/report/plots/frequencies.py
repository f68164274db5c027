"""Frequencies: measured, before updating and after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fmu.report.plots.style import BLACK, FONT, PALE, finish, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Frequencies:
    """A set of frequencies to compare with the measured ones.

    Attributes
    ----------
    label : str
    hz : array_like, shape (n_modes,)
    colour : str
    filled : bool
        Whether its markers are filled.
    interval_hz : array_like, shape (2, n_modes), optional
    """

    label: str
    hz: ArrayLike
    colour: str
    filled: bool = True
    interval_hz: ArrayLike | None = None


def plot_frequency_errors(
    measured_hz: ArrayLike, series: Sequence[Frequencies], labels: Sequence[str], figure: Figure | None = None
) -> Axes:
    """Draw how far sets of frequencies lie from the measured ones, in % and with their sign.

    Parameters
    ----------
    measured_hz : array_like, shape (n_modes,)
    series : sequence of Frequencies
        Side by side within each mode, in this order.
    labels : sequence of str
        Of the modes.
    """
    measured = np.asarray(measured_hz, dtype=float)
    figure = figure or new_figure(7.2, 4.4)
    axes = figure.subplots()
    centre = np.arange(len(measured), dtype=float)
    for k in range(1, len(measured)):
        axes.axvline(k - 0.5, color=PALE, linewidth=1.0, zorder=0)
    axes.axhline(0.0, color=BLACK, linewidth=1.0, zorder=1)
    for k, entry in enumerate(series):
        x = centre + 0.7 * ((k + 0.5) / len(series) - 0.5)
        error = 100.0 * (np.asarray(entry.hz) / measured - 1.0)
        axes.vlines(x, 0.0, error, color=entry.colour, linewidth=1.4, alpha=0.55, zorder=2)
        if entry.interval_hz is not None:
            low, high = 100.0 * (np.asarray(entry.interval_hz) / measured - 1.0)
            axes.vlines(x, low, high, color=entry.colour, linewidth=4.5, alpha=0.45, zorder=2)
        axes.plot(
            x, error, linestyle="none", marker="o", markersize=7, color=entry.colour, label=entry.label, zorder=3,
            markerfacecolor=entry.colour if entry.filled else "white", markeredgewidth=1.5,
        )  # fmt: skip
    axes.set_xticks(centre, [f"{label}\n{hz:g} Hz" for label, hz in zip(labels, measured, strict=True)])
    axes.set_xlim(-0.5, len(measured) - 0.5)
    axes.set_xlabel("mode, measured frequency", fontsize=FONT)
    axes.set_ylabel("(computed − measured)/measured, %", fontsize=FONT)
    finish(axes)
    figure.legend(loc="outside lower center", ncols=2, fontsize=FONT - 1, frameon=False)
    return axes
