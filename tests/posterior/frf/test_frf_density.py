"""The density of measured frequency response functions, against formulas written out, and its gradient."""

from copy import copy

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

import fmu
from fmu.posterior.frf.likelihood import _whiten
from fmu.posterior.frf.term import FRFTerm
from tests.gradients import assert_gradient
from tests.measured_frfs import (
    LINES,
    POINTS,
    RATIOS,
    TRUTH,
    building,
    modes,
    parameters,
    problem,
    ratios,
    receptances,
    simulate,
)

THETA = np.r_[TRUTH * [1.01, 0.99, 1.02], RATIOS * 1.1]
OMEGA = 2 * np.pi * LINES


def errors(kind="accelerance"):
    """Return data, computed FRFs and their standard deviations at THETA."""
    data = simulate(kind=kind)
    H = receptances(THETA[:3], THETA[3:]) * (1j * OMEGA) ** data.power
    return np.asarray(data.values), H, np.asarray(data.sd)


def density_of(extra=(), **options):
    p = problem(**options)
    return float(p.likelihood.responses[0].terms(np.r_[THETA, extra][None])[0])


@pytest.mark.parametrize("kind", ["receptance", "mobility", "accelerance"])
def test_gaussian_errors_of_real_and_imaginary_parts(kind):
    d, H, s = errors(kind)
    expected = stats.norm.logpdf(d.real, H.real, s).sum() + stats.norm.logpdf(d.imag, H.imag, s).sum()
    assert_allclose(density_of(kind=kind), expected, rtol=1e-11)


def test_a_relative_error_of_the_model_adds_to_the_variance():
    d, H, s = errors()
    sd = np.sqrt(s**2 + (0.05 * np.abs(H)) ** 2)
    expected = stats.norm.logpdf(d.real, H.real, sd).sum() + stats.norm.logpdf(d.imag, H.imag, sd).sum()
    assert_allclose(density_of(model_sd=0.05), expected, rtol=1e-11)
    inferred = fmu.Parameter("model error", 0.1, 0.0, 1.0)
    assert_allclose(density_of([0.05], model_sd=inferred), expected, rtol=1e-11)


def test_errors_of_log_frfs_are_a_density_of_the_data():
    d, H, s = errors()
    sd = np.sqrt((s / np.abs(d)) ** 2 + 0.05**2)
    amplitude = stats.norm.logpdf(np.log(np.abs(d)), np.log(np.abs(H)), sd)
    away = np.angle(d / H)
    phase = stats.norm.logpdf(away, 0.0, sd)
    expected = np.sum(amplitude + phase - 2 * np.log(np.abs(d)))  # d log|d| dφ = d Re d Im/|d|²
    assert_allclose(density_of(scale="log", model_sd=0.05), expected, rtol=1e-11)


def test_few_hits_give_student_errors():
    hits = np.stack([np.asarray(simulate(seed=i, sd=None).values) for i in range(4)])
    data = fmu.FRFData.from_hits(LINES, hits, ((2, "x"),) * 2, POINTS)
    own = fmu.FRFErrors(data, fmu.ModalDamping(ratios()))
    p = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    d, s = np.asarray(data.values), np.asarray(data.sd)
    _, H, _ = errors()
    z = np.stack([(d - H).real, (d - H).imag], axis=-1) / s[..., None]
    own = stats.multivariate_t([0, 0], np.eye(2) * 6 / 4, df=4)  # four hits: six degrees of freedom
    expected = sum(own.logpdf(z.reshape(-1, 2))) - 2 * np.log(s).sum()
    assert_allclose(p.likelihood.responses[0].terms(THETA[None])[0], expected, rtol=1e-10)
    assert_gradient(p.log_prob_and_grad(THETA)[1], p.log_prob, THETA, 1e-5 * THETA, order=4, of_largest=1e-5)


def normal(rng, *shape):
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def of_hits(n, model_sd, seed=0, scale="linear", noise=0.02):
    """Return the problem of simulated FRFs, averaged over n hits, of a model with a relative error of 10 %."""
    rng, H = np.random.default_rng(seed), receptances()
    hits = H + np.abs(H) * (0.1 * normal(rng, *H.shape) + noise * normal(rng, n, *H.shape))
    data = fmu.FRFData.from_hits(LINES, hits, ((2, "x"),) * 2, POINTS, "receptance")
    own = fmu.FRFErrors(data, fmu.ModalDamping(ratios()), scale, model_sd)
    return fmu.UpdatingProblem(building(), modes(), parameters(), error=own)


