"""What the samplers learn in warm-up with their default settings, and that adaptation is frozen after it."""

import numpy as np
import pytest

from fmu.posterior.scaled import ScaledDensity
from fmu.samplers import HamiltonianMonteCarlo, MetropolisHastings, RandomWalk, Run, Slice, make_sampler, run
from fmu.samplers.hmc import SHORT_STEPS
from fmu.samplers.settings import describe
from tests import plain_densities
from tests.samplers.moments import assert_right
from tests.samplers.targets import Banana, CorrelatedGaussian, SkewedGumbel, Target, TruncatedGaussian

ADAPTIVE = ("mh", "slice", "hmc")


class Canyon(Target):
    """A Gaussian in a box, 80 times longer than wide and oblique, 0.3 to 0.6 of the box away from its start."""

    name = "canyon"

    def __init__(self):
        super().__init__(4, lower=np.zeros(4), upper=np.full(4, 10.0))
        axes, _ = np.linalg.qr(np.random.default_rng(3).standard_normal((4, 4)))
        self.sd = np.array([0.01, 0.05, 0.2, 0.8])
        self.axes, self.mean = axes, np.array([5.0, 6.0, 4.0, 5.5])
        self.covariance = axes * self.sd**2 @ axes.T
        self.precision = axes / self.sd**2 @ axes.T
        self.start = np.array([1.0, 0.1, 9.9, 0.1])

    def value_and_slope(self, x):
        pull = (self.mean - x) @ self.precision
        return -0.5 * np.sum((self.mean - x) * pull, axis=1), pull


class Flat(Target):
    """Flat in a box."""

    name = "flat"

    def __init__(self):
        super().__init__(3, lower=np.zeros(3), upper=np.array([1.0, 5.0, 0.1]))

    def value_and_slope(self, x):
        return np.zeros(len(x)), np.zeros_like(x)


def warmed(target, sampler, warmup=300, draws=1, chains=8, init="prior", seed=7):
    return run(target, sampler, draws=draws, warmup=warmup, chains=chains, seed=seed, init=init)


@pytest.fixture(scope="module")
def of_gaussian():
    """Return the run in which HMC learns the five-dimensional Gaussian by its default settings."""
    return warmed(CorrelatedGaussian(), HamiltonianMonteCarlo())


@pytest.mark.parametrize("init", ["start", pytest.param("prior", marks=pytest.mark.validate)])
@pytest.mark.parametrize("name", ADAPTIVE)
def test_default_settings_find_and_learn_a_narrow_target(name, init):
    target = Canyon()
    draws = {"mh": 300, "slice": 150, "hmc": 40}[name]
    result = warmed(target, make_sampler(name), warmup=350, draws=draws, chains=32, init=init)
    assert_right(target, result, least=300)


@pytest.mark.parametrize(
    "kind",
    [
        TruncatedGaussian,
        SkewedGumbel,
        *(pytest.param(kind, marks=pytest.mark.validate) for kind in (CorrelatedGaussian, Banana, Canyon)),
    ],
)
class TestAcceptance:
    def test_of_metropolis_is_near_its_optimum(self, kind):
        target = kind()
        stats = warmed(target, MetropolisHastings(), draws=125).posterior.stats
        # 1000 rates of sd 0.35, one in three of them independent: 0.08 is four standard errors
        optimum = 0.234 + (0.44 - 0.234) / target.ndim
        assert stats["acceptance_rate"].mean() == pytest.approx(optimum, abs=0.08)

    def test_of_hmc_is_near_its_target(self, kind):
        result = warmed(kind(), HamiltonianMonteCarlo(), warmup=200, draws=25, chains=16)
        target = SHORT_STEPS if kind is Banana else 0.8  # longer steps diverge where it bends
        assert result.learnt["target_accept"] == target
        assert result.posterior.stats["acceptance_rate"].mean() == pytest.approx(target, abs=0.08)


def test_the_acceptance_that_hmc_aims_at_may_be_chosen():
    stats = warmed(SkewedGumbel(), HamiltonianMonteCarlo(target_accept=0.95), warmup=150, draws=50).posterior.stats
    assert stats["acceptance_rate"].mean() == pytest.approx(0.95, abs=0.03)


