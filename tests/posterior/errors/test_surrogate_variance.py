"""The variance of a surrogate in the likelihood: densities, derivatives, and what a design is weighted by."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

import fmu
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.base import ErrorTerm, Evaluated, Residuals
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.errors.slopes import gradient_of_terms
from fmu.posterior.errors.surrogate_variance import evaluated_with_variance, sensitivity_to_model
from tests.gradients import assert_gradient

MEASURED = np.array([3.0, 5.0])


class Uncertain(ModalModel):
    """Two frequencies, and shapes at three sensors, with variances that depend on theta."""

    n_parameters, n_modes, gives_shapes, is_uncertain = 2, 2, True, True

    def observed(self, theta, gradient=False):
        a, b = theta.T
        n = len(theta)
        f = np.stack([2.0 + a, 4.0 + a * b], axis=1)
        v = np.stack([0.01 + 0.02 * a**2, 0.05 * np.exp(b)], axis=1)
        s = np.stack([np.stack([a, b]), np.stack([b, 1 + a]), np.stack([1 + 0 * a, a * b])]).transpose(2, 0, 1)
        sv = np.broadcast_to(0.001 * (1.0 + a[:, None, None] ** 2), (n, 3, 2))
        if not gradient:
            return ModalPrediction(f, s, frequency_variance=v, shape_variance=sv)
        o, z = np.ones(n), np.zeros(n)
        df = np.array([[o, z], [b, a]]).transpose(2, 0, 1)
        dv = np.array([[0.04 * a, z], [z, 0.05 * np.exp(b)]]).transpose(2, 0, 1)
        ds = np.array([[[o, z], [z, o]], [[z, o], [o, z]], [[z, z], [b, a]]]).transpose(3, 0, 1, 2)
        dsv = np.zeros((n, 3, 2, 2))
        dsv[..., 0] = (0.002 * a)[:, None, None]
        return ModalPrediction(f, s, df, ds, v, sv, dv, dsv)


THETA = np.array([[0.9, 0.4], [1.3, 0.7], [0.2, 1.1]])
SHAPES = np.array([[1.0, 0.3], [0.5, 1.0], [0.8, 0.6]])


def likelihood(*errors, **data):
    return ModalLikelihood(Uncertain(), fmu.ModalData(MEASURED.tolist(), **data), list(errors))


@pytest.mark.parametrize("kind", ["absolute", "relative"])
def test_errors_of_frequencies_have_the_sum_of_both_variances(kind):
    unit = MEASURED if kind == "relative" else np.ones(2)
    found = likelihood(fmu.FrequencyErrors(kind, sd=0.1)).terms(THETA)
    seen = Uncertain().observed(THETA)
    expected = norm.logpdf(MEASURED, seen.frequencies, np.sqrt((0.1 * unit) ** 2 + seen.frequency_variance))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("kind", ["absolute", "relative"])
def test_the_gradient_knows_how_the_variance_changes(kind):
    of = likelihood(fmu.FrequencyErrors(kind, sd=0.1))
    terms, slopes = of.terms_and_gradient(THETA)
    np.testing.assert_array_equal(terms, of.terms(THETA))
    assert_gradient(slopes, of.terms, THETA, 1e-5, rtol=1e-6, atol=1e-6)


def test_inferred_deviations_have_their_derivatives():
    sd = fmu.Parameter("sd", start=0.1, lower=0.0, upper=1.0)
    of = likelihood(fmu.FrequencyErrors("absolute", sd=sd))
    theta = np.column_stack([THETA, [0.1, 0.2, 0.05]])
    assert_gradient(of.terms_and_gradient(theta)[1], of.terms, theta, 1e-5, rtol=1e-5, atol=1e-5)


def test_gauss_newton_takes_both_variances():
    of = likelihood(fmu.FrequencyErrors("absolute", sd=0.1))
    value, gradient, information = of.quadratic(THETA)
    seen = Uncertain().observed(THETA, gradient=True)
    weight = 1.0 / (0.01 + seen.frequency_variance)
    expected = np.einsum("nm,nmk,nml->nkl", weight, seen.frequency_slopes, seen.frequency_slopes)
    np.testing.assert_allclose(information, expected, rtol=1e-12)
    np.testing.assert_allclose(value, of.terms(THETA).sum(axis=1))
    np.testing.assert_allclose(gradient, of.terms_and_gradient(THETA)[1].sum(axis=1))


def test_a_covariance_is_right_to_first_order():
    covariance = np.array([[0.02, 0.01], [0.01, 0.03]])
    data = fmu.ModalData(MEASURED.tolist(), covariance_hz2=covariance)

    class Sure(Uncertain):
        def observed(self, theta, gradient=False):
            seen = super().observed(theta, gradient)
            return ModalPrediction(
                seen.frequencies, seen.shapes, frequency_variance=np.full((len(theta), 2), 1e-9),
                shape_variance=seen.shape_variance,
            )  # fmt: skip

    found = ModalLikelihood(Sure(), data, [fmu.FrequencyErrors("absolute")]).terms(THETA).sum(axis=1)
    f = Sure().observed(THETA).frequencies
    expected = [multivariate_normal.logpdf(MEASURED, one, covariance + 1e-9 * np.eye(2)) for one in f]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("error", [fmu.ShapeErrors(sd=0.2), fmu.MACErrors(sd=0.2)])
def test_errors_of_shapes_are_marginal_to_first_order(error):
    of = likelihood(error, shapes=SHAPES, sensors=[(i, "x") for i in range(3)])
    seen = of.observed(THETA)
    small = 1e-7
    rng = np.random.default_rng(1)
    scatter = rng.standard_normal((40_000, 3, 2))
    term = of.terms_of[0]
    plain = term.evaluate(seen, np.empty((3, 0)), False).terms

    class Nearly(Uncertain):
        def observed(self, theta, gradient=False):
            one = super().observed(theta, gradient)
            return ModalPrediction(
                one.frequencies, one.shapes, frequency_variance=np.zeros_like(one.frequencies),
                shape_variance=np.full_like(one.shapes, small),
            )  # fmt: skip

    found = of.with_model(Nearly()).terms(THETA) - plain
    g = np.stack(
        [
            term.evaluate(
                ModalPrediction(np.ones((len(scatter), 2)), seen.shapes[i] + np.sqrt(1e-4) * scatter),
                np.empty((len(scatter), 0)),
                False,
            ).terms
            - plain[i]
            for i in range(3)
        ]
    )
    # a thousand times the variance: the mean of exp(t − t₀) by simulation, and the formula, per unit of variance
    expected = np.mean(np.expm1(g), axis=1) / 1e-4
    error_of_mean = np.std(g, axis=1) / np.sqrt(len(scatter)) / 1e-4
    assert np.all(np.abs(found / small - expected) < 6.0 * error_of_mean + 0.25 * np.abs(expected) + 2.0)


def test_the_gradient_of_shape_errors_is_nearly_that_of_the_value():
    of = likelihood(fmu.ShapeErrors(sd=0.2), shapes=SHAPES, sensors=[(i, "x") for i in range(3)])
    found = of.terms_and_gradient(THETA)[1]
    assert_gradient(found, of.terms, THETA, 1e-5, atol=0.05 * np.max(np.abs(found)))


def test_a_design_is_weighted_by_the_variance_of_the_log_density():
    of = likelihood(fmu.FrequencyErrors("absolute", sd=0.1))
    seen = Uncertain().observed(THETA)
    of_frequency, of_shape = of.sensitivity_to_model(THETA)
    rng = np.random.default_rng(2)
    scale = 1e-4
    f = seen.frequencies[:, None] + scale * rng.standard_normal((3, 20_000, 2))
    sampled = np.var(norm.logpdf(MEASURED, f, 0.1), axis=1) / scale**2
    small = of_frequency - 0.5 * 0.1**-4 * seen.frequency_variance
    np.testing.assert_allclose(small, sampled, rtol=0.06, atol=2.0)
    assert not of_shape.any()


class OneResidual(ErrorTerm):
    """r = (c·φ − 1)/0.1 of each mode, linear in the shape's components, with the log-density −½ r²."""

    c = np.array([1.0, -0.5, 2.0])

    def evaluate(self, seen, noise, gradient):
        r = self.residuals(seen, noise).values[..., 0]
        return Evaluated(-0.5 * r**2, None, -r[:, None] * self.c[:, None] / 0.1 if gradient else None)

    def residuals(self, seen, noise):
        r = (np.einsum("s,nsm->nm", self.c, seen.shapes) - 1.0) / 0.1
        return Residuals(r[..., None], None, np.broadcast_to(self.c / 0.1, (*r.shape, 1, 3)))


