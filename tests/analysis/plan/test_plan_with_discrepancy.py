"""Plans of tests of models with a discrepancy."""

import numpy as np
import pytest

import fmu
from tests.shear_building import frequencies_hz, shear_building

MODEL = shear_building(["k1", "k1", "k2", "k2"], 3e6, 1000.0)
PARAMETERS = [fmu.Parameter(name, 1.0, 0.4, 1.6, fmu.Normal(0.1, mean=1.0)) for name in ("k1", "k2")]
F = frequencies_hz(MODEL, np.ones(2))[0]
DATA = fmu.ModalData(F, sd_hz=0.002 * F)
KINDS = [fmu.Discrepancy(tau=0.05), fmu.Discrepancy("modes", sd=0.02, correlation=0.3)]


@pytest.mark.parametrize("discrepancy", KINDS)
def test_a_discrepancy_that_the_plan_ignores_is_a_doubt(discrepancy):
    given = {"pairing": "index", "discrepancy": discrepancy}
    one = fmu.UpdatingProblem(MODEL, DATA, PARAMETERS, **given)
    several = fmu.JointProblem(MODEL, [fmu.Test("May", DATA), fmu.Test("June", DATA)], PARAMETERS, **given)
    for problem in (one, several):
        found = fmu.plan(problem, 3, draws=4)
        assert not found.recommended
        assert "The plan ignores the model's discrepancy" in " ".join(str(found).split())
        with pytest.raises(ValueError, match=r"plan: must be of a model without a discrepancy"):
            fmu.simulate_plan(found, 1)
