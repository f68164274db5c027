"""What errors at a few draws allow the posterior's moments to be off."""

import numpy as np
import pytest

from fmu.surrogates.error_limits import ErrorLimits, upper_shift


@pytest.mark.parametrize("draw", ["standard_normal", "laplace", "uniform", "squares"])
def test_the_limit_of_the_standard_deviation_holds_in_95_of_100(draw):
    rng, sd = np.random.default_rng(1), 0.01
    of = {
        "standard_normal": lambda: rng.standard_normal(12),
        "laplace": lambda: rng.laplace(size=12) / np.sqrt(2.0),
        "uniform": lambda: rng.uniform(-np.sqrt(3.0), np.sqrt(3.0), 12),
        "squares": lambda: (rng.standard_normal(12) ** 2 - 1.0) / np.sqrt(2.0),
    }[draw]
    held = np.mean([upper_shift(sd * of()) >= sd for _ in range(1000)])
    # of errors as skewed as squares twelve draws tell too little
    assert held > (0.85 if draw == "squares" else 0.94)


def test_a_constant_error_moves_nothing():
    found = ErrorLimits.of(np.full(12, -3.0))
    assert found.shift == found.sd == found.largest == 0.0


def test_the_share_of_wilks():
    assert ErrorLimits.of(np.random.default_rng(1).standard_normal(59)).share == pytest.approx(0.95, abs=1e-3)


def test_nothing_is_certified_where_a_draw_cannot_be_solved():
    errors = np.random.default_rng(1).standard_normal(12)
    errors[3] = np.nan
    found = ErrorLimits.of(errors)
    assert (found.n_failed, found.shift, found.share) == (1, np.inf, 0.0)


def test_large_errors_count_by_their_weights():
    errors = np.array([0.0] * 11 + [5.0])
    assert upper_shift(errors) > 3.0
