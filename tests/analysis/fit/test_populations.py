import numpy as np
import pytest

import fmu
from fmu.analysis.convergence.diagnostics import convergence_failures, summary, summary_for_verdict
from fmu.analysis.convergence.remedies import fewest, without_scores
from fmu.analysis.fit.check import POPULATION, level_of
from fmu.analysis.fit.populations import checks_of_scores, effective_parameters
from fmu.analysis.trace.reading import parameter_names, score_names

N = 30
NAMES = ("k1", "k2", "k3", "k4")
LEVEL = 0.01


def scores(seed):
    return np.random.default_rng(seed).standard_normal((N, len(NAMES)))


def checks(z, covariates=None, groups=None, explained=()):
    tests = [
        {"name": f"t{i}", "group": "" if groups is None else groups[i], "covariates": {} if covariates is None else
         {name: float(x[i]) for name, x in covariates.items()}}
        for i in range(len(z))
    ]  # fmt: skip
    z = (z - np.nanmean(z, axis=0)) / np.nanstd(z, axis=0, ddof=1)
    return checks_of_scores(z, NAMES, tests, set(explained), LEVEL)


def failed(found):
    return [check.of for check in found if check.failed]


def test_draws_of_one_population_pass():
    """At most one in a hundred sets is told, at the level of one in a hundred; all of them could have been."""
    found = [checks(scores(seed)) for seed in range(25)]
    assert sum(bool(failed(one)) for one in found) <= 1
    assert all(check.could_fail for one in found for check in one)


@pytest.mark.parametrize("seed", range(4))
def test_a_drift_is_told_with_its_parameter(seed):
    z = scores(seed)
    z[:, 2] += 5.0 * np.linspace(-0.5, 0.5, N)
    found = checks(z)
    assert failed(found) == ["population of k3"]
    assert "values rise with the order of the tests (correlation 0." in found[2].sentence


def test_blocks_are_told():
    z = scores(1)
    z[:, 0] += 3.0 * np.repeat([0, 2, 1], N // 3)
    (told,) = (check for check in checks(z) if check.failed)
    assert "values change slowly over the tests (" in told.sentence
    assert "of the variance in two waves), most after test t9" in told.sentence


def test_consecutive_tests_that_resemble_each_other_are_told():
    """An autoregression wanders without a trend or a slow wave."""
    z = scores(13)
    for t in range(1, N):
        z[t, 3] = 0.8 * z[t - 1, 3] + 0.6 * z[t, 3]
    (told,) = (check for check in checks(z) if check.failed)
    assert told.of == "population of k4"


@pytest.mark.parametrize("explained", [(), [("k1", "temperature")]])
def test_a_bend_in_a_covariate_is_named_with_its_place(explained):
    """The mean over a year is near the kink, so that a line explains little or has been taken out."""
    temperature = np.random.default_rng(5).uniform(-15.0, 15.0, 2 * N)
    z = np.random.default_rng(2).standard_normal((2 * N, len(NAMES)))
    z[:, 0] -= 0.4 * np.minimum(temperature, 0.0)
    if explained:
        z[:, 0] -= np.polyval(np.polyfit(temperature, z[:, 0], 1), temperature)
    (told,) = (check for check in checks(z, {"temperature": temperature}, explained=explained) if check.failed)
    verb = "rise" if explained else "hardly change"
    assert "values fall with temperature below " in told.sentence
    assert f"and {verb} above: add a slope with a kink near " in told.sentence
    place = float(told.sentence.partition("kink near ")[2].partition(" ")[0])
    assert abs(place) < 5.0


def test_a_covariate_that_some_tests_lack_is_named():
    temperature = np.random.default_rng(5).uniform(-10.0, 30.0, N)
    z = scores(3)
    z[:, 0] -= 0.2 * (temperature - temperature.mean())
    temperature[::5] = np.nan
    (told,) = (check for check in checks(z, {"temperature": temperature}) if check.failed)
    assert "values fall with temperature (correlation -0." in told.sentence


def test_one_test_far_from_the_others_is_named():
    z = scores(2)
    z[17, 1] = 7.0
    (told,) = (check for check in checks(z) if check.failed)
    assert told.of == "population of k2"
    assert "test t17 lies " in told.sentence
    z[17, 1] = 2.0
    assert failed(checks(z)) == []


def test_a_covariate_is_named_unless_the_model_has_it():
    temperature = np.random.default_rng(5).uniform(-10.0, 30.0, N)
    z = scores(3)
    z[:, 0] -= 0.2 * (temperature - temperature.mean())
    covariates = {"temperature": temperature}
    (told,) = (check for check in checks(z, covariates) if check.failed)
    assert "values fall with temperature (correlation -0." in told.sentence
    assert failed(checks(z, covariates, explained=[("k1", "temperature")])) == []


def test_groups_that_differ_are_told():
    groups = np.random.default_rng(4).permutation(["a", "b"] * (N // 2))
    z = scores(6)
    assert failed(checks(z, groups=groups)) == []
    z[groups == "a", 3] += 3.0
    (told,) = (check for check in checks(z, groups=groups) if check.failed)
    assert "of the variance lies between the groups" in told.sentence


def test_missing_values_are_left_out():
    z = scores(7)
    z[:, 1] += 5.0 * np.linspace(-0.5, 0.5, N)
    z[::4, 1] = np.nan
    assert failed(checks(z)) == ["population of k2"]


def test_few_tests_are_no_check():
    found = checks(scores(8)[:5])
    assert failed(found) == []
    assert not any(check.could_fail for check in found)


@pytest.fixture(scope="module")
def springs():
    """A spring with a mass in ten tests, its stiffness from one population, and a run that is too short."""
    rng = np.random.default_rng(5)
    model = fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)])
    f = np.sqrt(1.0 + 0.1 * rng.standard_normal(10)) / (2 * np.pi) * (1 + 0.01 * rng.standard_normal(10))
    tests = [fmu.Test(f"t{i}", fmu.ModalData([one], sd_hz=0.01 * one)) for i, one in enumerate(f)]
    parameter = fmu.Parameter("k", 1.0, 0.6, 1.5)
    problem = fmu.JointProblem(model, tests, [parameter], varies={"k": fmu.Population()}, pairing="index")
    return problem, fmu.sample(problem, draws=40, warmup=20, seed=1)


