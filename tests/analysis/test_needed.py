"""How many draws are missing: predicted from the effective sample size so far, on tables made by hand."""

import numpy as np
import pandas as pd
import pytest

from fmu.analysis.convergence.remedies import (
    draws_to_come,
    for_too_few_draws,
    growth_needed,
    in_two_digits,
    required_ess,
)


def table(ess, rhat=1.002, mcse=0.01, tail=None):
    """Two parameters, the first of which is known twice as well."""
    tail = ess if tail is None else tail
    columns = {"ess_bulk": [2 * ess, ess], "ess_tail": [2 * tail, tail], "rhat": [1.0, rhat]}
    return pd.DataFrame(columns | {"mcse_mean": [mcse, mcse], "sd": [1.0, 1.0]}, index=["a", "b"])


def test_required_is_400_and_100_a_chain():
    assert [required_ess(chains) for chains in (2, 4, 8)] == [400, 400, 800]


def test_the_scarcest_of_all_criteria_counts():
    assert growth_needed(table(800), 400) == 0.5
    assert growth_needed(table(800, tail=200), 400) == 2.0
    assert growth_needed(table(800, mcse=0.2), 400) == pytest.approx(4.0)
    assert growth_needed(table(800), 400, np.array([25.0, 10.0])) == 5.0
    assert np.isnan(growth_needed(table(np.nan), 400))


@pytest.mark.parametrize(
    ("found", "missing"),
    [
        (table(900), 134),  # 1000·(1.02·1000/900 − 1), rounded up
        (table(990), 50),  # a twentieth at least
        (table(600), 700),
        (table(250), 2264),  # four fifths of 4080 first, as it more than doubles the run
        (table(450), 1000),
        (table(60), 3000),  # no further than four times the run at once
        (table(49), 1000),  # too few to predict from
        (table(np.nan), 1000),
        (table(2000, rhat=1.011), 100),
        (table(2000, rhat=1.04), 150),
        (table(2000), 1000),  # no number of draws is known to help
        (table(2000, rhat=np.nan), 1000),
    ],
)
def test_draws_to_come(found, missing):
    assert draws_to_come(1000, found, 1000.0, None, None) == pytest.approx(missing, abs=1)


def test_ensembles_need_fifty_autocorrelation_times_and_walkers_that_mix():
    lengths, mixed = np.array([40.0, 60.0]), np.array([1.0, 1.02])
    assert draws_to_come(1000, table(5000), 400.0, lengths, mixed) == 275
    assert draws_to_come(1000, table(5000), 400.0, 2 * lengths, mixed) == 1000
    assert draws_to_come(1000, table(5000), 400.0, 2 * lengths, np.array([1.0, 1.06])) == 150


def test_predicted_draws_reach_the_goal_and_little_more():
    """A hundred runs of four chains of an autocorrelation time of 9 steps, their ESS known to some percent."""
    rng, goal = np.random.default_rng(61), 1000.0
    reached = []
    for _ in range(100):
        draws = 300
        while True:
            exact = 4 * draws / 9
            ess = exact * (1 + 0.8 * rng.standard_normal() / np.sqrt(draws / 9))
            if ess >= goal:
                break
            draws += draws_to_come(draws, table(ess), goal, None, None)
        reached.append(exact / goal)
    assert np.median(reached) < 1.15
    assert np.min(reached) > 0.85


@pytest.mark.parametrize(("draws", "rounded"), [(3327, 3400), (3400, 3400), (99, 99), (7.2, 8), (100.1, 110)])
def test_two_digits(draws, rounded):
    assert in_two_digits(draws) == rounded


class TestRemedy:
    @pytest.fixture
    def trace(self, make_trace):
        return make_trace(np.random.default_rng(62).standard_normal((4, 1000, 2)))

    def test_how_many_draws(self, trace):
        said = for_too_few_draws(trace, table(120), 400)
        assert said == "; about 3400 draws are needed: --draws 3400, or --until-ess 400"
        said = for_too_few_draws(trace, table(380, rhat=1.02), 400)
        assert said == "; about 2000 draws are needed: --draws 2000, or --until-ess 400"

    def test_how_many_steps_of_an_ensemble(self, trace):
        said = for_too_few_draws(trace, table(900), 400, np.array([8.0, 9.0]), np.array([1.1, 1.0]))
        assert said == "; about 6300 steps are needed: --draws 6300, or --until-ess 400"

    def test_what_does_not_exist_has_no_remedy(self, trace):
        assert for_too_few_draws(trace, table(np.nan, rhat=np.nan), 400) == ""

    @pytest.mark.parametrize("rhat", [2.5, np.inf])
    def test_chains_that_are_apart_need_something_else(self, trace, rhat):
        said = for_too_few_draws(trace, table(7, rhat=rhat), 400)
        assert said == "; use parallel tempering, which moves between maxima: --sampler tempering"
        trace["observed_data"] = trace["constant_data"]  # as a problem with a measurement has
        said = for_too_few_draws(trace, table(7, rhat=rhat), 400)
        assert said == '; start the chains at the posterior maxima: init="maxima" (--init maxima)'
