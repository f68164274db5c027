"""What is said of the samplers follows from the comparison beside it, and only from converged runs."""

from dataclasses import replace

import pandas as pd
import pytest

from fmu.paper.findings import SEPARATED, Findings, judge, statement
from fmu.paper.page import experiment_page
from fmu.paper.summary import summary_page

RATES = {"mh": 0.02, "slice": 0.01, "hmc": 0.05, "emcee": 0.03, "mixture": 0.005}


TO_CONVERGE = {  # samples, solves, seconds
    "mh": (40_000, 20_000, 4.0),
    "slice": (8_000, 60_000, 30.0),
    "hmc": (3_000, 50_000, 4.5),
    "emcee": (9_000, 90_000, 9.0),
    "mixture": (5_000, 400_000, 40.0),
}
OFF = {"mh": 3.0, "slice": 1.0, "hmc": 0.1, "emcee": None, "mixture": None}


@pytest.fixture
def make(findings):
    def make(
        open_=(), rates=RATES, to_converge=TO_CONVERGE, off=OFF, agreement=(0.01, 1.5, ("mh", "hmc")), **fields
    ):
        table = findings.comparison.copy()
        table["verdict"] = [f"not converged: R-hat of {s}" if s in open_ else "converged" for s in table.index]
        table["ess_per_solve"] = [rates[s] for s in table.index]
        table["n_solves"] = 100_000
        table["n_gradients"] = [100_000 if s == "hmc" else 0 for s in table.index]
        table["gradient_cost"] = [2.5 if s == "hmc" else float("nan") for s in table.index]
        table["ess_bulk_min"] = table["ess_per_solve"] * table["n_solves"]
        for k, name in enumerate(("needed_samples", "needed_solves")):
            table[name] = pd.array([None if s in open_ else to_converge[s][k] for s in table.index], dtype="Int64")
        table["needed_s"] = [float("nan") if s in open_ else to_converge[s][2] for s in table.index]
        table["paper_error"] = [float("nan") if off[s] is None else off[s] for s in table.index]
        return replace(findings, comparison=table, agreement=agreement, **fields)

    return make


def outcomes(findings, case="cantilever-young"):
    """The outcomes by statement, in the order of the criteria."""
    found = {}
    for judgement in judge(replace(findings, case=case)):
        found.setdefault(judgement.statement, []).append(judgement.outcome)
    return list(found.values())


AGREES, DISAGREES, CLOSE, OPEN = "agrees", "disagrees", "too close to call", "cannot be judged"


def test_speed_is_judged_by_samples_by_solves_and_by_seconds(make):
    assert outcomes(make()) == [
        [AGREES, DISAGREES, CLOSE],  # HMC and MH
        [AGREES, CLOSE, AGREES],  # HMC and slice sampling
        [DISAGREES, AGREES, AGREES],  # MH and slice sampling
    ]
    swapped = {**TO_CONVERGE, "hmc": TO_CONVERGE["slice"], "slice": TO_CONVERGE["hmc"]}
    assert outcomes(make(to_converge=swapped))[1] == [DISAGREES, CLOSE, DISAGREES]


def test_no_judgement_contradicts_the_table_of_costs(make):
    """Each is by two numbers of the table, in its digits; the smaller is that of the sampler that wins."""
    findings = make()
    page = experiment_page(findings)
    for j in judge(findings):
        mine, other = j.evidence.split(" against ")
        assert f"| {j.statement} | {j.criterion} | {j.outcome} | {j.evidence} |" in page
        for figure in (mine, other):
            assert f"| {figure} |" in page.split("## Convergence and cost")[1].split("## What the paper says")[0]
        first, second = (float(figure.replace(" ", "")) for figure in (mine, other))
        assert j.outcome == CLOSE or (j.outcome == AGREES) == (first < second)


def test_better_results_are_judged_by_the_error_of_the_papers_protocol(make):
    *_, last = judge(make())  # section 5.2
    assert last == (
        "MH gives better results than slice sampling",
        "worst mean of the paper's protocol, sd off",
        DISAGREES,
        "3.0 against 1.0",
    )
    assert judge(make(off={**OFF, "mh": 0.4}))[-1].outcome == AGREES
    assert judge(make(off={**OFF, "mh": 1.1}))[-1].outcome == CLOSE


def test_a_run_that_did_not_converge_loses_to_one_that_did(make):
    assert outcomes(make(open_=("slice",)))[1:] == [[AGREES] * 3] * 2
    assert outcomes(make(open_=("hmc",)))[:2] == [[DISAGREES] * 3] * 2
    assert "100 000 solves" in judge(make(open_=("slice",)))[3].evidence


