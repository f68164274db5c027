"""A structure that is solved by sparse factorisations: few of them, and bounds in place of full solves."""

import numpy as np
import pytest

from fmu.fem.modes import full_block
from fmu.fem.modes.eigensolver import DENSE_LIMIT
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.reduction import train_reduced
from fmu.posterior.reduction.region import plausible_points
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
    points = plausible_points(problem, 32, np.random.default_rng(4))
    bound = train_reduced._log_prob_bound(structure, problem.likelihood, points)
    assert np.max(bound) <= 0.7 * problem.tolerance.log_prob
    full, reduced = structure.truth.modes(points), structure.modes(points)
    points = points[np.all(full.rank == reduced.rank, axis=1)]  # the others are on a jump of the pairing
    assert len(points) > 16
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
