"""Priors: normalised over the bounds, differentiable, and drawn from."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.special import log_ndtr
from scipy.stats import kstest, truncnorm

from fmu.posterior.priors import Normal, Uniform

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
    assert Normal(2.0, 1.0).log_mass(-INF, INF) == 0.0
    assert Normal(2.0, 1.0).log_mass(1.0, INF) == pytest.approx(np.log(0.5), rel=1e-14)
    assert Normal(2.0, 1.0).log_mass(81.0, INF) == pytest.approx(log_ndtr(-40.0), rel=1e-14)
    assert Normal(2.0, 1.0).log_mass(-INF, -79.0) == Normal(2.0, 1.0).log_mass(81.0, INF)
    assert Uniform().log_mass(-1.0, 3.0) == pytest.approx(np.log(4.0))


def test_log_pdf_gradient_against_differences():
    prior, x = Normal(sd=0.3, mean=1.2), np.linspace(-1, 3, 9)
    difference = (prior.log_pdf(x + 1e-4) - prior.log_pdf(x - 1e-4)) / 2e-4
    assert_allclose(prior.log_pdf_gradient(x), difference, rtol=1e-7, atol=1e-7)
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
    assert Normal(2.0, 1.0).scale(-3.0, 5.0) == (-3.0, 8.0)
    assert Normal(2.0, 1.0).scale(-INF, 5.0) == (1.0, 2.0)
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
    assert Normal(2.0, 1.0).box(lower, upper) == expected


def test_box_of_a_uniform_prior():
    assert Uniform().box(-1.0, 2.0) == (-1.0, 2.0)


def test_alpha_is_one_over_the_variance():
    assert Normal.from_alpha(1 / 25e-18).sd == pytest.approx(5e-9, rel=1e-14)
    assert Normal.from_alpha(4.0, mean=3.0) == Normal(0.5, 3.0)


def test_priors_describe_themselves():
    assert Normal(2.0, 1.0).as_dict() == {"distribution": "normal", "mean": 1.0, "sd": 2.0}
    assert Uniform().as_dict() == {"distribution": "uniform"}


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, INF])
def test_wrong_normals(value):
    with pytest.raises(ValueError, match=rf"^sd: must be positive and finite \(got {value}\)$"):
        Normal(value)
    with pytest.raises(ValueError, match=rf"^alpha: must be positive and finite \(got {value}\)$"):
        Normal.from_alpha(value)
    if not np.isfinite(value):
        with pytest.raises(ValueError, match=rf"^mean: must be finite \(got {value}\)$"):
            Normal(1.0, mean=value)
