"""Springs of a portal whose stiffnesses span four decades: in the search, in sampling, and by a surrogate."""

import numpy as np
import pytest

import fmu
from fmu.fem.surrogate.coordinates import FARTHEST, Coordinates
from fmu.posterior.ascent import GaussNewton
from fmu.posterior.maxima import local_maxima
from fmu.posterior.scaled import LogarithmicDensity, LogScaledDensity, ScaledDensity
from tests.gradients import assert_gradient
from tests.models import portal


@pytest.fixture(scope="module")
def two_springs():
    return portal.problem(2)


def test_only_wide_log_normal_priors_are_climbed_in_logarithms(two_springs):
    scaled = LogScaledDensity(two_springs)
    assert scaled.is_log.tolist() == [False, True, True]
    theta = np.array([[1.0, 2e5, 4e8], [0.9, 1.0, 1e12]])
    assert scaled.to_theta(scaled.to_scaled(theta)) == pytest.approx(theta, rel=1e-12)
    narrow = [fmu.Parameter("a", 1.0, prior=fmu.LogNormal(1.0, 0.3)), fmu.Parameter("b", 1.0, -1.0, 2.0)]
    problem = fmu.UpdatingProblem(
        fmu.BlackBoxModel(lambda theta: np.sqrt(theta[:1] + 3.0 + theta[1:]), 2),
        fmu.ModalData([1.9], sd_hz=[0.1]),
        narrow,
    )
    points = np.random.default_rng(0).uniform(0.1, 2.0, size=(5, 2))
    plain, other = ScaledDensity(problem), LogScaledDensity(problem)
    assert np.array_equal(plain.to_scaled(points), other.to_scaled(points))
    assert np.array_equal(GaussNewton(problem)(points)[2], GaussNewton(problem, other)(points)[2])


def test_gradient_and_curvature_in_logarithms(two_springs):
    """The curvature by the residuals is that of their squares; of the prior it is exact."""
    scaled = LogScaledDensity(two_springs)
    climbing = GaussNewton(two_springs, scaled)
    u = np.array([[1.2, -0.4, 0.8]])
    value, gradient, hessian = climbing(u)
    assert_gradient(gradient, lambda u: climbing(u)[0], u, 1e-5, rtol=1e-4)
    theta = scaled.to_theta(u)
    information = two_springs.likelihood.quadratic(theta)[2][0]
    stretch = scaled.stretch(theta)[0]
    assert hessian[0] - information * np.outer(stretch, stretch) == pytest.approx(np.eye(3), abs=1e-3)
    assert value == -scaled.log_prob(u)


def test_the_density_of_logarithms_has_their_jacobian(two_springs):
    density, logs = LogarithmicDensity(two_springs), LogScaledDensity(two_springs)
    u = np.array([[0.3, -0.4, 0.8], [0.6, 1.0, -0.2]])
    theta, step = density.to_theta(u), 1e-6
    moved = [density.to_theta(u + step * e) - density.to_theta(u - step * e) for e in np.eye(3)]
    volume = np.prod([x[:, k] / (2.0 * step) for k, x in enumerate(moved)], axis=0)
    assert density.log_prob(u) == pytest.approx(two_springs.log_prob(theta) + np.log(volume), abs=1e-6)
    value, gradient = density.log_prob_and_grad(u)
    assert value == pytest.approx(density.log_prob(u))
    assert_gradient(gradient, density.log_prob, u, 1e-5, rtol=1e-4)
    assert density.to_scaled(theta) == pytest.approx(logs.to_scaled(theta))


def test_most_starts_lead_to_a_maximum_that_matters(two_springs):
    """Along the stiffness itself one of sixteen did; the others stayed where a spring is rigid or a hinge."""
    maxima = local_maxima(two_springs, starts=16)
    assert sum(m.starts for m in maxima if m.log_prob > maxima[0].log_prob - 100.0) >= 12
    assert maxima[0].theta == pytest.approx(portal.TRUTH[:3], rel=0.1)


def test_places_far_out_neither_weigh_nor_own_draws():
    """The prior of E is twenty standard deviations off: ascents end on slopes, whose models are infinite."""
    problem = portal.problem(2, mean=0.0)
    maxima = fmu.find_map(problem, 8)
    assert maxima[0].share == pytest.approx(1.0)
    assert all(np.isfinite(m.share) for m in maxima)
    low = [k for k, m in enumerate(maxima) if m.log_prob < maxima[0].log_prob - 1000.0]
    assert low
    assert np.all(np.isinf(maxima.drop(maxima[0].theta[None])[low]))
    trace = fmu.sample(problem, draws=50, warmup=100, maxima=maxima)
    assert not any("elsewhere" in reason for reason in fmu.diagnose(trace).reasons)


def test_a_parameter_has_no_effect_on_a_surrogate_far_outside_its_box():
    coordinates = Coordinates.of_box(np.array([-1.0, 1e4]), np.array([1.0, 1e8]), np.array([False, True]))
    theta = np.array([[-1e300, 0.0], [1e300, 1e300], [0.5, 1e5]])
    assert coordinates.to_x(theta) == pytest.approx(np.array([[-FARTHEST] * 2, [FARTHEST] * 2, [0.5, -0.5]]))
    assert coordinates.slope(theta) == pytest.approx(
        np.array([[0.0, 0.0], [0.0, 0.0], [1.0, 5e-6 / np.log(10.0)]])
    )


@pytest.mark.parametrize(("springs", "most"), [(1, 60), pytest.param(2, 100, marks=pytest.mark.validate)])
def test_a_surrogate_learns_springs_of_four_decades(springs, most):
    learnt = fmu.surrogate(portal.problem(springs))
    assert learnt.model.certificate.shift <= learnt.model.certificate.shift_tolerance
    assert learnt.model.certificate.solves <= most