def test_a_run_of_a_population_is_diagnosed_with_its_problem(springs):
    problem, trace = springs
    found = fmu.diagnose(trace, problem)
    assert found.fit == fmu.diagnose(trace).fit
    assert [check.of for check in found.fit.checks if check.kind == POPULATION] == ["population of k"]


def test_populations_get_most_of_the_level(springs):
    """Checks of data and of populations together have the level that is stated."""
    fit = fmu.diagnose(springs[1]).fit
    (of_population,) = (check for check in fit.checks if check.kind == POPULATION)
    assert of_population.limit == "p 0.015"
    assert any("fail at least one of these checks less than 2 % of the time" in note for note in fit.notes)
    assert {check.kind for check in fit.checks} > {POPULATION}
    assert level_of([check for check in fit.checks if check.kind != POPULATION]) == 0.01


def test_scores_count_as_far_as_the_data_inform_them(springs):
    _, trace = springs
    every = len(parameter_names(trace))
    assert every == 12
    informed = trace.copy()
    informed["populations"] = informed["populations"].to_dataset().assign(score_sd=lambda of: 0.0 * of["score_sd"])
    assert effective_parameters(informed) == every
    unknown = trace.copy()
    unknown["populations"] = (
        unknown["populations"].to_dataset().assign(score_sd=lambda of: 0.0 * of["score_sd"] + 1.0)
    )
    assert effective_parameters(unknown) == 2
    assert 2 < effective_parameters(trace) < every


def test_a_single_score_does_not_hold_up_a_run(springs):
    """Its R-hat may be up to 1.05, and its ESS is not asked for; that of the mean is."""
    _, trace = springs
    table = summary(trace).assign(
        rhat=1.001, ess_bulk=900.0, ess_tail=900.0, mcse_mean=0.0, mcse_eti90_lb=0.0, mcse_eti90_ub=0.0
    )
    score = score_names(trace)[0]
    table.attrs["scores"] = score_names(trace)

    def reasons(name, column, value):
        changed = table.copy()
        changed.loc[name, column] = value
        return [said for said in convergence_failures(trace, changed) if name in said]

    assert reasons(score, "rhat", 1.04) == reasons(score, "ess_bulk", 200.0) == []
    assert "R-hat is 1.06; it must be below 1.05" in reasons(score, "rhat", 1.06)[0]
    assert "R-hat is 1.04; it must be below 1.01" in reasons("k mean", "rhat", 1.04)[0]
    changed = table.copy()
    changed.loc[score, "ess_bulk"] = 3.0
    assert fewest(changed) == 900.0
    assert score not in without_scores(changed).index


def test_the_verdict_needs_only_the_rhat_of_scores(springs):
    """So that a run of many tests is judged in a fraction of the time of its summary."""
    _, trace = springs
    table, of_verdict = summary(trace), summary_for_verdict(trace)
    np.testing.assert_array_equal(of_verdict["rhat"], table["rhat"])
    columns = ["mean", "sd", "rhat", "ess_bulk", "ess_tail", "mcse_mean", "mcse_eti90_lb", "mcse_eti90_ub"]
    np.testing.assert_array_equal(without_scores(of_verdict)[columns], without_scores(table)[columns])
    assert of_verdict.loc[score_names(trace), "ess_bulk"].isna().all()
    assert convergence_failures(trace) == convergence_failures(trace, table)
    assert fewest(of_verdict) == fewest(table)
