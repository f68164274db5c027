"""The mixture sampler: its exact density, what it learns, and that it crosses between separated maxima."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp

from fmu.posterior.scaled import ScaledDensity
from fmu.samplers import MetropolisHastings, MixtureSampler, Run, Slice
from fmu.samplers.kernel import State
from fmu.samplers.kernel import Target as Counted
from fmu.samplers.mixture.kernel import BLOCK, CANDIDATE, LOG_WEIGHT, MixtureKernel
from fmu.samplers.mixture.proposal import Mixture, Points, fit_mixture, refit_mixture
from fmu.samplers.mixture.quadratic import Quadratic, climb, fit_quadratic
from fmu.samplers.mixture.warmup.local_draws import first_warp, groups_of_chains
from fmu.samplers.mixture.warmup.tuner import MixtureTuner
from fmu.samplers.mixture.warp import Warp
from tests.gradients import assert_gradient, differences
from tests.samplers.targets import Banana, CorrelatedGaussian, SkewedGumbel, Target, TwoModes

LOWER, UPPER = np.array([0.0, -1.0]), np.array([1.0, 2.0])
STEEP = Quadratic(np.array([1.0, 0.2]), 3.0, np.array([9.0, -1.0]), np.array([[50.0, 12.0], [12.0, 9.0]]))
FLAT = Quadratic(np.array([0.2, 1.0]), -1.0, np.zeros(2), np.array([[4.0, -1.0], [-1.0, 2.0]]))
BENDS = [(False, False), (True, False), (True, True)]


def mixture_of(bent, lower=LOWER, upper=UPPER):
    warp = Warp(lower, upper, np.array(bent))
    return Mixture([warp.quadratic(STEEP), warp.quadratic(FLAT)], [0.7, 0.3], warp)


def midpoints(n=350):
    axes = [a + (b - a) * (np.arange(n) + 0.5) / n for a, b in zip(LOWER, UPPER, strict=True)]
    cell = np.prod(UPPER - LOWER) / n**2
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2), cell


@pytest.mark.parametrize("bent", BENDS)
def test_the_density_is_normalised_and_that_of_the_draws(bent):
    q = mixture_of(bent)
    points, cell = midpoints()
    p = np.exp(q.log_density(points)) * cell
    assert p.sum() == pytest.approx(1.0, abs=2e-3)
    u = q.draw(np.random.default_rng(1), 40_000)
    assert np.all((u >= LOWER) & (u <= UPPER))
    mean = p @ points
    sd = np.sqrt(p @ (points - mean) ** 2)
    np.testing.assert_allclose((u.mean(axis=0) - mean) / sd, 0.0, atol=5 / 200)
    np.testing.assert_allclose(u.std(axis=0) / sd, 1.0, atol=0.03)


class Plateau:
    """The density of `mixture_of`, and next to nothing everywhere else in a box much larger than it."""

    ndim = 2
    lower, upper = np.array([-9.0, -9.0]), np.array([9.0, 9.0])

    def log_prob(self, u):
        return np.maximum(-0.5 * np.sum((u / 0.01) ** 2, axis=1), -400.0)


@pytest.mark.parametrize("gathers", [False, True])
def test_a_chain_far_out_is_brought_in_by_warm_up_alone(gathers):
    """Where a mixture has no tail the weight of a chain far out is beyond all candidates."""
    density = Plateau()
    warp = Warp(density.lower, density.upper, np.array([False, False]))
    narrow = Quadratic(np.zeros(2), 0.0, np.zeros(2), np.eye(2) / 0.01**2)
    mixture = Mixture([warp.quadratic(narrow)], [1.0], warp)
    local = Slice().bind(density)
    kernel = MixtureKernel(Counted(density), mixture, local, local_steps=0, jumps=1, gathers=gathers)
    state, _ = kernel.init(np.array([[0.01, 0.0], [7.0, 7.0]]))
    rng = np.random.default_rng(1)
    for _ in range(BLOCK):
        state, _ = kernel.step(rng, state)
    assert np.all(np.abs(state.position[0]) < 0.1)
    assert (np.all(np.abs(state.position[1]) < 0.1)) == gathers


def test_a_half_bounded_coordinate_has_a_normalised_density():
    q = mixture_of((True, False), np.array([0.0, -np.inf]), np.array([np.inf, np.inf]))
    u = q.draw(np.random.default_rng(2), 40_000)
    # E_q[uniform density on a box / q] is the share of the box, whatever q
    box = np.array([[0.3, 0.0], [1.2, 1.0]])
    inside = np.all((u > box[0]) & (u < box[1]), axis=1)
    found = np.mean(inside / np.prod(box[1] - box[0]) * np.exp(-q.log_density(u)))
    assert found == pytest.approx(1.0, abs=0.05)


def test_a_quadratic_keeps_its_value_and_slope_under_a_warp():
    warp = Warp(LOWER, UPPER, np.array([True, False]))
    of_x = warp.quadratic(FLAT)
    for d in 1e-3 * np.random.default_rng(3).standard_normal((5, 2)):
        u = (FLAT.position + d)[None]
        exact = FLAT(u) + warp.log_stretch(u)
        assert of_x(warp.to_x(u)) == pytest.approx(exact, abs=3e-7)
    back = warp.straighten(of_x)
    assert back.log_prob == pytest.approx(FLAT.log_prob, abs=1e-12)
    for name in ("position", "gradient", "hessian"):
        assert getattr(back, name) == pytest.approx(getattr(FLAT, name), rel=1e-12, abs=1e-12)


def test_a_fit_finds_a_quadratic():
    u = np.random.default_rng(4).uniform(LOWER, UPPER, (60, 2))
    found = fit_quadratic(u, STEEP(u), np.exp(0.1 * STEEP(u)))
    np.testing.assert_allclose(found(u), STEEP(u), atol=2e-4 * np.ptp(STEEP(u)))


def test_gradients_determine_a_quadratic_from_fewer_points_than_coefficients():
    rng, ndim = np.random.default_rng(11), 6
    root = rng.standard_normal((ndim, ndim))
    exact = Quadratic(rng.standard_normal(ndim), 2.0, rng.standard_normal(ndim), root @ root.T + np.eye(ndim))
    u = exact.position + 0.3 * rng.standard_normal((12, ndim))
    slope = exact.gradient - (u - exact.position) @ exact.hessian
    elsewhere = exact.position + rng.standard_normal((50, ndim))
    found, alone = (fit_quadratic(u, exact(u), np.ones(12), of)(elsewhere) for of in (slope, None))
    size = np.ptp(exact(elsewhere))
    np.testing.assert_allclose(found, exact(elsewhere), atol=1e-3 * size)
    assert np.max(np.abs(alone - exact(elsewhere))) > 0.1 * size


def test_the_gradient_under_a_warp_is_that_of_the_density_of_x():
    warp = Warp(LOWER, UPPER, np.array([True, False]))
    u = np.random.default_rng(12).uniform(0.2, 0.8, (5, 2)) * (UPPER - LOWER) + LOWER
    step = 1e-5
    x, _, slope = Points(u, FLAT(u), np.ones(5), differences(FLAT, u, step)).under(warp)

    def value(x):
        u = warp.to_u(x)
        return FLAT(u) + warp.log_stretch(u)

    assert_gradient(slope, value, x, step, rtol=1e-7, atol=1e-6 * np.max(np.abs(slope)))


def test_a_few_points_with_all_the_weight_are_fitted_all_the_same():
    """The first candidates may miss the posterior nearly everywhere."""
    rng, ndim = np.random.default_rng(7), 6
    box = np.full(ndim, np.inf)
    u = rng.standard_normal((200, ndim))
    log_p = -0.5 * np.sum((u / 1e-3) ** 2, axis=1)
    points = Points.weigh_draws(u, log_p, -0.5 * np.sum(u**2, axis=1))
    assert points.weight.sum() ** 2 / np.sum(points.weight**2) > 3 * ndim
    warp = Warp(-box, box, np.zeros(ndim, dtype=bool))
    wide = Quadratic(np.zeros(ndim), 0.0, np.zeros(ndim), np.eye(ndim))
    found = fit_mixture(points, Mixture([wide], [1.0], warp))
    assert np.linalg.det(np.cov(found.draw(rng, 4000).T)) < 1e-3


def test_a_nearly_singular_curvature_can_be_drawn_from():
    flat = np.diag([1e-9, 1e16])
    q = Quadratic(np.zeros(2), 0.0, np.zeros(2), flat)
    warp = Warp(LOWER, UPPER, np.zeros(2, dtype=bool))
    u = Mixture([q], [1.0], warp).draw(np.random.default_rng(6), 100)
    assert np.all(np.isfinite(Mixture([q], [1.0], warp).log_density(u)))


def test_arrays_keep_components_with_a_covariance_beside_one_without():
    """A maximum that a chain has found joins without one, and the run may be stopped before the next fit."""
    u = np.random.default_rng(8).uniform(LOWER, UPPER, (60, 2))
    warp = Warp(LOWER, UPPER, np.array([True, False]))
    q = Mixture([fit_quadratic(warp.to_x(u), STEEP(u), np.ones(60)), warp.quadratic(FLAT)], [0.7, 0.3], warp)
    again = Mixture.of_arrays(q.arrays(), LOWER, UPPER)
    np.testing.assert_array_equal(again.log_density(u), q.log_density(u))
    assert again.quadratics[1].covariance is None


def test_arrays_keep_the_share_of_wider_copies():
    q = Mixture([FLAT], [1.0], Warp(LOWER, UPPER, np.array([False, False])), wide=0.05)
    u = np.random.default_rng(8).uniform(LOWER, UPPER, (60, 2))
    np.testing.assert_array_equal(Mixture.of_arrays(q.arrays(), LOWER, UPPER).log_density(u), q.log_density(u))


def test_arrays_keep_weights_bit_for_bit():
    """Weights that add up to 1 but for rounding change when they are normalised again."""
    for weights in np.random.default_rng(9).random((6, 4)):
        q = Mixture([FLAT] * 4, weights, Warp(LOWER, UPPER, np.array([False, False])))
        np.testing.assert_array_equal(Mixture.of_arrays(q.arrays(), LOWER, UPPER).weights, q.weights)


def test_a_banana_is_split_and_a_gaussian_is_not():
    rng, box = np.random.default_rng(5), np.full(2, np.inf)
    x = rng.standard_normal((4000, 2))
    warp = Warp(-box, box, np.zeros(2, dtype=bool))
    shares = {}
    for name, bend in (("gaussian", 0.0), ("banana", 0.6)):
        u = np.column_stack([x[:, 0], 0.3 * x[:, 1] + bend * x[:, 0] ** 2])
        log_p = -0.5 * np.sum(x**2, axis=1)
        points = Points(u, log_p, np.ones(len(u)))
        one = Mixture([fit_quadratic(u, log_p, points.weight)], [1.0], warp)
        found = fit_mixture(points, one)
        before, after = (points.effective_share(q.log_density(u)) for q in (one, found))
        shares[name] = len(found.quadratics), before, after
    assert shares["gaussian"][0] == 1
    assert shares["gaussian"][1] > 0.8
    assert shares["banana"][0] > 1
    assert shares["banana"][2] > 1.3 * shares["banana"][1]


def test_a_maximum_of_a_few_percent_keeps_its_component_when_its_points_are_too_few():
    """Otherwise later candidates would never be there, and chains that left it agree on what is wrong."""
    rng, wide = np.random.default_rng(9), np.full(2, np.inf)
    centre = np.array([[0.0, 0.0], [30.0, 0.0]])
    both = [Quadratic(c, 0.0, np.zeros(2), np.eye(2)) for c in centre]
    u = np.concatenate([centre[k] + rng.standard_normal((n, 2)) for k, n in enumerate((400, 8))])
    log_p = np.logaddexp(*(one(u) for one in both))
    start = Mixture(both, [0.95, 0.05], Warp(-wide, wide, np.zeros(2, dtype=bool)))
    found = fit_mixture(Points(u, log_p, np.ones(len(u))), start)
    assert len(found.quadratics) == 2
    assert found.quadratics[1] is both[1]
    assert found.weights[1] == pytest.approx(8 / 408, rel=0.01)


class Apart(TwoModes):
    """Two modes that no local step leaves."""

    name = "apart"

    def __init__(self):
        super().__init__()
        self.centres = np.array([[-10.0, 0.0], [12.0, 15.0]])
        self.mean = self.weights @ self.centres
        away = self.centres - self.mean
        self.covariance = np.einsum("k,kij->ij", self.weights, self.covariances) + away.T * self.weights @ away
        self.unbounded_view()

    def components(self):
        """The two maxima in scaled units."""
        scaled, found = ScaledDensity(self), []
        for centre, precision in zip(self.centres, self.precisions, strict=True):
            value = float(self.log_prob(centre))
            hessian = precision * np.outer(self.scale, self.scale)
            found.append(Quadratic(scaled.to_scaled(centre), value, np.zeros(2), hessian))
        return found

    def log_evidence(self):
        """∫ exp(log_prob) is 2π, as the weights add up to 1."""
        return np.log(2 * np.pi)


def drawn(target, sampler, *, chains=8, draws=600, warmup=400, seed=1, **more):
    return Run(target, sampler, warmup=warmup, chains=chains, seed=seed, **more).extend(draws)


def test_chains_cross_between_separated_modes_in_the_right_proportion():
    """Even if the search found the wrong shares."""
    target = Apart()
    sampler = MixtureSampler(target.components(), (0.99, 0.01))
    start = np.repeat(target.centres[:1], 8, axis=0)
    result = drawn(target, sampler, init=start)
    left = result.posterior.position[..., 0] < 0
    share = left.mean()
    assert share == pytest.approx(0.7, abs=0.03)
    crossings = np.sum(left[:, 1:] != left[:, :-1], axis=1)
    assert crossings.min() > 50
    log_w = result.posterior.stats[CANDIDATE]
    log_w = log_w[np.isfinite(log_w)]
    found = logsumexp(log_w) - np.log(len(log_w)) + np.sum(np.log(target.scale))
    assert found == pytest.approx(target.log_evidence(), abs=0.03)


def test_a_mode_that_the_search_missed_joins():
    target = Apart()
    start = np.concatenate([np.repeat(target.centres[:1], 7, axis=0), target.centres[1:]])
    result = drawn(target, MixtureSampler(target.components()[:1]), init=start)
    assert np.mean(result.posterior.position[..., 0] < 0) == pytest.approx(0.7, abs=0.04)
    assert len(result.learnt["components"]) == 2


class LogGamma(Target):
    """Eight independent logarithms of exponential variables: skewed, with their maximum at 0."""

    def __init__(self, mean=-np.euler_gamma, variance=np.pi**2 / 6):
        super().__init__(8)
        self.mean, self.covariance = np.full(8, mean), np.eye(8) * variance
        self.unbounded_view()

    def value_and_slope(self, x):
        return np.sum(x - np.exp(x), axis=1), 1.0 - np.exp(x)

    def exact(self, rng, n):
        return np.log(rng.exponential(size=(n, 8)))


class RoundGaussian(LogGamma):
    """Eight independent Gaussian variables."""

    def __init__(self):
        super().__init__(mean=0.0, variance=1.0)

    def value_and_slope(self, x):
        return -0.5 * np.sum(x**2, axis=1), -x

    def exact(self, rng, n):
        return rng.standard_normal((n, 8))


@pytest.mark.parametrize(
    ("target", "components", "local", "walks"),
    [
        (RoundGaussian(), 1, None, False),
        (LogGamma(), 1, None, True),
        (LogGamma(), 2, None, False),  # local steps might leave one of them out
        (LogGamma(), 1, Slice(), False),
    ],
)
def test_local_steps_follow_a_single_poor_component(target, components, local, walks):
    """A tuner that is restored on the way goes on as the other."""
    scaled = ScaledDensity(target)
    best = Quadratic(scaled.to_scaled(np.zeros(8)), -8.0, np.zeros(8), np.diag(scaled.scale**2))
    sampler, rng = MixtureSampler(components * (best,), local=local), np.random.default_rng(1)
    tuner = sampler.tuner(scaled, 4, 400)
    state, _ = tuner.kernel.init(scaled.to_scaled(target.exact(rng, 4)))
    for _ in range(60):
        state, info = tuner.kernel.step(rng, state)
        tuner.update(state, info)
    assert (tuner.mixture is None) == walks
    again = sampler.tuner(scaled, 4, 400)
    again.restore(tuner.state())
    rngs = np.random.default_rng(2), np.random.default_rng(2)
    states = [state, state]
    for _ in range(340 if walks else 140):
        for k, (one, of) in enumerate(zip((tuner, again), rngs, strict=True)):
            states[k], info = one.kernel.step(of, states[k])
            one.update(states[k], info)
        np.testing.assert_array_equal(states[0].position, states[1].position)
    assert bool(len(tuner.visited.log_prob)) == walks
    assert tuner.mixture is not None


class Five(Target):
    """Five round modes in the unit box."""

    centres = np.array([[0.1, 0.1], [0.9, 0.1], [0.5, 0.5], [0.2, 0.9], [0.8, 0.8]])
    sd = 0.02

    def __init__(self):
        super().__init__(2, np.zeros(2), np.ones(2))

    def value_and_slope(self, x):
        away = (self.centres[:, None] - x) / self.sd
        each = -0.5 * np.sum(away**2, axis=2)
        value = logsumexp(each, axis=0)
        return value, np.einsum("kn,kni->ni", np.exp(each - value), away / self.sd)


def test_chains_at_separated_maxima_have_a_component_each_from_the_first_fit():
    target = Five()
    density = ScaledDensity(target)
    u = (target.centres + target.sd * np.random.default_rng(1).standard_normal((60, 5, 2))).reshape(-1, 2)
    tuner = MixtureTuner(MixtureSampler(), density, 5, 120)
    tuner.visited = tuner.visited.with_more(u, *density.log_prob_and_grad(u))
    tuner._fit_to_draws()
    found = np.array([tuner.mixture.warp.to_u(q.position) for q in tuner.mixture.quadratics])
    away = np.linalg.norm(target.centres[:, None] - found, axis=2)
    assert np.all(away.min(axis=1) < target.sd)


@pytest.mark.parametrize("move", [0.0, 1e-14])
def test_a_chain_that_has_not_moved_has_no_component(move):
    """A single point has no covariance, and rounding is none."""
    target = SkewedGumbel()
    u = np.random.default_rng(1).standard_normal((40, 3, target.ndim))
    u[:, 2] = 50.0 + move * u[:, 2]
    tuner = MixtureTuner(MixtureSampler(), ScaledDensity(target), 3, 80)
    log_p = target.log_prob(u.reshape(-1, target.ndim))
    tuner.visited = tuner.visited.with_more(u.reshape(-1, target.ndim), log_p, np.full((120, target.ndim), np.nan))
    tuner._fit_to_draws()
    assert np.all(np.isfinite(tuner.mixture.log_density(u[:, 0])))


def far_apart(**settings):
    """Return two maxima, sixteen standard deviations apart, and a tuner that knows the first alone."""
    target = Apart()
    sampler = MixtureSampler(target.components()[:1], local=Slice(), **settings)
    return target, MixtureTuner(sampler, ScaledDensity(target), 2, 100)


def at(tuner, theta):
    u = tuner.density.to_scaled(np.atleast_2d(theta))
    return State(u, tuner.density.log_prob(u))


@pytest.mark.parametrize("who", ["chain", "candidate", "visited"])
def test_a_maximum_that_was_found_once_joins_the_mixture(who):
    """Whether a chain is there at the fit, a candidate was, or a chain was there before the first fit."""
    target, tuner = far_apart()
    here = at(tuner, target.centres[[0, 0]])
    usual = tuner.mixture.draw(np.random.default_rng(1), 200)
    tuner.drawn = tuner.drawn.with_more(usual, tuner.density.log_prob(usual))
    tuner.counts[-1] = 200
    there = at(tuner, target.centres[1] + 1.5)
    if who == "chain":
        here = at(tuner, [target.centres[0], target.centres[1] + 1.5])
    elif who == "candidate":
        tuner.drawn = tuner.drawn.with_more(there.position, there.log_prob)
        tuner.counts[-1] += 1
    else:
        tuner.visited = tuner.visited.with_more(there.position, there.log_prob)
    spent = tuner._fit(here)
    found = [tuner.density.to_theta(tuner.mixture.warp.to_u(q.position)) for q in tuner.mixture.quadratics]
    assert len(found) == 2
    assert np.linalg.norm(found[1] - target.centres[1]) < 0.5  # from 2.1
    assert 6 + 5 <= spent.sum() <= 6 + 8 * 5  # along the line, and to climb
    # candidates of the new component are near the maximum, and the next fit learns its weight from them
    usual = tuner.mixture.draw(np.random.default_rng(2), 400)
    tuner.drawn = tuner.drawn.with_more(usual, tuner.density.log_prob(usual))
    tuner.counts[-1] = 400
    tuner._fit(at(tuner, target.centres))
    assert tuner.mixture.weights == pytest.approx([0.7, 0.3], abs=0.1)


def test_every_mixture_of_warm_up_keeps_a_given_share_of_wider_copies():
    """One fitted to candidates with a new maximum, and one fitted to local draws."""
    target, tuner = far_apart(wide=0.3)
    usual = tuner.mixture.draw(np.random.default_rng(1), 200)
    tuner.drawn = tuner.drawn.with_more(usual, tuner.density.log_prob(usual))
    tuner.counts[-1] = 200
    tuner._fit(at(tuner, [target.centres[0], target.centres[1] + 1.5]))
    assert len(tuner.mixture.quadratics) == 2
    assert [stage.wide for stage in tuner.stages] == [0.3, 0.3]
    walked = MixtureTuner(MixtureSampler(local=Slice(), wide=0.3), tuner.density, 2, 100)
    walked.visited = walked.visited.with_more(usual, tuner.density.log_prob(usual))
    walked._fit_to_draws()
    assert walked.mixture.wide == 0.3


def test_where_the_mixture_is_far_off_a_chain_still_gives_it_a_component():
    """All candidates so far are nearer to the new component than to the old one."""
    target, tuner = far_apart()
    tuner.stages[0] = Mixture(target.components()[1:], [1.0], tuner.mixture.warp)
    u = tuner.density.to_scaled(target.centres[[0] * 30] + np.random.default_rng(5).standard_normal((30, 2)))
    tuner.drawn = tuner.drawn.with_more(u, tuner.density.log_prob(u) - 1e4)
    tuner.counts[-1] = 30
    tuner._fit(at(tuner, target.centres[[0, 0]]))
    assert len(tuner.mixture.quadratics) == 2


def test_a_point_in_the_tail_of_a_known_maximum_is_no_maximum():
    target, tuner = far_apart()
    usual = tuner.mixture.draw(np.random.default_rng(1), 200)
    tuner.drawn = tuner.drawn.with_more(usual, tuner.density.log_prob(usual) - 8.0)  # the tail is 8 too heavy
    tuner.counts[-1] = 200
    u = tuner.density.to_scaled(target.centres[:1] + 0.5)
    tuner.drawn = tuner.drawn.with_more(u, tuner.density.log_prob(u))
    assert tuner._fit(at(tuner, target.centres[[0, 0]])).sum() == 18  # along three lines, and no climb
    assert len(tuner.mixture.quadratics) == 1


def test_a_maximum_that_a_fit_loses_is_found_again():
    """No candidate was near the component of the second maximum, where a chain is."""
    target, tuner = far_apart()
    tuner.stages[0] = Mixture(target.components(), [0.999, 0.001], tuner.mixture.warp)
    u = tuner.density.to_scaled(target.centres[[0] * 200] + np.random.default_rng(5).standard_normal((200, 2)))
    tuner.drawn = tuner.drawn.with_more(u, tuner.density.log_prob(u))
    tuner.counts[-1] = 200
    before = refit_mixture(Points.weigh_draws(*tuner.drawn[:2], tuner.mixture.log_density(u)), tuner.mixture)
    assert len(before.quadratics) == 1
    tuner._fit(at(tuner, target.centres))
    assert len(tuner.mixture.quadratics) == 2


def test_a_climb_ends_at_the_maximum_with_the_curvature_there():
    """From 3.5 deviations away, along axes that are three times too long and too short; a Gumbel is skewed."""
    scale = np.array([0.3, 3.0, 1.0])

    def log_prob(u):
        z = (u - [1.0, 2.0, 3.0]) / scale
        return np.where(
            z[:, 0] > -5.0, -np.exp(-z[:, 0]) - z[:, 0] - 0.5 * z[:, 1] ** 2 - 0.5 * z[:, 2] ** 2, -np.inf
        )

    top = climb(log_prob, np.array([2.0, -8.0, 3.0]), np.eye(3))
    assert np.all(np.abs(top.position - [1.0, 2.0, 3.0]) < 0.1 * scale)
    assert np.allclose(top.hessian, np.diag(scale**-2.0), rtol=0.2, atol=1e-12)
    assert top.log_prob == log_prob(top.position[None])[0]


def test_components_with_hardly_more_points_than_coordinates_stay_as_they_were():
    """Quadratics through 8 points in ten coordinates had no mass within the box."""
    ndim, rng = 10, np.random.default_rng(4)
    warp = Warp(np.zeros(ndim), np.ones(ndim), np.zeros(ndim, dtype=bool))
    centres = rng.uniform(0.3, 0.7, (5, ndim))
    start = Mixture([Quadratic(c, 0.0, np.zeros(ndim), 2e3 * np.eye(ndim)) for c in centres], np.ones(5), warp)
    u = start.draw(rng, 40)
    fit = fit_mixture(Points.weigh_draws(u, start.log_density(u), start.log_density(u)), start)
    assert [q.position.tolist() for q in fit.quadratics] == [q.position.tolist() for q in start.quadratics]


def test_a_fit_to_few_points_is_kept_only_if_it_suits_others():
    """Through 40 points in eight coordinates pass many quadratics."""
    ndim, rng = 8, np.random.default_rng(4)
    warp = Warp(np.full(ndim, -np.inf), np.full(ndim, np.inf), np.zeros(ndim, dtype=bool))
    start = Mixture([Quadratic(np.zeros(ndim), 0.0, np.zeros(ndim), np.eye(ndim))], [1.0], warp)

    def points(n):
        u = rng.standard_normal((n, ndim))
        log_p = -0.5 * np.sum(u**2, axis=1) - 0.3 * np.sum(np.abs(u) ** 1.5, axis=1)
        return Points.weigh_draws(u, log_p, start.log_density(u))

    assert refit_mixture(points(40), start) is start
    many, fresh = points(1000), points(1000)
    better = refit_mixture(many, start)
    assert fresh.effective_share(better.log_density(fresh.position)) > 0.85
    assert fresh.effective_share(start.log_density(fresh.position)) < 0.7


def test_without_components_local_steps_find_them():
    target = SkewedGumbel()
    result = drawn(target, MixtureSampler(), draws=40, warmup=100, init="prior")
    stats = result.posterior.stats
    assert np.mean(stats["accepted"]) > 0.3
    scaled = ScaledDensity(target)
    settings = result.learnt
    fields = ("position", "log_prob", "gradient", "hessian", "covariance")
    quadratics = [Quadratic(*(np.array(one[name]) for name in fields)) for one in settings["components"]]
    warp = Warp(scaled.lower, scaled.upper, np.array(settings["bent"]))
    q = Mixture(quadratics, settings["weights"], warp)
    u = scaled.to_scaled(result.posterior.position.reshape(-1, target.ndim))
    expected = stats["lp"].ravel() - q.log_density(u)
    np.testing.assert_allclose(stats[LOG_WEIGHT].ravel(), expected, atol=1e-8)


class Ring:
    """A ring of radius 1 ± 0.01, of no component's shape."""

    ndim = 2
    lower, upper = np.full(2, -3.0), np.full(2, 3.0)

    def log_prob(self, theta):
        return -0.5 * ((np.linalg.norm(theta, axis=1) - 1.0) / 0.01) ** 2

    def log_prob_and_grad(self, theta):
        radius = np.linalg.norm(theta, axis=1)
        return self.log_prob(theta), -((radius - 1.0) / 0.01**2 / radius)[:, None] * theta


