"""Several tests of one structure: one log-probability, put together by hand here."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.stats
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.posterior.joint.modal_test import TestsError
from tests.gradients import assert_gradient
from tests.shear_building import shear_building, storey

STOREYS = [storey(0, 2), storey(1, 2)]
MASS = np.diag([1000.0, 1000.0])
K1 = fmu.Parameter("k1", 2e6, 1e6, 3e6, prior=fmu.Normal(3e5, mean=2e6), unit="N/m")
K2 = fmu.Parameter("k2", 2e6, 1e6, 3e6, unit="N/m")
SENSORS = ((0, "x"), (1, "x"))


@pytest.fixture(scope="module")
def building():
    return shear_building(["k1", "k2"], mass=MASS)


def frequencies(k, mass=MASS, stiffness=0.0):
    K = k[0] * STOREYS[0] + k[1] * STOREYS[1] + stiffness
    return np.sqrt(scipy.linalg.eigh(K, mass, eigvals_only=True)) / (2 * np.pi)


def measured(k, shift=0.0, modes=(0, 1), **changes):
    f = frequencies(k, **changes)[list(modes)] * (1 + shift)
    labels = tuple(f"mode {m + 1}" for m in modes)
    return fmu.ModalData(f, sd_hz=0.01 * f, labels=labels, numbers=tuple(m + 1 for m in modes))


def log_likelihood(data, f):
    modes = np.array(data.numbers) - 1
    return scipy.stats.norm.logpdf(data.frequencies_hz, f[modes], data.sd_hz).sum()


def test_shared_and_own_parameters_give_the_sum_of_all_tests(building):
    data = [measured((2e6, 2e6)), measured((2.2e6, 1.9e6), 0.01, modes=(0,)), measured((1.9e6, 2.1e6))]
    tests = [fmu.Test(name, one) for name, one in zip("abc", data, strict=True)]
    problem = fmu.JointProblem(building, tests, [K1, K2], varies={"k2": "test"}, pairing="index", reduction=False)
    assert problem.names == ("k1", "k2 [a]", "k2 [b]", "k2 [c]")
    assert problem.data.labels == ("a: mode 1", "a: mode 2", "b: mode 1", "c: mode 1", "c: mode 2")
    theta = np.array([2.1e6, 1.8e6, 2.3e6, 2.6e6])
    expected = sum(log_likelihood(d, frequencies((theta[0], k))) for d, k in zip(data, theta[1:], strict=True))
    assert_allclose(problem.log_likelihood(theta), expected, rtol=1e-11)
    prior = fmu.UpdatingProblem(building, data[0], [K1, K2], pairing="index").log_prior(theta[:2])
    assert_allclose(problem.log_prior(theta), prior - 2 * np.log(2e6), rtol=1e-12)
    assert_allclose(problem.values(theta)[:, 0], theta[0], rtol=0)
    assert_allclose(problem.values(theta)[:, 1], theta[1:], rtol=0)


def test_groups_share_a_value(building):
    tests = [fmu.Test(f"t{i}", measured((2e6, 2e6), 1e-3 * i), group="old" if i < 2 else "new") for i in range(3)]
    problem = fmu.JointProblem(building, tests, [K1, K2], varies={"k1": "group"}, pairing="index")
    assert problem.names == ("k1 [old]", "k1 [new]", "k2")
    assert_allclose(problem.values([1.5e6, 1.6e6, 2e6])[:, 0], [1.5e6, 1.5e6, 1.6e6], rtol=0)


def test_added_masses_and_springs_are_those_of_the_matrices(building):
    plain, heavy, held = (
        fmu.Test("plain", measured((2e6, 2e6))),
        fmu.Test("heavy", measured((2e6, 2e6)), masses={1: 150.0}),
        fmu.Test("held", measured((2e6, 2e6)), springs={(0, "x"): 4e5}),
    )
    problem = fmu.JointProblem(building, [plain, heavy, held], [K1, K2], pairing="index", reduction=False)
    k = np.array([2.1e6, 1.7e6])
    computed = problem.frequencies(k)
    assert_allclose(computed[:2], frequencies(k), rtol=1e-12)
    assert_allclose(computed[2:4], frequencies(k, MASS + np.diag([0.0, 150.0])), rtol=1e-12)
    assert_allclose(computed[4:], frequencies(k, stiffness=np.diag([4e5, 0.0])), rtol=1e-12)
    assert len(problem.model.configurations) == 3


def test_a_parameter_known_in_one_test(building):
    tests = [
        fmu.Test("as built", measured((2e6, 2e6))),
        fmu.Test("cut", measured((2e6, 1.2e6)), known={"k2": 1.2e6}),
    ]
    problem = fmu.JointProblem(building, tests, [K1, K2], pairing="index", reduction=False)
    theta = np.array([1.8e6, 2.5e6])
    assert_allclose(problem.frequencies(theta)[2:], frequencies((1.8e6, 1.2e6)), rtol=1e-12)
    assert_array_equal(problem.values(theta)[1], [1.8e6, 1.2e6])
    assert_gradient(problem.log_prob_and_grad(theta)[1], problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-6)


@pytest.mark.parametrize("distribution", ["normal", "log-normal"])
@pytest.mark.parametrize("noise", [0.002, 0.2], ids=["centred", "not centred"])
def test_gradient_of_everything_at_once(building, distribution, noise):
    rng = np.random.default_rng(3)
    tests = []
    for t in range(6):
        f = frequencies(2e6 * (1 + 0.1 * rng.standard_normal(2)))
        changes = {"masses": {1: 50.0}} if t == 5 else {"known": {"k1": 1.9e6}} if t == 4 else {}
        data = fmu.ModalData(f, sd_hz=noise * f)
        tests.append(fmu.Test(f"t{t}", data, group="ab"[t % 2], covariates={"temperature": 4.0 * t}, **changes))
    problem = fmu.JointProblem(
        building,
        tests,
        [K1, K2],
        varies={"k1": fmu.Population(distribution), "k2": "group"},
        slopes={"k1": {"temperature": fmu.Normal(0.005)}, "k2": {"temperature": fmu.Normal(0.005)}},
        pairing="index",
        reduction=False,
    )
    centring = problem.layout.drawn[0].centring
    assert np.all(centring[[0, 1, 2, 3, 5]] > 0.5) if noise < 0.1 else np.all(centring == 0.0)
    assert centring[4] == 0.0  # where k1 is known there is no score
    assert not [name for name in problem.names if name.startswith("k1 score [t4")]
    theta = problem.sample_prior(np.random.default_rng(1), 4)
    values, gradients = problem.log_prob_and_grad(theta)
    assert_allclose(values, problem.log_prob(theta), rtol=1e-12)
    assert_gradient(gradients, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-5, of_largest=1e-6)


def test_sensitivities_of_residuals_have_the_covariates_of_their_tests(building):
    given = (("a", 4.0, (2e6, 2e6)), ("b", 7.0, (2.2e6, 1.9e6)), ("c", 22.0, (1.9e6, 2.1e6)))
    tests = [fmu.Test(name, measured(k), covariates={"temperature": T}) for name, T, k in given]
    slopes = {"k1": {"temperature": fmu.Normal(0.005)}}
    problem = fmu.JointProblem(
        building, tests, [K1, K2], varies={"k2": "test"}, slopes=slopes, pairing="index", reduction=False
    )

    def residuals(theta):
        return problem.likelihood.residuals_and_slopes(problem.layout.of_model(theta))[0]

    theta = problem.sample_prior(np.random.default_rng(3), 2)
    step = 1e-4 * problem.scale
    assert_gradient(problem.sensitivity(theta), residuals, theta, step, order=4, of_largest=1e-8)


def test_log_prob_of_a_batch_is_that_of_each_point(building):
    tests = [fmu.Test(f"t{t}", measured((2e6 * (1 + 0.03 * t), 2e6))) for t in range(4)]
    problem = fmu.JointProblem(building, tests, [K1, K2], varies={"k1": fmu.Population()}, pairing="index")
    theta = problem.sample_prior(np.random.default_rng(0), 5)
    assert_array_equal(problem.log_prob(theta), [problem.log_prob(point) for point in theta])


def test_errors_of_shapes_and_inferred_deviations_over_tests(building):
    shapes = np.array([[0.6, 1.0], [1.0, -0.6]])
    f = frequencies((2e6, 2e6))
    data = fmu.ModalData(f, sensors=SENSORS, shapes=shapes, sd_hz=0.01 * f)
    tests = [fmu.Test(name, data, masses={} if name == "a" else {1: 80.0}) for name in "ab"]
    noise = fmu.Parameter("s", 0.05, 0.0, 1.0, prior=fmu.HalfNormal(0.1))
    errors = [fmu.FrequencyErrors("absolute"), fmu.ShapeErrors(noise)]
    problem = fmu.JointProblem(building, tests, [K1, K2], varies={"k1": "test"}, error=errors, reduction=False)
    assert problem.names == ("k1 [a]", "k1 [b]", "k2", "s")
    theta = np.array([1.9e6, 2.2e6, 2.1e6, 0.07])
    parts = [
        fmu.UpdatingProblem(
            building if name == "a" else shear_building(["k1", "k2"], mass=[1000.0, 1080.0]),
            data,
            [K1, K2],
            error=errors,
        ).log_likelihood([k1, 2.1e6, 0.07])
        for name, k1 in (("a", 1.9e6), ("b", 2.2e6))
    ]
    assert_allclose(problem.log_likelihood(theta), sum(parts), rtol=1e-11)
    assert_gradient(problem.log_prob_and_grad(theta)[1], problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-5)


def test_every_mistake_is_told_with_its_place(building):
    f = frequencies((2e6, 2e6))
    tests = [
        fmu.Test("a", measured((2e6, 2e6)), group="x", covariates={"temperature": 3.0}),
        fmu.Test("a", measured((2e6, 2e6)), group="x"),
        fmu.Test("b", fmu.ModalData(f, sd_hz=f, labels=("p", "q")), group="", known={"k9": 1.0}),
    ]
    with pytest.raises(TestsError) as told:
        fmu.JointProblem(
            building,
            tests,
            [K1, K2],
            varies={"k1": "group", "k2": "tset"},
            slopes={"k2": {"temperature": fmu.Normal(1.0)}},
        )
    assert told.value.mistakes == (
        "tests.1.name: must not be that of tests.0 (got 'a')",
        "tests.2.known: must name parameters among k1, k2 (got 'k9')",
        "tests.2.group: must be given, as k1 varies by group (got none)",
        "varies.k2: must be one of shared, test, group, a Population or Damage or UndatedDamage (got 'tset')",
        "tests.1.covariates: must have temperature, on which k2 depends (got none)",
        "tests.2.covariates: must have temperature, on which k2 depends (got none)",
    )
    known = fmu.Test("b", measured((2e6, 2e6)), known={"k1": 2e6})
    with pytest.raises(TestsError, match=r"needs two tests or more \(got 1\)"):
        fmu.JointProblem(building, [tests[0], known], [K1, K2], varies={"k1": "test"})
    with pytest.raises(TestsError, match=r"tests\.1\.masses\.7: must be a place that is free to move"):
        fmu.JointProblem(building, [tests[0], fmu.Test("b", measured((2e6, 2e6)), masses={7: 1.0})], [K1, K2])


def test_shapes_that_cannot_be_compared_are_told(building):
    f, shapes = np.array([4.0, 10.0]), np.array([[0.5, 1.0], [1.0, -0.5]])
    one, turned = (fmu.ModalData(f, sensors=of, shapes=shapes, sd_hz=0.1) for of in (SENSORS, SENSORS[::-1]))
    tests = [fmu.Test("one", one), fmu.Test("turned", turned), fmu.Test("none", fmu.ModalData(f, sd_hz=0.1))]
    errors = [fmu.FrequencyErrors("absolute"), fmu.ShapeErrors(0.02)]
    with pytest.raises(TestsError) as told:
        fmu.JointProblem(building, tests, [K1, K2], error=errors)
    assert told.value.mistakes == (
        "tests.1.sensors: must be those of tests.0, in their order, as shapes are compared",
        "tests.2.shapes: must be given, as shapes are compared (got none)",
    )
    known = [fmu.Test(name, one, known={"k1": 2e6}) for name in "ab"]
    with pytest.raises(TestsError, match=r"must be unknown in one of them; otherwise it is no parameter"):
        fmu.JointProblem(building, known, [K1, K2])


BY_KEY = pytest.mark.parametrize(("key", "word"), [("numbers", "number"), ("counterparts", "counterpart")])


def contradiction(model, key, *given):
    """Return the message about tests with the given labels, and the given numbers or counterparts.

    A test with other sensors comes before them. It has all labels, and therefore a mode in common with each.
    """
    every = list(dict.fromkeys(label for labels, _ in given for label in labels))
    first = fmu.ModalData(1.0 + np.arange(len(every)), sensors=SENSORS[:1], sd_hz=0.1, labels=tuple(every))
    tests = [fmu.Test("first", first)]
    for labels, of in given:
        data = fmu.ModalData(1.0 + np.arange(len(of)), sensors=SENSORS, sd_hz=0.1, labels=labels, **{key: of})
        tests.append(fmu.Test(f"t{len(tests)}", data))
    with pytest.raises(TestsError) as told:
        fmu.JointProblem(model, tests, [K1, K2], pairing="index", reduction=False)
    return str(told.value)


@BY_KEY
def test_tests_that_disagree_on_a_mode_are_told_on_what(building, key, word):
    said = contradiction(building, key, (("p", "q"), (1, 2)), (("p", "q"), (2, 1)))
    assert said == f"tests.2.{key}: mode 'p' must have the {word} that it has in tests.1, 1 (got 2)"


@BY_KEY
def test_modes_with_one_number_or_counterpart_are_told_with_their_tests(key, word):
    three = shear_building(["k1", "k2", "k2"], mass=np.diag([1000.0] * 3))
    said = contradiction(three, key, (("p", "q"), (1, 2)), (("p", "r"), (1, 2)))
    rule = f"mode 'r' must not have the {word} of mode 'q' in tests.1 (got 2 for both)"
    advice = f"give each its own {word} or, if they are one mode, the same label"
    assert said == f"tests.2.{key}: {rule}; {advice}"


def test_a_mode_without_a_counterpart_is_told_with_its_test(building):
    f = np.array([4.0, 10.0])
    one = fmu.ModalData(f, sd_hz=0.1, sensors=SENSORS, labels=("p", "q"), counterparts=(1, 2))
    two = fmu.ModalData(f, sd_hz=0.1, sensors=SENSORS, labels=("p", "r"), shapes=np.eye(2))
    with pytest.raises(TestsError, match=r"^tests\.1\.counterparts: mode 'r' must have a counterpart"):
        fmu.JointProblem(building, [fmu.Test("one", one), fmu.Test("two", two)], [K1, K2])


class PairedModes:
    """A user's model that pairs its modes itself: p, q and r."""

    n_parameters, n_modes = 2, 3

    def frequencies(self, theta):
        return np.stack([theta[:, 0], theta[:, 1], theta.sum(axis=1)], axis=1)

    def frequencies_and_gradient(self, theta):
        gradient = np.tile(np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]), (len(theta), 1, 1))
        return self.frequencies(theta), gradient


