"""New tests beside the prediction of the next test: p-values, and the parameter that has departed."""

import dataclasses

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.next_test import rank_p_value
from fmu.posterior.joint.modal_test import TestsError
from tests import plain_traces
from tests.shear_building import frequencies_hz, shear_building

pytestmark = pytest.mark.usefixtures("all_half_centred")

NAMES, LABELS = ("k1", "k2", "k3", "k4"), ("a", "b", "c", "d")
MODEL = shear_building(NAMES, 4e6, 1000.0)
NOMINAL = frequencies_hz(MODEL, np.ones(4))[0]
SD_HZ = 1e-3 * NOMINAL
SCATTER, PER_DEGREE, DRAWS = 0.01, -0.002, 1500
CAMPAIGNS = 100
NORMAL = fmu.Population(sd=fmu.HalfNormal(0.02))


def measured(name, rng, factors=(1.0, 1.0, 1.0, 1.0), missed=(), temperature=None, scatter=SCATTER, **options):
    """Return a new test of the building, whose stiffnesses scatter and fall with the temperature."""
    k = (1.0 + scatter * rng.standard_normal(4)) * np.array(factors)
    k *= 1.0 if temperature is None else 1.0 + PER_DEGREE * temperature
    f = frequencies_hz(MODEL, k)[0] + SD_HZ * rng.standard_normal(4)
    f[list(missed)] = np.nan
    covariates = {} if temperature is None else {"temperature": temperature}
    data = fmu.ModalData(NOMINAL, labels=LABELS, sd_hz=SD_HZ).with_frequencies(f)
    return fmu.Test(name, data, covariates=covariates, **options)


def posed(tests, **options):
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    varies = dict.fromkeys(NAMES, NORMAL)
    return fmu.JointProblem(MODEL, tests, parameters, varies=varies, pairing="index", **options)


def trace_of(problem, **values):
    """Return a trace in which the populations are known: all means are 1, all standard deviations 1 %."""
    theta = np.tile(problem.start, (DRAWS, 1))
    for role, name, column in zip(problem.roles, problem.names, theta.T, strict=True):
        column[:] = {"mean": 1.0, "sd": SCATTER, "slope": PER_DEGREE}.get(role.kind, values.get(name, 0.0))
    return plain_traces.trace_of(problem, theta)


@pytest.fixture(scope="module")
def problem(all_half_centred):
    rng = np.random.default_rng(0)
    return posed([measured(f"t{i}", rng, missed=(2,) if i == 0 else ()) for i in range(4)])


@pytest.fixture(scope="module")
def trace(problem):
    return trace_of(problem)


def test_the_rank_is_uniform_whatever_the_distribution():
    """Of 19 skewed draws and a measurement like them, each of the 20 ranks has the same probability."""
    rng = np.random.default_rng(2)
    p = [rank_p_value(x[1:], x[0]) for x in np.exp(rng.standard_normal((2000, 20, 2)))]
    counts = np.bincount(np.round(20 * np.array(p)).astype(int), minlength=21)[1:]
    assert counts.sum() == 2000
    assert scipy.stats.chisquare(counts).pvalue > 1e-3


def test_the_rank_is_no_smaller_than_the_draws_allow():
    draws = np.random.default_rng(3).standard_normal((99, 2))
    assert rank_p_value(draws, np.array([50.0, -50.0])) == pytest.approx(0.01)
    assert rank_p_value(draws, draws.mean(axis=0)) == 1.0
    turned = draws @ [[2.0, 1.0], [0.3, 5.0]]
    x = np.array([1.0, 1.3])
    assert rank_p_value(turned, x @ [[2.0, 1.0], [0.3, 5.0]]) == rank_p_value(draws, x)


def test_p_values_of_tests_from_the_population_are_uniform(problem, trace):
    rng = np.random.default_rng(4)
    missed = [(), (), (1,), (0, 3)]
    new = [measured(f"n{i}", rng, missed=missed[i % 4]) for i in range(200)]
    found = fmu.predict_tests(trace, problem, new)
    assert scipy.stats.kstest(found["p_value"], "uniform").pvalue > 1e-3
    whole = found.iloc[0::4]
    for name in NAMES:
        assert scipy.stats.kstest(whole[f"score {name}"], "norm").pvalue > 1e-3
    assert (found["draws"] == DRAWS).all()


