"""Close modes compared as the plane that they span: whatever basis of it the eigensolver returned."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import orth

import fmu
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.mac import in_span
from tests.gradients import assert_gradient
from tests.veering import SENSORS, veering_problem

TOGETHER = [fmu.MACErrors(sd=0.02, together=[("1", "2")])]


def ring(error, reduction=True):
    """Three masses in a ring: at θ = (1, 1) the upper two frequencies are one, and part all around."""
    K = [fmu.Term(1e3 * np.diag(d), p) for d, p in (([1.0, 0, 0], (1.0, 0.0)), ([0, 1.0, 0], (0.0, 1.0)))]
    links = np.array([[0.6, -0.3, -0.3], [-0.3, 0.6, -0.3], [-0.3, -0.3, 1.6]])
    model = fmu.SeparableModel([*K, fmu.Term(1e3 * links, (0.0, 0.0))], [fmu.Term(np.eye(3), (0.0, 0.0))])
    shapes = [[1.0, 0.1], [-0.8, 0.9], [-0.3, -0.9]]
    data = fmu.ModalData([6.9, 7.0], sensors=SENSORS, shapes=shapes)
    parameters = [fmu.Parameter("k1", 1.1, 0.8, 1.3), fmu.Parameter("k2", 1.0, 0.8, 1.3)]
    return fmu.UpdatingProblem.reduced(model, data, parameters, error=error, reduction=reduction)


@pytest.fixture(scope="module")
def problem():
    return ring(TOGETHER)


def test_the_mac_with_a_span():
    rng = np.random.default_rng(1)
    S, unit = rng.standard_normal((4, 6, 5)), rng.standard_normal((6, 5))
    unit /= np.linalg.norm(unit, axis=0)
    seen = in_span(ModalPrediction(np.ones((4, 5)), S), unit, ((1, 3), (0, 2)))
    for one, given in zip(seen.shapes, S, strict=True):
        for group in ([1, 3], [0, 2]):
            basis = orth(given[:, group])
            assert_allclose(one[:, group], basis @ basis.T @ unit[:, group], rtol=1e-10, atol=1e-12)
    assert_array_equal(seen.shapes[:, :, 4], S[:, :, 4])


def test_slopes_against_differences():
    rng = np.random.default_rng(2)
    S, unit, dS = rng.standard_normal((3, 6, 3)), rng.standard_normal((6, 3)), rng.standard_normal((3, 6, 3, 2))
    own = in_span(ModalPrediction(np.ones((3, 3)), S, np.zeros((3, 3, 2)), dS), unit, ((0, 2),)).shape_slopes
    for k in range(2):
        up, down = (
            in_span(ModalPrediction(np.ones((3, 3)), S + h * dS[..., k]), unit, ((0, 2),)) for h in (1e-6, -1e-6)
        )
        assert_allclose(own[..., k], (up.shapes - down.shapes) / 2e-6, rtol=1e-6, atol=1e-7)


def test_variances_and_their_slopes():
    """A surrogate's errors of both shapes reach the projected one, by the amounts of the shapes in it."""
    rng = np.random.default_rng(4)
    S, unit, dS = rng.standard_normal((3, 6, 3)), rng.standard_normal((6, 3)), rng.standard_normal((3, 6, 3, 2))
    v, dv = rng.uniform(1.0, 2.0, (3, 6, 3)), rng.standard_normal((3, 6, 3, 2))

    def projected(h):
        seen = ModalPrediction(
            np.ones((3, 3)), S + dS @ h, shape_slopes=dS, shape_variance=v + dv @ h, shape_variance_slopes=dv
        )
        return in_span(seen, unit, ((0, 2),))

    own = projected(np.zeros(2))
    for i, one in enumerate(own.shape_variance):
        a = np.linalg.lstsq(S[i][:, [0, 2]], unit[:, [0, 2]], rcond=None)[0]
        assert_allclose(one[:, [0, 2]], v[i][:, [0, 2]] @ a**2, rtol=1e-10)
        assert_array_equal(one[:, 1], v[i, :, 1])
    for k, h in enumerate(1e-6 * np.eye(2)):
        moved = (projected(h).shape_variance - projected(-h).shape_variance) / 2e-6
        assert_allclose(own.shape_variance_slopes[..., k], moved, rtol=1e-6, atol=1e-6)


