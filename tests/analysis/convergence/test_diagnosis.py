"""Verdicts on real and hand-made runs: whoever is fooled by chains that agree with each other must fail here."""

import dataclasses
import json
import re

import numpy as np
import pandas as pd
import pytest

import fmu
from fmu.analysis.convergence import effective
from fmu.analysis.convergence.diagnosis import (
    GROUP,
    Diagnosis,
    choose_run,
    diagnose,
    diagnose_all,
    judge,
    maxima_of,
    with_maxima,
)
from fmu.analysis.convergence.diagnostics import convergence_failures, rhat_over_walkers, summary
from fmu.analysis.fit.check import PREDICTED, Check
from fmu.analysis.fit.model_fit import ModelFit
from fmu.analysis.maxima.search import find_map
from fmu.analysis.trace.conversion import load_trace, save_trace, to_trace
from fmu.samplers import RandomWalk


def covariance_around(maximum, section):
    """Covariance of the posterior around a maximum, roughly, in the units that samplers see."""
    precision = maximum.hessian + np.diag(maximum.gradient**2)
    return np.linalg.inv(precision * np.outer(section.scale, section.scale))


@pytest.fixture(scope="module")
def in_b(section, section_maxima, around):
    """Mixtures that know maximum B only: four chains that agree."""
    only = dataclasses.replace(section_maxima, maxima=(dataclasses.replace(section_maxima[1], share=1.0),))
    trace = fmu.sample(section, "mixture", draws=700, warmup=30, init=around(1, 4), seed=3, maxima=only)
    return trace.filter(lambda node: node.name != GROUP)  # as from a sampler that searched nothing


@pytest.fixture(scope="module")
def in_a(section, section_maxima, around):
    """Four chains around maximum A, from a sampler that searched nothing."""
    start = {"init": around(0, 4), "jumps": False, "maxima": section_maxima}
    trace = fmu.sample(section, "mh", draws=200, warmup=100, seed=1, **start)
    return trace.filter(lambda node: node.name != GROUP)


@pytest.fixture
def good(make_result, problem):
    """A trace of the linear problem's own posterior, drawn independently."""
    mean, sd = exact_posterior(problem)
    position = mean + sd * np.random.default_rng(41).standard_normal((4, 500, 2))
    lp = problem.log_prob(position.reshape(-1, 2)).reshape(4, 500)
    result = make_result(position)
    result.posterior.stats["lp"] = lp
    return to_trace(result, problem)


def exact_posterior(problem):
    best = find_map(problem, starts=4)[0]
    return best.mean, np.diag(np.linalg.cholesky(np.linalg.inv(best.hessian)))


def test_chains_that_agree_in_one_of_several_modes_are_found_out(section, in_b, section_maxima):
    assert convergence_failures(in_b) == []  # R-hat, ESS, E-BFMI: the chains alone see nothing
    assert summary(in_b)["rhat"].max() < 1.01
    found = diagnose(in_b, section)
    assert not found.converged
    assert found.reasons[0].startswith(
        "maximum 1 at Ix1 = 3904 mm⁴, Ix2 = 7500 mm⁴, Ax1 = 900.00 mm², Ax2 = 514.5 mm² was "
        "never visited: its log-probability is -40.4 (best draw: -10"
    )
    assert found.reasons[0].endswith(
        "), and it holds about 100 % of the probability; start the chains at the posterior "
        'maxima: init="maxima" (--init maxima)'
    )
    assert found.reasons[1].startswith("the draws were elsewhere: 4 chains are around maximum 2 at Ix1 = 6873 mm⁴")
    assert ", less than 0.01 % of the probability)" in found.reasons[1]
    assert len(found.reasons) == 2


def test_chains_in_the_mode_that_holds_the_probability_may_converge(in_a, section_maxima):
    found = judge(in_a, [section_maxima])
    assert list(found.reasons) == convergence_failures(in_a)
    assert not any("maximum" in reason for reason in found.reasons)


@pytest.mark.validate
def test_a_random_walk_in_the_lowest_of_three_modes_is_found_out(section, section_maxima, around):
    """R-hat below 1.01 in C, 75 below A; and what the walk alone would have been told."""
    walk = RandomWalk(2.38**2 / section.ndim * covariance_around(section_maxima[2], section))
    trace = fmu.sample(section, fmu.MetropolisHastings(walk), draws=4000, warmup=10, init=around(2, 4), seed=1)
    assert summary(trace)["rhat"].max() < 1.01
    assert convergence_failures(trace) == []
    first, second = judge(trace, [section_maxima]).reasons
    assert first.startswith("maximum 1 at Ix1 = 3904 mm⁴")
    assert second.startswith("the draws were elsewhere: 4 chains are around maximum 3 at Ix1 = 553")


