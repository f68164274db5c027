"""The first screen of a model that the data reject: nothing on it is said as if the model were right."""

import numpy as np
import pytest

import fmu
from fmu.analysis.fit.model_fit import CONTRADICTED
from fmu.report.run import runs_of
from fmu.report.sections.verdicts import ASSUMED, verdicts
from tests.linear import SLOPES, LinearModel

SURE, LEFT, FIT = 1, 2, 3


def first_screen(off, upper=5.0):
    """The verdicts on three frequencies by two parameters, the third measured `off` its place by so many sd."""
    parameters = [
        fmu.Parameter("a", 0.0, lower=-5.0, upper=upper, prior=fmu.Normal(2.0)),
        fmu.Parameter("b", 0.0, lower=-5.0, upper=5.0, prior=fmu.Normal(2.0)),
    ]
    y = 100.0 + SLOPES @ [0.6, -0.9] + np.array([0.0, 0.0, off * 0.1])
    data = fmu.ModalData(y, labels=("W1", "W2", "T1"), sd_hz=0.1)
    problem = fmu.UpdatingProblem(LinearModel(), data, parameters)
    trace = fmu.sample(problem, draws=250, warmup=100, chains=4)
    run = runs_of({"mixture": trace})["mixture"]
    return run, verdicts(run)


@pytest.mark.parametrize("off", [0.0, 40.0])
def test_certainty_says_first_that_the_data_reject_the_model(off):
    run, found = first_screen(off)
    is_rejected = run.diagnosis.fit.verdict == CONTRADICTED
    assert is_rejected == (off > 0.0)
    assert found[SURE].said.startswith(ASSUMED) == is_rejected
    assert (found[LEFT].answer, found[LEFT].is_good) == (("Not within this model", None) if off else ("No", True))


def test_what_only_a_bound_determines_is_not_determined():
    run, found = first_screen(0.0, upper=0.2)
    assert any("of the draws" in warning for warning in run.diagnosis.warnings)
    assert (found[LEFT].answer, found[LEFT].is_good) == ("Yes, beyond the bounds: a", None)
    assert found[LEFT].said.startswith("The data ask for values that the bounds exclude.")
    assert "a lies at the bounds, which narrow it." in found[SURE].said
