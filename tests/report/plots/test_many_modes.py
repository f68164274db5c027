"""Ten modes with names, of a structure in space: nothing is drawn over something else."""

from itertools import pairwise

import numpy as np
import pytest
import xarray as xr

from fmu.report import plots
from fmu.report.plots.frequencies import Frequencies, plot_frequency_errors
from fmu.report.plots.style import NARROW, new_figure

NAMES = [f"mode with a name {k}" for k in range(9)]


@pytest.fixture
def trace():
    n, angle = len(NAMES), np.linspace(0.0, np.pi, 12)
    rng = np.random.default_rng(0)
    moved = rng.standard_normal((2, n, 12, 3))
    alike = np.where(np.eye(n, dtype=bool), 0.9, 0.001) * np.ones((2, 1, 1))
    alike[:, 0, 1] = 0.3
    modes = xr.Dataset(
        {
            "mac": (("state", "reference_mode", "mode"), alike, {"reference": "modes before updating"}),
            "frequency": (("state", "mode"), np.stack([np.arange(1.0, n + 1)] * 2)),
            "displacement": (("state", "mode", "node", "direction"), moved / np.abs(moved).max()),
            "coordinates": (("node", "direction"), np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)),
            "ends": (("element", "end"), np.stack([np.arange(11), np.arange(1, 12)], axis=1)),
        },
        coords={"state": ["start", "posterior mean"], "mode": NAMES, "reference_mode": NAMES},
    )
    found = xr.DataTree.from_dict({"modes": xr.DataTree(modes)})
    found.attrs["sampler"] = "hmc"
    return found


def assert_labels_are_apart(axes, n=None):
    """Labels that are turned by half a right angle are apart if their ends are, by the height of a letter."""
    axes.figure.canvas.draw()
    labels = [label for label in axes.get_xticklabels() if label.get_text()]
    assert len(labels) == (n or len(NAMES))
    boxes = [label.get_window_extent() for label in labels]
    for label, (left, right) in zip(labels, pairwise(boxes), strict=False):
        if label.get_rotation() == 45.0:
            height = label.get_fontsize() * axes.figure.dpi / 72.0
            assert (right.x1 - left.x1) / np.sqrt(2.0) > height
        else:
            assert right.x0 > left.x1


def test_mac_of_many_modes(trace):
    axes = plots.plot_mac(trace)
    assert_labels_are_apart(axes)
    assert sorted(text.get_text() for text in axes.texts) == ["0.30", *["0.90"] * len(NAMES)]
    boxes = [text.get_window_extent() for text in axes.texts]
    cell = np.diff(axes.transData.transform([[0.0, 0.0], [1.0, 0.0]])[:, 0])[0]
    assert max(box.width for box in boxes) < cell


def test_shapes_of_many_modes_are_in_two_columns(trace):
    axes = plots.plot_mode_shapes(trace)
    assert len(axes) == len(NAMES)
    figure = axes[0].figure
    assert len(figure.axes) == len(NAMES)
    columns = [axis.get_subplotspec().colspan.start for axis in axes]
    assert columns == [0, 1] * 4 + [0]


@pytest.mark.parametrize("names", [NAMES, [str(k) for k in range(9)]])
def test_errors_of_many_frequencies(names):
    measured = np.arange(10.0, 19.0)
    figure = new_figure(NARROW if names is NAMES else 8.0, 5.0)
    axes = plot_frequency_errors(measured, [Frequencies("one", measured, "black")], names, figure)
    assert_labels_are_apart(axes)
    words = [label.get_text() for label in axes.get_xticklabels()]
    assert words[0] == (f"{names[0]}, 10 Hz" if names is NAMES else "0\n10 Hz")


def test_of_many_tests_some_modes_are_named():
    """Thirty tests of four modes: every eighth label."""
    labels = [f"{test}: {mode}" for test in range(1, 31) for mode in range(1, 5)]
    hz = np.linspace(2.0, 13.0, 120)
    series = [Frequencies("after", 1.01 * hz, "#0072B2", interval_hz=np.stack([hz, 1.02 * hz]))]
    assert_labels_are_apart(plot_frequency_errors(hz, series, labels, new_figure(NARROW, 4.2)), 15)
