"""What errors at a few draws allow the posterior's moments to be off."""

import numpy as np
import pytest
from scipy.stats import expon, norm

from fmu.surrogates.error_limits import ErrorLimits, draws_needed, upper_shift

N = 12
Z = np.random.default_rng(4).standard_normal((N, 2))


def shift(theta, error):
    """Return the true shift of a posterior whose draws theta (n, ndim) have these errors, by their weights."""
    w = np.exp(error - error.max())
    w /= w.sum()
    mean = w @ theta
    of_sd = np.sqrt(w @ (theta - mean) ** 2) / theta.std(axis=0) - 1.0
    return np.max(np.abs([(mean - theta.mean(axis=0)) / theta.std(axis=0), of_sd]))


ERRORS = {
    "linear": lambda theta: theta[:, 0],  # the mean moves as far as it can
    "quadratic": lambda theta: (theta[:, 0] ** 2 - 1.0) / np.sqrt(2.0),  # and so does the standard deviation
    "wavy": lambda theta: np.sin(3.0 * theta[:, 0]) * theta[:, -1],
    "cubic": lambda theta: theta[:, 0] ** 3 / 4.0,
}
OFTEN = [("linear", 1), ("quadratic", 1), ("wavy", 4), ("cubic", 4)]
RARELY = [pytest.param(name, 5 - ndim, marks=pytest.mark.validate) for name, ndim in OFTEN]


@pytest.mark.parametrize(("name", "ndim"), [*OFTEN, *RARELY])
def test_the_limit_holds_in_95_of_100(name, ndim):
    """By the draws alone: 0 is expected by the surrogate. 5 standard errors of the count are allowed."""
    rng, trials = np.random.default_rng(1), 2000
    theta = rng.standard_normal((100_000, ndim))
    e = ERRORS[name](theta)
    e *= 0.04 / e.std()
    true = shift(theta, e)
    posterior = theta[:1000]
    rows = rng.integers(len(theta), size=(trials, N))
    held = np.mean([ErrorLimits.of(e[some], posterior, 0.0).shift >= true for some in rows])
    assert held > 0.95 - 5.0 * np.sqrt(0.95 * 0.05 / trials)


def test_a_mean_may_move_by_all_of_the_errors():
    """Many draws of a linear error leave no margin: its mean moves by sd(e), its standard deviation hardly."""
    z = np.random.default_rng(2).standard_normal((2000, 1))
    e = 0.1 * z[:, 0]
    assert 0.09 < shift(z, e) < upper_shift(e, z) < 0.12


def test_it_is_not_less_than_what_the_surrogate_expects():
    z = np.random.default_rng(3).standard_normal((N, 2))
    assert ErrorLimits.of(np.zeros(N), z, 0.3).shift == 0.3


def test_a_constant_error_moves_nothing():
    z = np.random.default_rng(1).standard_normal((N, 2))
    found = ErrorLimits.of(np.full(N, -3.0), z, 0.0)
    assert found.shift == found.sd == found.largest == 0.0


def test_the_share_of_wilks():
    """With 95 % confidence 93 values enclose 95 % of a population between the least and the largest."""
    z = np.random.default_rng(1).standard_normal((93, 2))
    assert ErrorLimits.of(z[:, 0], z, 0.0).share == pytest.approx(0.95, abs=1e-3)


@pytest.mark.parametrize(
    ("law", "n"),
    [
        pytest.param(norm, 8, id="normal-8", marks=pytest.mark.validate),
        pytest.param(norm, 12, id="normal-12"),
        pytest.param(expon, 8, id="exponential-8"),
        pytest.param(expon, 12, id="exponential-12", marks=pytest.mark.validate),
    ],
)
def test_the_share_has_no_larger_error_in_95_of_100(law, n):
    rng, trials, held = np.random.default_rng(1), 1000, 0
    for errors in law.rvs(size=(trials, n), random_state=rng):
        found, mean = ErrorLimits.of(errors, Z, 0.0), errors.mean()
        held += law.cdf(mean + found.largest) - law.cdf(mean - found.largest) >= found.share
    assert held / trials > 0.95 - 5.0 * np.sqrt(0.95 * 0.05 / trials)


def test_nothing_is_certified_where_a_draw_cannot_be_solved():
    z = np.random.default_rng(1).standard_normal((N, 2))
    errors = z[:, 0].copy()
    errors[3] = np.nan
    found = ErrorLimits.of(errors, z, 0.0)
    assert (found.n_failed, found.shift, found.share) == (1, np.inf, 0.0)


def test_large_errors_count_by_their_weights():
    errors = np.array([0.0] * 11 + [5.0])
    z = np.random.default_rng(1).standard_normal((N, 2))
    assert upper_shift(errors, z) > 3.0


def test_more_draws_are_needed_for_larger_errors_until_none_are_enough():
    z = np.random.default_rng(1).standard_normal((500, 4))
    needed = [draws_needed(sd, z, 0.05, 12, 40) for sd in (0.001, 0.012, 0.016, 0.1)]
    assert needed[0] == 12 < needed[1] < needed[2] < 40
    assert needed[3] == 0
