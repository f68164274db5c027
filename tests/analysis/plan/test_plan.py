"""Plans of tests of small structures, from their matrices and from users' functions."""

import numpy as np
import pytest

import fmu
from fmu.analysis.plan.options import AGAIN
from tests import measured_frfs
from tests.shear_building import frequencies_hz, shear_building

NAMES = ["k1", "k1", "k2", "k2", "k3", "k3"]


def parameter(name, sd=0.1):
    return fmu.Parameter(name, 1.0, 0.5, 1.5, fmu.Normal(sd, mean=1.0))


def problem_of(model, names, n_modes=3):
    parameters = [parameter(name) for name in names]
    start = np.ones(len(names))
    f = frequencies_hz(model, start)[0][:n_modes]
    return fmu.UpdatingProblem(model, fmu.ModalData(f, sd_hz=0.005 * f), parameters)


@pytest.fixture(scope="module")
def tower():
    return problem_of(shear_building(NAMES, 3e6, 1000.0), ["k1", "k2", "k3"])


@pytest.fixture(scope="module")
def planned(tower):
    return fmu.plan(tower, 3, draws=16)


def test_a_plan_is_within_its_bound_and_above_the_customary_choices(planned):
    assert planned.recommended, planned.doubts
    assert len(planned.sensors) == 3
    assert 0.0 <= planned.gap < 0.2
    assert np.all(planned.choices["information"] <= planned.bound)
    assert planned.information >= planned.choices["information"].drop("this plan").max() - 1e-9
    assert planned.curve["information"].iloc[-1] == pytest.approx(planned.information)


def test_expected_sds_are_those_of_the_linearised_posterior(planned, tower):
    """With one draw at the start, the expected information is JᵀJ of the likelihood of such data."""
    model, theta = tower.model.structure, np.ones(3)
    f, shapes = frequencies_hz(model, theta)
    rows = [model.dof(*sensor) for sensor in planned.sensors]
    seen = shapes[rows, :3]
    largest = np.max(np.abs(shapes[:, :3]), axis=0)
    sd = 0.02 * largest / np.linalg.norm(seen, axis=0)
    data = fmu.ModalData(
        f[:3], sensors=planned.sensors, shapes=seen, sd_hz=0.005 * f[:3], shapes_sd=np.tile(sd, (3, 1))
    )
    errors = [fmu.FrequencyErrors("absolute"), fmu.ShapeErrors()]
    updated = fmu.UpdatingProblem(model, data, tower.parameters, error=errors)
    information = updated.likelihood.quadratic(theta[None])[2][0] + np.eye(3) / planned.design.prior_sd**2
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    np.testing.assert_allclose(planned.parameters()["after"], expected, rtol=0.1)


@pytest.mark.parametrize(
    "error",
    [
        fmu.FrequencyErrors("relative", sd=0.02),
        fmu.FrequencyErrors("eigenvalue", sd=0.04),
        fmu.StudentErrors("relative", sd=0.02 * np.sqrt(5 / 7), freedom=4.0),
    ],
)
def test_the_expected_sds_of_frequencies_are_those_of_the_problem(tower, error):
    problem = fmu.UpdatingProblem(
        tower.model, fmu.ModalData(tower.data.frequencies_hz), tower.parameters, error=error
    )
    np.testing.assert_allclose(fmu.plan(problem, 2, draws=2).frequency_sd, 0.02, rtol=1e-12)
    np.testing.assert_allclose(fmu.plan(problem, 2, draws=2, modes=2).frequency_sd, 0.02, rtol=1e-12)


def test_correlated_errors_have_the_sds_of_their_covariance(tower):
    """Given the other frequencies they would be 0.0077, and the plan counts the three as independent."""
    f = np.asarray(tower.data.frequencies_hz)
    correlation = 0.9 + 0.1 * np.eye(3)
    data = fmu.ModalData(f, covariance_hz2=correlation * np.outer(0.02 * f, 0.02 * f))
    problem = fmu.UpdatingProblem(tower.model, data, tower.parameters)
    np.testing.assert_allclose(fmu.plan(problem, 2, draws=2).frequency_sd, 0.02, rtol=1e-12)


