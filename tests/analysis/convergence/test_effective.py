import arviz as az
import numpy as np
import pytest
import xarray as xr
from emcee.autocorr import integrated_time
from scipy.special import ndtr, ndtri

from fmu.analysis.convergence import effective
from fmu.analysis.convergence.pareto import pareto_k


def flat(ensembles):
    """(ensembles, steps, walkers) -> (ensembles, steps * walkers), step-major, as traces store it."""
    return ensembles.reshape(len(ensembles), -1)


@pytest.mark.parametrize("phi", [-0.3, 0.0, 0.8])
def test_chains_are_measured_as_arviz_measures_them(ar1, phi):
    x = np.exp(ar1(np.random.default_rng(3), (4, 500), phi))
    data = xr.Dataset({"x": (("chain", "draw"), x)})
    assert effective.rhat(x) == float(az.rhat(data)["x"])
    assert effective.ess_bulk(x) == float(az.ess(data, method="bulk")["x"])
    assert effective.ess_tail(x) == float(az.ess(data, method="tail", prob=(0.05, 0.95))["x"])
    assert effective.ess_mean(x) == pytest.approx(float(az.ess(data, method="mean")["x"]), rel=1e-12)
    assert effective.mcse_mean(x) == pytest.approx(float(az.mcse(data)["x"]), rel=1e-12)


def test_units_do_not_change_the_effective_sample_size(ar1):
    # ArviZ's own ESS of the mean takes anything with a range below 1e-15 for a constant.
    x = ar1(np.random.default_rng(4), (4, 400), 0.9)
    tiny = 1e-20 * x
    assert effective.ess_mean(tiny) == pytest.approx(effective.ess_mean(x), rel=1e-9)
    assert effective.mcse_mean(tiny) == pytest.approx(1e-20 * effective.mcse_mean(x), rel=1e-9)
    assert effective.mcse_quantile(tiny, 0.9) == pytest.approx(1e-20 * effective.mcse_quantile(x, 0.9), rel=1e-9)
    assert effective.ess_mean(x) < 0.2 * x.size


@pytest.mark.parametrize("walkers", [1, 4])
@pytest.mark.parametrize("spoil", ["constant", "nan", "inf", "short"])
def test_what_cannot_be_computed_is_nan(walkers, spoil):
    x = np.random.default_rng(5).standard_normal((4, 3 if spoil == "short" else 40))
    if spoil == "constant":
        x[:] = 2.0
    elif spoil != "short":
        x[1, 7] = np.nan if spoil == "nan" else np.inf
    assert np.isnan(effective.rhat(x))
    for measure in (effective.ess_bulk, effective.ess_tail, effective.ess_mean, effective.mcse_mean):
        assert np.isnan(measure(x, walkers))
    assert np.isnan(effective.mcse_quantile(x, 0.05, walkers))


def test_one_chain_has_no_rhat_but_an_ess():
    x = np.random.default_rng(6).standard_normal((1, 400))
    assert np.isnan(effective.rhat(x))
    assert effective.ess_bulk(x) > 100


def test_chains_that_stand_still_apart_have_infinite_rhat():
    assert effective.rhat(np.repeat([[1.0], [2.0]], 50, axis=1)) == np.inf


def test_tail_ess_does_not_count_repetitions_of_the_largest_draw():
    x = np.random.default_rng(7).standard_normal((4, 100))
    x[2, 40:80] = x.max() + 1.0
    assert np.isnan(effective.ess_tail(x))
    assert np.isnan(effective.mcse_quantile(x, 0.95))


def test_ensemble_that_stands_still_is_nan():
    x = np.random.default_rng(8).standard_normal((3, 50, 8))
    x[1] = 0.3
    assert np.isnan(effective.ess_bulk(flat(x), 8))


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.8])
def test_autocorrelation_time_of_an_ensemble_is_that_of_the_process(ar1, phi):
    x = ar1(np.random.default_rng(9), (2, 10_000, 32), phi)
    tau = (1 + phi) / (1 - phi)
    relative_error = np.sqrt(2 * (10 * tau + 1) / (10_000 * 32))  # Sokal's, with a window of 5 tau
    times = effective.autocorrelation_times(flat(x), 32)
    np.testing.assert_allclose(times, tau, rtol=4 * relative_error)
    assert effective.ess_bulk(flat(x), 32) == pytest.approx(320_000 * np.sum(1 / times), rel=1e-12)


