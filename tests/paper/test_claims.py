"""What is said of the samplers follows from the comparison beside it, and only from converged runs."""

from dataclasses import replace

import pandas as pd
import pytest

from fmu.paper.findings import BETTER, DEPENDS, SEPARATED, Findings, judge, statement
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
PUBLISHED = {  # mean error in %, rms error in Hz, worst mean in sd
    "mh": (2.83, 20.9, 3.0),
    "slice": (2.97, 22.4, 1.0),
    "hmc": (3.58, 10.5, 0.1),
}


@pytest.fixture
def make(findings):
    def make(
        open_=(),
        rates=RATES,
        without_warmup=None,
        to_converge=TO_CONVERGE,
        published=PUBLISHED,
        agreement=(0.01, 1.5, ("mh", "hmc")),
        **fields,
    ):
        """Findings on these figures; `without_warmup`: those to converge, and rates twice as high."""
        table = findings.comparison.copy()
        table["verdict"] = [f"not converged: R-hat of {s}" if s in open_ else "converged" for s in table.index]
        table["ess_per_solve"] = [rates[s] for s in table.index]
        table["n_solves"] = 100_000
        table["n_gradients"] = [100_000 if s == "hmc" else 0 for s in table.index]
        table["sampling_gradients"] = table["n_gradients"] // (1 if without_warmup is None else 2)
        table["ess_per_sampling_solve"] = table["ess_per_solve"] * (1.0 if without_warmup is None else 2.0)
        table["gradient_cost"] = [2.5 if s == "hmc" else float("nan") for s in table.index]
        table["ess_bulk_min"] = table["ess_per_solve"] * table["n_solves"]
        for part, costs in (("", to_converge), ("sampling_", without_warmup or to_converge)):
            for k, of in enumerate(("samples", "solves")):
                cells = [None if s in open_ else costs[s][k] for s in table.index]
                table[f"needed_{part}{of}"] = pd.array(cells, dtype="Int64")
            table[f"needed_{part}s"] = [float("nan") if s in open_ else costs[s][2] for s in table.index]
        for k, column in enumerate(("published_percent", "published_rms_hz", "published_error")):
            table[column] = [published[s][k] if s in published else float("nan") for s in table.index]
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
    assert outcomes(make())[:3] == [
        [AGREES, DISAGREES, CLOSE],  # HMC and MH
        [AGREES, CLOSE, AGREES],  # HMC and slice sampling
        [DISAGREES, AGREES, AGREES],  # MH and slice sampling
    ]
    swapped = {**TO_CONVERGE, "hmc": TO_CONVERGE["slice"], "slice": TO_CONVERGE["hmc"]}
    assert outcomes(make(to_converge=swapped))[1] == [DISAGREES, CLOSE, DISAGREES]


def test_no_judgement_contradicts_the_table_of_costs(make):
    """Each on speed is by two numbers of the table, in its digits; the smaller is of the sampler that wins."""
    findings = make(without_warmup={s: (n - 1_500, m - 5_000, t - 0.4) for s, (n, m, t) in TO_CONVERGE.items()})
    page = experiment_page(findings)
    for j in judge(findings):
        assert f"| {j.statement} | {j.criterion} | {j.outcome} | {j.evidence} |" in page
        if "converges" not in j.statement:
            continue
        with_warmup, without = (text.split(" against ") for text in j.evidence.split("; without the warm-up "))
        for figures in zip(with_warmup, without, strict=True):
            cell = "| {} ({}) |".format(*(figure.split(":")[0] for figure in figures))
            assert cell in page.split("## Convergence and cost")[1].split("## What the paper says")[0]
        first, second = (float(figure.split(":")[0].replace(" ", "")) for figure in with_warmup)
        assert j.outcome in (CLOSE, DEPENDS) or (j.outcome == AGREES) == (first < second)


def test_a_verdict_that_a_warm_up_decides_is_none(make):
    """HMC needs 50 000 solves to MH's 20 000; most of them are its warm-up, whose length was chosen beforehand."""
    without = {**TO_CONVERGE, "hmc": (600, 15_000, 1.0), "mh": (38_000, 19_000, 3.8)}
    samples, solves, seconds = judge(make(without_warmup=without))[:3]
    assert (samples.outcome, solves.outcome, seconds.outcome) == (AGREES, DEPENDS, DEPENDS)
    assert samples.evidence == "3 000 against 40 000; without the warm-up 600 against 38 000"
    assert solves.evidence == (
        "50 000 against 20 000: disagrees; without the warm-up 15 000 against 19 000: too close to call"
    )
    assert seconds.evidence == "4.5 against 4.0: too close to call; without the warm-up 1.0 against 3.8: agrees"


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ("cantilever-young", [("MH", "slice sampling"), ("HMC", "slice sampling")]),
        ("cantilever-section", [("MH", "slice sampling"), ("HMC", "MH"), ("HMC", "slice sampling")]),
    ],
)
def test_every_comparison_of_accuracy_is_judged(make, case, expected):
    """Abstract: MH and HMC better than slice sampling (5.1), HMC better than both (5.2); 5.2: MH than slice."""
    judged = [j.statement for j in judge(replace(make(), case=case)) if BETTER in j.statement]
    assert judged[::3] == [f"{a} {BETTER} {b}" for a, b in expected]


