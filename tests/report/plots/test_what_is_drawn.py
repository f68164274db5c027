"""What the plots draw are the numbers of the analysis."""

import json

import numpy as np
import pytest
import xarray as xr

import fmu
from fmu.analysis.convergence.effective import autocorrelation, running_means, running_rhat
from fmu.analysis.prediction import predict_frequencies
from fmu.numbers import hertz
from fmu.report import plots
from fmu.report.plots import COLOURS
from fmu.report.plots.modes import _strokes
from fmu.report.plots.style import broken, legend_below, literal, new_figure
from tests.mast import damaged


def labelled(axes):
    return {line.get_label(): np.asarray(line.get_ydata(), dtype=float) for line in axes.lines}


def intervals(collection):
    """Return the lower and upper ends of vertical lines, shape (2, lines)."""
    return np.array([path[:, 1] for path in collection.get_segments()]).T


def test_parameters_have_mean_interval_start_bounds_and_maximum(beam_traces):
    trace = beam_traces["hmc"]
    maximum = np.array([1.8e11, 1.9e11, 2.0e11, 2.1e11, 2.2e11])
    (axes,) = plots.plot_parameter_updates({"hmc": trace}, maximum=maximum)
    drawn, table = labelled(axes), fmu.summary(trace)
    np.testing.assert_allclose(drawn["Hamiltonian Monte Carlo"], table["mean"] / 1e9)
    np.testing.assert_allclose(drawn["start"], 240.0)
    np.testing.assert_allclose(drawn["maximum"], maximum / 1e9)
    (bars,) = axes.collections
    np.testing.assert_allclose(intervals(bars), table[["eti90_lb", "eti90_ub"]].to_numpy().T / 1e9)
    assert [(bar.get_y(), bar.get_y() + bar.get_height()) for bar in axes.patches] == [(170.0, 250.0)] * 5
    low, high = axes.get_ylim()
    assert low < 170.0 < 250.0 < high
    assert [label.get_text() for label in axes.get_xticklabels()] == [f"E{k}" for k in range(1, 6)]


def test_parameters_of_each_unit_have_their_axes(hostile_traces):
    axes = plots.plot_parameter_updates(hostile_traces)
    assert [axis.get_ylabel() for axis in axes] == ["value / Pa", "value / <b>"]
    assert [len(axis.get_xticklabels()) for axis in axes] == [1, 1]


def test_inferred_error_parameters_have_their_own_axes(beam_traces):
    trace = beam_traces["hmc"].copy()
    configuration = json.loads(trace.attrs["configuration"])
    configuration["problem"]["likelihood"]["noise"] = ["E5"]
    trace.attrs["configuration"] = json.dumps(configuration)
    axes = plots.plot_parameter_updates({"hmc": trace})
    assert [axis.get_ylabel() for axis in axes] == ["value / GPa", "error parameter / GPa"]
    assert [len(axis.get_xticklabels()) for axis in axes] == [4, 1]


def test_what_differs_between_tests_has_its_own_axes():
    """A loss has no unit, as the parameter has not."""
    axes = plots.plot_parameter_updates({"hmc": damaged()})
    assert [axis.get_ylabel() for axis in axes] == ["value", "loss"]
    assert [len(axis.get_xticklabels()) for axis in axes] == [2, 2]


def test_published_values_stand_beside_ours(beam_traces):
    published = {"hmc": [2.4e11, 2.3e11, 2.2e11, 2.1e11, 2.0e11]}
    (axes,) = plots.plot_parameter_updates(beam_traces, published=published)
    drawn = {line.get_label(): line for line in axes.lines}
    theirs, ours, other = drawn["hmc, published"], drawn["Hamiltonian Monte Carlo"], drawn["emcee ensemble"]
    np.testing.assert_allclose(theirs.get_ydata(), [240.0, 230.0, 220.0, 210.0, 200.0])
    np.testing.assert_allclose(theirs.get_xdata(), ours.get_xdata())
    assert np.all(np.asarray(other.get_xdata()) != np.asarray(ours.get_xdata()))
    assert theirs.get_color() == ours.get_color() == COLOURS["hmc"]
    assert other.get_color() == COLOURS["emcee"]


