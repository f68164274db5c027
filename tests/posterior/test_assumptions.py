"""What a posterior rests on is said of every error model and pairing, and follows what is configured."""

import json

import numpy as np
import pytest

import fmu
from fmu.analysis.trace.provenance import canonical_json
from fmu.config import read
from fmu.posterior.assumptions import assumptions
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.frequency import FrequencyErrors
from fmu.posterior.errors.mac import MACErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.priors.one_sided import LogNormal
from fmu.posterior.problem import UpdatingProblem
from tests.shear_building import shear_building

MEASURED = np.array([1.0, 2.0])
NOISE = Parameter("noise", 0.02, 0.0, prior=LogNormal(0.02, 0.5))
SHAPES = np.array([[1.0, 1.0], [1.5, -0.7]])


def storeys(error=None, pairing="shape", shapes=None, beta=None, discrepancy=(), **data):
    model = shear_building(["k", "k"], mass=[0.02, 0.01], dofs=[("1", "x"), ("2", "x")])
    sensors = [("1", "x"), ("2", "x")] if shapes is not None else []
    modes = ModalData(MEASURED, sensors=sensors, shapes=shapes, **data)
    parameters = [Parameter("k", 1.0, 0.5, 2.0, Normal(0.2, mean=1.0))]
    settings = {} if error is None else {"error": error}
    return UpdatingProblem(
        model, modes, parameters, pairing=pairing, beta=beta, discrepancy=discrepancy, **settings
    )


def found(problem, inferred=None, reduction=None):
    """Return the assumptions as they are read from a trace: through JSON."""
    return assumptions(json.loads(canonical_json(problem.configuration())), reduction, inferred)


def said(problem, **options):
    return " ".join(found(problem, **options).sentences)


def sd(problem, **options):
    return [float(row[2]) for row in found(problem, **options).errors]


def test_beta():
    problem = storeys(beta=[0.5, 2.0])
    assert "a known σ of 0.50 to 1.00 Hz (β = 0.50 to 2.00 per Hz²)" in said(problem)
    assert found(problem).errors == (("1", "1", "1", "100"), ("2", "2", "0.5", "25"))


@pytest.mark.parametrize(
    ("error", "words", "expected"),
    [
        (FrequencyErrors("relative", 0.01), "a known σ of 1 %", [0.01, 0.02]),
        (FrequencyErrors("absolute", 0.05), "a known σ of 0.05 Hz", [0.05, 0.05]),
        (FrequencyErrors("eigenvalue", 0.04), "relative to their size: Gaussian and independent, with a known σ",
         [0.02, 0.04]),
        (FrequencyErrors("relative", 0.03, model_sd=NOISE), "a known σ of 3 % and a σ that is inferred, noise",
         [0.0361, 0.0721]),
    ],
)  # fmt: skip
def test_errors_of_frequencies(error, words, expected):
    problem = storeys(error)
    assert words in said(problem)
    assert sd(problem) == pytest.approx(expected, rel=5e-3)
    for row, f in zip(found(problem).errors, MEASURED, strict=True):
        assert float(row[3]) == pytest.approx(100 * float(row[2]) / f, rel=0.01)


def test_nothing_is_said_of_the_distribution_of_an_error_model_of_the_user():
    class Own(FrequencyErrors):
        def bind(self, data, index):
            term = super().bind(data, index)
            given = term.as_dict()
            term.as_dict = lambda: given | {"error": "logistic"}
            return term

    words = said(storeys([Own("absolute", sd=0.02)]))
    assert "Errors of the kind 'logistic': an error model that is not fmu's own." in words
    assert "Gaussian" not in words.split("Priors")[0]


def test_an_inferred_sd_is_said_with_its_prior_and_after_a_run_with_its_posterior():
    problem = storeys(FrequencyErrors("relative", NOISE))
    assert "a σ that is inferred, noise (prior: log-normal, median 0.02, sigma 0.5)." in said(problem)
    assert sd(problem) == pytest.approx([0.02, 0.04])  # at the start
    after = {"noise": (0.035, 0.004)}
    assert "sigma 0.5; posterior: 0.0350 ± 0.0040)" in said(problem, inferred=after)
    assert sd(problem, inferred=after) == pytest.approx([0.035, 0.07])
    assert found(problem).has_inferred
    assert not found(storeys()).has_inferred


def test_covariance():
    problem = storeys(covariance_hz2=np.array([[0.04, 0.01], [0.01, 0.09]]))
    assert "Gaussian and correlated between the modes, with the covariance that is given" in said(problem)
    assert sd(problem) == [0.2, 0.3]


