"""HMC in logarithmic coordinates: the same target, chosen where it is skewed, at a fraction of the gradients."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.analysis.convergence.effective import ess_bulk, mcse_mean
from fmu.samplers import HamiltonianMonteCarlo, MixtureSampler, run
from fmu.samplers.kernel import State
from fmu.samplers.mixture.quadratic import Quadratic
from fmu.samplers.mixture.warp import Warp, WarpedDensity
from fmu.samplers.settings import describe
from tests.samplers.targets import CorrelatedGaussian, Quadrature, TruncatedGaussian


class WeakSpring(Quadrature):
    """Data of k/(k + 0.05), a weak spring in series, and of k/(k + 0.05) + y: skewed, correlated, at a bound."""

    name = "spring"

    def __init__(self):
        super().__init__(2, lower=[0.02, 0.0], upper=[1.0, 2.0])
        self.set_moments()

    def value_and_slope(self, x):
        k, y = x.T
        share, slope = k / (k + 0.05), 0.05 / (k + 0.05) ** 2
        first, second = (share - 0.7) / 0.08, (share + y - 0.75) / 0.05
        value = -0.5 * (first**2 + second**2)
        return value, np.stack([-(first / 0.08 + second / 0.05) * slope, -second / 0.05], axis=1)


class Exponential(Quadrature):
    """Gamma(2) times an exponential distribution of a sum, both without an upper bound."""

    name = "exponential"

    def __init__(self):
        super().__init__(2, lower=[0.0, 0.0], upper=[40.0, 40.0])
        self.set_moments()
        self.upper = np.full(2, np.inf)
        self.offset, self.scale = np.zeros(2), np.ones(2)

    def value_and_slope(self, x):
        a, b = x.T
        return np.log(a) - a - b - 0.2 * a * b, np.stack([1 / a - 1 - 0.2 * b, -1 - 0.2 * a], axis=1)


class Flat(Quadrature):
    name = "flat"

    def __init__(self):
        super().__init__(2, lower=[0.0, 0.0], upper=[1.0, 3.0])
        self.set_moments()

    def value_and_slope(self, x):
        return np.zeros(len(x)), np.zeros_like(x)


@pytest.mark.parametrize(
    ("target", "bent"),
    [(WeakSpring(), (True, False)), (TruncatedGaussian(), (True, True)), (Exponential(), (True, True))],
    ids=lambda one: getattr(one, "name", ""),
)
def test_the_target_is_the_same_in_any_coordinates(target, bent):
    sampler = HamiltonianMonteCarlo(bent=bent)
    draws = run(target, sampler, draws=60, warmup=100, chains=120, seed=2, init="prior").posterior.position
    for of, expected in ((draws, target.mean), ((draws - target.mean) ** 2, np.diag(target.covariance))):
        for k in range(2):
            assert abs(of[..., k].mean() - expected[k]) < 4.5 * mcse_mean(of[..., k])
    product = np.prod(draws - target.mean, axis=-1)
    assert abs(product.mean() - target.covariance[0, 1]) < 4.5 * mcse_mean(product)


@pytest.mark.parametrize(
    ("bent", "message"),
    [
        ((True,), r"bent: must have 2 values, one per coordinate \(got 1\)"),
        ((False, True), r"bent.1: must be False, as the coordinate has no lower bound \(got True\)"),
    ],
)
def test_coordinates_that_cannot_be_logarithmic_are_refused(bent, message):
    target = WeakSpring()
    target.lower = np.array([0.02, -np.inf])
    with pytest.raises(ValueError, match=message):
        HamiltonianMonteCarlo(bent=bent).bind(target)
    component = Quadratic(np.zeros(2), 0.0, np.zeros(2), np.eye(2))
    with pytest.raises(ValueError, match=message):
        MixtureSampler((component,), bent=bent).bind(target)
    with pytest.raises(ValueError, match="components: must be given with bent"):
        MixtureSampler(bent=bent)


def test_the_state_is_of_the_density_that_was_given():
    target = WeakSpring()
    kernel = HamiltonianMonteCarlo(step_size=0.3, n_steps=3, bent=(True, True)).bind(target)
    rng = np.random.default_rng(1)
    state, _ = kernel.init(target.sample_prior(rng, 20))
    for _ in range(5):
        before, (state, info) = state, kernel.step(rng, state)
        value, slope = target.log_prob_and_grad(state.position)
        assert_allclose(state.log_prob, value, rtol=1e-12, atol=1e-11)
        assert_allclose(state.gradient, slope, rtol=1e-9, atol=1e-9)
        assert_array_equal(info.log_prob, state.log_prob)
        stay = ~info.accepted
        assert_array_equal(state.position[stay], before.position[stay])
    with pytest.raises(ValueError, match="state: must carry the gradient"):
        kernel.step(rng, State(state.position, state.log_prob))


def test_the_gradient_of_a_warped_density_is_its_slope():
    target = WeakSpring()
    warped = WarpedDensity(target, Warp(target.lower, target.upper, np.array([True, False])))
    x = warped.warp.to_x(target.sample_prior(np.random.default_rng(3), 30))
    step = 1e-5 * np.eye(2)
    central = [(warped.log_prob(x + h) - warped.log_prob(x - h)) / 2e-5 for h in step]
    assert_allclose(warped.log_prob_and_grad(x)[1], np.transpose(central), rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize(
    ("target", "bent"),
    [(WeakSpring(), {0}), (CorrelatedGaussian(), set()), (Flat(), set()), (Exponential(), {0, 1})],
    ids=lambda one: getattr(one, "name", ""),
)
def test_skewed_coordinates_are_chosen_in_warm_up(target, bent):
    learnt = run(target, HamiltonianMonteCarlo(), draws=1, warmup=60, chains=8, seed=5, init="prior").learnt
    found = {int(k) for k in np.flatnonzero(learnt["bent"])}
    assert bent <= found
    assert bent or not found


def test_a_weak_spring_takes_half_of_the_gradients():
    target, per_gradient = WeakSpring(), []
    for bent in (None, (False, False)):
        result = run(
            target, HamiltonianMonteCarlo(bent=bent), draws=80, warmup=120, chains=32, seed=3, init="prior"
        ).posterior
        ess = min(ess_bulk(result.position[..., k]) for k in range(2))
        per_gradient.append(ess / result.stats["n_gradients"].sum())
    assert per_gradient[0] > 2.0 * per_gradient[1]


def test_a_given_metric_keeps_the_coordinates_and_a_mask_must_fit():
    learnt = run(
        WeakSpring(),
        HamiltonianMonteCarlo(inverse_mass=[0.01, 0.01]),
        draws=1,
        warmup=30,
        chains=2,
        seed=1,
        init="prior",
    ).learnt
    assert learnt["bent"] is None
    with pytest.raises(ValueError, match=r"bent: must have 2 values, one per coordinate \(got 3\)"):
        HamiltonianMonteCarlo(bent=(True, False, True)).bind(WeakSpring())


@pytest.mark.parametrize(("settings", "steps"), [(HamiltonianMonteCarlo(), 80), (MixtureSampler(), 250)])
def test_a_tuner_that_is_restored_has_the_coordinates_of_the_other(settings, steps):
    target, rng = WeakSpring(), np.random.default_rng(2)
    tuner, other = (settings.tuner(target, 4, 300) for _ in range(2))
    state, _ = tuner.kernel.init(target.sample_prior(rng, 4))
    for _ in range(steps):
        state, info = tuner.kernel.step(rng, state)
        tuner.update(state, info)
    other.restore(tuner.state())
    for _ in range(20):
        ends = []
        for one, seed in ((tuner, 1), (other, 1)):
            end, info = one.kernel.step(np.random.default_rng(seed), state)
            one.update(end, info)
            ends.append(end)
        assert_array_equal(ends[0].position, ends[1].position)
        state = ends[0]
    assert describe(tuner.finish_learning()) == describe(other.finish_learning())


def test_local_steps_of_a_mixture_follow_the_coordinates_of_its_fit():
    learnt = run(WeakSpring(), MixtureSampler(), draws=1, warmup=120, chains=4, seed=5, init="prior").learnt
    assert learnt["bent"][0]
    assert learnt["local"]["bent"] == learnt["bent"]


def test_tempering_keeps_the_coordinates():
    assert HamiltonianMonteCarlo().rung_tuner(WeakSpring(), 4, 200).learner.choose_warp is None
