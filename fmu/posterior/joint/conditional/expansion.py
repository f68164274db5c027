"""The log-likelihood of each test to second order in the parameters of the structure in the test."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.errors.noise import Spread
from fmu.posterior.frf.likelihood import FRFLikelihood
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.base import sum_by_test
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray, IntArray

OfTests = ModalLikelihood | FRFLikelihood
"""The likelihoods of several tests."""


def likelihood_of_tests(problem: UpdatingProblem) -> OfTests:
    """Return the likelihood of a problem of several tests, which has no soft pairing and no modal residual."""
    likelihood = problem.likelihood
    assert isinstance(likelihood, OfTests)  # for the type checker
    return likelihood


class Expansion(NamedTuple):
    """The log-likelihood of each test, expanded to second order in the parameters of the structure in the test.

    Attributes
    ----------
    values : ndarray, shape (n_tests, P)
        The parameters of the structure in each test about which the log-likelihood is expanded.
    slope : ndarray, shape (n_tests, P)
        The gradient of the log-likelihood of each test.
    information : ndarray, shape (n_tests, P, P)
        The Gauss–Newton approximation of minus its second derivatives.
    noise : ndarray, shape (1, n_noise)
        The inferred standard deviations of errors at which the log-likelihood is expanded.
    spreads : tuple of Spread
        The variances of the errors of the measured modes.
    test_of_modes : ndarray of int, shape (n_modes,)
    """

    values: FloatArray
    slope: FloatArray
    information: FloatArray
    noise: FloatArray
    spreads: tuple[Spread, ...]
    test_of_modes: IntArray

    def weigh(self, noise: FloatArray) -> FloatArray:
        """Return factors of slope and information, (n, n_tests, 1), for other standard deviations (n, n_noise).

        A factor is the mean, over the errors of a test, of the variance in the expansion divided by the present
        variance. It is exact if all errors of the test have one standard deviation.
        """
        if not noise.shape[1]:
            return np.ones((1, 1, 1))
        n_tests, ratios = len(self.values), np.zeros((len(noise), len(self.test_of_modes)))
        for spread in self.spreads:
            ratio = spread.variance(self.noise) / spread.variance(noise)
            ratios += ratio.reshape(len(noise), -1, ratio.shape[-1]).mean(axis=1) / len(self.spreads)
        counts = np.bincount(self.test_of_modes, minlength=n_tests)
        total = sum_by_test(ratios, self.test_of_modes, n_tests)
        return np.where(counts > 0, total / np.maximum(counts, 1), 1.0)[..., None]


def expand(layout: Layout, likelihood: OfTests, theta: FloatArray) -> Expansion:
    """Return the log-likelihoods of the tests to second order about one theta, (ndim,)."""
    slopes = likelihood.terms_and_gradient(layout.of_model(theta[None]))[1][..., : len(layout.structural)]
    slope = sum_by_test(slopes, likelihood.test_of_terms, len(layout.tests))[0]
    values = layout.values(theta[None, : len(layout.parameters)])[0]
    information, noise = (
        information_by_test(layout, likelihood, theta),
        theta[None, len(layout.parameters) :].copy(),
    )
    spreads = tuple(term.spread for term in likelihood.terms_of)
    return Expansion(values, slope, information, noise, spreads, likelihood.model.test_of_modes)


def information_by_test(layout: Layout, likelihood: OfTests, theta: FloatArray) -> FloatArray:
    """Return the information of each test on its structural parameters, (n_tests, P, P), at theta (ndim,)."""
    J = likelihood.residuals_and_slopes(layout.of_model(theta[None]))[1]
    products = J[..., :, None] * J[..., None, :]
    return sum_by_test(products, likelihood.test_of_residuals, len(layout.tests))[0]
