"""One protocol that every sampler must pass: right moments, honest accounts, reproducible draws."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from fmu.samplers import (
    Ensemble,
    HamiltonianMonteCarlo,
    MetropolisHastings,
    MixtureSampler,
    RandomWalk,
    Slice,
    run,
)
from tests.samplers.moments import assert_right
from tests.samplers.targets import (
    ALL,
    BoundedBeta,
    CorrelatedGaussian,
    Counting,
    Funnel,
    SkewedGumbel,
    TruncatedGaussian,
    TwoModes,
)


def dense(ndim):
    """An inverse mass that is neither diagonal nor the covariance of any target."""
    return 0.7 * np.eye(ndim) + 0.3


def oblique(ndim):
    """Directions in no relation to any target."""
    return np.linalg.qr(np.random.default_rng(8).standard_normal((ndim, ndim)))[0]


SAMPLERS = {
    "mh": lambda t: MetropolisHastings(RandomWalk(2.0 / t.ndim**0.5 * t.width)),
    "slice-hyperrectangle": lambda t: Slice("hyperrectangle", width=4 * t.width),
    "slice-coordinate": lambda t: Slice("coordinate", width=2 * t.width, max_steps_out=4),
    "slice-hyperrectangle-oblique": lambda t: Slice("hyperrectangle", width=4 * t.width, axes=oblique(t.ndim)),
    "slice-coordinate-oblique": lambda t: Slice("coordinate", width=2 * t.width, axes=oblique(t.ndim)),
    "hmc": lambda t: HamiltonianMonteCarlo(0.4 * t.width, 6, inverse_mass=dense(t.ndim)),
    "hmc-central": lambda t: HamiltonianMonteCarlo(0.4 * t.width, 6, gradient="central-difference"),
    "mh-adaptive": lambda t: MetropolisHastings(),
    "slice-adaptive": lambda t: Slice(),
    "slice-coordinate-adaptive": lambda t: Slice("coordinate"),
    "hmc-adaptive": lambda t: HamiltonianMonteCarlo(),
    "mixture-adaptive": lambda t: MixtureSampler(),
    "mixture-mh-adaptive": lambda t: MixtureSampler(local=MetropolisHastings(), local_steps=3, jumps=2),
    "emcee-stretch": lambda t: Ensemble(moves="stretch"),
    "emcee": lambda t: Ensemble(),
    "emcee-de": lambda t: Ensemble(moves="de"),
    "emcee-snooker": lambda t: Ensemble(moves="snooker"),
}
LENGTH = {
    "mh": (320, 120, 240),
    "slice-hyperrectangle": (640, 60, 75),
    "slice-coordinate": (640, 60, 50),
    "slice-hyperrectangle-oblique": (640, 60, 75),
    "slice-coordinate-oblique": (640, 60, 30),
    "hmc": (640, 60, 30),
    "hmc-central": (640, 60, 40),
    "mh-adaptive": (640, 200, 80),
    "slice-adaptive": (320, 150, 80),
    "slice-coordinate-adaptive": (640, 200, 20),
    "hmc-adaptive": (320, 150, 60),
    "mixture-adaptive": (48, 120, 120),
    "mixture-mh-adaptive": (40, 200, 400),
    "emcee-stretch": (4, 200, 600),
    "emcee": (4, 200, 225),
    "emcee-de": (4, 100, 160),
    "emcee-snooker": (4, 200, 600),
}
"""Chains, warm-up and draws of each: many short chains, as a step of many takes little longer than one of few.

The runs of `make validate` have twice the steps.
"""
DECISIVE = {
    "mh": TruncatedGaussian,
    "slice-hyperrectangle": TruncatedGaussian,
    "slice-coordinate": BoundedBeta,
    "slice-hyperrectangle-oblique": SkewedGumbel,
    "slice-coordinate-oblique": TruncatedGaussian,
    "hmc": TruncatedGaussian,
    "mh-adaptive": SkewedGumbel,
    "slice-adaptive": TruncatedGaussian,
    "hmc-adaptive": SkewedGumbel,
    "mixture-adaptive": TruncatedGaussian,
    "emcee-de": BoundedBeta,
}
"""For each sampler one target that is skewed, correlated or has walls: what the suite asks of it every time.

