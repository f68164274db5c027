"""Modes left out by common candidates: closed forms, other evidences, solves, and what happens where they fail."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

import fmu
from fmu.analysis.held_out import modes
from fmu.analysis.held_out.candidates import PriorCandidates, gaussians_of_groups
from fmu.analysis.held_out.refit import approximation, left_out
from fmu.analysis.held_out.together import left_out_together, walk
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity

SD = 0.5


class Linear:
    """Frequencies 100 + S θ."""

    n_parameters, solves = 3, 0

    def __init__(self, slopes):
        self.slopes, self.n_modes = slopes, len(slopes)

    def frequencies(self, theta):
        Linear.solves += len(theta)
        return 100.0 + (self.slopes * theta[:, None, :]).sum(axis=2)

    def frequencies_and_gradient(self, theta):
        return self.frequencies(theta), np.broadcast_to(self.slopes, (len(theta), *self.slopes.shape))


def linear(n_modes, outlier=0.0):
    rng = np.random.default_rng(n_modes)
    slopes = rng.standard_normal((n_modes, 3))
    measured = 100.0 + slopes @ [0.5, -0.3, 0.2] + SD * rng.standard_normal(n_modes)
    measured[1] += outlier
    parameters = [Parameter(name, start=0.0, prior=Normal(1.0)) for name in "abc"]
    data = ModalData(measured, numbers=tuple(range(1, n_modes + 1)))
    return UpdatingProblem(Linear(slopes), data, parameters, beta=0.5 / SD**2), slopes, measured


def without_each(problem):
    labels = problem.data.labels
    return [problem.using([other for other in labels if other != label]) for label in labels]


def exact(slopes, measured):
    """log p(y_k | y_-k) of a linear model with unit normal priors."""
    joint = slopes @ slopes.T + SD**2 * np.eye(len(slopes))
    log_z = multivariate_normal(np.full(len(slopes), 100.0), joint).logpdf(measured)
    left = []
    for k in range(len(slopes)):
        kept = np.arange(len(slopes)) != k
        others = multivariate_normal(np.full(kept.sum(), 100.0), joint[np.ix_(kept, kept)])
        left.append(log_z - others.logpdf(measured[kept]))
    return np.array(left)


@pytest.mark.parametrize("outlier", [0.0, 8.0])
def test_ten_modes_of_a_linear_model_are_those_of_the_closed_form(outlier):
    problem, slopes, measured = linear(10, outlier)
    found = left_out_together(without_each(problem), problem, np.random.default_rng(1))
    assert all(one.is_known and one.predicts for one in found)
    error = np.array([one.error for one in found])
    off = np.array([one.elpd for one in found]) - exact(slopes, measured)
    assert np.all(np.abs(off) < 4.0 * error + 1e-3)
    assert np.all(error < 0.05)


def test_ten_modes_take_hardly_more_solves_than_two():
    taken = {}
    for n in (2, 10):
        problem, before = linear(10)[0], Linear.solves
        left_out_together(without_each(problem)[:n], problem, np.random.default_rng(1))
        taken[n] = Linear.solves - before
    assert taken[10] < 2.0 * taken[2]


@pytest.fixture(scope="module")
def frame():
    """Return the problem of a frame, the problems without each mode, and what leaving the modes out told."""
    problem = fmu.cases.load("cantilever-young")
    without = without_each(problem)
    return problem, without, left_out_together(without, problem, np.random.default_rng(1))


def test_a_frame_by_common_candidates(frame):
    """Evidences by importance and bridge sampling from HMC: tests/validation/left_out.py, results/left-out.md."""
    reference = np.array([-10.385, -1.625, -13.457, -4.895, -14.979])
    for one, expected in zip(frame[2], reference, strict=True):
        assert one.is_known
        assert one.predicts
        assert one.elpd == pytest.approx(expected, abs=4.0 * np.hypot(one.error, 0.014))


@pytest.mark.validate
def test_a_frame_by_common_candidates_and_by_a_refit(frame):
    problem, without, found = frame
    rng = np.random.default_rng(2)
    of_both = [approximation(one, problem.start[None], rng) for one in (without[0], problem)]
    alone = left_out(without[0], problem, of_both, rng)
    assert found[0].elpd == pytest.approx(alone.elpd, abs=4.0 * np.hypot(found[0].error, alone.error))
    means = [np.exp(one.log_weights[0]) @ one.theta / problem.scale for one in (found[0], alone)]
    sd = np.sqrt(np.exp(alone.log_weights[0]) @ (alone.theta / problem.scale - means[1]) ** 2)
    assert np.all(np.abs(means[0] - means[1]) < 5.0 * sd / np.sqrt(min(found[0].effective, alone.effective)))


@pytest.mark.usefixtures("refits")
def test_modes_that_common_candidates_do_not_cover_have_candidates_of_their_own(monkeypatch):
    problem, slopes, measured = linear(4)
    alone = []

    def poor(without, whole, rng):
        found = left_out_together(without, whole, rng)
        object.__setattr__(found[2], "pareto_k", np.array([0.9, 0.1]))
        return found

    def counted(*arguments):
        alone.append(arguments)
        return left_out(*arguments)

    monkeypatch.setattr(modes, "left_out_together", poor)
    monkeypatch.setattr(modes, "left_out", counted)
    found = modes._left_out_all(problem, range(4), np.inf)
    assert len(alone) == 1
    assert [row.method for row in found.values()] == ["refit"] * 4
    np.testing.assert_allclose([row.elpd for row in found.values()], exact(slopes, measured), atol=0.2)


def test_a_single_mode_has_candidates_of_its_own():
    problem, _, _ = linear(4)
    assert modes._left_out_together(problem, [2]) == {}


def test_candidates_from_a_uniform_prior_have_the_density_of_the_unit_box():
    data = ModalData([100.0, 101.0])
    parameters = [Parameter(name, 2e11, 1e11, 4e11) for name in "abc"]
    problem = UpdatingProblem(Linear(np.ones((2, 3))), data, parameters, beta=1.0)
    prior = PriorCandidates(problem, ScaledDensity(problem))
    u = prior.draw(np.random.default_rng(1), 50)
    assert 0.0 <= u.min() < 0.2
    assert 0.8 < u.max() <= 1.0
    np.testing.assert_allclose(prior.log_density(u), 0.0, atol=1e-9)


def test_groups_of_draws_have_gaussians_as_narrow_as_they_are():
    """Two heaps, each of which is a fiftieth as wide as they are apart."""
    rng = np.random.default_rng(1)
    u = np.repeat([[0.2, 0.5], [0.8, 0.5]], 500, axis=0) + 0.012 * rng.standard_normal((1000, 2))
    found = gaussians_of_groups(u, np.zeros(1000), rng)
    assert len(found) >= 2
    for one in found:
        assert min(abs(one.position[0] - 0.2), abs(one.position[0] - 0.8)) < 0.05
        assert np.all(np.sqrt(np.diag(np.linalg.inv(one.hessian))) < 0.05)


def test_walkers_along_differences_keep_the_density():
    rng, sd, far = np.random.default_rng(1), np.array([1.0, 0.1]), np.full(2, 50.0)
    x = sd * rng.standard_normal((10 * 48, 2))
    kept = walk(lambda u: -0.5 * np.sum((u / sd) ** 2, axis=1), x, (-far, far), rng, 48)
    np.testing.assert_allclose(kept[50:].std(axis=(0, 1)), sd, rtol=0.15)
