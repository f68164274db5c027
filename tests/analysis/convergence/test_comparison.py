import dataclasses

import numpy as np
import pandas as pd
import pytest

import fmu
from fmu.analysis.convergence.comparison import compare
from fmu.analysis.convergence.diagnostics import convergence_failures, summary

COLUMNS = [
    "verdict",
    "rhat_max",
    "ess_bulk_min",
    "ess_tail_min",
    "mcse_over_sd_max",
    "accept_rate",
    "divergences",
    "n_solves",
    "n_gradients",
    "gradient_cost",
    "wall_s",
    "ess_per_solve",
    "ess_per_s",
    "search_solves",
    "criterion_solves",
    "total_solves",
    "solves_per_ess",
    "criterion_over_baseline",
    "per_ess_over_baseline",
]


@pytest.fixture
def good():
    return np.random.default_rng(31).standard_normal((4, 500, 2))


def test_row_by_hand(make_trace, good):
    good[..., 1] = np.repeat(good[:, ::2, 1], 2, axis=1)  # the worse parameter
    accepted = np.arange(500) % 4 == 0
    diverging = np.zeros((4, 500), dtype=bool)
    diverging[1, :2] = True
    trace = make_trace(good, accepted=accepted, diverging=diverging)
    table = compare({"mine": trace})
    assert list(table.columns) == COLUMNS
    assert list(table.index) == ["mine"]
    row, parts = table.loc["mine"], summary(trace)
    assert row["verdict"] == "converged locally"
    assert row["rhat_max"] == max(parts["rhat"])
    assert row["ess_bulk_min"] == parts.loc["x1", "ess_bulk"]
    assert row["ess_tail_min"] == min(parts["ess_tail"])
    assert row["mcse_over_sd_max"] == max(parts["mcse_mean"] / parts["sd"])
    assert row["accept_rate"] == 0.25
    assert row["divergences"] == 2
    assert row["n_solves"] == 4 * (500 + 2) * 3  # 3 a draw, two draws of warm-up
    assert row["n_gradients"] == 4 * (500 + 2) * 2
    assert row["wall_s"] == 2.0
    assert np.isnan(row["gradient_cost"])
    assert row["ess_per_solve"] == pytest.approx(row["ess_bulk_min"] / 6024)
    assert row["ess_per_s"] == pytest.approx(row["ess_bulk_min"] / 2.0)


def test_per_solve_a_gradient_counts_as_what_it_costs(make_trace, good):
    trace = make_trace(good)
    trace.attrs["gradient_cost"] = 2.5
    row = compare({"hmc": trace}).loc["hmc"]
    assert (row["n_solves"], row["n_gradients"], row["gradient_cost"]) == (6024, 4016, 2.5)
    assert row["ess_per_solve"] == pytest.approx(row["ess_bulk_min"] / (6024 + 1.5 * 4016))


def test_verdict_names_the_first_reason(make_trace, good):
    traces = {"a": make_trace(good), "b": make_trace(good[:1])}
    table = compare(traces)
    assert table.loc["a", "verdict"] == "converged locally"
    assert table.loc["b", "verdict"] == f"not converged: {convergence_failures(traces['b'])[0]}"


def test_divergences_are_missing_where_there_are_no_trajectories(make_trace, good):
    table = compare({"hmc": make_trace(good, diverging=False), "mh": make_trace(good)})
    assert table.loc["hmc", "divergences"] == 0
    assert table.loc["mh", "divergences"] is pd.NA


def test_nan_of_one_parameter_is_not_skipped(make_trace, good):
    good[..., 1] = 3.0
    row = compare({"stuck": make_trace(good)}).loc["stuck"]
    assert row["verdict"] == "not converged: x1: R-hat is nan; it must be below 1.01"
    for column in ("rhat_max", "ess_bulk_min", "ess_tail_min", "mcse_over_sd_max", "ess_per_solve", "ess_per_s"):
        assert np.isnan(row[column])


@pytest.mark.parametrize("traces", [{}, [], None])
def test_nothing_to_compare(traces):
    with pytest.raises(ValueError, match="traces: must be a mapping"):
        compare(traces)


def test_what_is_no_trace_is_named(make_trace, good):
    with pytest.raises(ValueError, match=r"traces\.b: must be a trace, as fmu.sample"):
        compare({"a": make_trace(good), "b": 3})


def test_cost_does_not_depend_on_the_chains_shape(make_result, plain):
    from fmu.analysis.trace.conversion import to_trace

    result = make_result(np.random.default_rng(32).standard_normal((4, 400, 2)), walkers=8)
    result = dataclasses.replace(result, wall_s=0.0)
    row = compare({"emcee": to_trace(result, plain)}).loc["emcee"]
    assert row["n_solves"] == 4 * (400 + 16) * 3
    assert np.isnan(row["ess_per_s"])


def test_a_problem_with_other_parameters_is_refused(make_trace, good):
    problem = fmu.cases.load("shear-2dof", pairing="index")
    with pytest.raises(
        ValueError, match=r"problem: must have the parameters of mine, .*x0.*x1.* \(got .*theta1.*theta2"
    ):
        compare({"mine": make_trace(good)}, problem)
