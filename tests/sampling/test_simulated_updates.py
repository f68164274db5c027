"""Why real and expected standard deviations of simulated tests differ."""

from dataclasses import replace

import numpy as np
import pytest

import fmu
from fmu.analysis.plan.result import PLANNED
from fmu.sampling.simulated_updates import (
    BENT,
    BOUNDS,
    CROSSING,
    NOISE,
    SHORT,
    TRUTH,
    SimulatedTests,
    Updates,
    summarise_update,
)


def updates(**changed):
    """Return one update with one parameter, as expected unless something is changed."""
    usual = {"real": 1.0, "at_truth": 1.0, "at_mean": 1.0, "at_bounds": 0.0, "skewness": 0.0}
    arrays = {name: np.array([[changed.get(name, value)]]) for name, value in usual.items()}
    return Updates(
        **arrays,
        crossed=np.array([changed.get("crossed", 0.0)]),
        converged=np.array([changed.get("converged", True)]),
    )


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"real": 0.5, "at_truth": 0.5, "at_mean": 0.5}, TRUTH),
        ({"real": 2.0, "at_mean": 2.0}, NOISE),
        ({"real": 0.5, "at_bounds": 0.3}, BOUNDS),
        ({"real": 2.0, "crossed": 0.3}, CROSSING),
        ({"real": 2.0, "skewness": 1.5}, BENT),
        ({"real": 2.0, "converged": False}, SHORT),
    ],
)
def test_the_factor_furthest_from_one_names_the_reason(changed, reason):
    found = SimulatedTests(("k",), {PLANNED: np.ones(1)}, {PLANNED: updates(**changed)})
    row = found.cases().iloc[0]
    assert row["reason"] == reason
    assert row["ratio"] == pytest.approx(row[TRUTH] * row[NOISE] * row["shape"], rel=1e-12)
    assert f"In 1 of them {'the' if reason != CROSSING else 'modes'}" in " ".join(found.sentences())


def test_agreement_needs_no_reason():
    found = SimulatedTests(("k",), {PLANNED: np.ones(1)}, {PLANNED: updates(real=1.2)})
    assert len(found.cases()) == 0
    assert len(found.sentences()) == 1


def test_ratios_without_a_value_come_first_and_then_the_worst():
    ratios = np.array([[0.1, 1.0, 20.0, np.nan, 1.5, 0.01, np.nan]])
    of = updates()
    at = {
        name: np.broadcast_to(getattr(of, name), ratios.shape)
        for name in ("at_truth", "at_mean", "at_bounds", "skewness")
    }
    found = SimulatedTests(tuple("abcdefg"), {PLANNED: np.ones(7)}, {PLANNED: replace(of, real=ratios, **at)})
    assert "".join(found.cases()["parameter"]) == "dgfcae"


def one_stiffness(*parameter):
    """Return the updating of one stiffness with two frequencies, known to 2 %."""
    model = fmu.SeparableModel.from_terms(["k"], [([[1e6, -5e5], [-5e5, 5e5]], "k")], [np.eye(2) * 1e3])
    parameters = [fmu.Parameter("k", 1.0, *parameter)]
    return fmu.UpdatingProblem(model, fmu.expected_modes(model, parameters, 2, 0.02), parameters)


def test_an_update_between_close_bounds_is_summarised():
    """One stiffness whose prior ends where the data leave half of the posterior."""
    problem = one_stiffness(0.99, 1.01, fmu.Normal(0.2, mean=1.0))
    plan = fmu.plan(problem, 2, draws=4, frequency_sd=0.02)
    found = fmu.simulate_plan(plan, 1, choices=[], draws=50)
    update = found.updates[PLANNED]
    assert update.converged.all()
    assert update.at_bounds[0, 0] == pytest.approx(0.04, abs=0.02)  # a nearly flat posterior: 2 % at each end
    assert update.real[0, 0] == pytest.approx(0.02 / np.sqrt(12.0), rel=0.1)
    assert update.at_mean[0, 0] == pytest.approx(plan.design.prior_sd[0], rel=0.1)


@pytest.mark.parametrize(
    "parameter", [(0.0, np.inf, fmu.LogNormal(1.0, 0.2)), (-np.inf, 1.5, fmu.Normal(0.2, mean=1.0))]
)
def test_no_draw_is_near_a_bound_that_is_far_if_the_other_is_infinite(parameter):
    problem = one_stiffness(*parameter)
    trace = fmu.sample(problem, "mh", draws=20, warmup=20, chains=2)
    update = summarise_update(problem, trace, np.ones(1), 0.2 * np.eye(1))
    np.testing.assert_array_equal(update.at_bounds, [0.0])
