"""What errors at a few draws allow the posterior's moments to be off."""

import numpy as np
import pytest

from fmu.surrogates.error_limits import ErrorLimits, draws_needed, upper_shift

N = 12


def shift(theta, error):
    """Return the true shift of a posterior whose draws theta (n, ndim) have these errors, by their weights."""
    w = np.exp(error - error.max())
    w /= w.sum()
    mean = w @ theta
    of_sd = np.sqrt(w @ (theta - mean) ** 2) / theta.std(axis=0) - 1.0
    return np.max(np.abs([(mean - theta.mean(axis=0)) / theta.std(axis=0), of_sd]))


@pytest.mark.parametrize("sd", [0.01, 0.1])
@pytest.mark.parametrize(
    "error",
    [
        lambda theta: theta[:, 0],  # the mean moves as far as it can
        lambda theta: (theta[:, 0] ** 2 - 1.0) / np.sqrt(2.0),  # and so does the standard deviation
        lambda theta: np.sin(3.0 * theta[:, 0]) * theta[:, 1],
        lambda theta: theta[:, 0] ** 3 / 4.0,
    ],
    ids=["linear", "quadratic", "wavy", "cubic"],
)
def test_the_limit_holds_in_95_of_100(error, sd):
    rng = np.random.default_rng(1)
    theta = rng.standard_normal((100_000, 3))
    e = error(theta)
    e *= sd / e.std()
    true = shift(theta, e)
    posterior = theta[:1000]
    rows = rng.integers(len(theta), size=(400, N))
    held = np.mean([ErrorLimits.of(e[some], theta[some], posterior, sd).shift >= true for some in rows])
    assert held > 0.93


def test_the_limit_is_not_of_everything():
    """Errors that have nothing to do with the parameters are allowed to be larger than those that move means."""
    rng = np.random.default_rng(2)
    theta = rng.standard_normal((48, 3))
    of_nothing, of_a_mean = (upper_shift(0.1 * e, theta, theta) for e in (rng.standard_normal(48), theta[:, 0]))
    assert of_nothing < 0.8 * of_a_mean


def test_it_is_not_less_than_what_the_surrogate_expects():
    z = np.random.default_rng(3).standard_normal((N, 2))
    assert ErrorLimits.of(np.zeros(N), z, z, 0.3).shift == 0.3


def test_a_constant_error_moves_nothing():
    z = np.random.default_rng(1).standard_normal((N, 2))
    found = ErrorLimits.of(np.full(N, -3.0), z, z, 0.0)
    assert found.shift == found.sd == found.largest == 0.0


def test_the_share_of_wilks():
    z = np.random.default_rng(1).standard_normal((59, 2))
    assert ErrorLimits.of(z[:, 0], z, z, 0.0).share == pytest.approx(0.95, abs=1e-3)


def test_nothing_is_certified_where_a_draw_cannot_be_solved():
    z = np.random.default_rng(1).standard_normal((N, 2))
    errors = z[:, 0].copy()
    errors[3] = np.nan
    found = ErrorLimits.of(errors, z, z, 0.0)
    assert (found.n_failed, found.shift, found.share) == (1, np.inf, 0.0)


def test_large_errors_count_by_their_weights():
    errors = np.array([0.0] * 11 + [5.0])
    z = np.random.default_rng(1).standard_normal((N, 2))
    assert upper_shift(errors, z, z) > 3.0


def test_more_draws_are_needed_for_larger_errors_until_none_are_enough():
    z = np.random.default_rng(1).standard_normal((500, 4))
    needed = [draws_needed(sd, z, 0.05, 12, 40) for sd in (0.001, 0.025, 0.03, 0.1)]
    assert needed[0] == 12 < needed[1] < needed[2] < 40
    assert needed[3] == 0
