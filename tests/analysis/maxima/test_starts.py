"""Chains that start at the maxima: how many at each, how wide, and none where nothing is."""

from dataclasses import replace

import emcee
import numpy as np
import pytest

import fmu
from fmu.analysis.maxima.missed import draws_of_maxima, nearest_maxima
from fmu.analysis.maxima.starts import DISPERSION, allot_chains, are_in_funnel, components, starts_at_maxima
from tests.four_storeys import SD, TRUTH, four_storeys


@pytest.fixture(scope="module")
def frame():
    return four_storeys()


@pytest.fixture(scope="module")
def frame_maxima(frame):
    return fmu.find_map(frame)


@pytest.mark.parametrize(
    ("shares", "n", "counts"),
    [
        ([0.7, 0.3], 4, [3, 1]),
        ([0.26, 0.25, 0.25, 0.24], 4, [1, 1, 1, 1]),
        ([0.1, 0.9], 4, [1, 3]),  # one at each that counts
        ([0.98, 0.02], 4, [4, 0]),  # one of four chains is more than ten times 2 %
        ([0.98, 0.02], 8, [7, 1]),
        ([0.995, 0.005], 400, [400, 0]),  # below 1 % none, however many chains there are
        ([0.2, 0.5, 0.3], 2, [0, 1, 1]),  # too few chains for all
        ([0.2] * 5, 3, [1, 1, 1, 0, 0]),
        ([1e-30, 1.0], 1, [0, 1]),
        ([0.55, 0.35, 0.1], 32, [18, 11, 3]),
        ([0.005] * 200, 3, [3] + [0] * 199),
    ],
)
def test_chains_are_allotted_in_proportion(shares, n, counts):
    home = allot_chains(np.array(shares), n)
    np.testing.assert_array_equal(np.bincount(home, minlength=len(shares)), counts)


def test_the_frame_has_four_maxima_of_comparable_share_and_one_of_none(frame, frame_maxima):
    assert len(frame_maxima) == 5
    shares = np.array([m.share for m in frame_maxima])
    assert np.sum(shares[:4]) == pytest.approx(1.0, abs=1e-9)
    assert np.all((shares[:4] > 0.1) & (shares[:4] < 0.4))
    assert shares[4] < 1e-20
    assert frame_maxima[4].starts > 30
    truth = min(frame_maxima, key=lambda m: np.linalg.norm(m.theta - TRUTH))
    np.testing.assert_allclose(truth.theta, TRUTH, rtol=1e-4)


@pytest.mark.parametrize(("sampler", "chains"), [("mh", 16), ("slice", 16), ("hmc", 4), ("emcee", 1)])
def test_by_default_every_chain_is_at_a_maximum_that_counts(frame, frame_maxima, sampler, chains):
    """From the prior a climb in four ends at the fifth, which holds nothing."""
    settings = {"draws": 15, "warmup": 15, "chains": chains, "seed": 1}
    trace = fmu.sample(frame, sampler, **settings, maxima=frame_maxima, jumps=False)
    theta = np.stack([trace["posterior"][name] for name in frame.names], axis=-1)
    lp = trace["sample_stats"]["lp"].to_numpy()
    at = draws_of_maxima(theta.reshape(-1, 4), lp.ravel(), frame_maxima)
    visits = np.bincount(at[at >= 0], minlength=5) / len(at)
    assert visits[4] == 0.0
    assert np.all(visits[:4] > 0.1)


def test_starts_are_twice_as_wide_as_the_posterior_and_right_at_it(frame, frame_maxima):
    theta = starts_at_maxima(frame, frame_maxima, 2000, 1, seed=1)
    home = nearest_maxima(theta, frame_maxima)
    shares = np.array([m.share for m in frame_maxima])
    assert np.all(np.isfinite(frame.log_prob(theta)))
    for k in range(4):
        here = theta[home == k]
        assert len(here) / 2000 == pytest.approx(
            shares[k], abs=0.1
        )  # some are out of the ellipsoid that `home` is by
        covariance = np.linalg.inv(frame_maxima[k].hessian)
        z = np.linalg.solve(np.linalg.cholesky(covariance), (here - frame_maxima[k].theta).T)
        assert 0.7 * DISPERSION < np.sqrt(np.mean(z**2)) < 1.1 * DISPERSION


def test_starts_stay_within_the_bounds_at_maxima_on_them(section, section_maxima):
    theta = starts_at_maxima(section, section_maxima, 200, 1, seed=3)
    assert np.all((theta >= section.lower) & (theta <= section.upper))
    assert len(np.unique(theta, axis=0)) == 200
    highest = max(section_maxima, key=lambda m: m.share)
    fall = highest.log_prob - section.log_prob(theta)
    assert fall.max() < 60.0  # the rim of a Gaussian of twice the width; of the prior the median is 1e5
    assert (
        np.median(
            section_maxima[0].log_prob - section.log_prob(section.sample_prior(np.random.default_rng(1), 99))
        )
        > 1e3
    )


