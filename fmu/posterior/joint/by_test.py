"""The posterior of several tests taken apart: given the main parameters, the scores of each test are independent.

The main parameters are all parameters of theta but the scores. Given them, the posterior density of the scores is
a product with one factor per test,

    p(z_t | main, data) ∝ L_t(θ_t(main, z_t)) p(z_t | main),

in which L_t is the likelihood of the data of test t and θ_t are the parameters of the structure in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.population import Drawn
from fmu.types import BoolArray, FloatArray, IntArray


class Scores(NamedTuple):
    """The scores of a layout by test and population; p is the number of populations.

    Attributes
    ----------
    parameters : ndarray of int, shape (p,)
        The index of each population's parameter among the structural parameters.
    columns : ndarray of int, shape (n_tests, p)
        The index of each score in theta; meaningless where there is no score.
    scored : ndarray of bool, shape (n_tests, p)
        Whether the test has the score.
    """

    parameters: IntArray
    columns: IntArray
    scored: BoolArray

    @classmethod
    def of(cls, layout: Layout) -> Scores:
        """Return the scores of a layout with populations."""
        numbers = [j for j, one in enumerate(layout.values_of) if isinstance(one.base, Drawn)]
        columns = np.stack([one.columns for one in layout.drawn], axis=1)
        return cls(np.array(numbers), columns, np.stack([one.scored for one in layout.drawn], axis=1))

    def take(self, theta: FloatArray) -> FloatArray:
        """Return the scores, (n, n_tests, p), at theta (n, ndim); zero where there is no score."""
        return np.where(self.scored, theta[:, self.columns], 0.0)

    def put(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return a copy of theta (n, ndim) with the scores z, (n, n_tests, p)."""
        found = theta.copy()
        found[:, self.columns[self.scored]] = z[:, self.scored]
        return found


class Expansion(NamedTuple):
    """The log-likelihood of each test, expanded to second order in the parameters of the structure in the test.

    Attributes
    ----------
    values : ndarray, shape (n, n_tests, P)
        The parameters of the structure in each test at which the expansion is.
    slope : ndarray, shape (n, n_tests, P)
        The gradient of the log-likelihood of each test.
    information : ndarray, shape (n, n_tests, P, P)
        The Gauss–Newton approximation of minus its second derivatives.
    """

    values: FloatArray
    slope: FloatArray
    information: FloatArray


def expand(layout: Layout, likelihood: ModalLikelihood, theta: FloatArray) -> Expansion:
    """Return the log-likelihoods of the tests to second order about theta (n, ndim)."""
    at = layout.of_model(theta)
    slopes = likelihood.terms_and_gradient(at)[1]
    _, J = likelihood.residuals_and_slopes(at)
    P, n_tests = len(layout.structural), len(layout.tests)
    slope = sum_by_test(slopes[..., :P], likelihood.test_of_terms, n_tests)
    products = J[..., :, None] * J[..., None, :]
    information = sum_by_test(products, _tests_of_residuals(likelihood), n_tests)
    return Expansion(layout.values(theta[:, : len(layout.parameters)]), slope, information)


def sum_by_test(terms: FloatArray, test: IntArray, n_tests: int) -> FloatArray:
    """Return the sums over the terms (n, m, …) of each test, shape (n, n_tests, …); `test` has shape (m,)."""
    found = np.zeros((len(terms), n_tests, *terms.shape[2:]))
    order = np.argsort(test, kind="stable")
    first = np.flatnonzero(np.diff(test[order], prepend=-1))
    found[:, test[order][first]] = np.add.reduceat(terms[:, order], first, axis=1)
    return found


def score_precision(layout: Layout, theta: FloatArray) -> FloatArray:
    """Return minus the second derivatives of the log-prior by the scores of each test, (n, n_tests, p, p).

    The bounds of the parameters are taken as distant. Missing scores have the rows and columns of the identity.
    """
    size = np.stack([np.sqrt(one.curvature(theta)) for one in layout.drawn], axis=2)
    scored = np.stack([one.scored for one in layout.drawn], axis=1)
    size = np.where(scored, size, 1.0)
    p = size.shape[2]
    of_both = np.eye(p) if layout.correlation is None else np.eye(p) + layout.correlation.precision(theta)
    return np.asarray(of_both * size[..., :, None] * size[..., None, :])


def slopes_by_score(layout: Layout, theta: FloatArray) -> FloatArray:
    """Return the derivatives of the values by the scores, (n, n_tests, p), at theta (n, n_parameters)."""
    found = [
        next(s.values for s in one(theta)[1] if s.columns is one.base.columns)
        for one in layout.values_of
        if isinstance(one.base, Drawn)
    ]
    return np.stack(found, axis=2)


def _tests_of_residuals(likelihood: ModalLikelihood) -> IntArray:
    """Return the index of the test of each residual of ``residuals_and_slopes``, shape (n_residuals,)."""
    modes = likelihood.of_used(likelihood.model.test_of_modes)
    names = tuple(map(str, range(len(modes))))
    repeats = [len(term.labels(names)) // len(names) for term in likelihood.terms_of]
    found = [np.repeat(modes, n) for n in repeats]
    return np.concatenate([*found, *(np.full(len(term.labels), term.test) for term in likelihood.quantities)])