def inferred_sd():
    return fmu.Parameter("model error", 0.03, 0.0, 1.0)


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_few_hits_and_an_error_of_the_model_have_the_freedom_of_satterthwaite(scale):
    """A bivariate Student density with m − 2 degrees of freedom and the scale V m/(m − 2)."""
    sigma = 0.05
    p = of_hits(4, inferred_sd(), scale=scale)
    (term,) = p.likelihood.responses
    d, s, H = np.asarray(term.data.values), np.asarray(term.data.sd), receptances(THETA[:3], THETA[3:])
    e, own, size, jacobian = d - H, s**2, np.abs(H) ** 2, 0.0
    if scale == "log":
        e, own, size = np.log(np.abs(d / H)) + 1j * np.angle(d / H), own / np.abs(d) ** 2, np.ones(H.shape)
        jacobian = -2 * np.log(np.abs(d)).sum()
    V = own + sigma**2 * size
    m = 6 * (V / own) ** 2
    expected = jacobian + sum(
        stats.multivariate_t([0, 0], np.eye(2) * v * k / (k - 2), df=k - 2).logpdf([x.real, x.imag])
        for x, v, k in zip(e.ravel(), V.ravel(), m.ravel(), strict=True)
    )
    theta = np.r_[THETA, sigma]
    assert_allclose(term.terms(theta[None])[0], expected, rtol=1e-10)
    assert_gradient(p.log_prob_and_grad(theta)[1], p.log_prob, theta, 1e-5 * theta, order=4, of_largest=1e-5)
    (without,) = of_hits(4, 0.0, scale=scale).likelihood.responses
    assert np.array_equal(term.terms(np.r_[THETA, 0.0][None]), without.terms(THETA[None]))


@pytest.mark.parametrize("n", [3, pytest.param(5, marks=pytest.mark.validate), 10])
def test_an_error_of_the_model_is_found_from_few_hits(n):
    """Over 12 tests: the most probable σ, and Σ r² at the true σ, which contradicts no model."""
    sigma, squares, found = np.linspace(0.04, 0.16, 121), [], []
    at = np.column_stack([np.tile(np.r_[TRUTH, RATIOS], (len(sigma), 1)), sigma])
    for seed in range(12):
        (term,) = of_hits(n, inferred_sd(), seed).likelihood.responses
        found.append(sigma[np.argmax(term.terms(at))])
        squares.append(term.squares(at[60:61], np.random.default_rng(seed)).sum())
    values = 12 * term.n_data
    assert_allclose(np.mean(found), 0.1, rtol=5 / np.sqrt(2 * values))
    assert_allclose(np.sum(squares), values, atol=5 * np.sqrt(2 * values))


def test_simulated_errors_of_few_hits_have_the_distribution_that_is_assumed():
    (term,) = of_hits(3, 0.1, noise=0.2).likelihood.responses
    theta, rng = np.r_[TRUTH, RATIOS][None], np.random.default_rng(0)
    H = np.repeat(term.frfs(theta), 50, axis=0)
    e = (term.simulate(H, theta, rng) - H) / term.error_sd(H, theta)
    p = (1 + np.abs(e) ** 2 / term.freedoms(H, theta)) ** (-term.freedoms(H, theta) / 2)
    assert_allclose(np.mean(p < 0.05), 0.05, atol=5 * np.sqrt(0.05 * 0.95 / p.size))


def test_the_information_on_an_error_of_the_model_is_that_of_students_density():
    """The mean square of the slope by log V, in the density with exponent −m/2, over its quantiles."""
    sigma = 0.1
    (term,) = of_hits(3, inferred_sd(), noise=0.2).likelihood.responses
    own, size = np.asarray(term.data.sd).ravel() ** 2, np.abs(receptances()).ravel() ** 2
    V = own + sigma**2 * size
    m = 4 * (V / own) ** 2
    q = (np.arange(4000) + 0.5) / 4000  # the probability of a larger error
    slope = m[:, None] / 2 * (1 - q ** (2 / (m[:, None] - 2))) - 1
    expected = np.sum((2 * sigma * size / V) ** 2 * np.mean(slope**2, axis=1))
    found = term.information(np.r_[TRUTH, RATIOS, sigma][None])[0, -1, -1]
    assert_allclose(found, expected, rtol=0.01)  # 4000 quantiles; 1.2 times as much without its factor


