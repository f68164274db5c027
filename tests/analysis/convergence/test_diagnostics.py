import json

import numpy as np
import pytest

from fmu.analysis.convergence import effective
from fmu.analysis.convergence.diagnosis import draws_missing
from fmu.analysis.convergence.diagnostics import (
    autocorrelation_times_run,
    convergence_failures,
    is_beyond_draws,
    rhat_over_walkers,
    summary,
    walkers_stay_apart,
)
from fmu.analysis.trace.conversion import to_trace


@pytest.fixture
def good():
    return np.random.default_rng(21).standard_normal((4, 500, 2))


@pytest.fixture
def good_ensembles(ar1):
    """Four ensembles of 10 walkers, 100 autocorrelation times: (ensembles, steps, walkers, ndim)."""
    return ar1(np.random.default_rng(22), (4, 900, 10, 2), 0.8)


def flat(ensembles):
    return ensembles.reshape(len(ensembles), -1, ensembles.shape[-1])


def test_summary_by_hand(make_result, problem, good):
    position = good / 10 + [1.0, 2.0]
    table = summary(to_trace(make_result(position), problem), ci_prob=0.8)
    assert list(table.columns) == [
        "mean",
        "sd",
        "eti80_lb",
        "eti80_ub",
        "rhat",
        "ess_bulk",
        "ess_tail",
        "mcse_mean",
        "mcse_eti80_lb",
        "mcse_eti80_ub",
    ]
    assert list(table.index) == ["E1", "rho"]
    assert table.attrs["units"] == {"E1": "Pa", "rho": "kg/m³"}
    x = position[..., 1]
    expected = [np.mean(x), np.std(x, ddof=1), *np.quantile(x, [0.1, 0.9]), effective.rhat(x)]
    expected += [effective.ess_bulk(x), effective.ess_tail(x), effective.mcse_mean(x)]
    expected += [effective.mcse_quantile(x, p) for p in (0.1, 0.9)]
    np.testing.assert_allclose(table.loc["rho"].to_numpy(dtype=float), expected, rtol=1e-14)


def test_interval_columns_carry_the_probability(make_trace, good):
    assert {"eti90_lb", "eti90_ub"} <= set(summary(make_trace(good)).columns)
    assert {"eti95.5_lb", "eti95.5_ub"} <= set(summary(make_trace(good), ci_prob=0.955).columns)


@pytest.mark.parametrize("ci_prob", [0, 1, -0.1, 90])
def test_interval_probability_out_of_range(make_trace, good, ci_prob):
    with pytest.raises(ValueError, match=r"ci_prob: must lie between 0 and 1 \(got"):
        summary(make_trace(good), ci_prob=ci_prob)


def test_what_is_no_trace_is_refused():
    with pytest.raises(ValueError, match="trace: must be a trace, as"):
        summary({"posterior": 1})


def test_summary_of_ensembles_uses_their_autocorrelation_time(make_trace, good_ensembles):
    table = summary(make_trace(flat(good_ensembles), walkers=10))
    for j, name in enumerate(("x0", "x1")):
        x = flat(good_ensembles)[..., j]
        tau = effective.autocorrelation_times(x, 10)
        assert table.loc[name, "ess_bulk"] == pytest.approx(np.sum(9000 / tau))
        assert table.loc[name, "mcse_mean"] == pytest.approx(
            table.loc[name, "sd"] / table.loc[name, "ess_bulk"] ** 0.5
        )
        assert table.loc[name, "rhat"] == effective.rhat(x)


def test_run_length_is_that_of_the_slowest_ensemble(make_trace, ar1):
    rng = np.random.default_rng(23)
    x = np.concatenate([ar1(rng, (1, 2000, 10, 2), phi) for phi in (0.0, 0.9, 0.5)])
    lengths = autocorrelation_times_run(make_trace(flat(x), walkers=10))
    np.testing.assert_allclose(lengths, 2000 / 19, rtol=0.35)


def test_rhat_over_walkers_finds_a_single_trapped_walker(make_trace, good_ensembles):
    x = good_ensembles
    x[2, :, 7, 1] += 30.0  # one walker of one ensemble, in the second parameter
    values = rhat_over_walkers(make_trace(flat(x), walkers=10))
    assert values[0] < 1.05 < 1.15 < values[1]
    assert values[0] == max(effective.rhat(ensemble.T) for ensemble in x[..., 0])


def test_good_chains_have_converged(make_trace, good):
    assert convergence_failures(make_trace(good)) == []


def test_one_chain_cannot_show_convergence(make_trace):
    position = np.random.default_rng(24).standard_normal((1, 4000, 2))
    failures = convergence_failures(make_trace(position))
    assert failures[0] == "1 chain; at least 2 are needed: --chains 4"
    assert failures[1] == "x0: R-hat is nan; it must be below 1.01"