def test_one_residual_of_many_components_has_the_sum_of_their_variances():
    """Exact where the residual is linear: values, derivatives, and the variance of the log-density."""
    term, none = OneResidual(), np.empty((3, 0))

    def terms(theta):
        seen = Uncertain().observed(theta)
        return evaluated_with_variance(term, seen, np.empty((len(theta), 0)), False).terms

    seen = Uncertain().observed(THETA, gradient=True)
    r = term.residuals(seen, none).values[..., 0]
    S = np.einsum("s,nsm->nm", (term.c / 0.1) ** 2, seen.shape_variance)
    found = evaluated_with_variance(term, seen, none, True)
    np.testing.assert_allclose(found.terms, -0.5 * r**2 / (1.0 + S) - 0.5 * np.log1p(S), rtol=1e-12)
    np.testing.assert_array_equal(found.terms, terms(THETA))
    assert_gradient(gradient_of_terms(found, seen, 2, 0), terms, THETA, 1e-5, rtol=1e-6, atol=1e-6)
    of_shape = sensitivity_to_model(term, seen, none)[1]
    variance = np.sum(of_shape * seen.shape_variance, axis=1)
    np.testing.assert_allclose(variance, r**2 * S + 0.5 * S**2, rtol=1e-12)


def test_the_gradient_of_mac_errors_is_nearly_that_of_the_value():
    of = likelihood(fmu.MACErrors(sd=0.2), shapes=SHAPES, sensors=[(i, "x") for i in range(3)])
    found = of.terms_and_gradient(THETA)[1]
    assert_gradient(found, of.terms, THETA, 1e-5, atol=0.05 * np.max(np.abs(found)))


