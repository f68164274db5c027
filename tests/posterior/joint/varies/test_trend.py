"""Laws of covariates: kinks, powers, sums, slopes in common; covariates that are missing or known with errors."""

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.posterior.joint.modal_test import TestsError
from tests.gradients import assert_gradient
from tests.shear_building import frequencies_hz, shear_building

NAMES = ("k1", "k2")
SLOPE = fmu.Normal(0.005)
TEMPERATURES = (-12.0, -5.0, -1.0, 3.0, 8.0, 15.0, 22.0, 30.0)
WIND = (3.0, 8.0, 1.0, 6.0, 2.0, 9.0, 4.0, 5.0)


@pytest.fixture(scope="module")
def building():
    return shear_building(NAMES, 2e6, 1000.0)


def measured(building, factors, noise=1e-3, seed=1, **covariates):
    """Return tests of a building whose storeys have the stiffness factors (n_tests, 2)."""
    rng, tests = np.random.default_rng(seed), []
    for t, of_test in enumerate(factors):
        f = frequencies_hz(building, of_test)[0]
        f = f * (1 + noise * rng.standard_normal(len(f)))
        here = {name: x[t] for name, x in covariates.items()}
        tests.append(fmu.Test(f"t{t}", fmu.ModalData(f, sd_hz=noise * f), covariates=here))
    return tests


def posed(building, tests, slopes, **options):
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    return fmu.JointProblem(building, tests, parameters, slopes=slopes, pairing="index", **options)


def campaign(building, temperature=TEMPERATURES, **others):
    return measured(building, np.ones((len(temperature), 2)), temperature=temperature, **others)


KINKED = fmu.PiecewiseLinear(SLOPE, kinks=[0.0])
LAWS = {
    "one kink": {"k1": {"temperature": KINKED}},
    "two kinks": {"k1": {"temperature": fmu.PiecewiseLinear(SLOPE, [-3.0, 10.0])}},
    "kink inferred": {"k1": {"temperature": fmu.PiecewiseLinear(SLOPE, fmu.Normal(8.0, mean=2.0))}},
    "cubic": {"k1": {"temperature": fmu.Polynomial([SLOPE, fmu.Normal(5e-5), fmu.Normal(1e-6)])}},
    "sum": {"k1": {"temperature": KINKED, "wind": SLOPE}},
    "in common": {"k1": {"temperature": "k2"}, "k2": {"temperature": KINKED, "wind": SLOPE}},
}
UNCERTAIN = {
    "all known": TEMPERATURES,
    "two missing": (None, *TEMPERATURES[1:5], None, *TEMPERATURES[6:]),
    "with errors": tuple(fmu.Normal(0.5, mean=x) for x in TEMPERATURES),
}


@pytest.mark.parametrize("varies", [{}, {"k1": fmu.Population(), "k2": "group"}], ids=["shared", "population"])
@pytest.mark.parametrize("temperature", UNCERTAIN)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.usefixtures("half_centred")
def test_gradient(building, law, temperature, varies):
    tests = campaign(building, UNCERTAIN[temperature], wind=WIND)
    tests = [fmu.Test(one.name, one.data, "ab"[t % 2], one.covariates) for t, one in enumerate(tests)]
    problem = posed(building, tests, LAWS[law], varies=varies, reduction=False)
    theta = problem.sample_prior(np.random.default_rng(2), 4)
    theta = 0.7 * problem.start + 0.3 * theta
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-4, of_largest=1e-6)


def test_a_straight_line_with_a_kink(building):
    problem = posed(building, campaign(building), LAWS["one kink"])
    assert problem.names == ("k1", "k1 per temperature below 0", "k1 per temperature above 0", "k2")
    x, x0 = np.array(TEMPERATURES), np.mean(TEMPERATURES)
    values = problem.values([1.1, -0.02, -0.003, 0.9])
    expected = 1.1 * (1 - 0.02 * np.minimum(x, 0.0) - 0.003 * (np.maximum(x, 0.0) - x0))
    assert_allclose(values[:, 0], expected, rtol=1e-14)
    assert_array_equal(values[:, 1], 0.9)
    straight = posed(building, campaign(building), {"k1": {"temperature": SLOPE}})
    assert_allclose(
        problem.values([1.1, -0.01, -0.01, 0.9]), straight.values([1.1, -0.01, 0.9]), rtol=1e-14
    )  # without a change of slope there is no kink


def test_an_inferred_kink_is_that_kink(building):
    inferred = posed(building, campaign(building), LAWS["kink inferred"])
    assert inferred.names[1:4] == (
        "k1 per temperature below kink",
        "k1 per temperature above kink",
        "k1 kink in temperature",
    )
    assert (inferred.lower[3], inferred.upper[3]) == (min(TEMPERATURES), max(TEMPERATURES))
    known = posed(building, campaign(building), {"k1": {"temperature": fmu.PiecewiseLinear(SLOPE, [3.7])}})
    found = inferred.values([1.1, -0.02, -0.003, 3.7, 0.9])
    assert_allclose(found, known.values([1.1, -0.02, -0.003, 0.9]), rtol=1e-14)


