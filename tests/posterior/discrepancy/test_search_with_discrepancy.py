"""The search for maxima of a model that may be wrong begins with the maxima of the model without its errors."""

from importlib.resources import as_file, files

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fmu.analysis.maxima.search import hessian_at
from fmu.config import read
from fmu.config.discrepancy import DiscrepancyTable
from fmu.posterior.maxima import local_maxima
from fmu.progress.phases import solves

STARTS = 2
RTOL = 1e-3
"""With a discrepancy, the derivatives of a shape's residuals leave out the part along the computed shape."""


@pytest.fixture(scope="module")
def posed():
    """Return a problem without and with scatter. Two modes of the last test nearly cross.

    The variances of their shapes change so fast around the crossing that Gauss–Newton steps do not converge.
    """
    with as_file(files("fmu.cases") / "shear-12dof-damage.toml") as path:
        file = read(path)
        wrong = file.model_copy(update={"discrepancy": [DiscrepancyTable(kind="embedded")]})
        return [one.build(path.name, path.parent) for one in (file, wrong)]


@pytest.fixture(scope="module")
def searched(posed):
    """Return the maxima of each problem, and the number of solves of each search."""
    found = []
    for problem in posed:
        before = solves()
        found.append((local_maxima(problem, STARTS), solves() - before))
    return found


def test_search_with_scatter_takes_few_solves_more_than_without(searched):
    """Rounding decides whether ascents converge at once or when retried, up to twice, for some `without` each."""
    (_, without), (_, with_scatter) = searched
    assert with_scatter <= 4 * without


def test_scatter_of_a_model_that_is_right_vanishes_at_the_maximum(posed, searched):
    (without, _), (with_scatter, _) = searched
    theta, problem = with_scatter[0].theta, posed[1]
    assert 0.0 < theta[-1] < 1e-6
    assert_allclose(theta[:-1], without[0].theta, atol=1e-3)
    scatter_alone = problem.prior.log_pdf(theta[None])[0] - posed[0].prior.log_pdf(theta[None, :-1])[0]
    assert_allclose(with_scatter[0].log_prob, without[0].log_prob + scatter_alone, atol=1e-3)


def test_curvature_where_the_scatter_vanishes_is_that_without_it(posed, searched):
    theta, problem = searched[1][0][0].theta, posed[1]
    plain = problem.with_likelihood(problem.likelihood.easier()[0])
    found, expected = (hessian_at(one, theta, is_rough=True)[0][:-1, :-1] for one in (problem, plain))
    assert_allclose(found, expected, rtol=RTOL, atol=RTOL * np.abs(expected).max())
