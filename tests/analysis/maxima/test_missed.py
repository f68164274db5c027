"""Which maxima draws are near to, and which of them a run left out; with maxima and draws made by hand."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from fmu.analysis.maxima import missed
from fmu.analysis.maxima.missed import compare_shares, draws_of_maxima, missed_maxima, nearest_maxima
from fmu.analysis.maxima.results import Maxima, PosteriorMaximum


def maximum(theta, log_prob, share, sd=(1.0, 1.0), gradient=(0.0, 0.0), effective=300.0):
    theta, sd = np.array(theta, dtype=float), np.array(sd)
    return PosteriorMaximum(
        theta=theta,
        log_prob=log_prob,
        frequencies=np.array([1.0]),
        starts=1,
        at_bound=np.zeros(2, dtype=int),
        gradient=np.array(gradient),
        hessian=np.diag(sd**-2.0),
        curvature="differences",
        mean=theta,
        sd=sd,
        log_mass=np.log(share),
        effective_draws=effective,
        share=share,
    )


def known(*maxima):
    infinite = np.full(2, np.inf)
    one = np.ones(1)
    return Maxima(maxima, ("x0", "x1"), ("m", ""), ("1",), -infinite, infinite, np.zeros(2), one, one)


@pytest.fixture
def two():
    """The lower one is wide and holds most of the probability."""
    return known(maximum((0, 0), -1.0, 0.2, sd=(0.1, 0.1)), maximum((20, 0), -4.0, 0.8, sd=(2.0, 2.0)))


@pytest.fixture
def trace_of(make_trace):
    """A trace whose chains scatter around the given places; the best log-probability is `best`."""

    def make(*places, walkers=1, best=-2.0, sd=0.1):
        rng = np.random.default_rng(51)
        position = np.array(places)[:, None] + sd * rng.standard_normal((len(places), 200, 2))
        return make_trace(position, walkers=walkers, lp=np.full((len(places), 200), best))

    return make


def test_the_mass_of_gaussian_draws_is_that_of_their_density():
    cov = np.array([[4.0, 0.6], [0.6, 0.25]])
    density = multivariate_normal([1.0, -3.0], cov)
    draws = density.rvs(20_000, random_state=1)
    assert missed._log_mass(draws, density.logpdf(draws) + np.log(0.3)) == pytest.approx(np.log(0.3), abs=0.03)


def test_the_error_of_the_evidence_is_that_of_the_masses():
    one, other = maximum((0, 0), -1.0, 0.2, effective=50.0), maximum((20, 0), -4.0, 0.8, effective=400.0)
    of_old_trace = known(one, other).log_evidence_error
    assert of_old_trace == pytest.approx(np.sqrt(0.2**2 / 50.0 + 0.8**2 / 400.0))
    both = known(replace(one, evidence_covariance=1e-3), replace(other, evidence_covariance=2e-4))
    assert both.log_evidence_error == pytest.approx(np.sqrt(0.2 * 1e-3 + 0.8 * 2e-4))
    stored = Maxima.from_dataset(both.to_dataset())
    assert stored.log_evidence_error == both.log_evidence_error


def test_a_draw_belongs_to_the_maximum_whose_ellipsoid_it_is_in(two):
    # χ² of two degrees of freedom exceeds -2 log 1e-4 = 4.292² with probability 1e-4
    theta = np.array([[0, 0], [0.42, 0], [0.44, 0], [20, 8.5], [20, 8.7], [-50, 0]])
    np.testing.assert_array_equal(nearest_maxima(theta, two), [0, 0, -1, 1, -1, -1])


def test_beyond_the_ellipsoids_a_draw_that_is_high_belongs_to_the_least_fall(two):
    """The rim of an ellipsoid is 9.21 below its peak; the narrow peak's model falls fastest."""
    theta = np.array([[0.44, 0], [0, 20], [-3, 0], [-3, 0]])
    np.testing.assert_array_equal(nearest_maxima(theta, two), [-1, -1, -1, -1])
    np.testing.assert_array_equal(draws_of_maxima(theta, np.full(4, -2.0), two), [0, 1, 1, 1])
    low = np.array([-10.3, -13.3, -13.1, -13.3])
    np.testing.assert_array_equal(draws_of_maxima(theta, low, two), [-1, -1, 1, -1])
    near = np.array([[0.1, 0], [20, 0]])
    np.testing.assert_array_equal(draws_of_maxima(near, np.full(2, -90.0), two), [0, 1])


