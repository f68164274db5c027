"""A structure that is solved by sparse factorisations: few of them, and bounds in place of full solves."""

from importlib.util import find_spec

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.fem.modes import full_block
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.fem.modes.factors import banded, pardiso
from fmu.fem.reduced import anchors, confirming, residuals, shared
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.reduction import tolerance, train_reduced
from fmu.posterior.reduction.region import plausible_points
from fmu.posterior.reduction.tolerance import MEASURED, Tolerance
from tests.validation.bound import _of_problem, examined
from tests.validation.scale_model import Size, scale_problem

SIZE = Size(12, 3, 2)


@pytest.fixture(scope="module")
def made():
    """Return the problem of a frame, how many full eigenproblems it took, and how many tests of its mass."""
    counted = {"eigen": 0, "rank": 0}
    patch = pytest.MonkeyPatch()
    for name in counted:
        whole = getattr(full_block, name)

        def counting(*given, whole=whole, name=name):
            counted[name] += 1
            return whole(*given)

        patch.setattr(full_block, name, counting)
    patch.setenv("FMU_CACHE_DIR", "")
    problem = scale_problem(SIZE, 2, 1e-5)
    patch.undo()
    return problem, counted


def test_few_full_solves_make_a_problem(made):
    _, counted = made
    assert SIZE.n_dof > DENSE_LIMIT
    # the reference modes, which are those at the start; the middle of the box, and four that confirm the basis
    assert counted == {"eigen": 6, "rank": 1}


def test_the_bound_of_the_log_probability_follows_from_those_of_the_frequencies(made, monkeypatch):
    problem, _ = made
    structure = problem.model
    points = plausible_points(problem, 20, np.random.default_rng(4))
    bound = train_reduced._log_prob_bound(structure, problem.likelihood, points)
    assert np.max(bound) <= 0.7 * problem.tolerance.log_prob
    full, reduced = structure.truth.modes(points), structure.modes(points)
    points = points[np.all(full.rank == reduced.rank, axis=1)]  # the others are on a jump of the pairing
    assert len(points) > 10
    errors = structure.frequencies(points) / structure.truth.frequencies(points) - 1.0
    monkeypatch.setattr(structure, "frequency_bound", lambda theta: errors[np.isin(points, theta).all(axis=1)])
    bound = train_reduced._log_prob_bound(structure, problem.likelihood, points)
    exact = np.sum(problem.with_model(problem.model.truth).likelihood.terms(points), axis=1)
    true = np.abs(np.sum(problem.likelihood.terms(points), axis=1) - exact)
    assert np.all(true <= bound + 1e-8)
    assert np.any(true >= 0.99 * bound)


@pytest.mark.validate
def test_the_bound_holds_where_the_basis_does_not_know_the_mode_above(made):
    assert examined(_of_problem("frame", made[0], 256)).exceeded == 0


def test_the_factors_of_training_serve_the_bound(made, monkeypatch):
    problem, _ = made
    theta = problem.sample_prior(np.random.default_rng(5), 4)
    found = problem.model.frequency_bound(theta)
    monkeypatch.setattr("fmu.fem.reduced.anchors.factorise", None)
    np.testing.assert_array_equal(problem.model.frequency_bound(theta), found)


def test_a_solve_at_one_theta_is_remembered_as_it_was(made):
    problem, _ = made
    (block,) = problem.model.truth.blocks
    theta = problem.start[None]
    lam, phi = block.modes(theta, 4)
    phi[:] = 0.0  # the caller's own
    again = block.modes(theta, 4)
    assert np.all(np.any(again[1], axis=1))
    np.testing.assert_array_equal(again[0], lam)
    assert block.modes(theta, 5)[0].shape == (1, 5)
    np.testing.assert_array_equal(block.modes(theta, 4)[1], again[1])


