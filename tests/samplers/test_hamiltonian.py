import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.samplers import HamiltonianMonteCarlo, State, run
from fmu.samplers.hmc import _with_first_mass
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.samplers.trajectory import Metric
from tests.samplers.targets import Counting, SkewedGumbel, Target, TruncatedGaussian

DENSE2 = np.array([[0.5, 0.3], [0.3, 0.9]])


def launch(target, n, seed=0, **settings):
    """Return a kernel, states around the target's mean and momenta."""
    kernel = HamiltonianMonteCarlo(**settings).bind(target)
    rng = np.random.default_rng(seed)
    state, _ = kernel.init(target.sample_prior(rng, n))
    return kernel, state, kernel.metric.sample_momentum(rng, n)


def energy_error(target, step_size, n_steps, n, **settings):
    kernel, state, p = launch(target, n, step_size=step_size, n_steps=n_steps, **settings)
    end = kernel.integrate(state, p, np.full(n, step_size))
    assert end.finished.all()
    before = kernel.metric.kinetic(p) - state.log_prob
    return kernel.metric.kinetic(end.momentum) - end.log_prob - before, end.n_bounces


class TestTrajectory:
    @pytest.mark.parametrize("gradient", ["exact", "central-difference"])
    @pytest.mark.parametrize("inverse_mass", [None, DENSE2], ids=["identity", "dense"])
    def test_reversible_with_reflections(self, gradient, inverse_mass):
        target = TruncatedGaussian()
        kernel, state, p = launch(
            target, 100, step_size=0.1, n_steps=25, inverse_mass=inverse_mass, gradient=gradient, h=1e-3
        )
        step_size = np.full(100, 0.1)
        there = kernel.integrate(state, p, step_size)
        turned = State(there.position, there.log_prob, there.gradient)
        back = kernel.integrate(turned, -there.momentum, step_size)
        assert there.n_bounces.mean() > 1
        np.testing.assert_allclose(back.position, state.position, atol=1e-10)
        np.testing.assert_allclose(-back.momentum, p, atol=1e-10)
        np.testing.assert_array_equal(back.n_bounces, there.n_bounces)

    @pytest.mark.parametrize("inverse_mass", [None, DENSE2], ids=["identity", "dense"])
    def test_volume_is_preserved_with_reflections(self, inverse_mass):
        target = TruncatedGaussian()
        kernel, state, p = launch(target, 30, step_size=0.1, n_steps=15, inverse_mass=inverse_mass)
        step_size, shift = np.full(30, 0.1), 1e-6
        x = np.concatenate([state.position, p], axis=1)

        def flow(x):
            start, _ = kernel.init(x[:, :2])
            end = kernel.integrate(start, x[:, 2:], step_size)
            return np.concatenate([end.position, end.momentum], axis=1), end.n_bounces

        bounces = flow(x)[1]
        columns, same = [], np.ones(30, dtype=bool)
        for e in shift * np.eye(4):
            (above, n_above), (below, n_below) = flow(x + e), flow(x - e)
            columns.append((above - below) / (2 * shift))
            same &= (n_above == bounces) & (n_below == bounces)  # the map has a kink where a wall is just grazed
        determinant = np.linalg.det(np.stack(columns, axis=2))
        assert bounces[same].sum() > 10
        np.testing.assert_allclose(np.abs(determinant[same]), 1.0, atol=1e-6)

    def test_energy_error_is_of_second_order_without_bounces(self):
        target = SkewedGumbel()
        dense = 0.7 * np.eye(3) + 0.3
        error = [
            np.sqrt(np.mean(energy_error(target, 1.0 / n, n, 200, inverse_mass=dense)[0] ** 2))
            for n in (20, 40, 80)
        ]
        assert error[0] / error[1] == pytest.approx(4, rel=0.1)
        assert error[1] / error[2] == pytest.approx(4, rel=0.1)

    def test_energy_error_is_of_first_order_with_bounces(self):
        """A kick does not know where within a step the wall will be met: the error halves with the step."""
        target = TruncatedGaussian()
        rms = []
        for n in (40, 80, 160):
            error, bounces = energy_error(target, 2.0 / n, n, 2000, inverse_mass=DENSE2)
            rms.append(np.sqrt(np.mean(error[bounces > 0] ** 2)))
        assert rms[0] / rms[1] == pytest.approx(2, rel=0.25)
        assert rms[1] / rms[2] == pytest.approx(2, rel=0.25)

    def test_harmonic_motion(self):
        """A quarter period of a unit oscillator turns momentum into position."""

        class Oscillator(Target):
            def value_and_slope(self, x):
                return -0.5 * np.sum(x**2, axis=1), -x

        n = 400
        kernel = HamiltonianMonteCarlo(step_size=1.0, n_steps=n).bind(Oscillator(2))
        state, _ = kernel.init(np.zeros((1, 2)))
        end = kernel.integrate(state, np.array([[1.0, -2.0]]), np.array([np.pi / 2 / n]))
        np.testing.assert_allclose(end.position, [[1.0, -2.0]], atol=1e-5)
        np.testing.assert_allclose(end.momentum, [[0.0, 0.0]], atol=1e-4)


