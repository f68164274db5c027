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