def test_shifted_chain_is_found(make_trace, good):
    good[3, :, 1] += 1.0
    failures = convergence_failures(make_trace(good))
    assert ": R-hat is 1." in failures[0]
    assert "x1: R-hat is " in failures[0]
    assert "it must be below 1.01" in failures[0]


def test_correlated_chains_have_too_few_effective_draws(make_trace, ar1):
    position = ar1(np.random.default_rng(25), (2, 100_000, 2), 0.998)
    failures = convergence_failures(make_trace(position))
    assert any(": bulk ESS is " in f and "; at least 400 are needed" in f for f in failures)


def test_every_chain_owes_a_hundred_effective_draws(make_trace):
    position = np.random.default_rng(26).standard_normal((8, 90, 2))  # 720 in all
    failures = convergence_failures(make_trace(position))
    assert any(": bulk ESS is " in f and "; at least 800 are needed" in f for f in failures)


def test_tail_counts_by_itself(make_trace):
    rng = np.random.default_rng(27)
    position = rng.standard_normal((4, 500, 2))
    table = summary(make_trace(position))
    table.loc["x1", "ess_tail"] = 399.0
    assert convergence_failures(make_trace(position), table) == [
        "x1: tail ESS is 399; at least 400 are needed; about 660 draws are needed: leave out --draws, "
        "or --draws 660 (Python: until_ess=400 or draws=660)"
    ]


@pytest.fixture
def with_mixture(make_trace):
    """A trace of 4 chains with a candidate of a mixture in every other step, and the weights of its components."""

    def make(draws, *weights):
        position = np.random.default_rng(28).standard_normal((4, draws, 2))
        trace = make_trace(position, candidate_log_weight=np.where(np.arange(draws) % 2, 0.0, np.nan))
        trace.attrs["learnt"] = json.dumps({"weights": weights[0] if len(weights) == 1 else weights})
        trace.attrs["groups"] = len(weights)
        return trace

    return make


def test_each_component_of_a_mixture_needs_candidates(with_mixture):
    """Chains that none of the few candidates has taken to a maximum agree on their share of it."""
    assert convergence_failures(with_mixture(500, [0.98, 0.02])) == []
    assert convergence_failures(with_mixture(498, [0.98, 0.02])) == [
        "of 996 candidates, 20 are expected at the component with 2 % of the mixture, and all chains may have "
        "missed it; at least 1 000 candidates are needed; about 650 draws are needed: leave out --draws, or "
        "--draws 650 (Python: until_ess=400 or draws=650)"
    ]
    assert draws_missing(with_mixture(498, [0.98, 0.02]), 400, None) == 10
    assert draws_missing(with_mixture(500, [0.98, 0.02]), 400, None) == 0


@pytest.mark.parametrize(("share", "draws"), [(0.3, 34), (0.01, 1000), (0.002, 1000), (9e-4, 21)])
def test_a_component_of_hardly_any_weight_does_not_matter(with_mixture, share, draws):
    """Between 0.1 % and 1 % it counts as 1 %, since its share may have been underestimated."""

    def failures(draws, *weights):
        return [
            failure for failure in convergence_failures(with_mixture(draws, *weights)) if "candidate" in failure
        ]

    for weights in (
        [[1.0 - share, share]],
        [[0.5, 0.5], [1.0 - share, share]],
    ):  # of one group of chains, and of two
        assert failures(draws, *weights) == []
        if share > 1e-3:
            assert len(failures(draws - 2, *weights)) == 1


@pytest.mark.parametrize("column", ["rhat", "ess_bulk", "ess_tail"])
def test_nan_is_a_failure(make_trace, good, column):
    trace = make_trace(good)
    table = summary(trace)
    table.loc["x1", column] = np.nan
    (failure,) = convergence_failures(trace, table)
    assert failure.startswith("x1: ")
    assert " is nan; " in failure


def test_chains_that_stand_still_have_not_converged(make_trace):
    failures = convergence_failures(make_trace(np.zeros((4, 500, 2))))
    assert failures[0] == ("chain 0 does not move for 500 of its 500 draws; lengthen the warm-up: --warmup 1000")
    assert [f.split(" is nan")[0] for f in failures[1:]] == [
        "x0: R-hat",
        "x0: bulk ESS",
        "x0: tail ESS",
        "x0: MCSE over sd",
        "x0: MCSE of the 5 % quantile over sd",
        "x0: MCSE of the 95 % quantile over sd",
    ]


