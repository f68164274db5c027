"""The log-likelihood of each test to second order in the parameters of the structure in the test."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.joint.layout import Layout
from fmu.types import FloatArray, IntArray


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
    """

    values: FloatArray
    slope: FloatArray
    information: FloatArray


def expand(layout: Layout, likelihood: ModalLikelihood, theta: FloatArray) -> Expansion:
    """Return the log-likelihoods of the tests to second order about one theta, (ndim,)."""
    at = layout.of_model(theta[None])
    slopes = likelihood.terms_and_gradient(at)[1]
    _, J = likelihood.residuals_and_slopes(at)
    P, n_tests = len(layout.structural), len(layout.tests)
    slope = sum_by_test(slopes[..., :P], likelihood.test_of_terms, n_tests)
    products = J[..., :, None] * J[..., None, :]
    information = sum_by_test(products, _tests_of_residuals(likelihood), n_tests)
    return Expansion(layout.values(theta[None, : len(layout.parameters)])[0], slope[0], information[0])


def sum_by_test(terms: FloatArray, test: IntArray, n_tests: int) -> FloatArray:
    """Return the sums over the terms (n, m, …) of each test, shape (n, n_tests, …); `test` has shape (m,)."""
    found = np.zeros((len(terms), n_tests, *terms.shape[2:]))
    order = np.argsort(test, kind="stable")
    first = np.flatnonzero(np.diff(test[order], prepend=-1))
    found[:, test[order][first]] = np.add.reduceat(terms[:, order], first, axis=1)
    return found


def _tests_of_residuals(likelihood: ModalLikelihood) -> IntArray:
    """Return the index of the test of each residual of ``residuals_and_slopes``, shape (n_residuals,)."""
    modes = likelihood.of_used(likelihood.model.test_of_modes)
    names = tuple(map(str, range(len(modes))))
    repeats = [len(term.labels(names)) // len(names) for term in likelihood.terms_of]
    found = [np.repeat(modes, n) for n in repeats]
    return np.concatenate([*found, *(np.full(len(term.labels), term.test) for term in likelihood.quantities)])
