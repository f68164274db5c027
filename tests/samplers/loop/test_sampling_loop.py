import json

import numpy as np
import pytest

from fmu.posterior.scaled import ScaledDensity
from fmu.samplers import (
    Ensemble,
    HamiltonianMonteCarlo,
    Independence,
    MetropolisHastings,
    RandomWalk,
    Run,
    Slice,
    make_sampler,
    run,
)
from tests.gradients import assert_gradient
from tests.samplers.targets import BoundedBeta, CorrelatedGaussian, Counting, SkewedGumbel, TruncatedGaussian

WALK = MetropolisHastings(RandomWalk(0.3))
SETTINGS = {"draws": 6, "warmup": 4, "chains": 3, "seed": 1, "init": "prior"}


class TestNames:
    @pytest.mark.parametrize(
        ("name", "kind"),
        [("mh", MetropolisHastings), ("slice", Slice), ("hmc", HamiltonianMonteCarlo), ("emcee", Ensemble)],
    )
    def test_defaults(self, name, kind):
        assert make_sampler(name) == kind()
        assert make_sampler(name).name == name

    def test_an_unknown_name_lists_the_known_ones(self):
        known = "mh, slice, hmc, emcee, mixture, gibbs, tempering"
        with pytest.raises(ValueError, match=rf"sampler: must be one of {known} \(got 'nuts'\)"):
            make_sampler("nuts")


class TestResult:
    def test_shapes(self):
        result = run(TruncatedGaussian(), WALK, **SETTINGS)
        assert result.warmup.position.shape == (3, 4, 2)
        assert result.posterior.position.shape == (3, 6, 2)
        for part, steps in ((result.warmup, 4), (result.posterior, 6)):
            assert {"lp", "accepted", "n_solves", "n_gradients"} <= part.stats.keys()
            assert all(value.shape == (3, steps) for value in part.stats.values())
            assert part.stats["accepted"].dtype == bool
        assert (result.draws, result.warmup_draws, result.chains, result.walkers) == (6, 4, 3, 1)
        assert (result.sampler, result.seed, result.init) == ("mh", 1, "prior")
        assert 0 < result.warmup_wall_s < result.wall_s

    def test_an_ensemble_is_one_chain_of_steps_times_walkers_walkers_fastest(self):
        result = run(TruncatedGaussian(), Ensemble(walkers=10), **SETTINGS)
        assert result.posterior.position.shape == (3, 60, 2)
        assert result.posterior.stats["n_solves"].shape == (3, 60)
        assert (result.draws, result.walkers) == (6, 10)
        # A walker that was not moved repeats its draw one step, that is ten draws, later.
        position, accepted = result.posterior.position, result.posterior.stats["accepted"]
        stayed = ~accepted[:, 10:]
        assert stayed.any()
        np.testing.assert_array_equal(position[:, 10:][stayed], position[:, :-10][stayed])
        assert not np.any(np.all(position[:, 1:] == position[:, :-1], axis=2))

    @pytest.mark.parametrize("sampler", [WALK, Ensemble(walkers=8)], ids=["mh", "emcee"])
    def test_without_warmup(self, sampler):
        target = Counting(TruncatedGaussian())
        result = run(target, sampler, **SETTINGS | {"warmup": 0})
        assert result.warmup.position.shape == (3, 0, 2)
        assert result.warmup.stats.keys() == result.posterior.stats.keys()
        assert all(value.shape == (3, 0) for value in result.warmup.stats.values())
        assert result.posterior.stats["n_solves"].sum() == target.n_solves

    def test_the_start_is_paid_for_by_the_first_step(self):
        hmc = HamiltonianMonteCarlo(0.05, 4)
        stats = run(TruncatedGaussian(), hmc, **SETTINGS).warmup.stats
        np.testing.assert_array_equal(stats["n_solves"], [[5, 4, 4, 4]] * 3)
        np.testing.assert_array_equal(stats["n_gradients"], [[5, 4, 4, 4]] * 3)

    @pytest.mark.parametrize(
        "sampler",
        [
            MetropolisHastings(RandomWalk([[1.0, 0.1], [0.1, 1.0]])),
            MetropolisHastings(Independence([0.5, 0.5], np.eye(2))),
            Slice(width=np.array([0.1, 0.2])),
            HamiltonianMonteCarlo(0.1, 3, inverse_mass=np.eye(2)),
            Ensemble(moves={"de": 0.8, "snooker": 0.2}),
        ],
        ids=["walk", "independence", "slice", "hmc", "emcee"],
    )
    def test_settings_are_json(self, sampler):
        settings = run(TruncatedGaussian(), sampler, **SETTINGS).settings
        assert json.loads(json.dumps(settings)) == settings
        fields = {"mh": "proposal", "slice": "width", "hmc": "inverse_mass", "emcee": "moves"}
        assert fields[sampler.name] in settings

    def test_nested_settings_are_spelled_out(self):
        settings = run(TruncatedGaussian(), WALK, **SETTINGS).settings
        assert settings == {"proposal": {"type": "RandomWalk", "scale": 0.3}}

    def test_chains_share_steps_but_not_draws(self):
        position = run(CorrelatedGaussian(), WALK, **SETTINGS | {"init": "start"}).posterior.position
        assert np.unique(position[:, -1, 0]).size == 3