def test_frequencies_before_and_after(beam_traces):
    trace = beam_traces["hmc"]
    axes = plots.plot_frequency_updates(trace)
    table, drawn = predict_frequencies(trace), labelled(axes)
    before = trace["modes"]["frequency"].sel(state="start").to_numpy()
    np.testing.assert_allclose(drawn["before updating"], 100 * (before / table["measured"] - 1))
    after = drawn["after: mean, 90 % interval with measurement noise"]
    np.testing.assert_allclose(after, 100 * (table["mean"] / table["measured"] - 1))
    ends = table[["noisy_eti90_lb", "noisy_eti90_ub"]].to_numpy().T / table["measured"].to_numpy()
    assert any(np.allclose(intervals(c), 100 * (ends - 1)) for c in axes.collections)


def test_frequencies_under_the_modal_residual_have_no_noise(beam_traces):
    trace = beam_traces["hmc"].copy()
    trace["posterior_predictive"] = xr.DataTree(trace["posterior_predictive"].to_dataset().drop_vars("frequency"))
    drawn = labelled(plots.plot_frequency_updates(trace))
    assert "after: mean, 90 % interval without measurement noise" in drawn
    with pytest.raises(ValueError, match="predictive distribution of measurements"):
        plots.plot_predictive_check(trace)


def test_predictive_check_is_in_predictive_standard_deviations(beam_traces):
    trace = beam_traces["hmc"]
    axes = plots.plot_predictive_check(trace)
    table = predict_frequencies(trace)
    expected = (table["measured"] - table["mean"]) / table["noisy_sd"]
    np.testing.assert_allclose(labelled(axes)["measured"], expected)
    words = {c.get_label(): intervals(c) for c in axes.collections}
    low, high = words["90 % of the model's frequencies, without noise"]
    np.testing.assert_allclose(low, (table["eti90_lb"] - table["mean"]) / table["noisy_sd"])
    wide = words["99 % of new measurements, noise included"]
    assert np.all(wide[0] < low)
    assert np.all(wide[1] > high)


def test_mac_is_written_into_its_cells(beam_traces):
    trace = beam_traces["hmc"]
    values = trace["modes"]["mac"].sel(state="posterior mean").to_numpy()
    axes = plots.plot_mac(trace)
    words = np.array([text.get_text() for text in axes.texts]).reshape(5, 5)
    assert words.tolist() == [[f"{x:.2f}" for x in row] for row in values]
    np.testing.assert_allclose(np.ravel(axes.collections[0].get_array()), values.ravel())
    at_start = plots.plot_mac(trace, "start")
    assert at_start.get_xlabel() == "mode of the model, start"
    np.testing.assert_allclose(np.diag(np.reshape(at_start.collections[0].get_array(), (5, 5))), 1.0)
    with pytest.raises(ValueError, match=r"state: must be one of start, posterior mean, maximum \(got 'end'\)"):
        plots.plot_mac(trace, "end")


def test_shapes_before_and_after_have_one_sign(beam_traces):
    trace = beam_traces["hmc"]
    moved = trace["modes"]["displacement"].sel(direction="z")
    axes = plots.plot_mode_shapes(trace)
    for k, axis in enumerate(axes):
        drawn = labelled(axis)
        one, other = (moved.sel(state=state).isel(mode=k).to_numpy() for state in ("start", "posterior mean"))
        before, after = (drawn[words][~np.isnan(drawn[words])] for words in ("before updating", "posterior mean"))
        sign = np.sign(one[np.argmax(np.abs(one))])
        np.testing.assert_allclose(before, sign * one)
        np.testing.assert_allclose(after, sign * other)
        assert before.max() == pytest.approx(1.0)
        f, g = (float(trace["modes"]["frequency"].sel(state=s)[k]) for s in ("start", "posterior mean"))
        assert axis.get_title("left") == f"mode {k + 1}: {hertz(f, g)[0]} Hz before, {hertz(f, g)[1]} Hz after"