def test_where_candidates_are_rarely_accepted_most_steps_are_local_ones():
    start = Quadratic(np.array([2 / 3, 0.5]), 0.0, np.zeros(2), np.diag([1e5, 20.0]))  # of one point of the ring
    angle = np.array([0.1, 1.6, 3.2, 4.8])
    init = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    sampler = MixtureSampler([start], local=MetropolisHastings())
    run = Run(Ring(), sampler, chains=4, warmup=200, seed=1, init=init)
    result = run.extend(60)
    assert (result.learnt["local_steps"], result.learnt["jumps"]) == (3, 1)
    is_local = np.isnan(result.posterior.stats["candidate_log_weight"])
    np.testing.assert_allclose(is_local.mean(axis=1), 0.75, atol=0.01)
    moved = np.any(np.diff(result.posterior.position, axis=1) != 0.0, axis=2)
    assert moved[is_local[:, 1:]].mean() > 2.0 * moved[~is_local[:, 1:]].mean()


def test_after_a_fit_weights_and_candidates_are_those_of_the_new_mixture():
    """Whether the first step after it is a jump or a local one."""
    target, rng = TwoModes(), np.random.default_rng(3)
    scaled = ScaledDensity(target)
    wide = Quadratic(np.zeros(2), 0.0, np.zeros(2), 0.1 * np.eye(2))
    before, after = (
        MixtureSampler([wide, replace(wide, hessian=h * np.eye(2))], local=Slice(), local_steps=2, jumps=2)
        for h in (0.5, 2.0)
    )
    for steps in range(1, 9):
        state, _ = before.bind(scaled).init(scaled.to_scaled(np.tile(target.mean, (4, 1))))
        kernel = replace(before.bind(scaled), fit=1)
        for _ in range(steps):
            state, _ = kernel.step(rng, state)
        kernel = replace(after.bind(scaled), fit=2)
        for _ in range(3):
            state, info = kernel.step(rng, state)
            here = state.log_prob - kernel.proposal.log_density(state.position)
            np.testing.assert_allclose(info.extra[LOG_WEIGHT], here, atol=1e-10)
            moved = info.accepted & np.isfinite(info.extra[CANDIDATE])
            np.testing.assert_allclose(info.extra[CANDIDATE][moved], here[moved], atol=1e-10)


