"""Mixtures for bent densities: their coordinates, their exact density, what they fit, and the draws with them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

import fmu
from fmu.analysis.convergence.effective import mcse_mean
from fmu.analysis.convergence.remedies import RATIOS
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers import MixtureSampler, Run
from fmu.samplers.kernel import Target
from fmu.samplers.mixture.bent import fit_gaussians
from fmu.samplers.mixture.curve import fit_curve, fit_infinite_margins
from fmu.samplers.mixture.curved import CurvedMixture, fit_curved
from fmu.samplers.mixture.warmup.rounds import Rounds, learn_in_rounds
from tests.densities import Banana, Beta, Funnel, Ridges, Shell, StudentT
from tests.gradients import differences

EXACT_GRADIENT = 2
"""Evaluations that an exact gradient counts for."""


def exact_draws(density, n, seed=1):
    scaled = ScaledDensity(density)
    return scaled, scaled.to_scaled(density.draw(n, np.random.default_rng(seed)))


class Mixed:
    """A coordinate that is infinite at its walls, and one whose place and width depend on it."""

    lower, upper = np.array([0.0, -np.inf]), np.array([1.0, np.inf])

    def draw(self, n):
        rng = np.random.default_rng(2)
        u = np.stack([rng.beta(0.4, 0.6, n), rng.standard_normal(n)], axis=1)
        y = stats.norm.ppf(np.clip(u[:, 0], 1e-12, 1 - 1e-12))
        u[:, 1] = 0.3 * y**2 + np.exp(0.3 * y) * u[:, 1]
        return u


def test_curves_are_inverted_and_have_the_right_slope():
    mixed = Mixed()
    u = mixed.draw(3000)
    curve = fit_curve(u, np.ones(3000), mixed.lower, mixed.upper)
    assert np.isfinite(curve.a).tolist() == [True, False]
    assert curve.location[1].any()
    assert curve.scale[1].any()
    u = u[(u[:, 0] > 0.01) & (u[:, 0] < 0.99)][:50]
    x, log_slope = curve.to_x(u)
    np.testing.assert_allclose(curve.to_u(x), u, rtol=1e-9, atol=1e-9)
    found = np.linalg.slogdet(differences(lambda u: curve.to_x(u)[0], u, 1e-6))[1]
    np.testing.assert_allclose(log_slope, found, atol=1e-5)


@pytest.mark.parametrize(
    ("density", "bent"), [(Banana(), [1, 3]), (Funnel(), [1, 2, 3, 4, 5, 6, 7])], ids=["banana", "funnel"]
)
def test_a_triangular_map_makes_a_banana_and_a_funnel_gaussian(density, bent):
    scaled, u = exact_draws(density, 3000)
    curve = fit_curve(u, np.ones(3000), scaled.lower, scaled.upper)
    assert np.flatnonzero(curve.location.any(axis=1) | curve.scale.any(axis=1)).tolist() == bent
    x, _ = curve.to_x(exact_draws(density, 3000, seed=2)[1])
    for one in x.T:
        assert stats.kstest((one - one.mean()) / one.std(), "norm").statistic < 1.7 / np.sqrt(3000)
    square = np.corrcoef(x**2, rowvar=False)
    assert np.abs(square - np.eye(len(square))).max() < 0.15


@pytest.mark.parametrize(
    ("draw", "is_infinite"),
    [
        (lambda rng: rng.beta(0.5, 0.5, 4000), True),
        (lambda rng: rng.beta(0.6, 3.0, 4000), True),
        (lambda rng: rng.random(4000), False),
        (lambda rng: 0.05 * rng.standard_exponential(4000), False),
        (lambda rng: 1.0 - 0.1 * np.abs(rng.standard_normal(4000)), False),
        (lambda rng: 0.5 + 0.01 * rng.standard_normal(4000), False),
    ],
)
def test_a_density_is_infinite_at_a_wall_where_its_shape_is_below_one(draw, is_infinite):
    u = draw(np.random.default_rng(3))[:, None]
    shapes = fit_infinite_margins(u, np.ones(len(u)), np.zeros(1), np.ones(1))
    assert np.isfinite(shapes).all() == is_infinite


@pytest.mark.parametrize(
    ("density", "n", "accepted"),
    [
        (Banana(), 2500, 0.8),
        (Funnel(), 3000, 0.7),
        (Shell(), 8000, 0.65),
        (Ridges(), 2500, 0.7),
        (Beta(), 2500, 0.8),
    ],
    ids=lambda one: getattr(one, "name", None),
)
def test_candidates_of_a_mixture_fitted_to_exact_draws_are_accepted(density, n, accepted):
    """A sphere needs more draws than the others."""
    scaled, u = exact_draws(density, n)
    q = fit_curved(u, np.ones(len(u)), scaled.lower, scaled.upper)
    rng = np.random.default_rng(4)
    candidates, draws = q.draw(rng, n), exact_draws(density, n, seed=5)[1]
    of_candidates = Target(scaled).evaluate(candidates).log_prob - q.log_density(candidates)
    of_draws = scaled.log_prob(draws) - q.log_density(draws)
    assert np.mean(np.exp(np.minimum(0.0, of_candidates - of_draws))) > accepted
    # the mean weight is the evidence: the density of the mixture is normalised
    weight = np.exp(of_candidates + np.sum(np.log(scaled.scale)))
    assert weight.mean() == pytest.approx(1.0, abs=5 * weight.std() / np.sqrt(n))


def test_a_sphere_is_covered_by_bent_gaussians():
    _, u = exact_draws(Shell(), 4000)
    parts, _ = fit_gaussians(u, np.ones(len(u)))
    assert 8 <= len(parts.weights) <= 32
    assert np.all(parts.sds[:, 0] < 0.5)  # what a bend leaves of the thickness of a flat sheet


def test_a_density_of_many_coordinates_gets_its_margins_without_bends():
    """Its quadratic features are far more than points; 128 coordinates have 8385."""
    u = 3.0 + 0.5 * np.random.default_rng(1).standard_normal((2000, 128))
    curve = fit_curve(u, np.full(2000, 1 / 2000), np.full(128, -np.inf), np.full(128, np.inf))
    assert not curve.location.any()
    np.testing.assert_allclose(curve.centre, 3.0, atol=0.1)
    np.testing.assert_allclose(curve.spread, 0.5, rtol=0.15)


def test_arrays_keep_a_curved_mixture_bit_for_bit():
    scaled, u = exact_draws(Banana(), 1000)
    q = fit_curved(u, np.ones(len(u)), scaled.lower, scaled.upper)
    again = CurvedMixture.of_arrays(q.arrays())
    np.testing.assert_array_equal(again.log_density(u), q.log_density(u))
    drawn = (one.draw(np.random.default_rng(1), 50) for one in (q, again))
    np.testing.assert_array_equal(*drawn)


def test_a_mixture_that_misses_what_another_knows_is_inefficient():
    """Its own candidates show nothing of that."""
    density = Ridges()
    scaled, u = exact_draws(density, 2500)
    of_one = density.draw(2500, np.random.default_rng(1))[:, 2] > 0
    rounds = Rounds(Target(scaled))
    for points in (u[of_one], u):
        mixture = fit_curved(points, np.ones(len(points)), scaled.lower, scaled.upper)
        rounds.draw(mixture, np.random.default_rng(2), 2000)
    assert rounds.efficiency(0) < 0.02
    assert rounds.efficiency(1) > 0.3


def test_rounds_learn_a_banana_from_points_on_a_part_of_it():
    density = Banana()
    scaled, u = exact_draws(density, 400)
    part = u[np.abs(u[:, 0] - u[:, 0].mean()) < 0.5 * u[:, 0].std()]
    mixture, efficiency, n_solves = learn_in_rounds(Target(scaled), part, np.random.default_rng(1), 20_000)
    assert efficiency > 0.6
    assert n_solves <= 20_000
    draws = exact_draws(density, 4000, seed=5)[1]
    log_w = scaled.log_prob(draws) - mixture.log_density(draws)
    assert log_w.max() - np.median(log_w) < 3.0


def test_rounds_that_find_nothing_in_the_box_end():
    scaled, u = exact_draws(Shell(), 200)
    _, efficiency, n_solves = learn_in_rounds(Target(scaled), u + 50.0, np.random.default_rng(1), 20_000)
    assert efficiency < 0.02
    assert n_solves <= 2000


@pytest.mark.parametrize(
    "density",
    [Ridges(), *(pytest.param(one, marks=pytest.mark.validate) for one in (Banana(), Shell(), Beta()))],
    ids=lambda one: one.name,
)
def test_bent_hollow_and_infinite_densities_converge_within_50_000_evaluations(density):
    trace = fmu.sample(density, draws=250, until_ess=400, max_solves=50_000)
    stats_of = [trace["sample_stats"], trace["warmup_sample_stats"]]
    n_solves, n_gradients = (sum(int(one[name].sum()) for one in stats_of) for name in ("n_solves", "n_gradients"))
    assert n_solves + (EXACT_GRADIENT - 1) * n_gradients <= 50_000
    table = fmu.summary(trace)
    assert table["rhat"].max() < 1.01
    assert "not converged" not in str(fmu.diagnose(trace))
    assert np.all(np.abs(table["mean"] - density.mean) < 5 * table["mcse_mean"])
    x = np.stack([trace["posterior"][name].to_numpy() for name in trace["posterior"].data_vars], axis=-1)
    square = ((x.reshape(len(x), -1, density.ndim) - density.mean) / density.sd) ** 2
    for one in np.moveaxis(square, 2, 0):
        error = mcse_mean(one)
        assert abs(one.mean() - 1.0) < 5 * error


def test_weights_of_candidates_are_bounded_under_heavy_tails():
    """Gaussians leave weights P/q without a bound there, e^178 and more: evidences are too low."""
    density = StudentT()
    scaled = ScaledDensity(density)
    start = density.draw(4, np.random.default_rng(7))
    begun = Run(density, MixtureSampler(), warmup=150, chains=4, seed=0, init=start)
    begun.extend(1)
    tuner = MixtureSampler().tuner(scaled, 4, 150)
    tuner.restore(begun._groups[0].state.tuner)
    draws = scaled.to_scaled(density.draw(8_000, np.random.default_rng(5)))
    log_w = scaled.log_prob(draws) - tuner.mixture.log_density(draws)
    assert log_w.max() - np.median(log_w) < 20.0


def test_a_curved_mixture_is_kept_in_the_settings_and_the_state_of_the_tuner():
    density = Beta()
    sampler = MixtureSampler()
    begun = Run(density, sampler, warmup=150, chains=4, seed=1, init="prior")
    learnt = begun.extend(1).learnt
    assert json.loads(json.dumps(learnt))["components"]["type"] == "CurvedMixture"
    scaled = ScaledDensity(density)
    tuner = sampler.tuner(scaled, 4, 150)
    tuner.restore(begun._groups[0].state.tuner)
    again = sampler.tuner(scaled, 4, 150)
    again.restore(tuner.state())
    u = exact_draws(density, 50)[1]
    assert isinstance(tuner.mixture, CurvedMixture)
    np.testing.assert_array_equal(again.mixture.log_density(u), tuner.mixture.log_density(u))
    assert (again.finish_learning().jumps, again.finish_learning().local_steps) == (
        learnt["jumps"],
        learnt["local_steps"],
    )


class Ratios(Funnel):
    """Neal's funnel by its remedy: x = exp(v/2) z, sampled as v and z."""

    name = "ratios"

    def __init__(self):
        super().__init__()
        self.lower, self.upper = np.array([-18.0, *7 * [-8.0]]), np.array([18.0, *7 * [8.0]])

    def value_and_slope(self, x):
        width = np.array([self.s, *7 * [1.0]])
        return -0.5 * np.sum((x / width) ** 2, axis=1), -x / width**2