def test_the_slope_of_few_hits_has_the_variance_that_its_curvature_promises():
    """Over tests with errors of a fixed size: the variance of the gradient is the mean information."""
    rng, slopes, informations, first = np.random.default_rng(0), [], [], None
    exact = receptances()
    sd = 0.1 * np.abs(exact)
    for _ in range(200):
        noise = rng.standard_normal((5, *sd.shape)) + 1j * rng.standard_normal((5, *sd.shape))
        data = fmu.FRFData.from_hits(LINES, exact + sd * noise, ((2, "x"),) * 2, POINTS, "receptance")
        if first is None:
            damping = fmu.ModalDamping([float(ratio) for ratio in RATIOS])
            first = fmu.FRFErrors(data, damping).bind_frfs(building(), parameters())
        term = FRFTerm(data, first.model, first.channels, first.inferred, first.is_log, model_sd=0.0, settings={})
        theta = np.r_[TRUTH][None]
        slopes.append(term.terms_and_gradient(theta)[1][0])
        informations.append(term.information(theta)[0])
    ratio = np.var(slopes, axis=0) / np.mean([np.diag(one) for one in informations], axis=0)
    assert_allclose(ratio, 1.0, atol=4.5 * np.sqrt(2 / 200))  # Student's own density has 1.25 and more


@pytest.mark.parametrize(("scale", "sigma"), [("linear", 0.02), ("log", 0.01), ("linear", 0.0), ("log", 0.0)])
def test_gains_are_integrated_out_exactly(scale, sigma):
    """The integral over both gains by quadrature."""
    sd = {POINTS[0]: 0.05, POINTS[1]: 0.02}
    d, H, s = errors()
    found = density_of(scale=scale, gain_sd=tuple_of(sd), model_sd=sigma)
    expected = 0.0
    for j in range(2):
        g = np.linspace(-8 * sd[POINTS[j]], 8 * sd[POINTS[j]], 20_001)[:, None]
        if scale == "log":
            V = (s[j] / np.abs(d[j])) ** 2 + sigma**2
            e = np.log(np.abs(d[j] / H[j])) - g + 1j * np.angle(d[j] / H[j])
            constant = -2 * np.log(np.abs(d[j]))
        else:
            V = s[j] ** 2 + (sigma * np.abs(H[j])) ** 2
            e, constant = d[j] - (1 + g) * H[j], 0.0
        log_p = np.sum(-0.5 * np.abs(e) ** 2 / V - np.log(2 * np.pi * V) + constant, axis=1)
        log_p += stats.norm.logpdf(g[:, 0], 0, sd[POINTS[j]])
        top = log_p.max()
        expected += top + np.log(np.trapezoid(np.exp(log_p - top), g[:, 0]))
    assert_allclose(found, expected, rtol=1e-9)


def test_the_gain_of_a_force_is_common_to_its_frfs():
    """Integrated over the gain by quadrature, all FRFs of the force have the covariance s² I + sd² H Hᵀ."""
    d, H, s = (one.ravel() for one in errors())
    d, H, s = np.r_[d.real, d.imag], np.r_[H.real, H.imag], np.r_[s, s]
    sd = 0.05
    term = problem(force_gain_sd=sd).likelihood.responses[0]
    assert term.inferred[-1].name == "gain error of force 2 x"
    g = np.linspace(-8 * sd, 8 * sd, 4001)
    log_p = term.terms(np.column_stack([np.tile(THETA, (len(g), 1)), g])) + stats.norm.logpdf(g, 0, sd)
    top = log_p.max()
    white, along = (d - H) / s, sd * H / s
    A = 1.0 + along @ along
    square = white @ white - (along @ white) ** 2 / A  # Sherman and Morrison
    expected = -0.5 * (square + np.log(A) + len(d) * np.log(2 * np.pi)) - np.log(s).sum()
    assert_allclose(top + np.log(np.trapezoid(np.exp(log_p - top), g)), expected, rtol=1e-9)


class tuple_of(dict):  # noqa: N801  # a dict that the cache of problems takes
    def __hash__(self):
        return hash(tuple(self.items()))


SETTINGS = {
    "plain": {},
    "model": {"model_sd": 0.05},
    "inferred": {"model_sd": inferred_sd()},
    "gains": {"gain_sd": 0.03},
    "gains and model": {"gain_sd": 0.03, "model_sd": inferred_sd()},
    "delays": {"delay_sd": 1e-4},
    "all": {"gain_sd": 0.03, "force_gain_sd": 0.03, "delay_sd": 1e-4, "model_sd": inferred_sd()},
    "log": {"scale": "log"},
    "log with gains": {"scale": "log", "gain_sd": 0.03},
    "log with all": {
        "scale": "log",
        "gain_sd": 0.03,
        "force_gain_sd": 0.03,
        "delay_sd": 1e-4,
        "model_sd": inferred_sd(),
    },
    "modes too": {"others": (fmu.FrequencyErrors(sd=0.01),)},
    "Rayleigh": {"damping": (fmu.RayleighDamping(fmu.Parameter("alpha", 0.3, 0.0, 2.0), 1e-4),)},
    "loss factors": {
        "damping": (fmu.StructuralDamping(0.02, tuple_of({"k1": fmu.Parameter("eta", 0.03, 0.0, 0.2)})),)
    },
    "dashpot": {
        "damping": (
            fmu.RayleighDamping(0.1, 1e-4),
            fmu.Dashpot((2, "x"), fmu.Parameter("c", 800.0, 0.0, 5000.0), (0, "x")),
        )
    },
}


