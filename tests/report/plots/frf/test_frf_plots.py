"""Figures of frequency response functions: amplitude, phase and distance, with units and colours."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

from fmu.report import plots
from fmu.report.plots.frf.functions import HELD, Shown, _chosen_lines, plot_frf_at_start
from tests.measured_frfs import LINES, simulate


def drawn(axis, colour):
    """Return the points (n, 2) of a colour."""
    found = [
        line
        for line in axis.lines
        if line.get_linestyle() == "None" and to_hex(line.get_color()) == colour.lower()
    ]
    return np.concatenate([line.get_xydata() for line in found]) if found else np.empty((0, 2))


def test_amplitude_phase_and_distance(frf_trace):
    axes = plots.plot_frf(frf_trace, "0 x / 2 x")
    assert [axis.get_ylabel() for axis in axes] == ["|H| / m/s²/N", "phase / °", "distance,\nnormal score"]
    assert axes[-1].get_xlabel() == "frequency / Hz"
    assert axes[0].get_yscale() == "log"
    assert axes[0].get_title("left") == "0 x / 2 x"
    assert plots.plot_frf(frf_trace)[0].get_title("left") == "2 x / 2 x"


def test_unused_lines_have_another_colour(frf_trace):
    measured = np.asarray(simulate().values)[1]
    used = frf_trace["frfs"]["used"].to_numpy()[1].astype(bool)
    above = plots.plot_frf(frf_trace, "0 x / 2 x")[0]
    for colour, where in ((plots.BLACK, used), (HELD, ~used)):
        points = drawn(above, to_hex(colour))
        np.testing.assert_allclose(points, np.stack([LINES, np.abs(measured)], axis=1)[where], rtol=1e-12)


def test_phases_lie_beside_the_prediction(frf_trace):
    axes = plots.plot_frf(frf_trace, "0 x / 2 x")
    (curve,) = [line for line in axes[1].lines if line.get_linewidth() == 1.1]
    points = np.concatenate([drawn(axes[1], plots.BLACK), drawn(axes[1], HELD)])
    middle = np.interp(points[:, 0], *curve.get_data())
    assert np.max(np.abs(points[:, 1] - middle)) < 30.0
    assert np.max(np.abs(np.diff(curve.get_ydata()))) < 180.0


def test_an_unknown_function_is_refused(frf_trace, beam_traces):
    with pytest.raises(ValueError, match="frf: must be one of 2 x / 2 x, 0 x / 2 x"):
        plots.plot_frf(frf_trace, "1 x / 2 x")
    with pytest.raises(ValueError, match="trace: must have frequency response functions"):
        plots.plot_frf(beam_traces["hmc"])


def test_many_lines_are_thinned_and_resonances_kept():
    n = 20_000
    size = 1.0 / np.abs(1.0 - (np.arange(n) / 7_777.3) ** 2 + 1e-3j)
    chosen = _chosen_lines(np.stack([size, np.zeros(n)], axis=1))
    assert len(chosen) <= 1200
    assert {int(size.argmax()), int(size.argmin())} <= set(chosen.tolist())


def test_a_measurement_beside_the_model_at_the_start():
    data = simulate()
    every = np.ones(len(LINES), dtype=bool)
    shown = Shown("tip", "m/s²/N", LINES, np.asarray(data.values)[0], every, ~every)
    axes = plot_frf_at_start(shown, 2.0 * shown.measured)
    (curve,) = [line for line in axes[0].lines if line.get_linestyle() == "-"]
    np.testing.assert_allclose(curve.get_ydata(), 2.0 * np.abs(shown.measured), rtol=1e-12)
