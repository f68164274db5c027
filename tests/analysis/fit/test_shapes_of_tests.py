"""Shapes of several tests after a run: the test and the sensor that contradict the model are named."""

import numpy as np
import pytest

import fmu
from fmu.analysis.fit.check import RESIDUALS, SHAPE, TEST
from fmu.analysis.fit.measured_shapes import sensor_warnings
from fmu.analysis.fit.model_fit import CONTRADICTED, NOT_CONTRADICTED
from fmu.report.run import runs_of
from fmu.report.sections.sensors import sensors
from tests.shear_building import shear_building

NAMES = ("k1", "k2", "k3", "k4")
FLOORS = [(f"floor {i}", "x") for i in range(1, 5)]
ERRORS = [fmu.FrequencyErrors(), fmu.ShapeErrors()]


def run(order=(0, 1, 2, 3), signs=(1.0, 1.0, 1.0, 1.0), error=ERRORS):
    """Return a run of four storeys in three tests with a sensor a floor, the second of them connected wrongly."""
    rng = np.random.default_rng(4)
    model = shear_building(NAMES, 2e6, 1e3, dofs=FLOORS)
    lam, phi = np.linalg.eigh(model.K(np.ones(4)).toarray() / 1e3)
    f, tests = np.sqrt(lam) / (2.0 * np.pi), []
    for t in range(3):
        shapes = phi + 0.01 * rng.standard_normal(phi.shape)
        if t == 1:
            shapes = np.array(signs)[:, None] * shapes[list(order)]
        hertz = f * (1.0 + 0.003 * rng.standard_normal(4))
        data = fmu.ModalData(hertz, sensors=FLOORS, shapes=shapes, sd_hz=0.003 * f, shapes_sd=0.02)
        tests.append(fmu.Test(f"t{t + 1}", data))
    parameters = [fmu.Parameter(name, 1.0, 0.7, 1.4) for name in NAMES]
    problem = fmu.JointProblem(model, tests, parameters, pairing="index", error=error)
    return problem, fmu.sample(
        problem, draws=60, warmup=60, chains=2, seed=1, maxima=fmu.find_map(problem, starts=2)
    )


@pytest.fixture(scope="module")
def swapped():
    return run(order=(0, 2, 1, 3))


def test_swapped_sensors_are_named_with_their_test(swapped):
    problem, trace = swapped
    found = fmu.diagnose(trace, problem)
    (of_test,) = (check for check in found.fit.checks if check.of == "test t2")
    assert of_test.failed
    assert of_test.sentence.endswith("; look at sensors floor 2 x and floor 3 x")
    said = [warning for warning in found.notes if warning.startswith("Test t2: ")]
    assert [one.partition(" (")[0] for one in said] == [
        "Test t2: Sensors floor 2 x and floor 3 x: exchanged, they would agree with the model"
    ]
    assert not any(warning.startswith(("Test t1: ", "Test t3: ")) for warning in found.warnings)
    unlike = [warning for warning in found.notes if "does not match the measured shape" in warning]
    assert unlike
    assert all(warning.startswith("mode t2: ") and "MAC 0." in warning for warning in unlike)
    assert said[0] in str(found)


def test_the_tests_divide_the_level_that_all_residuals_have(swapped):
    checks = [check for check in fmu.diagnose(swapped[1]).fit.checks if check.kind in (RESIDUALS, TEST)]
    limits = {check.of: float(check.limit.removeprefix("p ")) for check in checks}
    of_all = limits.pop("all used data")
    assert limits == pytest.approx({f"test t{t}": of_all / 3 for t in (1, 2, 3)}, rel=0.1)


def test_the_page_names_test_sensor_and_mode(swapped):
    section = sensors(runs_of({"hmc": swapped[1]})["hmc"])
    doubts, _, details = section.parts
    assert doubts.items == tuple(sensor_warnings(swapped[1]))
    (table,) = details.parts
    test, _, mac, sensor, _, ecomac = table.rows[0]
    assert test == "t2"
    assert sensor in ("floor 2 x", "floor 3 x")
    assert float(mac) < 0.8 < 0.98 < min(float(row[2]) for row in table.rows[1:])
    assert float(ecomac) > 0.1 > max(float(row[5]) for row in table.rows[1:])


def test_a_reversed_sensor_is_named_with_its_test():
    """Only frequencies have an error model, so that the shapes are checked by their MAC."""
    _, trace = run(signs=(1.0, 1.0, -1.0, 1.0), error=fmu.FrequencyErrors())
    found = fmu.diagnose(trace)
    assert found.fit.verdict == CONTRADICTED
    failed = [check.of for check in found.fit.checks if check.kind == SHAPE and check.failed]
    assert failed
    assert all(name.startswith("mode t2: ") for name in failed)
    (said,) = (warning for warning in found.notes if warning.startswith("Test "))
    assert said.startswith("Test t2: Sensor floor 3 x: test and model disagree")
    assert said.endswith("with the opposite sign it would agree.")


def test_right_shapes_name_nothing():
    _, trace = run()
    found = fmu.diagnose(trace)
    assert found.fit.verdict == NOT_CONTRADICTED
    assert not any("ensor" in warning for warning in found.warnings)
    first, *_ = sensors(runs_of({"hmc": trace})["hmc"]).parts
    assert first.words == "No sensor stands out in any of the 3 tests."