def exact_draws(rng, estimates, sd):
    """Return 300 draws of mean and sd of a population from their posterior on a grid, given one value per test.

    The priors are N(1, 0.05²) and half-normal with 0.02; `sd` is that of the errors of the values.
    """
    mean, width = np.meshgrid(np.linspace(0.8, 1.2, 401), np.linspace(0.000625, 0.099375, 80), indexing="ij")
    log_density = -0.5 * ((mean - 1.0) / 0.05) ** 2 - 0.5 * (width / 0.02) ** 2
    spread = width**2 + sd**2
    squares = np.sum(estimates**2) - 2.0 * mean * np.sum(estimates) + len(estimates) * mean**2
    log_density -= 0.5 * len(estimates) * np.log(spread) + 0.5 * squares / spread
    density = np.exp(log_density - log_density.max()).ravel()
    picked = rng.choice(density.size, 300, p=density / density.sum())
    return mean.ravel()[picked], width.ravel()[picked]


def test_p_values_are_uniform_over_campaigns_of_six_tests_from_which_the_population_is_inferred():
    """All storeys share k, so that f² is proportional to it, and the posterior of its population is known."""
    model = shear_building(["k"] * 4, 4e6, 1000.0)
    sd_hz = 2e-3 * NOMINAL
    data = fmu.ModalData(NOMINAL, labels=LABELS, sd_hz=sd_hz)
    alike = [fmu.Test(f"t{i}", data) for i in range(2)]
    parameter = fmu.Parameter("k", 1.0, 0.5, 1.5)
    problem = fmu.JointProblem(model, alike, [parameter], varies={"k": NORMAL}, pairing="index")
    rng, found = np.random.default_rng(14), []
    for _ in range(CAMPAIGNS):
        k = rng.normal(1.0, 0.05) + np.abs(rng.normal(0.0, 0.02)) * rng.standard_normal(7)
        f = NOMINAL * np.sqrt(k)[:, None] + sd_hz * rng.standard_normal((7, 4))
        mean, width = exact_draws(rng, ((f[:6] / NOMINAL) ** 2).mean(axis=1), 2.0 * 2e-3 / np.sqrt(4))
        theta = np.column_stack([mean, width, np.zeros((300, 2))])
        trace = plain_traces.trace_of(problem, theta)
        trace.attrs["seed"] = len(found)
        new = fmu.Test("new", data.with_frequencies(f[6]))
        found.append(fmu.predict_tests(trace, problem, [new])["p_value"]["new"])
    assert scipy.stats.kstest(found, "uniform").pvalue > 1e-3
    assert scipy.stats.binomtest(int(np.sum(np.array(found) <= 0.05)), CAMPAIGNS, 0.05).pvalue > 1e-3


@pytest.mark.parametrize("storey", range(4))
def test_a_loss_of_8_percent_is_told_with_its_storey(storey, problem, trace):
    """The scatter of 1 % is 8 times smaller; another storey's own scatter may add to what the loss looks like."""
    rng = np.random.default_rng(5 + storey)
    factors = np.where(np.arange(4) == storey, 0.92, 1.0)
    found = fmu.predict_tests(trace, problem, [measured(f"n{i}", rng, factors) for i in range(40)])
    assert (found["p_value"] <= 0.01).all()
    assert (found["parameter"] == NAMES[storey]).all()
    assert_allclose(found["change"].mean(), -0.08, atol=5 * SCATTER / np.sqrt(40))


