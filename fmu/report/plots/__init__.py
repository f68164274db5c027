"""Figures. One colour a sampler everywhere, units on every axis.

Functions take traces and draw on a matplotlib Figure of their own or one that is handed in; they return its Axes
and touch no global state of matplotlib.
"""

from fmu.report.plots.frequencies import Frequencies as Frequencies
from fmu.report.plots.frequencies import plot_frequency_errors as plot_frequency_errors
from fmu.report.plots.paths import plot_traces as plot_traces
from fmu.report.plots.style import BLACK as BLACK
from fmu.report.plots.style import COLOURS as COLOURS
from fmu.report.plots.style import DPI as DPI
from fmu.report.plots.style import FONT as FONT
from fmu.report.plots.style import GREY as GREY
from fmu.report.plots.style import PALE as PALE
from fmu.report.plots.style import TITLES as TITLES
from fmu.report.plots.style import finish as finish
from fmu.report.plots.style import new_figure as new_figure