def of_user(*labels):
    """Return the joint problem of a user's model for tests with the given labels and different sensors."""
    known = {"p": 1.0, "q": 2.0, "r": 3.0, "s": 4.0}
    tests = [
        fmu.Test(f"t{t}", fmu.ModalData([known[one] for one in own], labels=own, sd_hz=0.1, sensors=SENSORS[:t]))
        for t, own in enumerate(labels)
    ]
    return fmu.JointProblem(PairedModes(), tests, [fmu.Parameter(name, 1.5, 0.5, 4.0) for name in "ab"])


def test_a_users_paired_model_gives_each_test_its_own_modes():
    problem = of_user(("p", "q"), ("r", "p"), ("q", "r", "p"))
    theta = np.array([1.1, 2.3])
    assert_allclose(problem.frequencies(theta), [1.1, 2.3, 3.4, 1.1, 2.3, 3.4, 1.1], rtol=1e-14)
    assert_gradient(problem.log_prob_and_grad(theta)[1], problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-6)
    few = r"^tests: must together have the 3 modes of the model, in its order \(got 2: p, q\)$"
    with pytest.raises(TestsError, match=few):
        of_user(("p", "q"), ("q",))
    with pytest.raises(TestsError, match=r"\(got 4: p, q, r, s\)"):
        of_user(("p", "q", "r"), ("p", "s"))


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_users_paired_model_of_tests_that_missed_a_mode(order):
    """Mode 2 of the first test, whichever that is, is mode 2 of the model, not its last one."""
    modes = fmu.ModalData([1.0, 2.0, 3.0], sd_hz=0.1)
    every = [fmu.Test("A", modes.with_frequencies(np.array([1.0, np.nan, 3.0]))), fmu.Test("B", modes)]
    parameters = [fmu.Parameter("a", 1.0, 0.5, 2.0), fmu.Parameter("b", 2.0, 0.5, 4.0)]
    problem = fmu.JointProblem(PairedModes(), [every[t] for t in order], parameters)
    assert_allclose(problem.frequencies(np.array([1.0, 2.0])), problem.data.frequencies_hz, rtol=1e-14)