# far from all maxima the reduced model's log-probability misses its tolerance
@pytest.mark.filterwarnings("ignore::fmu.analysis.certificate.CertificateWarning")
@pytest.mark.parametrize(
    ("sampler", "warmup", "draws"),
    [
        ("mh", 100, 200),
        pytest.param("slice", 100, 100, marks=pytest.mark.validate),
        pytest.param(fmu.HamiltonianMonteCarlo(0.003, 10), 60, 30, marks=pytest.mark.validate),
        pytest.param(fmu.Ensemble(walkers=16), 60, 20, marks=pytest.mark.validate),
    ],
    ids=["mh", "slice", "hmc", "emcee"],
)
def test_dispersed_starts_do_not_converge(section, section_maxima, sampler, warmup, draws):
    """Whether some chains find A or none does, A or what stands in its place is named."""
    trace = fmu.sample(
        section, sampler, draws=draws, warmup=warmup, seed=1, init="prior", jumps=False, maxima=section_maxima
    )
    found = judge(trace, [section_maxima])
    assert not found.converged
    assert found.reasons[0].startswith("maximum ")
    assert any("maximum 1 at Ix1 = 3904 mm⁴" in reason for reason in found.reasons[:3])
    assert any(re.search(r"(chain is|chains are|walkers are) (around|near)", r) for r in found.reasons[:3])


@pytest.mark.parametrize(("sampler", "maximum"), [("slice", 1), ("emcee", 2)], ids=["slice in B", "emcee in C"])
def test_whoever_stays_in_a_local_mode_is_told_where(section, section_maxima, around, sampler, maximum):
    settings, shape = (fmu.Slice(width=0.05), (4,)) if sampler == "slice" else (fmu.Ensemble(walkers=16), (4, 16))
    start = {"init": around(maximum, *shape), "maxima": section_maxima}
    trace = fmu.sample(section, settings, draws=20, warmup=0, seed=1, **start)
    first, second = judge(trace, [section_maxima]).reasons[:2]
    assert first.startswith("maximum 1 at Ix1 = 3904 mm⁴")
    assert second.startswith("the draws were elsewhere: ")
    kind = "chains" if sampler == "slice" else "walkers"
    assert f"{kind} are around maximum {maximum + 1} at" in second


def test_one_chain_in_each_mode_does_not_converge(section, section_maxima, around):
    init = np.concatenate([around(k, 1) for k in (0, 1, 2, 2)])
    small_steps = fmu.MetropolisHastings(fmu.RandomWalk(0.005))  # none leaves its mode
    trace = fmu.sample(section, small_steps, draws=200, warmup=0, init=init, seed=1, maxima=section_maxima)
    found = judge(trace, [section_maxima])
    assert found.reasons[0].startswith("maximum 2 at Ix1 = 6873 mm⁴")
    assert "has 25 % of the draws (effective size 4), but less than 0.01 %" in found.reasons[0]
    assert found.reasons[0].endswith('init="maxima" (--init maxima)')
    assert found.reasons[1].startswith("maximum 3 at")
    assert found.reasons[2].startswith("1 chain is around maximum 1 at Ix1 = 3904 mm⁴")
    assert "1 chain is around maximum 2 at" in found.reasons[2]
    assert "2 chains are around maximum 3 at" in found.reasons[2]
    assert any(": R-hat is " in reason for reason in found.reasons)


@pytest.mark.validate
@pytest.mark.parametrize("modes", [(1, 2), (0, 1)], ids=["B and C", "A and B"])
def test_ensembles_with_walkers_in_two_modes_are_calm_and_found_out(section, section_maxima, around, modes):
    """The false calm: in equal proportion in every ensemble, so that the ensembles agree."""
    init = np.concatenate([around(k, 4, 16) for k in modes], axis=1)
    calm = fmu.Ensemble(walkers=32, moves="stretch")
    trace = fmu.sample(section, calm, draws=200, warmup=0, init=init, seed=1)
    assert summary(trace)["rhat"].max() < 1.02
    failures = convergence_failures(trace)
    assert any(": R-hat over walkers is " in f for f in failures)
    assert any(": the run is 1" in f and "autocorrelation times long; 50 are needed" in f for f in failures)
    found = judge(trace, [section_maxima])
    assert not found.converged
    if 0 in modes:
        assert re.search(r"of the draws \(effective size [\d ]+\), but less than 0.01 %", found.reasons[0])
    else:
        assert "maximum 1" in found.reasons[0]
        assert "was never visited" in found.reasons[0]
        assert "walkers are around maximum 2" in found.reasons[1]