def test_refits_learn_the_weights_of_the_maxima_from_all_candidates():
    """Most of the first candidates were drawn where little of the probability is."""
    result = drawn(Apart(), MixtureSampler(Apart().components(), (0.02, 0.98)), init="prior", warmup=300)
    learnt = result.learnt
    left = np.array([one["position"][0] < 0 for one in learnt["components"]])
    assert np.asarray(learnt["weights"])[left].sum() == pytest.approx(0.7, abs=0.06)


@pytest.mark.parametrize(
    ("target", "settings", "expected"),
    [
        (CorrelatedGaussian(), {}, (0.05, 79)),
        (Banana(), {}, (0.1, 39)),
        (CorrelatedGaussian(), {"wide": 0.2}, (0.2, 39)),
        (CorrelatedGaussian(), {"local": Slice(), "jumps": 1}, (0.05, 1)),
    ],
)
def test_a_good_mixture_has_fewer_wide_candidates_and_local_steps(target, settings, expected):
    """Unless their numbers were given. In warm-up they are the usual ones."""
    result = drawn(target, MixtureSampler(**settings), draws=80, warmup=120, init="prior")
    assert (result.learnt["wide"], result.learnt["jumps"]) == expected
    local = np.isnan(result.posterior.stats[CANDIDATE]).mean()
    assert local == pytest.approx(1 / (1 + expected[1]), abs=0.01)