@pytest.mark.parametrize(
    ("scatter", "error"),
    [
        ("each", fmu.FrequencyErrors("absolute")),
        ("pooled", fmu.FrequencyErrors("relative")),
        ("each", fmu.FrequencyErrors("eigenvalue")),
        ("joint", fmu.FrequencyErrors("absolute")),
    ],
)
def test_repeated_tests_give_the_sds_of_one_test(tower, scatter, error):
    """Not those of the mean of the 25 tests, which a table of repeats would divide once more."""
    rng = np.random.default_rng(3)
    f = np.asarray(tower.data.frequencies_hz) * (1.0 + 0.02 * rng.standard_normal((25, 3)))
    of_one = f.std(axis=0, ddof=1) / f.mean(axis=0)
    if scatter == "pooled":
        of_one = np.sqrt(np.mean(of_one**2))
    data = fmu.ModalData.from_tests(f, scatter=scatter)
    one = fmu.UpdatingProblem(tower.model, data, tower.parameters, error=error)
    several = [fmu.Test("a", data), fmu.Test("b", data)]
    for problem in (one, fmu.JointProblem(tower.model, several, tower.parameters, error=error)):
        np.testing.assert_allclose(fmu.plan(problem, 2, draws=2).frequency_sd, of_one, rtol=1e-12)


def test_repeated_tests_beside_errors_of_the_model_or_a_given_sd(tower):
    rng = np.random.default_rng(4)
    f = np.asarray(tower.data.frequencies_hz) * (1.0 + 0.02 * rng.standard_normal((25, 3)))
    data, model_sd = fmu.ModalData.from_tests(f), fmu.Parameter("model", 0.03, 0.001, 0.2)
    w = np.array([1.0, 4.0, 0.25])
    of_one = f.std(axis=0, ddof=1) / f.mean(axis=0)
    for error, expected in (
        (fmu.FrequencyErrors("relative", model_sd=model_sd), np.hypot(of_one, 0.03)),
        (fmu.FrequencyErrors("relative", sd=0.02), 0.02),
        (fmu.FrequencyErrors("relative", weights=w), of_one / np.sqrt(w)),
        (fmu.FrequencyErrors("eigenvalue", weights=w), of_one / np.sqrt(w)),
    ):
        problem = fmu.UpdatingProblem(tower.model, data, tower.parameters, error=error)
        np.testing.assert_allclose(fmu.plan(problem, 2, draws=2).frequency_sd, expected, rtol=1e-12)


def test_an_inferred_sd_of_frequencies_has_its_starting_value_before_a_run(tower):
    noise = fmu.Parameter("noise", 0.03, 0.001, 0.2)
    error = fmu.FrequencyErrors("relative", sd=noise)
    problem = fmu.UpdatingProblem(tower.model, tower.data, tower.parameters, error=error)
    np.testing.assert_allclose(fmu.plan(problem, 2, draws=2).frequency_sd, 0.03, rtol=1e-12)
    trace = fmu.sample(problem, "mh", draws=20, warmup=20, chains=2, maxima=fmu.find_map(problem, starts=2))
    expected = float(np.mean(trace["posterior"]["noise"]))
    np.testing.assert_allclose(fmu.plan(problem, 2, draws=2, trace=trace).frequency_sd, expected, rtol=1e-12)


def test_a_prediction_as_target_is_its_combination_of_parameters(tower):
    by_names = fmu.plan(tower, 2, draws=4, target={"k1": 1.0, "k3": 2.0})
    by_function = fmu.plan(tower, 2, draws=4, target=lambda theta: theta[:, 0] + 2.0 * theta[:, 2])
    assert by_function.information == pytest.approx(by_names.information, rel=1e-6)
    assert by_function.sensors == by_names.sensors
    one, every = fmu.plan(tower, 3, draws=4, target="k3"), fmu.plan(tower, 3, draws=4)
    assert one.parameters().loc["k3", "after"] <= every.parameters().loc["k3", "after"] * (1 + 1e-9)


def test_the_known_mass_separates_stiffness_from_mass():
    model = shear_building(["k", "k"], 1e6, 1000.0, "m")
    problem = problem_of(model, ["k", "m"], 2)
    changes = {f"400 kg on floor {i + 1}": fmu.Change(masses={i: 400.0}) for i in range(2)}
    found = fmu.plan(problem, 2, draws=16, changes=changes)
    assert np.all(found.parameters()["after"] > 0.6 * found.parameters()["before"])
    table = found.second_tests
    assert set(table.index[:2]) == set(changes)
    assert table.index[2] == AGAIN
    assert table["largest_sd"].iloc[0] < 0.6 * table.loc[AGAIN, "largest_sd"]
    assert table["gain"].iloc[0] > table.loc[AGAIN, "gain"] + 0.3