@pytest.mark.validate
def test_campaigns_of_twelve_tests_that_are_sampled():
    """Of 80 new tests, as many are alarms as asked for; of 16 with a loss of 8 %, at least 15, by name."""
    model, names = shear_building(["k1", "k1", "k2", "k2"], 4e6, 1000.0), ("k1", "k2")
    nominal = frequencies_hz(model, np.ones(2))[0]
    data = fmu.ModalData(nominal, labels=LABELS, sd_hz=1e-3 * nominal)
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in names]
    p, lost = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        mean = rng.uniform(0.9, 1.1, 2)

        def measure(name, factors=(1.0, 1.0), rng=rng, mean=mean):
            k = mean * (1.0 + SCATTER * rng.standard_normal(2)) * factors
            f = frequencies_hz(model, k)[0] * (1.0 + 1e-3 * rng.standard_normal(4))
            return fmu.Test(name, data.with_frequencies(f))

        tests = [measure(f"t{i}") for i in range(12)]
        varies = dict.fromkeys(names, NORMAL)
        problem = fmu.JointProblem(model, tests, parameters, varies=varies, pairing="index")
        trace = fmu.sample(problem, "hmc", draws=300, warmup=300, seed=seed)
        new = [measure(f"n{i}") for i in range(10)]
        damaged = [measure("k1", (0.92, 1.0)), measure("k2", (1.0, 0.92))]
        found = fmu.predict_tests(trace, problem, [*new, *damaged])
        p += found["p_value"].tolist()[:10]
        lost += [(name, *found.loc[name, ["p_value", "parameter"]]) for name in names]
    for level in (0.05, 0.2, 0.5):
        assert scipy.stats.binomtest(int(np.sum(np.array(p) <= level)), len(p), level).pvalue > 1e-3
    told = [parameter == name for name, p_value, parameter in lost if p_value <= 0.01]
    assert len(told) >= 15
    assert sum(told) >= 15


def test_parameters_that_one_mode_cannot_tell_apart_are_all_named(problem, trace):
    rng = np.random.default_rng(6)
    new = measured("n", rng, (0.7, 1.0, 1.0, 1.0), missed=(1, 2, 3))
    row = fmu.predict_tests(trace, problem, [new]).iloc[0]
    assert row["p_value"] < 0.01
    assert {row["parameter"], *row["or_parameters"].split(", ")} == set(NAMES)


def test_the_covariate_of_the_new_test_is_taken_into_account():
    rng = np.random.default_rng(7)
    tests = [measured(f"t{i}", rng, temperature=t) for i, t in enumerate((-5.0, 0.0, 5.0))]
    slopes = {name: {"temperature": fmu.Normal(0.01)} for name in NAMES}
    problem = posed(tests, slopes=slopes)
    warm = measured("warm", rng, temperature=40.0)
    cold = fmu.Test("cold", warm.data, covariates={"temperature": 0.0})
    found = fmu.predict_tests(trace_of(problem), problem, [warm, cold])
    assert found["p_value"]["warm"] > 0.01
    assert found["p_value"]["cold"] < 0.01
    with pytest.raises(
        TestsError, match=r"^tests\.0\.covariates: must have temperature, on which k1 depends \(got "
    ):
        fmu.predict_tests(trace_of(problem), problem, [measured("no", rng)])


def test_the_configuration_of_the_new_test_is_that_of_the_test_it_is_like():
    rng = np.random.default_rng(8)
    tests = [measured(f"t{i}", rng) for i in range(2)]
    known = {"k4": 0.5}
    soft = [measured(f"s{i}", rng, (1.0, 1.0, 1.0, 0.5), known=known) for i in range(2)]
    problem = posed([*tests, *soft])
    trace = trace_of(problem)
    new = measured("new", rng, (1.0, 1.0, 1.0, 0.5))
    with pytest.raises(TestsError, match=r"^tests\.0\.like: must name the test whose masses, springs and known "):
        fmu.predict_tests(trace, problem, [new])
    assert fmu.predict_tests(trace, problem, [new], like="t1")["parameter"]["new"] == "k4"
    found = fmu.predict_tests(trace, problem, [new], like="s1").loc["new"]
    assert np.isnan(found["score k4"])
    assert "k4" not in (found["parameter"], found["or_parameters"])
    own = measured("own", rng, known={"k4": 0.6})
    with pytest.raises(
        TestsError, match=r"like: must have no masses, springs and known parameters, or those of 's1'"
    ):
        fmu.predict_tests(trace, problem, [own], like="s1")


def test_a_test_in_which_all_populations_are_known_has_no_departure_to_look_for():
    rng = np.random.default_rng(15)
    tests = [*(measured(f"t{i}", rng) for i in range(2)), measured("fixed", rng, known={"k1": 1.0})]
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    problem = fmu.JointProblem(MODEL, tests, parameters, varies={"k1": NORMAL}, pairing="index")
    trace = trace_of(problem, **dict.fromkeys(NAMES[1:], 1.0))
    rule = r"^tests\.0\.like: must name a test in which the value of a parameter .* unknown \(got 'fixed'\)"
    with pytest.raises(TestsError, match=rule):
        fmu.predict_tests(trace, problem, [measured("new", rng)], like="fixed")
    assert fmu.predict_tests(trace, problem, [measured("new", rng)], like="t0")["parameter"]["new"] == "k1"