def sample(target, sampler, draws=50, chains=4):
    start = np.tile(target.mean, (chains, 1))
    return run(target, sampler, draws=draws, warmup=0, chains=chains, seed=1, init=start).posterior


def test_a_trajectory_at_the_cap_on_bounces_is_rejected():
    density = Counting(TruncatedGaussian())
    draws = sample(density, HamiltonianMonteCarlo(step_size=50.0, n_steps=3, max_bounces=5))
    stats = draws.stats
    capped = stats["n_bounces"] == 5
    assert capped.mean() > 0.9
    assert not np.any(stats["accepted"] & (stats["n_steps"] < 3))
    assert np.all(stats["diverging"][stats["n_steps"] < 3])
    assert np.all(stats["n_bounces"] <= 5)
    assert stats["n_solves"].sum() == density.n_solves  # an abandoned trajectory is not evaluated any further
    assert density.n_solves < 4 * 50 * 3


def test_the_cap_leaves_the_target_invariant():
    from tests.samplers.moments import assert_right

    target = TruncatedGaussian()
    sampler = HamiltonianMonteCarlo(step_size=0.05, n_steps=4, max_bounces=1)
    result = run(target, sampler, draws=80, warmup=60, chains=256, seed=11, init="prior")
    assert 0.05 < result.posterior.stats["diverging"].mean() < 0.6
    assert_right(target, result)


def test_an_unstable_step_is_rejected_flagged_and_does_not_warn():
    draws = sample(SkewedGumbel(), HamiltonianMonteCarlo(step_size=500.0, n_steps=20))
    assert draws.stats["diverging"].all()
    assert not draws.stats["accepted"].any()
    assert np.all(draws.stats["acceptance_rate"] == 0)
    assert np.all(np.isfinite(draws.stats["energy"]))


def test_a_mild_energy_error_is_no_divergence():
    draws = sample(SkewedGumbel(), HamiltonianMonteCarlo(step_size=0.2, n_steps=5))
    assert 0.2 < draws.stats["acceptance_rate"].mean() < 0.99
    assert not draws.stats["diverging"].any()


def test_energy_is_that_of_the_state_the_step_ended_in():
    """H = W − log P with W ≥ 0; at equilibrium W is gamma distributed with mean ndim/2."""
    target = SkewedGumbel()
    sampler = HamiltonianMonteCarlo(step_size=0.15, n_steps=8)
    stats = run(target, sampler, draws=64, warmup=40, chains=128, seed=4, init="prior").posterior.stats
    kinetic = stats["energy"] + stats["lp"]
    assert kinetic.min() >= -1e-9
    assert kinetic.mean() == pytest.approx(1.5, abs=4.5 * np.sqrt(1.5 / 8192))


def test_the_acceptance_rate_is_the_probability_of_acceptance():
    sampler = HamiltonianMonteCarlo(step_size=0.3, n_steps=5)
    result = run(SkewedGumbel(), sampler, draws=40, warmup=20, chains=480, seed=2, init="prior")
    rate, accepted = result.posterior.stats["acceptance_rate"], result.posterior.stats["accepted"]
    error = (accepted - rate).sum() / np.sqrt((rate * (1 - rate)).sum())
    assert abs(error) < 5


def test_the_step_size_is_jittered_for_each_chain():
    jittered = sample(TruncatedGaussian(), HamiltonianMonteCarlo(0.1, 2, jitter=0.2), draws=40, chains=40)
    step_size = jittered.stats["step_size"]
    assert step_size.min() >= 0.08
    assert step_size.max() <= 0.12
    assert step_size.max() - step_size.min() > 0.038
    assert np.all(step_size[0] != step_size[1])
    fixed = sample(TruncatedGaussian(), HamiltonianMonteCarlo(0.1, 2, jitter=0.0), draws=5)
    assert np.all(fixed.stats["step_size"] == 0.1)


def test_a_start_without_a_finite_gradient_is_refused():
    class Broken(TruncatedGaussian):
        def log_prob_and_grad(self, theta):
            value, slope = super().log_prob_and_grad(theta)
            return value, slope * np.where(np.arange(len(value)) == 1, np.nan, 1.0)[:, None]

    with pytest.raises(ValueError, match=r"init: the gradient must be finite at the start \(chain 1\)"):
        sample(Broken(), HamiltonianMonteCarlo(0.1, 2))