def test_repeats_help_until_the_drift_remains(tower):
    alone = fmu.plan(tower, 2, draws=4).repeats["median_sd"]
    plan = fmu.plan(tower, 2, draws=4, drift=0.05, shape_sd=1.0)
    drifting = plan.repeats["median_sd"]
    np.testing.assert_allclose(plan.frequency_sd, np.hypot(plan.design.frequency_sd, 0.05), rtol=1e-14)
    assert np.all(np.diff(alone) < 0.0)
    assert alone.loc[20] < 0.25 * alone.loc[1]  # nearly 1/√20: the prior says little
    assert drifting.loc[20] > 0.9 * drifting.loc[1]
    change = {"100 kg on floor 1": fmu.Change(masses={0: 100.0})}
    for drift in (0.0, 0.05):  # the same test again is the second of two repeats
        found = fmu.plan(tower, 2, draws=4, drift=drift, shape_sd=1.0, changes=change)
        gain = found.repeats["information"].diff().loc[2]
        assert found.second_tests.loc[AGAIN, "gain"] == pytest.approx(gain, abs=0.02)


def test_a_users_function_has_differences_that_are_counted():
    model = shear_building(NAMES, 3e6, 1000.0)

    def solve(theta):
        f, shapes = frequencies_hz(model, theta)
        return f[:3], shapes[:, :3]

    sensors = tuple((i, "x") for i in range(6))
    f, shapes = solve(np.ones(3))
    data = fmu.ModalData(f, sensors=sensors, shapes=shapes, sd_hz=0.005 * f)
    parameters = [parameter(name) for name in ("k1", "k2", "k3")]
    function = fmu.UpdatingProblem(fmu.BlackBoxModel(solve, 3), data, parameters)
    exact = fmu.UpdatingProblem(model, data, parameters)
    found, expected = (fmu.plan(problem, 3, draws=4) for problem in (function, exact))
    assert found.sensors == expected.sensors
    assert found.information == pytest.approx(expected.information, rel=1e-4)
    assert found.design.found.n_solves == 4 * 7
    with pytest.raises(ValueError, match=r"changes: need a model with matrices"):
        fmu.plan(function, 2, changes={"mass": fmu.Change(masses={1: 1.0})})


def test_triaxial_sensors_read_all_directions_of_their_place():
    steel = fmu.Material(E=2.1e11, nu=0.3, rho=7850.0)
    section = fmu.Section.rectangle(0.1, 0.2)
    group = fmu.ElementGroup("beam", np.stack([np.arange(8), np.arange(1, 9)], axis=1), section, steel)
    nodes = np.stack([np.linspace(0.0, 4.0, 9), np.zeros(9), np.zeros(9)], axis=1)
    held = {0: ("x", "y", "z", "rx", "ry", "rz")}
    frame = fmu.Frame(nodes=nodes, groups=[group], supports=held)
    model = frame.separable({"E": [("E", "beam")]})
    data = fmu.ModalData([5.0, 10.0, 32.0, 63.0], sd_hz=0.1)
    prior = fmu.Normal(2e10, mean=2.1e11)
    problem = fmu.UpdatingProblem(model, data, [fmu.Parameter("E", 2.1e11, 1e11, 3e11, prior)])
    sides = [(node, direction) for node in range(1, 9) for direction in ("y", "z")]
    found = fmu.plan(problem, 3, candidates=sides, triaxial=True, mounted=[(8, "y")], exclude=[8], draws=4)
    assert found.sensors[0] == (8, "y")
    assert len(found.sensors) == 1 + 2 * 3
    apart = fmu.plan(problem, 3, candidates=sides, min_distance=1.2, draws=4)
    at = nodes[[place for place, _ in apart.sensors], 0]
    assert np.min(np.diff(np.sort(at))) >= 1.2 - 1e-9
    assert not {8, 7} & {place for place, _ in fmu.plan(problem, 3, exclude=[8, 7], draws=4).sensors}


def test_a_mode_that_looks_like_another_is_not_recommended(tower):
    found = fmu.plan(tower, 2, draws=8, shape_sd=0.9)
    assert not found.recommended
    assert "is paired with another mode" in " ".join(found.doubts)
    assert "Not recommended." in str(found)


