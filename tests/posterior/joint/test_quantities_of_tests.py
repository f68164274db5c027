"""Weighed masses and static displacements of single tests among several: the sum of what each test says."""

import pickle

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu import cli
from fmu.config import ConfigurationError
from fmu.posterior.joint.joint_problem import simulate_next_test
from fmu.posterior.joint.modal_test import TestsError
from tests.gradients import assert_gradient
from tests.posterior.errors.test_quantities import cantilever
from tests.shear_building import shear_building

PARAMETERS = [
    fmu.Parameter("k1", 5.7e7, 1e7, 1e8),
    fmu.Parameter("k2", 1.7e7, 5e6, 5e7),
    fmu.Parameter("mu", 16e3, 1e4, 3e4),
]
BARE, LADEN = fmu.MassErrors(mass=32.5e3, sd=300.0), fmu.MassErrors(mass=33.4e3, sd=200.0)
STATIC = fmu.StaticErrors(force=(1, "x"), load=1e4, displacement=8e-4, sd=1e-5)
CHANGES = {
    "bare": {},
    "laden": {"masses": {1: 1e3}},
    "held": {"springs": {(0, "x"): 2e7}},
    "known": {"known": {"k2": 2e7}},
}
MEASURED = {"bare": [BARE], "laden": [LADEN, STATIC], "held": [STATIC], "known": [STATIC]}


def chain():
    """Return two masses on two springs: frequencies tell k/m alone."""
    return shear_building(["k1", "k2"], mass_name="mu", dofs=[(0, "x"), (1, "x")])


def data(shift=0.0):
    return fmu.ModalData(np.array([4.2, 10.8]) * (1.0 + shift), sd_hz=[0.01, 0.02], numbers=(1, 2))


def in_test(error, name):
    return type(error)(**{**vars(error), "test": name})


def errors():
    return [in_test(error, name) for name, measured in MEASURED.items() for error in measured]


def joint(error=None, **varies):
    tests = [
        fmu.Test(name, data(0.001 * i), group=name[:1], covariates={"temperature": 5.0 * i}, **changes)
        for i, (name, changes) in enumerate(CHANGES.items())
    ]
    options = varies.pop("options", {})
    return fmu.JointProblem(
        chain(), tests, PARAMETERS, varies=varies, pairing="index", error=error or errors(), **options
    )


def points(problem, n=4):
    theta = problem.sample_prior(np.random.default_rng(3), n)
    return problem.start + 0.2 * (theta - problem.start)


def test_the_density_is_the_sum_of_those_of_single_tests():
    """Of tests without changes, each by itself."""
    tests = [fmu.Test(name, data(shift)) for name, shift in (("a", 0.0), ("b", 0.01))]
    error = [in_test(BARE, "a"), in_test(LADEN, "b"), in_test(STATIC, "b")]
    both = fmu.JointProblem(chain(), tests, PARAMETERS, pairing="index", error=error)
    theta = points(both)
    single = [
        fmu.UpdatingProblem(chain(), test.data, PARAMETERS, pairing="index", error=own)
        for test, own in zip(tests, ([BARE], [LADEN, STATIC]), strict=True)
    ]
    assert_allclose(both.log_likelihood(theta), sum(one.log_likelihood(theta) for one in single), rtol=1e-9)
    assert both.log_likelihood_terms(theta).shape == (4, 7)
    assert_array_equal(both.log_prob(theta), [both.log_prob(one) for one in theta])


def test_each_is_of_the_structure_as_it_was_in_its_test():
    theta = np.array([[5e7, 2.5e7, 1.7e4]])
    k1, k2, mu = theta[0]
    problem = joint()
    of_model = problem.model_parameters(theta)
    terms = problem.likelihood.quantities
    found = {label: term.computed(of_model)[0][0] for term in terms for label in term.labels}
    assert set(found) == {
        "bare: mass",
        "laden: mass",
        *(f"{name}: displacement of 1 x" for name in ("laden", "held", "known")),
    }
    assert_allclose(found["bare: mass"], 2 * mu)
    assert_allclose(found["laden: mass"], 2 * mu + 1e3)
    assert_allclose(found["laden: displacement of 1 x"], 1e4 * (1 / k1 + 1 / k2), rtol=1e-9)
    assert_allclose(found["held: displacement of 1 x"], 1e4 * (1 / (k1 + 2e7) + 1 / k2), rtol=1e-9)
    assert_allclose(found["known: displacement of 1 x"], 1e4 * (1 / k1 + 1 / 2e7), rtol=1e-9)