def test_a_state_without_gradient_is_refused():
    target = TruncatedGaussian()
    kernel = HamiltonianMonteCarlo().bind(target)
    with pytest.raises(ValueError, match="state: must carry the gradient"):
        kernel.step(np.random.default_rng(1), State(target.mean[None], np.zeros(1)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"step_size": 0}, r"step_size: must be a positive finite number or None \(got 0\)"),
        ({"step_size": np.inf}, "step_size: must be a positive finite number"),
        ({"step_size": [0.1, 0.2]}, "step_size: must be a positive finite number"),
        ({"n_steps": 0}, "n_steps: must be a whole number of at least 1"),
        ({"n_steps": True}, "n_steps: must be a whole number"),
        ({"jitter": 1.0}, "jitter: must be at least 0 and below 1"),
        ({"jitter": -0.1}, "jitter: must be at least 0 and below 1"),
        ({"inverse_mass": [1.0, -1.0]}, "inverse_mass: must be positive"),
        ({"inverse_mass": [[1.0, 2.0], [2.0, 1.0]]}, "inverse_mass: must be a symmetric positive definite"),
        ({"first_mass": [[1.0, 2.0], [2.0, 1.0]]}, "first_mass: must be a symmetric positive definite"),
        ({"gradient": "forward"}, "gradient: must be one of exact, central-difference"),
        ({"delta": 0.0}, "delta: must be positive"),
        ({"h": -1e-6}, "h: must be a positive finite number"),
        ({"max_bounces": -1}, "max_bounces: must be a whole number of at least 0"),
    ],
)
def test_bad_settings(settings, message):
    with pytest.raises(ValueError, match=message):
        HamiltonianMonteCarlo(**settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"inverse_mass": [1.0, 1.0, 1.0]}, "inverse_mass: must have length 2"),
        ({"first_mass": [1.0, 1.0, 1.0]}, "first_mass: must have length 2"),
        ({"inverse_mass": 1.0, "first_mass": [1.0, 1.0, 1.0]}, "first_mass: must have length 2"),
        ({"gradient": "central-difference", "delta": [1.0]}, "delta: must have length 2"),
    ],
)
def test_settings_that_do_not_fit_the_density(settings, message):
    with pytest.raises(ValueError, match=message):
        HamiltonianMonteCarlo(**settings).bind(TruncatedGaussian())


def at_a_maximum(hessian, gradient=0.0):
    ndim = len(hessian)
    return [Quadratic(np.zeros(ndim), 0.0, np.full(ndim, gradient), np.asarray(hessian, dtype=float))], np.ones(1)


def test_the_curvature_at_a_maximum_is_the_first_mass():
    hessian = np.array([[4.0, 1.0], [1.0, 2.0]])
    assert_allclose(HamiltonianMonteCarlo().starting_from(*at_a_maximum(hessian)).first_mass, hessian)
    at_a_bound = HamiltonianMonteCarlo().starting_from(*at_a_maximum(hessian, 3.0)).first_mass
    assert_allclose(at_a_bound, hessian + 9.0 * np.eye(2))
    for given in ({"first_mass": 2.0}, {"inverse_mass": 2.0}, {"step_size": 0.1, "n_steps": 3}):
        sampler = HamiltonianMonteCarlo(**given)
        assert sampler.starting_from(*at_a_maximum(hessian)) is sampler


@pytest.mark.parametrize(
    "hessian",
    [[[1.0, 2.0], [2.0, 1.0]], [[np.nan, 0.0], [0.0, 1.0]], np.diag([np.nan, *[1.0] * 60])],
    ids=["saddle", "nan", "nan among many"],
)
def test_without_a_definite_curvature_warm_up_begins_as_without_a_maximum(hessian):
    sampler = HamiltonianMonteCarlo()
    assert sampler.starting_from(*at_a_maximum(hessian)) is sampler


@pytest.mark.parametrize("ndim", [10, 60])
def test_an_ill_conditioned_curvature_has_a_symmetric_inverse(ndim):
    """Rounding makes the inverse of LAPACK unsymmetric, which a metric must not be."""
    axes, _ = np.linalg.qr(np.random.default_rng(ndim).standard_normal((ndim, ndim)))
    hessian = (axes * np.logspace(0, 11, ndim)) @ axes.T
    hessian = 0.5 * (hessian + hessian.T)
    sampler = HamiltonianMonteCarlo().starting_from(*at_a_maximum(hessian))
    metric = Metric.of(_with_first_mass(sampler, ndim).inverse_mass, ndim)
    assert_array_equal(metric.inverse, metric.inverse.T)
    assert_allclose(metric.inverse @ hessian, np.eye(ndim), atol=0.1)
