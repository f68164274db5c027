"""The regions of a corner plot hold the part of the draws that the page says."""

import numpy as np
import pytest
from matplotlib.path import Path

from fmu.report.plots.corner import LEVELS, _draw_regions, _frames
from fmu.report.plots.style import new_figure

FREE = np.full(2, np.inf)


def shares(pair, lower=-FREE):
    """Return the part of the draws within each contour, the outer one first."""
    panel = new_figure(3.0, 3.0).subplots()
    frame = _frames(pair, lower, FREE)
    panel.set(xlim=frame[0], ylim=frame[1])
    _draw_regions(panel, pair, frame, "#0072B2")
    (lines,) = [one for one in panel.collections if not one.filled]
    found = []
    for path in lines.get_paths():
        parts = path.to_polygons(closed_only=False)
        inside = np.sum([Path(part).contains_points(pair) for part in parts], axis=0)
        found.append(np.mean(inside % 2 == 1))
    assert panel.get_xlim() == frame[0]
    return found


@pytest.mark.parametrize("rho", [0.0, 0.6, 0.9, -0.98, 0.999])
def test_regions_hold_half_and_nine_tenths_of_the_draws(rho):
    pair = np.random.default_rng(0).multivariate_normal([5.0, 3.0], [[1.0, rho], [rho, 1.0]], size=20_000)
    np.testing.assert_allclose(shares(pair * [1.0, 1e-3]), LEVELS[::-1], atol=0.01)


def test_a_region_has_the_width_and_the_length_of_the_density():
    """The ellipse of half the draws extends to 1.177 standard deviations along both axes."""
    pair = np.random.default_rng(0).multivariate_normal([0.0, 0.0], [[1.0, 0.98], [0.98, 1.0]], size=40_000)
    panel = new_figure(3.0, 3.0).subplots()
    _draw_regions(panel, pair, _frames(pair, -FREE, FREE), "#0072B2")
    (lines,) = [one for one in panel.collections if not one.filled]
    ends = np.abs(lines.get_paths()[1].vertices)
    np.testing.assert_allclose(ends.max(axis=0), np.sqrt(2 * np.log(2)), rtol=0.1)
    across = np.abs(lines.get_paths()[1].vertices @ [1.0, -1.0]) / np.sqrt(2 * 0.02)
    np.testing.assert_allclose(across.max(), np.sqrt(2 * np.log(2)), rtol=0.15)


def test_draws_at_a_bound_and_draws_that_are_equal_have_regions():
    pair = np.abs(np.random.default_rng(0).standard_normal((20_000, 2)))
    np.testing.assert_allclose(shares(pair, np.zeros(2)), LEVELS[::-1], atol=0.01)
    assert len(shares(np.ones((50, 2)))) == 2
    k = np.random.default_rng(0).standard_normal(500)
    assert len(shares(np.column_stack([k, 0.3 * k + 0.7]))) == 2  # y - b x is rounding alone
