import numpy as np
import pytest

from fmu.samplers.trajectory import Metric, drift

LOWER, UPPER = np.zeros(3), np.array([1.0, 2.0, 0.5])
DENSE = np.array([[1.0, 0.6, -0.3], [0.6, 0.8, 0.1], [-0.3, 0.1, 0.5]])


def random_motion(n, metric, seed=0):
    rng = np.random.default_rng(seed)
    return LOWER + (UPPER - LOWER) * rng.random((n, 3)), metric.sample_momentum(rng, n)


def move(q, p, metric, time, lower=LOWER, upper=UPPER, cap=10_000):
    n = len(q)
    return drift(q, p, np.full(n, float(time)), metric, lower, upper, np.full(n, cap))


def scalar_drift(q, p, inverse_mass, time):
    """One point, one event after the other, written down from the law of reflection."""
    q, p = list(q), np.array(p)
    while True:
        v = inverse_mass @ p
        times = [((UPPER if v[i] > 0 else LOWER)[i] - q[i]) / v[i] for i in range(3)]
        first = int(np.argmin(times))
        if times[first] >= time:
            return np.array(q) + time * v, p
        q = [q[i] + times[first] * v[i] for i in range(3)]
        q[first] = (UPPER if v[first] > 0 else LOWER)[first]
        n = np.eye(3)[first]
        p = p - 2 * (n @ v) / (n @ inverse_mass @ n) * n
        time -= times[first]


def test_without_coupling_every_coordinate_folds_by_itself():
    metric = Metric.of([1.0, 0.3, 2.0], 3)
    q, p = random_motion(200, metric)
    end = move(q, p, metric, 7.0)
    width = UPPER - LOWER
    phase = np.mod(q - LOWER + 7.0 * metric.velocity(p), 2 * width)
    np.testing.assert_allclose(end.position, LOWER + np.where(phase > width, 2 * width - phase, phase), atol=1e-12)
    assert end.arrived.all()
    crossings = np.abs(np.floor((q - LOWER + 7.0 * metric.velocity(p)) / width)).sum(axis=1)
    np.testing.assert_array_equal(end.n_bounces, crossings)


def test_under_a_dense_metric_walls_are_met_in_order():
    metric = Metric.of(DENSE, 3)
    q, p = random_motion(50, metric)
    end = move(q, p, metric, 3.0)
    assert end.n_bounces.min() >= 1
    for i in range(50):
        position, momentum = scalar_drift(q[i], p[i], DENSE, 3.0)
        np.testing.assert_allclose(end.position[i], position, atol=1e-11)
        np.testing.assert_allclose(end.momentum[i], momentum, atol=1e-11)


def test_kinetic_energy_is_kept_and_the_box_not_left():
    metric = Metric.of(DENSE, 3)
    q, p = random_motion(200, metric)
    end = move(q, p, metric, 5.0)
    np.testing.assert_allclose(metric.kinetic(end.momentum), metric.kinetic(p), rtol=1e-11)
    assert np.all((end.position >= LOWER) & (end.position <= UPPER))


def test_reversible():
    metric = Metric.of(DENSE, 3)
    q, p = random_motion(200, metric)
    there = move(q, p, metric, 5.0)
    back = move(there.position, -there.momentum, metric, 5.0)
    np.testing.assert_allclose(back.position, q, atol=1e-10)
    np.testing.assert_allclose(-back.momentum, p, atol=1e-10)
    np.testing.assert_array_equal(back.n_bounces, there.n_bounces)


def test_a_wall_at_infinity_is_never_met():
    metric = Metric.of(None, 3)
    q, p = random_motion(20, metric)
    end = move(q, p, metric, 100.0, np.full(3, -np.inf), np.full(3, np.inf))
    np.testing.assert_array_equal(end.position, q + 100.0 * p)
    assert end.n_bounces.sum() == 0


def test_a_point_on_a_wall_leaves_it():
    metric = Metric.of(None, 3)
    q = np.array([[0.0, 0.5, 0.25], [0.0, 0.5, 0.25]])
    p = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    end = move(q, p, metric, 0.25)
    np.testing.assert_allclose(end.position[:, 0], 0.25)
    np.testing.assert_allclose(end.momentum[:, 0], 1.0)
    np.testing.assert_array_equal(end.n_bounces, [1, 0])


def test_a_corner_takes_two_bounces():
    metric = Metric.of(None, 3)
    end = move(np.full((1, 3), 0.25), np.array([[-1.0, -1.0, 0.0]]), metric, 0.5)
    np.testing.assert_allclose(end.position, [[0.25, 0.25, 0.25]])
    np.testing.assert_allclose(end.momentum, [[1.0, 1.0, 0.0]])
    assert end.n_bounces[0] == 2


def test_the_cap_interrupts_the_motion_and_says_so():
    metric = Metric.of(None, 3)
    q, p = np.tile([0.5, 0.5, 0.25], (2, 1)), np.array([[10.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    end = move(q, p, metric, 1.0, cap=3)
    np.testing.assert_array_equal(end.arrived, [False, True])
    np.testing.assert_array_equal(end.n_bounces, [3, 1])


@pytest.mark.parametrize("momentum", [np.nan, np.inf])
def test_a_motion_that_is_not_finite_does_not_arrive(momentum):
    metric = Metric.of(None, 3)
    with np.errstate(invalid="ignore"):
        end = move(np.full((1, 3), 0.25), np.array([[momentum, 0.0, 0.0]]), metric, 1.0)
    assert not end.arrived[0]


class TestMetric:
    @pytest.mark.parametrize("inverse_mass", [None, [0.5, 2.0, 3.0], DENSE], ids=["identity", "vector", "matrix"])
    def test_momenta_have_covariance_m(self, inverse_mass):
        metric = Metric.of(inverse_mass, 3)
        n = 200_000
        p = metric.sample_momentum(np.random.default_rng(1), n)
        mass = np.linalg.inv(metric.inverse)
        np.testing.assert_allclose(np.cov(p.T), mass, atol=5 * np.diag(mass).max() * np.sqrt(2 / n))
        assert abs(metric.kinetic(p).mean() - 1.5) < 5 * np.sqrt(1.5 / n)

    def test_velocity_is_the_inverse_mass_times_momentum(self):
        np.testing.assert_allclose(Metric.of(DENSE, 3).velocity(np.eye(3)), DENSE)
        np.testing.assert_allclose(Metric.of([1.0, 2.0, 4.0], 3).velocity(np.ones((1, 3))), [[1.0, 2.0, 4.0]])
