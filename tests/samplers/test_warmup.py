"""What warm-up is built of: schedule, averaging of a step size, moments that a bad chain does not spoil."""

import numpy as np
import pytest

from fmu.samplers.adaptation import (
    SHRINKAGE,
    DualAveraging,
    Schedule,
    draws_in_bulk,
    find_arrived,
    regularised_covariance,
)  # fmt: skip

COVARIANCE = np.array([[1.0, 0.6, 0.0], [0.6, 0.8, -0.2], [0.0, -0.2, 0.5]])


class TestSchedule:
    @pytest.mark.parametrize("steps", [100, 500, 1000, 1777, 20_000])
    def test_doubling_windows_follow_each_other_and_fill_the_middle(self, steps):
        schedule = Schedule.doubling(steps)
        starts, ends = np.transpose(schedule.windows)
        assert starts[0] == schedule.first
        np.testing.assert_array_equal(starts[1:], ends[:-1])
        assert ends[-1] == steps - schedule.last
        sizes = ends - starts
        np.testing.assert_array_equal(sizes[:-1], 25 * 2 ** np.arange(len(sizes) - 1))
        assert sizes[-1] >= 25 * 2 ** (len(sizes) - 1)

    @pytest.mark.parametrize("steps", [100, 500, 1000, 1777, 20_000])
    def test_sliding_windows_hold_the_later_half_of_the_steps(self, steps):
        schedule = Schedule.sliding(steps)
        starts, ends = np.transpose(schedule.windows)
        np.testing.assert_array_equal(starts, ends // 2)
        assert np.all(np.diff(ends) > 0)
        assert ends[0] == 25
        assert ends[-1] == steps - schedule.last
        assert schedule.first < ends[-1]

    @pytest.mark.parametrize("make", [Schedule.doubling, Schedule.sliding])
    @pytest.mark.parametrize("steps", [1, 10, 28])
    def test_a_short_warm_up_has_no_windows(self, make, steps):
        assert make(steps).windows == ()


class TestDualAveraging:
    @pytest.mark.parametrize("start", [1e-4, 1.0, 100.0])
    def test_finds_the_value_of_a_known_response(self, start):
        """Accepted with probability 1/(1 + ε²): 0.8 at ε = 1/2, whatever the start."""
        rng = np.random.default_rng(1)
        averaging = DualAveraging(np.log(start) * np.ones(20), 0.8)
        for _ in range(2000):
            averaging.update((rng.random(20) < 1 / (1 + np.exp(2 * averaging.log_value))).astype(float))
        step_size = np.exp(averaging.averaged)
        assert step_size.std() > 0  # every entry goes its own way
        np.testing.assert_allclose(step_size, 0.5, rtol=0.3)
        assert abs(np.mean(step_size) - 0.5) < 0.05

    def test_every_entry_has_its_own_response(self):
        best = np.array([0.01, 1.0, 30.0])
        averaging = DualAveraging(np.zeros(3), 0.8)
        for _ in range(3000):
            averaging.update(1 / (1 + 0.25 * np.exp(2 * averaging.log_value) / best**2))
        np.testing.assert_allclose(np.exp(averaging.averaged), best, rtol=0.05)

    @pytest.mark.parametrize("acceptance", [0.0, 1.0])
    def test_does_not_run_off_where_nothing_depends_on_it(self, acceptance):
        averaging = DualAveraging(np.zeros(1), 0.8)
        for _ in range(20_000):
            averaging.update(np.array([acceptance]))
        assert averaging.lowest <= averaging.averaged[0] <= averaging.highest

    def test_nothing_seen_leaves_the_start(self):
        assert DualAveraging(np.array(0.3), 0.8).averaged == 0.3


class Window:
    """Steps of five chains that draw from one Gaussian, but for what a test does to the last of them."""

    def __init__(self, n=400, scale=1.0):
        rng = np.random.default_rng(2)
        factor = np.linalg.cholesky(COVARIANCE)
        self.position = rng.standard_normal((n, 5, 3)) @ factor.T * scale
        z = np.linalg.solve(factor, (self.position / scale).reshape(-1, 3).T)
        self.log_prob = -0.5 * np.sum(z**2, axis=0).reshape(n, 5)
        self.acceptance = rng.uniform(0.1, 0.5, (n, 5))

    def covariance(self, chains=slice(None), first=0):
        draws = draws_in_bulk(*(a[first:, chains] for a in (self.position, self.log_prob, self.acceptance)))
        return None if draws is None else regularised_covariance(draws)


class TestCovarianceOfWindow:
    def test_is_the_covariance_of_all_chains_shrunk_towards_its_diagonal(self):
        window = Window()
        plain = np.cov(window.position.reshape(-1, 3), rowvar=False)
        n = 5 * 400
        expected = (n * plain + SHRINKAGE * np.diag(np.diag(plain))) / (n + SHRINKAGE)
        np.testing.assert_allclose(window.covariance(), expected, rtol=1e-12)
        np.testing.assert_allclose(window.covariance(), COVARIANCE, atol=0.15)

    def test_counts_the_spread_between_chains(self):
        """Chains that have each seen a part of the target know the whole together."""
        window = Window()
        window.position[:, :, 0] = 0.1 * window.position[:, :, 0] + np.linspace(-1, 1, 5)
        assert window.covariance()[0, 0] > 10 * window.covariance([0])[0, 0]

    def test_units_do_not_matter(self):
        units = np.array([1e-6, 1.0, 1e8])
        scaled = Window(scale=units).covariance() / np.outer(units, units)
        np.testing.assert_allclose(scaled, Window().covariance(), rtol=1e-9, atol=1e-12)

    def test_starts_where_it_is_told(self):
        window = Window()
        window.position[:200] += 50.0
        np.testing.assert_allclose(window.covariance(first=200), COVARIANCE, atol=0.2)

    def test_a_trapped_chain_is_left_out(self):
        window = Window()
        expected = window.covariance(slice(4))
        window.position[:, 4] += 20.0
        window.log_prob[:, 4] -= 100.0
        np.testing.assert_array_equal(window.covariance(), expected)

    def test_a_chain_in_a_spike_is_left_out(self):
        window = Window()
        expected = window.covariance(slice(4))
        window.position[:, 4] = 20.0 + 1e-6 * window.position[:, 4]
        window.log_prob[:, 4] += 40.0
        np.testing.assert_array_equal(window.covariance(), expected)

    def test_a_chain_that_stands_still_is_left_out(self):
        window = Window()
        expected = window.covariance(slice(4))
        window.position[:, 4] = window.position[0, 4]
        window.log_prob[:, 4] = window.log_prob[:, :4].mean()
        window.acceptance[:, 4] = 0.01
        np.testing.assert_array_equal(window.covariance(), expected)

    def test_draws_on_the_way_are_left_out(self):
        """A chain that arrives within the window counts from its arrival on."""
        window = Window()
        window.position[:10, 4] += 30.0
        window.log_prob[:10, 4] -= 60.0
        np.testing.assert_allclose(window.covariance(), COVARIANCE, atol=0.15)

    def test_most_chains_on_the_way_teach_nothing_of_the_one_that_has_arrived(self):
        """One of four chains in the bulk, or in a spike: nobody can tell, and the many decide."""
        assert find_arrived(np.array([0.0, -80.0, -81.0, -79.0]), 10.0).tolist() == [False, True, True, True]

    def test_the_best_half_decides(self):
        assert find_arrived(np.array([0.0, -1.0, -80.0, -200.0]), 10.0).tolist() == [True, True, False, False]
        assert find_arrived(np.array([0.0, -80.0]), 10.0).tolist() == [True, False]

    def test_too_few_draws(self):
        assert Window(0).covariance() is None
        assert Window(1).covariance() is None
        assert Window(5).covariance(first=5) is None

    def test_chains_that_never_moved(self):
        window = Window()
        window.position[:] = 1.0
        assert window.covariance() is None