@pytest.mark.parametrize("name", SETTINGS)
def test_gradient_and_batches(name):
    p = problem(**SETTINGS[name])
    rng = np.random.default_rng(3)
    at = [{"delay": 3e-5, "gain ": 0.02}.get(name[:5], x) for name, x in zip(p.names, p.start, strict=True)]
    x = at * (1.0 + 0.02 * rng.standard_normal((5, p.ndim)))
    value, gradient = p.log_prob_and_grad(x)
    assert np.all(np.isfinite(value))
    assert_gradient(gradient, p.log_prob, x, 2e-5 * np.abs(x), order=4, of_largest=1e-5)
    assert np.array_equal(value, p.log_prob(x))
    alone = [p.log_prob_and_grad(one) for one in x]
    assert [float(v) for v in value] == [v for v, _ in alone]
    assert np.array_equal(gradient, [g for _, g in alone])


TOGETHER = ("all", "log with all", "Rayleigh", "loss factors", "dashpot")
"""Each kind of parameter is in one of these, most beside the others."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.validate] * (name not in TOGETHER)) for name in SETTINGS]
)
def test_information_is_the_covariance_of_the_gradient(name):
    """Over simulated data, the mean of the gradient's square is Fisher's information."""
    p = problem(**SETTINGS[name])
    term, theta = p.likelihood.responses[0], p.start[None]
    rng, slopes, of_data = np.random.default_rng(4), [], []
    H = term.frfs(theta)
    for i in range(300):
        other = copy(term)
        d = term.simulate(H, theta, rng)[0] / term._power
        other._measured, other._log_measured = d, np.log(d)
        slopes.append(other.terms_and_gradient(theta)[1][0])
        if i < 20:  # gains that are integrated out depend on the data
            of_data.append(other.information(theta)[0])
    found = np.mean(of_data, axis=0)
    covariance = np.cov(np.array(slopes).T)
    scale = np.sqrt(np.diag(found))
    live = scale > 0
    ratio = (covariance / np.outer(scale, scale).clip(1e-300))[np.ix_(live, live)]
    expected = (found / np.outer(scale, scale).clip(1e-300))[np.ix_(live, live)]
    # 300 simulations: an entry of the covariance has a standard error of about 1/√300
    assert_allclose(ratio, expected, atol=6 / np.sqrt(300))


def test_rows_of_a_long_batch_of_lines_add_up():
    """More lines than a block has: the density is the sum of those of two halves."""
    rng, lines = np.random.default_rng(0), np.linspace(1.0, 16.0, 1300)
    H = receptances(lines=lines)
    sd = 0.05 * np.abs(H)
    d = H + sd * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape))

    def term(some):
        data = fmu.FRFData(lines[some], d[:, some], ((2, "x"),) * 2, POINTS, "receptance", sd[:, some])
        p = fmu.UpdatingProblem(
            building(), modes(), parameters(), error=fmu.FRFErrors(data, fmu.ModalDamping(ratios()))
        )
        return p.likelihood.responses[0].terms_and_gradient(THETA[None])

    whole, *halves = (term(some) for some in (slice(None), slice(0, 700), slice(700, None)))
    assert_allclose(whole[0], halves[0][0] + halves[1][0], rtol=1e-12)
    assert_allclose(whole[1], halves[0][1] + halves[1][1], rtol=1e-9)


def test_residuals_have_the_information_that_unknown_other_parameters_leave():
    rng = np.random.default_rng(1)
    A, gradient = rng.standard_normal((8, 5)), rng.standard_normal(5)
    r, J = _whiten(gradient, A.T @ A, 3)
    assert_allclose(np.linalg.inv(J.T @ J), np.linalg.inv(A.T @ A)[:3, :3], rtol=1e-9)
    assert_allclose(-np.linalg.solve(J, r), np.linalg.solve(A.T @ A, gradient)[:3], rtol=1e-9)
