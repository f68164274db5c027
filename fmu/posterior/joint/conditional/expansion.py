"""Expand each test's log-likelihood to second order in the structural parameters of that test."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from fmu.posterior.discrepancy.given_errors import ExpandedErrors, LikelihoodGivenErrors
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.errors.noise import Spread
from fmu.posterior.frf.likelihood import FRFLikelihood
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.base import sum_by_test
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray, IntArray

OfTests = ModalLikelihood | FRFLikelihood
"""The kinds of likelihood that a problem with several tests can have."""


def likelihood_of_tests(problem: UpdatingProblem) -> OfTests:
    """Return a problem's likelihood, typed as `OfTests`. The problem must have several tests."""
    likelihood = problem.likelihood
    assert isinstance(likelihood, OfTests)  # for the type checker
    return likelihood


class Expansion(NamedTuple):
    """Each test's log-likelihood, expanded to second order in the P structural parameters of that test.

    Attributes
    ----------
    values : ndarray, shape (n_tests, P)
        Structural parameters in each test at the expansion point.
    slope : ndarray, shape (1, n_tests, P)
        Gradient of each test's log-likelihood.
    information : ndarray, shape (1, n_tests, P, P)
        Gauss–Newton approximation of the negative second derivatives.
    noise : ndarray, shape (1, n_noise)
        Inferred error parameters at the expansion point.
    spreads : tuple of Spread
        For each error model, the error variances of the measured modes.
    test_of_modes : ndarray of int, shape (n_modes,)
        Index of the test that measured each mode.
    errors : ExpandedErrors, optional
        The residuals as a function of the model errors, if these are parameters. `slope` and `information` then
        leave out the data with model errors; `given_errors` adds them.
    """

    values: FloatArray
    slope: FloatArray
    information: FloatArray
    noise: FloatArray
    spreads: tuple[Spread, ...]
    test_of_modes: IntArray
    errors: ExpandedErrors | None = None

    def given_errors(self, noise: FloatArray) -> Self:
        """Return the expansion given the model errors in `noise` (n, n_noise), or `self` if `errors` is None.

        The first axis of slope and information has the length n if `errors` is given, otherwise 1.
        """
        if self.errors is None:
            return self
        slope, information = self.errors.quadratic(noise)
        return self._replace(slope=self.slope + slope, information=self.information + information)

    def weigh(self, noise: FloatArray) -> FloatArray:
        """Return factors, (n, n_tests, 1), that adapt slope and information to the error parameters `noise`.

        A test's factor is the ratio of the error variance at the expansion point to the variance for `noise`, (n,
        n_noise), averaged over the test's errors in modes. It is exact if all errors in the test have the same
        standard deviation. It is 1 for a test without modes and, with shape (1, 1, 1), if no error parameter is
        inferred.
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
    """Expand the log-likelihoods of all tests to second order about theta, shape (ndim,)."""
    slopes = likelihood.terms_and_gradient(layout.of_model(theta[None]))[1][..., : len(layout.structural)]
    slope = sum_by_test(slopes, likelihood.test_of_terms, len(layout.tests))
    values = layout.values(theta[None, : len(layout.parameters)])[0]
    information, noise = (
        information_by_test(layout, likelihood, theta)[None],
        theta[None, len(layout.parameters) :].copy(),
    )
    spreads, errors = tuple(term.spread for term in likelihood.terms_of), None
    if isinstance(likelihood, LikelihoodGivenErrors):
        errors = likelihood.expand(layout.of_model(theta[None]))
        slope = slope - errors.quadratic(noise)[0]
        information = information - errors.quadratic(np.zeros_like(noise))[1]
    return Expansion(values, slope, information, noise, spreads, likelihood.model.test_of_modes, errors)


def information_by_test(layout: Layout, likelihood: OfTests, theta: FloatArray) -> FloatArray:
    """Return each test's information on the P structural parameters, shape (n_tests, P, P), at theta (ndim,)."""
    J = likelihood.residuals_and_slopes(layout.of_model(theta[None]))[1]
    products = J[..., :, None] * J[..., None, :]
    return sum_by_test(products, likelihood.test_of_residuals, len(layout.tests))[0]