Other tests guard what is left out: a step with any move of emcee is emcee's to the last bit, and the snooker has
its formula (test_ensemble.py); trajectories by central differences are reversible (test_hamiltonian.py); a mixture
with steps of Metropolis and Hastings has each mode's share (mixture/test_jumps.py); the slice sampler that moves
coordinate by coordinate is here with given widths, and learns them as the other scheme does.
"""
MATRIX = [
    *((name, kind) for name in ("mh", "slice-hyperrectangle", "slice-coordinate", "hmc") for kind in ALL),
    *(
        (name, kind)
        for name in ("mh-adaptive", "slice-adaptive", "hmc-adaptive", "mixture-adaptive", "mixture-mh-adaptive")
        for kind in ALL
    ),
    *(("slice-coordinate-adaptive", kind) for kind in (TruncatedGaussian, TwoModes)),
    *(("slice-hyperrectangle-oblique", kind) for kind in (TruncatedGaussian, SkewedGumbel, Funnel)),
    *(
        ("slice-coordinate-oblique", kind)
        for kind in (CorrelatedGaussian, TruncatedGaussian, BoundedBeta, TwoModes)
    ),
    *(("hmc-central", kind) for kind in (TruncatedGaussian, SkewedGumbel)),
    *(("emcee-stretch", kind) for kind in (CorrelatedGaussian, TruncatedGaussian, SkewedGumbel)),
    *(("emcee-de", kind) for kind in (CorrelatedGaussian, BoundedBeta)),
    ("emcee", TruncatedGaussian),
    ("emcee-snooker", CorrelatedGaussian),
]
"""All targets that make sense for a sampler; those that are not decisive are for `make validate`."""


def moments_of(name, kind):
    marks = () if DECISIVE.get(name) is kind else pytest.mark.validate
    return pytest.param(name, kind, id=f"{name}-{kind.name}", marks=marks)


@pytest.mark.parametrize(("name", "kind"), [moments_of(*pair) for pair in MATRIX])
def test_moments(name, kind):
    target = kind()
    chains, warmup, draws = LENGTH[name]
    if DECISIVE.get(name) is not kind:
        warmup, draws = 2 * warmup, 2 * draws
    sampler = SAMPLERS[name](target)
    if isinstance(sampler, Ensemble):
        sampler = replace(sampler, walkers=64)
    result = run(target, sampler, draws=draws, warmup=warmup, chains=chains, seed=20261121, init="prior")
    assert_right(target, result)


@cache
def counted(name, kind):
    """A short run, its density, and how many solves and gradients that saw."""
    density = Counting(kind())
    sampler = SAMPLERS[name](density.target)
    result = run(density, sampler, draws=12, warmup=7, chains=3, seed=5, init="prior")
    return density, result, (density.n_solves, density.n_gradients)


@pytest.mark.parametrize("kind", [CorrelatedGaussian, TruncatedGaussian], ids=lambda kind: kind.name)
@pytest.mark.parametrize("name", SAMPLERS)
class TestAccounts:
    def test_solves_and_gradients_are_what_the_density_saw(self, name, kind):
        _, result, (n_solves, n_gradients) = counted(name, kind)
        spent = {
            key: sum(int(part.stats[key].sum()) for part in (result.warmup, result.posterior))
            for key in ("n_solves", "n_gradients")
        }
        assert spent["n_solves"] == n_solves
        if name == "hmc-central":
            assert n_gradients == 0
            assert spent["n_gradients"] == 3 * (1 + 19 * 6)
        else:
            assert spent["n_gradients"] == n_gradients

    def test_log_prob_belongs_to_the_position(self, name, kind):
        density, result, _ = counted(name, kind)
        for part in (result.warmup, result.posterior):
            theta = part.position.reshape(-1, density.ndim)
            np.testing.assert_allclose(part.stats["lp"].ravel(), density.log_prob(theta), rtol=1e-12)

    def test_accepted_says_whether_the_chain_has_moved(self, name, kind):
        density, result, _ = counted(name, kind)
        steps = (3, 19, result.walkers)
        parts = (result.warmup, result.posterior)
        position = np.concatenate([part.position for part in parts], axis=1).reshape(*steps, density.ndim)
        accepted = np.concatenate([part.stats["accepted"] for part in parts], axis=1).reshape(steps)
        moved = np.any(position[:, 1:] != position[:, :-1], axis=-1)
        np.testing.assert_array_equal(accepted[:, 1:], moved)
        assert accepted.any()

    def test_every_draw_is_inside_the_box(self, name, kind):
        density, result, _ = counted(name, kind)
        assert np.all(result.posterior.position >= density.lower)
        assert np.all(result.posterior.position <= density.upper)


@pytest.mark.parametrize("name", SAMPLERS)
def test_the_seed_alone_decides(name):
    target = TruncatedGaussian()
    sampler = SAMPLERS[name](target)
    settings = {"draws": 5, "warmup": 5, "chains": 3, "init": "prior"}
    before = np.random.get_state()[1].copy()  # noqa: NPY002 - the global generator must stay untouched
    first = run(target, sampler, seed=3, **settings)
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(9)  # noqa: NPY002
    again, other = run(target, sampler, seed=3, **settings), run(target, sampler, seed=4, **settings)
    for part, same in ((first.warmup, again.warmup), (first.posterior, again.posterior)):
        np.testing.assert_array_equal(part.position, same.position)
        for key, value in part.stats.items():
            np.testing.assert_array_equal(value, same.stats[key])
    assert not np.array_equal(first.posterior.position, other.posterior.position)


@pytest.mark.parametrize("name", SAMPLERS)
def test_state_and_generator_are_all_that_a_step_needs(name):
    target = CorrelatedGaussian()
    kernel = SAMPLERS[name](target).bind(target)
    rng = np.random.default_rng(1)
    shape = (1, 32, 5) if name.startswith("emcee") else (3, 5)
    start = target.mean + 0.1 * np.random.default_rng(2).standard_normal(shape)
    state, _ = kernel.init(start)
    state, _ = kernel.step(rng, state)
    resumed = np.random.default_rng(0)
    resumed.bit_generator.state = rng.bit_generator.state
    expected, _ = kernel.step(rng, state)
    fresh = SAMPLERS[name](target).bind(target)
    found, _ = fresh.step(resumed, state)
    np.testing.assert_array_equal(found.position, expected.position)


class Failing(CorrelatedGaussian):
    """A density that fails in part of its box, as an eigensolver may."""

    def value_and_slope(self, x):
        value, slope = super().value_and_slope(x)
        failed = x[:, 0] > self.mean[0] + 0.2
        return np.where(failed, np.nan, value), np.where(failed[:, None], np.nan, slope)


@pytest.mark.parametrize("name", SAMPLERS)
def test_a_failing_density_stops_the_point_and_not_the_run(name):
    density = Counting(Failing())
    start = density.target.mean - 0.1 * np.abs(np.random.default_rng(1).standard_normal((2, 32, 5)))
    init = start if name.startswith("emcee") else start[:, 0]
    warmup = 30 if name.endswith("adaptive") else 0
    result = run(density, SAMPLERS[name](density), draws=15, warmup=warmup, chains=2, seed=1, init=init)
    stats = result.posterior.stats
    assert np.all(np.isfinite(stats["lp"]))
    assert np.all(result.posterior.position[..., 0] <= density.target.mean[0] + 0.2)
    assert stats["n_nonfinite"].sum() > 0
    assert stats["accepted"].any()
    assert stats["n_solves"].sum() + result.warmup.stats["n_solves"].sum() == density.n_solves
    if name.startswith("hmc"):
        np.testing.assert_array_equal(stats["diverging"], stats["n_nonfinite"] > 0)
        assert not np.any(stats["diverging"] & stats["accepted"])
