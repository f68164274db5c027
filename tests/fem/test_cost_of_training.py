"""Training costs a budget at most, and the faster model answers: decided by counted work, not by a clock."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.check import model_in_words
from fmu.analysis.maxima.search import STARTS, STARTS_BY_FULL, default_starts
from fmu.fem.reduced import training
from fmu.fem.reduced.cost import Cost
from tests.models import free_bar, truss_deck
from tests.work import counted

FRAME = Cost(n_dof=1000, n_entries=55_000, n_terms=18, massless=True)


@pytest.fixture(scope="module")
def deck(tmp_path_factory):
    """Return the footbridge of 17 groups, loaded, and the work that it took."""
    planted = truss_deck.write(tmp_path_factory.mktemp("deck"), top='pairing = "index"')
    with counted() as work:
        problem = fmu.load(planted.path)
    return planted, problem, work


def test_a_model_of_many_terms_in_wide_bounds_is_loaded_within_the_budget(deck):
    _, problem, work = deck
    cost = problem.model.full.blocks[0]
    assert cost.size == 941
    assert cost.n_modes == 467  # the others have no mass
    assert work.factorisations <= 100
    assert work.solves <= 40 * training.BUDGET


def test_the_full_model_answers_where_a_reduced_one_saves_little(deck):
    _, problem, _ = deck
    assert problem.model.reduced_sizes == ()
    assert problem.tolerance is None
    assert default_starts(problem) == STARTS_BY_FULL < STARTS
    said = " ".join(model_in_words(problem))
    assert "The full model answers: a reduced one of" in said


def test_the_decision_is_kept(deck):
    planted, problem, _ = deck
    with counted() as work:
        again = fmu.load(planted.path)
    assert work.factorisations <= 20
    assert again.model.why_full == problem.model.why_full


def test_its_frequencies_are_those_of_a_dense_solver(deck):
    planted, problem, _ = deck
    rng = np.random.default_rng(3)
    theta = np.stack([rng.uniform(-0.9, 2.0, 17), rng.uniform(-0.2, 0.2, 17)])
    exact = [planted.frequencies_hz(dict(zip(problem.names, x, strict=True))) for x in theta]
    assert_allclose(problem.frequencies(theta), exact, rtol=1e-6)


def test_cost_grows_with_sizes():
    sizes = np.arange(10, 400, 10)
    assert np.all(np.diff([FRAME.reduced(r) for r in sizes]) > 0)
    assert 3.0 * FRAME.reduced(FRAME.most_vectors()) <= FRAME.full < 3.0 * FRAME.reduced(FRAME.most_vectors() + 1)
    solid = Cost(n_dof=1000, n_entries=300_000, n_terms=18, massless=True)
    assert solid.full > FRAME.full
    assert solid.most_vectors() > FRAME.most_vectors()


def test_a_spent_budget_ends_training_with_the_best_basis_so_far(tmp_path, monkeypatch):
    planted = free_bar.write(tmp_path, (9, 4, 4))
    monkeypatch.setattr(training, "BUDGET", 1e-3)
    monkeypatch.setattr(training, "CHEAP", 0.0)
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    problem = fmu.load(planted.path)
    assert not problem.model.confirmed
    assert problem.model.reduced_sizes
