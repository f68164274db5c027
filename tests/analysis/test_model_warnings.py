"""Warnings on the model: draws at bounds, shapes unlike the measured ones, maxima that a search missed."""

import numpy as np
import pytest
import xarray as xr

import fmu
from fmu.analysis.convergence.diagnosis import judge
from fmu.analysis.fit.measured_shapes import shape_warnings
from fmu.analysis.prediction import bound_warnings, pinned_parameters, search_warnings
from fmu.analysis.trace.conversion import to_trace
from fmu.analysis.trace.modal_states import MEASURED


@pytest.fixture
def trace_of(make_result, problem):
    """A trace of the linear problem with E1, whose bounds are ∓4, as given: shape (chains, draws)."""

    def make(first):
        position = np.stack([first, np.zeros_like(first)], axis=-1)
        return to_trace(make_result(position), problem)

    return make


@pytest.fixture
def rng():
    return np.random.default_rng(61)


def test_draws_at_the_upper_bound(trace_of, rng):
    (found,) = bound_warnings(trace_of(4.0 - np.abs(0.3 * rng.standard_normal((4, 500)))))
    assert found.startswith("E1: 4")
    assert found.endswith("% of the draws (prior: 0 %) lie within 2 % of the range from the upper bound, 4 Pa")


def test_draws_at_the_lower_bound(trace_of, rng):
    (found,) = bound_warnings(trace_of(-4.0 + rng.exponential(0.2, (4, 500))))
    assert found.startswith("E1: ")
    assert found.endswith(" lie within 2 % of the range from the lower bound, -4 Pa")


@pytest.mark.parametrize("gains", [True, False])
def test_a_loss_at_its_lower_bound_is_a_gain_that_the_bound_excludes(make_result, rng, gains):
    """At its upper bound nearly all is lost, and nothing lies beyond."""
    model = fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)])
    tests = [fmu.Test(name, fmu.ModalData([0.16], sd_hz=0.001), group=name) for name in ("before", "after")]
    k = fmu.Parameter("k", 1.0, 0.2, 3.0)
    problem = fmu.JointProblem(model, tests, [k], varies={"k": fmu.Damage()}, pairing="index")
    beyond = rng.exponential(0.005, (4, 500))
    loss = beyond - 0.5 if gains else 0.95 - beyond
    draws = np.stack([1.0 + 0.1 * rng.standard_normal((4, 500)), loss], axis=-1)
    trace = to_trace(make_result(draws), problem)
    (said,) = bound_warnings(trace)
    assert said.startswith("k loss [after]: ")
    assert ('give it varies = "group"' in said) is gains
    assert pinned_parameters(trace) == (["k loss [after]"] if gains else [])


@pytest.mark.parametrize(
    "first",
    [
        lambda rng: rng.uniform(-4.0, 4.0, (4, 500)),  # 2 % are near each bound, as of the prior
        lambda rng: 3.9 + 0.02 * rng.standard_normal((4, 500)),  # narrow, and five standard deviations from it
        lambda rng: rng.standard_normal((4, 500)),
    ],
    ids=["everywhere", "near but not at", "inside"],
)
def test_draws_that_the_bound_does_not_hold_back(trace_of, rng, first):
    assert bound_warnings(trace_of(np.clip(first(rng), -4.0, 4.0))) == []


def test_a_prior_that_is_at_the_bound_itself(trace_of, rng):
    trace = trace_of(4.0 - np.abs(0.3 * rng.standard_normal((4, 500))))
    trace["prior"]["E1"] = trace["prior"]["E1"] * 0.0 + 3.95
    assert bound_warnings(trace) == []


def test_unbounded_parameters_and_plain_densities(make_trace, rng):
    assert bound_warnings(make_trace(rng.standard_normal((4, 500, 2)))) == []


def test_a_draw_above_all_maxima(make_trace, rng):
    trace = make_trace(rng.standard_normal((4, 50, 2)), lp=np.linspace(-9.0, -3.0, 50))
    assert search_warnings(trace, -2.9) == []
    assert search_warnings(trace, -3.0) == []
    (found,) = search_warnings(trace, -3.5)
    assert "log-probability -3.0, above the highest maximum found, -3.5" in found


def with_mac(trace, reference):
    """Return a trace that keeps MAC at two states: at most 0.6 before, 0.95 and 0.79 after updating."""
    values = np.array([[[0.6, 0.3], [0.2, 0.5]], [[0.95, 0.85], [0.1, 0.79]]])
    mac = xr.DataArray(values, dims=("state", "reference_mode", "mode"), attrs={"reference": reference})
    coords = {"state": ["start", "posterior mean"], "reference_mode": ["a", "b"], "mode": ["a", "b"]}
    kept = trace.copy()
    kept["modes"] = xr.DataTree(xr.Dataset({"mac": mac}, coords=coords))
    return kept


def test_a_shape_that_is_not_the_measured_one_is_named(make_trace, rng):
    trace = with_mac(make_trace(rng.standard_normal((4, 50, 2))), MEASURED)
    expected = "mode b does not match the measured shape: MAC 0.50 before and 0.79 after updating, below 0.8"
    assert shape_warnings(trace) == [expected]
    assert expected in judge(trace).warnings


def test_where_no_shapes_were_measured_none_can_be_missed(make_trace, rng):
    trace = make_trace(rng.standard_normal((4, 50, 2)))
    assert shape_warnings(trace) == []
    assert shape_warnings(with_mac(trace, "modes before updating, at all translations")) == []
