"""What is said of the samplers follows from the comparison, and only from converged runs."""

from dataclasses import replace

import pandas as pd
import pytest

from fmu.paper.findings import SEPARATED, judge, statement
from fmu.paper.page import experiment_page
from fmu.paper.summary import summary_page

RATES = {"mh": 0.02, "slice": 0.01, "hmc": 0.05, "emcee": 0.03}


@pytest.fixture
def make(findings):
    def make(open_=(), rates=RATES, agreement=(0.01, 1.5, ("mh", "hmc")), **fields):
        table = findings.comparison.copy()
        table["verdict"] = [f"not converged: R-hat of {s}" if s in open_ else "converged" for s in table.index]
        table["ess_per_solve"] = [rates[s] for s in table.index]
        table["n_solves"] = 100_000
        table["n_gradients"] = [100_000 if s == "hmc" else 0 for s in table.index]
        table["ess_bulk_min"] = table["ess_per_solve"] * table["n_solves"]
        table["needed_solves"] = pd.array([None if s in open_ else 40_000 for s in table.index], dtype="Int64")
        return replace(findings, comparison=table, agreement=agreement, **fields)

    return make


def outcomes(findings):
    return [judgement.outcome for judgement in judge(findings)]


def test_converged_runs_are_ranked_by_effective_draws_per_solve(make):
    assert outcomes(make()) == ["agrees"] * 3
    assert outcomes(make(rates={**RATES, "slice": 0.03})) == ["agrees", "agrees", "disagrees"]
    assert outcomes(make(rates={**RATES, "hmc": 0.001})) == ["disagrees", "disagrees", "agrees"]


def test_a_run_that_did_not_converge_loses_to_one_that_did(make):
    assert outcomes(make(open_=("slice",))) == ["agrees"] * 3
    assert outcomes(make(open_=("hmc",))) == ["disagrees", "disagrees", "agrees"]
    assert "100 000 solves" in judge(make(open_=("slice",)))[1].evidence


def test_nothing_is_said_of_two_runs_that_did_not_converge(make):
    assert outcomes(make(open_=("mh", "slice"))) == ["agrees", "agrees", "cannot be judged"]
    assert outcomes(make(open_=tuple(RATES))) == ["cannot be judged"] * 3


def test_close_efficiencies_are_not_told_apart(make):
    close = make(rates={**RATES, "slice": 0.019, "emcee": 0.045})
    assert outcomes(close) == ["agrees", "agrees", "too close to call"]
    assert "Best: Hamiltonian Monte Carlo, emcee ensemble (too close to call)" in statement(close)
    assert "too close" not in statement(make())


def test_statement_names_the_best_and_the_price_of_central_differences(make):
    words = statement(make())
    assert "Best: Hamiltonian Monte Carlo" in words
    assert "8 solves a gradient, HMC would have 0.0063, no longer the most of the paper's samplers" in words
    assert "at most 0.01 posterior sd, 1.5 standard errors" in words
    assert "still the most" in statement(make(rates={**RATES, "hmc": 0.5}))


def test_statement_does_not_rank_what_did_not_converge(make):
    words = statement(make(open_=("hmc",)))
    assert "Best: emcee ensemble" in words
    assert "Not converged: Hamiltonian Monte Carlo" in words
    assert "0.05" not in words


def test_statement_on_separated_modes(make):
    maxima = make().maxima
    split = pd.concat([maxima, maxima.assign(log_prob=maxima["log_prob"] - 67)])
    assert SEPARATED.strip() in statement(make(open_=tuple(RATES), maxima=split))
    page = experiment_page(make(open_=tuple(RATES), maxima=split))
    assert "say nothing about the samplers" in page
    assert "say nothing about the samplers" not in experiment_page(make(open_=tuple(RATES)))


def test_no_efficiency_is_given_for_what_did_not_converge(make):
    page = experiment_page(make(open_=("slice",)))
    assert "| Slice sampling | 100 000 | 0 | – | – | – | – |" in page
    assert "| Metropolis–Hastings | 100 000 | 0 | 40 000 | 0.02 |" in page


def test_summary_shows_what_converged_and_what_it_took(make):
    page = summary_page([make(open_=("slice",))], (40, 40), 7, {"numpy": "2.0"})
    assert "**Slice sampling, long run (not converged)**" in page
    assert "**Hamiltonian Monte Carlo, long run (converged)**" in page
    assert "| 40 000 | 0.05 |" in page
    assert "| more than 100 000 | – |" in page
    assert "40 of 40" in page
    assert "Seed 7; numpy 2.0." in page