def test_a_structure_in_space_is_drawn_isometric(beam_traces):
    trace = beam_traces["hmc"].copy()
    modes = trace["modes"].to_dataset().copy(deep=True)
    angle = np.linspace(0.0, np.pi, modes.sizes["node"])
    modes["coordinates"] = (("node", "direction"), np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1))
    trace["modes"] = xr.DataTree(modes)
    axes = plots.plot_mode_shapes(trace)
    assert not any(axis.axison for axis in axes)
    assert [len(axis.lines) for axis in axes] == [3] * 5  # undeformed, before, after
    undeformed = axes[0].lines[0].get_ydata()
    np.testing.assert_allclose(np.nanmax(undeformed), 1.0, atol=0.15)  # top of the arch, x = 0


def test_a_line_through_elements_is_lifted_between_branches():
    nodes = np.arange(8.0).reshape(4, 2)
    points = _strokes(nodes, np.array([[0, 1], [1, 2], [1, 3]]))
    lifted = np.isnan(points[:, 0])
    assert lifted.tolist() == [True, False, False, False, True, False, False]
    np.testing.assert_array_equal(points[~lifted], nodes[[0, 1, 2, 1, 3]])


@pytest.mark.parametrize("plot", [plots.plot_mac, plots.plot_mode_shapes])
def test_shapes_that_are_not_there(plot, hostile_traces, plain_traces):
    for trace in (hostile_traces["hmc"], plain_traces["hmc"]):
        with pytest.raises(ValueError, match="in its group modes"):
            plot(trace)


@pytest.mark.parametrize("sampler", ["hmc", "emcee"])
def test_autocorrelation_is_that_of_the_effective_sample_size(sampler, beam_traces):
    trace = beam_traces[sampler]
    axes = plots.plot_autocorrelation(trace)
    expected = autocorrelation(trace["posterior"]["E3"].to_numpy(), int(trace.attrs["walkers"]))
    for line, values in zip(axes[2].lines, expected, strict=False):
        np.testing.assert_allclose(line.get_ydata(), values[:101])
    assert len(axes[2].lines) == len(expected) + 1


def test_running_means_end_at_the_means(beam_traces):
    trace = beam_traces["emcee"]
    axes = plots.plot_running_means(trace)
    at, means = running_means(trace)
    for chain in range(2):
        line = axes[1].lines[1 + chain]
        assert line.get_xdata()[-1] == at[-1] == 12
        assert line.get_ydata()[-1] == pytest.approx(means[-1, chain, 1] / 1e9)
    row = fmu.summary(trace).loc["E2"] / 1e9
    (band,) = axes[1].patches
    assert band.get_y() == pytest.approx(row["mean"] - 2 * row["mcse_mean"])
    assert band.get_height() == pytest.approx(4 * row["mcse_mean"])


def test_running_rhat(beam_traces):
    axes = plots.plot_running_rhat(beam_traces["hmc"])
    at, rhat = running_rhat(beam_traces["hmc"])
    for k, name in enumerate(["E1", "E2", "E3", "E4", "E5"]):
        np.testing.assert_allclose(labelled(axes)[name], np.maximum(rhat[:, k] - 1.0, 1e-3))
        np.testing.assert_array_equal(axes.lines[k].get_xdata(), at)
    assert axes.lines[-1].get_ydata()[0] == pytest.approx(0.01)
    assert axes.get_ylim()[0] == pytest.approx(1e-3)


def test_ranks_of_chains_that_differ_are_far_from_uniform(plain_traces, beam_traces):
    def furthest(axes):
        return max(np.max(np.abs(line.get_ydata())) for line in axes.lines)

    good = plots.plot_ranks(plain_traces["hmc"])
    assert [furthest(axis) < 0.15 for axis in good] == [True, True]
    apart = plain_traces["hmc"].copy()
    shift = xr.DataArray([0.0, 0.0, 0.0, 3.0], dims="chain")
    apart["posterior"] = xr.DataTree(apart["posterior"].to_dataset() + shift)
    bad = plots.plot_ranks(apart)
    assert [furthest(axis) > 0.3 for axis in bad] == [True, True]
    with pytest.raises(ValueError, match="at least two chains"):
        plots.plot_ranks(plain_traces["mh"])