def test_a_draw_near_two_belongs_to_the_higher_model():
    both = known(maximum((0, 0), -1.0, 0.5), maximum((3, 0), -1.0, 0.5))
    np.testing.assert_array_equal(nearest_maxima(np.array([[1.4, 0], [1.6, 0]]), both), [0, 1])
    lower = known(maximum((0, 0), -1.0, 0.5), maximum((3, 0), -5.0, 0.5))
    np.testing.assert_array_equal(nearest_maxima(np.array([[1.6, 0]]), lower), [0])


def test_at_a_wall_the_density_falls_off_exponentially():
    """Five decay lengths from the wall is near; without the gradient it would be anyway, ten are not."""
    wall = known(maximum((0, 0), -1.0, 1.0, sd=(100.0, 1.0), gradient=(-1.0, 0.0)))
    theta = np.array([[5.0, 0], [10.0, 0]])
    np.testing.assert_array_equal(nearest_maxima(theta, wall), [0, -1])


def test_a_maximum_never_visited(two, trace_of):
    first, second = missed_maxima(trace_of((0, 0), (0, 0), best=-2.5), two)
    assert first == (
        "maximum 2 at x0 = 20.0 m, x1 = 0.0 was never visited: its log-probability is -4.0 (best draw: -2.5), "
        "and it holds about 80 % of the probability; use parallel tempering, which moves between maxima: "
        "--sampler tempering"
    )
    assert second == (
        "the draws were elsewhere: 2 chains are around maximum 1 at x0 = 0.00 m, x1 = 0.00 "
        "(log-probability -1.0, about 20 % of the probability)"
    )


def test_both_visited(two, trace_of):
    assert missed_maxima(trace_of((0, 0), (20, 0), (20, 1)), two) == []


def test_a_mode_that_was_not_found_is_no_visit_to_one_that_was(trace_of):
    """As high as maximum 1, which no draw was near to: whoever goes by height alone is fooled."""
    alone = known(maximum((0, 0), -1.0, 1.0))
    first, second = missed_maxima(trace_of((9, 0), (9, 0), best=-1.0), alone)
    assert "was never visited: its log-probability is -1.0 (best draw: -1.0)" in first
    assert second == "the draws were elsewhere: 2 chains are near no maximum"


def test_draws_along_a_bent_valley_are_in_proportion(make_trace):
    """x1 = x0²/2 ± 0.1 with x0 of sd 10: most draws are outside the ellipsoid, and yet of the maximum."""
    z = np.random.default_rng(53).standard_normal((4, 500, 2))
    position = np.stack([10 * z[..., 0], 50.0 * z[..., 0] ** 2 + 0.1 * z[..., 1]], axis=-1)
    lp = -1.0 - 0.5 * np.sum(z**2, axis=-1)
    valley = known(maximum((0, 0), -1.0, 1.0, sd=(10.0, 0.1)))
    assert np.mean(nearest_maxima(position.reshape(-1, 2), valley) == 0) < 0.1
    trace = make_trace(position, lp=lp)
    assert missed_maxima(trace, valley) == []
    low = compare_shares(make_trace(position, lp=lp - 20.0), valley)
    assert low.outweighed[0].startswith("maximum 1 at x0 = 0 m, x1 = 0.00 has ")
    assert low.reasons == []  # draws that come and go tell more than 300 weights


def test_a_maximum_without_mass_need_not_be_visited(trace_of):
    maxima = known(maximum((0, 0), -1.0, 0.995), maximum((20, 0), -4.0, 0.005))
    assert missed_maxima(trace_of((0, 0), (0, 0)), maxima) == []


def test_mass_counts_and_not_height(trace_of):
    """The highest maximum may hold nothing, and the lowest all."""
    maxima = known(maximum((0, 0), 50.0, 1e-4, sd=(1e-6, 1e-6)), maximum((20, 0), -4.0, 0.9999))
    assert missed_maxima(trace_of((20, 0), (20, 0)), maxima) == []
    assert "maximum 2" in missed_maxima(trace_of((0, 0), (0, 0), sd=1e-7), maxima)[0]


