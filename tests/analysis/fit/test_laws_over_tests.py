"""Laws of parameters over the tests: what a covariate does beyond the model is named, and P(loss) is withheld."""

from functools import cache

import numpy as np
import pytest

import fmu
from fmu.analysis.fit.causes import _of_order
from fmu.analysis.fit.check import LAW, LEVEL
from fmu.analysis.fit.model_fit import CONTRADICTED, NOT_CONTRADICTED
from fmu.analysis.fit.populations import checks_of_scores
from fmu.analysis.fit.residual_scores import GROUP, residual_group
from fmu.cli.damage import echo_losses
from fmu.report.run import runs_of
from fmu.report.sections.tests import losses, lost
from tests.shear_building import shear_building

NAMES = ("k1", "k2", "k3", "k4")
NOISE, PER_DEGREE, LOSS = 0.003, -0.003, 0.08


def campaign(seed, n=60, bent=True, storeys=range(4), slopes=NAMES):
    """Return the problem of four storeys over a year, with linear laws in the temperature.

    The stiffness of `storeys` falls with the temperature below 0 °C if it is `bent`, else at any temperature. The
    second storey has lost a part of its stiffness in the last quarter of the tests.
    """
    rng = np.random.default_rng(seed)
    model = shear_building(NAMES, 2e6, 1e3)
    warm = np.clip(10.0 - 25.0 * np.cos(2 * np.pi * np.arange(n) / n) + rng.normal(0.0, 3.0, n), -15.0, 35.0)
    tests = []
    for t, celsius in enumerate(warm.tolist()):
        k, later = np.ones(4), t >= 0.75 * n
        k[list(storeys)] += PER_DEGREE * (min(celsius, 0.0) if bent else celsius - 10.0)
        k[1] *= 1.0 - LOSS * later
        f = np.sqrt(np.linalg.eigvalsh(model.K(k).toarray() / 1e3)) / (2.0 * np.pi)
        data = fmu.ModalData(f * (1.0 + NOISE * rng.standard_normal(4)), sd_hz=NOISE * f)
        group = "after" if later else "before"
        tests.append(fmu.Test(f"t{t + 1}", data, group=group, covariates={"temperature": celsius}))
    parameters = [fmu.Parameter(name, 1.0, 0.7, 1.4) for name in NAMES]
    by = {name: {"temperature": fmu.Normal(0.005)} for name in slopes}
    return fmu.JointProblem(model, tests, parameters, varies={"k2": fmu.Damage()}, slopes=by, pairing="index")


@cache
def sampled(bent):
    problem = campaign(3, n=24, bent=bent)
    return fmu.sample(problem, draws=50, warmup=80, chains=2, seed=1, maxima=fmu.find_map(problem, 2))


@cache
def diagnosed(bent):
    return fmu.diagnose(sampled(bent))


def laws(problem, level=LEVEL / 4):
    """Return the checks of the laws at the maximum, without draws."""
    scores = residual_group(problem, fmu.find_map(problem, 1)[0].theta[None])[GROUP]["score"].to_numpy()
    known = {
        (problem.layout.structural[role.of].name, role.where) for role in problem.roles if role.kind == "slope"
    }
    return checks_of_scores(scores, [], [test.as_dict() for test in problem.tests], known, level, NAMES)


def test_a_linear_law_with_a_bend_in_truth_is_contradicted_and_the_covariate_named():
    fit = diagnosed(True).fit
    assert fit.verdict == CONTRADICTED
    assert fit.against[0].startswith("residuals of k")
    assert "values fall with temperature below " in fit.against[0]
    assert "and rise above: add a slope with a kink near " in fit.against[0]


def test_the_right_law_is_not_contradicted():
    fit = diagnosed(False).fit
    assert fit.verdict == NOT_CONTRADICTED
    assert [check.of for check in fit.checks if check.kind == LAW] == [f"residuals of {name}" for name in NAMES]


@pytest.mark.parametrize("bent", [pytest.param(False, marks=pytest.mark.validate), True])
def test_probabilities_of_losses_are_withheld_with_the_reason(bent):
    trace = sampled(bent)
    table = fmu.damage(trace, (0.05,))
    assert np.isnan(table["P(loss > 5 %)"]).all() == bool(table.attrs["withheld"]) == bent
    run = runs_of({"hmc": trace})["hmc"]
    (verdict,) = lost(run)
    cell = losses(run).parts[-1].rows[0][-1]
    if bent:
        assert (verdict.answer, verdict.is_good, cell) == ("Unknown: P is withheld", False, "withheld")
        assert "with temperature below" in verdict.said
    else:
        assert verdict.answer.startswith("k2 ")
        assert cell.endswith("%")