@pytest.mark.validate
def test_the_remedy_for_a_funnel_works_when_it_is_followed():
    """It is told by a run that could not, and the run by ratios has the moments of the funnel."""
    said = fmu.diagnose(fmu.sample(Funnel(), draws=250, warmup=400, until_ess=400, max_solves=60_000))
    assert not said.converged
    assert any(RATIOS in reason for reason in said.reasons)
    trace = fmu.sample(Ratios(), draws=250, warmup=200, until_ess=400, max_solves=50_000)
    assert fmu.diagnose(trace).converged
    v, z = (trace["posterior"][name].to_numpy() for name in ("x0", "x1"))
    for one, mean in ((v, 0.0), (v**2, 9.0), (np.sign(z) * np.log1p(np.abs(np.exp(v / 2) * z)), 0.0)):
        assert abs(one.mean() - mean) < 5 * mcse_mean(one)


@pytest.mark.parametrize("seed", range(3))
def test_a_density_that_falls_steeply_from_a_wall_is_not_infinite_there(seed):
    """A beta distribution fitted to it has a shape of 0.33 at that wall."""
    rng, n = np.random.default_rng(seed), 2000
    steep = np.where(rng.uniform(size=n) < 0.6, rng.exponential(0.02, n), rng.uniform(size=n)).clip(0.0, 1.0)
    infinite = rng.beta(0.5, 2.0, n)
    u = np.stack([steep, 1.0 - steep, infinite, 1.0 - infinite], axis=1)
    a, b = fit_infinite_margins(u, np.ones(n), np.zeros(4), np.ones(4))
    assert np.isnan(a).tolist() == np.isnan(b).tolist() == [True, True, False, False]
    assert max(abs(a[2] - 0.5), abs(b[3] - 0.5)) < 0.1