def test_better_results_are_judged_by_the_papers_tables(make):
    """Also where no run converged, for they are no run of ours."""
    for findings in (make(), make(open_=tuple(RATES))):
        found = [
            j[1:] for j in judge(replace(findings, case="cantilever-young")) if j.statement.startswith("MH g")
        ]
        assert found == [
            ("mean error of the published frequencies, %", CLOSE, "2.83 against 2.97"),
            ("rms error of the published frequencies, Hz", CLOSE, "20.9 against 22.4"),
            ("worst of the published means, sd off", DISAGREES, "3.0 against 1.0"),
        ]
    *_, percent, rms, off = judge(make())
    assert (percent.outcome, rms.outcome, off.outcome) == (CLOSE, AGREES, AGREES)  # HMC and slice sampling


def test_a_run_that_did_not_converge_loses_to_one_that_did(make):
    assert outcomes(make(open_=("slice",)))[1:3] == [[AGREES] * 3] * 2
    assert outcomes(make(open_=("hmc",)))[:2] == [[DISAGREES] * 3] * 2
    assert "100 000 solves" in judge(make(open_=("slice",)))[3].evidence


def test_nothing_is_said_of_two_runs_that_did_not_converge(make):
    assert outcomes(make(open_=("mh", "slice")))[2] == [OPEN] * 3
    assert outcomes(make(open_=tuple(RATES)))[:3] == [[OPEN] * 3] * 3


def test_close_efficiencies_are_not_told_apart(make):
    close = make(rates={**RATES, "emcee": 0.045})
    assert "Most: Hamiltonian Monte Carlo, emcee ensemble (too close to call)" in statement(close)
    assert "too close" not in statement(make())


def test_statement_names_the_best_and_the_price_of_central_differences(make):
    words = statement(make())
    assert "Most: Hamiltonian Monte Carlo" in words
    price = (
        "8 solves a gradient, HMC would have {} without the warm-up, no longer the most of the paper's samplers"
    )
    assert price.format("0.0063") in words
    assert "at most 0.01 posterior sd, 1.5 standard errors" in words
    assert "still the most" in statement(make(rates={**RATES, "hmc": 0.5}))
    words = statement(make(without_warmup=TO_CONVERGE))  # half the gradients, at twice the rate
    assert "Hamiltonian Monte Carlo 0.05 (0.1), emcee ensemble 0.03 (0.06)" in words
    assert price.format("0.013") in words


def test_samplers_are_ranked_without_the_warm_up(make):
    """Its length was chosen beforehand; if it would make another first, both are named."""
    findings = make()
    table = findings.comparison.copy()
    table.loc["mh", "ess_per_sampling_solve"] = 0.2
    words = statement(replace(findings, comparison=table))
    assert "Most: Metropolis–Hastings. If the warm-up counts: Hamiltonian Monte Carlo. " in words
    assert "Metropolis–Hastings 0.02 (0.2), Hamiltonian Monte Carlo 0.05 (0.05)" in words


def test_an_estimate_from_chains_that_hardly_move_is_a_bound(make):
    findings = make()
    table = findings.comparison.copy()
    table["paper_needed_solves"] = pd.array([21_463_864] * len(table), dtype="Int64")
    for ess, words in ((4.4, "more than 21 000 000"), (40.0, "≈ 21 000 000")):
        table["paper_pace_ess"] = ess
        changed = replace(findings, comparison=table)
        for page in (experiment_page(changed), summary_page([changed], "34 of 40", 7, {})):
            assert f"| {words} |" in page


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
    assert "| – | 40 000 (40 000) | 20 000 (20 000) | 4.0 (4.0) | 0.02 |" in page
    assert "| 100 000 | 2.5 | 3 000 (3 000) | 50 000 (50 000) | 4.5 (4.5) | 0.05 |" in page


def test_summary_shows_what_converged_and_what_it_took(make):
    page = summary_page([make(open_=("slice",))], "34 of 40", 7, {"numpy": "2.0"})
    assert "**Slice sampling, long run (not converged)**" in page
    assert "**Hamiltonian Monte Carlo, long run (converged)**" in page
    assert "| 2.5 | 3 000 (3 000) | 50 000 (50 000) | 4.5 (4.5) | 0.05 (0.05) |" in page
    assert "| – | – | more than 100 000 | – | – |" in page
    assert "- 34 of 40 ([recomputed.md]" in page
    assert "Seed 7; numpy 2.0." in page
