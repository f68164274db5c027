import numpy as np
import pytest

import fmu
from tests.shear_building import shear_building, storey

NAMES = ("k1", "k2")
PARAMETERS = [fmu.Parameter(name, 2e6, 1e6, 4e6) for name in NAMES]


@pytest.fixture(scope="module")
def campaign():
    """A building of two storeys in 30 tests, whose stiffnesses scatter by 2 %."""
    rng, model, n = np.random.default_rng(3), shear_building(NAMES, mass=1e3), 30
    means, tests = np.array([2e6, 2.5e6]), []
    for t in range(n):
        k = means * (1.0 + 0.02 * rng.standard_normal(2))
        K = sum(k[j] * storey(j, 2) for j in range(2))
        f = np.sqrt(np.linalg.eigvalsh(K / 1000.0)) / (2.0 * np.pi) * (1.0 + 0.002 * rng.standard_normal(2))
        tests.append(fmu.Test(f"t{t + 1}", fmu.ModalData(f, sd_hz=0.002 * f)))
    varies = {name: fmu.Population() for name in NAMES}
    return fmu.JointProblem(model, tests, PARAMETERS, varies=varies, pairing="index")


def test_scores_are_neither_listed_nor_doubted(campaign):
    found = fmu.check(campaign)
    said = str(found)
    assert "score" not in said
    assert "Modes are paired by number in the sorted spectrum: 1, 2." in found.sentences()
    assert "The model itself pairs its modes with the measured ones." not in found.sentences()
    assert list(found.parameters.index) == ["k1 mean", "k1 sd", "k2 mean", "k2 sd"]
    assert len(found.colours) == 4
    assert found.doubts == ()
    assert len(said.splitlines()) < 180
    assert "Prior prediction for a measurement, Hz: the first 40 of 60 rows" in said


def test_the_mean_is_as_well_known_as_the_tests_scatter(campaign):
    """Linearised, its standard deviation is √((σ² + C)/n), of which the scatter σ is at the start of its prior."""
    found = fmu.identifiability(campaign)
    assert found.names == ("k1 mean", "k2 mean")
    start = dict(zip(campaign.names, campaign.start, strict=True))
    model, data = shear_building(NAMES, mass=1e3), campaign.tests[0].data
    one = fmu.identifiability(fmu.UpdatingProblem(model, data, PARAMETERS, pairing="index"))
    of_one = np.linalg.inv(one.fisher_information)
    scatter = np.diag([start["k1 sd"] ** 2, start["k2 sd"] ** 2])
    expected = (of_one + scatter) / len(campaign.tests)
    np.testing.assert_allclose(np.linalg.inv(found.fisher_information), expected, rtol=0.02)


def with_shapes(n_tests, swapped=()):
    """Return a building of eight storeys whose shapes each test measured, two sensors swapped in some of them."""
    names = [f"k{j}" for j in range(8)]
    model = shear_building(names, stiffness=2e6, mass=1e3)
    K = 2e6 * sum(storey(j, 8) for j in range(8))
    lam, phi = (part[..., :4] for part in np.linalg.eigh(K / 1e3))
    tests = []
    for t in range(n_tests):
        shapes = phi[[0, 1, 2, 6, 4, 5, 3, 7]] if t in swapped else phi
        data = fmu.ModalData(
            np.sqrt(lam) / (2.0 * np.pi), sensors=model.dofs, shapes=shapes, shapes_sd=0.02, sd_hz=0.02
        )
        tests.append(fmu.Test(f"t{t + 1}", data))
    parameters = [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in names]
    errors = [fmu.FrequencyErrors(), fmu.ShapeErrors()]
    return fmu.JointProblem(model, tests, parameters, varies={"k0": "test"}, error=errors)


def test_a_swapped_sensor_is_named_with_its_test():
    assert fmu.check(with_shapes(3)).modes.doubts == ()
    doubts = fmu.check(with_shapes(3, swapped=(1,))).modes.doubts
    assert all(doubt.startswith("Test t2: ") for doubt in doubts)
    assert any("MAC 0." in doubt for doubt in doubts)
    assert any(doubt.startswith("Test t2: Sensors 3 x and 6 x: exchanged, they would agree") for doubt in doubts)


def test_of_many_tests_with_warnings_the_first_are_named():
    doubts = fmu.check(with_shapes(8, swapped=range(8))).modes.doubts
    assert {doubt[:8] for doubt in doubts[:-1]} == {f"Test t{t}:" for t in range(1, 6)}
    assert doubts[-1] == "3 more tests have such warnings, such as t8."
