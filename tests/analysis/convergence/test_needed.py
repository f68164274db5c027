"""How many draws are missing: predicted from the effective sample size so far, on tables made by hand."""

import re

import numpy as np
import pandas as pd
import pytest

import fmu
from fmu.analysis.convergence.diagnosis import draws_missing
from fmu.analysis.convergence.diagnostics import autocorrelation_times_run, rhat_over_walkers, summary
from fmu.analysis.convergence.remedies import (
    draws_to_come,
    for_too_few_draws,
    growth_needed,
    in_two_digits,
    required_ess,
    rhat_excess,
)


def table(ess, rhat=1.002, mcse=0.01, tail=None, ends=(0.02, 0.02)):
    """Two parameters, the first of which is known twice as well."""
    tail = ess if tail is None else tail
    columns = {"ess_bulk": [2 * ess, ess], "ess_tail": [2 * tail, tail], "rhat": [1.0, rhat]}
    errors = {"mcse_eti90_lb": [0.02, ends[0]], "mcse_eti90_ub": [0.02, ends[1]]}
    return pd.DataFrame(columns | errors | {"mcse_mean": [mcse, mcse], "sd": [1.0, 1.0]}, index=["a", "b"])


def test_required_is_400_and_100_a_chain():
    assert [required_ess(chains) for chains in (2, 4, 8)] == [400, 400, 800]


def test_the_scarcest_of_all_criteria_counts():
    assert growth_needed(table(800), 400) == 0.5
    assert growth_needed(table(800, tail=200), 400) == 2.0
    assert growth_needed(table(800, mcse=0.2), 400) == pytest.approx(4.0)
    assert growth_needed(table(800, ends=(0.18, 0.13)), 400) == pytest.approx(2.25)
    assert growth_needed(table(800, ends=(0.06, 0.24)), 400) == pytest.approx(4.0)
    assert np.isnan(growth_needed(table(800, ends=(np.nan, 0.1)), 400))
    assert growth_needed(table(800), 400, np.array([25.0, 10.0])) == 5.0
    assert np.isnan(growth_needed(table(np.nan), 400))


@pytest.mark.parametrize(
    ("growth", "is_reliable", "excess", "missing"),
    [
        (1.09, True, 0.0, 101),  # 1000·(1.01·1.09 − 1), rounded up
        (1.002, True, 0.0, 20),  # a fiftieth at least
        (1.7, True, 0.0, 560),  # four fifths of what is missing
        (16.0, True, 9.0, 1000),  # no further than twice the run at once
        (16.0, False, 0.0, 1000),  # too few effective draws to predict from
        (np.nan, True, 0.0, 1000),
        (0.5, True, 1.02, 50),
        (0.5, True, 1.1, 100),
        (0.5, True, 4.0, 150),
        (0.5, True, 0.2, 1000),  # no number of draws is known to help
        (0.5, True, np.nan, 1000),
    ],
)
def test_draws_to_come(growth, is_reliable, excess, missing):
    assert draws_to_come(1000, growth, is_reliable, excess) == pytest.approx(missing, abs=1)


def test_excess_of_rhat():
    assert rhat_excess(table(500, rhat=1.03)) == pytest.approx(3.0)
    assert np.isnan(rhat_excess(table(500, rhat=np.nan)))


def test_a_run_is_looked_at_again_after_the_steps_that_it_lacks(make_trace, ar1):
    """Ensembles of some 30 autocorrelation times have effective draws in plenty, and too few steps."""
    x = ar1(np.random.default_rng(63), (4, 600, 10, 2), 0.9).reshape(4, -1, 2)
    trace = make_trace(x, walkers=10)
    missing = draws_missing(trace, 400, None)
    assert summary(trace)[["ess_bulk", "ess_tail"]].min().min() > 900
    assert missing == draws_to_come(600, 50 / autocorrelation_times_run(trace).min())
    assert 600 < 600 + missing < 1400


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
            draws += draws_to_come(draws, goal / ess, ess >= 50)
        reached.append(exact / goal)
    assert np.median(reached) < 1.06
    assert np.min(reached) > 0.85


@pytest.mark.parametrize(("draws", "rounded"), [(3327, 3400), (3400, 3400), (99, 99), (7.2, 8), (100.1, 110)])
def test_two_digits(draws, rounded):
    assert in_two_digits(draws) == rounded


