"""Where the misfit lives: the probability that a scatter is needed, the largest one, and widths of intervals."""

import json

import numpy as np
import pytest
import xarray as xr

from fmu.analysis.models.scatter import (
    interval_ratios,
    needed_probability,
    ratio_words,
    scatter_table,
    scatter_words,
    scatters,
)

SD = 0.1


def half_normal(rng, sd, shape=(4, 2000)):
    return np.abs(rng.normal(0.0, sd, shape))


@pytest.mark.parametrize("narrower", [1.0, 3.0, 10.0])
def test_the_probability_is_that_of_the_densities_at_zero(narrower):
    """A half-normal posterior: its density at 0 is `narrower` times that of the prior."""
    found = needed_probability(half_normal(np.random.default_rng(1), SD / narrower), SD)
    assert found == pytest.approx(1 / (1 + narrower), rel=0.08)


def test_a_scatter_far_from_zero_is_needed_but_not_surer_than_the_draws():
    draws = np.random.default_rng(2).normal(0.1, 0.01, (4, 500))
    found = needed_probability(draws, SD)
    assert 0.99 < found < 1 - SD / (2000 * 0.1)
    assert np.isnan(needed_probability(np.full((4, 500), 0.1), SD))


def trace_of(draws):
    """Return a trace with two groups of parameters of which τ has the given draws."""
    names = ["k1", "k2", "k3", "tau a", "tau b"]
    prior = {"distribution": "half-normal", "sd": SD, "at": 0.0}
    rng = np.random.default_rng(3)
    values = {name: rng.normal(1.0, 0.05, (4, 500)) for name in names[:3]} | draws
    parameters = [{"name": name, "prior": prior if name.startswith("tau") else {}} for name in names]
    likelihood = {
        "noise": ["sigma", "tau a", "tau b"],
        "discrepancy": [{"kind": "embedded", "names": names[:3], "inferred": [1, 2, 1]}],
    }
    trace = xr.DataTree.from_dict(
        {"posterior": xr.Dataset({name: (("chain", "draw"), x) for name, x in values.items()})}
    )
    trace.attrs["configuration"] = json.dumps({"problem": {"parameters": parameters, "likelihood": likelihood}})
    return trace


def test_the_group_that_scatters_is_named():
    rng = np.random.default_rng(4)
    found = scatters(
        trace_of({"tau a": half_normal(rng, 0.01, (4, 500)), "tau b": rng.normal(0.2, 0.02, (4, 500))})
    )
    assert [one.parameters for one in found] == [("k1", "k3"), ("k2",)]
    a, b = found
    assert (a.needed < 0.2, b.needed > 0.95, a.largest, b.largest) == (True, True, 0.0, 1.0)
    assert b.median == pytest.approx(0.2, abs=0.005)
    said = scatter_words(found)
    assert said[0].startswith("k1 and k3 together: needs no scatter, as far as the data tell (probability ")
    assert said[1].startswith("k2: needs a scatter (probability 9")
    assert said[2].startswith("The misfit lives in k2: its scatter is the largest with a probability of ")
    assert scatter_table(found).loc["tau a", "parameters"] == "k1, k3"


def test_groups_that_the_data_do_not_tell_apart_are_not_named():
    rng = np.random.default_rng(5)
    found = scatters(trace_of({name: half_normal(rng, SD, (4, 500)) for name in ("tau a", "tau b")}))
    said = scatter_words(found)
    assert all("the data do not tell whether it needs a scatter" in one for one in said[:2])
    assert said[2].startswith("Where the misfit lives is not sure. Probability of the largest scatter: ")
    assert sum(one.largest for one in found) == pytest.approx(1.0)
    assert scatter_words(()) == []


def test_widths_of_intervals_are_compared(monkeypatch):
    import pandas as pd

    widths = {"narrow": [1.0, 2.0], "wide": [3.0, 2.5]}

    def summary(name):
        return pd.DataFrame({"eti90_lb": [0.0, 0.0], "eti90_ub": widths[name]}, index=["k1", "k2"])

    monkeypatch.setattr("fmu.analysis.models.scatter.summary", summary)
    monkeypatch.setattr("fmu.analysis.models.scatter.parameter_names", lambda trace: ("k1", "k2"))
    found = interval_ratios({"narrow": "narrow", "wide": "wide"}, "narrow")
    assert found["wide"].tolist() == [3.0, 1.25]
    assert ratio_words(found, "narrow") == [
        "wide: the 90 % intervals of the parameters are 1.2 to 3 times as wide as with narrow, k1 the most."
    ]