def test_progress_is_told_of_every_step():
    seen = []
    run(TruncatedGaussian(), Ensemble(walkers=8), progress=lambda *call: seen.append(call), **SETTINGS)
    for group in ("1/3", "2/3", "3/3"):
        assert [call[:3] for call in seen if call[3]["group"] == group] == [
            *(("warmup", k, 4) for k in range(1, 5)),
            *(("draws", k, 6) for k in range(1, 7)),
        ]
    assert [call[0] for call in seen] == ["warmup"] * 12 + ["draws"] * 18
    assert all(0.0 <= call[3]["accept"] <= 1.0 and call[3]["solves"] > 0 for call in seen)


class TestCarryingOn:
    @pytest.mark.parametrize(
        "sampler",
        [MetropolisHastings(), Slice(), HamiltonianMonteCarlo(), Ensemble(walkers=8)],
        ids=["mh", "slice", "hmc", "emcee"],
    )
    @pytest.mark.parametrize("warmup", [0, 40])
    def test_parts_are_bitwise_the_whole(self, sampler, warmup):
        settings = {"warmup": warmup, "chains": 3, "seed": 5, "init": "prior"}
        whole = run(TruncatedGaussian(), sampler, draws=37, **settings)
        parts = Run(TruncatedGaussian(), sampler, **settings)
        for steps, total in ((1, 1), (10, 11), (26, 37)):
            result = parts.extend(steps)
            assert result.draws == total
        for phase in ("warmup", "posterior"):
            one, other = getattr(whole, phase), getattr(result, phase)
            np.testing.assert_array_equal(one.position, other.position)
            assert one.stats.keys() == other.stats.keys()
            for name in one.stats:
                np.testing.assert_array_equal(one.stats[name], other.stats[name])
                assert one.stats[name].dtype == other.stats[name].dtype
        assert (result.learnt, result.settings) == (whole.learnt, whole.settings)
        assert (result.draws, result.warmup_draws, result.walkers) == (37, warmup, sampler.walkers)

    def test_earlier_results_stay_what_they_were(self):
        begun = Run(TruncatedGaussian(), WALK, warmup=2, chains=2, seed=1, init="prior")
        first = begun.extend(5)
        kept = first.posterior.position.copy()
        second = begun.extend(5)
        assert first.posterior.position.shape == (2, 5, 2)
        np.testing.assert_array_equal(first.posterior.position, kept)
        np.testing.assert_array_equal(second.posterior.position[:, :5], kept)
        assert second.wall_s > first.wall_s > first.warmup_wall_s == second.warmup_wall_s

    def test_cost_is_counted_once(self):
        target = Counting(TruncatedGaussian())
        begun = Run(target, HamiltonianMonteCarlo(0.05, 4), warmup=0, chains=3, seed=1, init="prior")
        for _ in range(3):
            result = begun.extend(4)
        assert result.posterior.stats["n_solves"].sum() == target.n_solves

    def test_progress_goes_on_where_it_was(self):
        seen = []
        begun = Run(
            TruncatedGaussian(), WALK, warmup=1, chains=2, seed=1, init="prior",
            progress=lambda *call: seen.append(call[:3]),
        )  # fmt: skip
        begun.extend(2)
        begun.extend(1)
        assert seen == [("warmup", 1, 1), ("draws", 1, 2), ("draws", 2, 2), ("draws", 3, 3)]

    def test_nothing_to_draw(self):
        begun = Run(TruncatedGaussian(), WALK, warmup=1, chains=2, seed=1, init="prior")
        with pytest.raises(ValueError, match=r"draws: must be a whole number of at least 1 \(got 0\)"):
            begun.extend(0)