def test_one_walker_has_the_autocorrelation_time_that_emcee_gives_it(ar1):
    x = ar1(np.random.default_rng(15), (1, 4000), 0.8)
    expected = integrated_time(x[0], tol=0)[0]
    assert effective.autocorrelation_times(x, 1)[0] == pytest.approx(expected, rel=1e-10)


def test_ensemble_has_the_autocorrelation_time_that_emcee_gives_its_joined_walkers(ar1):
    x = ar1(np.random.default_rng(16), (1, 1000, 8), 0.8) + np.linspace(0, 1, 8)
    centred = (x[0] - x.mean()).T
    joined = np.concatenate([centred, np.zeros_like(centred)], axis=1).ravel()  # zeros keep the walkers apart
    assert effective.autocorrelation_times(flat(x), 8)[0] == pytest.approx(
        integrated_time(joined, tol=0)[0], rel=1e-10
    )


def test_ess_is_summed_over_ensembles(ar1):
    rng = np.random.default_rng(10)
    x = np.concatenate([ar1(rng, (1, 5000, 16), phi) for phi in (0.0, 0.9)])
    expected = 5000 * 16 * (1 + 1 / 19)
    assert effective.ess_mean(flat(x), 16) == pytest.approx(expected, rel=0.08)
    assert effective.ess_mean(flat(x[1:]), 16) == pytest.approx(5000 * 16 / 19, rel=0.35)


def test_short_runs_do_not_overstate_the_effective_sample_size(ar1):
    rng = np.random.default_rng(11)
    short = [effective.autocorrelation_times(flat(ar1(rng, (1, 380, 32), 0.9)), 32)[0] for _ in range(40)]
    # 20 autocorrelation times: centring each walker at its own mean gives 12.7 instead of 19.
    assert np.mean(short) == pytest.approx(19.0, rel=0.1)


def test_walkers_that_alternate_have_a_positive_ess_of_at_most_n_log_n(ar1):
    x = ar1(np.random.default_rng(17), (2, 500, 8), -0.95)
    assert effective.ess_mean(flat(x), 8) == pytest.approx(x.size * np.log10(500 * 8), rel=1e-12)


def test_walkers_in_separate_modes_count_as_correlated(ar1):
    x = ar1(np.random.default_rng(12), (4, 1000, 8), 0.2)
    x[:, :, ::2] += 10.0  # neighbours in different modes
    assert effective.ess_bulk(flat(x), 8) < 2 * 4 * 8  # about one per walker
    assert effective.ess_bulk(flat(x - x.mean(axis=1, keepdims=True)), 8) > 10_000


@pytest.mark.parametrize("walkers", [1, 8])
def test_standard_error_is_the_scatter_over_replicates(ar1, walkers):
    rng = np.random.default_rng(13)
    runs = [flat(ar1(rng, (4, 500, walkers), 0.7)) for _ in range(200)]
    scatter = np.std([x.mean() for x in runs])
    reported = np.mean([effective.mcse_mean(x, walkers) for x in runs])
    assert reported == pytest.approx(scatter, rel=5 / np.sqrt(2 * 200))


def test_tail_ess_of_an_ensemble_is_that_of_the_quantiles(ar1):
    rng = np.random.default_rng(14)
    runs = [flat(ar1(rng, (2, 500, 8), 0.8)) for _ in range(200)]
    scatter = np.std([np.mean(x <= -1.6448536269514722) for x in runs])
    reported = np.mean([np.sqrt(0.05 * 0.95 / effective.ess_tail(x, 8)) for x in runs])
    # The smaller of two noisy ESS is smaller than either, hence a little above the scatter.
    assert 0.8 * scatter < reported < 1.4 * scatter
    assert effective.ess_tail(runs[0], 8) > 1.3 * effective.ess_bulk(runs[0], 8)