def test_nothing_is_learnt_after_warm_up():
    target = Apart()
    sampler = MixtureSampler(target.components(), (0.5, 0.5))
    begun = Run(target, sampler, warmup=60, chains=4, seed=1, init="prior")
    learnt = begun.extend(1).learnt
    assert str(begun.extend(200).learnt) == str(learnt)
    assert str(begun.extend(1).learnt) == str(learnt)


def test_each_candidate_is_counted_once():
    target = TwoModes()
    result = drawn(target, MixtureSampler(local_steps=1, jumps=4), draws=100, warmup=50, init="prior")
    jumps = np.isfinite(result.posterior.stats[CANDIDATE])
    assert jumps.mean() == pytest.approx(0.8, abs=0.01)
    assert result.posterior.stats["n_solves"][jumps].sum() == 4 * 25 * 8  # blocks of 25 for 80 jumps a chain


def test_what_a_fit_evaluates_is_counted():
    """Chains start at a maximum that the mixture does not know: fits look for a valley."""
    target, evaluated = Apart(), []
    sampler = MixtureSampler(target.components()[:1], local=Slice())
    whole = target.log_prob
    target.log_prob = lambda theta: (evaluated.append(len(np.atleast_2d(theta))), whole(theta))[1]
    result = drawn(target, sampler, init=np.repeat(target.centres[1:], 8, axis=0), draws=10, warmup=40)
    counted = result.posterior.stats["n_solves"].sum() + result.warmup.stats["n_solves"].sum()
    assert sum(evaluated) == counted
    assert len(result.learnt["components"]) == 2


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"jumps": 0}, "jumps: must be a whole number of at least 1"),
        ({"local_steps": 0}, "local_steps: must be a whole number of at least 1"),
        ({"wide": 1.0}, r"wide: must be a positive finite number below 1 or None \(got 1.0\)"),
        ({"wide": float("nan")}, "wide: must be a positive finite number"),
        ({"adapt": False}, "components: must be given if adapt is False"),
        ({"components": [STEEP], "weights": [0.2, 0.8]}, r"weights: must be 1, one per component \(got 2\)"),
        ({"components": [STEEP], "weights": [-1.0]}, "weights: must be positive"),
    ],
)
def test_wrong_settings_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        MixtureSampler(**settings)