def test_a_test_of_some_modes_without_counterparts_has_those_of_the_other_test():
    building = shear_building(["k1", "k2", "k3"], 1e6, 1000.0)
    f = np.sqrt(scipy.linalg.eigh(building.K(np.ones(3)).toarray(), np.eye(3) * 1e3, eigvals_only=True)) / (
        2 * np.pi
    )
    missed = fmu.ModalData(f, sd_hz=0.02).with_frequencies(np.array([np.nan, f[1], f[2]]))
    upper = fmu.ModalData(f[1:], numbers=(2, 3), labels=("2", "3"), sd_hz=0.02)
    tests = [fmu.Test("A", missed), fmu.Test("B", upper)]
    problem = fmu.JointProblem(building, tests, [fmu.Parameter(f"k{i}", 1.0, 0.5, 2.0) for i in (1, 2, 3)])
    assert_allclose(problem.frequencies(np.ones(3)), problem.data.frequencies_hz, rtol=1e-6)


def test_numbers_that_pairing_by_shape_does_not_follow_are_refused():
    """Also of tests that missed a mode: there a mode's place must not stand in for the number that was given."""
    building = shear_building(["k1", "k2", "k3"], 1e6, 1000.0)
    modes = fmu.ModalData([2.0, 3.0], numbers=(1, 3), sd_hz=0.02)
    tests = [fmu.Test("A", modes), fmu.Test("B", modes.with_frequencies(np.array([2.0, np.nan])))]
    k = [fmu.Parameter(f"k{i}", 1.0, 0.5, 2.0) for i in (1, 2, 3)]
    with pytest.raises(TestsError, match=r"^tests\.0\.numbers: must be those .* number 3"):
        fmu.JointProblem(building, tests, k)
    assert fmu.JointProblem(building, tests, k, pairing="index").data.numbers == (1, 3, 1)
    chosen = [replace(test, data=replace(test.data, counterparts=test.data.numbers)) for test in tests]
    two = [fmu.JointProblem(building, chosen, k, pairing=pairing) for pairing in ("shape", "index")]
    assert_allclose(two[0].frequencies(np.ones(3)), two[1].frequencies(np.ones(3)), rtol=1e-12)


