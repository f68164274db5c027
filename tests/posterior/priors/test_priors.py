"""Priors: normalised over the bounds, differentiable, drawn from, and with a box that they hardly leave."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.integrate import quad
from scipy.special import log_ndtr
from scipy.stats import kstest, truncnorm

from fmu.posterior.priors.base import Normal, Uniform
from fmu.posterior.priors.one_sided import HalfNormal, LogNormal
from fmu.posterior.priors.scipy_distributions import ScaledBeta, ScipyPrior
from fmu.posterior.priors.spike_and_slab import SpikeAndSlab
from tests.gradients import assert_gradient

INF = np.inf
INTERVALS = [
    (-INF, INF),
    (-1.0, 2.0),
    (0.0, INF),
    (-INF, -3.0),
    (3.5, 3.6),
    (8.0, 9.0),
    (30.0, 31.0),
    (-45.0, -40.0),
    (200.0, INF),
    (5.0, 5.0 + 1e-6),
    (-1e-9, 1e-9),
]


@pytest.mark.parametrize(("a", "b"), INTERVALS)
@pytest.mark.parametrize("prior", [Normal(1.0), Normal(sd=2e11, mean=-3e11)], ids=["unit", "scaled"])
def test_normal_is_normalised_over_its_bounds(prior, a, b):
    """The quadrature runs over z, shifted by the largest log-density: far in the tail nothing underflows."""
    lower, upper = prior.mean + a * prior.sd, prior.mean + b * prior.sd
    nearest = min(max(0.0, a), b)
    reach = 40.0 / max(1.0, abs(nearest))
    start, stop = max(a, nearest - reach), min(b, nearest + reach)
    top = prior.log_pdf(np.array([prior.mean + nearest * prior.sd]))[0]

    def density(z):
        return np.exp(prior.log_pdf(np.array([prior.mean + z * prior.sd]))[0] - top)

    integral, _ = quad(density, start, stop, epsabs=0, epsrel=1e-10)
    log_mass = top + np.log(integral * prior.sd)
    assert prior.log_mass(lower, upper) == pytest.approx(log_mass, rel=1e-9, abs=1e-6 if b - a < 1e-5 else 1e-9)


def test_log_mass_in_closed_form():
    assert Normal(2.0, mean=1.0).log_mass(-INF, INF) == 0.0
    assert Normal(2.0, mean=1.0).log_mass(1.0, INF) == pytest.approx(np.log(0.5), rel=1e-14)
    assert Normal(2.0, mean=1.0).log_mass(81.0, INF) == pytest.approx(log_ndtr(-40.0), rel=1e-14)
    assert Normal(2.0, mean=1.0).log_mass(-INF, -79.0) == Normal(2.0, mean=1.0).log_mass(81.0, INF)
    assert Uniform().log_mass(-1.0, 3.0) == pytest.approx(np.log(4.0))


def test_log_pdf_gradient_against_differences():
    prior, x = Normal(sd=0.3, mean=1.2), np.linspace(-1, 3, 9)
    gradient = prior.log_pdf_gradient(x)[:, None]
    assert_gradient(gradient, lambda x: prior.log_pdf(x[:, 0]), x[:, None], 1e-4, rtol=1e-7, atol=1e-7)
    assert_array_equal(Uniform().log_pdf_gradient(x), np.zeros(9))
    assert_array_equal(Uniform().log_pdf(x), np.zeros(9))


@pytest.mark.parametrize(("a", "b"), INTERVALS)
def test_draws_follow_the_truncated_distribution(a, b):
    prior = Normal(sd=2e-9, mean=5e-9)
    lower, upper = prior.mean + a * prior.sd, prior.mean + b * prior.sd
    x = prior.draw(np.random.default_rng(12), 2000, lower, upper)
    assert x.shape == (2000,)
    assert np.all((x >= lower) & (x <= upper))
    z = (x - prior.mean) / prior.sd
    # 1 in 10⁴ for a correct sampler; the seed is fixed. Rounding of x in its unit is coarse in narrow intervals.
    if b - a > 1e-5:
        assert kstest(z, truncnorm(a, b).cdf).pvalue > 1e-4
    else:
        assert kstest((x - lower) / (upper - lower), "uniform").pvalue > 1e-4


def test_uniform_draws():
    x = Uniform().draw(np.random.default_rng(1), 2000, -3.0, 5.0)
    assert kstest((x + 3.0) / 8.0, "uniform").pvalue > 1e-4


def test_draws_repeat_with_the_generator():
    for prior in (Normal(1.0), Uniform()):
        first, second = (prior.draw(np.random.default_rng(5), 10, -1.0, 2.0) for _ in range(2))
        assert_array_equal(first, second)


def test_affine_coordinates_of_order_one():
    assert Normal(2.0, mean=1.0).scale(-3.0, 5.0) == (-3.0, 8.0)
    assert Normal(2.0, mean=1.0).scale(-INF, 5.0) == (1.0, 2.0)
    assert Uniform().scale(-3.0, 5.0) == (-3.0, 8.0)


@pytest.mark.parametrize(
    ("lower", "upper", "expected"),
    [
        (-INF, INF, (-7.0, 9.0)),
        (0.0, INF, (0.0, 9.0)),
        (-2.0, 3.0, (-2.0, 3.0)),
        (-100.0, 3.0, (-7.0, 3.0)),
        (21.0, INF, (21.0, 29.0)),  # beyond four standard deviations there is a box as well
        (21.0, 22.0, (21.0, 22.0)),
        (-INF, -19.0, (-27.0, -19.0)),
    ],
)
def test_box_of_a_normal_prior(lower, upper, expected):
    assert Normal(2.0, mean=1.0).box(lower, upper) == expected


def test_box_of_a_uniform_prior():
    assert Uniform().box(-1.0, 2.0) == (-1.0, 2.0)


def test_alpha_is_one_over_the_variance():
    assert Normal.from_alpha(1 / 25e-18).sd == pytest.approx(5e-9, rel=1e-14)
    assert Normal.from_alpha(4.0, mean=3.0) == Normal(0.5, mean=3.0)


def test_priors_describe_themselves():
    assert Normal(2.0, mean=1.0).as_dict() == {"distribution": "normal", "mean": 1.0, "sd": 2.0}
    assert Uniform().as_dict() == {"distribution": "uniform"}


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, INF])
def test_wrong_normals(value):
    with pytest.raises(ValueError, match=rf"^sd: must be a positive finite number \(got {value}\)$"):
        Normal(value)
    with pytest.raises(ValueError, match=rf"^alpha: must be a positive finite number \(got {value}\)$"):
        Normal.from_alpha(value)
    if not np.isfinite(value):
        with pytest.raises(ValueError, match=rf"^mean: must be a finite number \(got {value}\)$"):
            Normal(1.0, mean=value)


class TwoNormals(stats.rv_continuous):
    """One of the unit normal distribution and a wider one."""

    def _pdf(self, x, share, sd):
        return (1 - share) * stats.norm.pdf(x) + share * stats.norm.pdf(x, scale=sd)

    def _cdf(self, x, share, sd):
        return (1 - share) * stats.norm.cdf(x) + share * stats.norm.cdf(x, scale=sd)

    def _sf(self, x, share, sd):
        return self._cdf(-x, share, sd)


PAIRS = {
    "spike and slab": (SpikeAndSlab(0.2, 6.0, 2.0, 1.0), TwoNormals()(share=0.2, sd=3.0, loc=1.0, scale=2.0)),
    "half-normal": (HalfNormal(2.0, 1.0), stats.halfnorm(1.0, 2.0)),
    "log-normal": (LogNormal(2e9, 0.5), stats.lognorm(0.5, scale=2e9)),
    "log-normal, wide": (LogNormal(1e-3, 3.0), stats.lognorm(3.0, scale=1e-3)),
    "beta": (ScaledBeta(2.0, 5.0, -1.0, 3.0), stats.beta(2, 5, -1, 4)),
    "beta, an open end": (ScaledBeta(1.0, 3.0, 0.0, 7.0), stats.beta(1, 3, 0, 7)),
    "beta, infinite at its ends": (ScaledBeta(0.5, 0.7), stats.beta(0.5, 0.7)),
    "beta, narrow": (ScaledBeta(800.0, 90.0, 0.0, 2e11), stats.beta(800, 90, 0, 2e11)),
    "gumbel": (ScipyPrior(stats.gumbel_r(2.0, 3.0)), stats.gumbel_r(2.0, 3.0)),
    "gamma": (ScipyPrior(stats.gamma(1.5, scale=7e10)), stats.gamma(1.5, scale=7e10)),
    "exponential": (ScipyPrior(stats.expon(-1.0, 2.0)), stats.expon(-1.0, 2.0)),
    "student": (ScipyPrior(stats.t(df=4, loc=1e4)), stats.t(df=4, loc=1e4)),
}
TAILS = [(0.0, 1.0), (0.1, 0.4), (0.0, 1e-9), (1e-12, 1e-9), (0.3, 1.0)]


@pytest.fixture(params=list(PAIRS))
def pair(request):
    """A prior, and the same distribution of SciPy."""
    return PAIRS[request.param]


def between(reference, p, q, upper_tail):
    """Bounds between which the reference has the probability q − p, counted from one of its tails."""
    if upper_tail:
        return float(reference.isf(q)), float(reference.isf(p))
    return float(reference.ppf(p)), float(reference.ppf(q))


def test_density_against_scipy(pair):
    prior, reference = pair
    x = reference.ppf([1e-9, 1e-3, 0.2, 0.5, 0.9, 1 - 1e-6])
    assert_allclose(prior.log_pdf(x), reference.logpdf(x), rtol=1e-12, atol=1e-12)
    assert_allclose(prior.support, reference.support())


def test_gradient_against_differences(pair):
    """Six-point differences, over a hundredth of the way to the nearer end of the support."""
    prior, reference = pair
    x = reference.ppf([1e-3, 0.2, 0.5, 0.9, 0.999])
    low, high = prior.support
    h = 0.01 * np.minimum(np.minimum(x - low, high - x), reference.ppf(0.84) - reference.ppf(0.16))
    gradient, atol = prior.log_pdf_gradient(x)[:, None], 1e-7 / (reference.ppf(0.84) - x[0])
    x, h = x[:, None], h[:, None]
    assert_gradient(gradient, lambda x: reference.logpdf(x[:, 0]), x, h, order=6, rtol=1e-6, atol=atol)


@pytest.mark.parametrize("upper_tail", [False, True])
@pytest.mark.parametrize(("p", "q"), TAILS)
def test_mass_between_bounds(pair, p, q, upper_tail):
    prior, reference = pair
    lower, upper = between(reference, p, q, upper_tail)
    end = reference.sf if upper_tail else reference.cdf
    mass = abs(end(upper) - end(lower))
    # the lower end of a half-normal is the middle of a Gaussian, where a narrow interval costs digits
    tolerance = 1e-6 if isinstance(prior, HalfNormal) and not upper_tail else 1e-9
    assert prior.log_mass(lower, upper) == pytest.approx(np.log(mass), rel=tolerance, abs=tolerance)


@pytest.mark.parametrize("upper_tail", [False, True])
@pytest.mark.parametrize(("p", "q"), TAILS)
def test_draws_follow_what_the_bounds_leave(pair, p, q, upper_tail):
    prior, reference = pair
    lower, upper = between(reference, p, q, upper_tail)
    x = prior.draw(np.random.default_rng(3), 2000, lower, upper)
    assert x.shape == (2000,)
    assert np.all((x >= lower) & (x <= upper))
    if upper_tail:
        u = (reference.sf(x) - reference.sf(upper)) / (reference.sf(lower) - reference.sf(upper))
    else:
        u = (reference.cdf(x) - reference.cdf(lower)) / (reference.cdf(upper) - reference.cdf(lower))
    # 1 in 10⁴ for a correct sampler; the seed is fixed
    assert kstest(u, "uniform").pvalue > 1e-4


def test_mass_far_out_in_closed_form():
    assert HalfNormal(2.0, 1.0).log_mass(81.0, INF) == pytest.approx(np.log(2.0) + log_ndtr(-40.0), rel=1e-14)
    assert LogNormal(2.0, 0.5).log_mass(2.0 * np.exp(20.0), INF) == pytest.approx(log_ndtr(-40.0), rel=1e-12)
    assert LogNormal(2.0, 0.5).log_mass(0.0, 2.0 * np.exp(-20.0)) == pytest.approx(log_ndtr(-40.0), rel=1e-12)
    assert ScaledBeta(2.0, 3.0).log_mass(0.0, 1e-100) == pytest.approx(np.log(6.0) - 200 * np.log(10), rel=1e-12)
    upper_end = ScaledBeta(2.0, 3.0, -1.0, 0.0).log_mass(-1e-90, 0.0)
    assert upper_end == pytest.approx(np.log(4.0) - 270 * np.log(10), rel=1e-12)
    assert ScipyPrior(stats.gumbel_r()).log_mass(600.0, INF) == pytest.approx(-600.0, rel=1e-12)
    assert ScipyPrior(stats.gumbel_r()).log_mass(-INF, -5.0) == pytest.approx(-np.exp(5.0), rel=1e-12)
    assert ScipyPrior(stats.gumbel_r()).log_mass(800.0, INF) == -INF


def test_outside_the_support_and_at_its_ends_nothing_is_undefined(pair):
    """The log-density is a number or −∞ everywhere; outside it has no gradient."""
    prior, _ = pair
    low, high = prior.support
    x = np.array([e for e in (low, high) if np.isfinite(e)] + [-1e300, 0.0, 5e-324, 1e300])
    log_pdf, gradient = prior.log_pdf(x), prior.log_pdf_gradient(x)
    assert np.all(np.isfinite(log_pdf) | (log_pdf == -INF))
    assert np.all(log_pdf[(x < low) | (x > high)] == -INF)
    assert np.all(np.isnan(gradient[(x < low) | (x > high)]))
    assert np.all(np.isfinite(prior.log_pdf_gradient(prior.quantile(np.linspace(0.01, 0.99, 9), low, high))))


def test_densities_at_the_ends():
    assert HalfNormal(2.0, 1.0).log_pdf(np.array([1.0]))[0] == pytest.approx(stats.halfnorm(1, 2).logpdf(1.0))
    assert HalfNormal(2.0, 1.0).log_pdf_gradient(np.array([1.0]))[0] == 0.0
    assert_array_equal(LogNormal(1.0, 0.5).log_pdf(np.zeros(2)), [-INF, -INF])
    assert_allclose(ScaledBeta(1.0, 3.0).log_pdf(np.array([0.0, 1.0])), [np.log(3.0), -INF])
    assert_allclose(ScaledBeta(1.0, 3.0).log_pdf_gradient(np.array([0.0, 1.0])), [-2.0, np.nan])
    assert_array_equal(ScaledBeta(0.5, 0.5).log_pdf(np.array([0.0, 1.0])), [-INF, -INF])
    assert_allclose(ScipyPrior(stats.expon()).log_pdf_gradient(np.array([0.0])), [-1.0], rtol=1e-4)


def test_scale_is_half_the_central_interval(pair):
    prior, reference = pair
    offset, scale = prior.scale(*prior.support)
    assert offset == pytest.approx(reference.median())
    interval = stats.norm.cdf([-1.0, 1.0])
    assert scale == pytest.approx(0.5 * np.ptp(reference.ppf(interval)))


def test_boxes():
    assert_allclose(LogNormal(2.0, 0.5).box(0.0, INF), 2.0 * np.exp([-2.0, 2.0]))
    assert_allclose(LogNormal(2.0, 0.5).box(1.0, 3.0), (1.0, 3.0))
    assert HalfNormal(1.0, 2.0).box(2.0, INF)[0] == 2.0
    assert HalfNormal(1.0, 2.0).box(2.0, INF)[1] == pytest.approx(2.0 + stats.halfnorm.isf(stats.norm.sf(4.0)))
    low, high = ScaledBeta(1.0, 3.0).box(0.0, 1.0)
    assert low == 0.0
    assert high == pytest.approx(stats.beta(1, 3).isf(stats.norm.sf(4.0)))
    assert ScipyPrior(stats.gumbel_r()).box(-1e9, 1e9) == pytest.approx(
        stats.gumbel_r.ppf(stats.norm.cdf([-4.0, 4.0])), rel=1e-6
    )


@settings(deadline=None, max_examples=60)
@given(
    name=st.sampled_from(list(PAIRS)),
    ends=st.lists(st.floats(1e-6, 1 - 1e-6), min_size=2, max_size=2, unique=True).filter(
        lambda e: abs(e[0] - e[1]) > 1e-3
    ),
    open_below=st.booleans(),
    open_above=st.booleans(),
)
def test_whatever_the_bounds_the_box_is_finite_within_them_and_holds_the_draws(name, ends, open_below, open_above):
    prior, reference = PAIRS[name]
    lower = prior.support[0] if open_below else reference.ppf(min(ends))
    upper = prior.support[1] if open_above else reference.ppf(max(ends))
    low, high = prior.box(lower, upper)
    assert lower <= low < high <= upper
    assert np.isfinite(high - low)
    lost = np.exp(
        np.logaddexp(prior.log_mass(lower, low), prior.log_mass(high, upper)) - prior.log_mass(lower, upper)
    )
    assert lost < 7e-5
    offset, scale = prior.scale(lower, upper)
    assert lower < offset < upper
    assert 0.0 < scale <= 0.5 * (upper - lower)


@settings(deadline=None)
@given(centre=st.floats(1e-100, 1e100), ratio=st.floats(1e-6, 1e3))
def test_log_normal_by_its_moments(centre, ratio):
    """Mode m e^(−σ²), mean m e^(σ²/2), variance mean² (e^(σ²) − 1); in logarithms, for the numbers are large."""
    for make, factor in ((LogNormal.from_mode, -1.0), (LogNormal.from_mean, 0.5)):
        prior = make(centre, sd=ratio * centre)
        variance = prior.sigma**2
        assert np.log(prior.median) + factor * variance == pytest.approx(np.log(centre), rel=1e-11, abs=1e-11)
        log_sd = np.log(prior.median) + 0.5 * variance + 0.5 * np.log(np.expm1(variance))
        assert log_sd == pytest.approx(np.log(ratio * centre), rel=1e-11, abs=1e-11)


@pytest.mark.parametrize("mode", [1.3, 0.8])
def test_the_priors_of_beck_and_au(mode):
    prior = LogNormal.from_mode(mode, sd=1.0)
    reference = stats.lognorm(prior.sigma, scale=prior.median)
    assert reference.std() == pytest.approx(1.0, rel=1e-12)
    assert prior.log_pdf_gradient(np.array([mode]))[0] == pytest.approx(0.0, abs=1e-12)


def test_beta_by_its_moments():
    prior = ScaledBeta.from_mean(2.2, 0.3, low=1.0, high=4.0)
    reference = stats.beta(prior.a, prior.b, 1.0, 3.0)
    assert reference.mean() == pytest.approx(2.2, rel=1e-13)
    assert reference.std() == pytest.approx(0.3, rel=1e-13)


def test_the_other_priors_describe_themselves():
    assert HalfNormal(2.0, 1.0).as_dict() == {"distribution": "half-normal", "sd": 2.0, "at": 1.0}
    assert LogNormal(2.0, 0.5).as_dict() == {"distribution": "log-normal", "median": 2.0, "sigma": 0.5}
    beta = {"distribution": "beta", "a": 2.0, "b": 3.0, "low": 0.0, "high": 4.0}
    assert ScaledBeta(2.0, 3.0, 0.0, 4.0).as_dict() == beta
    gumbel = ScipyPrior(stats.gumbel_r(2.0, scale=3.0))
    assert repr(gumbel) == "ScipyPrior(gumbel_r(2.0, scale=3.0))"
    described = gumbel.as_dict()
    assert described.pop("quantiles") == pytest.approx(stats.gumbel_r(2, 3).ppf([0.16, 0.5, 0.84]).tolist())
    assert described == {"distribution": "scipy.stats.gumbel_r", "argument 1": 2.0, "scale": 3.0}
    json.dumps(gumbel.as_dict())


def test_histograms_are_told_apart():
    rng = np.random.default_rng(0)
    one, other = (
        ScipyPrior(stats.rv_histogram(np.histogram(rng.normal(m, size=500), bins=20), density=True).freeze())
        for m in (0.0, 1.0)
    )
    assert one.as_dict() != other.as_dict()
    assert one.log_mass(*one.support) == pytest.approx(0.0, abs=1e-12)


NO_SCIPY = (
    r"distribution: must be a frozen distribution, such as "
    r"scipy\.stats\.gumbel_r\(loc=2\.0\) or rv_histogram\(h\)\(\)"
)
BROKEN = [
    (lambda: HalfNormal(0.0), r"sd: must be a positive finite number \(got 0\.0\)"),
    (lambda: HalfNormal(1.0, INF), r"at: must be a finite number \(got inf\)"),
    (lambda: LogNormal(-1.0, 1.0), r"median: must be a positive finite number \(got -1\.0\)"),
    (lambda: LogNormal(1.0, INF), r"sigma: must be a positive finite number \(got inf\)"),
    (lambda: LogNormal.from_mode(0.0, 1.0), r"mode: must be a positive finite number \(got 0\.0\)"),
    (lambda: LogNormal.from_mode(1.0, -1.0), r"sd: must be a positive finite number \(got -1\.0\)"),
    (lambda: LogNormal.from_mean(np.nan, 1.0), r"mean: must be a positive finite number \(got nan\)"),
    (lambda: ScaledBeta(0.0, 1.0), r"a: must be a positive finite number \(got 0\.0\)"),
    (lambda: ScaledBeta(1.0, INF), r"b: must be a positive finite number \(got inf\)"),
    (lambda: ScaledBeta(1.0, 1.0, 2.0, 1.0), r"high: must exceed low 2 \(got 1\)"),
    (lambda: ScaledBeta(1.0, 1.0, -INF, 1.0), r"low: must be a finite number \(got -inf\)"),
    (lambda: ScaledBeta.from_mean(3.0, 1.0, 0.0, 2.0), r"mean: must lie between low 0 and high 2 \(got 3\)"),
    (
        lambda: ScaledBeta.from_mean(1.0, 1.0, 0.0, 2.0),
        r"sd: must be below 1, the limit for a beta with this mean \(got 1\)",
    ),
    (lambda: SpikeAndSlab(1.0), r"share: must lie between 0 and 1 \(got 1\.0\)"),
    (lambda: SpikeAndSlab(0.1, 0.01), r"spike: must be narrower than the slab, sd 0\.01 \(got 0\.01\)"),
    (lambda: ScipyPrior("normal"), NO_SCIPY + r" \(got 'normal'\)"),
    (lambda: ScipyPrior(stats.norm), NO_SCIPY + r" \(got .*\)"),
    (lambda: ScipyPrior(stats.Normal(mu=1.0, sigma=2.0)), NO_SCIPY + r" \(got Normal\(.*"),
    (lambda: ScipyPrior(stats.poisson(3.0)), NO_SCIPY + r" \(got .*\)"),
    (
        lambda: ScipyPrior(stats.gumbel_r(scale=-1.0)),
        r"distribution: its arguments must be numbers in range \(got ScipyPrior\(gumbel_r\(scale=-1\.0\)\)\)",
    ),
    (
        lambda: ScipyPrior(stats.norm([1.0, 2.0, 3.0])),
        r"distribution: its arguments must be numbers in range \(got .*",
    ),
]


@pytest.mark.parametrize(("make", "message"), BROKEN)
def test_broken_priors(make, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        make()