def test_nothing_is_said_of_two_runs_that_did_not_converge(make):
    assert outcomes(make(open_=("mh", "slice")))[2] == [OPEN] * 3
    assert outcomes(make(open_=tuple(RATES))) == [[OPEN] * 3] * 3
    assert outcomes(make(open_=tuple(RATES)), "cantilever-section")[2] == [OPEN]


def test_close_efficiencies_are_not_told_apart(make):
    close = make(rates={**RATES, "emcee": 0.045})
    assert "Most: Hamiltonian Monte Carlo, emcee ensemble (too close to call)" in statement(close)
    assert "too close" not in statement(make())


def test_statement_names_the_best_and_the_price_of_central_differences(make):
    words = statement(make())
    assert "Most: Hamiltonian Monte Carlo" in words
    assert "8 solves a gradient, HMC would have 0.0063, no longer the most of the paper's samplers" in words
    assert "at most 0.01 posterior sd, 1.5 standard errors" in words
    assert "still the most" in statement(make(rates={**RATES, "hmc": 0.5}))


def test_statement_does_not_rank_what_did_not_converge(make):
    words = statement(make(open_=("hmc",)))
    assert "Most: emcee ensemble" in words
    assert "Not converged: Hamiltonian Monte Carlo" in words
    assert "0.05" not in words


def test_statement_on_separated_modes(make):
    maxima = make().maxima
    split = pd.concat([maxima, maxima.assign(log_prob=maxima["log_prob"] - 67)])
    assert SEPARATED.strip() in statement(make(open_=tuple(RATES), maxima=split))
    assert SEPARATED.strip() in experiment_page(make(open_=("emcee",), maxima=split))
    assert SEPARATED.strip() not in experiment_page(make(open_=("emcee",)))
    assert SEPARATED.strip() not in experiment_page(make(maxima=split))  # all runs crossed between them


def test_only_runs_away_from_the_highest_maximum_are_named(result, make):
    """A run that missed another maximum is not."""
    highest = result.maxima[0]
    at = {"mh": highest.theta + 100.0 * highest.sd, "slice": highest.theta}
    long = {name: trace.copy(deep=True) for name, trace in result.long.items()}
    for sampler, theta in at.items():
        for name, value in zip(result.problem.names, theta, strict=True):
            long[sampler]["posterior"][name].values[:, ::2] = value
            long[sampler]["posterior"][name].values[:, 1::2] = value * (1.0 + 1e-9)
    never_near = Findings.of(replace(result, long=long)).never_near
    assert "mh" in never_near
    assert "slice" not in never_near
    maxima = make().maxima
    split = pd.concat([maxima, maxima.assign(log_prob=maxima["log_prob"] - 67)])
    missed = {"slice": ("maximum 2 was never visited",)}
    page = experiment_page(make(open_=("mh", "slice"), maxima=split, reasons=missed, never_near=("mh",)))
    assert "Never near number 1: Metropolis–Hastings. \n" in page


def test_chains_from_one_start_are_not_believed_for_their_rhat(make):
    run = make().one_start._replace(rhat=1.0004, off=219.6, reasons=("maximum 1 was never visited",))
    page = experiment_page(make(one_start=run)).split("## Chains from one start")[1]
    assert "the largest R-hat is 1.0004" in page
    assert "lies 219.6 posterior standard deviations off" in page
    assert "- maximum 1 was never visited" in page
    page = experiment_page(make(one_start=run._replace(reasons=()))).split("## Chains from one start")[1]
    assert "The run has converged." in page
    assert "Not converged" not in page.split("## Whether")[0]


def test_no_efficiency_is_given_for_what_did_not_converge(make):
    page = experiment_page(make(open_=("slice",)))
    assert "| Slice sampling | 100 000 | 0 | – | – | – | – | – | – | – |" in page
    assert "| Metropolis–Hastings | 100 000 | 0 | – | 40 000 | 20 000 | 4.0 | 0.02 |" in page
    assert "| Hamiltonian Monte Carlo | 100 000 | 100 000 | 2.5 | 3 000 | 50 000 | 4.5 | 0.05 |" in page


def test_summary_shows_what_converged_and_what_it_took(make):
    page = summary_page([make(open_=("slice",))], "34 of 40", 7, {"numpy": "2.0"})
    assert "**Slice sampling, long run (not converged)**" in page
    assert "**Hamiltonian Monte Carlo, long run (converged)**" in page
    assert "| 2.5 | 3 000 | 50 000 | 4.5 | 0.05 |" in page
    assert "| – | – | more than 100 000 | – | – |" in page
    assert "- 34 of 40 ([recomputed.md]" in page
    assert "Seed 7; numpy 2.0." in page
