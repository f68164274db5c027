"""Training costs a budget at most, and the faster model answers: decided by counted work, not by a clock."""

import warnings
from itertools import count

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.analysis.maxima.search import STARTS, STARTS_IF_SLOW, default_starts
from fmu.analysis.start.model_words import model_in_words
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.full_block import full_blocks
from fmu.fem.modes.modal import solve_spectrum
from fmu.fem.modes.solver import LAPACK
from fmu.fem.reduced import training
from fmu.fem.reduced.cost import Cost
from fmu.fem.reduced.reduced_structure import largest_tolerance_elsewhere, restore
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.reduction import train_reduced
from fmu.posterior.reduction.region import plausible_points
from fmu.posterior.reduction.train_reduced import ReductionWarning
from tests.models import free_bar, truss_deck
from tests.models.random_models import random_model
from tests.work import counted

FRAME = Cost(n_dof=1000, n_entries=55_000, n_terms=18, massless=True)


LENGTHS = {"short": (35, 4, 20, 8), "long": (40, 8, 60, 32)}
"""Bays and measured modes of a footbridge; draws at which it is solved for a basis, and those that check it.

The short one has just so many masses that its modes are those of sparse factors.
"""
SIZES = {"short": (821, 407), "long": (941, 467)}
"""Degrees of freedom, and those that have mass."""


@pytest.fixture(scope="module", params=["short", pytest.param("long", marks=pytest.mark.validate)])
def length(request):
    return request.param


@pytest.fixture(scope="module")
def trained(length):
    """Return the states of what `deck` trained: `in_full` decides otherwise after the same training."""
    return {}


def train_once(patch, length, trained):
    """Keep every training and its plausible points, or restore what was kept at the same place while loading."""
    calls = count()

    def remembered(train):
        def call(structure, *given):
            at = next(calls)
            if at in trained:
                return restore(structure, trained[at]), dict(trained[at])
            model, trained[at] = train(structure, *given)
            return model, dict(trained[at])

        return call

    def remembered_points(find):
        places = count()

        def call(*given):
            at = f"points {next(places)}"
            if at not in trained:
                trained[at] = find(*given)
            return trained[at]

        return call

    patch.setattr(train_reduced, "_SNAPSHOTS", LENGTHS[length][2])
    patch.setattr(train_reduced, "_CHECKED", LENGTHS[length][3])
    for name in ("train", "train_at"):
        patch.setattr(train_reduced, name, remembered(getattr(train_reduced, name)))
    patch.setattr(train_reduced, "plausible_points", remembered_points(train_reduced.plausible_points))