def test_repeated_tests():
    rng = np.random.default_rng(1)
    tests = MEASURED + 0.01 * rng.standard_normal((20, 2))
    data = ModalData.from_tests(tests)
    problem = UpdatingProblem(storeys().model.structure, data, [Parameter("k", 1.0, 0.5, 2.0)], pairing="index")
    assert "is the mean of repeated tests, and its σ is the error of that mean" in said(problem)
    assert sd(problem) == pytest.approx(tests.std(axis=0, ddof=1) / np.sqrt(20), rel=0.3)


def test_shapes_and_their_pairing():
    errors = [FrequencyErrors("relative", 0.01), ShapeErrors(0.05)]
    words = said(storeys(errors, shapes=SHAPES))
    assert "Errors of the mode shapes, scaled to unit length at the sensors: Gaussian" in words
    assert "Modes are paired by MAC with the shapes measured at 2 sensors." in words
    words = said(storeys([FrequencyErrors("relative", 0.01), MACErrors(0.02)], shapes=SHAPES))
    assert "Errors 1 − MAC of the mode shapes: half-Gaussian" in words
    assert found(storeys([ShapeErrors(0.05)], shapes=SHAPES)).errors == ()


def test_pairing_by_number_and_by_shapes_of_the_model():
    assert "Modes are paired by number in the sorted spectrum: 1, 2." in said(storeys(pairing="index"))
    words = said(storeys())
    assert "MAC with the model's own shapes before updating" in words
    assert "as the lowest elastic modes, in this order" in words
    soft = storeys(FrequencyErrors("relative", 0.01), "soft", SHAPES)
    assert ", softly: the likelihood of a measured mode is a mixture" in said(soft)
    assert "exp(MAC/0.02)" in said(soft)


def test_shipped_cases():
    path = fmu.cases.path("garteur")
    garteur = read(path).model_copy(update={"reduction": False}).build("garteur", path.parent, None)
    assert "by their numbers among these, " in said(garteur)
    assert "as the lowest modes that the sensors see" in said(fmu.cases.load("cantilever-section"))
    assert found(fmu.cases.load("cantilever-young")).errors[0] == ("1", "31.9", "0.707", "2.2")


def test_the_reduced_model():
    assert "The full model is solved everywhere" in said(storeys())
    words = said(storeys(), reduction=1e-6)
    assert words.endswith("The relative error allowed to a frequency is 1e-6.")
    problem = storeys().configuration()
    *_, last = assumptions(problem, 1e-6, error=3.2e-6).sentences
    assert last.endswith("allowed to a frequency is 1e-6; 3.2e-6 was found at draws solved again in full.")
    *_, last = assumptions(problem, 1e-6, error=3.2e-7, elsewhere=1e-3).sentences
    assert " is 1e-6 where the posterior has its mass, and 0.001 elsewhere; 3.2e-7 was found" in last
    *_, last = assumptions(problem, 1e-3, log_prob=0.01).sentences
    assert last.endswith("to a frequency is 0.001. The error allowed to the log-probability is 0.01.")


def test_a_plain_density_has_none():
    assert assumptions({"density": "Gaussian", "lower": [0.0], "upper": [1.0]}, None) is None


def test_several_tests():
    said = assumptions(fmu.cases.load("shear-4dof-repeated").configuration(), None).sentences
    assert "A parameter has one value in all tests, unless it is named for one of them or for a group." in said
    (drawn,) = (one for one in said if one.startswith("The values of k1, k2, k3, k4 in the tests are draws"))
    assert drawn.endswith(
        "from a normal distribution each, cut off at the bounds; the populations are independent of each other."
    )
    assert "Modes are paired by number in the sorted spectrum: 1, 2, 3, 4." in said


@pytest.mark.parametrize(
    ("discrepancy", "words"),
    [
        (fmu.Discrepancy(tau=0.05),
         "k scatters over the modes by τ times the value, with a known τ of 0.05, independently."),
        (fmu.Discrepancy(correlation=0.4),
         "posterior: 0.0200 ± 0.0050), and between two modes a known correlation of 0.4."),
        (fmu.Discrepancy("modes", sd=0.02, shape_sd=0.1),
         "the frequencies err, relative to their size, with a known σ of 0.02, and between two modes a "
         "correlation that is inferred, model error correlation (prior: uniform)."),
        (fmu.Discrepancy("modes", shape_sd=0.1),
         "scaled to a largest component of one, err with a known σ of 0.1, independent from sensor to sensor."),
    ],
)  # fmt: skip
def test_an_error_of_the_model_is_said_with_its_size_and_its_correlation(discrepancy, words):
    errors = [FrequencyErrors("relative", 0.01), ShapeErrors(0.05)]
    text = said(storeys(errors, shapes=SHAPES, discrepancy=discrepancy), inferred={"tau": (0.02, 0.005)})
    assert words in text
    assert "must cover both measurement error and model error" not in text