class TestRemedy:
    @pytest.fixture
    def trace(self, make_trace):
        return make_trace(np.random.default_rng(62).standard_normal((4, 1000, 2)))

    def test_how_many_draws(self, trace):
        """Three tenths more than predicted, in two digits, as it is typed in the shell and in Python."""
        said = for_too_few_draws(trace, table(120), 400)
        assert said == (
            "; about 4400 draws are needed: leave out --draws, or --draws 4400 "
            "(Python: until_ess=400 or draws=4400)"
        )
        trace.attrs["limit"] = "20 000 solves"
        assert for_too_few_draws(trace, table(120), 400) == "; about 4400 draws are needed"
        del trace.attrs["limit"]
        said = for_too_few_draws(trace, table(380, rhat=1.02), 400)
        assert said.startswith("; about 2600 draws are needed: leave out --draws, or --draws 2600 ")

    def test_how_many_steps_of_an_ensemble(self, trace):
        said = for_too_few_draws(trace, table(900), 400, np.array([8.0, 9.0]))
        assert said.startswith("; about 6900 steps are needed: leave out --draws, or --draws 6900 ")

    def test_what_is_too_uncertain_to_predict_is_a_least_number(self, trace):
        assert for_too_few_draws(trace, table(40), 400).startswith("; at least 13000 draws are needed: ")
        said = for_too_few_draws(trace, table(900), 400, np.array([2.5, 9.0]))
        assert said.startswith("; at least 22000 steps are needed: ")

    def test_walkers_that_stay_apart_need_something_else(self, trace):
        said = for_too_few_draws(trace, table(900), 400, np.array([8.0, 9.0]), are_apart=True)
        assert said == "; use parallel tempering, which moves between maxima: --sampler tempering"

    def test_what_does_not_exist_has_no_remedy(self, trace):
        assert for_too_few_draws(trace, table(np.nan, rhat=np.nan), 400) == ""

    @pytest.mark.parametrize("rhat", [2.5, np.inf])
    def test_chains_that_are_apart_need_something_else(self, trace, rhat):
        said = for_too_few_draws(trace, table(7, rhat=rhat), 400)
        assert said == "; use parallel tempering, which moves between maxima: --sampler tempering"
        trace["observed_data"] = trace["constant_data"]  # as a problem with a measurement has
        said = for_too_few_draws(trace, table(7, rhat=rhat), 400)
        assert said == '; start the chains at the posterior maxima: init="maxima" (--init maxima)'

    def test_chains_around_the_only_maximum_need_more_draws(self, trace):
        said = for_too_few_draws(trace, table(7, rhat=1.4), 400, places="one")
        assert said.startswith("; at least 75000 draws are needed: leave out --draws, or --draws 75000 ")


class Normal3:
    """A correlated Gaussian of three parameters."""

    ndim, lower, upper = 3, np.full(3, -np.inf), np.full(3, np.inf)
    precision = np.array([[2.0, -0.9, 0.0], [-0.9, 1.0, 0.3], [0.0, 0.3, 1.0]])

    def log_prob(self, theta):
        return -0.5 * np.sum(theta @ self.precision * theta, axis=-1)

    def log_prob_and_grad(self, theta):
        return self.log_prob(theta), -theta @ self.precision


@pytest.mark.validate
@pytest.mark.parametrize(
    ("sampler", "draws"),
    [(fmu.Ensemble(walkers=16), 250), (fmu.MetropolisHastings(), 400), (fmu.HamiltonianMonteCarlo(), 80)],
    ids=["emcee", "mh", "hmc"],
)
def test_a_run_of_the_recommended_number_of_draws_converges(sampler, draws):
    """Most of 12: R-hat scatters from run to run, and three of Metropolis–Hastings miss it by some thousandths."""
    converged = 0
    for seed in range(12):
        shape = (4, sampler.walkers, 3) if sampler.walkers > 1 else (4, 3)
        start = np.random.default_rng(seed).standard_normal(shape)
        short = fmu.sample(Normal3(), sampler, draws=draws, warmup=200, seed=seed, init=start)
        number = re.search(r"--draws (\d+)", fmu.diagnose(short).reasons[0])
        long = fmu.sample(Normal3(), sampler, draws=int(number[1]), warmup=200, seed=seed, init=start)
        converged += fmu.diagnose(long).converged
    assert converged >= 8


@pytest.mark.validate
def test_rhat_over_walkers_that_mix_says_how_long_the_run_is():
    """Beyond 50 autocorrelation times it is above the limit for chains, 1.01, and never above its own, 1.05."""
    for seed in range(8):
        start = np.random.default_rng(seed).standard_normal((4, 16, 3))
        trace = fmu.sample(Normal3(), fmu.Ensemble(walkers=16), draws=3500, warmup=200, seed=seed, init=start)
        length, rhat = autocorrelation_times_run(trace).min(), rhat_over_walkers(trace).max()
        assert length > 50
        assert 1.01 < rhat < 1.05
        assert 1.5 < (rhat**2 - 1) * length < 4.0
