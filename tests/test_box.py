"""Points in a box: walls belong to it, NaN does not, and nothing is not everything."""

import numpy as np
import pytest

from fmu.box import find_inside

LOWER, UPPER = np.array([0.0, -np.inf]), np.array([1.0, 2.0])


@pytest.mark.parametrize(
    ("point", "expected"),
    [
        ([0.0, 2.0], True),
        ([1.0, -1e300], True),
        ([np.nextafter(1.0, 2.0), 0.0], False),
        ([0.5, np.nan], False),
        ([0.5, -np.inf], True),
        ([0.5, np.inf], False),
    ],
)
def test_a_point_alone_and_among_others(point, expected):
    assert find_inside(np.array(point), LOWER, UPPER) == (expected, expected)
    batch = np.array([[[0.5, 0.0], point], [[0.1, 1.0], [0.2, 1.0]]])
    inside, all_inside = find_inside(batch, LOWER, UPPER)
    np.testing.assert_array_equal(inside, [[True, expected], [True, True]])
    assert all_inside == expected


def test_no_points_are_not_all_inside():
    inside, all_inside = find_inside(np.empty((0, 2)), LOWER, UPPER)
    assert inside.shape == (0,)
    assert not all_inside
