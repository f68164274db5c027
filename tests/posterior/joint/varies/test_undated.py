"""Damage at an unknown date: a loss at once or growing, of parameters that scatter or not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from tests.gradients import assert_gradient
from tests.shear_building import frequencies_hz, shear_building
from tests.validation.campaigns import parameters, simulated_tests
from tests.validation.several_tests import building as storeys

NAMES = ("k1", "k2")
DAYS = (0.0, 1.0, 3.0, 4.0, 8.0, 9.0, 11.0, 12.0)


@pytest.fixture(scope="module")
def building():
    return shear_building(NAMES, 2e6, 1000.0)


def campaign(building, factors, days, noise=1e-3, seed=1):
    """Return tests on given days of a building whose lower storey has the given stiffness factors."""
    rng, tests = np.random.default_rng(seed), []
    for t, (day, k1) in enumerate(zip(days, factors, strict=True)):
        f = frequencies_hz(building, [k1, 1.0])[0] * (1 + noise * rng.standard_normal(2))
        data = fmu.ModalData(f, sd_hz=noise * f)
        tests.append(fmu.Test(f"t{t}", data, covariates={"day": day, "temperature": 20 - day}))
    return tests


def posed(building, damage, factors=(1.0,) * 8, days=DAYS, noise=1e-3, **options):
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    varies = damage if isinstance(damage, dict) else {"k1": damage}
    tests = campaign(building, factors, days, noise)
    return fmu.JointProblem(building, tests, parameters, varies=varies, pairing="index", **options)


SUDDEN, GROWING = fmu.UndatedDamage(by="day"), fmu.UndatedDamage(by="day", grows=True)


def test_a_sudden_loss(building):
    problem = posed(building, SUDDEN)
    assert problem.names == ("k1", "k1 loss", "day of damage", "k2")
    assert (problem.lower[2], problem.upper[2]) == (0.0, 12.0)
    assert [tuple(role) for role in problem.roles[:3]] == [
        ("shared", 0, ""), ("loss", 0, "damage"), ("date", None, "damage"),
    ]  # fmt: skip
    lost = {4.0: [0, 0, 0, 0, 1, 1, 1, 1], 7.6: [0, 0, 0, 0, 0.5, 1, 1, 1], 12.0: [0] * 8, 0.0: [0, *[1] * 7]}
    for date, share in lost.items():
        theta = np.array([1.1, 0.1, date, 0.9])
        assert_allclose(problem.values(theta)[:, 0], 1.1 * (1 - 0.1 * np.array(share)), rtol=1e-14)
        assert_allclose(problem.layout.losses_by_test(theta[None])[0, :, 0], 0.1 * np.array(share), rtol=1e-14)


def test_a_growing_loss(building):
    problem = posed(building, GROWING)
    assert (problem.lower[2], problem.upper[2]) == (0.0, 11.0)
    share = [0.0, 0.0, 0.0, 0.0, 4 / 8, 5 / 8, 7 / 8, 1.0]
    assert_allclose(problem.values([1.1, 0.1, 4.0, 0.9])[:, 0], 1.1 * (1 - 0.1 * np.array(share)), rtol=1e-14)


def test_the_order_of_the_tests_is_the_time_by_default(building):
    problem = posed(building, fmu.UndatedDamage())
    assert problem.names[2] == "test of damage"
    assert_allclose(problem.values([1.0, 0.1, 3.9, 1.0])[:, 0], [1, 1, 1, 0.95, 0.9, 0.9, 0.9, 0.9], rtol=1e-14)


def test_an_event_has_one_date(building):
    both = posed(building, dict.fromkeys(NAMES, SUDDEN))
    assert both.names == ("k1", "k1 loss", "day of damage", "k2", "k2 loss")
    other = fmu.UndatedDamage(by="day", event="corrosion", grows=True)
    two = posed(building, {"k1": SUDDEN, "k2": other})
    assert two.names == ("k1", "k1 loss", "day of damage", "k2", "k2 loss", "day of corrosion")
    with pytest.raises(ValueError, match="varies: day of damage must have the same prior and growth"):
        posed(building, {"k1": SUDDEN, "k2": GROWING})
    by_number = (
        "varies: test of damage must have the same by .* event damage, or another event .got day of damage too"
    )
    with pytest.raises(ValueError, match=by_number):
        posed(building, {"k1": SUDDEN, "k2": fmu.UndatedDamage()})


@pytest.mark.parametrize("scatter", [None, fmu.Population(sd=fmu.HalfNormal(0.05))], ids=["none", "scatter"])
@pytest.mark.parametrize("grows", [False, True], ids=["sudden", "growing"])
def test_gradient_and_box(building, grows, scatter):
    damage = fmu.UndatedDamage(by="day", grows=grows, scatter=scatter)
    slopes = {"k1": {"temperature": fmu.Normal(0.003)}}
    problem = posed(building, {"k1": damage, "k2": damage}, slopes=slopes, reduction=False)
    theta = problem.sample_prior(np.random.default_rng(1), 6)
    date = problem.names.index("day of damage")
    theta = 0.7 * problem.start + 0.3 * theta
    theta[:, date] = [0.5, 2.7, 3.9, 6.0, 8.83, 10.65]
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-4, of_largest=1e-5)
    low, high = problem.layout.box()
    values = problem.values(problem.sample_prior(np.random.default_rng(0), 400))
    assert np.mean((values >= low) & (values <= high)) > 0.998


def test_the_next_test_comes_after_the_last(building):
    theta = np.array([[1.0, 0.1, 4.0, 1.0]])
    rng, none = np.random.default_rng(0), np.zeros((1, 0))
    for damage, at_10, at_16 in ((SUDDEN, 0.9, 0.9), (GROWING, 1 - 0.1 * 6 / 8, 0.85)):
        layout = posed(building, damage).layout
        assert_allclose(layout.of_next_test(theta, rng, none, 0, {})[0, 0], 0.9, rtol=1e-14)
        for day, expected in ((2.0, 1.0), (10.0, at_10), (16.0, at_16)):
            assert_allclose(layout.of_next_test(theta, rng, none, 0, {"day": day})[0, 0], expected, rtol=1e-14)


DATE, MONTH = 12.0, np.arange(20.0)


def with_a_loss(building, grows):
    """Return the problem of twenty tests, with a loss of 8 % on the twelfth day or growing from then on."""
    share = np.clip((MONTH - DATE) / (19.0 - DATE), 0.0, 1.0) if grows else (MONTH > DATE).astype(float)
    return posed(building, fmu.UndatedDamage(by="day", grows=grows), 1.0 - 0.08 * share, MONTH, noise=0.003)


@pytest.mark.parametrize("grows", [False, True], ids=["sudden", "growing"])
def test_date_and_loss_have_their_probability_where_they_are_true(building, grows):
    """By a sum over a grid of the posterior of date and loss given the stiffnesses."""
    problem = with_a_loss(building, grows)
    losses, dates = (
        grid.ravel() for grid in np.meshgrid(np.linspace(0.0, 0.2, 81), np.linspace(0.05, 17.95, 180))
    )
    theta = np.tile([1.0, 0.0, 0.0, 1.0], (len(dates), 1))
    theta[:, 1], theta[:, 2] = losses, dates
    p = problem.log_prob(theta)
    p = np.exp(p - p.max()) / np.sum(np.exp(p - p.max()))
    mean = p @ losses
    assert abs(mean - 0.08) < 4 * np.sqrt(p @ (losses - mean) ** 2) < 0.03
    assert np.sum(p[np.abs(dates - DATE) < (4.0 if grows else 1.0)]) > 0.95


@pytest.mark.parametrize(
    "grows", [pytest.param(False, marks=pytest.mark.validate), True], ids=["sudden", "growing"]
)
def test_the_date_is_recovered(building, grows):
    problem = with_a_loss(building, grows)
    maxima = fmu.find_map(problem, starts=8)
    trace = fmu.sample(problem, "hmc", draws=200, warmup=150, seed=1, maxima=maxima)
    assert fmu.summary(trace)["rhat"].max() < 1.05
    loss, dates = (trace["posterior"][name].to_numpy() for name in ("k1 loss", "day of damage"))
    assert abs(loss.mean() - 0.08) < 4 * loss.std()
    assert np.quantile(np.abs(dates - DATE), 0.95) < (4.0 if grows else 1.0)


def test_the_tests_cannot_tell_when_between_two_of_them_it_happened(building):
    problem = posed(building, SUDDEN, 1.0 - 0.08 * (np.array(DAYS) > 4.0), reduction=False)
    found = [problem.log_likelihood([1.0, 0.08, date, 1.0]) for date in (4.0, 5.5, 7.2, 3.9, 7.3)]
    assert_allclose(found[1:3], found[0], rtol=1e-12)
    assert max(found[3:]) < found[0] - 5.0


WRONG = {
    "no covariate": (fmu.UndatedDamage(by="hour"), DAYS, r"tests.0.covariates: must have hour as a number"),
    "two times": (SUDDEN, (1.0,) * 4 + (2.0,) * 4, r"varies.k1: the date of a damage needs tests at 3 times"),
    "one time": (SUDDEN, (1.0,) * 8, r"needs tests at 3 times or more \(got 1\)"),
    "prior beyond": (
        fmu.UndatedDamage(by="day", date=fmu.ScaledBeta(2.0, 2.0, 50.0, 60.0)), DAYS,
        r"varies.k1: the date must have a probability between 0 and 12 \(got none\)",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_contradictions(building, case):
    damage, days, message = WRONG[case]
    with pytest.raises(ValueError, match=message):
        posed(building, damage, days=days)


def test_an_event_needs_a_name():
    with pytest.raises(ValueError, match="event: must not be empty"):
        fmu.UndatedDamage(event="")


def test_a_check_before_the_run_doubts_neither_dates_nor_covariates(building):
    """At the start there is no loss and no slope, so that dates, kinks and temperatures change nothing there."""
    tests = campaign(building, (1.0,) * 8, DAYS)
    unknown = {"day": 3.0, "temperature": None}
    tests[2] = fmu.Test(tests[2].name, tests[2].data, covariates=unknown)
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    slopes = {"k1": {"temperature": fmu.PiecewiseLinear(fmu.Normal(0.003), fmu.Normal(5.0, mean=12.0))}}
    problem = fmu.JointProblem(building, tests, parameters, varies={"k1": SUDDEN}, slopes=slopes, pairing="index")
    found = fmu.check(problem)
    pieces = ("k1 per temperature below kink", "k1 per temperature above kink")
    assert list(found.parameters.index) == list(problem.names)
    assert fmu.identifiability(problem).names == ("k1", "k1 loss", *pieces, "k2")
    assert "carry no information on" not in str(found)


@pytest.mark.validate
def test_runs_with_scatter_converge_and_find_date_and_loss():
    """Default runs of twenty campaigns of 60 tests: a loss of 8 %, a scatter of 0.5 %, errors of 0.3 %."""
    converged, near, inside = [], [], []
    for seed in range(1, 21):
        rng = np.random.default_rng((seed, 7))
        first = int(rng.integers(10, 50))
        values = np.ones((60, 4))
        values[:, 1] *= np.exp(0.005 * rng.standard_normal(60))
        values[first:, 1] *= 0.92
        scatter = fmu.Population("log-normal", sd=fmu.HalfNormal(0.05))
        problem = fmu.JointProblem(
            storeys(4),
            simulated_tests(rng, values),
            parameters(),
            varies={"k2": fmu.UndatedDamage(scatter=scatter)},
            pairing="index",
        )
        trace = fmu.sample(problem, seed=seed, progress=False)
        low, high = np.quantile(trace["posterior"]["k2 loss"], (0.05, 0.95))
        converged.append(fmu.diagnose(trace).converged)
        near.append(abs(np.median(trace["posterior"]["test of damage"]) - (first + 0.5)) <= 5.0)
        inside.append(low <= 0.08 <= high)
        main = [name for name, role in zip(problem.names, problem.roles, strict=True) if role.kind != "score"]
        print(seed, f"{low:.4f} to {high:.4f}, R-hat {fmu.summary(trace).loc[main, 'rhat'].max():.4f}", near[-1])
    print(np.sum(converged), np.sum(near), np.sum(inside))
    assert np.sum(converged) >= 19
    assert np.sum(near) >= 18
    assert np.sum(inside) >= 14  # of 20 intervals of 90 %, in all but 0.2 % of such studies
