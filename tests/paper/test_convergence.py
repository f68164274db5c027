"""Running errors, what they cost, and where a run began to convince."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from fmu.analysis.convergence.diagnostics import autocorrelation_times_run, summary
from fmu.analysis.convergence.remedies import MIN_AUTOCORRELATION_TIMES
from fmu.paper.convergence import (
    LEAST_ESS_OF_PACE,
    Reference,
    around_the_maxima,
    has_met_criterion,
    lengths_up_to,
    pool_traces,
    running_error,
    shorten_trace,
    solves_at_this_pace,
    solves_by_step,
    solves_needed,
)

REFERENCE = Reference(np.array([1.0, 20.0]), np.array([2.0, 10.0]), np.array([0.1, 0.1]), "given")


def make_trace(a, b, walkers=1, warm_solves=7, lp=0.0, gradients=0):
    """A trace of two parameters whose step k (from 0) took k + 1 solves in every walker.

    Every step, that of the warm-up too, took `gradients`; warm-up took 0.5 s, draws as long.
    """
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    steps = np.arange(a.shape[1]) // walkers + 1
    dims = ("chain", "draw")
    trace = xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset({"a": (dims, a), "b": (dims, b)}),
            "sample_stats": xr.Dataset(
                {
                    "n_solves": (dims, np.broadcast_to(steps, a.shape)),
                    "n_gradients": (dims, np.full(a.shape, gradients)),
                    "lp": (dims, np.full(a.shape, lp)),
                }
            ),
            "warmup_sample_stats": xr.Dataset(
                {
                    "n_solves": (dims, np.full((len(a), 1), warm_solves)),
                    "n_gradients": (dims, np.full((len(a), 1), gradients)),
                }
            ),
        }
    )
    trace.attrs = {"walkers": walkers, "sampler": "mh", "wall_s": 1.0, "warmup_wall_s": 0.5, "warmup": 1}
    return trace


def test_solves_count_the_warmup_and_all_walkers():
    trace = make_trace(np.zeros((2, 3)), np.zeros((2, 3)))
    np.testing.assert_array_equal(solves_by_step(trace), [[8, 10, 13]] * 2)
    ensemble = make_trace(np.zeros((1, 6)), np.zeros((1, 6)), walkers=2)
    np.testing.assert_array_equal(solves_by_step(ensemble), [[9, 13, 19]])


def test_a_gradient_counts_as_the_solves_that_it_takes_the_time_of():
    trace = make_trace(np.zeros((2, 3)), np.zeros((2, 3)), gradients=1)
    np.testing.assert_array_equal(solves_by_step(trace), [[8, 10, 13]] * 2)  # not measured: one
    trace.attrs["gradient_cost"] = 2.5
    np.testing.assert_array_equal(solves_by_step(trace), [[8 + 3, 10 + 4.5, 13 + 6]] * 2)


def test_running_error_of_a_chain():
    trace = make_trace([[3.0, 5.0], [1.0, 1.0]], [[20.0, 20.0], [30.0, 50.0]])
    curve = running_error(trace, REFERENCE)
    # chain 0: means of a are 3 and 4, one and one and a half sd off; chain 1: means of b are 30 and 40
    np.testing.assert_allclose(curve.error, np.array([[1.0, 1.5], [1.0, 2.0]]) / np.sqrt(2))
    np.testing.assert_array_equal(curve.solves, [8, 10])


def test_running_error_of_an_ensemble_averages_its_walkers():
    trace = make_trace([[3.0, 5.0, 9.0, 11.0]], [[20.0] * 4], walkers=2)
    curve = running_error(trace, REFERENCE)
    np.testing.assert_allclose(curve.error, np.array([[1.5, 3.0]]) / np.sqrt(2))


def test_lengths_grow_geometrically_and_end_at_the_whole_run():
    lengths = lengths_up_to(1000, 2.0, 50)
    assert lengths[0] == 50
    assert lengths[-1] == 1000
    assert np.all(lengths[1:] / lengths[:-1] <= 2.05)
    np.testing.assert_array_equal(lengths_up_to(30, 2.0, 50), [30])


def test_shortened_trace_keeps_the_first_draws():
    trace = make_trace([np.arange(10.0)], [np.arange(10.0)])
    short = shorten_trace(trace, 4)
    np.testing.assert_array_equal(short["posterior"]["a"], [[0, 1, 2, 3]])
    assert short.attrs == trace.attrs


@pytest.mark.parametrize("walkers", [1, 2])
def test_solves_needed_is_where_the_verdict_turned_good_for_good(walkers):
    steps = 400
    trace = make_trace(np.zeros((2, steps * walkers)), np.zeros((2, steps * walkers)), walkers)

    def passes(short):
        length = short["posterior"].sizes["draw"] // walkers
        return length >= 200 or 60 <= length <= 80

    needed = solves_needed(trace, passes)
    assert 200 <= needed.draws <= 250
    cost = 7 + walkers * needed.draws * (needed.draws + 1) // 2
    assert needed.solves == 2 * cost
    assert needed.samples == 2 * walkers * (1 + needed.draws)
    assert needed.seconds == pytest.approx(0.5 + 0.5 * needed.draws / steps)
    # the warm-up is one step of 7 solves and 0.5 s in each of two chains
    assert needed.sampling_solves == needed.solves - 2 * 7
    assert needed.sampling_samples == needed.samples - 2 * walkers
    assert needed.sampling_seconds == pytest.approx(needed.seconds - 0.5)


@pytest.mark.parametrize("walkers", [1, 16])
def test_the_criterion_is_alike_for_ensembles_and_chains(walkers):
    """Independent draws meet it at an ESS of 400, also walkers whose run spans few autocorrelation times."""
    draws = np.random.default_rng(4).standard_normal((2, 4, 640))
    trace, apart = (make_trace(*draws, walkers=walkers) for draws in (draws, draws + np.arange(4)[:, None]))
    assert has_met_criterion(shorten_trace(trace, 640))
    assert not has_met_criterion(shorten_trace(trace, 64))
    assert not has_met_criterion(shorten_trace(apart, 640))
    assert (autocorrelation_times_run(trace).max() < MIN_AUTOCORRELATION_TIMES) == (walkers > 1)


def test_pace_is_in_proportion_to_the_worst_ess():
    draws = np.random.default_rng(3).standard_normal((2, 4, 100))
    trace = make_trace(*draws)
    ess = summary(trace)[["ess_bulk", "ess_tail"]].min().min()
    assert 50 < ess < 400
    # 4 chains of 1 + 2 + … + 100 solves; the warm-up does not count
    assert solves_at_this_pace(trace) == (round(4 * 5050 * 400 / ess), ess)
    assert solves_at_this_pace(make_trace(draws[0], np.zeros((4, 100)))) is None


def test_the_size_of_chains_that_hardly_move_is_overestimated():
    """Four AR(1) chains with an effective sample size of 0.4 seem to have one of 4 and more, below the limit."""
    rng, steps, r = np.random.default_rng(8), 1000, 0.9998
    draws = rng.standard_normal((2, 4, steps)) * np.sqrt(1 - r**2)
    draws[..., 0] = rng.standard_normal((2, 4))
    for k in range(1, steps):
        draws[..., k] += r * draws[..., k - 1]
    truth = 4 * steps * (1 - r) / (1 + r)
    assert 5 * truth < solves_at_this_pace(make_trace(*draws)).ess < LEAST_ESS_OF_PACE


def test_solves_needed_of_a_run_that_never_convinces():
    trace = make_trace(np.zeros((2, 400)), np.zeros((2, 400)))
    needed = solves_needed(trace, lambda short: short["posterior"].sizes["draw"] < 400)
    assert needed.draws is None
    assert needed.solves is None


def test_reference_from_the_maxima_is_the_mixture_that_they_make():
    one = SimpleNamespace(share=0.75, mean=np.array([0.0, 2.0]), sd=np.array([1.0, 1.0]), effective_draws=100.0)
    two = SimpleNamespace(share=0.25, mean=np.array([4.0, 2.0]), sd=np.array([1.0, 3.0]), effective_draws=0.0)
    reference = around_the_maxima([one, two])
    np.testing.assert_allclose(reference.mean, [1.0, 2.0])
    np.testing.assert_allclose(reference.sd, np.sqrt([1.0 + 0.75 * 1 + 0.25 * 9, 0.75 + 0.25 * 9]))
    np.testing.assert_allclose(reference.mcse, np.sqrt([0.75**2 / 100 + 0.25**2, 0.75**2 / 100 + 0.75**2]))


def test_a_run_that_misses_the_maximum_is_measured_against_it(result):
    """Nothing converged in this short run: the reference is the mass around the maximum, not the chains."""
    np.testing.assert_allclose(result.reference.mean, result.maxima[0].mean, rtol=1e-6)
    assert result.reference.resolution < 0.2


def test_pooled_reference_weighs_by_effective_draws():
    rng = np.random.default_rng(1)
    short, long = (make_trace(*rng.standard_normal((2, 4, n))) for n in (300, 4_000))
    reference = pool_traces({"short": short, "long": long}, "both")
    every = np.concatenate(
        [trace["posterior"][name].to_numpy().ravel() for trace in (short, long) for name in "a"]
    )
    np.testing.assert_allclose(reference.mean[0], every.mean(), atol=2e-3)
    np.testing.assert_allclose(reference.sd, 1.0, atol=0.03)
    np.testing.assert_allclose(reference.mcse, 1 / np.sqrt(4 * 4_300), rtol=0.1)
    assert reference.resolution == pytest.approx(1 / np.sqrt(4 * 4_300), rel=0.1)