def test_a_complete_test_beside_one_that_missed_a_mode():
    building = shear_building(["k1", "k2", "k3"], 1e6, 1000.0)
    f = np.sqrt(scipy.linalg.eigh(building.K(np.ones(3)).toarray(), np.eye(3) * 1e3, eigvals_only=True))
    modes = fmu.ModalData(f / (2 * np.pi), sd_hz=0.02)
    tests = [
        fmu.Test("A", modes),
        fmu.Test("B", modes.with_frequencies(np.array([f[0], np.nan, f[2]]) / 2 / np.pi)),
    ]
    problem = fmu.JointProblem(building, tests, [fmu.Parameter(f"k{i}", 1.0, 0.5, 2.0) for i in (1, 2, 3)])
    assert_allclose(problem.frequencies(np.ones(3)), problem.data.frequencies_hz, rtol=1e-6)


def test_stiffness_and_mass_are_told_apart_by_a_known_mass():
    """One test gives the ratio of stiffness and mass alone; with 300 kg added it gives both."""
    model = fmu.SeparableModel.from_terms(
        ["k", "m"], [(2e6 * (STOREYS[0] + STOREYS[1]), "k")], [(MASS, "m")], dofs=[("first", "x"), ("roof", "x")]
    )
    parameters = [fmu.Parameter(name, 1.0, 0.3, 3.0) for name in ("k", "m")]
    f, loaded = frequencies((2e6, 2e6)), frequencies((2e6, 2e6), MASS + np.diag([0.0, 300.0]))
    one, two = (fmu.ModalData(x, sd_hz=0.001 * x) for x in (f, loaded))
    alone = fmu.UpdatingProblem.reduced(model, one, parameters, pairing="index")
    both = fmu.JointProblem(
        model,
        [fmu.Test("plain", one), fmu.Test("loaded", two, masses={"roof": 300.0})],
        parameters,
        pairing="index",
    )
    assert alone.ndim == both.ndim == 2
    contraction = []
    for problem in (alone, both):
        trace = fmu.sample(problem, draws=100, warmup=80, seed=4, maxima=fmu.find_map(problem, starts=4))
        contraction.append(fmu.summary(trace).loc["m", "sd"] / (2.7 / np.sqrt(12)))
    # the ridge k/m = 1 across the box, and 1.1 % of m by first-order propagation of 0.1 % of four frequencies
    assert contraction[0] > 0.5
    assert contraction[1] < 0.05
    assert_allclose(fmu.summary(trace).loc["m", "mean"], 1.0, atol=4 * fmu.summary(trace).loc["m", "sd"])


