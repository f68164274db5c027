"""Plans of the next test after several tests, and plans for a decision about damage."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

import fmu
from fmu.analysis.plan.before import known_before
from fmu.analysis.plan.sensors.information import State
from fmu.analysis.plan.targets import Decision
from fmu.posterior.joint.varies.damage import loss_parameter
from fmu.report.plan.page import plan_page
from tests.shear_building import frequencies_hz, shear_building

MODEL = shear_building(["k1", "k1", "k2", "k2"], 3e6, 1000.0)
SENSORS = tuple((i, "x") for i in range(4))
PARAMETERS = [fmu.Parameter(name, 1.0, 0.4, 1.6, fmu.Normal(0.15, mean=1.0)) for name in ("k1", "k2")]
ERRORS = [fmu.FrequencyErrors("absolute")]
VALUES = {"May": (1.0, 1.0), "June": (0.85, 1.0), "July": (0.85, 1.0)}


def measured(name, modes, shapes_sd=None):
    """Return a test without errors, by frequencies alone or with shapes at all floors."""
    f, phi = frequencies_hz(MODEL, np.array(VALUES[name]))
    group, given = "before" if name == "May" else "after", {}
    if shapes_sd is not None:
        seen = phi[:, :modes]
        sd = shapes_sd * np.abs(seen).max(axis=0) / np.linalg.norm(seen, axis=0)
        given = {"shapes": seen, "sensors": SENSORS, "shapes_sd": np.tile(sd, (4, 1))}
    return fmu.Test(name, fmu.ModalData(f[:modes], sd_hz=0.005 * f[:modes], **given), group)


def joint(tests, varies=None, errors=ERRORS, **options):
    return fmu.JointProblem(MODEL, tests, PARAMETERS, varies=varies, error=errors, **options)


@pytest.fixture(scope="module")
def damaged():
    return joint([measured("May", 4), measured("June", 2)], {"k1": fmu.Damage()})


@pytest.fixture(scope="module")
def planned(damaged):
    return fmu.plan(damaged, 4, modes=3, target=fmu.DamageTarget("k1", 0.1), draws=16)


def linearised_sds(problem, theta):
    """Return the standard deviations of the posterior linearised at theta, for Gaussian priors."""
    prior = np.array([p.prior.sd for p in problem.parameters])
    information = problem.quadratic(np.array(theta)[None])[2][0] + np.diag(1.0 / prior**2)
    return np.sqrt(np.diag(np.linalg.inv(information)))


def test_what_has_been_measured_is_known_before(planned, damaged):
    expected = linearised_sds(damaged, [1.0, 0.15, 1.0])
    assert planned.design.names == ("k1", "k1 loss [after]", "k2")
    np.testing.assert_allclose(planned.parameters()["before"], expected, rtol=0.1)


def test_the_plan_expects_the_posterior_of_all_tests_together(planned):
    errors = [*ERRORS, fmu.ShapeErrors()]
    # the first two tests tell nothing by shapes as inaccurate as these
    tests = [measured("May", 4, 10.0), measured("June", 2, 10.0), measured("July", 3, 0.02)]
    together = joint(tests, {"k1": fmu.Damage()}, errors, reduction=False)
    expected = linearised_sds(together, [1.0, 0.15, 1.0])
    np.testing.assert_allclose(planned.parameters()["after"], expected, rtol=0.1)


def test_losses_before_and_after(planned):
    row, sd = planned.losses().loc["k1"], planned.parameters().loc["k1 loss [after]"]
    assert row["sd_before"] == pytest.approx(sd["before"], rel=1e-6)
    assert row["sd_after"] == pytest.approx(sd["after"], rel=1e-6)
    assert row["if_none"] < 0.5 * row["before"] < row["before"] < row["if_twice"]
    said = " ".join(planned.sentences())
    assert "The probability that k1 has lost more than 10 % is" in said
    assert "is expected if k1 has lost 20 %" in said
    assert planned.choices["if_twice"].iloc[0] == pytest.approx(row["if_twice"])


def test_expected_probabilities_are_those_of_simulated_linear_tests():
    rng = np.random.default_rng(1)
    L, H, mean, beyond = np.array([[0.1, 0.0], [0.03, 0.05]]), rng.standard_normal((3, 2)) * 20.0, 0.04, 0.1
    scaled, n = H @ L, 100_000
    state = State(np.eye(2)[None] + (scaled.T @ scaled)[None], np.zeros((1, 0, 2)), np.zeros((1, 0)))
    row = Decision(("d",), beyond, np.array([mean])).expect(L[:1][None], state).loc["d"]
    covariance = np.linalg.inv(np.linalg.inv(L @ L.T) + H.T @ H)
    for name, loss in (("if_none", 0.0), ("if_twice", 0.2)):
        off = loss - mean
        slope, left = (L @ L.T)[1, 0] / (L @ L.T)[0, 0], np.linalg.det(L) / L[0, 0]
        psi = np.column_stack([np.full(n, off), slope * off + left * rng.standard_normal(n)])
        y = psi @ H.T + rng.standard_normal((n, 3))
        estimate = mean + (y @ H @ covariance)[:, 0]
        p = scipy.stats.norm.cdf((estimate - beyond) / np.sqrt(covariance[0, 0]))
        assert row[name] == pytest.approx(p.mean(), abs=5.0 * p.std() / np.sqrt(n))
    assert row["before"] == pytest.approx(scipy.stats.norm.cdf((mean - beyond) / 0.1))


def test_a_loss_since_a_single_test_has_its_prior():
    problem = fmu.UpdatingProblem(MODEL, fmu.expected_modes(MODEL, PARAMETERS, 3), PARAMETERS)
    found = fmu.plan(problem, 2, target=fmu.DamageTarget(["k1"], 0.1, fmu.Normal(0.2)), draws=8)
    assert found.design.names == ("k1", "k2", "k1 loss")
    ends = [end / 0.2 for end in fmu.Normal(0.2).box(-0.5, 0.95)]  # the bounds of a loss
    sd = scipy.stats.truncnorm.std(*ends, scale=0.2)
    assert found.losses()["sd_before"].iloc[0] == pytest.approx(sd, rel=1e-6)
    # however accurate, one test cannot tell a loss from a stiffness that was smaller before
    expected = sd * 0.15 / np.hypot(sd, 0.15)
    assert found.losses()["sd_after"].iloc[0] == pytest.approx(expected, rel=0.1)
    with pytest.raises(ValueError, match=r"plan: must start from the prior of a problem of one test"):
        fmu.simulate_plan(found, 1)


def test_damage_as_target_reduces_the_loss_most(damaged):
    one = fmu.plan(damaged, 3, modes=3, target=fmu.DamageTarget("k1", 0.1), draws=8)
    every = fmu.plan(damaged, 3, modes=3, draws=8)
    readings = one.design.readings()
    assert one.information == pytest.approx(readings.value_of(one.every))
    assert one.information >= readings.value_of(every.every) - 1e-9


def test_parameters_that_do_not_matter_are_integrated_out():
    problem = fmu.UpdatingProblem(MODEL, fmu.expected_modes(MODEL, PARAMETERS, 3), PARAMETERS)
    rng = np.random.default_rng(1)
    losses = [loss_parameter("k1 loss", None)]
    before = replace(known_before(problem, None, None, losses, 5, rng), scale=np.tril(rng.standard_normal((3, 3))))
    found, needed = before.only(np.array([True, False, True])), [0, 2]
    assert [one.name for one in found.parameters] == ["k1", "k1 loss"]
    covariance = (before.scale @ before.scale.T)[np.ix_(needed, needed)]
    np.testing.assert_allclose(found.scale @ found.scale.T, covariance, rtol=1e-12)
    expected = before.draws.copy()
    expected[:, 1] = before.reference[1]
    np.testing.assert_array_equal(found.values(found.draws), before.values(expected))


@pytest.mark.usefixtures("no_pictures")
def test_a_parameter_with_a_population_has_a_new_score():
    tests = [measured("May", 3), measured("June", 3), measured("July", 3)]
    found = fmu.plan(joint(tests, {"k1": fmu.Population()}), 2, modes=2, draws=4)
    table = found.parameters()
    assert list(table.index) == ["k1 mean", "k1 sd", "k2", "k1 score [planned]"]
    assert table.loc["k1 score [planned]", "before"] == pytest.approx(1.0, rel=0.01)
    assert np.all(table["after"] <= table["before"] * (1.0 + 1e-9))
    said = "Repeats are on the same day, with the same k1; tests on other days, with new values, are not in"
    assert said in " ".join(found.sentences())
    assert said in plan_page(found).sections[3].parts[1].caption  # of the table of repeats


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"target": fmu.DamageTarget("k2", 0.1)},
            r"target\.of: must name parameters that vary by damage",
        ),
        ({"target": fmu.DamageTarget(["k1", "k1"], 0.1)}, r"target\.of: must name parameters"),
        (
            {"target": fmu.DamageTarget("k1", 0.1), "like": "May"},
            r"like: must name a test of a group with l",
        ),
        (
            {"target": fmu.DamageTarget("k1", 0.1, fmu.Normal(0.1))},
            r"target\.prior: must not be given for",
        ),
        ({"like": "August"}, r"like: must be one of May, June \(got 'August'\)"),
        ({"target": "k3"}, r"target: must name parameters, k1, k1 loss \[after\], k2 \(got 'k3'\)"),
    ],
)
def test_bad_input(damaged, options, message):
    with pytest.raises(ValueError, match=message):
        fmu.plan(damaged, 2, draws=4, **options)


@pytest.mark.parametrize("beyond", [0.0, 0.5, -0.1, np.nan])
def test_a_threshold_out_of_range(beyond):
    with pytest.raises(ValueError, match=r"beyond: must be a positive finite number below 0\.5"):
        fmu.DamageTarget("k1", beyond)


def test_a_value_of_its_own_in_each_test():
    problem = joint([measured("May", 3), measured("June", 3)], {"k1": "test"})
    with pytest.raises(ValueError, match=r"problem: must have no parameter with a value of its own .*\(got k1\)"):
        fmu.plan(problem, 2, draws=4)


def test_a_users_function_in_several_tests_is_planned_like_its_matrices():
    def solve(theta):
        f, phi = frequencies_hz(MODEL, theta)
        return f[:3], phi[:, :3]

    tests = [measured("May", 3, 0.02), measured("June", 3, 0.02)]
    found, expected = (
        fmu.plan(
            fmu.JointProblem(model, tests, PARAMETERS, varies={"k1": fmu.Damage()}, error=ERRORS),
            3,
            target=fmu.DamageTarget("k1", 0.1),
            draws=2,
        )
        for model in (fmu.BlackBoxModel(solve, 2), MODEL)
    )
    assert found.sensors == expected.sensors
    assert found.losses()["sd_after"].iloc[0] == pytest.approx(expected.losses()["sd_after"].iloc[0], rel=1e-3)


def test_a_parameter_that_is_not_updated_keeps_its_value():
    """Another parameter with the same start, known nearly exactly, is as good as one that is not updated."""
    k1, k2 = PARAMETERS
    held = fmu.Parameter("k2", 1.0, 0.4, 1.6, k2.prior, updated=False)
    known = fmu.Parameter("k2", 1.0, 0.4, 1.6, fmu.Normal(1e-6, mean=1.0))
    data = fmu.expected_modes(MODEL, PARAMETERS, 3)
    found, expected = (
        fmu.plan(fmu.UpdatingProblem(MODEL, data, [k1, other]), 3, draws=64).parameters()
        for other in (held, known)
    )
    assert list(found.index) == ["k1"]
    assert found.loc["k1", "before"] == pytest.approx(expected.loc["k1", "before"])
    assert found.loc["k1", "after"] == pytest.approx(expected.loc["k1", "after"], rel=1e-4)  # at the same draws


def test_earlier_tests_that_put_a_parameter_at_its_bound_are_a_doubt():
    f = frequencies_hz(MODEL, np.array([2.5, 1.0]))[0][:3]
    tests = [fmu.Test(name, fmu.ModalData(f, sd_hz=0.005 * f)) for name in ("May", "June")]
    found = fmu.plan(joint(tests), 2, modes=2, draws=4)
    assert not found.recommended
    assert found.doubts[0].startswith("The earlier tests put k1 at a bound")


def daily(varies):
    """Return a problem of ten tests on ten days, of which the last five show 7 % less stiffness."""
    model = fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)], dofs=[("a", "x")])
    z, day = np.random.default_rng(3).standard_normal(10), np.arange(10.0)
    f = np.sqrt((1.0 + 0.02 * z) * np.where(day < 5, 1.0, 0.93)) / (2.0 * np.pi)
    tests = [
        fmu.Test(f"day {i}", fmu.ModalData(f[[i]], sd_hz=5e-4), covariates={"day": day[i]}) for i in range(10)
    ]
    k = fmu.Parameter("k", 1.0, 0.2, 3.0, fmu.Normal(0.1, mean=1.0))
    return fmu.JointProblem(model, tests, [k], varies={"k": varies}, pairing="index")


@pytest.mark.parametrize("time", [4.0, "inferred"])
def test_values_that_are_correlated_in_time_need_a_run(time):
    """The typical point is of independent values: without a run, the sd of the mean was 3.4 times too small."""
    problem = daily(fmu.Population(correlation_time=time, by="day"))
    with pytest.raises(ValueError, match=r"trace: must be given where values are correlated in time \(got none\)"):
        fmu.plan(problem, 1, modes=1, draws=4)
    trace = fmu.sample(problem, "gibbs", draws=10, warmup=10, chains=2, seed=1)
    found = fmu.plan(problem, 1, modes=1, draws=4, trace=trace)
    assert found.doubts[0].startswith("The values of k are correlated in time")


def test_values_that_are_independent_are_not_said_to_be_correlated():
    problem = daily(fmu.Population())
    trace = fmu.sample(problem, "gibbs", draws=10, warmup=10, chains=2, seed=1)
    assert not any("correlated" in one for one in fmu.plan(problem, 1, modes=1, draws=4, trace=trace).doubts)


@pytest.mark.parametrize("grows", [False, True])
def test_a_loss_at_an_unknown_date_with_a_population_is_a_doubt(grows):
    """The typical point has one date: without a run, sds of 14 such tests were 1.2 to 1.7 times too small."""
    problem = daily(fmu.UndatedDamage(by="day", grows=grows, scatter=fmu.Population()))
    found = fmu.plan(problem, 1, modes=1, draws=4)
    assert found.doubts[0] == "The date of the loss of k is uncertain; plan with a run (--run, trace)."
    assert not found.recommended