@pytest.mark.parametrize("together", [(), [("1", "2")]], ids=["alone", "together"])
def test_mac_errors_have_the_density_averaged_over_the_shapes(together):
    """By simulation, where the surrogate's errors are small enough for 1 − MAC to be linear in them."""
    rng = np.random.default_rng(5)
    unit = np.linalg.qr(rng.standard_normal((10, 3)))[0]
    data = fmu.ModalData(MEASURED.tolist(), sensors=[(i, "x") for i in range(10)], shapes=unit[:, :2])
    term = fmu.MACErrors(sd=0.01, together=together).bind(data, lambda p: 0)
    close = np.array([[1.0, 1.0], [0.0, 0.3]])  # the two shapes at the sensors are 17 degrees apart
    S = (unit[:, :2] @ (close if together else np.eye(2)) + unit[:, 2:] * [0.32, 0.42])[None]
    v = 0.001**2 * np.array([1.0, 4.0]) * np.ones((1, 10, 1))
    seen = ModalPrediction(np.ones((1, 2)), S, frequency_variance=np.zeros((1, 2)), shape_variance=v)
    none = np.empty((1, 0))
    found = evaluated_with_variance(term, term.project(seen), none, False).terms[0]
    moved = ModalPrediction(np.ones((40_000, 2)), S + np.sqrt(v) * rng.standard_normal((40_000, 10, 2)))
    t = term.evaluate(term.project(moved), np.empty((40_000, 0)), False).terms
    plain = term.evaluate(term.project(seen), none, False).terms[0]
    expected = np.log(np.mean(np.exp(t - plain), axis=0)) + plain
    assert np.all(np.abs(found - expected) < 0.1 * np.abs(expected - plain))
    of_shape = sensitivity_to_model(term, seen, none)[1]
    np.testing.assert_allclose(np.sum(of_shape * v), np.sum(np.var(t, axis=0)), rtol=0.1)
