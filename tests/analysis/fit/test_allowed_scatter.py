"""The verdict on a model that may be wrong, and the remedy for one that is contradicted."""

import numpy as np
import xarray as xr

import fmu
from fmu.analysis.fit.allowed_scatter import REMEDY, _describe_modes
from fmu.analysis.fit.model_fit import ALLOWED, CONTRADICTED, NOT_CONTRADICTED, NOT_TESTABLE, model_fit
from tests.shear_building import frequencies_hz, shear_building

STOREYS = ["k1", "k2", "k3", "k4", "k5"]


WRONG = np.array([1.0, 1.4, 0.8, 1.2, 0.7])


def fit_of(discrepancy=(), n_modes=5, truth=WRONG):
    """Return the verdict on a model whose storeys have the same stiffness; those measured differ by up to 40 %."""
    truth = frequencies_hz(shear_building(STOREYS), truth)[0]
    problem = fmu.UpdatingProblem.reduced(
        shear_building(["k"] * 5),
        fmu.ModalData(truth[:n_modes]),
        [fmu.Parameter("k", 1.0, 0.2, 3.0)],
        pairing="index",
        error=fmu.FrequencyErrors("relative", sd=0.002),
        discrepancy=discrepancy,
    )
    return model_fit(
        fmu.sample(problem, draws=80, warmup=40, chains=2, seed=1, maxima=fmu.find_map(problem, starts=2))
    )


def test_a_contradicted_model_has_a_remedy_and_then_a_verdict_that_is_not_good():
    found = fit_of()
    assert found.verdict == CONTRADICTED
    assert found.said[-1].startswith(f"{REMEDY}. ")
    assert "fmu run FILE --discrepancy embedded" in REMEDY
    assert "roughly, it would be " in found.said[-1]
    rescued = fit_of(fmu.Discrepancy(prior_sd=0.2))
    assert rescued.verdict == ALLOWED
    assert "may be wrong" in rescued.answer
    assert rescued.said[0].startswith("k: a scatter over the modes, tau, of ")
    assert REMEDY not in " ".join(rescued.said)


def test_a_model_that_is_not_contradicted_needs_no_remedy():
    found = fit_of(truth=np.ones(5))
    assert found.verdict == NOT_CONTRADICTED
    assert found.remedy == ""
    assert REMEDY not in " ".join(found.said)


def test_a_given_scatter_is_stated():
    assert fit_of(fmu.Discrepancy(tau=0.2)).said == ("k: a given scatter of 20 % over the modes.",)


def test_no_more_data_than_parameters_test_nothing_with_a_scatter_either():
    found = fit_of(fmu.Discrepancy(), n_modes=1)
    assert found.verdict == NOT_TESTABLE
    assert "the median of its prior is 6.7 %" in found.reasons[1]


def test_the_article_suits_the_error():
    trace = xr.DataTree(children={"posterior": xr.DataTree(xr.Dataset({"s": 0.02}))})
    said = _describe_modes(trace, {"sd": {"inferred": 0}, "shape_sd": {"inferred": 0}}, ["s"])
    assert [one.partition(" by the model")[0] for one in said] == [
        "a relative error of the frequencies",
        "an error of the shapes",
    ]
