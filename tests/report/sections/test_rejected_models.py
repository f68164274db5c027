"""The first screen of a model that the data reject: nothing on it is said as if the model were right."""

from dataclasses import replace

import numpy as np
import pytest

import fmu
from fmu.analysis.fit.model_fit import CONTRADICTED
from fmu.report.run import runs_of
from fmu.report.sections.fit import checks, model_fit
from fmu.report.sections.updating import frequencies
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


def test_a_probability_that_underflows_is_not_printed_as_zero():
    run, _ = first_screen(40.0)
    fit = run.diagnosis.fit
    changed = tuple(replace(check, p=0.0) if check.failed else check for check in fit.checks)
    of_zero = replace(run, diagnosis=replace(run.diagnosis, fit=replace(fit, checks=changed)))
    assert model_fit(of_zero).said.endswith("(p < 1e-300).")
    table = checks(of_zero).parts[1]
    by_result = [(row[5], row[4]) for row in table.rows]
    assert ("fails", "< 1e-300") in by_result
    assert not any(p == "0" for _, p in by_result)


def test_an_interval_with_noise_has_the_digits_of_the_noise():
    """The model's frequency is known to 1e-7 Hz here, a new measurement to 0.1 Hz."""
    run, _ = first_screen(0.0)
    table = run.prediction.assign(sd=1e-7)
    rows = frequencies(replace(run, prediction=table)).parts[1].rows
    for row in rows:
        low, high = row[7].split(" to ")
        assert all(len(end.partition(".")[2]) <= 4 for end in (low, high))
        assert len(row[4].partition(".")[2]) == 8