def test_good_ensembles_have_converged(make_trace, good_ensembles):
    assert convergence_failures(make_trace(flat(good_ensembles), walkers=10)) == []


def test_three_ensembles_are_too_few(make_trace, good_ensembles):
    failures = convergence_failures(make_trace(flat(good_ensembles[:3]), walkers=10))
    assert failures == ["3 ensembles; at least 4 are needed: --chains 4"]


def test_short_ensembles_have_not_converged(make_trace, good_ensembles):
    # 300 steps are about 33 autocorrelation times: R-hat and ESS alone would let this pass.
    failures = convergence_failures(make_trace(flat(good_ensembles[:, :300]), walkers=10))
    assert len(failures) == 1  # R-hat over walkers, also above its limit, would say nothing else
    assert failures[0].startswith("x0: the run is 25")
    assert "; about " in failures[0]
    assert " steps are needed: leave out --draws, or --draws " in failures[0]


def test_walkers_in_separate_modes_in_equal_proportion_have_not_converged(make_trace, good_ensembles):
    good_ensembles[:, :, ::2] += 20.0
    trace = make_trace(flat(good_ensembles), walkers=10)
    assert summary(trace)["rhat"].max() < 1.01  # the false calm of R-hat over ensembles
    failures = convergence_failures(trace)
    assert ": R-hat over walkers is 1." in failures[0]
    assert failures[0].endswith(
        "; it must be below 1.05: walkers stay in separate places; use "
        "parallel tempering, which moves between maxima: --sampler tempering"
    )
    assert any(": the run is " in f and "autocorrelation times long" in f for f in failures)
    assert not any("--draws" in f for f in failures)


@pytest.mark.parametrize("steps", [80, 300, 900])
def test_walkers_that_mix_and_walkers_that_do_not_are_told_apart(make_trace, good_ensembles, steps):
    x = good_ensembles[:, :steps]
    for offset, are_apart in ((0.0, False), (30.0, True)):
        trace = make_trace(flat(x + offset * np.arange(10)[:, None]), walkers=10)
        assert walkers_stay_apart(trace, autocorrelation_times_run(trace)) is are_apart


def test_a_run_too_short_to_tell_has_one_maximum_to_be_around(make_trace, good_ensembles):
    trace = make_trace(flat(good_ensembles[:, :40]), walkers=10)  # less than three autocorrelation times
    assert "walkers stay in separate places" in convergence_failures(trace)[0]
    (failure,) = [f for f in convergence_failures(trace, places="one") if "--draws" in f]
    assert "; at least " in failure


def test_no_number_of_draws_is_promised_where_a_maximum_was_missed(make_trace, good_ensembles):
    trace = make_trace(flat(good_ensembles[:, :300]), walkers=10)
    (failure,) = convergence_failures(trace, places="missed")
    assert failure.endswith("autocorrelation times long; 50 are needed")


def test_chain_that_stands_still_for_long_is_named(make_trace, good):
    good[2, 100:199] = good[2, 100]
    assert not any("does not move" in f for f in convergence_failures(make_trace(good)))
    good[2, 100:200] = good[2, 100]
    failures = convergence_failures(make_trace(good))
    assert failures[0].startswith("chain 2 does not move for 100 of its 500 draws; ")


def test_walker_that_stands_still_is_named(make_trace, good_ensembles):
    good_ensembles[1, 300:500, 7] = good_ensembles[1, 300, 7]
    failures = convergence_failures(make_trace(flat(good_ensembles), walkers=10))
    assert failures[0].startswith("walker 7 of ensemble 1 does not move for 200 of its 900 draws; ")


def test_short_runs_are_not_called_standing(make_trace):
    position = np.random.default_rng(28).standard_normal((4, 30, 2))
    position[0, :19] = position[0, 0]
    assert not any("does not move" in f for f in convergence_failures(make_trace(position)))


def test_standard_error_is_held_against_the_sd(make_trace, good):
    trace = make_trace(good)
    table = summary(trace)
    table.loc["x1", "mcse_mean"] = 0.11 * table.loc["x1", "sd"]
    assert convergence_failures(trace, table) == [
        "x1: MCSE over sd is 0.110; it must be below 0.1; about 790 draws are needed: leave out --draws, "
        "or --draws 790 (Python: until_ess=400 or draws=790)"
    ]
    table.loc["x1", "mcse_mean"] = np.nan
    assert convergence_failures(trace, table) == ["x1: MCSE over sd is nan; it must be below 0.1"]