def test_a_correlation_of_the_populations_is_taken_into_account():
    """Together, two stiffnesses may be 2.5 sd high; one alone that is lower by 5 sd is the one that is named."""
    rng = np.random.default_rng(13)
    tests = [measured(f"t{i}", rng, scatter=0.0) for i in range(3)]
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    varies = dict.fromkeys(("k1", "k2"), NORMAL)
    problem = fmu.JointProblem(MODEL, tests, parameters, varies=varies, correlation=1.0, pairing="index")
    correlation = next(
        n for n, role in zip(problem.names, problem.roles, strict=True) if role.kind == "correlation"
    )
    trace = trace_of(problem, **{correlation: 0.9, "k3": 1.0, "k4": 1.0})
    factors = {"high": (1.025, 1.025, 1.0, 1.0), "k1": (0.95, 1.0, 1.0, 1.0), "k2": (1.0, 0.95, 1.0, 1.0)}
    new = [measured(name, rng, of, scatter=0.0) for name, of in factors.items()]
    found = fmu.predict_tests(trace, problem, new)
    assert found["p_value"]["high"] > 0.01 > found["p_value"][["k1", "k2"]].max()
    assert found["parameter"][["k1", "k2"]].tolist() == ["k1", "k2"]
    assert_allclose(found["change"][["k1", "k2"]], -0.05, atol=0.01)


def test_groups_matter_where_a_parameter_varies_by_group():
    rng = np.random.default_rng(9)
    tests = [measured(f"t{i}", rng, group="old" if i < 2 else "new") for i in range(4)]
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    varies = dict.fromkeys(NAMES[1:], NORMAL) | {"k1": "group"}
    problem = fmu.JointProblem(MODEL, tests, parameters, varies=varies, pairing="index")
    trace = trace_of(problem, **{"k1 [old]": 1.0, "k1 [new]": 0.8})
    weak = measured("weak", rng, (0.8, 1.0, 1.0, 1.0), group="new", scatter=0.0)
    p = fmu.predict_tests(trace, problem, [weak, fmu.Test("old one", weak.data, "old")])["p_value"]
    assert p["weak"] > 0.01 > p["old one"]
    with pytest.raises(
        TestsError, match=r"group: must be one of old, new, as a parameter varies by group \(got ''\)"
    ):
        fmu.predict_tests(trace, problem, [measured("x", rng)])
    with pytest.raises(TestsError, match=r"like: must be a test of the group new \(got 't0', of old\)"):
        fmu.predict_tests(trace, problem, [weak], like="t0")


def test_the_errors_are_those_of_the_group():
    """An imprecise test is no departure from the precise tests that come first, of another group."""
    rng = np.random.default_rng(16)
    tests = [measured(f"t{i}", rng, group="precise") for i in range(2)]
    rough = [dataclasses.replace(measured(f"r{i}", rng), data=imprecise(rng), group="rough") for i in range(2)]
    problem = posed([*tests, *rough])
    trace = trace_of(problem)
    new = fmu.Test("new", imprecise(rng), "rough")
    assert fmu.predict_tests(trace, problem, [new])["p_value"]["new"] > 0.01
    assert fmu.predict_tests(trace, problem, [new], like="t0")["p_value"]["new"] < 0.001
    rule = r"^tests\.0\.like: must name the test whose errors the new test has, as they differ \(got none\)$"
    with pytest.raises(TestsError, match=rule):
        fmu.predict_tests(trace, problem, [fmu.Test("new", new.data)])


def imprecise(rng):
    """Return frequencies with errors 30 times as large as those of `measured`."""
    data = fmu.ModalData(NOMINAL, labels=LABELS, sd_hz=30 * SD_HZ)
    return data.with_frequencies(NOMINAL + 30 * SD_HZ * rng.standard_normal(4))