@pytest.mark.parametrize("bent", [False, True])
def test_the_terminal_withholds_them_too(bent, capsys):
    echo_losses(sampled(bent), diagnosed(bent))
    said = " ".join(capsys.readouterr().out.split())
    assert ("P is withheld, as losses include what the laws of the model leave out. k" in said) == bent
    assert ("with temperature below" in said) == bent


@pytest.mark.parametrize("storey", [pytest.param(0, marks=pytest.mark.validate), 2])
def test_the_parameter_whose_sensitivities_explain_the_residuals_is_named(storey):
    found = laws(campaign(5, n=120, storeys=(storey,)))
    assert [check.of for check in found if check.failed] == [f"residuals of k{storey + 1}"]


def test_a_covariate_without_a_slope_is_named():
    """Nothing depends on the temperature in the model, and all of the first storey does in truth."""
    found = laws(campaign(6, bent=False, storeys=(0,), slopes=()))
    assert found[0].failed
    assert "its law in the model: values fall with temperature (correlation -0." in found[0].sentence
    assert "): add a slope with temperature (p = " in found[0].sentence


def test_parameters_with_values_of_their_own_in_each_test_have_no_residual_scores():
    model = shear_building(("k1", "k2"), 2e6, 1e3)
    f = np.sqrt(np.linalg.eigvalsh(model.K([1.0, 1.0]).toarray() / 1e3)) / (2.0 * np.pi)
    tests = [fmu.Test(f"t{t}", fmu.ModalData(f, sd_hz=0.01 * f)) for t in range(8)]
    parameters = [fmu.Parameter(name, 1.0, 0.7, 1.4) for name in ("k1", "k2")]
    for ways, left in (({"k1": "test"}, ["k2"]), ({"k1": fmu.Population()}, ["k2"]), ({}, ["k1", "k2"])):
        problem = fmu.JointProblem(model, tests, parameters, varies=ways, pairing="index")
        group = residual_group(problem, problem.start[None])[GROUP]
        assert group["parameter"].to_numpy().tolist() == left


def test_scores_are_the_slopes_of_the_likelihood_in_their_standard_deviations():
    """By differences of the log-likelihood of one test, as its information by the score's own definition."""
    problem = campaign(7, n=12)
    theta = problem.start.copy()
    scores = residual_group(problem, theta[None])[GROUP]["score"].to_numpy()
    one = problem.tests[4]
    alone = fmu.UpdatingProblem(
        shear_building(NAMES, 2e6, 1e3),
        one.data,
        [fmu.Parameter(n, 1.0, 0.7, 1.4) for n in NAMES],
        pairing="index",
    )
    at = problem.values(theta)[4]
    for j in range(4):
        h = np.zeros(4)
        h[j] = 1e-4
        before, after = (alone.likelihood.terms((at + sign * h)[None]).sum() for sign in (-1.0, 1.0))
        slope = (after - before) / 2e-4
        f = [alone.frequencies(at + sign * h) for sign in (-1.0, 1.0)]
        size = np.linalg.norm((f[1] - f[0]) / 2e-4 / np.asarray(one.data.sd_hz))
        assert scores[4, j] == pytest.approx(slope / size, rel=1e-4)


@pytest.mark.validate
def test_bent_laws_are_found_and_right_ones_pass():
    """Of 50 campaigns of 200 tests with a bend all name the temperature; of 200 right ones at most 4 fail."""
    found = [laws(campaign((77, seed), 200)) for seed in range(50)]
    assert all(any(check.failed and "temperature" in check.dependence for check in one) for one in found)
    right = [laws(campaign((77, seed), 200, bent=False)) for seed in range(200)]
    assert sum(any(check.failed for check in one) for one in right) <= 4


def test_a_step_is_named_at_the_test_before_it():
    values = np.where(np.arange(12) < 8, -1.0, 2.0) + 0.3 * np.random.default_rng(1).standard_normal(12)
    trend = _of_order((values - values.mean())[:, None], [f"t{i}" for i in range(12)])[0]
    assert trend.words(0, 0.8).endswith("most after test t7")
