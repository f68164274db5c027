"""Priors that hardly fit their bounds are doubted, and others are not: where each doubt turns."""

import numpy as np
import pytest
from scipy.stats import norm

import fmu
from fmu.config import read
from fmu.posterior.parameters import Parameter
from fmu.posterior.prior_doubts import fit_to_bounds, outside_bounds, prior_doubts
from fmu.posterior.priors import PRIORS, prior_of
from fmu.posterior.priors.base import Normal, Uniform
from fmu.posterior.priors.one_sided import HalfNormal, LogNormal
from fmu.posterior.priors.scipy_distributions import ScaledBeta

LOWER, UPPER = 1.7e11, 2.5e11


def modulus(prior, name="E", lower=LOWER, upper=UPPER):
    return Parameter(name, 2.4e11, lower, upper, prior, unit="N/m²")


def test_a_mean_left_out():
    (doubt,) = prior_doubts([modulus(Normal(2e10))])
    assert doubt == (
        "The prior of E is centred on 0 GPa (as it is where no mean is given), 8.5 of its standard deviations "
        "below the lower bound: the bounds, 170 to 250 GPa, hold < 0.01 % of its probability, and its median "
        "within them is 171.6 GPa. The prior presses the parameter against the lower bound, 170 GPa: centre it on "
        "the value that is expected, or move the bounds."
    )


@pytest.mark.parametrize("sd", np.geomspace(2e10, 5e12, 25))
def test_the_doubt_of_a_mean_left_out_turns_with_the_mass_between_the_bounds(sd):
    """Centred on 0 with a wider and wider sd: doubted while the bounds hold less than 5 %, or it is 1 sd away."""
    mass = norm.cdf(UPPER / sd) - norm.cdf(LOWER / sd)
    doubts = prior_doubts([modulus(Normal(sd))])
    assert bool(doubts) == (mass < 0.05 or sd < LOWER)
    assert fit_to_bounds(modulus(Normal(sd))).mass == pytest.approx(mass, rel=1e-9)


@pytest.mark.parametrize("mean", np.linspace(0.5e11, 3.9e11, 35))
def test_the_doubt_of_a_centre_outside_turns_one_sd_from_the_bounds(mean):
    sd = 5e10
    doubts = prior_doubts([modulus(Normal(sd, mean=mean))])
    assert bool(doubts) == (mean < LOWER - sd or mean > UPPER + sd)
    side = "lower" if mean < LOWER else "upper"
    assert all(f"presses the parameter against the {side} bound" in doubt for doubt in doubts)
    assert not any("no mean is given" in doubt for doubt in doubts)


@pytest.mark.parametrize("prior", [Normal(1e13, mean=2.1e11), Normal(1e13), LogNormal(2.1e11, 9.0)])
def test_a_prior_so_wide_that_only_the_bounds_say_something(prior):
    (doubt,) = prior_doubts([modulus(prior)])
    assert "much wider than the bounds" in doubt
    assert "presses" not in doubt
    assert "give a uniform prior" in doubt


@pytest.mark.parametrize(("sd", "doubted"), [(0.05, True), (7.9e6, True), (8.1e6, False), (1e10, False)])
def test_a_relative_sd_where_one_in_the_unit_of_the_parameter_is_meant(sd, doubted):
    """1e-4 of the range of 80 GPa is 8e6 N/m²; without bounds, of the centre."""
    doubts = prior_doubts([modulus(Normal(sd, mean=2.4e11))])
    assert bool(doubts) == doubted
    assert all(f"a standard deviation of {sd:.2g} N/m²".replace("e+0", "e") in doubt for doubt in doubts if sd < 1)
    assert prior_doubts([modulus(Normal(0.05, mean=2.4e11), lower=-np.inf, upper=np.inf)])
    assert not prior_doubts([modulus(Normal(2.5e7, mean=2.4e11), lower=-np.inf, upper=np.inf)])


@pytest.mark.parametrize(
    "prior",
    [
        Uniform(),
        Normal(2e10, mean=2.1e11),
        LogNormal(2.1e11, 0.1),
        HalfNormal(3e11),
        ScaledBeta(2.0, 2.0, 1e11, 3e11),
    ],
)
def test_priors_that_fit_are_not_doubted(prior):
    assert prior_doubts([modulus(prior)]) == []


def test_parameters_with_the_same_slip_share_a_sentence():
    (doubt, other) = prior_doubts([*(modulus(Normal(2e10), name) for name in "abc"), modulus(Normal(3e10), "d")])
    assert doubt.startswith("The priors of a, b and c are centred on 0 GPa (as it is")
    assert "8.5 of their standard deviations" in doubt
    assert other.startswith("The prior of d is ")


@pytest.mark.parametrize("case", fmu.cases.names())
def test_no_shipped_prior_is_doubted(case):
    path = fmu.cases.path(case)
    problem = read(path).model_copy(update={"reduction": False}).build(case, path.parent, None)
    assert prior_doubts(problem.parameters) == []


def test_what_the_priors_of_the_paper_are_is_said():
    """Centred on 0, 0.85 and 0.7 sd below the bounds, as eq. (6) has it: 9.2 % and 18 % of them are inside."""
    problem = fmu.cases.load("cantilever-young")
    assert outside_bounds(problem.configuration()["parameters"]) == [
        "The priors of E1, E2, E3, E4 and E5 are centred on 0 GPa, outside the bounds, which hold 9.2 % of their "
        "probability; their median within them is 205.9 GPa."
    ]
    assert 100 * (norm.cdf(1.25) - norm.cdf(0.85)) == pytest.approx(9.2, abs=0.05)


@pytest.mark.parametrize("prior", [Uniform(), Normal(2.0, mean=1.0), HalfNormal(3.0), LogNormal(2.0, 0.1),
                                   ScaledBeta(2.0, 3.0, 0.0, 4.0)])  # fmt: skip
def test_a_prior_from_its_description(prior):
    assert prior_of(prior.as_dict()) == prior
    assert prior.as_dict()["distribution"] in PRIORS


def test_a_description_of_another_prior_is_not_known():
    assert prior_of({"distribution": "scipy.stats.gumbel_r", "quantiles": [0.0, 1.0, 2.0]}) is None


def test_a_prior_narrower_than_rounding_has_a_place():
    inside, beyond = (modulus(Normal(mean=mean, sd=1e-30)) for mean in (2.0e11, 3.0e11))
    assert fit_to_bounds(inside).outside == 0.0
    assert fit_to_bounds(beyond).outside == np.inf
    assert prior_doubts([inside, beyond])
