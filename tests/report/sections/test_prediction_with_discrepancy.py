"""The page shows predictions by the model alone and with its error, and says where a scatter keeps its prior."""

import numpy as np
import pytest

import fmu
from fmu.analysis.information import information
from fmu.report.document import PageTable
from fmu.report.run import runs_of
from fmu.report.sections.prediction import predictive
from fmu.report.sections.verdicts import verdicts
from tests.shear_building import frequencies_hz, shear_building

NAMES = ["k1", "k2"]


@pytest.fixture(scope="module", params=[(), fmu.Discrepancy()], ids=["none", "embedded"])
def run(request):
    measured = frequencies_hz(shear_building(NAMES), np.ones(2))[0]
    problem = fmu.UpdatingProblem(
        shear_building(NAMES), fmu.ModalData(measured, sd_hz=0.01 * measured),
        [fmu.Parameter(name, 1.0, 0.2, 3.0) for name in NAMES], pairing="index", discrepancy=request.param,
    )  # fmt: skip
    trace = fmu.sample(problem, draws=100, warmup=80, maxima=fmu.find_map(problem, starts=8), progress=False)
    return request.param, runs_of({"mixture": trace})["mixture"]


def test_the_page_shows_predictions_with_and_without_the_error(run):
    discrepancy, reported = run
    tables = [part for part in predictive(reported).parts if isinstance(part, PageTable)]
    assert len(tables) == (2 if discrepancy else 1)
    if discrepancy:
        for row in tables[1].rows:
            alone, whole = ([float(x) for x in cell.split(" to ")] for cell in row[2:])
            assert whole[0] < alone[0] < alone[1] < whole[1]
    assert ("of a similar structure" in tables[0].caption) == bool(discrepancy)


def test_a_scatter_keeps_its_prior_without_degrees_of_freedom(run):
    """Two frequencies determine two stiffnesses, and nothing is left for τ."""
    discrepancy, reported = run
    said = str(fmu.diagnose(reported.trace))
    assert ("tau was not updated by the data" in said) == bool(discrepancy)
    if discrepancy:
        tau = reported.trace["posterior"]["tau"].to_numpy()
        prior = np.sqrt(np.array([2.0 / np.pi, 1.0 - 2.0 / np.pi])) * discrepancy.prior_sd
        assert np.abs(np.array([tau.mean(), tau.std()]) / prior - 1.0).max() < 0.3


def test_an_inferred_standard_deviation_is_no_change_of_the_model():
    model = shear_building(["k1", "k1"])
    measured = frequencies_hz(model, np.array([1.3]))[0]
    noise = fmu.Parameter("noise", 0.05, 1e-4, 1.0, prior=fmu.HalfNormal(0.1))
    problem = fmu.UpdatingProblem(
        model, fmu.ModalData(measured * np.array([1.001, 0.999])), [fmu.Parameter("k1", 1.0, 0.2, 3.0)],
        error=fmu.FrequencyErrors("relative", sd=noise), pairing="index",
    )  # fmt: skip
    trace = fmu.sample(problem, draws=200, warmup=80, maxima=fmu.find_map(problem, starts=4), progress=False)
    changes, sure, *_ = verdicts(runs_of({"mixture": trace})["mixture"])
    assert "noise" not in information(trace).not_informed
    assert changes.answer.startswith("k1 ")
    assert "noise" not in changes.answer + sure.answer