class Normal2:
    """A correlated Gaussian."""

    ndim, lower, upper = 2, np.full(2, -np.inf), np.full(2, np.inf)

    def log_prob(self, theta):
        x, y = np.asarray(theta).T
        return -0.5 * (x**2 + (y - 0.5 * x) ** 2)

    def log_prob_and_grad(self, theta):
        raise NotImplementedError


def test_walkers_taken_for_chains_raise_a_false_alarm_on_a_good_run():
    init = np.random.default_rng(5).standard_normal((4, 8, 2))
    trace = fmu.sample(Normal2(), fmu.Ensemble(walkers=8, moves="de"), draws=600, warmup=20, init=init, seed=1)
    x = effective.by_walker(trace["posterior"]["x0"].to_numpy(), 8).reshape(32, -1)
    assert effective.rhat(x) > 1.01
    assert np.max(rhat_over_walkers(trace)) > 1.01
    found = diagnose(trace)
    assert found.converged
    assert found.state == "converged locally"  # nothing bounds where to search
    assert found.reasons == ()


def test_what_another_run_found_counts_without_a_problem(in_b, in_a):
    found = diagnose(in_b, others={"mh": in_a})
    assert not found.converged
    assert found.reasons[0].startswith("run mh visited Ix1 = 3")
    assert "the log-probability there is -4" in found.reasons[0]
    assert "it holds about 100 % of the probability" in found.reasons[0]
    # the other way round nothing of weight was missed
    assert not any("visited" in reason for reason in diagnose(in_a, others=[in_b]).reasons)


def test_maxima_that_a_trace_keeps_count_for_it_and_for_others(in_b, section_maxima, tmp_path):
    assert maxima_of(in_b) is None
    kept = load_trace(save_trace(with_maxima(in_b, section_maxima), tmp_path / "kept.nc"))
    assert str(maxima_of(kept)) == str(section_maxima)
    assert "maxima" not in in_b.children
    assert kept.attrs == in_b.attrs
    for found in (diagnose(kept), diagnose(in_b, others=[kept]), diagnose_all({"a": in_b, "b": kept})["a"]):
        assert found.reasons[0].startswith("maximum 1 at Ix1 = 3904 mm⁴")


def test_others_on_another_posterior_are_left_out(in_b, section_maxima):
    other = with_maxima(in_b, section_maxima)
    configuration = json.loads(other.attrs["configuration"])
    configuration["problem"]["likelihood"]["beta"] = [2.0] * 5
    other.attrs["configuration"] = json.dumps(configuration)
    assert diagnose_all({"a": in_b, "b": other})["a"].converged


def test_the_search_with_the_greater_mass_counts(in_b, section_maxima):
    blind = dataclasses.replace(section_maxima, maxima=section_maxima.maxima[1:])
    assert judge(in_b, [blind]).converged
    for known in ([blind, section_maxima], [section_maxima, blind]):
        assert judge(in_b, known).reasons[0].startswith("maximum 1 at Ix1 = 3904 mm⁴")


def test_good_run_has_converged(good, problem):
    found = diagnose(good, problem)
    assert found == Diagnosis(True, (), (), doubts_of_search=(), fit=found.fit)
    assert found.verdict == "converged"
    assert str(found) == "converged\nthe model: not contradicted"


def test_a_verdict_without_maxima_says_so(good, problem):
    """Chains alone may pass for converged, but not without a word."""
    found = diagnose(good)
    assert found.converged
    assert not found.searched
    assert found.verdict == found.state == "converged locally"
    assert diagnose(good, problem).state == "converged"
    assert "judged by its own draws only, as no maxima are known" in str(found)
    assert "judged by its own draws only" in found._repr_html_()
    assert "no maxima" not in str(diagnose(good, problem))
    assert "no maxima" not in str(diagnose(good.isel(chain=[0])))  # there the reasons stand


def test_one_chain_is_never_called_converged(good, problem):
    one = good.isel(chain=[0])
    found = diagnose(one, problem)
    assert not found.converged
    assert found.reasons[0] == "1 chain; at least 2 are needed: --chains 4"


def test_summary_that_is_nan_is_a_failure(good):
    table = summary(good)
    table.loc["rho", "ess_tail"] = np.nan
    assert not judge(good, table=table).converged


