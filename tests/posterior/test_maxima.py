"""Local maxima from several starts, and the points where the reduced model has to be good."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.maxima import STARTS, Maximum, _is_same, local_maxima
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.reduction.region import PLAUSIBLE, plausible_points


class Squares:
    """f = (θ₀², θ₁): the sign of θ₀ cannot be told, so that there are two maxima."""

    n_parameters = n_modes = 2

    def frequencies(self, theta):
        return np.stack([theta[:, 0] ** 2, theta[:, 1]], axis=1)

    def frequencies_and_gradient(self, theta):
        slopes = np.zeros((len(theta), 2, 2))
        slopes[:, 0, 0], slopes[:, 1, 1] = 2 * theta[:, 0], 1.0
        return self.frequencies(theta), slopes


@pytest.fixture(scope="module")
def squares():
    """The prior's mean at +0.5 makes the positive maximum the higher one; θ₁ is pressed against its bound."""
    parameters = [
        Parameter("a", 1.5, -3.0, 3.0, prior=Normal(1.0, mean=0.5)),
        Parameter("b", 1.0, 0.0, 2.0, prior=Normal(1.0, mean=1.0)),
    ]
    return UpdatingProblem(Squares(), ModalData([4.0, 2.5]), parameters, beta=[2.0, 2.0])


def test_every_maximum_is_found_the_highest_first(squares):
    maxima = local_maxima(squares, starts=16)
    assert len(maxima) == 2
    assert_allclose([m.theta[0] for m in maxima], [2.0, -2.0], atol=0.05)
    assert_array_equal([m.theta[1] for m in maxima], [2.0, 2.0])
    assert maxima[0].log_prob > maxima[1].log_prob
    assert sum(m.starts for m in maxima) == 16
    for maximum in maxima:
        assert maximum.log_prob == squares.log_prob(maximum.theta)
        _, gradient = squares.log_prob_and_grad(maximum.theta)
        assert gradient[0] == pytest.approx(0.0, abs=1e-3)
        assert gradient[1] > 0.0


class Notched:
    """A flat log-probability with a valley of given width at one place of the line from 0 to 1."""

    scale, n_solves = np.ones(1), 0

    def __init__(self, at, width):
        self.at, self.width = at, width

    def log_prob(self, theta):
        self.n_solves += len(theta)
        return -1.0 * (np.abs(theta[:, 0] - self.at) < self.width)


@pytest.mark.parametrize(("at", "most"), [(16 / 32, 1), (8 / 32, 3), (24 / 32, 3), (1 / 32, 31), (31 / 32, 31)])
def test_a_valley_is_found_and_the_wide_ones_at_once(at, most):
    one, other = (Maximum(np.array([x]), 0.0, 1) for x in (0.0, 1.0))
    narrow, wide, none = Notched(at, 1e-3), Notched(at, 0.5), Notched(at, 0.0)
    assert not _is_same(narrow, one, other)
    assert narrow.n_solves <= most
    assert not _is_same(wide, one, other)
    assert wide.n_solves <= 3
    assert _is_same(none, one, other)
    assert none.n_solves == 31


def test_one_start_is_the_problems_own(squares):
    (only,) = local_maxima(squares, starts=1)
    assert only.theta[0] > 0
    assert only.starts == 1


def test_search_repeats_with_its_seed(squares):
    first, second = local_maxima(squares, starts=6, seed=3), local_maxima(squares, starts=6, seed=3)
    assert_array_equal([m.theta for m in first], [m.theta for m in second])


def test_wrong_number_of_starts(squares):
    with pytest.raises(ValueError, match=r"^starts: must be at least 1 \(got 0\)$"):
        local_maxima(squares, starts=0)


def test_plausible_points_surround_every_plausible_maximum(squares):
    points = plausible_points(squares, 40, np.random.default_rng(0))
    assert points.shape == (80, 2)
    assert np.all((points >= squares.lower) & (points <= squares.upper))
    drop = local_maxima(squares)[0].log_prob - squares.log_prob(points)
    assert np.all(drop <= PLAUSIBLE + 1e-6)
    assert np.all(drop >= -1e-6)
    assert np.max(drop) > 0.5 * PLAUSIBLE
    assert 30 < np.sum(points[:, 0] > 0) < 50  # a direction may lead across from one to the other


# Local maxima of cantilever-section by number: second moments of area in m⁴, areas in m².
SECTION_MAXIMA = {
    "A": (3.904e-9, 7.500e-9, 9.000e-4, 5.145e-4),
    "B": (6.873e-9, 7.166e-9, 9.000e-4, 9.000e-4),
    "C": (5.534e-9, 5.425e-9, 6.913e-4, 7.073e-4),
}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.validate) for seed in (1, 2, 3))])
def test_maxima_by_number_of_the_sections_are_found_from_every_seed(load_case, seed):
    """A holds nearly all the probability, and few starts climb to it: a search that misses it is blind."""
    maxima = local_maxima(load_case("cantilever-section", "index"), seed=seed)
    for (name, theta), height in zip(SECTION_MAXIMA.items(), (-40.4, -107.9, -114.6), strict=True):
        (found,) = [m for m in maxima if np.allclose(m.theta, theta, rtol=2e-3)]
        assert found.log_prob == pytest.approx(height, abs=0.1)
        assert found.starts >= {"A": 8, "B": 40, "C": 80}[name]
    assert sum(m.starts for m in maxima) == STARTS