class TestStart:
    def test_array(self):
        target = TruncatedGaussian()
        start = np.array([[-0.5, 0.1], [0.2, 3.0], [1.0, 0.0]])
        still = MetropolisHastings(RandomWalk(1e3))
        result = run(target, still, **SETTINGS | {"init": start})
        np.testing.assert_allclose(result.posterior.position[:, 0], start, atol=1e-14)
        assert result.init == "array"

    def test_start(self):
        target = BoundedBeta()
        still = MetropolisHastings(RandomWalk(1e3))
        result = run(target, still, **SETTINGS | {"init": "start"})
        np.testing.assert_allclose(result.warmup.position, np.broadcast_to(target.start, (3, 4, 2)), rtol=1e-14)

    def test_the_walkers_of_an_ensemble_are_spread_around_the_start_inside_the_box(self):
        target = Counting(TruncatedGaussian())
        target.target.start = np.array([1.0, 0.0])  # a corner
        result = run(target, Ensemble(walkers=16), **SETTINGS | {"init": "start"})
        first = result.warmup.position[:, :16]
        assert np.all(np.abs((first - target.start) / (target.upper - target.lower)) < 0.3)
        assert np.unique(first.reshape(-1, 2), axis=0).shape == (48, 2)

    def test_prior(self):
        target = SkewedGumbel()
        still = MetropolisHastings(RandomWalk(1e-12))
        first = run(target, still, **SETTINGS | {"chains": 4000}).warmup.position[:, 0]
        spread = 0.5 * np.sqrt(np.diag(target.covariance))
        np.testing.assert_allclose(first.std(axis=0), spread, rtol=0.1)

    @pytest.mark.parametrize(
        ("init", "message"),
        [
            ("posterior", r"init: must be 'prior', 'start' or an array of shape \(3, 2\) \(got 'posterior'\)"),
            (np.zeros((2, 2)), r"init: must have shape \(3, 2\) \(got \(2, 2\)\)"),
            ([[0.0, 1.0], [0.0, 1.0], [1.5, 1.0]], r"init: chain 2 must start within \[-1, 1\] in coordinate 0"),
            ([[0.0, 1.0], [0.0, -9.0], [0.5, 1.0]], r"init: chain 1 must start within \[0, 5\] in coordinate 1"),
            ([[0.0, np.nan], [0.0, 1.0], [0.5, 1.0]], r"chain 0 must start within .* \(got nan\)"),
        ],
    )
    def test_bad_starts(self, init, message):
        with pytest.raises(ValueError, match=message):
            run(TruncatedGaussian(), WALK, **SETTINGS | {"init": init})

    def test_a_walker_outside_the_box_is_named(self):
        start = np.random.default_rng(0).random((3, 8, 2))
        start[1, 5, 0] = 7.0
        with pytest.raises(ValueError, match="init: chain 1 walker 5 must start within"):
            run(TruncatedGaussian(), Ensemble(walkers=8), **SETTINGS | {"init": start})

    @pytest.mark.parametrize("init", ["prior", "start"])
    def test_a_density_without_what_init_asks_for(self, init):
        class Bare:
            ndim, lower, upper = 2, np.zeros(2), np.ones(2)

            def log_prob(self, theta):
                return np.zeros(len(theta))

            def log_prob_and_grad(self, theta):
                return self.log_prob(theta), np.zeros_like(theta)

        with pytest.raises(ValueError, match=f"init: '{init}' needs a density with"):
            run(Bare(), WALK, **SETTINGS | {"init": init})
        run(Bare(), WALK, **SETTINGS | {"init": np.full((3, 2), 0.5)})

    @pytest.mark.parametrize("sampler", [WALK, Slice(), HamiltonianMonteCarlo()], ids=["mh", "slice", "hmc"])
    @pytest.mark.parametrize("value", [np.nan, -np.inf])
    def test_a_start_without_a_finite_log_density_is_named(self, sampler, value):
        class Hollow(TruncatedGaussian):
            def value_and_slope(self, x):
                log_prob, slope = super().value_and_slope(x)
                return np.where(x[:, 0] > 0.5, value, log_prob), slope

        start = [[0.0, 1.0], [0.75, 2.0], [0.0, 1.0]]
        with pytest.raises(
            ValueError,
            match=r"init: chain 1 must start where the log-density is finite \(got theta = \[0.75, 2.0\]",
        ):
            run(Hollow(), sampler, **SETTINGS | {"init": start})

    def test_an_ensembles_walker_without_a_finite_log_density_is_named(self):
        class Hollow(TruncatedGaussian):
            def value_and_slope(self, x):
                log_prob, slope = super().value_and_slope(x)
                return np.where(x[:, 0] > 0.5, np.nan, log_prob), slope

        start = 0.4 * np.random.default_rng(0).random((3, 8, 2))
        start[2, 6, 0] = 0.8
        with pytest.raises(ValueError, match="init: chain 2 walker 6 must start where the log-density is finite"):
            run(Hollow(), Ensemble(walkers=8), **SETTINGS | {"init": start})


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"draws": 0}, r"draws: must be a whole number of at least 1 \(got 0\)"),
        ({"draws": 10.0}, "draws: must be a whole number"),
        ({"warmup": -1}, "warmup: must be a whole number of at least 0"),
        ({"chains": 0}, "chains: must be a whole number of at least 1"),
        ({"seed": -4}, "seed: must be a whole number of at least 0"),
        ({"seed": None}, "seed: must be a whole number"),
    ],
)
def test_bad_numbers(setting, message):
    with pytest.raises(ValueError, match=message):
        run(TruncatedGaussian(), WALK, **SETTINGS | setting)


