"""Where an ascent ends: maxima, walls, kinks, jumps, edges and slopes are told apart, and a jump has no basin."""

from dataclasses import replace

import numpy as np
import pytest

import fmu
from fmu.analysis.maxima.kinds import EDGE, JUMP, KINK, MAXIMUM, SLOPE, active_bounds, basin, kind_of, slope
from fmu.analysis.maxima.missed import draws_of_maxima
from fmu.analysis.maxima.mode_weights import mode_weights
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.mixture.quadratic import Quadratic

SD = np.array([0.01, 0.02])


class Broken:
    """A Gaussian around 0 of which `beyond` changes what lies at x₀ > 0.03."""

    ndim = 2
    lower, upper = np.full(2, -1.0), np.full(2, 1.0)

    def __init__(self, beyond):
        self.beyond = beyond

    def log_prob(self, x):
        x = np.asarray(x)
        smooth = -0.5 * np.sum((x / SD) ** 2, axis=-1)
        return np.where(x[..., 0] > 0.03, self.beyond(x, smooth), smooth)


def ended(density, x, gradient):
    """The model around a point: the Gaussian's curvature, and this gradient per standard deviation."""
    scaled = ScaledDensity(density)
    position = scaled.to_scaled(np.asarray(x))
    hessian = np.diag((scaled.scale / SD) ** 2)
    slopes = np.asarray(gradient) * scaled.scale / SD
    return scaled, Quadratic(position, float(scaled.log_prob(position)), slopes, hessian)


@pytest.mark.parametrize(
    ("beyond", "x", "gradient", "kind"),
    [
        (lambda x, smooth: smooth, [0.0, 0.0], [1e-3, 0.0], MAXIMUM),
        (lambda x, smooth: smooth, [-1.0, 0.0], [-100.0, 0.0], MAXIMUM),
        (lambda x, smooth: smooth, [-0.03, 0.0], [3.0, 0.0], SLOPE),
        (lambda x, smooth: -1e3 * x[..., 0], [0.03 - 1e-12, 0.0], [3.0, 0.0], JUMP),
        (lambda x, smooth: -4.5 - 400.0 * (x[..., 0] - 0.03), [0.03 - 1e-12, 0.0], [3.0, 0.0], KINK),
        (lambda x, smooth: np.full_like(smooth, -np.inf), [0.03 - 1e-12, 0.0], [3.0, 0.0], EDGE),
        (lambda x, smooth: np.full_like(smooth, np.nan), [0.03 - 1e-12, 0.0], [3.0, 0.0], EDGE),
    ],
)
def test_what_ends_an_ascent(beyond, x, gradient, kind):
    scaled, model = ended(Broken(beyond), x, gradient)
    assert kind_of(None, scaled, model) == kind
    if kind not in (MAXIMUM,):
        assert slope(scaled, model) == pytest.approx(3.0, rel=1e-6)


def test_a_spike_where_modes_coincide_is_a_jump():
    """As of two modes of one frequency, whose shapes turn within 1e-9 of the parameter."""

    def spike(x, smooth):
        return smooth - 28.0 * (1.0 - np.exp(-(((x[..., 0] - 0.03) / 1e-10) ** 2)))

    scaled, model = ended(Broken(spike), [0.03, 0.0], [7.2, 0.0])
    assert kind_of(None, scaled, model) == JUMP


@pytest.fixture
def far_jump():
    """A maximum at 0, and a jump 7.9 standard deviations away whose gradient points at it, both scaled to 1."""
    top = Quadratic(np.zeros(2), 0.0, np.zeros(2), np.eye(2))
    jump = Quadratic(np.array([7.9, 0.0]), -26.0, np.array([-7.4, 0.0]), np.eye(2))
    return top, jump


def test_the_mass_of_a_jump_is_that_of_its_place(far_jump):
    """Its own model rises by 27 nats towards the maximum, and claimed a share of its draws."""
    lower, upper = np.full(2, -20.0), np.full(2, 20.0)

    def log_prob(u):
        return -0.5 * np.sum(u**2, axis=-1)

    no_bound = np.zeros(2)
    basins = [basin(far_jump[0], MAXIMUM, no_bound), basin(far_jump[1], JUMP, no_bound)]
    assert basins[0] is far_jump[0]
    found = mode_weights(log_prob, far_jump, lower, upper, np.random.default_rng(1), basins=basins)
    share = np.exp(found[1].log_mass - np.logaddexp(found[0].log_mass, found[1].log_mass))
    assert share < 1e-4
    assert found[0].log_mass == pytest.approx(np.log(2.0 * np.pi), abs=0.05)
    by_models = mode_weights(log_prob, far_jump, lower, upper, np.random.default_rng(1))
    reached = [np.exp(m.log_mass - np.logaddexp(by_models[0].log_mass, by_models[1].log_mass)) for m in by_models]
    assert reached[1] > 0.1  # what was taken for its share
    assert found[1].log_reach == by_models[1].log_mass


def maxima_with_a_jump(problem):
    """The maximum of the problem, and the same 7.9 standard deviations away as a jump that points at it."""
    found = fmu.find_map(problem, starts=8)
    top = found[0]
    root = np.linalg.cholesky(np.linalg.inv(top.hessian))
    direction = np.zeros(problem.ndim)
    direction[0] = 1.0
    gradient = -7.4 * np.linalg.solve(root.T, direction)
    jump = replace(
        top, theta=top.theta + 7.9 * root @ direction, log_prob=top.log_prob - 26.0, gradient=gradient, starts=1,
        share=0.0, kind=JUMP, slope=7.4, weight=0.18,
    )  # fmt: skip
    return replace(found, maxima=(top, jump))


def test_draws_of_the_maximum_are_not_those_of_a_jump(problem):
    maxima = maxima_with_a_jump(problem)
    theta = np.random.default_rng(3).multivariate_normal(maxima[0].theta, np.linalg.inv(maxima[0].hessian), 2000)
    owner = draws_of_maxima(theta, problem.log_prob(theta), maxima)
    assert np.all(owner == 0)


def test_a_jump_is_named(problem, tmp_path):
    maxima = maxima_with_a_jump(problem)
    assert [maxima.title(k) for k in range(2)] == ["maximum 1", "jump 2"]
    (said,) = maxima.no_maxima()
    assert said == (
        "Jump 2 is no maximum: the log-probability rises by 7.4 per posterior standard deviation up to a jump "
        "down, where computed modes swap or coincide."
    )
    assert "jump 2" in str(maxima)
    assert " ".join(said.split()) in " ".join(str(maxima).split())
    dataset = maxima.to_dataset()
    again = type(maxima).from_dataset(dataset)
    assert [(m.kind, m.weight) for m in again][1] == (JUMP, 0.18)
    assert again.hash == maxima.hash
    older = dataset.drop_vars(["kind", "slope", "weight"])
    assert type(maxima).from_dataset(older)[1].kind == MAXIMUM


def test_chains_start_as_the_models_reach(problem):
    """The starts are those of a run before jumps were told apart: the same draws, bit for bit."""
    maxima = maxima_with_a_jump(problem)
    assert [m.starting_share for m in maxima] == [maxima[0].share, 0.18]


def test_the_bound_of_a_jump_keeps_its_gradient():
    scaled, model = ended(Broken(lambda x, smooth: smooth), [-1.0, 0.0], [-100.0, 3.0])
    at_bound = active_bounds(scaled, model)
    assert at_bound.tolist() == [-1.0, 0.0]
    assert basin(model, JUMP, at_bound).gradient.tolist() == [model.gradient[0], 0.0]