class TestLearnt:
    """In the scaled view of the Gaussian, every coordinate has standard deviation 1."""

    def correlation(self, target):
        sd = np.sqrt(np.diag(target.covariance))
        return target.covariance / np.outer(sd, sd)

    def test_metric_of_hmc_is_the_covariance(self, of_gaussian):
        target, learnt = CorrelatedGaussian(), of_gaussian.learnt
        np.testing.assert_allclose(learnt["inverse_mass"], self.correlation(target), atol=0.25)
        assert learnt["n_steps"] == round(learnt["length"] / learnt["step_size"])

    def test_random_walk_has_the_shape_of_the_target(self):
        target = CorrelatedGaussian()
        learnt = warmed(target, MetropolisHastings(), warmup=400, chains=24).learnt
        scale = np.array(learnt["proposal"]["scale"])
        np.testing.assert_allclose(scale / np.trace(scale), self.correlation(target) / 5, atol=0.06)
        assert np.sqrt(np.trace(scale) / 5) == pytest.approx(2.38 / np.sqrt(5), rel=0.3)

    def test_axes_of_slice_are_the_principal_directions(self):
        target = Canyon()
        learnt = warmed(target, Slice()).learnt
        order = np.argsort(learnt["width"])
        cosines = np.sum(np.array(learnt["axes"])[:, order] * target.axes, axis=0)
        np.testing.assert_allclose(np.abs(cosines), 1.0, atol=0.01)

    def test_intervals_of_slice_are_three_standard_deviations(self):
        target = CorrelatedGaussian()
        learnt = warmed(target, Slice(), chains=24).learnt
        sd = np.sqrt(np.linalg.eigvalsh(self.correlation(target)))
        np.testing.assert_allclose(np.sort(learnt["width"]), 3.0 * sd, rtol=0.25)


SHORT = {"warmup": 60, "draws": 10}


class TestGivenByHand:
    @pytest.mark.parametrize(
        "sampler",
        [
            MetropolisHastings(RandomWalk(0.3)),
            Slice(width=0.7),
            HamiltonianMonteCarlo(0.1, 5),
            HamiltonianMonteCarlo(0.1, 5, inverse_mass=[1.0, 2.0, 0.5]),
        ],
        ids=["mh", "slice", "hmc", "hmc-mass"],
    )
    def test_fixed_settings_learn_nothing(self, sampler):
        target = SkewedGumbel()
        result = warmed(target, sampler, warmup=50, draws=10)
        assert result.learnt == {}
        # the draws are those of a kernel that never heard of warm-up
        whole = np.concatenate([result.warmup.position, result.posterior.position], axis=1)
        unwarmed = warmed(target, sampler, warmup=0, draws=60)
        np.testing.assert_array_equal(unwarmed.posterior.position, whole)

    def test_inverse_mass(self):
        learnt = warmed(SkewedGumbel(), HamiltonianMonteCarlo(inverse_mass=[1.0, 2.0, 0.5]), **SHORT).learnt
        assert list(learnt["inverse_mass"]) == [1.0, 2.0, 0.5]
        assert learnt["step_size"] is not None

    def test_first_mass(self, of_gaussian):
        """Long steps from the first one on, until warm-up has learnt a covariance; then it is forgotten."""
        first = 0.7 * np.eye(CorrelatedGaussian().ndim) + 0.3
        result = warmed(CorrelatedGaussian(), HamiltonianMonteCarlo(first_mass=first))
        steps, of_plain = (one.warmup.stats["n_steps"][:, :20].mean() for one in (result, of_gaussian))
        assert steps < 0.7 * of_plain
        assert result.learnt["first_mass"] is None
        np.testing.assert_allclose(result.learnt["inverse_mass"], of_gaussian.learnt["inverse_mass"], atol=0.25)
        short = warmed(CorrelatedGaussian(), HamiltonianMonteCarlo(first_mass=first), warmup=20, draws=5)
        np.testing.assert_allclose(short.learnt["inverse_mass"], np.linalg.inv(first), rtol=1e-12)

    def test_number_of_steps(self):
        result = warmed(SkewedGumbel(), HamiltonianMonteCarlo(n_steps=7), **SHORT)
        assert result.learnt["n_steps"] == 7
        assert set(np.unique(result.posterior.stats["n_steps"])) == {7}

    def test_scheme_of_slice(self):
        result = warmed(SkewedGumbel(), Slice("coordinate"), **SHORT)
        assert result.learnt["scheme"] == "coordinate"
        assert result.posterior.stats["n_steps_out"].sum() > 0


