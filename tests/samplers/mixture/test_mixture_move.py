"""The mixture as a move of emcee: the posterior stays invariant, and every way to call emcee works."""

from multiprocessing.pool import ThreadPool
from types import SimpleNamespace

import emcee
import numpy as np
import pytest

import fmu
from fmu.samplers.mixture.move import MixtureMove, Proposal
from tests.samplers.moments import assert_right
from tests.samplers.targets import BoundedBeta, CorrelatedGaussian, SkewedGumbel, TruncatedGaussian, TwoModes

WALKERS = 32


def run(target, move, steps, *, ensembles=2, walkers=2 * WALKERS, tune=0, seed=1):
    """Return ensembles of plain emcee, as `assert_right` reads them."""
    chains = []
    for k in range(ensembles):
        sampler = emcee.EnsembleSampler(walkers, target.ndim, target.log_prob, vectorize=True, moves=move(target))
        sampler.random_state = np.random.RandomState([seed, k]).get_state()
        start = target.sample_prior(np.random.default_rng([seed, k]), walkers)
        sampler.run_mcmc(start, tune or 8, tune=bool(tune))
        sampler.reset()
        sampler.run_mcmc(None, steps)
        chains.append(sampler.get_chain().reshape(-1, target.ndim))
    posterior = SimpleNamespace(position=np.array(chains))
    return SimpleNamespace(posterior=posterior, chains=len(chains), draws=steps, walkers=walkers)


# bounded and correlated; bounded, skewed and coupled; skewed and correlated
LENGTH = {TruncatedGaussian: 20, BoundedBeta: 20, SkewedGumbel: 40}


@pytest.mark.parametrize(
    "target", [TruncatedGaussian, pytest.param(BoundedBeta, marks=pytest.mark.validate), SkewedGumbel]
)
def test_the_target_is_invariant_while_the_mixture_is_fitted_to_the_other_half(target):
    assert_right(target(), run(target(), MixtureMove, LENGTH[target], ensembles=4), least=500)


@pytest.mark.parametrize(
    ("target", "steps"),
    [
        (TwoModes, 50),
        *(
            pytest.param(one, 100, marks=pytest.mark.validate)
            for one in (TruncatedGaussian, SkewedGumbel, CorrelatedGaussian)
        ),
    ],
)
def test_the_target_is_invariant_after_a_warm_up(target, steps):
    assert_right(target(), run(target(), MixtureMove, steps, tune=20))


class WithoutRatio(MixtureMove):
    """A mutant: candidates are accepted by the ratio of the posterior alone."""

    def candidates(self, *arguments):
        q, factor = super().candidates(*arguments)
        return q, np.zeros_like(factor)


@pytest.mark.parametrize(
    ("target", "length"),
    [
        (TruncatedGaussian, {"steps": 10, "walkers": 128}),
        (BoundedBeta, {"steps": 50, "tune": 20}),
        pytest.param(SkewedGumbel, {"steps": 100, "tune": 20}, marks=pytest.mark.validate),
    ],
)
def test_without_the_ratio_of_the_densities_the_moments_are_wrong(target, length):
    with pytest.raises(AssertionError, match="errors in MCSE"):
        assert_right(target(), run(target(), WithoutRatio, **length), least=500)


def test_a_mixture_is_fitted_to_the_other_half_alone(monkeypatch):
    target, given, moved = CorrelatedGaussian(), [], []
    fit, candidates = Proposal.fit_points.__func__, MixtureMove.candidates
    monkeypatch.setattr(
        Proposal,
        "fit_points",
        classmethod(lambda cls, *a: given.append([x.copy() for x in a[:2]]) or fit(cls, *a)),
    )
    monkeypatch.setattr(
        MixtureMove, "candidates", lambda self, s, *a: moved.append(s.copy()) or candidates(self, s, *a)
    )
    sampler = emcee.EnsembleSampler(WALKERS, 5, target.log_prob, vectorize=True, moves=MixtureMove(target))
    start = target.sample_prior(np.random.default_rng(1), WALKERS)
    sampler.run_mcmc(start, 1)
    end = sampler.get_last_sample().coords
    before, after = ({tuple(x) for x in walkers} for walkers in (start, end))
    assert {tuple(x) for x in moved[0]} | {tuple(x) for x in given[0][0]} == before
    assert {tuple(x) for x in given[0][0]} == {tuple(x) for x in moved[1]}, "the halves change their parts"
    assert {tuple(x) for x in given[1][0]} <= after, "the second half sees where the first one is now"
    for position, log_prob in given:
        assert len(position) == WALKERS // 2
        np.testing.assert_array_equal(log_prob, target.log_prob(position))


