"""A structure deformed in a mode: along a line, in its plane, in space."""

import matplotlib.pyplot as plt
import numpy as np

from fmu.report.plots.modes import plot_mode

LINE = np.stack([np.linspace(0.0, 2.0, 5), np.zeros(5), np.zeros(5)], axis=1)
ENDS = np.stack([np.arange(4), np.arange(1, 5)], axis=1)


def drawn(axes, line):
    """The points of a line without its gaps, (n_elements, 2, 2)."""
    points = np.stack(axes.lines[line].get_data(), axis=1)
    return points.reshape(-1, 3, 2)[:, :2]


def test_along_a_line_the_largest_displacement_is_shown_over_the_position():
    shape = np.zeros((5, 3))
    shape[:, 2], shape[:, 1] = 0.5 * LINE[:, 0], 0.1
    axes = plot_mode(LINE, ENDS, shape)
    np.testing.assert_allclose(drawn(axes, 1)[:, 1], np.stack([LINE[1:, 0], LINE[1:, 0] / 2.0], axis=1))
    assert axes.get_xlabel() == "x / m"
    assert axes.get_ylabel().startswith("z displacement")


def test_in_its_plane_a_structure_is_seen_face_on():
    nodes = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [4.0, 0.0, 3.0]])
    shape = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    axes = plot_mode(nodes, np.array([[0, 1], [1, 2]]), shape)
    np.testing.assert_allclose(drawn(axes, 0)[:, 1], [[0.0, 3.0], [4.0, 3.0]])
    np.testing.assert_allclose(drawn(axes, 1)[:, 1], [[0.48, 3.0], [4.48, 3.0]])  # 12 % of its 4 m


def test_out_of_its_plane_in_isometric_projection():
    nodes = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [4.0, 0.0, 3.0]])
    shape = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    axes = plot_mode(nodes, np.array([[0, 1], [1, 2]]), shape)
    moved = drawn(axes, 1)[:, 1] - drawn(axes, 0)[:, 1]
    np.testing.assert_allclose(moved, [[-0.48 * np.sqrt(0.75), 0.24]] * 2)
    assert plt.get_fignums() == []  # unknown to pyplot