def test_energies(beam_traces, plain_traces):
    axes = plots.plot_energy(beam_traces["hmc"])
    areas = [
        sum(bar.get_height() * bar.get_width() for bar in axes.patches[:-1]), axes.patches[-1].get_xy()[:, 1].max()
    ]  # fmt: skip
    assert areas[0] == pytest.approx(1.0)
    assert areas[1] > 0
    with pytest.raises(ValueError, match="the sampler mh has none"):
        plots.plot_energy(plain_traces["mh"])


def test_legends_stand_in_as_many_columns_as_fit():
    for width, label, expected in ((8.0, "short", 4), (4.0, "a label of thirty letters, or so", 1)):
        axes = new_figure(width, 3.0).subplots()
        for k in range(4):
            axes.plot([0, 1], label=f"{label}{k}")
        legend_below(axes)
        assert axes.figure.legends[0]._ncols == expected


def test_names_are_shown_as_they_are():
    assert literal("$E_1$") == r"\$E_1\$"


def test_labels_are_broken_where_they_do_not_fit():
    assert broken("E1 / GPa", 1.1) == "E1 / GPa"
    assert broken("m drum weights / kg", 1.1) == "m drum\nweights\n/ kg"
    assert broken("k pitch / kN·m/rad", 1.25) == "k pitch\n/ kN·m/rad"
    assert max(map(len, broken("a name " * 20, 1.1).split("\n"))) <= 12
    assert broken("x" * 90, 1.1).count("\n") == 2


@pytest.fixture(scope="module")
def measured_beam():
    """A cantilever whose modes were measured at six places, one accelerometer upside down."""
    young = fmu.cases.load("cantilever-young")
    sensors = [(20, "z"), (30, "-z"), (40, "z"), (49, "z")]
    exact = young.model.structure.observation(sensors).toarray() @ young.model.truth.shapes(young.start)
    data = fmu.ModalData(young.data.frequencies_hz, sensors=sensors, shapes=-2.0 * exact)
    problem = fmu.UpdatingProblem(young.model.structure, data, young.parameters)
    maxima = fmu.find_map(problem, starts=1)
    return fmu.sample(problem, "hmc", draws=4, warmup=4, chains=2, init="start", maxima=maxima)


def test_measured_shapes_stand_on_the_structure(measured_beam):
    """Those of the model at the start, of another scale and sign, lie on its curves before updating."""
    axes = plots.plot_mode_shapes(measured_beam)
    for axis in axes:
        lines = {line.get_label(): np.asarray(line.get_xydata(), dtype=float) for line in axis.lines}
        curve = lines["before updating"][~np.isnan(lines["before updating"][:, 0])]
        expected = np.interp(lines["measured"][:, 0], *curve.T)
        assert lines["measured"][:, 0] == pytest.approx([0.2, 0.3, 0.4, 0.49])
        ratio = lines["measured"][:, 1] / expected
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
        assert ratio[0] == pytest.approx(1.0, abs=0.2)  # scaled to the posterior mean
    assert plots.plot_mac(measured_beam).get_ylabel() == "measured shape"


