"""Every plot: it returns its Axes, every axis says what it shows in which unit, a figure handed in is used."""

import html
from functools import cache

import numpy as np
import pytest
from matplotlib.colors import to_hex

from fmu.report import plots
from fmu.report.document import inline_svg
from fmu.report.plots import COLOURS, plot_corner
from fmu.report.plots.style import PALETTE, new_figure

NAMES = tuple(f"E{k}" for k in range(1, 6))
GPA = tuple(f"E{k} / GPa" for k in range(1, 6))
Y_LABELS = {
    "plot_parameter_updates": ("value / GPa",),
    "plot_frequency_updates": ("(computed − measured)/measured, %",),
    "plot_left_out": ("(predicted − measured)/measured, %",),
    "plot_predictive_check": ("(frequency − predicted mean)\n/ predictive sd",),
    "plot_mac": ("mode of the model before updating",),
    "plot_sensitivity": ("mode",),
    "plot_mode_shapes": ("z displ.\n/ largest",) * 5,
    "plot_traces": GPA,
    "plot_ranks": NAMES,
    "plot_autocorrelation": NAMES,
    "plot_running_means": GPA,
    "plot_running_rhat": ("R-hat − 1\n(at least 0.001)",),
    "plot_energy": ("density / nat⁻¹",),
}
X_LABELS = {
    "plot_parameter_updates": "parameter",
    "plot_frequency_updates": "mode, measured frequency",
    "plot_left_out": "mode, measured frequency",
    "plot_predictive_check": "mode",
    "plot_mac": "mode of the model, posterior mean",
    "plot_sensitivity": "parameter",
    "plot_mode_shapes": "x / m",
    "plot_traces": "step",
    "plot_ranks": "rank among the draws of all chains / their number",
    "plot_autocorrelation": "lag / steps",
    "plot_running_means": "steps kept",
    "plot_running_rhat": "steps kept",
    "plot_energy": "energy (−log-probability + kinetic), nats",
}
SEVERAL = ("plot_parameter_updates", "plot_traces")
OF_MODES = ("plot_frequency_updates", "plot_left_out", "plot_predictive_check")
ONE_AXES = (*OF_MODES, "plot_mac", "plot_sensitivity", "plot_running_rhat", "plot_energy")
BY_CHAIN = ("plot_traces", "plot_ranks", "plot_autocorrelation", "plot_running_means")
BESIDE = {"plot_ranks": "Δ ECDF of the ranks", "plot_autocorrelation": "autocorrelation"}
NO_SAMPLER = ("plot_energy", "plot_mac", "plot_sensitivity", "plot_running_rhat", *BY_CHAIN)
SHAPES = ("plot_mac", "plot_mode_shapes")  # a black-box model has none
NAMELESS = ("plot_energy",)


def draw(name, trace, **more):
    return getattr(plots, name)({"hmc": trace} if name in SEVERAL else trace, **more)


def test_all_plots_of_traces_are_here():
    public = {name for name in dir(plots) if name.startswith("plot_")}
    # frequencies are no trace; every column of a corner plot has a label, see below; traces of several tests, too
    others = {"plot_frequency_errors", "plot_corner", "plot_marginals", "plot_values", "plot_losses"}
    others |= {"plot_damage_by_test"}
    others |= {"plot_held_out", "plot_intervals"}  # of several models
    others |= {"plot_mac_matrix", "plot_sensors"}  # of shapes alone
    others |= {"plot_frf", "plot_frf_at_start"}  # see frf/test_frf_plots.py
    others |= {"plot_forest", "plot_overlaid_marginals", "plot_ranks_of_samplers", "plot_growth"}  # of several
    assert set(Y_LABELS) == set(X_LABELS) == public - others


@pytest.fixture(scope="module")
def draw_once(beam_traces):
    """Draw each plot once, on a figure that is handed in; return what the plot returns, and the figure."""

    @cache
    def drawing(name):
        figure = new_figure(8.0, 9.0)
        return draw(name, beam_traces["hmc"], figure=figure), figure

    return drawing


@pytest.mark.parametrize("name", Y_LABELS)
def test_it_returns_axes_with_labels_and_units(name, draw_once):
    found, _ = draw_once(name)
    assert isinstance(found, np.ndarray) == (name not in ONE_AXES)
    axes = np.ravel(np.asarray(found, dtype=object))
    assert tuple(axis.get_ylabel() for axis in axes) == Y_LABELS[name]
    assert axes[-1].get_xlabel() == X_LABELS[name]
    assert {axis.get_xlabel() for axis in axes[:-1]} <= {""}  # shared with the last


@pytest.mark.parametrize("name", Y_LABELS)
def test_a_figure_handed_in_is_drawn_on(name, draw_once):
    found, figure = draw_once(name)
    assert {axis.figure for axis in np.ravel(np.asarray(found, dtype=object))} == {figure}


@pytest.mark.parametrize("name", [name for name in Y_LABELS if name not in NO_SAMPLER])
def test_the_sampler_has_its_colour(name, beam_traces):
    axes = np.ravel(np.asarray(draw(name, beam_traces["emcee"]), dtype=object))
    shades = [line.get_color() for axis in axes for line in axis.lines]
    shades += [shade for axis in axes for artist in axis.collections for shade in artist.get_edgecolor()]
    shades += [patch.get_edgecolor() for axis in axes for patch in axis.patches]
    assert COLOURS["emcee"] in {to_hex(shade).upper() for shade in shades}
    assert not {to_hex(shade).upper() for shade in shades} & {COLOURS["hmc"], COLOURS["mh"], COLOURS["slice"]}


@pytest.mark.parametrize("name", BY_CHAIN)
def test_each_chain_has_its_colour_and_the_legend_names_it(name, draw_once):
    axes = np.ravel(np.asarray(draw_once(name)[0], dtype=object))
    for axis in axes:
        shades = [to_hex(line.get_color()).upper() for line in axis.lines]
        assert set(PALETTE[:2]) <= set(shades)
        assert not set(PALETTE[2:]) & set(shades)
    (legend,) = axes[0].figure.legends
    entries = zip(legend.texts, legend.legend_handles, strict=True)
    named = {text.get_text(): line.get_color() for text, line in entries}
    assert named == {"chain 1": PALETTE[0], "chain 2": PALETTE[1]}
    assert (axes[0].figure.get_supylabel() or None) == BESIDE.get(name)


@pytest.mark.parametrize("name", [name for name in Y_LABELS if name not in SHAPES])
def test_names_are_no_mathematics(name, hostile_traces):
    axes = np.ravel(np.asarray(draw(name, hostile_traces["hmc"]), dtype=object))
    drawn = inline_svg(axes[0].figure, "a", "alt 1")
    names = [html.escape(name, quote=False) for name in ("$x_1$ & &amp;", "$a$")]
    about = dict.fromkeys(OF_MODES, names[1])
    if name not in NAMELESS:
        assert about.get(name, names[0]) in drawn


def test_corner_of_some_parameters(beam_traces):
    axes = plot_corner(beam_traces["hmc"], names=("E4", "E2"))
    assert axes.shape == (2, 2)
    assert [axis.get_xlabel() for axis in axes[-1]] == ["E4 / GPa", "E2 / GPa"]


def test_corner_of_a_plain_density_marks_no_start(plain_traces):
    axes = plot_corner(plain_traces["hmc"])
    words = [text.get_text() for text in axes[0, 0].figure.legends[0].get_texts()]
    assert words == ["bound"]
