"""Values of frequency response functions that are not used in updating test the updated model."""

import numpy as np
import pytest
from scipy.stats import chi2

import fmu
from fmu.analysis.fit.check import HELD_OUT
from fmu.analysis.fit.checks import checks_of
from fmu.analysis.frf.predictions import _distance, frf_groups
from tests.measured_frfs import LINES, building, modes, parameters, ratios, simulate

SOME = (LINES > 4.0) & (LINES < 7.0)


def update(data, draws=100, **options):
    own = fmu.FRFErrors(data, fmu.ModalDamping(ratios()), **options)
    problem = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    maxima = fmu.find_map(problem, starts=4)
    return problem, fmu.sample(problem, "mixture", draws=draws, warmup=60, seed=3, maxima=maxima)


@pytest.fixture(scope="module")
def by_lines():
    return update(simulate(use=~SOME))


def test_lines_between_used_ones_are_predicted_and_tested(by_lines):
    _, trace = by_lines
    group = trace["frfs"].to_dataset()
    assert np.array_equal(group["held_out"].to_numpy().astype(bool), np.tile(SOME, (2, 1)))
    assert np.array_equal(group["held_freedom"], [2 * SOME.sum()] * 2)
    share = group["held_inside"].sum() / group["held_freedom"].sum() * 2
    assert 0.8 < share < 0.98  # 90 % of 92 values
    held = [check for check in checks_of(trace) if check.kind == HELD_OUT]
    assert len(held) == 2
    assert not any(check.failed for check in held)
    assert "not contradicted" in str(fmu.diagnose(trace))


def test_lines_beyond_those_in_use_are_not_tested():
    _, trace = update(simulate(band=(2.0, 8.0)), draws=20)
    assert not trace["frfs"]["held_freedom"].to_numpy().any()
    outside = (LINES < 2.0) | (LINES > 8.0)
    amplitude = trace["frfs"]["amplitude"].to_numpy()
    assert np.array_equal(np.isnan(amplitude[0, 0, 0]), outside)


def test_a_wrong_sensor_that_is_held_out_contradicts_the_model():
    use = np.repeat([[True], [False]], len(LINES), axis=1)
    data = simulate(distort=lambda H, w: H * np.array([[1.0], [1.1]]), use=use)
    _, trace = update(data, draws=50)
    (held,) = [check for check in checks_of(trace) if check.kind == HELD_OUT]
    assert held.failed
    assert "FRF 0 x / 2 x" in held.sentence
    assert "contradicted by" in str(fmu.diagnose(trace))


def test_the_squares_are_chi_square_for_data_of_the_posterior(by_lines):
    problem, trace = by_lines
    draws = np.array([trace["posterior"][name].to_numpy().ravel() for name in problem.names]).T
    rng, data = np.random.default_rng(5), simulate(use=~SOME)
    (term,) = problem.likelihood.responses
    H = term.with_use(np.ones((2, len(LINES)), dtype=bool)).frfs(draws)
    p = []
    for i in range(24):
        values = np.asarray(data.values).copy()
        values[:, SOME] = (H[i * 16] + data.standard_deviation * _noise(rng))[:, SOME]
        own = fmu.FRFErrors(_replaced(data, values), fmu.ModalDamping(ratios()))
        other = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
        group = frf_groups(other, draws[None, ::8], rng)["frfs"]
        p += chi2.sf(group["held_squares"].to_numpy(), group["held_freedom"].to_numpy()).tolist()
    # 48 uniform numbers, of which two of an FRF pair are nearly independent: bounds of 4 standard errors
    assert abs(np.mean(p) - 0.5) < 4 * np.sqrt(1 / 12 / 48)
    assert np.min(p) > 1e-5


def test_the_distance_of_gaussian_errors_is_that_of_their_covariance():
    rng = np.random.default_rng(0)
    mean, A = rng.standard_normal(12), rng.standard_normal((12, 4))
    expected = mean @ np.linalg.solve(np.eye(12) + A @ A.T, mean)
    np.testing.assert_allclose(_distance(mean, A, np.full(6, np.inf)), expected, rtol=1e-12)


@pytest.mark.parametrize(("nu", "lines", "scatter"), [(4.0, 20, 0.3), (4.0, 20, 10.0), (18.0, 100, 3.0)])
def test_students_noise_beside_the_scatter_of_parameters_gives_uniform_probabilities(nu, lines, scatter):
    """Two parameters, of which the truth is a draw, move the values by `scatter` times the noise."""
    rng, n, p = np.random.default_rng(1), 800, []
    for _ in range(n):
        A = scatter * rng.standard_normal((2 * lines, 2))
        noise = rng.standard_normal((2, lines)) * np.sqrt(nu / rng.chisquare(nu, lines))
        mean = A @ rng.standard_normal(2) + noise.ravel()
        p.append(chi2.sf(_distance(mean, A, np.full(lines, nu)), 2 * lines))
    for level in (0.05, 0.005, 0.001):
        assert abs(np.sum(np.array(p) < level) - n * level) < 5 * np.sqrt(n * level)


def _noise(rng):
    return rng.standard_normal((2, len(LINES))) + 1j * rng.standard_normal((2, len(LINES)))


def _replaced(data, values):
    return fmu.FRFData(
        data.frequencies_hz, values, data.drives, data.responses, data.kind, data.standard_deviation, use=data.used
    )