@pytest.mark.parametrize(
    "varies",
    [
        {},
        {"k1": "test", "k2": "group"},
        {"k1": fmu.Population(), "mu": fmu.Population("log-normal")},
        {
            "k1": fmu.Damage(),
            "k2": fmu.Population(),
            "options": {"slopes": {"k2": {"temperature": fmu.Normal(0.01)}}},
        },
        {"k1": fmu.Population(), "k2": fmu.Population(), "options": {"correlation": 2.0}},
    ],
    ids=["shared", "by test and group", "populations", "damage and a slope", "correlated"],
)
@pytest.mark.usefixtures("half_centred")
def test_gradients_are_exact(varies):
    problem = joint(**varies)
    theta = points(problem)
    value, gradient = problem.log_prob_and_grad(theta)
    assert_allclose(value, problem.log_prob(theta), rtol=1e-12)
    # a central difference over 1e-6 of the scale keeps about half of the digits of the density
    assert_gradient(gradient, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-5, of_largest=1e-6)
    scaled = np.abs(gradient * problem.scale).max()
    slope = problem.quadratic(theta)[1]
    assert problem.log_likelihood_terms(theta).shape[1] == 13
    assert_allclose(slope + problem.prior.log_pdf_gradient(theta), gradient, rtol=1e-9, atol=1e-9 * scaled)


def test_k_and_m_are_separated_in_all_tests():
    """By what was measured in one of them."""
    tests = [fmu.Test(name, data(shift)) for name, shift in (("a", 0.0), ("b", 0.001))]
    error = [in_test(BARE, "b"), in_test(STATIC, "b")]
    plain, both = (
        fmu.JointProblem(chain(), tests, PARAMETERS, varies={"k1": "test"}, pairing="index", error=of)
        for of in ("frequency", error)
    )
    traces = [
        fmu.sample(problem, draws=60, warmup=60, chains=2, seed=1, maxima=fmu.find_map(problem, starts=1))
        for problem in (plain, both)
    ]
    narrower = [fmu.summary(trace)["sd"] for trace in traces]
    assert np.all(narrower[0] / narrower[1] > 5.0)
    assert list(traces[1]["quantities"]["datum"].to_numpy()) == ["b: mass", "b: displacement of 1 x"]
    checks = {
        check.of for check in fmu.diagnose(traces[1], both).fit.checks if check.kind == "mass or displacement"
    }
    assert checks == {"b: mass", "b: displacement of 1 x"}


def test_simulation_and_prediction_are_of_the_frequencies():
    problem, plain = joint(k1="test"), joint("frequency", k1="test")
    theta = points(problem)
    both = [simulate_next_test(one, np.random.default_rng(1), theta, "laden") for one in (problem, plain)]
    assert_array_equal(both[0], both[1])
    frequencies = problem.frequencies(theta)
    assert_array_equal(*(one.simulate_data(np.random.default_rng(1), frequencies) for one in (problem, plain)))


@pytest.mark.parametrize("name", [None, "winter"])
def test_the_test_must_be_named(name):
    with pytest.raises(TestsError) as refused:
        joint([fmu.FrequencyErrors(sd=0.1), in_test(BARE, name)])
    got = "none" if name is None else "'winter'"
    assert str(refused.value) == (
        f"error.1.test: must be the test in which it was measured, one of bare, laden, held, known (got {got})"
    )


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"^test: must not be given where there is one test only \(got 'a'\)"):
        cantilever([in_test(fmu.MassErrors(mass=10.0, sd=0.1), "a")])
    with pytest.raises(
        ValueError, match=r"^error\.0\.force: must be a place and a direction that are free to move"
    ):
        joint([fmu.StaticErrors(force=(7, "x"), load=1.0, displacement=1e-3, sd=1e-4, test="held")])
    tests = [fmu.Test(name, fmu.ModalData([1.0], sd_hz=0.1)) for name in "ab"]
    model = fmu.BlackBoxModel(lambda theta: np.array([1.0]), 1)
    with pytest.raises(
        TestsError, match=r"^error\.0: a mass or a displacement needs a model with matrices, .* \(got Bl"
    ):
        fmu.JointProblem(model, tests, [fmu.Parameter("k", 1.0, 0.5, 2.0)], error=in_test(BARE, "a"))


