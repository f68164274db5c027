"""Parameters that contradict themselves; what is known of all of them together."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats

import fmu
from fmu.posterior.parameters import Parameter, prior_in_words, share_alpha
from fmu.posterior.priors.base import Normal, Uniform
from fmu.posterior.priors.joint import JointPrior
from fmu.posterior.priors.one_sided import HalfNormal, LogNormal
from fmu.posterior.priors.scipy_distributions import ScaledBeta, ScipyPrior

INF = np.inf


def test_groups_share_their_alpha():
    parameters = [
        Parameter("a", 1.0, 0.0, 2.0, group="I"),
        Parameter("b", 1.0, 0.0, 2.0, group="A"),
        Parameter("c", 1.0, 0.0, 2.0, prior=Normal(9.0), group="other"),
        Parameter("d", 1.5, 0.0, 2.0, group="I"),
    ]
    shared = share_alpha(parameters, {"I": 4.0, "A": 100.0})
    assert [p.prior for p in shared] == [Normal(0.5), Normal(0.1), Normal(9.0), Normal(0.5)]
    assert [(p.name, p.start) for p in shared] == [("a", 1.0), ("b", 1.0), ("c", 1.0), ("d", 1.5)]
    with pytest.raises(ValueError, match=r"^alpha: every group needs a parameter \(none in \['J'\]\)$"):
        share_alpha(parameters, {"J": 4.0})


MIXED = [
    Parameter("a", 1.0, 0.0, 2.0, prior=Normal(0.7, mean=0.3)),
    Parameter("b", 0.0, -1.0, 1.0, prior=Uniform()),
    Parameter("c", 3.0, prior=Normal(2.0, mean=4.0)),
    Parameter("d", -6.0, upper=-5.0, prior=Normal(1.0)),
    Parameter("e", 1.0, 0.5, prior=LogNormal(2.0, 0.5)),
    Parameter("f", 1.0, prior=HalfNormal(3.0)),
    Parameter("g", 0.5, upper=0.9, prior=ScaledBeta(2.0, 3.0)),
    Parameter("h", 1.0, prior=ScipyPrior(stats.gumbel_r(1.0, 0.5))),
]


def test_joint_prior_is_the_product():
    theta = np.stack([p.prior.draw(np.random.default_rng(3), 6, p.lower, p.upper) for p in MIXED], axis=1)
    joint = JointPrior(MIXED)
    expected = sum(p.prior.log_pdf(theta[:, j]) - p.prior.log_mass(p.lower, p.upper) for j, p in enumerate(MIXED))
    assert_allclose(joint.log_pdf(theta), expected, rtol=1e-13)
    for j in range(len(MIXED)):
        step = np.zeros(len(MIXED))
        step[j] = 2e-5
        difference = (joint.log_pdf(theta + step) - joint.log_pdf(theta - step)) / 4e-5
        assert_allclose(joint.log_pdf_gradient(theta)[:, j], difference, rtol=1e-7, atol=1e-7)


def test_joint_prior_of_every_kind_in_a_batch_changes_no_bit():
    theta = np.stack([p.prior.draw(np.random.default_rng(3), 64, p.lower, p.upper) for p in MIXED], axis=1)
    joint = JointPrior([*MIXED, *MIXED])
    theta = np.concatenate([theta, theta[::-1]], axis=1)
    assert_array_equal(joint.log_pdf(theta), [joint.log_pdf(row[None])[0] for row in theta])
    assert_array_equal(joint.log_pdf_gradient(theta), [joint.log_pdf_gradient(row[None])[0] for row in theta])


@pytest.mark.parametrize("n", [1, 9, 30])
def test_joint_prior_of_a_batch_changes_no_bit(n):
    theta = np.random.default_rng(0).standard_normal((64, n))
    joint = JointPrior([Parameter(f"p{i}", start=0.0, prior=Normal(1.0 + i)) for i in range(n)])
    assert_array_equal(joint.log_pdf(theta), [joint.log_pdf(row[None])[0] for row in theta])
    assert_array_equal(joint.log_pdf(np.asfortranarray(theta)), joint.log_pdf(theta))


@pytest.mark.parametrize(
    ("parameter", "bounds", "dense"),
    [
        (Parameter("k", 1.0, prior=Normal(1.0)), (-INF, INF), (-INF, INF)),
        (Parameter("k", 1.0, 0.0, prior=Normal(1.0)), (0.0, INF), (0.0, INF)),
        (Parameter("k", 1.0, prior=LogNormal(1.0, 0.5)), (0.0, INF), (5e-324, INF)),
        (Parameter("k", 1.0, -1.0, 2.0, LogNormal(1.0, 0.5)), (0.0, 2.0), (5e-324, 2.0)),
        (Parameter("k", 1.0, 0.5, 2.0, LogNormal(1.0, 0.5)), (0.5, 2.0), (0.5, 2.0)),
        (Parameter("k", 1.0, prior=HalfNormal(1.0)), (0.0, INF), (0.0, INF)),
        (Parameter("k", 1.5, 0.0, prior=HalfNormal(1.0, 1.0)), (1.0, INF), (1.0, INF)),
        (Parameter("k", 1.0, prior=ScaledBeta(2.0, 1.0, 0.0, 4.0)), (0.0, 4.0), (5e-324, 4.0)),
        (
            Parameter("k", 1.0, 0.5, prior=ScaledBeta(2.0, 2.0, 0.0, 4.0)),
            (0.5, 4.0),
            (0.5, np.nextafter(4.0, 0.0)),
        ),
        (Parameter("k", 1.0, prior=ScipyPrior(stats.uniform(0.0, 3.0))), (0.0, 3.0), (0.0, 3.0)),
    ],
)
def test_a_prior_that_ends_before_the_bounds_gives_the_bounds(parameter, bounds, dense):
    assert (parameter.lower, parameter.upper) == bounds
    assert (parameter.lowest, parameter.highest) == dense


def test_a_notebook_needs_nothing_but_fmu():
    k1 = fmu.Parameter("k1", start=1.0, prior=fmu.LogNormal.from_mode(1.3, sd=1.0))
    assert (k1.lower, k1.upper) == (0.0, INF)


WRONG = {
    "empty name": ({"name": ""}, r"name: must not be empty or contain '/' \(got ''\)"),
    "slash": ({"name": "E/A"}, r"name: must not be empty or contain '/' \(got 'E/A'\)"),
    "order": ({"lower": 2.0, "upper": 2.0}, r"E\.upper: must exceed lower 2 \(got 2\)"),
    "NaN bound": ({"lower": np.nan}, r"lower: must be a number \(got nan\)"),
    "start below": ({"start": -0.1}, r"E\.start: must be finite and within \[0, 2\] \(got -0\.1\)"),
    "start NaN": ({"start": np.nan}, r"start: must be a finite number \(got nan\)"),
    "start infinite": (
        {"start": INF, "upper": INF, "prior": Normal(1.0)},
        r"start: must be a finite number \(got inf\)",
    ),
    "uniform without end": (
        {"upper": INF},
        r"E\.prior: a uniform prior needs finite bounds \(got \[0, inf\]\)",
    ),
    "no mass left by rounding": (
        {"lower": 1.0, "upper": 1.0 + 1e-15, "prior": Normal(1.0, mean=1e9)},
        r"E\.prior: must have probability between the bounds \(got none\)",
    ),
    "bounds outside the support": (
        {"lower": 2.0, "start": 3.0, "upper": 4.0, "prior": ScaledBeta(2.0, 2.0)},
        r"E\.prior: must have probability between the bounds \(got none\)",
    ),
    "start outside the support": (
        {"start": 1.5, "prior": ScaledBeta(2.0, 2.0)},
        r"E\.start: must be finite and within \[0, 1\] \(got 1\.5\)",
    ),
    "start where the prior vanishes": (
        {"start": 0.0, "prior": LogNormal(1.0, 0.5)},
        r"E\.start: must be where the prior has a density \(got 0\)",
    ),
    "no mass": (
        {"lower": 1e200, "start": 1e200, "upper": 2e200, "prior": Normal(1.0)},
        r"E\.prior: must have probability between the bounds \(got none\)",
    ),
}


@pytest.mark.parametrize("case", list(WRONG))
def test_wrong_parameters(case):
    changes, message = WRONG[case]
    with pytest.raises(ValueError, match=f"^{message}$"):
        Parameter(**({"name": "E", "start": 1.0, "lower": 0.0, "upper": 2.0} | changes))


def test_a_prior_in_words_has_all_arguments_in_the_customary_unit():
    spike = fmu.SpikeAndSlab(share=0.1, sd=2e9, spike=1e7, mean=2e11).as_dict()
    assert prior_in_words(spike, "N/m²") == "spike-and-slab, share 0.1, sd 2, spike 0.01, mean 200"
    whole = Normal(sd=20_000_000_000, mean=200_000_000_000).as_dict()
    assert prior_in_words(whole, "N/m²") == "normal, mean 200, sd 20"


def test_quantiles_in_words_are_rounded():
    settings = {"distribution": "scipy.stats.Distribution", "quantiles": [0.10666666666666666, 1e-20 / 3, 2.0]}
    assert prior_in_words(settings, "") == "scipy.stats.Distribution, quantiles [0.106667, 3.33333e-21, 2]"
