"""The study of starts: its mismatch of shares."""

import numpy as np
import pytest

from tests.validation.starts import mismatch


@pytest.mark.parametrize(
    ("visits", "expected"),
    [
        ([0.7, 0.3], 0.0),
        ([0.3, 0.7], 0.4),
        ([1.0, 0.0], 0.3),
        ([0.0, 0.0], 1.0),  # all draws are near no maximum
        ([0.35, 0.15], 0.5),
    ],
)
def test_mismatch_is_the_share_of_draws_at_the_wrong_place(visits, expected):
    assert mismatch(np.array(visits), np.array([0.7, 0.3])) == pytest.approx(expected)