@pytest.mark.parametrize("pairing", ["shape", "index"])
def test_a_test_that_removes_more_than_all_mass_is_named(pairing):
    model = fmu.SeparableModel.from_terms(
        ["k"], [(STOREYS[0] + STOREYS[1], "k")], [MASS], dofs=[(3, "x"), (4, "x")]
    )
    model.place_names = {4: "roof"}
    f = frequencies((1.0, 1.0))
    data = fmu.ModalData(f, sd_hz=0.1 * f)
    tests = [fmu.Test("plain", data), fmu.Test("loaded", data, masses={4: -MASS[1, 1] - 3.0})]
    reason = "M is not positive semidefinite: its diagonal is -3 at node roof x"
    with pytest.raises(ValueError, match=rf"^start: must have .* in test loaded \(got .*{reason}\); correct"):
        fmu.JointProblem(model, tests, [fmu.Parameter("k", 1.0, 0.5, 2.0)], pairing=pairing)


def test_a_mode_missed_in_a_table_leaves_the_others_in_their_places(tmp_path):
    """The first row misses mode 2, and the only row with an added mass misses mode 1."""
    names, mass = ("k1", "k2", "k3"), np.diag([1000.0, 1000.0, 1200.0])
    building = shear_building(list(names), 1e6, 1000.0)
    K = building.K(np.ones(3)).toarray()
    f, g = (np.sqrt(scipy.linalg.eigh(K, M, eigvals_only=True)) / (2 * np.pi) for M in (np.eye(3) * 1e3, mass))
    rows = [f"A,{f[0]},,{f[2]}", f"B,{f[0]},{f[1]},{f[2]}"], [f"C,,{g[1]},{g[2]}"]
    tests = []
    for k, (lines, masses) in enumerate(zip(rows, ({}, {2: 200.0}), strict=True)):
        file = tmp_path / f"{k}.csv"
        file.write_text("\n".join(["name,1,2,3", *lines]), encoding="utf-8")
        tests += fmu.Test.from_csv(file, ["1", "2", "3"], sd_hz=0.02, masses=masses)
    problem = fmu.JointProblem(building, tests, [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in names])
    assert_allclose(problem.frequencies(np.ones(3)), problem.data.frequencies_hz, rtol=1e-6)
    assert_allclose(problem.frequencies(np.ones(3)), [f[0], f[2], *f, *g[1:]], rtol=1e-6)