def test_the_time_of_a_new_test_decides_how_much_of_an_undated_loss_it_has():
    """The loss grows by 10 % from day 100 to day 200, the last; it was smaller before and is larger later."""

    def on(day, name):
        f = frequencies_hz(MODEL, np.array([1.0 - 0.1 * max(day - 100.0, 0.0) / 100.0, 1.0, 1.0, 1.0]))[0]
        data = fmu.ModalData(f, labels=LABELS, sd_hz=SD_HZ)
        return fmu.Test(name, data, covariates={"day": day})

    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    varies = {"k1": fmu.UndatedDamage(by="day", grows=True, scatter=NORMAL)}
    tests = [on(day, f"t{day:g}") for day in (0.0, 100.0, 150.0, 200.0)]
    problem = fmu.JointProblem(MODEL, tests, parameters, varies=varies, pairing="index")
    trace = trace_of(problem, **{"k1 loss": 0.1, "day of damage": 100.0, **dict.fromkeys(NAMES[1:], 1.0)})
    new = [on(day, f"n{day:g}") for day in (50.0, 160.0, 300.0)]
    assert fmu.predict_tests(trace, problem, new)["p_value"].min() > 0.5
    with pytest.raises(TestsError, match=r"covariates: must have day as a number, which is the time of a test"):
        fmu.predict_tests(trace, problem, [fmu.Test("n", new[0].data)])


@pytest.mark.parametrize("grows", [True, False])
def test_a_loss_that_grows_with_the_number_of_the_test_predicts_no_new_test(grows):
    """It would be predicted as small as in the last test, so that each later test departs more."""
    rng, parameters = np.random.default_rng(14), [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    losses = {"a": 0.0, "b": 0.0, "c": 0.03, "d": 0.06, "n": 0.06}
    *tests, new = [
        measured(name, rng, (1.0 - loss, 1.0, 1.0, 1.0), temperature=100.0 * loss) for name, loss in losses.items()
    ]
    varies = {"k1": fmu.UndatedDamage(grows=grows, scatter=NORMAL)}
    slopes = {name: {"temperature": fmu.Normal(0.01)} for name in NAMES}
    problem = fmu.JointProblem(MODEL, tests, parameters, varies=varies, slopes=slopes, pairing="index")
    trace = trace_of(problem, **{"k1 loss": 0.06, "test of damage": 2.0, **dict.fromkeys(NAMES[1:], 1.0)})
    if grows:
        rule = r"^problem: must have the time of the growing loss of k1 as a covariate, .*; name it \(onset = { by"
        with pytest.raises(ValueError, match=rule):
            fmu.predict_tests(trace, problem, [new])
    else:
        assert fmu.predict_tests(trace, problem, [new])["p_value"]["n"] > 0.01


def test_every_fault_of_new_tests_is_listed(problem, trace):
    rng = np.random.default_rng(10)
    other = fmu.Test("n1", fmu.ModalData([1.0, 2.0], labels=("a", "e")))
    with pytest.raises(TestsError) as raised:
        fmu.predict_tests(trace, problem, [measured("t1", rng), other], like="t9")
    assert list(raised.value.mistakes) == [
        "tests.0.name: must not be that of a test that was updated with; rename it (got 't1')",
        "tests.0.like: must be one of t0, t1, t2, t3 (got 't9')",
        "tests.1.labels: must be modes among a, b, d, c (got 'e')",
        "tests.1.like: must be one of t0, t1, t2, t3 (got 't9')",
    ]
    with pytest.raises(
        TestsError, match=r"labels: must be modes that one of the earlier tests has all \(got a, b"
    ):
        fmu.predict_tests(trace, problem, [measured("n", rng)], like="t0")


def test_what_has_no_population_is_refused(trace):
    rng = np.random.default_rng(11)
    tests = [measured(f"t{i}", rng) for i in range(2)]
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    shared = fmu.JointProblem(MODEL, tests, parameters, pairing="index")
    with pytest.raises(ValueError, match=r'^problem: must have a parameter with varies = "population"'):
        fmu.predict_tests(trace_of(shared), shared, [measured("n", rng)])
    with pytest.raises(ValueError, match=r"^trace: must be of the problem"):
        fmu.predict_tests(trace, shared, [measured("n", rng)])


def test_few_draws_are_refused(problem, trace):
    with pytest.raises(ValueError, match=r"^trace: must have 40 draws at least for 4 modes \(got 20\)"):
        fmu.predict_tests(trace, problem, [measured("n", np.random.default_rng(12))], draws=20)