def test_draws_out_of_proportion_to_mass(trace_of):
    maxima = known(maximum((0, 0), -1.0, 0.97), maximum((20, 0), -4.0, 0.03))
    wrong, where = missed_maxima(trace_of((0, 0), (20, 0), (20, 1), (0, 1)), maxima)
    assert wrong == (
        "maximum 2 at x0 = 20.0 m, x1 = 0.0 has 50 % of the draws (effective size 4), but about 3 % of the "
        "probability by importance sampling (effective size 300); lengthen the warm-up: "
        "--warmup 1000"
    )
    assert where == (
        "2 chains are around maximum 1 at x0 = 0.0 m, x1 = 0.0 "
        "(log-probability -1.0, about 97 % of the probability); "
        "2 chains are around maximum 2 at x0 = 20.0 m, x1 = 0.0 "
        "(log-probability -4.0, about 3 % of the probability)"
    )
    maxima = known(maximum((0, 0), -1.0, 0.9), maximum((20, 0), -4.0, 0.1))
    assert (
        missed_maxima(trace_of((0, 0), (20, 0)), maxima) == []
    )  # five times too many may be the estimate's fault
    rare = known(maximum((0, 0), -1.0, 0.95), maximum((20, 0), -4.0, 0.05))
    places = [(20, 0)] * 39 + [(0, 0)]
    reasons = missed_maxima(trace_of(*places), rare)
    assert reasons[0].startswith("maximum 1 at x0 = 0.0 m, x1 = 0.0 has 2.5 % of the draws (effective size 40), ")
    assert reasons[0].endswith("; use parallel tempering, which moves between maxima: --sampler tempering")


def test_the_larger_effective_size_decides(make_trace):
    """Draws that come and go between two maxima with 2 % at the second, against weights that give it 30 %."""
    rng = np.random.default_rng(54)
    second = rng.random((4, 1000)) < 0.02
    position = np.stack([20.0 * second, np.zeros((4, 1000))], axis=-1) + 0.1 * rng.standard_normal((4, 1000, 2))
    trace = make_trace(position, lp=np.full((4, 1000), -2.0))

    def held_against(effective):
        return compare_shares(
            trace, known(maximum((0, 0), -1.0, 0.7), maximum((20, 0), -1.0, 0.3, effective=effective))
        )

    by_draws = held_against(40.0)
    assert by_draws.reasons == []
    (said,) = by_draws.outweighed
    assert said.startswith("maximum 2 at x0 = 20.0 m, x1 = 0.0 has 2")
    assert said.endswith(
        "but about 30 % of the probability by importance sampling (effective size 40): "
        "the draws are the better estimate"
    )
    assert 3000 < float(re.search(r"draws \(effective size ([\d ]+)\)", said)[1].replace(" ", "")) < 6000
    by_weights = held_against(9000.0)
    assert by_weights.outweighed == []
    assert (
        "but about 30 % of the probability by importance sampling (effective size 9 000)" in by_weights.reasons[0]
    )


def test_chains_that_never_change_maxima_are_worth_one_draw_each(trace_of):
    trace = trace_of((0, 0), (20, 0))
    for effective, decides in ((19.0, "weights"), (1.5, "draws")):
        poor = known(
            maximum((0, 0), -1.0, 0.97, effective=effective), maximum((20, 0), -4.0, 0.03, effective=effective)
        )
        found = compare_shares(trace, poor)
        assert bool(found.reasons) == (decides == "weights")
        assert bool(found.outweighed) == (decides == "draws")
        assert "has 50 % of the draws (effective size 2)" in (found.reasons + found.outweighed)[0]
    # what comes from the Laplace approximation alone is negligible by far
    laplace = known(maximum((0, 0), -1.0, 1.0), maximum((20, 0), -90.0, 1e-30, effective=0.0))
    assert "has 50 % of the draws (effective size 2), but less than 0.01 %" in missed_maxima(trace, laplace)[0]
    # a draw above all maxima shows that the search did not see everything
    assert compare_shares(trace_of((0, 0), (20, 0), best=-0.5), laplace) == ([], [])


def test_walkers_are_told_apart(two, make_trace):
    rng = np.random.default_rng(52)
    position = 0.1 * rng.standard_normal((2, 100, 4, 2))
    position[:, :, 0, 0] -= 300.0
    trace = make_trace(position.reshape(2, 400, 2), walkers=4)
    assert missed_maxima(trace, two)[1] == (
        "the draws were elsewhere: 2 walkers are near no maximum; 6 walkers are around maximum 1 at x0 = 0.00 "
        "m, x1 = 0.00 "
        "(log-probability -1.0, about 20 % of the probability)"
    )