@pytest.mark.parametrize("name", ADAPTIVE)
def test_nothing_is_learnt_after_warm_up(name):
    """Carried on, a run is made with the settings frozen at its end of warm-up: a fresh kernel of them agrees."""
    target = SkewedGumbel()
    begun = Run(target, make_sampler(name), warmup=100, chains=3, seed=2, init="prior")
    first = begun.extend(20)
    scaled = ScaledDensity(target)
    held = begun._groups[0].state
    tuner = make_sampler(name).tuner(scaled, 3, 100)
    tuner.restore(held.tuner)
    assert describe(tuner.finish_learning()) == first.learnt == held.learnt
    kernel, state, copy = tuner.finish_learning().bind(scaled), held.state, np.random.default_rng(0)
    copy.bit_generator.state = held.generator
    position = []
    for _ in range(20):
        state, _ = kernel.step(copy, state)
        position.append(scaled.to_theta(state.position))
    second = begun.extend(20)
    assert second.learnt == first.learnt
    np.testing.assert_array_equal(second.posterior.position[:, 20:], np.stack(position, axis=1))


def test_the_step_size_of_the_draws_is_the_one_learnt():
    result = warmed(SkewedGumbel(), HamiltonianMonteCarlo(jitter=0.1), warmup=40, draws=100, chains=4)
    ratio = result.posterior.stats["step_size"] / result.learnt["step_size"]
    assert 0.9 <= ratio.min() < 0.92
    assert 1.08 < ratio.max() <= 1.1


class Trap(Target):
    """A Gaussian of unit width, and far away a spike 1000 times narrower and 200 below in log-density."""

    name = "trap"

    def __init__(self):
        super().__init__(2)
        self.mean, self.covariance = np.zeros(2), np.eye(2)
        self.spike, self.narrow = np.full(2, 50.0), 1e-3
        self.unbounded_view()

    def value_and_slope(self, x):
        near = -0.5 * np.sum(x**2, axis=1)
        away = (x - self.spike) / self.narrow
        far = -200.0 - 0.5 * np.sum(away**2, axis=1)
        value = np.logaddexp(near, far)
        weight = np.exp(far - value)[:, None]
        return value, -(1 - weight) * x - weight * away / self.narrow


@pytest.mark.parametrize("name", ADAPTIVE)
def test_a_trapped_chain_does_not_spoil_what_the_others_learn(name):
    target = Trap()
    start = np.vstack([0.5 * np.random.default_rng(1).standard_normal((3, 2)), target.spike[None]])
    result = warmed(target, make_sampler(name), warmup=250, draws=5, chains=4, init=start)
    x = result.posterior.position
    np.testing.assert_allclose(x[3], 50.0, atol=0.1)  # the trap holds
    scale = {
        "mh": lambda learnt: np.sqrt(np.diag(learnt["proposal"]["scale"])) / (2.38 / np.sqrt(2)),
        "slice": lambda learnt: np.array(learnt["width"]) / 3.0,
        "hmc": lambda learnt: np.sqrt(np.diag(learnt["inverse_mass"])),
    }[name](result.learnt)
    np.testing.assert_allclose(scale, 1.0, rtol=0.35)
    if name == "hmc":
        assert result.learnt["step_size"] > 0.5


def test_steps_on_a_flat_density_have_an_end():
    """All are accepted, so that no acceptance rate bounds them, and walls reflected the longest to death."""
    sampler = HamiltonianMonteCarlo()
    stats = warmed(Flat(), sampler, warmup=60, draws=20, chains=4).posterior.stats
    assert np.all(stats["accepted"])
    assert stats["step_size"].max() <= 10.0 * (1.0 + sampler.jitter) * sampler.length
    assert stats["n_bounces"].max() <= 100


def test_steps_are_short_where_longer_ones_diverge(of_gaussian):
    """At the usual acceptance rate one trajectory in three hundred diverged, so that no run converged."""
    density = plain_densities.BentLittle()
    result = warmed(density, HamiltonianMonteCarlo(), warmup=400, draws=125, chains=16, seed=1)
    assert result.learnt["target_accept"] == SHORT_STEPS
    assert np.mean(result.posterior.stats["diverging"]) <= 1e-3
    assert of_gaussian.learnt["target_accept"] == HamiltonianMonteCarlo.target_accept
