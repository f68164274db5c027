"""FRFs of a model whose modes err: the density against a dense covariance, and honest intervals."""

from copy import copy
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose
from scipy import stats

import fmu
from fmu.posterior.frf.scattered import ScatteredTerm
from tests.gradients import assert_gradient
from tests.measured_frfs import (
    LINES,
    MASS,
    POINTS,
    RATIOS,
    TRUTH,
    building,
    modes,
    parameters,
    ratios,
    simulate,
)
from tests.shear_building import frequencies_hz

OMEGA = 2 * np.pi * LINES
HELD = (LINES > 8.0) & (LINES < 10.0)


INFERRED = fmu.Discrepancy("modes", sd=0.02, correlation=0.3)
KNOWN = fmu.Discrepancy("modes", sd=0.02, correlation=0.3, shape_sd=0.05)


def posed(data=None, discrepancy=INFERRED, **options):
    own = fmu.FRFErrors(data or simulate(), fmu.ModalDamping(ratios()), **options)
    return fmu.UpdatingProblem(building(), modes(), parameters(), error=own, discrepancy=discrepancy)


def point(problem, seed=0):
    rng = np.random.default_rng(seed)
    f, _ = frequencies_hz(building(), TRUTH)
    own = np.r_[TRUTH, RATIOS, f * (1 + 0.01 * rng.standard_normal(3)), 0.05]
    return own[: problem.ndim]


def test_the_density_is_that_of_a_dense_covariance():
    problem = posed()
    assert problem.names[6:] == (
        *(f"frequency of mode {k}" for k in (1, 2, 3)),
        "model error shapes",
    )
    theta = point(problem)
    f, (s, rho, shapes) = theta[6:9], (0.02, 0.3, theta[9])
    own, phi = frequencies_hz(building(), TRUTH)
    phi = phi / np.sqrt(MASS)
    wr = 2 * np.pi * f
    g = 1.0 / (wr[:, None] ** 2 - OMEGA**2 + 2j * RATIOS[:, None] * wr[:, None] * OMEGA)
    A = np.array([phi[place] * phi[2] for place, _ in POINTS])
    unit = np.sqrt(np.mean(A**2, axis=0))
    data = simulate()
    power = (1j * OMEGA) ** 2
    d, sd = np.asarray(data.values), np.asarray(data.sd)
    expected = 0.0
    for i in range(2):
        e, C = d[i] - power * (A[i] @ g), power * shapes * unit[:, None] * g
        e, C = np.r_[e.real, e.imag], np.concatenate([C.real, C.imag], axis=1)
        expected += stats.multivariate_normal.logpdf(e, cov=np.diag(np.r_[sd[i], sd[i]] ** 2) + C.T @ C)
    x = np.log(f / own)
    R = (1 - rho) * np.eye(3) + rho
    of_modes = stats.multivariate_normal.logpdf(x, cov=s**2 * R) - np.sum(np.log(f))
    width = np.sum(np.log(problem.upper[6:9] - problem.lower[6:9]))
    assert_allclose(problem.log_likelihood(theta), expected + of_modes + width, rtol=1e-9)


@pytest.mark.parametrize("discrepancy", [INFERRED, KNOWN], ids=["inferred", "known"])
def test_gradients_are_exact(discrepancy):
    problem = posed(discrepancy=discrepancy)
    theta = np.stack([point(problem, seed) for seed in (0, 1)])
    value, gradient = problem.log_prob_and_grad(theta)
    assert_allclose(value, problem.log_prob(theta), rtol=1e-12)
    assert_gradient(gradient, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-5, of_largest=1e-6)
    assert_allclose(problem.quadratic(theta)[1] + problem.prior.log_pdf_gradient(theta), gradient, rtol=1e-9)


def test_the_information_is_the_covariance_of_the_slopes():
    """Of simulated data; the errors of the modes alone add what they say of the frequencies."""
    term, theta = posed(discrepancy=KNOWN).likelihood.responses[0], point(posed(discrepancy=KNOWN))[None]
    of_data = (term.information(theta) - term.without_lines().information(theta))[0]
    drawn = copy(term)
    rng, H, at = np.random.default_rng(1), term.frfs(theta)[0] / term._power, term._at(theta)
    slopes = []
    for _ in range(400):
        noise = rng.standard_normal((2, 2 * len(LINES))) + np.einsum(
            "fr,frl->fl", rng.standard_normal((2, 3)), at.B[0]
        )
        drawn._measured = H + (noise[:, : len(LINES)] + 1j * noise[:, len(LINES) :]) * np.sqrt(term._variance)
        slopes.append(drawn.terms_and_gradient(theta)[1][0])
    root = np.linalg.cholesky(of_data[3:9, 3:9])
    found = np.linalg.solve(root, np.linalg.solve(root, np.cov(np.array(slopes)[:, 3:9].T)).T)
    assert np.all(np.abs(found - np.eye(6)) < 5 * np.sqrt(2 / 400))