def test_only_what_was_measured_along_the_drawn_direction_is_marked_and_all_of_it_is_in_the_axes(measured_beam):
    """A sensor across it measured no displacement of 0 there; the expanded shape may be larger than 1."""
    trace = measured_beam.copy()
    modes = trace["modes"].to_dataset().copy(deep=True)
    places = modes["place"].to_numpy().tolist()
    k = int(np.argmin(modes["site"].to_numpy()[:, 0]))
    places[k] = places[k].replace(" z", " y")
    whole = 3.0 * modes["displacement"].sel(state="posterior mean", drop=True)
    modes = modes.assign_coords(place=places).assign(expanded=whole)
    trace["modes"] = xr.DataTree(modes)
    for axis in plots.plot_mode_shapes(trace):
        drawn = {line.get_label(): np.asarray(line.get_xydata(), dtype=float) for line in axis.lines}
        marks = drawn["measured"][np.isfinite(drawn["measured"]).all(axis=1)]
        assert marks[:, 0] == pytest.approx([0.3, 0.4, 0.49])
        low, high = axis.get_ylim()
        expanded = drawn["measured, expanded"][:, 1]
        assert np.nanmax(np.abs(expanded)) > 1.15
        assert low < np.nanmin(expanded)
        assert high > np.nanmax(expanded)


@pytest.mark.parametrize("case", ["shear-10dof", "shear-2dof"])
def test_shapes_of_matrices_are_drawn_over_their_degrees_of_freedom(case):
    problem = fmu.cases.load(case)
    maxima = fmu.find_map(problem, starts=2)
    trace = fmu.sample(problem, "hmc", draws=5, warmup=5, chains=2, init="start", maxima=maxima)
    for k, axis in enumerate(plots.plot_mode_shapes(trace)):
        drawn = {line.get_label(): np.asarray(line.get_ydata(), dtype=float) for line in axis.lines}
        assert len(drawn["before updating"]) == len(drawn["posterior mean"]) == problem.model.structure.n_dof
        if problem.data.shapes is None:
            assert "measured" not in drawn
        else:
            seen = drawn["measured"]
            assert np.flatnonzero(~np.isnan(seen)).tolist() == [2, 5, 8, 9]  # floors 3, 6, 9 and 10
            shape = np.asarray(problem.data.shapes)[:, k]
            np.testing.assert_allclose(seen[[2, 5, 8, 9]] / seen[9], shape / shape[3])
            np.testing.assert_allclose(seen[[2, 5, 8, 9]], drawn["posterior mean"][[2, 5, 8, 9]], atol=0.25)
    assert axis.get_xlabel() == "degree of freedom"
    assert axis.get_ylabel() == "x displ.\n/ largest"


def test_prior_posterior_and_maximum_are_the_draws(beam_traces):
    trace = beam_traces["hmc"]
    maximum = np.linspace(1.8e11, 2.2e11, 5)
    panels = plots.plot_marginals(trace, maximum)
    assert len(panels) == 5
    for k, axes in enumerate(panels):
        lines = {line.get_label(): line for line in axes.lines}
        for group, name in (("prior", "prior"), ("posterior", "posterior")):
            draws = trace[group][f"E{k + 1}"].to_numpy().ravel() / 1e9
            x, density = lines[name].get_data()
            assert np.sum(density) * (x[1] - x[0]) == pytest.approx(1.0)
            assert np.sum(x * density) / np.sum(density) == pytest.approx(draws.mean(), abs=x[1] - x[0])
            assert (density[0], density[-1]) == (0.0, 0.0)
        assert lines["maximum"].get_xdata()[0] == pytest.approx(maximum[k] / 1e9)
        assert lines["start"].get_xdata()[0] == 240.0
    bare = trace.copy()
    del bare["prior"]
    with pytest.raises(ValueError, match="must have draws from the prior"):
        plots.plot_marginals(bare)


def test_sensitivities_are_those_of_the_linearised_model(beam_traces):
    trace = beam_traces["hmc"]
    axes = plots.plot_sensitivity(trace)
    expected = trace["identifiability"]["sensitivity"].to_numpy()[-1]
    np.testing.assert_allclose(axes.collections[0].get_array().reshape(expected.shape), expected)
    assert [label.get_text() for label in axes.get_yticklabels()] == ["1", "2", "3", "4", "5"]
    bare = trace.copy()
    del bare["identifiability"]
    with pytest.raises(ValueError, match="must have a linearised model"):
        plots.plot_sensitivity(bare)
