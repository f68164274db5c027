"""The bands against every outcome there is, of few ranks."""

from itertools import product

import numpy as np
import pytest

from tests.validation.bands import UniformRanks

SMALL = UniformRanks(replicates=4, largest=3)
OUTCOMES = [np.array(ranks) for ranks in product(range(4), repeat=4)]


@pytest.mark.parametrize("tail", [0.01, 0.1, 0.3, 0.7])
def test_escape_is_the_share_of_outcomes_outside_the_band(tail):
    lowest, highest = SMALL.band(tail)
    counts = np.array([SMALL.counts(ranks) for ranks in OUTCOMES])
    outside = np.any((counts < lowest) | (counts > highest), axis=1)
    assert SMALL.escape(tail) == pytest.approx(outside.mean(), abs=1e-12)


def test_p_values_are_exact():
    p = np.array([SMALL.p_value(ranks) for ranks in OUTCOMES])
    for level in np.unique(p):
        assert np.mean(p <= level + 1e-12) == pytest.approx(level, abs=1e-9)


@pytest.mark.parametrize("level", [0.01, 0.05, 0.3])
def test_the_band_of_a_level_is_left_by_what_is_rarer(level):
    uniform = UniformRanks(replicates=60, largest=15)
    lowest, highest = uniform.simultaneous_band(level)
    rng = np.random.default_rng(1)
    for ranks in rng.integers(0, 16, size=(300, 60)):
        counts = uniform.counts(ranks)
        outside = np.any((counts < lowest) | (counts > highest))
        assert outside == (uniform.p_value(ranks) <= level)


def test_ranks_of_a_posterior_too_narrow_or_shifted_are_found():
    uniform = UniformRanks(replicates=200, largest=63)
    middle = (np.arange(200) + 0.5) / 200
    assert uniform.p_value((64 * middle).astype(int)) > 0.99
    assert uniform.p_value((64 * middle**1.5).astype(int)) < 1e-4
    u_shaped = 0.5 - 0.5 * np.cos(np.pi * middle)
    assert uniform.p_value((64 * u_shaped).astype(int)) < 1e-3


def test_ranks_out_of_range_are_refused():
    with pytest.raises(ValueError, match="ranks"):
        SMALL.counts(np.array([0, 1, 2, 4]))
