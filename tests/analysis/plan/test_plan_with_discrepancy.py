"""Plans of tests of models with a discrepancy."""

import numpy as np
import pytest

import fmu
from fmu.analysis.plan.options import AGAIN
from tests.shear_building import frequencies_hz, shear_building

MODEL = shear_building(["k1", "k1", "k2", "k2"], 3e6, 1000.0)
PARAMETERS = [fmu.Parameter(name, 1.0, 0.4, 1.6, fmu.Normal(0.1, mean=1.0)) for name in ("k1", "k2")]
SENSORS, MASS = tuple((i, "x") for i in range(4)), {3: 800.0}
SD, SHAPE_SD, N_MODES = 0.002, 0.02, 3
ERRORS = [fmu.FrequencyErrors("absolute"), fmu.ShapeErrors()]
MODES = fmu.Discrepancy("modes", sd=0.02, correlation=0.3, shape_sd=0.05)


def data_at(theta, model=MODEL, repeats=1, shapes=True):
    """Return the mean of repeated tests without errors, which has the sds that the plan assumes."""
    f, phi = (x[..., :N_MODES] for x in frequencies_hz(model, theta))
    sd_hz = SD * f / np.sqrt(repeats)
    if not shapes:
        return fmu.ModalData(f, sd_hz=sd_hz)
    sd = SHAPE_SD * np.abs(phi).max(axis=0) / np.linalg.norm(phi, axis=0) / np.sqrt(repeats)
    return fmu.ModalData(f, sensors=SENSORS, shapes=phi, sd_hz=sd_hz, shapes_sd=np.tile(sd, (4, 1)))


def covariance(problem, theta, prior_sd):
    p = problem.n_structural
    information = problem.quadratic(theta[None])[2][0, :p, :p]
    return np.linalg.inv(information + np.eye(p) / prior_sd**2)


def expected(found, discrepancy, **how):
    """Return the covariances of the linearised posterior at each draw, (n, 2, 2), from the likelihood itself."""
    errors = ERRORS if how.get("shapes", True) else ERRORS[:1]
    given = {"pairing": "index", "error": errors, "discrepancy": discrepancy}
    return np.array(
        [
            covariance(
                fmu.UpdatingProblem(MODEL, data_at(theta, **how), PARAMETERS, **given),
                np.append(theta, found.problem.start[2:]),
                found.design.prior_sd,
            )
            for theta in found.before.draws
        ]
    )


def sds(covariances):
    return np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)).mean(axis=0)


def first_test(discrepancy, **options):
    given = {"pairing": "index", "error": ERRORS, "discrepancy": discrepancy}
    problem = fmu.UpdatingProblem(MODEL, data_at(np.ones(2)), PARAMETERS, **given)
    return fmu.plan(problem, 4, draws=3, shape_sd=SHAPE_SD, **options)


@pytest.mark.parametrize(
    "discrepancy",
    [
        fmu.Discrepancy(tau=0.05),
        fmu.Discrepancy(tau=0.05, correlation=0.4, groups=("k2",)),
        fmu.Discrepancy(),
        MODES,
        [MODES, fmu.Discrepancy(tau=0.03)],
    ],
)
def test_a_first_test_has_the_covariance_of_the_likelihood_with_its_discrepancy(discrepancy):
    found = first_test(discrepancy)
    after = expected(found, discrepancy)
    np.testing.assert_allclose(found.parameters()["after"], sds(after), rtol=1e-6)
    before = 2.0 * np.log(found.design.prior_sd).sum()
    assert found.information == pytest.approx(0.5 * np.mean(before - np.linalg.slogdet(after)[1]), rel=1e-6)
    assert found.information <= found.bound
    assert "model's" not in " ".join(found.doubts)
    ratio = sds(expected(found, discrepancy, repeats=20)) / found.design.prior_sd
    assert found.repeats.loc[20, "median_sd"] == pytest.approx(np.median(ratio), rel=1e-6)