@pytest.mark.parametrize(("column", "end"), [("mcse_eti90_lb", "5"), ("mcse_eti90_ub", "95")])
def test_standard_error_of_an_end_is_held_against_the_sd(make_trace, good, column, end):
    trace = make_trace(good)
    table = summary(trace)
    assert convergence_failures(trace, table) == []
    table.loc["x1", column] = 0.132 * table.loc["x1", "sd"]
    assert convergence_failures(trace, table) == [
        f"x1: MCSE of the {end} % quantile over sd is 0.132; it must be below 0.12; about 790 draws are needed: "
        "leave out --draws, or --draws 790 (Python: until_ess=400 or draws=790)"
    ]
    table.loc["x1", column] = np.nan
    assert convergence_failures(trace, table) == [
        f"x1: MCSE of the {end} % quantile over sd is nan; it must be below 0.12"
    ]


def test_divergences(make_trace, good):
    two, three = (np.arange(500) < n for n in (0, 3))
    assert convergence_failures(make_trace(good, diverging=two)) == []
    assert convergence_failures(make_trace(good, diverging=three)) == [
        "12 of 2000 trajectories diverged, and more draws do not help; use a shorter step: "
        "fmu.HamiltonianMonteCarlo(target_accept=0.95)"
    ]
    one = np.zeros((4, 500), dtype=bool)
    one[0, :2] = True
    assert convergence_failures(make_trace(good, diverging=one)) == []


def test_energies_that_are_not_explored(make_trace, good, ar1):
    rng = np.random.default_rng(29)
    fresh = rng.standard_normal((4, 500))
    assert convergence_failures(make_trace(good, energy=fresh)) == []
    fresh[2] = ar1(rng, (1, 500), 0.95)[0]
    (failure,) = convergence_failures(make_trace(good, energy=fresh))
    assert failure.startswith("chain 2: E-BFMI is 0.")
    assert failure.endswith("; at least 0.3 is needed")
    fresh[2] = 1.0
    (failure,) = convergence_failures(make_trace(good, energy=fresh))
    assert failure == "chain 2: E-BFMI is nan; at least 0.3 is needed"


def test_the_remedy_for_divergences_is_for_the_sampler_that_ran(make_trace, good):
    """Candidates of a mixture are no trajectories, and Hamiltonian steps may be short already."""
    diverging = np.arange(500) % 100 == 0
    candidate = np.where(np.arange(500) % 4 == 1, 0.0, np.nan)
    trace = make_trace(good, diverging=diverging, candidate_log_weight=candidate, sampler="mixture")
    trace.attrs["settings"] = '{"weights": [1.0], "components": null}'
    (said,) = convergence_failures(trace)
    assert said == (
        "20 of 1500 trajectories diverged, and more draws do not help; if one parameter sets the width of others, "
        "sample their ratios to that width instead of them"
    )
    # where most steps are candidates, their weights tell how well they fit
    candidate = np.where(diverging | (np.arange(500) % 10 == 0), np.nan, 0.0)
    mostly = make_trace(good, diverging=diverging, candidate_log_weight=candidate, sampler="mixture")
    mostly.attrs["settings"] = trace.attrs["settings"]
    assert convergence_failures(mostly) == []
    short = make_trace(good, diverging=diverging, sampler="hmc")
    short.attrs["learnt"] = '{"target_accept": [0.8, 0.95]}'
    other = "take the default sampler, the mixture; if one parameter"
    assert convergence_failures(short) == [said.replace("of 1500", "of 2000").replace("if one parameter", other)]


def test_draws_do_not_cure_divergences(make_trace, good):
    """Whatever else is missing, a run with them is not continued; with a few, which may be chance, it is."""
    for n, continued in ((0, True), (1, True), (12, False)):
        trace = make_trace(good[:, :50], diverging=np.arange(200).reshape(4, 50) < n)
        assert (draws_missing(trace, 400, None) > 0) == continued


def test_weights_of_a_curved_mixture_may_have_no_heavy_tail(make_trace, good):
    """R-hat does not show the places that its candidates hardly reach."""
    rng = np.random.default_rng(3)
    for kind, log_w, converged in (
        ("CurvedMixture", rng.standard_normal((4, 500)), True),
        ("CurvedMixture", rng.standard_exponential((4, 500)), False),
        ("Quadratic", rng.standard_exponential((4, 500)), True),
    ):
        trace = make_trace(good, candidate_log_weight=log_w, sampler="mixture")
        components = {"type": kind}
        components = components if kind == "CurvedMixture" else [components]
        trace.attrs["settings"] = json.dumps({"weights": [1.0], "components": components})
        said = convergence_failures(trace)
        assert (said == []) == converged
        assert is_beyond_draws(trace) != converged
        if not converged:
            assert said[0].startswith("Pareto k ")
            assert "more draws do not help; lengthen the warm-up: --warmup 1000; or if one parameter" in said[0]
