"""The likelihood of eq. (4): a density of the data, with a β for all modes or one for each."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import dblquad, quad

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.frequency import FrequencyTerm

COMPUTED = np.array([[30.0, 200.0]])


@pytest.mark.parametrize("beta", [1.0, 0.03, 7.0])
def test_each_term_integrates_to_one_over_the_measurement(beta):
    def density(measured):
        return np.exp(FrequencyTerm.of_beta(np.array([measured]), beta).log_prob_terms(COMPUTED[:, :1])[0, 0])

    integral, _ = quad(density, 30.0 - 40.0, 30.0 + 40.0, points=[30.0], epsabs=1e-12)
    assert integral == pytest.approx(1.0, abs=1e-10)


def test_two_modes_integrate_to_one_together():
    def density(y, x):
        return np.exp(FrequencyTerm.of_beta(np.array([x, y]), [1.0, 0.2]).log_prob_terms(COMPUTED).sum())

    integral, _ = dblquad(density, 24.0, 36.0, 188.0, 212.0, epsabs=1e-8)
    assert integral == pytest.approx(1.0, abs=1e-6)


def test_terms_of_eq_4():
    error = FrequencyTerm.of_beta(np.array([31.9, 197.9]), [2.0, 0.5])
    expected = [np.log(2.0 / np.pi) / 2 - 2.0 * 1.9**2, np.log(0.5 / np.pi) / 2 - 0.5 * 2.1**2]
    assert_allclose(error.log_prob_terms(COMPUTED)[0], expected, rtol=1e-12)
    assert_allclose(error.sd, [0.5, 1.0])


def test_scalar_beta_stands_for_every_mode():
    measured = np.array([31.9, 197.9])
    scalar, vector = FrequencyTerm.of_beta(measured, 0.7), FrequencyTerm.of_beta(measured, [0.7, 0.7])
    assert_array_equal(scalar.beta, vector.beta)
    assert_array_equal(scalar.log_prob_terms(COMPUTED), vector.log_prob_terms(COMPUTED))
    assert_array_equal(FrequencyTerm.of_beta(measured).beta, [1.0, 1.0])


def test_normaliser_is_eq_5():
    """(π/β)^(N/2) at no error, for a scalar β and one position of measurement."""
    measured = np.array([31.9, 197.9, 553.0])
    value = FrequencyTerm.of_beta(measured, 0.7).log_prob_terms(measured[None]).sum()
    assert value == pytest.approx(-1.5 * np.log(np.pi / 0.7), rel=1e-14)


def test_gradient_against_differences():
    error = FrequencyTerm.of_beta(np.array([31.9, 197.9]), [2.0, 0.5])
    h = 1e-3
    difference = (error.log_prob_terms(COMPUTED + h) - error.log_prob_terms(COMPUTED - h)) / (2 * h)
    seen = ModalPrediction(COMPUTED, np.empty((1, 0, 2)))
    found = error.evaluate(seen, np.empty((1, 0)), gradient=True)
    assert_array_equal(found.terms, error.log_prob_terms(COMPUTED))
    assert_allclose(found.by_frequency, difference, rtol=1e-9)


def test_simulated_noise_has_the_standard_deviation_of_beta():
    error = FrequencyTerm.of_beta(np.array([31.9, 197.9]), [2.0, 0.5])
    noise = (
        error.simulate(np.random.default_rng(4), np.tile(COMPUTED, (20000, 1)), np.empty((20000, 0))) - COMPUTED
    )
    # standard errors: 0.7 % of an sd for the mean, 0.5 % for the sd; five of them
    assert_allclose(noise.mean(axis=0) / error.sd, 0.0, atol=5 * 0.0071)
    assert_allclose(noise.std(axis=0) / error.sd, 1.0, atol=5 * 0.005)
    assert abs(np.corrcoef(noise.T)[0, 1]) < 5 * 0.0071


def test_beta_given_later_cannot_change_the_likelihood():
    beta = np.array([1.0, 2.0])
    error = FrequencyTerm.of_beta(np.array([31.9, 197.9]), beta)
    beta[0] = 100.0
    assert_array_equal(error.beta, [1.0, 2.0])


@pytest.mark.parametrize("frequency", [1e200, np.inf])
def test_absurd_frequencies_have_no_probability_and_no_warning(frequency):
    assert FrequencyTerm.of_beta(np.array([1.0])).log_prob_terms(np.array([[frequency]]))[0, 0] == -np.inf


def test_terms_sum_to_the_same_bits_in_any_memory_order():
    rng = np.random.default_rng(0)
    error = FrequencyTerm.of_beta(rng.uniform(10, 20, size=20), 0.01)
    frequencies = rng.uniform(10, 20, size=(64, 20))
    total = error.log_prob_terms(np.asfortranarray(frequencies)).sum(axis=1)
    assert_array_equal(total, [error.log_prob_terms(row[None]).sum(axis=1)[0] for row in frequencies])


def test_description():
    # to the last bit: configurations of earlier versions are compared
    spread = {"fixed": [0.7071067811865476, 0.7071067811865476], "inferred": {}}
    term = FrequencyTerm.of_beta(np.array([1.0, 2.0]), 1.0)
    assert term.as_dict() == {"error": "absolute frequency", "spread": spread}


@pytest.mark.parametrize(
    ("beta", "message"),
    [
        ([1.0], r"beta: must be a number or 2 numbers \(got shape \(1,\)\)"),
        ([[1.0, 1.0]], r"beta: must be a number or 2 numbers \(got shape \(1, 2\)\)"),
        (0.0, r"beta: must be positive and finite \(got 0\.0\)"),
        ([1.0, -1.0], r"beta: must be positive and finite \(got \[1\.0, -1\.0\]\)"),
        ([1.0, np.nan], r"beta: must be positive and finite \(got \[1\.0, nan\]\)"),
        (np.inf, r"beta: must be positive and finite \(got inf\)"),
    ],
)
def test_wrong_beta(beta, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        FrequencyTerm.of_beta(np.array([31.9, 197.9]), beta)
