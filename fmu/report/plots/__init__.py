"""Plots of posterior draws, frequencies and mode shapes. Samplers have fixed colours, and axes show their units.

Each plot function plots on a given or a new Matplotlib Figure and returns its Axes; it does not use Matplotlib's
global state. To add a plot, write it in a module of this package and import it below.
"""

from fmu.report.plots.chains import plot_autocorrelation as plot_autocorrelation
from fmu.report.plots.chains import plot_energy as plot_energy
from fmu.report.plots.chains import plot_ranks as plot_ranks
from fmu.report.plots.chains import plot_running_means as plot_running_means
from fmu.report.plots.chains import plot_running_rhat as plot_running_rhat
from fmu.report.plots.chains import plot_traces as plot_traces
from fmu.report.plots.corner import plot_corner as plot_corner
from fmu.report.plots.correlation import plot_mac_matrix as plot_mac_matrix
from fmu.report.plots.correlation import plot_sensors as plot_sensors
from fmu.report.plots.frequencies import Frequencies as Frequencies
from fmu.report.plots.frequencies import plot_frequency_errors as plot_frequency_errors
from fmu.report.plots.frequencies import plot_frequency_updates as plot_frequency_updates
from fmu.report.plots.frequencies import plot_left_out as plot_left_out
from fmu.report.plots.frequencies import plot_predictive_check as plot_predictive_check
from fmu.report.plots.frf.functions import plot_frf as plot_frf
from fmu.report.plots.frf.functions import plot_frf_at_start as plot_frf_at_start
from fmu.report.plots.information import plot_marginals as plot_marginals
from fmu.report.plots.information import plot_sensitivity as plot_sensitivity
from fmu.report.plots.models import plot_held_out as plot_held_out
from fmu.report.plots.models import plot_intervals as plot_intervals
from fmu.report.plots.modes import plot_mac as plot_mac
from fmu.report.plots.modes import plot_mode_shapes as plot_mode_shapes
from fmu.report.plots.parameters import plot_parameter_updates as plot_parameter_updates
from fmu.report.plots.samplers import plot_forest as plot_forest
from fmu.report.plots.samplers import plot_growth as plot_growth
from fmu.report.plots.samplers import plot_overlaid_marginals as plot_overlaid_marginals
from fmu.report.plots.samplers import plot_ranks_of_samplers as plot_ranks_of_samplers
from fmu.report.plots.style import BLACK as BLACK
from fmu.report.plots.style import COLOURS as COLOURS
from fmu.report.plots.style import DPI as DPI
from fmu.report.plots.style import FONT as FONT
from fmu.report.plots.style import GREY as GREY
from fmu.report.plots.style import PALE as PALE
from fmu.report.plots.style import TITLES as TITLES
from fmu.report.plots.style import finish as finish
from fmu.report.plots.style import new_figure as new_figure
from fmu.report.plots.tests import plot_damage_by_test as plot_damage_by_test
from fmu.report.plots.tests import plot_losses as plot_losses
from fmu.report.plots.tests import plot_values as plot_values
