"""The speed budget of the log-probability, as ratios to the LAPACK calls that any eigenvalue model needs."""

from copy import copy

import numpy as np
import pytest
import scipy.linalg as sl

import fmu
from tests.benchmarks.ratio import spd

YOUNG, SECTION = "cantilever-young", "cantilever-section"
VALUES = [(YOUNG, "shape", 1.5), (SECTION, "shape", 2.5), (YOUNG, "index", 3.0), (SECTION, "index", 4.0)]
BATCHES = [16, 64, 512]


def prior_draws(problem, n):
    return problem.sample_prior(np.random.default_rng(1), n)


def by_assignment(problem):
    """Return the problem with modes paired by MAC at every theta, although training found one order for all."""
    model = copy(problem.model)
    model._answer_by(model.truth.solved_by(model.cheap.blocks, model.rule))
    return problem.with_model(model)


@pytest.mark.parametrize("n", BATCHES)
@pytest.mark.parametrize(("case", "pairing", "budget"), VALUES)
def test_values(load, against, case, pairing, budget, n):
    problem, matrices = load(case, pairing), spd(n, 20)
    theta = prior_draws(problem, n)
    what = f"log_prob, {case} by {pairing}, batch of {n}, against eigvalsh 20×20"
    against(what, lambda: problem.log_prob(theta), lambda: np.linalg.eigvalsh(matrices), budget)


@pytest.mark.parametrize("n", BATCHES)
@pytest.mark.parametrize("case", [YOUNG, SECTION])
def test_values_by_general_assignment(load, against, case, n):
    problem, matrices = load(case), spd(n, 20)
    general = by_assignment(problem)
    theta = prior_draws(problem, n)
    np.testing.assert_allclose(general.log_prob(theta), problem.log_prob(theta), rtol=1e-6)
    what = f"log_prob, {case} by general MAC assignment, batch of {n}, against eigh 20×20"
    against(what, lambda: general.log_prob(theta), lambda: np.linalg.eigh(matrices), 2.0)


@pytest.mark.parametrize("n", BATCHES)
@pytest.mark.parametrize("case", [YOUNG, SECTION])
def test_gradient(load, against, case, n):
    problem, matrices = load(case), spd(n, 20)
    theta = prior_draws(problem, n)
    what = f"log_prob_and_grad, {case} by shape, batch of {n}, against eigh 20×20"
    against(what, lambda: problem.log_prob_and_grad(theta), lambda: np.linalg.eigh(matrices), 1.5)


@pytest.mark.parametrize(("n", "budget"), [(64, 300.0), (1, 120.0)])
def test_against_scipy_on_the_whole_beam(load, against, n, budget):
    """SciPy's dense solver on the whole beam of 300 DOF, without the assembly of its matrices."""
    problem = load(YOUNG)
    theta = prior_draws(problem, n)
    K, M = (matrix(theta[0]).toarray() for matrix in (problem.model.structure.K, problem.model.structure.M))
    point = theta if n > 1 else theta[0]

    def dense():
        for _ in range(n):
            sl.eigh(K, M, subset_by_index=[0, 9])

    what = f"scipy.linalg.eigh on 300 DOF against log_prob, per theta, {'batch of 64' if n > 1 else 'single'}"
    against(what, lambda: problem.log_prob(point), dense, budget, at_most=False)


def shapes_too(problem):
    """Return a problem with the frequencies of a case and its computed shapes at five nodes, and its errors."""
    nodes = list(problem.model.structure.geometry.row_of)[10:51:10]
    sensors = tuple((node, direction) for node in nodes for direction in "xyz")
    shapes = (
        problem.model.truth.seen_by(sensors).observed(problem.start[None, : len(problem.parameters)]).shapes[0]
    )
    data = fmu.ModalData(np.asarray(problem.data.frequencies_hz), sensors=sensors, shapes=shapes)
    errors = [fmu.FrequencyErrors("relative", sd=0.01), fmu.ShapeErrors(sd=0.05)]
    return fmu.UpdatingProblem.reduced(problem.model.structure, data, problem.parameters, error=errors), errors


@pytest.mark.parametrize("n", [1, 64])
@pytest.mark.parametrize("of", ["frequencies", "shapes"])
@pytest.mark.parametrize("gradient", [False, True])
def test_embedded_scatter(load, against, gradient, of, n):
    """The cost of embedded scatter: values need first derivatives, gradients need second derivatives."""
    plain, error = (load(YOUNG), "frequency") if of == "frequencies" else shapes_too(load(YOUNG))
    budget = 4.0 if gradient else 2.5
    wrong = fmu.UpdatingProblem(
        plain.model, plain.data, plain.parameters, error=error, discrepancy=fmu.Discrepancy()
    )
    theta = prior_draws(wrong, n)
    point, point_of_plain = (theta, theta[:, : plain.ndim].copy()) if n > 1 else (theta[0], theta[0, : plain.ndim])
    ours, theirs = (p.log_prob_and_grad if gradient else p.log_prob for p in (wrong, plain))
    what = (
        f"{'log_prob_and_grad' if gradient else 'log_prob'}, {YOUNG}, {of}, batch of {n}, with embedded scatter "
    )
    against(f"{what}against none", lambda: ours(point), lambda: theirs(point_of_plain), budget)