def test_drawn_errors_of_residues_have_the_covariance_that_the_data_leave():
    n, precision = 20_000, np.array([[4.0, 3.0, 0.5], [3.0, 9.0, -1.0], [0.5, -1.0, 1.0]])
    given = SimpleNamespace(mean=np.ones((n, 1, 3)), precision=np.broadcast_to(precision, (n, 1, 3, 3)))
    drawn = ScatteredTerm._draw(given, np.random.default_rng(1))[:, 0]
    assert_allclose(drawn.mean(axis=0), 1.0, atol=0.05)
    assert_allclose(np.cov(drawn.T), np.linalg.inv(precision), atol=0.07)


@pytest.fixture(scope="module")
def wrong():
    """Return simulated FRFs of a building whose second floor is 10 % heavier than the model says."""
    rng, M = np.random.default_rng(0), np.diag([MASS, 1.1 * MASS, MASS])
    lam, phi = scipy.linalg.eigh(building().K(TRUTH).toarray(), M)
    g = 1.0 / (lam[:, None] - OMEGA**2 + 2j * RATIOS[:, None] * np.sqrt(lam)[:, None] * OMEGA)
    H = np.array([(phi[place] * phi[2]) @ g for place, _ in POINTS]) * (1j * OMEGA) ** 2
    sd = 0.03 * np.abs(H)
    values = H + sd * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape))
    return fmu.FRFData(LINES, values, ((2, "x"),) * 2, POINTS, "accelerance", sd, use=~HELD)


def sampled(problem):
    maxima = fmu.find_map(problem, starts=16)
    return fmu.sample(problem, "mixture", draws=300, warmup=100, seed=1, maxima=maxima)


def far(trace):
    draws = np.array([trace["posterior"][name].to_numpy().ravel() for name in ("k1", "k2", "k3")])
    return np.max(np.abs(draws.mean(axis=1) - TRUTH) / draws.std(axis=1))


def test_intervals_of_a_wrong_model_are_honest(wrong):
    trace = sampled(posed(wrong, KNOWN))
    assert far(trace) < 3.0
    diagnosis = fmu.diagnose(trace)
    assert diagnosis.converged
    assert "not contradicted" in str(diagnosis)
    group = trace["frfs"]
    inside = group["held_inside"].sum() / HELD.sum() / 2
    assert 0.75 < inside < 1.0


def test_without_errors_of_the_model_they_are_not(wrong):
    trace = sampled(posed(wrong, discrepancy=()))
    assert far(trace) > 20.0
    assert "contradicted by" in str(fmu.diagnose(trace))


@pytest.mark.parametrize(
    ("discrepancy", "options", "message"),
    [
        (fmu.Discrepancy(), {}, r'must be of kind "modes": .* \(got embedded\)'),
        (fmu.Discrepancy("modes", sd=0.02), {}, "needs sd and correlation; a band has too few modes"),
        (KNOWN, {"model_sd": 0.1}, r"needs Gaussian errors of H .* \(got model_sd\)"),
        (KNOWN, {"gain_sd": 0.1}, r"\(got gain_sd\)"),
        (KNOWN, {"scale": "log"}, r"\(got scale\)"),
        ([KNOWN, KNOWN], {}, r'must be one, of kind "modes" \(got 2\)'),
    ],
)
def test_what_it_needs(discrepancy, options, message):
    with pytest.raises(ValueError, match=message):
        posed(discrepancy=discrepancy, **options)


def test_beside_errors_of_modes_and_with_damping_that_couples_modes_it_is_refused():
    own = fmu.FRFErrors(simulate(), fmu.ModalDamping(ratios()))
    with pytest.raises(
        ValueError, match="needs errors of modes, or of frequency response functions, but not both"
    ):
        fmu.UpdatingProblem(
            building(), modes(), parameters(), error=[own, fmu.FrequencyErrors(sd=0.1)], discrepancy=KNOWN
        )
    coupled = fmu.FRFErrors(simulate(), fmu.Dashpot((2, "x"), 100.0))
    with pytest.raises(ValueError, match="damping that couples the modes"):
        fmu.UpdatingProblem(building(), modes(), parameters(), error=coupled, discrepancy=KNOWN)


def test_the_assumptions_and_the_check_say_so():
    found = fmu.check(posed(discrepancy=KNOWN), draws=50)
    assert found.parameters["changes"]["frequency of mode 2"] == "error of the model"
    said = " ".join(str(found).split())
    assert "the frequencies of 3 modes err by 2 %, with a correlation of 0.3" in said