def test_seed_and_number_decide(frame, frame_maxima):
    first, again, other = (starts_at_maxima(frame, frame_maxima, 4, 1, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.all(first != other)


def test_walkers_of_every_ensemble_are_in_proportion_and_span_the_space(frame, frame_maxima):
    theta = starts_at_maxima(frame, frame_maxima, 3, 40, seed=1)
    assert theta.shape == (3, 40, 4)
    expected = np.bincount(allot_chains(np.array([m.share for m in frame_maxima]), 40))
    closest = np.argmin(np.stack([np.linalg.norm(theta - m.theta, axis=-1) for m in frame_maxima]), axis=0)
    for ensemble, home in zip(theta, closest, strict=True):
        assert np.all(np.abs(np.bincount(home, minlength=len(expected)) - expected) <= 3)
        assert np.linalg.matrix_rank(ensemble - ensemble.mean(axis=0)) == 4


def test_where_the_quadratic_is_wrong_a_start_is_drawn_in(frame, frame_maxima):
    """A density that falls off a cliff half a standard deviation from the maximum."""

    class Cliff:
        ndim, lower, upper = frame.ndim, frame.lower, frame.upper
        offset, scale = frame.offset, frame.scale

        def log_prob(self, theta):
            below = theta[:, 0] < frame_maxima[0].theta[0] + 0.5 * frame_maxima[0].sd[0]
            return np.where(below, frame.log_prob(theta), np.nan)

    density = Cliff()
    assert np.all(np.isfinite(density.log_prob(starts_at_maxima(density, frame_maxima, 1, 1, seed=1))))
    only_first = fmu.analysis.maxima.results.Maxima(
        (frame_maxima[0],), *(getattr(frame_maxima, n) for n in ("names", "units", "labels", "lower", "upper",
                                                                "start", "measured", "before"))
    )  # fmt: skip
    theta = starts_at_maxima(density, only_first, 100, 1, seed=1)
    assert np.all(np.isfinite(density.log_prob(theta)))
    assert len(np.unique(theta, axis=0)) == 100


def test_first_candidates_are_enough_at_a_small_maximum(frame, frame_maxima):
    """Half of the weights are in proportion to the shares, half are equal."""
    shares = [0.03, *[0.97 / (len(frame_maxima) - 1)] * (len(frame_maxima) - 1)]
    rare = [replace(m, share=share) for m, share in zip(frame_maxima, shares, strict=True)]
    quadratics, weights, _ = components(frame, replace(frame_maxima, maxima=tuple(rare)))
    assert len(quadratics) == len(rare) > 1
    assert weights.sum() == pytest.approx(1.0)
    assert (
        weights[-1] == weights.min() == pytest.approx(0.5 * (0.03 + 1 / len(rare)))
    )  # the smallest share is last


def test_walkers_are_spread_over_the_maxima_and_emcee_takes_them(frame, frame_maxima):
    start = frame.walkers(32, seed=3)
    assert start.shape == (32, frame.ndim)
    assert np.all((start >= frame.lower) & (start <= frame.upper))
    closest = np.argmin(frame_maxima.drop(start), axis=0)
    share = np.array([m.share for m in frame_maxima])
    np.testing.assert_array_equal(
        np.bincount(closest, minlength=5), np.bincount(allot_chains(share, 32), minlength=5)
    )
    np.testing.assert_array_equal(frame.walkers(32, seed=3), start)
    assert not np.isin(frame.walkers(32, seed=4), start).any()
    sampler = emcee.EnsembleSampler(32, frame.ndim, frame.log_prob, vectorize=True)
    sampler.run_mcmc(start, 2)
    assert sampler.acceptance_fraction.mean() > 0


def test_walkers_of_a_hierarchical_posterior_are_around_its_middle():
    problem = fmu.cases.load("shear-4dof-repeated")
    start = problem.walkers(2 * problem.ndim)
    assert start.shape == (2 * problem.ndim, problem.ndim)
    assert np.isfinite(problem.log_prob(start)).all()


@pytest.mark.parametrize(
    ("n", "seed", "message"),
    [
        (3, 1, r"n: must be a whole number of at least 8, twice the parameters \(got 3\)"),
        (32.0, 1, r"n: must be a whole number of at least 8, twice the parameters \(got 32.0\)"),
        (32, -1, r"seed: must be a whole number of at least 0 \(got -1\)"),
    ],
)
def test_walkers_that_make_no_sense(frame, n, seed, message):
    with pytest.raises(ValueError, match=message):
        frame.walkers(n, seed)


def test_a_funnel_has_one_maximum_which_is_its_neck(frame):
    """Of a model that may be wrong; the quadratics at its maxima, without scatter, are far too narrow."""
    error = fmu.FrequencyErrors("relative", sd=SD)
    wrong = fmu.UpdatingProblem(
        frame.model, frame.data, frame.parameters, error=error, discrepancy=fmu.Discrepancy()
    )
    maxima = fmu.find_map(wrong, starts=4)
    neck, wide = (
        replace(maxima, maxima=(replace(maxima[0], share=1.0, effective_draws=n),)) for n in (2.0, 200.0)
    )
    assert are_in_funnel(wrong, neck)
    assert not any(are_in_funnel(*one) for one in ((wrong, wide), (wrong, maxima), (frame, neck)))
