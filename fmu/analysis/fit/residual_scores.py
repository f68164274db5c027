"""Test scores from residuals: the direction in which each test's data would move a parameter.

For a parameter that does not scatter, the model gives its value in every test: one common value, a value for each
group, or a law in the covariates. Let r be the residuals of test t, in standard deviations, and J their
derivatives with respect to the parameter in this test, at the posterior mean. The score is s_t = −Jᵀr/|J|. It is
Rao's score statistic for a value in test t that differs from the model (Rao 1948, *Proc. Camb. Phil. Soc.* 44,
50–57). It is positive if the data favour a larger value. If the model is correct, the scores are independent of
order, groups and covariates. Their variance is nearly one, because many tests determine few parameters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.posterior.errors.slopes import residuals_of_term
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem


GROUP = "residual_scores"
_LEAST = 1e-6
"""A parameter does not affect a test if its sum of squared derivatives is below this fraction of the largest of
all tests."""
_IN_EACH_TEST = ("mean", "test")
"""Roles of parameters whose values in the tests are free: population means, and values in single tests."""


def residual_group(problem: UpdatingProblem, theta: FloatArray) -> dict[str, xr.Dataset]:
    """Return the trace group ``residual_scores``, with the variable ``score`` (test, parameter), in a dict.

    The dict is empty if every parameter scatters or has a separate value in each test, if no error model has
    residuals of modes, or if the model contains a user's function, since derivatives would require further calls.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with several tests.
    theta : ndarray, shape (n, ndim)
        Posterior draws.
    """
    import xarray as xr

    free = {role.of for role in problem.roles if role.kind in _IN_EACH_TEST}
    chosen = [j for j in range(len(problem.layout.structural)) if j not in free]
    if not chosen or problem.model.functions or not problem.likelihood.terms_of:
        return {}
    scores = _scores(problem, theta.mean(axis=0))[:, chosen]
    names = [problem.layout.structural[j].name for j in chosen]
    coordinates = {"test": [test.name for test in problem.tests], "parameter": names}
    return {GROUP: xr.Dataset({"score": (("test", "parameter"), scores)}, coords=coordinates)}


def _scores(problem: UpdatingProblem, theta: FloatArray) -> FloatArray:
    """Return each test's score for each structural parameter at theta (ndim,), shape (n_tests, n_structural).

    A score is NaN if the parameter does not affect the test.
    """
    likelihood, every = problem.likelihood, problem.layout.of_model(theta[None])
    seen, noise = likelihood.observed(every, True), every[:, problem.model.n_parameters :]
    gradient = np.zeros((problem.data.n_modes, len(problem.layout.structural)))
    information = np.zeros_like(gradient)
    for term in likelihood.terms_of:
        r, J = (part[0] for part in residuals_of_term(term, seen, noise))
        gradient -= np.einsum("mq,mqk->mk", r, J)
        information += np.einsum("mqk,mqk->mk", J, J)
    used = np.arange(len(gradient)) if likelihood.used is None else likelihood.used
    tests = problem.model.test_of_modes[used]
    of_test = (tests == np.arange(len(problem.tests))[:, None]).astype(float)
    gradient, information = of_test @ gradient[used], of_test @ information[used]
    known = information > _LEAST * information.max(axis=0)
    return np.where(known, gradient / np.sqrt(np.where(known, information, 1.0)), np.nan)