def test_rounding_is_found_again_after_the_start_has_changed(made):
    problem, _ = made
    other = UpdatingProblem(problem.model, problem.data, problem.parameters)
    assert other.log_prob(other.start) == problem.log_prob(problem.start)


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Return the frame as a structure that counts as large, and the same with the basis from the cache."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (full_block, anchors, shared, confirming, tolerance):
            patch.setattr(module, "LARGE", DENSE_LIMIT)
        for module, name in ((full_block, "clear_factor"), (anchors, "factorise"), (residuals, "factorise")):
            patch.setattr(module, name, _counted(name, getattr(module, name)))
        patch.setenv("FMU_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield scale_problem(SIZE, 2, reduction=True), scale_problem(SIZE, 2, reduction=True)


FACTORISED = []


def _counted(name, whole):
    def counting(*given, **named):
        FACTORISED.append(name)
        return whole(*given, **named)

    return counting


def test_factors_are_used_again(measured):
    """One stiffness serves the modes at the start, the anchor and its modes; one count of modes the training.

    With the basis from the cache, the modes at the start are left.
    """
    assert FACTORISED == ["clear_factor", "factorise", "clear_factor"]


def test_the_errors_of_the_measurement_set_the_tolerance_of_a_large_structure(made, measured):
    problem = measured[0]
    assert problem.tolerance == MEASURED == Tolerance(1e-3, 0.01, 10.0)
    assert sum(problem.model.sizes) < sum(made[0].model.sizes)  # of 1e-5 in the whole box
    points = plausible_points(problem, 24, np.random.default_rng(5), MEASURED.depth)
    full = problem.with_model(problem.model.truth)
    assert np.max(np.abs(problem.log_prob(points) - full.log_prob(points))) <= MEASURED.log_prob
    rng = np.random.default_rng(6)
    theta = rng.uniform(problem.model.lower[0], problem.model.upper[0], size=(8, 2))
    assert np.max(np.abs(problem.frequencies(theta) / full.frequencies(theta) - 1.0)) <= MEASURED.frequency


def test_a_number_is_taken_at_its_word():
    assert Tolerance.of(1e-6, 10**6) == Tolerance() == Tolerance.of(True, tolerance.LARGE - 1)
    assert Tolerance.of(True, tolerance.LARGE) == MEASURED
    assert Tolerance.of(False, 10**6) is None


def test_bounds_from_shared_right_hand_sides_are_those_solved_for_and_those_from_the_cache(measured):
    trained, read = (problem.model for problem in measured)
    theta = measured[0].sample_prior(np.random.default_rng(7), 6)
    bound = trained.frequency_bound(theta)
    assert read._bound.shared
    # shared energies are differences: their rounding is 5e-12 here, at 200 points from the prior
    assert_allclose(read.frequency_bound(theta), bound, rtol=1e-3, atol=5e-11)
    read._bound.shared = {}
    assert_allclose(read.frequency_bound(theta), bound, rtol=1e-3, atol=5e-11)
    errors = np.abs(trained.frequencies(theta) / trained.truth.frequencies(theta) - 1.0)
    assert np.all(errors <= bound + 1e-10)


@pytest.mark.skipif(find_spec("pypardiso") is None, reason="pypardiso, the extra fast, is not installed")
def test_factors_in_single_precision_certify_the_same_posterior(measured, monkeypatch, certified):
    for module in (full_block, anchors, shared, confirming, tolerance):
        monkeypatch.setattr(module, "LARGE", DENSE_LIMIT)
    monkeypatch.setenv("FMU_CACHE_DIR", "")
    monkeypatch.setattr(pardiso, "_SHARE", 0.0)
    monkeypatch.setattr(banded, "_NARROW", 0)  # no band of LAPACK's
    banded.find_band.cache_clear()
    problem = scale_problem(SIZE, 2, reduction=True)
    banded.find_band.cache_clear()
    (block,) = problem.model.truth.blocks
    assert block.clear_factor(problem.start).is_single
    found = problem.model.truth.frequencies(problem.start[None])
    assert_allclose(found, measured[0].model.truth.frequencies(problem.start[None]), rtol=1e-9)
    trace = fmu.sample(problem, "mixture", draws=20, warmup=20, chains=2, seed=1)
    assert trace.attrs["certificate_bound_exceeded"] == 0
    assert trace.attrs["certificate_log_prob_error"] <= MEASURED.log_prob
