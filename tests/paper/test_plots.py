"""Figures: labels with units, one colour a sampler, what is drawn is what was drawn from the posterior."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

from fmu import sampling
from fmu.paper.figures import ENOUGH, frequency_series, plot_convergence
from fmu.paper.plan import SAMPLERS
from fmu.report.plots import COLOURS, TITLES, Frequencies, plot_corner, plot_frequency_errors, plot_traces
from fmu.report.plots.style import PALETTE

LABELS = ["Ix1 / mm⁴", "Ix2 / mm⁴", "Ax1 / mm²", "Ax2 / mm²"]


@pytest.fixture(autouse=True)
def _no_figure_reaches_pyplot():
    import matplotlib as mpl
    from matplotlib import pyplot

    before = dict(mpl.rcParams)
    yield
    assert pyplot.get_fignums() == []
    assert dict(mpl.rcParams) == before


def test_every_sampler_has_its_own_colour():
    assert set(COLOURS) == set(TITLES) == set(sampling.SAMPLERS)
    assert len(set(COLOURS.values())) == len(COLOURS)


def test_traces_show_the_draws_in_readable_units(result):
    mh = result.long["mh"]
    axes = plot_traces({"paper": result.paper["mh"], "long": mh}, result.published.columns["mh"].theta)
    assert axes.shape == (4, 2)
    assert [axis.get_ylabel() for axis in axes[:, 0]] == LABELS
    assert [axis.get_ylabel() for axis in axes[:, 1]] == LABELS
    assert [axis.get_title() for axis in axes[0]] == ["paper", "long"]
    assert {axis.get_xlabel() for axis in axes[-1]} == {"step"}
    paths = {len(line.get_xdata()): line for line in axes[2, 1].lines}
    first_chain = axes[2, 1].lines[1]  # drawn last
    expected = np.concatenate([mh["warmup_posterior"]["Ax1"][0], mh["posterior"]["Ax1"][0]]) / 1e-6
    np.testing.assert_allclose(first_chain.get_ydata(), expected)
    assert to_hex(first_chain.get_color()).upper() == PALETTE[0]
    assert 100 in paths
    dotted = [line for line in axes[0, 0].lines if line.get_linestyle() == ":"]
    assert [float(line.get_ydata()[0]) for line in dotted] == pytest.approx([7050.0])
    assert "warm-up" in [text.get_text() for text in axes[0, 1].texts]
    assert "warm-up" not in [text.get_text() for text in axes[0, 0].texts]


def test_traces_of_an_ensemble_follow_one_walker(result):
    emcee = result.long["emcee"]
    axes = plot_traces({"long": emcee})
    line = axes[0, 0].lines[1]
    walker = emcee["posterior"]["Ix1"].to_numpy()[0, ::32] / 1e-12
    np.testing.assert_allclose(line.get_ydata()[-len(walker) :], walker)
    assert "walker" in axes[-1, 0].get_xlabel()


def test_bounds_are_drawn_where_the_draws_are(result):
    axes = plot_traces({"long": result.long["hmc"]})
    for i, upper in enumerate([7500.0, 7500.0, 900.0, 900.0]):
        dashed = [float(line.get_ydata()[0]) for line in axes[i, 0].lines if line.get_linestyle() == "--"]
        low, high = axes[i, 0].get_ylim()
        expected = [bound for bound in (upper,) if low < bound < high]
        assert [value for value in dashed if value > 0.6 * upper] == pytest.approx(expected)


def test_corner(result):
    axes = plot_corner(result.long["slice"], result.maxima[0].theta)
    assert axes.shape == (4, 4)
    assert [axis.get_xlabel() for axis in axes[-1]] == LABELS
    assert [axis.get_ylabel() for axis in axes[1:, 0]] == LABELS[1:]
    words = [text.get_text() for text in axes[0, 0].figure.legends[0].get_texts()]
    assert [word.split(" (")[0] for word in words] == ["bound", "start", "maximum"]
    for j, upper in enumerate([7500.0, 7500.0, 900.0, 900.0]):
        assert axes[-1, j].get_xlim()[1] <= upper


def test_corner_says_what_it_cannot_show(result):
    far = result.problem.lower
    words = [t.get_text() for t in plot_corner(result.long["slice"], far)[0, 0].figure.legends[0].get_texts()]
    assert "maximum (outside the frame)" in words


def test_frequency_errors():
    series = [
        Frequencies("a", [110.0, 180.0], "#000000"),
        Frequencies("b", [100.0, 202.0], "#0072B2", interval_hz=[[99.0, 200.0], [101.0, 204.0]]),
    ]
    axes = plot_frequency_errors([100.0, 200.0], series, ["1", "2"])
    assert axes.get_ylabel().endswith("%")
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1\n100 Hz", "2\n200 Hz"]
    drawn = {line.get_label(): line.get_ydata() for line in axes.lines}
    np.testing.assert_allclose(drawn["a"], [10.0, -10.0])
    np.testing.assert_allclose(drawn["b"], [0.0, 1.0], atol=1e-12)
    assert [text.get_text() for text in axes.figure.legends[0].get_texts()] == ["a", "b"]


def test_frequency_figures_compare_before_published_and_ours(result, findings):
    table = findings.frequencies
    series = frequency_series(result, table, "hmc")
    assert [entry.label.split(",")[0] for entry in series] == [
        "before updating", "published", "the paper's protocol", "long run"
    ]  # fmt: skip
    np.testing.assert_allclose(series[1].hz, [31.6, 193.8, 545.3, 1077.0, 1790.7])
    np.testing.assert_allclose(series[2].hz, table["paper_hmc_hz"])
    assert np.shape(series[3].interval_hz) == (2, 5)
    assert [entry.label.split(",")[0] for entry in frequency_series(result, table, "emcee")] == [
        "before updating", "long run"
    ]  # fmt: skip


def test_convergence(result):
    axes = plot_convergence(result)
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert "solves" in axes.get_xlabel()
    assert "posterior sd" in axes.get_ylabel()
    solid = {
        line.get_label(): line for line in axes.lines if line.get_linestyle() == "-" and line.get_linewidth() == 2
    }
    assert set(solid) == {TITLES[name] for name in SAMPLERS}
    for name in SAMPLERS:
        title = TITLES[name]
        assert solid[title].get_color() == COLOURS[name]
        np.testing.assert_allclose(solid[title].get_ydata(), np.median(result.curves[name][0].error, axis=0))
    dotted = [line.get_color() for line in axes.lines if line.get_linestyle() == ":"]
    assert dotted == [COLOURS[name] for name in ("mh", "slice", "hmc")]
    assert any(np.allclose(line.get_ydata(), ENOUGH) for line in axes.lines)
    (band,) = axes.patches
    assert (band.get_y(), band.get_y() + band.get_height()) == pytest.approx(
        (axes.get_ylim()[0], result.reference.resolution)
    )
    assert result.reference.origin in axes.get_title()