def test_a_polynomial(building):
    problem = posed(building, campaign(building), LAWS["cubic"])
    assert problem.names[1:4] == ("k1 per temperature", "k1 per temperature^2", "k1 per temperature^3")
    away = np.array(TEMPERATURES) - np.mean(TEMPERATURES)
    expected = 1.1 * (1 + np.polyval([2e-6, -1e-4, -0.01, 0.0], away))
    assert_allclose(problem.values([1.1, -0.01, -1e-4, 2e-6, 1.0])[:, 0], expected, rtol=1e-14)


def test_effects_of_two_covariates_add(building):
    tests = campaign(building, wind=WIND)
    problem = posed(building, tests, {"k1": {"temperature": SLOPE, "wind": SLOPE}})
    of_heat, of_wind = (np.array(x) - np.mean(x) for x in (TEMPERATURES, WIND))
    values = problem.values([1.1, -0.01, 0.02, 0.9])
    assert_allclose(values[:, 0], 1.1 * (1 - 0.01 * of_heat + 0.02 * of_wind), rtol=1e-14)


def test_slopes_in_common(building):
    problem = posed(building, campaign(building, wind=WIND), LAWS["in common"])
    of_both = ("k1 and k2 per temperature below 0", "k1 and k2 per temperature above 0")
    assert problem.names == ("k1", *of_both, "k2", "k2 per wind")
    values = problem.values([1.1, -0.02, -0.003, 0.9, 0.0])
    assert_allclose(values[:, 0] / 1.1, values[:, 1] / 0.9, rtol=1e-14)
    assert problem.roles[1] == ("slope", 1, "temperature")


def test_covariates_of_which_some_are_inferred(building):
    given = (None, *TEMPERATURES[1:6], fmu.Normal(0.5, mean=22.0), TEMPERATURES[7])
    problem = posed(building, campaign(building, given), {name: {"temperature": SLOPE} for name in NAMES})
    assert problem.names == (
        "k1", "temperature [t0]", "temperature [t6]", "k1 per temperature", "k2", "k2 per temperature",
    )  # fmt: skip
    assert problem.roles[1] == ("covariate", None, "t0")
    known = TEMPERATURES[1:]
    prior = problem.parameters[1].prior  # with the 95 % interval of one more value
    scale = np.std(known, ddof=1) * np.sqrt(1.0 + 1.0 / len(known))
    further = scipy.stats.t(len(known) - 1, np.mean(known), scale)
    assert_allclose([prior.mean - 1.959964 * prior.sd, prior.mean + 1.959964 * prior.sd], further.interval(0.95))
    assert problem.parameters[2].prior == fmu.Normal(0.5, mean=22.0)
    x = np.array(TEMPERATURES)
    x0 = (np.mean(known) + sum(known)) / 8
    x[0], x[6] = -40.0, 21.0
    values = problem.values([1.1, -40.0, 21.0, -0.01, 0.9, 0.002])
    assert_allclose(
        values, np.stack([1.1 * (1 - 0.01 * (x - x0)), 0.9 * (1 + 0.002 * (x - x0))], axis=1), rtol=1e-14
    )
    inferred = problem.configuration()["tests"][0]
    assert inferred["covariates"] == {}
    assert inferred["inferred_covariates"] == {"temperature": None}


def test_tests_at_one_temperature_are_solved_once_unless_it_is_inferred(building):
    twice = (*TEMPERATURES[2:5], *TEMPERATURES[2:5])
    problem = posed(building, campaign(building, twice), LAWS["one kink"])
    assert len(problem.model.configurations[0].distinct) == 3
    problem = posed(building, campaign(building, (None, *twice[1:])), LAWS["one kink"])
    assert len(problem.model.configurations[0].distinct) == 4


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("temperature", UNCERTAIN)
def test_the_box_holds_the_values(building, law, temperature):
    problem = posed(building, campaign(building, UNCERTAIN[temperature], wind=WIND), LAWS[law])
    low, high = problem.layout.box()
    values = problem.values(problem.sample_prior(np.random.default_rng(0), 400))
    assert np.mean((values >= low) & (values <= high)) > 0.998


def test_the_next_test_has_the_law_too(building):
    problem = posed(building, campaign(building), LAWS["one kink"])
    theta = np.array([[1.1, -0.02, -0.003, 0.9]])
    rng = np.random.default_rng(0)
    for t in (0, 6):
        found = problem.layout.of_next_test(theta, rng, np.zeros((1, 0)), 3, {"temperature": TEMPERATURES[t]})
        assert_allclose(found, problem.values(theta)[:, t], rtol=1e-14)
    at_mean = problem.layout.of_next_test(theta, rng, np.zeros((1, 0)), 0, {})
    assert_allclose(at_mean[0], [1.1, 0.9], rtol=1e-14)