def test_customary_choices_keep_to_the_budget(tower):
    found = fmu.plan(tower, 5, costs={0: 2.0, 5: 2.0}, budget=4.0, draws=4)
    for chosen in (found.chosen, *found.usual.values()):
        assert 2 <= len(chosen) <= 4
        assert np.sum(found.limits.cost[list(chosen)]) <= 4.0
    assert np.all(found.choices["information"] <= found.bound)
    assert "No other choice within the budget gives more" in " ".join(found.sentences())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensors": 7}, r"sensors: must be at most 6, the number of candidates \(got 7\)"),
        ({"mounted": [(9, "x")]}, r"mounted\.0: must be a place and a direction that are free to move"),
        ({"candidates": [(0, "x"), (4, "y")]}, r"candidates\.1: must be a place and a direction that are free"),
        ({"candidates": [(0, "x"), (0, "x")]}, r"candidates\.1: must be given once"),
        ({"mounted": [(i % 6, "x") for i in range(120)]}, r"mounted\.6: must be given once"),
        ({"exclude": [17]}, r"exclude: must name places of the model \(got 17\)"),
        ({"modes": [1, 9]}, r"modes: must be modes of finite frequency"),
        ({"modes": [1, 1]}, r"modes: must be distinct numbers"),
        ({"target": []}, "target: must depend on the parameters"),
        (
            {"target": lambda theta: np.ones((len(theta), 2, 2))},
            "target: must return finite numbers of shape",
        ),
        ({"target": "E"}, r"target: must name parameters, k1, k2, k3 \(got 'E'\)"),
        ({"frequency_sd": [0.1, 0.2]}, r"frequency_sd: must be a number or 3 numbers"),
        ({"budget": 0.5}, r"budget: must be at least 1, the cost of the cheapest candidate \(got 0\.5\)"),
        ({"min_distance": 1.0}, r"min_distance: must be 0 where the coordinates"),
        ({"changes": {"m": fmu.Change(masses={9: 1.0})}}, r"changes\.m\.masses\.9: must be a place"),
    ],
)
def test_bad_input(tower, options, message):
    with pytest.raises(ValueError, match=message):
        fmu.plan(tower, **{"sensors": 2, "draws": 4} | options)


def two_towers():
    """Return a problem whose third mode belongs to a second tower, beside the first."""
    K = np.zeros((3, 3))
    K[:2, :2], K[2, 2] = [[2.0, -1.0], [-1.0, 1.0]], 9.0
    model = fmu.SeparableModel.from_terms(["k"], [(1e5 * K, "k")], [np.eye(3) * 100.0])
    return problem_of(model, ["k"], 3)


def test_a_mode_that_no_candidate_sees():
    with pytest.raises(
        ValueError, match=r"candidates: must include a place and a direction in which mode 3 moves"
    ):
        fmu.plan(two_towers(), 2, candidates=[(0, "x"), (1, "x")], modes=[1, 3], draws=4)
    with pytest.raises(ValueError, match=r"candidates: must see 3 modes of the model \(got fewer\)"):
        fmu.plan(two_towers(), 2, candidates=[(0, "x"), (1, "x")], draws=4)


def test_a_motion_that_is_not_known_is_no_candidate():
    K, M = np.diag(np.arange(2.0, 8.0) * 1e4) + 1e3, np.eye(6)
    dofs = [(place, direction) for place in (1, 2, 3) for direction in "xy"]
    model = fmu.SeparableModel.from_terms(["k"], [(K, "k")], [M], dofs=dofs, motions={(1, "x"): {}})
    problem = fmu.UpdatingProblem(
        model, fmu.ModalData([22.0, 27.0, 31.0], sd_hz=0.1), [fmu.Parameter("k", 1.0, 0.5, 2.0)]
    )
    assert (1, "x") not in fmu.plan(problem, 2, draws=4).design.candidates.sensors


def test_a_candidate_that_no_mode_moves():
    with pytest.raises(ValueError, match=r"candidates: must be moved by a mode to be measured, not as .*2, 'x'"):
        fmu.plan(two_towers(), 2, candidates=[(0, "x"), (1, "x"), (2, "x")], modes=2, draws=4)
    found = fmu.plan(two_towers(), 2, modes=2, draws=4)
    assert (2, "x") not in found.design.candidates.sensors


def test_a_plan_after_frfs_says_that_it_is_of_modes():
    found = fmu.plan(measured_frfs.problem(), 2, draws=4)
    np.testing.assert_allclose(found.frequency_sd, 0.005)
    assert "ignores frequency response functions, and damping" in found.sentences()[0]
    assert found.sentences()[0] in " ".join(str(found).split())
    own = measured_frfs.problem(others=(fmu.FrequencyErrors(),))
    np.testing.assert_allclose(
        fmu.plan(own, 2, draws=4).frequency_sd, own.tests[0].data.sd_hz / own.tests[0].data.frequencies_hz
    )
