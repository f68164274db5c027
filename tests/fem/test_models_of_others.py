"""The kinds of models that other people bring: loaded from defaults within counted work, and right.

The free bar, the bracket and the footbridge have files of their own.
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.config import ConfigurationError
from tests.models import folded_shell, free_bar, loose_part, tower, truss_deck
from tests.work import counted


@pytest.fixture(scope="module", params=[tower, folded_shell], ids=["tower", "shell"])
def loaded(request, tmp_path_factory):
    planted = request.param.write(tmp_path_factory.mktemp("models"))
    with counted() as work:
        problem = fmu.load(planted.path)
    return planted, problem, work


def test_loading_takes_a_few_factorisations(loaded):
    _, problem, work = loaded
    assert work.factorisations <= 300
    assert work.solves <= 20_000
    assert problem.model.sizes
    assert max(problem.model.sizes) <= 80


def test_frequencies_are_those_of_a_dense_solver_where_nothing_was_solved_before(loaded):
    planted, problem, _ = loaded
    rng = np.random.default_rng(5)
    theta = problem.lower + (problem.upper - problem.lower) * rng.uniform(size=(1, problem.ndim))
    exact = [planted.frequencies_hz(dict(zip(problem.names, x, strict=True))) for x in theta]
    assert_allclose(problem.frequencies(theta), exact, rtol=1e-6)


def test_a_part_that_nothing_holds_is_refused_with_its_nodes(tmp_path):
    path = loose_part.write(tmp_path)
    with counted() as work, pytest.raises(ConfigurationError) as refused:
        fmu.load(path)
    words = str(refused.value)
    assert "can move without strain in 6 ways" in words
    assert str(loose_part.FIRST) in words
    assert not any(f"({node}" in words for node in range(1001, 1013))
    assert work.factorisations <= 20
    assert work.eigenproblems == 0


# a basis for the bounds of the footbridge would not pay, and fmu says so
REDUCED_AT_DRAWS = pytest.mark.filterwarnings("ignore:reduction. within the bounds a basis")


@pytest.mark.validate
@pytest.mark.parametrize("kind", [free_bar, tower, folded_shell, pytest.param(truss_deck, marks=REDUCED_AT_DRAWS)])
def test_runs_reach_a_verdict_and_find_the_truth(kind, tmp_path):
    prior = {"prior": free_bar.PRIOR} if kind is free_bar else {}
    planted = kind.write(tmp_path, **prior)
    problem = fmu.load(planted.path)
    trace = fmu.sample(problem, until_ess=400, seed=1)
    assert fmu.diagnose(trace, problem).converged
    assert trace.attrs.get("certificate_full_share", 0) == 0
    for name, truth in planted.truth.items():
        low, high = np.quantile(trace.posterior[name], [0.005, 0.995])
        assert low < truth < high, name