@pytest.mark.parametrize(
    ("phi", "steps", "walkers", "of_normal"),
    [
        pytest.param(0.0, 100, 1, np.asarray, marks=pytest.mark.validate),
        (0.0, 100, 1, np.exp),  # an upper tail that is longer than the lower
        (0.6, 400, 1, lambda x: -np.log(ndtr(-x))),  # exponential: it ends at 0
        pytest.param(0.5, 300, 1, ndtr, marks=pytest.mark.validate),  # uniform: it ends at both sides
        (0.8, 120, 8, np.exp),
    ],
)
def test_error_of_a_quantile_is_what_it_is_off_by_in_replicates(ar1, phi, steps, walkers, of_normal):
    rng = np.random.default_rng(18)
    runs = [of_normal(flat(ar1(rng, (4, steps, walkers), phi))) for _ in range(600)]
    for normal in (-1.6448536269514722, 1.6448536269514722):
        truth, p = of_normal(np.array(normal)), float(ndtr(normal))
        z = np.array([(np.quantile(x, p) - truth) / effective.mcse_quantile(x, p, walkers) for x in runs])
        assert 0.87 < np.std(z) < 1.13
        assert np.mean(np.abs(z) > 2.58) < 0.035


def test_error_of_a_quantile_sees_a_slow_part_of_the_correlation(ar1):
    # Two places, chosen anew once in ten steps on average: of "below the 5 % quantile" the autocorrelation is
    # 0.02 after one step and falls as slowly as 0.9^k, within the noise that ends a sum of autocorrelations.
    rng = np.random.default_rng(19)
    quantile, z = float(ndtri(0.05 / 0.7)), []
    for _ in range(600):
        leaves = rng.random((4, 1000)) > 0.9
        leaves[:, 0] = True
        last = np.maximum.accumulate(np.where(leaves, np.arange(1000), 0), axis=1)
        right = np.take_along_axis(rng.random((4, 1000)) > 0.7, last, axis=1)
        x = rng.standard_normal((4, 1000)) + 20.0 * right
        z.append((np.quantile(x, 0.05) - quantile) / effective.mcse_quantile(x, 0.05))
    assert 0.88 < np.std(z) < 1.09


def test_by_walker_follows_each_walker_through_the_steps():
    x = np.arange(12).reshape(1, 12)  # 4 steps of 3 walkers
    np.testing.assert_array_equal(effective.by_walker(x, 3)[0], [[0, 3, 6, 9], [1, 4, 7, 10], [2, 5, 8, 11]])


@pytest.mark.parametrize(
    ("draws", "most", "walkers", "expected"),
    [(1000, 1500, 1, 1), (1000, 500, 1, 2), (1001, 500, 1, 3), (6400, 100, 32, 65), (6000, 500, 30, 13)],
)
def test_thinning_sees_all_walkers_alike(draws, most, walkers, expected):
    distance = effective.apart(draws, most, walkers)
    assert distance == expected
    seen = np.bincount(np.arange(0, draws, distance) % walkers, minlength=walkers)
    assert np.ptp(seen) <= 1


def test_autocorrelation_of_an_ensemble_is_about_its_common_mean():
    rng = np.random.default_rng(1)
    steps = rng.normal(size=(2, 400, 4)) + np.array([0.0, 0.0, 8.0, 8.0])  # walkers that sit in two places
    values = effective.autocorrelation(steps.reshape(2, -1), 4)
    assert values.shape == (2, 400)
    np.testing.assert_allclose(values[:, 0], 1.0)
    assert np.all(values[:, 1:20] > 0.85)  # 16 of the variance 17 is that of the places, less at longer lags
    still = np.ones((1, 40))
    assert np.isnan(effective.autocorrelation(still)).all()


def test_the_tail_of_weights_that_do_not_differ():
    """A run must not end with an error because a chain has not moved."""
    log_w = np.random.default_rng(2).standard_normal(400)
    stuck = np.where(np.arange(400) < 100, log_w.max() + 1.0, log_w)
    assert pareto_k(stuck) == np.inf
    assert pareto_k(np.full(400, 3.0)) == -np.inf
    assert -0.5 < pareto_k(log_w) < 0.7