@pytest.mark.parametrize("discrepancy", [fmu.Discrepancy(tau=0.05), fmu.Discrepancy("modes", sd=0.02)])
def test_frequencies_alone_have_errors_of_the_model(discrepancy):
    """They were 2 to 7 times too accurate."""
    given = {"pairing": "index", "discrepancy": discrepancy}
    problem = fmu.UpdatingProblem(MODEL, data_at(np.ones(2), shapes=False), PARAMETERS, **given)
    found = fmu.plan(problem, 4, draws=3)
    table = found.parameters()
    np.testing.assert_allclose(table["frequencies"], sds(expected(found, discrepancy, shapes=False)), rtol=1e-6)
    ignored = any("ignores the model's errors in frequencies or shapes" in one for one in found.doubts)
    assert ignored is (discrepancy.kind == "modes")


def test_a_second_test_has_the_same_errors_of_the_model():
    discrepancy = fmu.Discrepancy(tau=0.05, correlation=0.4)
    found = first_test(discrepancy, changes={"more mass": fmu.Change(masses=MASS)})
    gain = found.repeats["information"].diff().loc[2]
    assert found.second_tests.loc[AGAIN, "gain"] == pytest.approx(gain, abs=0.01)
    heavier, after = shear_building(["k1", "k1", "k2", "k2"], 3e6, [1000.0, 1000.0, 1000.0, 1800.0]), []
    for theta in found.before.draws:
        tests = [fmu.Test("a", data_at(theta)), fmu.Test("b", data_at(theta, heavier), masses=MASS)]
        given = {"pairing": "index", "error": ERRORS, "discrepancy": discrepancy}
        together = fmu.JointProblem(MODEL, tests, PARAMETERS, **given)
        after.append(covariance(together, theta, found.design.prior_sd))
    ratio = sds(np.array(after)) / found.design.prior_sd
    assert found.second_tests.loc["more mass", "largest_sd"] == pytest.approx(ratio.max(), rel=1e-6)


@pytest.mark.parametrize("discrepancy", [fmu.Discrepancy(tau=0.05), MODES])
def test_a_discrepancy_that_the_plan_ignores_is_a_doubt(discrepancy):
    given = {"pairing": "index", "error": ERRORS, "discrepancy": discrepancy}
    tests = [fmu.Test(name, data_at(np.ones(2))) for name in ("May", "June")]
    found = fmu.plan(fmu.JointProblem(MODEL, tests, PARAMETERS, **given), 3, draws=4)
    assert not found.recommended
    assert "The plan ignores the model's discrepancy" in " ".join(str(found).split())


def test_simulated_tests_would_lack_the_discrepancy():
    with pytest.raises(ValueError, match=r"plan: must be of a model without a discrepancy"):
        fmu.simulate_plan(first_test(MODES), 1)


@pytest.mark.parametrize(
    "discrepancy", [fmu.Discrepancy("modes", sd=0.02, shape_sd=0.9), fmu.Discrepancy(tau=20.0, groups=("k2",))]
)
def test_errors_of_the_model_in_shapes_confuse_modes(discrepancy):
    assert "is paired with another mode" not in " ".join(first_test(()).doubts)
    assert "is paired with another mode" in " ".join(first_test(discrepancy).doubts)


def test_a_parameter_that_is_not_updated_scatters_too():
    held = [PARAMETERS[0], fmu.Parameter("k2", 1.0, 0.4, 1.6, updated=False)]
    given = {"pairing": "index", "error": ERRORS, "discrepancy": fmu.Discrepancy(tau=0.05)}
    found = fmu.plan(fmu.UpdatingProblem(MODEL, data_at(np.ones(2)), held, **given), 4, draws=3, shape_sd=SHAPE_SD)
    after = [
        covariance(
            fmu.UpdatingProblem(MODEL, data_at(np.append(k1, 1.0)), held, **given), k1, found.design.prior_sd
        )
        for k1 in found.before.draws
    ]
    np.testing.assert_allclose(found.parameters()["after"], sds(np.array(after)), rtol=1e-6)


def test_a_loss_since_a_first_test_has_errors_of_the_model():
    target = fmu.DamageTarget("k1", 0.1, fmu.Normal(0.2))
    plain, found = (first_test(one, target=target).losses().loc["k1"] for one in ((), fmu.Discrepancy(tau=0.1)))
    assert found["sd_before"] == pytest.approx(plain["sd_before"], rel=1e-12)
    assert found["sd_after"] > 1.02 * plain["sd_after"]
    assert found["if_twice"] < plain["if_twice"]