def test_the_warm_up_fits_and_then_the_mixture_is_frozen():
    target = CorrelatedGaussian()
    move = MixtureMove(target)
    sampler = emcee.EnsembleSampler(WALKERS, 5, target.log_prob, vectorize=True, moves=move)
    sampler.run_mcmc(target.sample_prior(np.random.default_rng(1), WALKERS), 9, tune=True)
    assert move.frozen is None
    sampler.run_mcmc(None, 11, tune=True)
    frozen = move.frozen
    assert frozen is not None
    sampler.reset()
    sampler.run_mcmc(None, 50)
    assert move.frozen is frozen
    assert sampler.acceptance_fraction.mean() > 0.85
    precision = frozen.mixture.quadratics[0].hessian / np.outer(frozen.scale, frozen.scale)
    np.testing.assert_allclose(precision, target.precision, atol=0.02 * np.abs(target.precision).max())


def test_vectorised_or_not_in_a_pool_and_with_blobs():
    target, chains = TruncatedGaussian(), []

    def with_blobs(x):
        return target.log_prob(x), 2.0 * x[0], 3.0 * x[1]

    def many(x):
        return np.column_stack([target.log_prob(x), 2.0 * x[:, 0], 3.0 * x[:, 1]])

    start = target.sample_prior(np.random.default_rng(1), WALKERS)
    with ThreadPool(2) as pool:
        for function, options in ((with_blobs, {}), (with_blobs, {"pool": pool}), (many, {"vectorize": True})):
            sampler = emcee.EnsembleSampler(WALKERS, 2, function, moves=MixtureMove(target), **options)
            sampler.random_state = np.random.RandomState(3).get_state()
            sampler.run_mcmc(start, 4)
            chains.append(sampler.get_chain())
            np.testing.assert_array_equal(sampler.get_blobs(), chains[-1] * [2.0, 3.0])
            flat = sampler.get_chain(flat=True)
            np.testing.assert_allclose(sampler.get_log_prob(flat=True), target.log_prob(flat), rtol=1e-12)
    np.testing.assert_array_equal(chains[1], chains[0])
    np.testing.assert_allclose(chains[2], chains[0], rtol=1e-9)


def test_candidates_do_not_depend_on_units():
    """The fit is in scaled coordinates, with bounds or without."""
    target, unit = CorrelatedGaussian(), np.array([1e11, 1e-6, 1.0, 1e3, 1e-9])
    x = target.sample_prior(np.random.default_rng(2), WALKERS)
    for bounds in ({}, {"lower": target.mean - 9.0, "upper": target.mean + 9.0}):
        found = []
        for factor in (1.0, unit):
            move = MixtureMove(**{name: factor * value for name, value in bounds.items()})
            q, ratio = move.candidates(
                factor * x[:16], factor * x[16:], target.log_prob(x[16:]), np.random.RandomState(1)
            )
            found.append((q / factor, ratio))
        np.testing.assert_allclose(found[1][0], found[0][0], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(found[1][1], found[0][1], rtol=1e-4, atol=1e-4)


def test_where_the_other_half_spans_nothing_walkers_stretch():
    move, random = MixtureMove(), np.random.RandomState(1)
    s, same = np.random.default_rng(1).standard_normal((4, 2)), np.ones((4, 2))
    for c, log_prob in ((same, np.zeros(4)), (s, np.full(4, -np.inf))):
        q, factor = move.candidates(s, c, log_prob, random)
        assert q.shape == (4, 2)
        assert np.isfinite(factor).all()


def test_walkers_outside_the_bounds_or_where_nothing_is_known():
    target = TruncatedGaussian()
    move = MixtureMove(target)
    x = target.sample_prior(np.random.default_rng(1), 20)
    outside = np.array([[2.0, 1.0]])
    q, factor = move.candidates(outside, x, target.log_prob(x), np.random.RandomState(1))
    assert np.all((q >= target.lower) & (q <= target.upper))
    assert factor[0] == -np.inf, "the mixture never proposes it"


def test_bad_bounds():
    with pytest.raises(ValueError, match=r"upper: must exceed lower"):
        fmu.MixtureMove(lower=[0.0, 1.0], upper=[1.0, 1.0])
    with pytest.raises(ValueError, match=r"upper: must have the shape of lower, \(2,\) \(got \(3,\)\)"):
        fmu.MixtureMove(lower=[0.0, 1.0], upper=[1.0, 2.0, 3.0])