def test_coordinates_with_a_lower_bound_alone_are_bent_at_first():
    target = Target(3, [0.0, 0.0, -np.inf], [1.0, np.inf, np.inf])
    np.testing.assert_array_equal(first_warp(target).bent, [False, True, False])


def test_a_single_point_determines_no_quadratic():
    """The tuner then goes on with the mixture that it has; nothing overflows on the way."""
    u = np.random.default_rng(14).uniform(LOWER, UPPER, (40, 2))
    weight = np.zeros(40)
    weight[3] = 1.0
    with pytest.raises(np.linalg.LinAlgError):
        fit_quadratic(u, STEEP(u), weight)


def test_a_component_with_a_single_point_bends_no_coordinate():
    """Nothing overflows where all weight of a component is on one candidate."""
    ndim, rng = 4, np.random.default_rng(15)
    warp = Warp(np.full(ndim, -1.0), np.full(ndim, 4.0), np.zeros(ndim, dtype=bool))
    ones = [Quadratic(np.full(ndim, c), 0.0, np.zeros(ndim), 100.0 * np.eye(ndim)) for c in (0.0, 3.0)]
    start = Mixture(ones, [0.5, 0.5], warp)
    u = np.concatenate([0.1 * rng.standard_normal((300, ndim)), np.full((1, ndim), 3.0)])
    log_p = np.append(ones[0](u[:-1]), -66.0)
    found = fit_mixture(Points.weigh_draws(u, log_p, start.log_density(u)), start)
    assert not found.warp.bent.any()


def test_chains_at_separated_places_are_groups_of_their_own():
    rng = np.random.default_rng(13)
    places = np.array([[0.0, 0.0], [8.0, 0.0], [0.5, 0.2], [8.5, 0.1], [0.0, 30.0]])
    u = places + np.array([1.0, 5.0]) * rng.standard_normal((400, 5, 2))
    assert list(groups_of_chains(u)) == [0, 1, 0, 1, 4]
    assert list(groups_of_chains(u[:, :1])) == [0]