@pytest.mark.parametrize("case", ["cantilever-young", "cantilever-section"])
def test_by_shape_there_is_one_maximum_and_all_starts_climb_to_it(load_case, case):
    problem = load_case(case, "shape")
    (only,) = local_maxima(problem, starts=64)
    assert only.starts == 64
    if case == "cantilever-section":
        assert_allclose(only.theta, SECTION_MAXIMA["B"], rtol=2e-3)
    else:
        assert_allclose(only.theta, [1.733e11, 1.937e11, 2.392e11, 2.500e11, 1.700e11], rtol=2e-3)


@pytest.mark.parametrize(
    ("case", "pairing"),
    [
        ("cantilever-young", "shape"),
        pytest.param("cantilever-young", "index", marks=pytest.mark.validate),
        pytest.param("cantilever-section", "shape", marks=pytest.mark.validate),
        ("cantilever-section", "index"),
    ],
)
def test_no_point_around_a_maximum_is_higher(load_case, case, pairing):
    problem, rng = load_case(case, pairing), np.random.default_rng(0)
    for maximum in local_maxima(problem):
        for radius in (1e-5, 1e-4, 1e-3):
            step = radius * problem.scale * rng.standard_normal((200, problem.ndim))
            around = np.clip(maximum.theta + step, problem.lower, problem.upper)
            assert np.max(problem.log_prob(around)) < maximum.log_prob + 1e-6


class Ridge:
    """f = (10 + |θ₀ − θ₁²|, θ₁): where the first is measured below 10, the maximum sits on a curved kink."""

    n_parameters = n_modes = 2

    def frequencies(self, theta):
        x = theta[:, 0] - theta[:, 1] ** 2
        return np.stack([10.0 + np.abs(x), theta[:, 1]], axis=1)

    def frequencies_and_gradient(self, theta):
        sign = np.sign(theta[:, 0] - theta[:, 1] ** 2)
        slopes = np.zeros((len(theta), 2, 2))
        slopes[:, 0, 0], slopes[:, 0, 1], slopes[:, 1, 1] = sign, -2 * theta[:, 1] * sign, 1.0
        return self.frequencies(theta), slopes


def test_a_maximum_on_a_kink_is_found():
    parameters = [Parameter("a", 1.5, -3.0, 3.0), Parameter("b", 1.0, -3.0, 3.0)]
    problem = UpdatingProblem.reduced(Ridge(), ModalData([9.0, 1.2]), parameters, beta=[5.0, 5.0])
    maxima = local_maxima(problem, starts=32)
    assert len(maxima) < 8
    assert_allclose(maxima[0].theta, [1.44, 1.2], atol=0.02)
    assert maxima[0].log_prob > problem.log_prob([1.44, 1.2]) - 1e-3


def test_a_model_that_fails_at_some_starts_is_climbed_from_the_others(oscillators):
    parameters = [Parameter(name, 4.0, 1.0, 9.0) for name in ("a", "b")]
    problem = UpdatingProblem.reduced(
        oscillators(2, fails_above=6.0), ModalData([2.0, 2.5]), parameters, beta=50.0
    )
    (only,) = local_maxima(problem, starts=32)
    assert_allclose(only.theta, [4.0, 6.25], rtol=1e-6)
    assert 10 < only.starts < 32


def test_modal_residual_is_climbed_too(chain):
    shapes = np.array([[1.0, 0.3], [0.8, -0.6], [0.5, 0.2]])
    data = ModalData([0.1, 0.25], sensors=[(0, "x"), (1, "x"), (2, "x")], shapes=shapes)
    parameters = [Parameter(name, 1.0, 0.1, 4.0, prior=Normal(2.0, mean=1.0)) for name in ("k0", "k1")]
    problem = UpdatingProblem.reduced(chain, data, parameters, error="modal-residual", beta=30.0)
    maxima = local_maxima(problem, starts=4)
    assert sum(m.starts for m in maxima) == 4
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0.1, 4.0, 20)]), axis=-1).reshape(-1, 2)
    assert maxima[0].log_prob >= np.max(problem.log_prob(grid))


@pytest.mark.parametrize("pose", [fmu.UpdatingProblem, fmu.UpdatingProblem.reduced])
def test_a_rigid_body_motion_taken_for_a_measured_mode(pose):
    """Numbers that are given count the rigid-body motions; without any, mode 1 is the first elastic one."""
    K, M = np.array([[1.0, -1.0], [-1.0, 1.0]]), np.diag([3.0, 2.0])
    model = fmu.SeparableModel.from_terms(["k"], [(K, "k")], [M])
    parameters = [fmu.Parameter("k", 2000.0, 500.0, 4000.0)]
    first = fmu.ModalData([6.5], sd_hz=0.1, numbers=[1])
    with pytest.raises(ValueError, match="mode 1 has no frequency above 0 Hz"):
        fmu.find_map(pose(model, first, parameters, pairing="index"), starts=4)
    for numbers in ([2], []):
        data = fmu.ModalData([6.5], sd_hz=0.1, numbers=numbers)
        found = fmu.find_map(pose(model, data, parameters, pairing="index"), starts=4)
        assert_allclose(found[0].theta, (2 * np.pi * 6.5) ** 2 / (1 / 3 + 1 / 2), rtol=1e-3)
