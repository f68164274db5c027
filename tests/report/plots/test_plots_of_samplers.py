"""Figures of several samplers side by side."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

import fmu
from fmu.analysis.convergence.growth import growth
from fmu.report import plots


def test_a_forest_has_every_interval_and_its_numbers(beam_traces):
    axes = plots.plot_forest(beam_traces)
    tables = {name: fmu.summary(trace) for name, trace in beam_traces.items()}
    assert [axis.get_title(loc="left") for axis in axes] == [f"E{k} / GPa" for k in range(1, 6)]
    for name, axis in zip(tables["hmc"].index, axes, strict=True):
        assert [label.get_text() for label in axis.get_yticklabels()] == list(beam_traces)
        means = [line.get_xdata()[0] for line in axis.lines]
        np.testing.assert_allclose(means, [1e-9 * tables[run]["mean"][name] for run in beam_traces])
        wide = [path.vertices[:, 0] for bar in axis.collections[::2] for path in bar.get_paths()]
        ends = [1e-9 * tables[run].loc[name, ["eti90_lb", "eti90_ub"]].to_numpy(float) for run in beam_traces]
        np.testing.assert_allclose(wide, ends)
    beside = axes[0].figure.axes[1]
    said = {text.get_text() for text in beside.texts}
    assert {f"{tables[run]['rhat'].iloc[0]:.3f}" for run in beam_traces} <= said
    assert {f"{tables[run]['ess_bulk'].iloc[0]:.0f}" for run in beam_traces} <= said


def test_marginals_lie_over_each_other(beam_traces):
    axes = plots.plot_overlaid_marginals(beam_traces)
    for axis in axes:
        shades = [to_hex(line.get_color()).upper() for line in axis.lines]
        assert shades == [plots.COLOURS[str(trace.attrs["sampler"])] for trace in beam_traces.values()]
        for line in axis.lines:  # densities
            x, y = line.get_xdata(), line.get_ydata()
            assert np.sum(y) * (x[1] - x[0]) == pytest.approx(1.0)


def test_ranks_of_samplers_that_differ_leave_zero(plain_traces):
    good = plain_traces["hmc"]
    other = good.copy()
    other["posterior"] = other["posterior"].to_dataset() + 2.0
    far = {}
    for name, second in (("same", good), ("other", other)):
        axes = plots.plot_ranks_of_samplers({"one": good, "two": second})
        far[name] = max(np.abs(line.get_ydata()).max() for line in axes[0].lines if len(line.get_ydata()))
    assert far["same"] < 0.15
    assert far["other"] > 0.3


def test_growth_is_drawn_over_all_solves(plain_traces):
    axes = plots.plot_growth(plain_traces, search=100.0)
    lines = {line.get_label(): line for line in axes.lines}
    for name, trace in plain_traces.items():
        grown = growth(trace)
        np.testing.assert_allclose(lines[name].get_xdata(), 100.0 + grown.solves)
        np.testing.assert_allclose(lines[name].get_ydata(), grown.ess)
    assert lines["400 needed"].get_ydata()[0] == 400


@pytest.mark.parametrize("draws", [1, 3])
def test_growth_of_a_few_draws_has_an_axis_of_solves(plain_traces, draws):
    """Their ESS is not defined; a logarithmic axis without data was an error, and no page was written."""
    traces = {name: trace.isel(draw=slice(draws)) for name, trace in plain_traces.items()}
    axes = plots.plot_growth(traces)
    assert all(np.isnan(growth(trace).ess).all() for trace in traces.values())
    axes.figure.canvas.draw()
    solves = np.concatenate([growth(trace).solves for trace in traces.values()])
    assert axes.get_xlim()[0] < solves.min() <= solves.max() < axes.get_xlim()[1]
