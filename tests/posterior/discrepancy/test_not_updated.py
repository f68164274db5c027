"""Parameters that are not updated: known values of the model that may be wrong, and scatter over the modes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

import fmu
from fmu.analysis.fit.allowed_scatter import scatter_sentences
from tests.gradients import assert_gradient
from tests.shear_building import frequencies_hz, shear_building

NAMES = ["k1", "k2", "k3", "k4"]
TRUTH = np.array([1.05, 0.7, 0.95, 1.1])
HELD = 1.3
"""The value that k2 keeps; the truth is 0.7."""
SD = 0.004
TABLE = """
[[parameters]]
name = "theta2"
start = 0.8
lower = 0.2
upper = 2.0
updated = false
"""


def building():
    return shear_building(NAMES, 1e3, mass=[1.0, 1.5, 1.2, 0.8], dofs=[(j, "x") for j in range(1, 5)])


def parameters(held=("k2",)):
    starts = [1.0, HELD, 0.9, 1.1]
    return [fmu.Parameter(n, s, 0.2, 3.0, updated=n not in held) for n, s in zip(NAMES, starts, strict=True)]


def data(truth=TRUTH):
    measured = frequencies_hz(building(), truth)[0]
    return fmu.ModalData(measured, sd_hz=SD * measured)


def problem_of(discrepancy, make=fmu.UpdatingProblem.reduced, truth=TRUTH):
    return make(building(), data(truth), parameters(), pairing="index", discrepancy=discrepancy)


@pytest.mark.parametrize("make", [fmu.UpdatingProblem, fmu.UpdatingProblem.reduced])
def test_theta_has_no_such_parameter_but_the_variances_have_its_slopes(make):
    problem = problem_of(fmu.Discrepancy(groups=("k2",)), make)
    assert problem.names == ("k1", "k3", "k4", "tau")
    theta = problem.sample_prior(np.random.default_rng(1), 5)
    theta[:, 3] = 0.1
    whole = np.insert(theta[:, :3], 1, HELD, axis=1)
    every = fmu.UpdatingProblem(building(), data(), parameters(held=()), pairing="index")
    f, J = every.model.frequencies_and_gradient(whole)
    V = (SD * np.asarray(data().frequencies_hz)) ** 2 + (J[:, :, 1] * HELD * 0.1) ** 2
    expected = stats.norm.logpdf(data().frequencies_hz, f, np.sqrt(V))
    assert_allclose(problem.log_likelihood_terms(theta), expected, rtol=1e-6)
    assert_allclose(problem.values(theta)[:, 0], whole)
    assert_allclose(problem.frequencies(theta), f, rtol=1e-9)
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-4 * theta, order=4, of_largest=1e-6)
    assert [problem.log_prob(one) for one in theta] == problem.log_prob(theta).tolist()


def test_a_value_that_is_wrong_has_a_larger_scatter():
    """k2 is too stiff by 86 %, or right."""
    tau = []
    for truth in (TRUTH, np.array([1.05, HELD, 0.95, 1.1])):
        found = fmu.find_map(problem_of(fmu.Discrepancy(groups=("k2",)), truth=truth), starts=2)
        tau.append(found[0].theta[3])
    assert tau[0] > 5 * tau[1]
    assert tau[0] > 0.05


def test_a_run_and_what_is_said_of_it():
    problem = problem_of(fmu.Discrepancy(groups=("k2",), correlation="inferred"))
    maxima = fmu.find_map(problem, starts=2)
    trace = fmu.sample(problem, "mh", draws=30, warmup=30, chains=2, seed=1, maxima=maxima)
    assert list(fmu.summary(trace).index) == ["k1", "k3", "k4", "tau", "tau correlation"]
    of_scatter, of_correlation = scatter_sentences(trace)
    assert of_scatter.startswith("k2: a scatter over the modes, tau, of ")
    assert of_correlation.startswith("a correlation over the modes, tau correlation, of 0.")


def test_check_names_a_parameter_that_does_nothing():
    said = fmu.check(problem_of(())).priors
    assert any("k2 is not updated, and no discrepancy lets it scatter" in sentence for sentence in said)
    assert not any("not updated" in sentence for sentence in fmu.check(problem_of(fmu.Discrepancy())).priors)


def test_a_problem_file(tmp_path):
    head, tables = fmu.cases.path("shear-2dof").read_text().split("\n[", 1)
    tables = tables[: tables.rindex("[[parameters]]")]
    scatter = '[[discrepancy]]\nkind = "embedded"\ngroups = ["theta2"]\n'
    path = tmp_path / "held.toml"
    path.write_text(f"{head}\n{scatter}\n[{tables}{TABLE}")
    problem = fmu.load(path)
    assert problem.names == ("theta1", "tau")
    assert problem.configuration()["not_updated"] == {"theta2": 0.8}
    assert np.isfinite(problem.log_prob([1.3, 0.1]))


def test_several_tests():
    tests = [
        fmu.Test(name, fmu.ModalData(f, sd_hz=0.01)) for name, f in (("a", [1.7, 4.8]), ("b", [1.6, 4.9, 7.7]))
    ]
    problem = fmu.JointProblem(
        building(),
        tests,
        parameters(),
        varies={"k3": "test"},
        pairing="index",
        discrepancy=fmu.Discrepancy(by="group"),
    )
    assert problem.names == ("k1", "k3 [a]", "k3 [b]", "k4", "tau k1", "tau k2", "tau k3", "tau k4")
    theta = problem.start * np.random.default_rng(1).uniform(0.9, 1.1, (3, problem.ndim))
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-4 * theta, order=4, of_largest=1e-6)
    assert_array_equal(problem.values(theta)[:, :, 1], np.full((3, 2), HELD))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"held": NAMES}, "parameters: one at least must be updated"),
        ({"model": fmu.BlackBoxModel(lambda theta: np.sqrt(theta), 4)}, "k2.updated: must be true"),
    ],
)
def test_what_makes_no_sense_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        fmu.UpdatingProblem(change.get("model", building()), data(), parameters(change.get("held", ("k2",))))


@pytest.mark.parametrize("key", ["varies", "slopes"])
def test_what_is_not_updated_does_not_vary(key):
    tests = [
        fmu.Test(name, fmu.ModalData([1.7, 4.8], sd_hz=0.01), covariates={"T": t}) for t, name in enumerate("ab")
    ]
    how = {"varies": {"k2": "test"}, "slopes": {"k2": {"T": fmu.Normal(0.1)}}}[key]
    with pytest.raises(ValueError, match=f"{key}.k2: must not be given for a parameter that is not updated"):
        fmu.JointProblem(building(), tests, parameters(), pairing="index", **{key: how})
