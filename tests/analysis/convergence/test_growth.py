"""The criterion that is the same for every sampler, and the counts of what it took to meet it."""

import numpy as np
import pytest

from fmu.analysis.convergence.comparison import at_both_points, cost_rows, costs_side_by_side
from fmu.analysis.convergence.diagnostics import convergence_failures, summary
from fmu.analysis.convergence.growth import growth, solves_to_criterion
from fmu.analysis.convergence.remedies import meets_criterion, rhat_excess
from fmu.analysis.trace.conversion import to_trace

OF_WARMUP, A_STEP = 4 * 2, 4  # the fixture's warm-up, and a draw of each of four chains


def correlated(rng, chains, draws, share):
    """Draws of an AR(1) process of unit variance, (chains, draws, 2)."""
    z = rng.standard_normal((chains, draws, 2))
    for k in range(1, draws):
        z[:, k] = share * z[:, k - 1] + np.sqrt(1 - share**2) * z[:, k]
    return z


@pytest.fixture
def slow(make_trace):
    return make_trace(correlated(np.random.default_rng(5), 4, 2000, 0.7))


def test_it_is_r_hat_and_both_sizes_whatever_the_sampler():
    assert meets_criterion(0.99, 400.0, 4)
    assert not meets_criterion(1.0, 400.0, 4)
    assert not meets_criterion(0.0, 399.9, 4)
    assert not meets_criterion(np.nan, 500.0, 4)
    assert not meets_criterion(0.0, 500.0, 8)  # a hundred per chain


def test_the_last_length_is_the_whole_run(slow):
    grown, table = growth(slow), summary(slow)
    assert grown.steps[-1] == 2000
    assert grown.ess[-1] == table[["ess_bulk", "ess_tail"]].to_numpy().min()
    assert grown.excess[-1] == rhat_excess(table) == (table["rhat"].max() - 1.0) / (1.01 - 1.0)
    assert grown.solves[-1] == slow.attrs["n_solves"] + slow.attrs["warmup_n_solves"]
    assert np.all(np.diff(grown.solves) > 0)


def test_the_first_length_that_meets_it_is_found_between_two(slow):
    solves = solves_to_criterion(slow)
    steps = int((solves - 3 * OF_WARMUP) / (3 * A_STEP))
    grown = growth(slow)
    met = [meets_criterion(r, e, 4) for r, e in zip(grown.excess, grown.ess, strict=True)]
    k = met.index(True)
    assert grown.steps[k - 1] < steps <= grown.steps[k]
    found = growth(slow, np.array([steps]))
    assert meets_criterion(found.excess[0], found.ess[0], 4)
    assert found.solves[0] == solves


def test_a_run_that_never_meets_it_has_no_such_cost(make_trace):
    trace = make_trace(np.random.default_rng(6).standard_normal((4, 60, 2)))
    assert np.isnan(solves_to_criterion(trace))
    rows = cost_rows(costs_side_by_side({"a": trace}))
    assert ["whole run", "744"] in rows
    assert all(label != "to the criterion" for label, *_ in rows)


def test_everything_is_counted_and_the_baseline_is_one(make_result, plain, slow):
    """Warm-up, gradients at their cost, and the search, which is charged to each."""
    draws = np.random.default_rng(7).standard_normal((4, 3200, 2))
    emcee = to_trace(make_result(draws, walkers=8), plain)
    emcee.attrs["sampler"] = "emcee"
    slow.attrs["gradient_cost"] = 2.5
    table = costs_side_by_side({"hmc": slow, "emcee": emcee})
    assert table.loc["hmc", "total_solves"] == 3 * (8000 + OF_WARMUP) + 1.5 * 2 * (8000 + OF_WARMUP)
    ess = summary(slow)[["ess_bulk", "ess_tail"]].to_numpy().min()
    assert table.loc["hmc", "solves_per_ess"] == pytest.approx((3 + 1.5 * 2) * 8000 / ess)
    assert list(table.loc["emcee", ["criterion_over_baseline", "per_ess_over_baseline"]]) == [1.0, 1.0]
    for column, ratio in (
        ("criterion_solves", "criterion_over_baseline"),
        ("solves_per_ess", "per_ess_over_baseline"),
    ):
        assert table.loc["hmc", ratio] == table.loc["hmc", column] / table.loc["emcee", column]
    said = at_both_points(table, {"hmc": True, "emcee": False}, {"hmc": slow, "emcee": emcee})
    assert said.startswith("emcee met the criterion after ")
    assert "it had not converged after 38 600. To converge, an ensemble must also be 50 autocorr" in said
    assert at_both_points(table, {"hmc": True}, {"hmc": slow}) == ""


def test_the_solves_that_prepare_a_sampler_are_counted(slow):
    """A discrepancy's components are fitted by solves before the warm-up (`before_n_solves`)."""
    before = costs_side_by_side({"mixture": slow}).loc["mixture"]
    slow.attrs["before_n_solves"] = 37
    after = costs_side_by_side({"mixture": slow}).loc["mixture"]
    for column in ("criterion_solves", "total_solves"):
        assert after[column] == before[column] + 37
    assert after["solves_per_ess"] == before["solves_per_ess"]


@pytest.mark.parametrize("role", ["value", "score"])
def test_scores_of_tests_count_as_in_the_verdict(make_trace, role):
    """Their R-hat may be up to 1.05, and their ESS is not asked for."""
    draws = np.random.default_rng(9).standard_normal((4, 600, 2))
    draws[:, :, 1] = draws[:, :, 1].repeat(6, axis=1)[:, :600] + 0.2 * np.arange(4)[:, None]
    trace = make_trace(draws)
    roles = (
        trace["constant_data"]
        .to_dataset()
        .assign(
            role=("parameter", ["mean", role]),
            role_of=("parameter", ["x", "x"]),
            role_where=("parameter", ["", "t1"]),
        )
    )
    trace["constant_data"] = roles
    assert 1.01 < summary(trace)["rhat"]["x1"] < 1.05
    reasons = [said for said in convergence_failures(trace) if said.startswith("x1")]
    grown = growth(trace)
    assert (reasons == []) == np.isfinite(solves_to_criterion(trace)) == (role == "score")
    assert (grown.ess[-1] >= 400) == (role == "score")