def test_shapes_may_turn_within_their_span(problem):
    """On a circle of 10⁻⁶ around (1, 1) the two shapes make half a turn; the span does not notice."""
    angle = np.linspace(0.0, 2.0 * np.pi, 17)
    circle = 1.0 + 1e-6 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.ptp(problem.log_prob(circle)) < 1e-3
    assert np.ptp(ring([fmu.MACErrors(sd=0.02)]).log_prob(circle)) > 10.0


@pytest.mark.parametrize("reduction", [True, False], ids=["reduced", "full"])
def test_gradient_with_steps_far_greater_than_the_gap(reduction):
    theta = np.array([[1.0 + 1e-7, 1.0], [1.0, 1.0 + 1e-5], [1.01, 1.01], [0.95, 1.1]])
    problem = ring(TOGETHER, reduction)
    assert_gradient(problem.log_prob_and_grad(theta)[1], problem.log_prob, theta, 1e-3, order=4, of_largest=1e-6)


def test_repeated_modes_have_a_gradient(problem):
    """To the last bit: a reduced model leaves out what turns in the plane."""
    theta = np.array([1.0, 1.0])
    assert_gradient(problem.log_prob_and_grad(theta)[1], problem.log_prob, theta, 1e-3, order=4, of_largest=1e-6)


def test_rows_do_not_depend_on_their_batch(problem):
    theta = problem.sample_prior(np.random.default_rng(3), 11)
    assert_array_equal(problem.log_prob(theta), [problem.log_prob(point) for point in theta])
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_array_equal(gradient, [problem.log_prob_and_grad(point)[1] for point in theta])


def test_shapes_that_are_one_at_the_sensors():
    S = np.ones((1, 4, 2))
    unit = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    seen = in_span(ModalPrediction(np.ones((1, 2)), S), unit, ((0, 1),))
    assert_allclose(seen.shapes, 0.25, rtol=1e-6)


def test_from_a_file(tmp_path):
    path = tmp_path / "together.toml"
    path.write_text("""
name = "pair"
[[error]]
of = "mac"
sd = 0.02
together = [["low", "high"]]
[model]
type = "matrices"
dofs = [["a", "x"], ["b", "x"], ["c", "x"]]
[[model.stiffness]]
matrix = [[1000.0, -10.0, 0.0], [-10.0, 1000.0, -10.0], [0.0, -10.0, 5000.0]]
powers = { k = 1 }
[[model.mass]]
matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
[measurement]
frequencies = [5.0, 5.1]
labels = ["low", "high"]
sensors = [["a", "x"], ["b", "x"], ["c", "x"]]
shapes = [[1.0, -0.1, 0.0], [0.1, 1.0, 0.01]]
[[parameters]]
name = "k"
start = 1.0
lower = 0.5
upper = 2.0
""")
    assert fmu.load(path).likelihood.as_dict()["errors"][0]["together"] == [[0, 1]]
    path.write_text(path.read_text().replace('["low", "high"]]\n[model]', '["low", "top"]]\n[model]'))
    with pytest.raises(ValueError, match=r"together: must name measured modes, low, high \(got 'top'\)"):
        fmu.load(path)


@pytest.mark.parametrize(
    ("together", "message"),
    [
        ([("1", "3")], r"^together: must name measured modes, 1, 2 \(got '3'\)$"),
        ([("1", "1")], r"^together: must name no mode twice \(got \['1', '1'\]\)$"),
        (
            [("1",)],
            r"^together: a group must be of 2 modes or more, and fewer than the 3 sensors \(got \['1'\]\)$",
        ),
    ],
)
def test_groups_that_make_no_sense(together, message):
    with pytest.raises(ValueError, match=message):
        veering_problem(error=[fmu.MACErrors(sd=0.1, together=together)])


def test_soft_pairing_has_no_groups():
    with pytest.raises(ValueError, match=r"^pairing: soft needs errors that are independent from mode to mode"):
        veering_problem(pairing="soft", error=TOGETHER)


def test_groups_beside_errors_of_frequencies():
    frequencies = fmu.FrequencyErrors("absolute", sd=0.1)
    theta = np.array([[1.05, 0.95]])
    both, each = ring([frequencies, *TOGETHER]), (ring([frequencies]), ring(TOGETHER))
    assert_allclose(both.log_likelihood(theta), sum(one.log_likelihood(theta) for one in each), rtol=1e-6)
    per_sd = both.likelihood.in_standard_deviations(np.array([6.9, 7.0]), np.array([0.1, 0.2]), both.start)
    assert_allclose(per_sd, [1.0, 2.0])