def test_warnings_do_not_touch_convergence(good, problem):
    good["misfit"]["squares"] = good["misfit"]["squares"] + 40.0
    found = diagnose(good, problem)
    assert found.converged
    assert found.warnings == found.fit.against
    assert "the model: contradicted by 4 of 4 checks" in str(found)


def test_text_and_html():
    found = Diagnosis(False, ("R-hat 2 of <a>", "second"), ("mode 1 & more",))
    assert (
        str(found)
        == "not converged\n  - R-hat 2 of <a>\n  - second\nnotes on the model and the data\n  - mode 1 & more"
    )
    assert found.verdict == "not converged: R-hat 2 of <a>"
    html = found._repr_html_()
    assert "<strong>not converged</strong>" in html
    assert "<li>R-hat 2 of &lt;a&gt;</li><li>second</li>" in html
    assert "<strong>notes on the model and the data</strong></p><ul><li>mode 1 &amp; more</li>" in html
    good = Diagnosis(True, (), (), doubts_of_search=())
    assert str(good) == "converged"
    assert good._repr_html_() == "<p><strong>converged</strong></p>"
    with pytest.raises(dataclasses.FrozenInstanceError):
        found.converged = True


def test_failed_checks_and_notes_are_two_lists():
    """ "Contradicted by 1 of 2 checks" heads the one that failed, and nothing else."""
    checks = [
        Check(PREDICTED, f"mode {k}", "4.9 sd", "2.6 sd", p, p < 0.01, "an error of 1 %", f"mode {k} is off")
        for k, p in ((1, 1e-6), (2, 0.5))
    ]
    fit = ModelFit(tuple(checks), 3, 2)
    (failed,) = fit.against
    found = Diagnosis(True, (), (failed, "E1 lies at its upper bound"), doubts_of_search=(), fit=fit)
    lines = str(found).splitlines()
    assert lines == [
        "converged", "the model: contradicted by 1 of 2 checks", f"  - {failed}",
        "notes on the model and the data", "  - E1 lies at its upper bound",
    ]  # fmt: skip


@pytest.mark.parametrize("flipped", [False, True])
def test_the_run_that_speaks_for_all_does_not_depend_on_their_order(flipped):
    def ess(least):
        return pd.DataFrame({"ess_bulk": [900.0, least], "ess_tail": [800.0, 700.0]})

    good, bad = Diagnosis(True, (), ()), Diagnosis(False, ("R-hat",), ())
    runs = {"mh": (good, 450.0), "hmc": (good, 600.0), "slice": (bad, 5000.0), "emcee": (good, np.nan)}
    names = list(runs)[::-1] if flipped else list(runs)
    assert choose_run({n: runs[n][0] for n in names}, {n: ess(runs[n][1]) for n in names}) == "hmc"
    assert choose_run(dict.fromkeys(names, bad), {n: ess(runs[n][1]) for n in names}) == "slice"


def test_bad_arguments(good, section, in_b):
    with pytest.raises(ValueError, match="trace: must be a trace, as"):
        diagnose(3)
    with pytest.raises(ValueError, match=r"others\.2: must be a trace written by fmu"):
        diagnose(good, others=[good, 3])
    with pytest.raises(ValueError, match=r"problem: must have the parameters \('E1', 'rho'\) \(got \('Ix1'"):
        diagnose(good, section)
    with pytest.raises(ValueError, match=r"others\.b: must have the parameters \('E1', 'rho'\) \(got \('Ix1'"):
        diagnose(good, others={"b": in_b})


def test_a_problem_with_other_data_is_refused(good, problem):
    """As from a notebook in which the cell with the data was edited after the run."""
    data = dataclasses.replace(problem.data, frequencies_hz=problem.data.frequencies_hz * 1.01)
    beta = [0.5, 1.0, 2.0]
    edited = fmu.UpdatingProblem(problem.model, data, problem.parameters, beta=beta, name="linear")
    with pytest.raises(ValueError, match="problem: must be the posterior that was sampled; they differ in data"):
        diagnose(good, edited)
    with pytest.raises(ValueError, match="problem: must be the posterior of hmc, that was sampled"):
        fmu.compare({"hmc": good}, edited)


@pytest.mark.parametrize("converged", [True, False])
def test_a_run_that_was_stopped_says_so_whatever_the_verdict(good, converged):
    trace = good.copy() if converged else good.isel(draw=slice(20))
    trace.attrs = good.attrs | {"complete": 0, "draws": 500}
    found = judge(trace)
    assert found.converged == converged
    assert found.remarks[-1] == "the run was stopped after 500 draws and can be resumed"
    assert judge(good).stopped == ""
