"""Places that only another run came to, with draws made by hand from Gaussians of known mass."""

import numpy as np
import pytest

from fmu.analysis.maxima.missed import missed_places
from fmu.analysis.maxima.results import Maxima, PosteriorMaximum

COVARIANCE = np.array([[1.0, 0.9], [0.9, 1.0]])


def gaussian(seed, shape, centre, height=0.0, scale=1.0):
    """Draws from a correlated Gaussian, and their log-density with the given height at the centre."""
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((*shape, 2)) @ np.linalg.cholesky(COVARIANCE).T
    lp = height - 0.5 * np.einsum("...i,ij,...j", z, np.linalg.inv(COVARIANCE), z)
    return np.array(centre) + scale * z, lp


@pytest.fixture
def run(make_trace):
    """Chains of 500 draws, one for each centre, all of the same height and scale."""

    def make(seed, *centres, height=0.0, scale=1.0, draws=500, walkers=1):
        parts = [gaussian([seed, k], (draws,), c, height, scale) for k, c in enumerate(centres)]
        position = np.stack([x for x, _ in parts])
        return make_trace(position, lp=np.stack([lp for _, lp in parts]), walkers=walkers)

    return make


HERE = [(0.0, 0.0)] * 4
THERE = [(12.0, -3.0)] * 4


def test_runs_on_the_same_place_have_nothing_to_tell_each_other(run):
    for seed in range(10):
        assert missed_places(run(seed, *HERE), {"other": run(100 + seed, *HERE)}) == []


@pytest.mark.parametrize("draws", [100, 20_000])
def test_lengths_may_differ(run, draws):
    assert missed_places(run(1, *HERE), {"other": run(2, *HERE, draws=draws)}) == []
    assert missed_places(run(2, *HERE, draws=draws), {"other": run(1, *HERE)}) == []


def test_a_place_of_the_same_weight(run):
    (found,) = missed_places(run(1, *HERE), {"mh": run(2, *THERE)})
    assert found.startswith("run mh visited x0 = 1")
    share = float(found.split("about ")[1].split(" %")[0])
    assert 40 < share < 60


def test_across_the_correlation_a_short_way_is_far(run):
    """1.5 to the side of a ridge of width 0.3: nearer than many draws are to each other along it."""
    assert missed_places(run(1, *HERE), {"other": run(2, *[(2.2, -2.2)] * 4)})
    assert missed_places(run(1, *HERE), {"other": run(2, *[(0.5, 0.5)] * 4)}) == []


def test_weight_is_height_and_width(run):
    here = run(1, *HERE)
    # a tenth of the width in both directions is a hundredth of the mass, unless it is e⁵ as high
    assert missed_places(here, {"other": run(2, *THERE, height=-1.0, scale=0.1)}) == []
    (found,) = missed_places(here, {"other": run(2, *THERE, height=5.0, scale=0.1)})
    share = float(found.split("about ")[1].split(" %")[0])
    assert share == pytest.approx(100 * np.exp(5) / (np.exp(5) + 100), abs=10)


def test_one_chain_of_many_suffices(run):
    (found,) = missed_places(run(1, *HERE), {"other": run(2, *HERE[:3], THERE[0])})
    assert "x0 = 1" in found


def test_a_worthless_place_of_a_trapped_chain_does_not_count(make_trace, run):
    position, lp = (
        np.stack(parts) for parts in zip(*(gaussian(k, (500,), (0, 0)) for k in range(4)), strict=True)
    )
    position[3], lp[3] = gaussian(9, (500,), (12.0, -3.0), height=-60.0)
    assert missed_places(run(1, *HERE), {"other": make_trace(position, lp=lp)}) == []


def test_a_run_that_mixes_over_both_places_knows_both(make_trace, run):
    """Within its chains the covariance is wide, which must not make the third place near."""
    rng = np.random.default_rng(3)
    position, lp = gaussian(4, (4, 600), (0.0, 0.0))
    position[rng.uniform(size=(4, 600)) < 0.5] += np.array(THERE[0])
    mixing = make_trace(position, lp=lp)
    assert missed_places(mixing, {"a": run(1, *HERE), "b": run(2, *THERE)}) == []
    assert len(missed_places(mixing, {"c": run(2, *[(-3.0, 12.0)] * 4)})) == 1
    # and of the mixing run those that know one place hear of the other
    assert len(missed_places(run(1, *HERE), {"mixing": mixing})) == 1


def test_a_single_chain_and_a_stuck_one(run, make_trace):
    assert missed_places(run(1, HERE[0]), {"other": run(2, *HERE)}) == []
    assert len(missed_places(run(1, HERE[0]), {"other": run(2, *THERE)})) == 1
    stuck = make_trace(np.zeros((2, 500, 2)), lp=np.zeros((2, 500)))
    assert len(missed_places(stuck, {"other": run(2, *HERE)})) == 1
    assert missed_places(run(2, *HERE), {"stuck": stuck}) == []


def test_walkers_are_followed_one_by_one(make_trace, run):
    """Two of eight walkers of each ensemble elsewhere: their mass is that place's, not that of all between."""
    position, lp = gaussian(5, (4, 100, 8), (0.0, 0.0))
    position[:, :, :2] += np.array(THERE[0])
    ensembles = make_trace(position.reshape(4, 800, 2), lp=lp.reshape(4, 800), walkers=8)
    (found,) = missed_places(run(1, *HERE), {"emcee": ensembles})
    share = float(found.split("about ")[1].split(" %")[0])
    assert 30 < share < 70
    assert missed_places(ensembles, {"a": run(1, *HERE), "b": run(2, *THERE)}) == []


def test_known_maxima_are_the_measure_and_are_left_to_their_own_test(run, plain):
    here, there = run(1, *HERE), {"mh": run(2, *THERE)}
    infinite, log_mass = np.full(2, np.inf), np.log(2 * np.pi * np.sqrt(np.linalg.det(COVARIANCE)))

    def known(centre, mass):
        maximum = PosteriorMaximum(
            theta=np.array(centre),
            log_prob=0.0,
            frequencies=np.ones(1),
            starts=1,
            at_bound=np.zeros(2, dtype=int),
            gradient=np.zeros(2),
            hessian=np.linalg.inv(COVARIANCE),
            curvature="differences",
            mean=np.array(centre),
            sd=np.ones(2),
            log_mass=mass,
            effective_draws=100.0,
            share=1.0,
        )
        return Maxima((maximum,), ("x0", "x1"), ("", ""), ("1",), -infinite, infinite, *np.ones((3, 2)))

    assert len(missed_places(here, there, known(HERE[0], log_mass))) == 1
    assert missed_places(here, there, known(HERE[0], log_mass + 6.0)) == []
    assert missed_places(here, there, known(THERE[0], log_mass)) == []