def test_a_kink_is_recovered_that_a_straight_line_takes_for_a_change(building):
    """The intervals of both slopes and of the stiffness at 0 °C hold the truth; a straight line's do not."""
    x = np.linspace(-15.0, 25.0, 16)
    k1 = 1 - 0.01 * np.minimum(x, 0.0) - 0.003 * np.maximum(x, 0.0)
    tests = measured(building, np.stack([k1, np.ones(16)], axis=1), temperature=x)
    draws = {}
    for name, law, n in (("kink", KINKED, 200), ("line", SLOPE, 50)):
        problem = posed(building, tests, {"k1": {"temperature": law}})
        draws[name] = fmu.sample(problem, draws=n, warmup=60, seed=1, maxima=fmu.find_map(problem, starts=2))
    kinked = draws["kink"]["posterior"].to_dataset()
    assert fmu.summary(draws["kink"])["rhat"].max() < 1.03
    for name, truth in {"k1 per temperature below 0": -0.01, "k1 per temperature above 0": -0.003}.items():
        slope = kinked[name].to_numpy() * kinked["k1"].to_numpy()  # relative to the stiffness at the mean
        assert abs(slope.mean() - truth) < 4 * slope.std()
        assert slope.std() < 5e-4
    at = {name: trace["tests"]["k1"].to_numpy()[..., 6].ravel() for name, trace in draws.items()}  # at 1 °C
    assert abs(at["kink"].mean() - k1[6]) < 4 * at["kink"].std()
    assert abs(at["line"].mean() - k1[6]) > 8 * at["line"].std()


def test_a_missing_temperature_is_inferred(building):
    """One storey tells the temperature of the day on which the thermometer failed."""
    x = np.linspace(-15.0, 25.0, 12)
    factors = np.stack([1 - 0.01 * x, np.ones(12)], axis=1)
    tests = measured(building, factors, temperature=[None if t == 10 else x[t] for t in range(12)])
    problem = posed(building, tests, {"k1": {"temperature": SLOPE}})
    trace = fmu.sample(problem, draws=100, warmup=60, seed=1, maxima=fmu.find_map(problem, starts=2))
    found = trace["posterior"]["temperature [t10]"].to_numpy()
    assert abs(found.mean() - x[10]) < 4 * found.std()
    assert found.std() < 1.0  # of 12.4 before


WRONG = {
    "no kink": (lambda: fmu.PiecewiseLinear(SLOPE, []), "kinks: must be one value or several in ascending order"),
    "kinks descend": (lambda: fmu.PiecewiseLinear(SLOPE, [1.0, 1.0]), "kinks: must be one value or several"),
    "no prior": (lambda: fmu.Polynomial([]), "priors: must have a prior for each coefficient"),
    "nan": (
        lambda: fmu.Test("a", fmu.ModalData([1.0], sd_hz=0.1), covariates={"temperature": np.nan}),
        "covariates.temperature: must be a finite number, a Prior or None",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_settings(case):
    make, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        make()


CONTRADICTIONS = {
    "kink beyond": (
        {"k1": {"temperature": fmu.PiecewiseLinear(SLOPE, [40.0])}}, TEMPERATURES,
        "slopes.k1: the kinks in temperature must be between its values in the tests, -12 and 30 (got 40)",
    ),
    "prior beyond": (
        {"k1": {"temperature": fmu.PiecewiseLinear(SLOPE, fmu.ScaledBeta(2.0, 2.0, 50.0, 60.0))}}, TEMPERATURES,
        "slopes.k1: the kinks in temperature must be between its values in the tests, -12 and 30 (got a prior "
        "without probability there)",
    ),
    "chain": (
        {"k1": {"temperature": "k2"}, "k2": {"temperature": "k1"}}, TEMPERATURES,
        "slopes.k1: must name a parameter with a law of temperature of its own (got 'k2'); "
        "slopes.k2: must name a parameter with a law of temperature of its own (got 'k1')",
    ),
    "unknown": (
        {"k1": {"temperature": "k3"}, "k2": {"temperature": SLOPE}}, TEMPERATURES,
        "slopes.k1: must name a parameter with a law of temperature of its own, of k2 (got 'k3')",
    ),
    "constant": (
        {"k1": {"temperature": KINKED}}, (5.0,) * 8,
        "slopes.k1: temperature must differ between tests (got one value)",
    ),
    "all missing": (
        {"k1": {"temperature": KINKED}}, (None,) * 8,
        "slopes.k1: temperature must differ between tests (got none)",
    ),
    "uniform": (
        {"k1": {"temperature": KINKED}}, (fmu.Uniform(), *TEMPERATURES[1:]),
        "tests.0.covariates.temperature: must have a distribution without bounds, as fmu.Normal (got Uniform)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_contradictions(building, case):
    slopes, temperature, message = CONTRADICTIONS[case]
    with pytest.raises(TestsError) as told:
        posed(building, campaign(building, temperature), slopes)
    assert str(told.value) == message


def test_a_slope_starts_where_its_prior_has_a_density(building):
    prior = fmu.LogNormal(0.005, 0.5)
    problem = posed(building, campaign(building), {"k1": {"temperature": prior}})
    (slope,) = [one for one in problem.parameters if one.prior == prior]
    assert slope.start == pytest.approx(0.005)