FILE = """
name = "chain"
pairing = "index"

[model]
type = "matrices"
dofs = [["low", "x"], ["top", "x"]]
stiffness = [
  { matrix = [[1, 0], [0, 0]], powers = { k1 = 1 } },
  { matrix = [[1, -1], [-1, 1]], powers = { k2 = 1 } },
]
mass = [{ matrix = [[1, 0], [0, 1]], powers = { mu = 1 } }]

[[tests]]
name = "bare"
frequencies = [4.2, 10.8]
sd = [0.01, 0.02]

[[tests]]
name = "laden"
frequencies = [4.2042, 10.8108]
sd = [0.01, 0.02]
masses = [{ place = "top", mass = 1e3 }]

[[error]]
of = "mass"
test = "bare"
mass = 32.5e3
sd = 300

[[error]]
of = "static"
test = "laden"
force = ["top", "x"]
load = 1e4
displacement = 8e-4
sd = 1e-5

[[parameters]]
name = "k1"
start = 5.7e7
lower = 1e7
upper = 1e8
varies = "test"

[[parameters]]
name = "k2"
start = 1.7e7
lower = 5e6
upper = 5e7

[[parameters]]
name = "mu"
start = 16e3
lower = 1e4
upper = 3e4
"""


def test_in_a_problem_file(tmp_path):
    (tmp_path / "chain.toml").write_text(FILE)
    problem = fmu.load(tmp_path / "chain.toml")
    tests = [fmu.Test("bare", data()), fmu.Test("laden", data(0.001), masses={1: 1e3})]
    error = [in_test(BARE, "bare"), in_test(STATIC, "laden")]
    same = fmu.JointProblem(chain(), tests, PARAMETERS, varies={"k1": "test"}, pairing="index", error=error)
    theta = points(same)
    assert_allclose(problem.log_prob(theta), same.log_prob(theta), rtol=1e-9)
    words = " ".join(str(fmu.check(problem)).split())
    assert "Measured besides, with Gaussian errors: bare: mass 32500 ± 300 kg" in words


@pytest.mark.usefixtures("no_pictures")
def test_a_run_of_a_problem_file_writes_them_into_its_page(tmp_path):
    (tmp_path / "chain.toml").write_text(FILE)
    options = ["--draws", "20", "--warmup", "30", "--chains", "2", "--out", str(tmp_path / "run"), "--report"]
    result = CliRunner().invoke(cli.main, ["run", str(tmp_path / "chain.toml"), *options], prog_name="fmu")
    assert result.exit_code == 0, result.output
    page = (tmp_path / "run" / "report" / "index.html").read_text(encoding="utf-8")
    assert "bare: mass 32500 ± 300 kg" in page
    assert "laden: displacement of top x" in page


def test_another_process_has_the_same_density():
    problem = joint(k1=fmu.Population())
    theta = points(problem)
    assert_array_equal(pickle.loads(pickle.dumps(problem)).log_prob(theta), problem.log_prob(theta))


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            'test = "bare"\n',
            "",
            "error.0.test: must be the test in which it was measured, one of bare, laden (got none)",
        ),
        (
            'test = "laden"\n',
            'test = "winter"\n',
            "error.1.test: must be the test in which it was measured, one of bare, l",
        ),
        (
            '["top", "x"]\nload',
            '["top", "y"]\nload',
            "error.1.force: must be a place and a direction that are free",
        ),
        ("sd = [0.01, 0.02]\nmasses", "masses", "tests.1"),
    ],
)
def test_mistakes_of_a_file_have_their_place(tmp_path, old, new, told):
    text = FILE.replace(old, new)
    assert text != FILE
    (tmp_path / "chain.toml").write_text(text)
    with pytest.raises(ConfigurationError) as refused:
        fmu.load(tmp_path / "chain.toml")
    assert told in str(refused.value)