def write_deck(length, folder):
    """Write a footbridge, and return it."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in zip(("BAYS", "MODES"), LENGTHS[length], strict=False):
            patch.setattr(truss_deck, name, value)
        return truss_deck.write(folder)


@pytest.fixture(scope="module")
def deck(tmp_path_factory, length, trained):
    """Return the footbridge of 17 groups, loaded, and the work that it took."""
    planted = write_deck(length, tmp_path_factory.mktemp("deck"))
    with pytest.MonkeyPatch.context() as patch, counted() as work:
        train_once(patch, length, trained)
        with pytest.warns(ReductionWarning, match="where the posterior has its mass, and"):
            problem = fmu.load(planted.path)
    return planted, problem, work


@pytest.fixture(scope="module")
def in_full(tmp_path_factory, length, deck, trained):
    """Return the footbridge where no basis is accurate enough, and its file; the work after that of `deck`."""
    planted = write_deck(length, tmp_path_factory.mktemp("full"))
    with pytest.MonkeyPatch.context() as patch, counted() as work:
        train_once(patch, length, trained)
        patch.setattr(train_reduced, "LOOSEST_LOG_PROB", 1e-9)
        patch.setenv("FMU_CACHE_DIR", str(planted.path.parent))
        problem = fmu.load(planted.path)
    return planted, problem, work


def test_a_model_of_many_terms_in_wide_bounds_is_loaded_within_the_budget(length, deck):
    _, problem, work = deck
    block = problem.model.truth.blocks[0]
    assert (block.size, block.n_modes) == SIZES[length]
    assert block.n_modes > DENSE_LIMIT
    most = training.BUDGET * LENGTHS[length][2] / LENGTHS["long"][2]  # solves at draws are most of the work
    assert work.factorisations <= most  # those of eigenproblems too
    assert work.solves <= 40 * most


def test_where_a_basis_for_the_box_would_not_pay_one_is_trained_where_the_posterior_is(deck):
    _, problem, _ = deck
    (size,) = problem.model.sizes
    assert size <= 200
    assert problem.tolerance.log_prob == train_reduced.LOOSEST_LOG_PROB
    assert problem.model.elsewhere >= problem.tolerance.frequency
    assert not problem.model.truth.why_full
    assert default_starts(problem) == STARTS_IF_SLOW < STARTS  # more than a millisecond a solve
    points = plausible_points(problem, 10, np.random.default_rng(7), 15.0)
    full = problem.with_model(problem.model.truth).likelihood.terms(points)
    assert np.all(np.abs(np.sum(problem.likelihood.terms(points) - full, axis=1)) < problem.tolerance.log_prob)
    reduced, exact = problem.frequencies(points), problem.model.truth.frequencies(points)
    assert np.all(np.abs(reduced / exact - 1.0) < problem.tolerance.frequency)


def test_the_full_model_answers_where_no_basis_is_accurate(in_full):
    _, problem, work = in_full
    assert problem.model.sizes == ()
    assert problem.tolerance is None
    assert default_starts(problem) == STARTS_IF_SLOW < STARTS
    said = " ".join(model_in_words(problem))
    assert "The full model answers: a reduced one of" in said
    assert work.factorisations <= training.BUDGET  # those of eigenproblems too


@pytest.mark.usefixtures("length")
@pytest.mark.parametrize("how", ["deck", "in_full"])
def test_the_decision_is_kept(how, request, monkeypatch):
    planted, problem, _ = request.getfixturevalue(how)
    if how == "in_full":
        monkeypatch.setenv("FMU_CACHE_DIR", str(planted.path.parent))
    with counted() as work, warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", ReductionWarning)
        again = fmu.load(planted.path)
    assert len(said) == (how == "deck")
    assert work.factorisations <= 20
    assert work.eigenproblems <= 5
    assert again.model.truth.why_full == problem.model.truth.why_full
    assert again.tolerance == problem.tolerance
    assert largest_tolerance_elsewhere(again.model) == largest_tolerance_elsewhere(problem.model)
    assert_array_equal(again.frequencies(problem.start[None]), problem.frequencies(problem.start[None]))


def test_its_frequencies_are_those_of_a_dense_solver(in_full):
    planted, problem, _ = in_full
    rng = np.random.default_rng(3)
    theta = np.stack([rng.uniform(-0.9, 2.0, 17), rng.uniform(-0.2, 0.2, 17)])
    exact = [planted.frequencies_hz(dict(zip(problem.names, x, strict=True))) for x in theta]
    assert_allclose(problem.frequencies(theta), np.array(exact)[:, : problem.model.n_modes], rtol=1e-6)


def test_cost_grows_with_sizes():
    sizes = np.arange(10, 400, 10)
    assert np.all(np.diff([FRAME.of_reduced(r) for r in sizes]) > 0)
    assert FRAME.of_reduced(2000) > 7.0 * FRAME.of_reduced(1000)  # eigenproblems of full matrices: by the cube
    assert (
        3.0 * FRAME.of_reduced(FRAME.most_vectors())
        <= FRAME.full
        < 3.0 * FRAME.of_reduced(FRAME.most_vectors() + 1)
    )
    solid = Cost(n_dof=1000, n_entries=300_000, n_terms=18, massless=True)
    assert solid.full > FRAME.full
    assert solid.most_vectors() > FRAME.most_vectors()


def test_a_spent_budget_ends_training_with_the_best_basis_so_far(tmp_path, monkeypatch):
    planted = free_bar.write(tmp_path, (8, 3, 3))
    monkeypatch.setattr(training, "BUDGET", 1e-3)
    monkeypatch.setattr(training, "CHEAP", 0.0)
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    problem = fmu.load(planted.path)
    assert not problem.model.confirmed
    assert problem.model.sizes


def test_a_block_that_no_parameter_changes_is_solved_once():
    """Two springs beside one that is uncertain, and a mass that nothing holds."""
    K = np.diag([0.0, 3.0, 2.0, 0.0])
    model = fmu.SeparableModel.from_terms(["k"], [K, (np.diag([1.0, 0.0, 0.0, 0.0]), "k")], [np.eye(4)])
    full, theta = full_blocks(model), np.linspace(0.5, 1.5, 7)[:, None]
    assert [block.constant for block in full] == [False, True, True, True]
    with counted() as work:
        eigenvalues = solve_spectrum(full, theta, 4).eigenvalues
        solve_spectrum(full, 2.0 * theta[:3], 4)
    assert work.eigenproblems == 7 + 3 + 3
    expected = np.stack([np.sort([0.0, 3.0, 2.0, k]) for k in theta[:, 0]])
    assert_allclose(eigenvalues, expected, atol=1e-15)


@pytest.mark.parametrize("budget", [20, 64, pytest.param(400, marks=pytest.mark.validate)])
def test_comparisons_of_a_small_model_keep_to_the_budget(monkeypatch, budget):
    monkeypatch.setattr(train_reduced, "BUDGET", budget)
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    compared, whole = [], ModalLikelihood.terms

    def counting(self, points):
        compared.append(len(points) if self.model is self.model.truth else 0)
        return whole(self, points)

    monkeypatch.setattr(ModalLikelihood, "terms", counting)
    random = random_model(102, 300)
    measured = np.array([1.0, 1.1, 1.3]) * np.sqrt(random.modes(np.ones(5), 3)[0].astype(float)) / (2.0 * np.pi)
    data = fmu.ModalData(measured, sd_hz=1e-2 * measured)
    fmu.UpdatingProblem.reduced(random.model, data, random.parameters, pairing="index")
    assert 1 < sum(compared) <= budget + 1  # and the start


def test_the_error_of_a_basis_that_missed_its_tolerance_takes_one_full_solve_a_point(monkeypatch):
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    random = random_model(110, 700)
    start = np.ones(len(random.parameters))
    measured = np.sqrt(random.modes(start, 3)[0].astype(float)) / (2.0 * np.pi)
    data = fmu.ModalData(measured, sd_hz=1e-2 * measured)
    problem = fmu.UpdatingProblem.reduced(random.model, data, random.parameters, pairing="index")
    assert problem.model.truth.solver != LAPACK
    with counted() as work:
        error = train_reduced._paired_error(problem.model, 0.7 * start, 1.3 * start, 1e-12)
    assert 1e-12 < error < 1e-6
    assert 20 <= work.eigenproblems <= train_reduced._CHECKED