class TestScaledDensity:
    def test_a_box_becomes_the_unit_box(self):
        scaled = ScaledDensity(BoundedBeta())
        np.testing.assert_array_equal(scaled.lower, [0.0, 0.0])
        np.testing.assert_array_equal(scaled.upper, [1.0, 1.0])

    def test_what_is_unbounded_is_scaled_as_the_density_says(self):
        target = SkewedGumbel()
        scaled = ScaledDensity(target)
        u = np.array([[0.3, -0.2, 1.0]])
        np.testing.assert_allclose(scaled.to_theta(u), target.offset + u * target.scale)
        assert np.all(np.isinf(scaled.lower))

    def test_what_is_unbounded_and_unscaled_is_left_alone(self):
        target = SkewedGumbel()
        del target.offset, target.scale
        u = np.array([[0.3, -0.2, 1.0]])
        np.testing.assert_array_equal(ScaledDensity(target).to_theta(u), u)

    @pytest.mark.parametrize("kind", [BoundedBeta, SkewedGumbel])
    def test_the_gradient_follows_the_chain_rule(self, kind):
        target = kind()
        scaled = ScaledDensity(target)
        u = scaled.to_scaled(target.start)[None]
        value, gradient = scaled.log_prob_and_grad(u)
        assert value[0] == pytest.approx(target.log_prob(target.start))
        assert_gradient(gradient, scaled.log_prob, u, 1e-6, rtol=1e-6)

    def test_rounding_never_leaves_the_box(self):
        target = TruncatedGaussian()
        target.lower, target.upper = np.array([0.1, 1.7e11]), np.array([0.7, 2.5e11 + 0.1])
        scaled = ScaledDensity(target)
        u = np.nextafter(1.0, 0.0) ** np.arange(4)[:, None] * np.ones(2)
        assert np.all(scaled.to_theta(u) <= target.upper)
        assert np.all(scaled.to_theta(1 - u) >= target.lower)

    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("lower", np.zeros(3), r"lower: must have shape \(2,\)"),
            ("upper", np.array([-2.0, 5.0]), "upper: must exceed lower"),
            ("scale", np.array([1.0, 0.0]), "scale: must be positive and finite"),
            ("scale", np.array([1.0]), r"scale: must have shape \(2,\)"),
        ],
    )
    def test_bad_densities(self, name, value, message):
        target = TruncatedGaussian()
        target.offset, target.scale = np.zeros(2), np.ones(2)
        setattr(target, name, value)
        with pytest.raises(ValueError, match=message):
            ScaledDensity(target)
