"""Error models: what they are normalised in, and their derivatives against differences."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.integrate import quad

from fmu.fem.pairing.paired_structure import PairedStructure
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.frequency import FrequencyErrors
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.errors.mac import MACErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.parameters import Parameter
from tests.gradients import assert_gradient
from tests.shear_building import shear_building

SENSORS = ((0, "x"), (1, "x"), (3, "x"))
START = np.array([1.0, 1.3, 0.9, 1.1])
MEASURED = np.array([0.09, 0.25, 0.38])
SHAPES = np.array([[0.3, -0.8, 0.7], [0.6, -0.7, -0.9], [1.0, 1.0, 0.4]])
SIGMA = Parameter("sigma", start=0.1, lower=1e-3, upper=2.0)
DELTA = Parameter("delta", start=0.2, lower=0.0, upper=2.0)


def storeys():
    """Four storeys whose four stiffnesses are the parameters; masses of one, one and a half, …"""
    return shear_building(["k1", "k2", "k3", "k4"], mass=[1.0, 1.5, 1.2, 0.8])


@pytest.fixture(scope="module")
def structure():
    return PairedStructure.of(storeys(), pairing="index", numbers=(1, 2, 3), sensors=SENSORS, reference=START)


@pytest.fixture(scope="module")
def data():
    return ModalData(MEASURED, sensors=SENSORS, shapes=SHAPES)


MODELS = {
    "absolute": [FrequencyErrors("absolute", sd=0.01)],
    "relative, weighted": [FrequencyErrors("relative", sd=[0.02, 0.03, 0.01], weights=[1.0, 0.5, 2.0])],
    "eigenvalue": [FrequencyErrors("eigenvalue", sd=1 / 16)],
    "inferred": [FrequencyErrors("relative", sd=SIGMA)],
    "inferred twice": [FrequencyErrors("relative", sd=SIGMA, model_sd=SIGMA)],
    "error of the model": [FrequencyErrors("relative", sd=0.02, model_sd=DELTA)],
    "shapes": [ShapeErrors(sd=0.1)],
    "a sensor each": [ShapeErrors(sd=np.linspace(0.05, 0.3, 9).reshape(3, 3))],
    "shapes, inferred": [ShapeErrors(sd=SIGMA, weights=[1.0, 2.0, 0.3])],
    "MAC": [MACErrors(sd=0.05)],
    "MAC, inferred": [MACErrors(sd=SIGMA)],
    "all": [
        FrequencyErrors("relative", sd=SIGMA, model_sd=DELTA),
        ShapeErrors(sd=DELTA),
        MACErrors(sd=Parameter("tau", start=0.3, lower=0.01, upper=1.0)),
    ],
}


@pytest.fixture(params=MODELS)
def likelihood(request, structure, data):
    return ModalLikelihood(structure, data, MODELS[request.param])


def theta_of(likelihood, n=3):
    rng = np.random.default_rng(3)
    noise = np.array([p.start for p in likelihood.noise])
    return np.hstack([START * rng.uniform(0.8, 1.2, (n, 4)), noise * rng.uniform(0.8, 1.2, (n, len(noise)))])


def test_gradient_against_differences(likelihood):
    theta = theta_of(likelihood)
    terms, gradient = likelihood.terms_and_gradient(theta)
    assert_allclose(terms, likelihood.terms(theta), rtol=1e-10, atol=1e-10)
    step = 1e-3 * np.abs(theta)
    assert_gradient(gradient, likelihood.terms, theta, step, order=4, rtol=1e-6, of_largest=1e-8)


def test_residuals_are_the_quadratic_part(likelihood):
    """−½ Σ r² moves with the model as the terms do, but for what normalisers depend on the model."""
    theta = theta_of(likelihood)
    values, slopes = likelihood.residuals_and_slopes(theta)
    for k in range(4):
        h = 1e-4 * theta[:, k : k + 1] * np.eye(theta.shape[1])[k]
        ahead, behind = (likelihood.residuals_and_slopes(theta + step * h)[0] for step in (1, -1))
        difference = (ahead - behind) / (2 * h[:, k : k + 1])
        if not likelihood.needs_shapes:  # computed shapes may turn round between the two
            assert_allclose(slopes[..., k], difference, rtol=1e-6, atol=1e-6 * np.abs(slopes).max())
        energy = (np.sum(ahead**2, axis=1) - np.sum(behind**2, axis=1)) / (2 * h[:, k])
        assert_allclose(
            2 * np.sum(values * slopes[..., k], axis=1), energy, rtol=1e-5, atol=1e-5 * np.abs(energy).max()
        )


def test_rows_do_not_depend_on_their_batch(likelihood):
    theta = theta_of(likelihood, 5)
    terms, gradient = likelihood.terms_and_gradient(theta)
    for i in range(5):
        one, slope = likelihood.terms_and_gradient(theta[i : i + 1])
        assert_array_equal(one[0], terms[i])
        assert_array_equal(slope[0], gradient[i])


def at(frequencies, shapes=None):
    """What a model would observe."""
    shapes = SHAPES if shapes is None else shapes
    return ModalPrediction(np.atleast_2d(frequencies), np.asarray(shapes)[None])


def bound(model, data):
    return model.bind(data, lambda parameter: 0)


def test_frequency_errors_are_densities_of_the_measured_frequency(data):
    f = MEASURED * [1.01, 0.98, 1.03]
    absolute = bound(FrequencyErrors("absolute", sd=[0.01, 0.02, 0.03]), data)
    expected = stats.norm.logpdf(MEASURED, f, [0.01, 0.02, 0.03])
    assert_allclose(absolute.evaluate(at(f), np.empty((1, 0)), False).terms[0], expected)
    relative = bound(FrequencyErrors("relative", sd=0.02, weights=[4.0, 1.0, 1.0]), data)
    expected = stats.norm.logpdf(MEASURED, f, 0.02 * MEASURED / [2.0, 1.0, 1.0])
    assert_allclose(relative.evaluate(at(f), np.empty((1, 0)), False).terms[0], expected)
    eigenvalue = bound(FrequencyErrors("eigenvalue", sd=SIGMA), data)
    expected = stats.norm.logpdf((f / MEASURED) ** 2 - 1, 0.0, 0.07)
    assert_allclose(eigenvalue.evaluate(at(f), np.array([[0.07]]), False).terms[0], expected)


def test_the_uncertainty_of_the_data_is_taken_where_none_is_given():
    data = ModalData(MEASURED, sd_hz=[0.001, 0.002, 0.003])
    f = MEASURED * [1.01, 0.98, 1.03]
    for kind in ("absolute", "relative"):
        terms = bound(FrequencyErrors(kind), data).evaluate(at(f), np.empty((1, 0)), False).terms[0]
        assert_allclose(terms, stats.norm.logpdf(MEASURED, f, [0.001, 0.002, 0.003]))
    terms = bound(FrequencyErrors("eigenvalue"), data).evaluate(at(f), np.empty((1, 0)), False).terms[0]
    sd = 2 * np.array([0.001, 0.002, 0.003]) / MEASURED
    assert_allclose(terms, stats.norm.logpdf((f / MEASURED) ** 2 - 1, 0.0, sd))


@pytest.mark.parametrize("sd", [0.05, [[0.04], [0.1]]], ids=["one for all", "a sensor each"])
def test_shape_errors_are_a_density_of_the_direction(sd):
    """At two sensors a direction is an angle: over half a turn the density integrates to one, as σ gets small."""

    def density(angle, scale):
        data = ModalData([1.0], sensors=((0, "x"), (1, "x")), shapes=[[np.cos(angle)], [np.sin(angle)]])
        term = bound(ShapeErrors(sd=np.multiply(sd, scale)), data)
        seen = at([1.0], [[-3.0 * np.cos(0.7)], [-3.0 * np.sin(0.7)]])
        return float(np.exp(term.evaluate(seen, np.empty((1, 0)), False).terms[0, 0]))

    areas = [quad(density, 0.7 - np.pi / 2, 0.7 + np.pi / 2, args=(s,), points=[0.7])[0] for s in (1.0, 0.1)]
    assert areas[0] == pytest.approx(1.0, abs=0.02)
    assert areas[1] == pytest.approx(1.0, abs=2e-4)


def test_directions_with_noise_have_that_density():
    """Shapes with Gaussian noise at the sensors: the mean log-density is the entropy of the noise in the plane."""
    rng, sd, q = np.random.default_rng(1), np.array([0.004, 0.008, 0.006, 0.01]), 4
    phi = np.array([1.0, 0.5, -0.7, 0.2])
    phi /= np.linalg.norm(phi)
    found = []
    for _ in range(2000):
        data = ModalData(
            [1.0], sensors=tuple((k, "x") for k in range(q)), shapes=(phi + sd * rng.normal(size=q))[:, None]
        )
        term = bound(ShapeErrors(sd=sd[:, None]), data)
        found.append(term.evaluate(at([1.0], 5.0 * phi[:, None]), np.empty((1, 0)), False).terms[0, 0])
    tangent = np.linalg.svd(phi[None])[2][1:]
    covariance = tangent @ np.diag(sd**2) @ tangent.T
    expected = -stats.multivariate_normal(np.zeros(q - 1), covariance).entropy()
    assert np.mean(found) == pytest.approx(expected, abs=5 * np.std(found) / np.sqrt(len(found)))


def test_with_one_sigma_the_error_of_a_shape_is_its_mac(data):
    shapes = SHAPES + 0.2 * np.random.default_rng(2).normal(size=(3, 3))
    term = bound(ShapeErrors(sd=0.1), data).evaluate(at(MEASURED, shapes), np.empty((1, 0)), False).terms[0]
    mac = np.sum(SHAPES * shapes, axis=0) ** 2 / np.sum(SHAPES**2, axis=0) / np.sum(shapes**2, axis=0)
    assert_allclose(term, -0.5 * (1 - mac) / 0.01 - 2 * np.log(0.1) - np.log(2 * np.pi))
    turned = bound(ShapeErrors(sd=0.1), data).evaluate(at(MEASURED, -4.0 * shapes), np.empty((1, 0)), False)
    assert_allclose(turned.terms[0], term)


@pytest.mark.parametrize("sd", [0.05, 0.8])
def test_mac_errors_are_a_density_of_what_is_missing_of_one(sd):
    def density(error):
        angle = np.arccos(np.sqrt(1.0 - error))
        data = ModalData([1.0], sensors=((0, "x"), (1, "x")), shapes=[[np.cos(angle)], [np.sin(angle)]])
        return float(
            np.exp(
                bound(MACErrors(sd), data).evaluate(at([1.0], [[2.0], [0.0]]), np.empty((1, 0)), False).terms[0, 0]
            )
        )

    assert quad(density, 0.0, 1.0, points=[sd])[0] == pytest.approx(1.0, rel=1e-6)


def test_a_deviation_that_two_models_name_is_one_parameter(structure, data):
    errors = [FrequencyErrors(sd=SIGMA), ShapeErrors(sd=SIGMA, model_sd=DELTA)]
    assert ModalLikelihood(structure, data, errors).noise == (SIGMA, DELTA)


@pytest.mark.parametrize(
    ("errors", "message"),
    [
        ([], r"error: at least one error model is needed \(got none\)"),
        ([FrequencyErrors()], r"frequency errors: needs sd, a number or a Parameter, as the data have none"),
        (
            [FrequencyErrors(sd=[0.1, 0.2])],
            r"frequency errors: sd must be a number or of shape \(3,\) \(got \(2,\)\)",
        ),
        ([FrequencyErrors(sd=0.1, weights=[1.0, 2.0])], r"weights: must be 3 positive numbers"),
        (
            [FrequencyErrors(sd=Parameter("s", 0.1, -1.0, 1.0))],
            r"frequency errors: s must have a lower bound of at least 0",
        ),
        (
            [FrequencyErrors(sd=SIGMA), ShapeErrors(sd=Parameter("sigma", 0.2, 0.0, 1.0))],
            r"error: different parameters must not share a name \(got 'sigma'\)",
        ),
    ],
)
def test_what_is_refused(structure, data, errors, message):
    with pytest.raises(ValueError, match=message):
        ModalLikelihood(structure, data, errors)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "cubic"}, r"kind: must be one of 'absolute', .* \(got 'cubic'\)"),
        ({"sd": -0.1}, r"sd: must be positive finite numbers, .* \(got -0.1\)"),
        (
            {"sd": 0.1, "weights": [1.0, 0.0, 1.0]},
            r"weights: must be positive finite numbers, .* \(got \[1.0, 0.0",
        ),
    ],
)
def test_settings_that_no_data_fit(settings, message):
    with pytest.raises(ValueError, match=message):
        FrequencyErrors(**settings)


@pytest.mark.parametrize("errors", [ShapeErrors(sd=0.1), MACErrors(sd=0.1)])
def test_shapes_are_needed_for_errors_of_shapes(structure, errors):
    with pytest.raises(ValueError, match=r"errors: need measured shapes at the sensors \(got none\)"):
        ModalLikelihood(structure, ModalData(MEASURED), [errors])
    lonely = ModalData([1.0], sensors=((0, "x"),), shapes=[[1.0]])
    with pytest.raises(ValueError, match=r"errors: need shapes at two sensors or more \(got 1\)"):
        bound(errors, lonely)


def test_one_deviation_as_that_of_the_measurement_and_of_the_model_counts_twice(structure, data):
    once, twice = (
        ModalLikelihood(structure, data, [FrequencyErrors(sd=SIGMA, model_sd=model_sd)])
        for model_sd in (None, SIGMA)
    )
    theta = theta_of(twice)
    assert_allclose(twice.terms(theta), once.terms(theta * [1.0, 1.0, 1.0, 1.0, np.sqrt(2.0)]), rtol=1e-12)
