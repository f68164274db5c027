"""Dates and losses of sudden events without the scores: against sums over a grid, and where nothing is known."""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

import fmu
from fmu.analysis.convergence.rank_statistics import chain_ess
from fmu.posterior.joint.conditional.both import conditionals
from tests.shear_building import frequencies_hz, shear_building

TIMES = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 6.0, 7.0])
NOISE, RAMP = 0.01, 0.2
LOSS = fmu.Normal(0.1)


def storey(distribution="log-normal", prior=LOSS, noise=NOISE, grows=False):
    """Return the problem of seven tests of one storey, which scatters by 2 % and loses 5 % after the fourth."""
    rng, model = np.random.default_rng(4), shear_building(["k1"], 2e6, 1000.0)
    k = np.exp(0.02 * rng.standard_normal(7)) * np.where(TIMES > 4.0, 0.95, 1.0)
    f = np.stack([frequencies_hz(model, [one])[0] for one in k]) * (1.0 + NOISE * rng.standard_normal((7, 1)))
    tests = [fmu.Test(f"t{t}", fmu.ModalData(one), covariates={"day": TIMES[t]}) for t, one in enumerate(f)]
    scatter = fmu.Population(distribution, sd=fmu.HalfNormal(0.03))
    damage = fmu.UndatedDamage(prior, by="day", scatter=scatter, grows=grows)
    k1 = fmu.Parameter("k1", 1.0, 0.5, 1.6, prior=fmu.Normal(0.05, mean=1.0))
    error = fmu.FrequencyErrors("relative", sd=noise)
    return fmu.JointProblem(model, tests, [k1], varies={"k1": damage}, pairing="index", error=error)


def two_storeys():
    """Return the problem of seven tests of two storeys, which scatter and have a loss on one date."""
    rng, names = np.random.default_rng(5), ["k1", "k2"]
    model = shear_building(names, 2e6, 1000.0)
    k = np.exp(0.01 * rng.standard_normal((7, 2))) * np.where(TIMES[:, None] > 4.0, [0.92, 0.95], 1.0)
    f = np.stack([frequencies_hz(model, one)[0] for one in k]) * (1.0 + 0.005 * rng.standard_normal((7, 2)))
    tests = [fmu.Test(f"t{t}", fmu.ModalData(one), covariates={"day": TIMES[t]}) for t, one in enumerate(f)]
    damage = fmu.UndatedDamage(by="day", scatter=fmu.Population("log-normal", sd=fmu.HalfNormal(0.03)))
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.6, prior=fmu.Normal(0.05, mean=1.0)) for name in names]
    error = fmu.FrequencyErrors("relative", sd=0.005)
    varies = dict.fromkeys(names, damage)
    return fmu.JointProblem(model, tests, parameters, varies=varies, correlation=1.0, pairing="index", error=error)


def grid_of_dates():
    """Return dates, the probability of the interval of each, and the shares of the loss in the tests then."""
    dates, widths = [], []
    for last, time in pairwise(TIMES):
        width = time - last
        dates += [last + 0.4 * width, *(time - RAMP * width * (1.0 - (np.arange(6) + 0.5) / 6))]
        widths += [(1.0 - RAMP) * width, *[RAMP * width / 6] * 6]
    gaps = np.diff(TIMES, prepend=-np.inf)
    shares = np.clip((TIMES - np.array(dates)[:, None]) / (RAMP * gaps), 0.0, 1.0)
    return np.array(dates), np.array(widths) / np.sum(widths), shares


def moments_on_grid(problem):
    """Return means and sds of median, sd and loss, and the probability of each interval between tests.

    The frequency of the storey is √(k K/M)/2π. The score of each test is integrated out by Gauss and Hermite's
    rule, the other parameters by sums over a grid, without any approximation of fmu.
    """
    f = np.array([test.data.frequencies_hz[0] for test in problem.tests]) / (np.sqrt(2e6 / 1000.0) / (2 * np.pi))
    x, w = np.polynomial.hermite_e.hermegauss(16)
    m, s, d = np.meshgrid(
        np.linspace(0.87, 1.13, 21), (np.arange(14) + 0.5) * 0.006, np.linspace(-0.2, 0.3, 31), indexing="ij"
    )
    prior = norm.logpdf(m, 1.0, 0.05) - 0.5 * (s / 0.03) ** 2 - 0.5 * (d / 0.1) ** 2
    _dates, widths, shares = grid_of_dates()

    def by_test(share):
        k = np.sqrt(m * (1.0 - share * d))[..., None] * np.exp(0.5 * s[..., None] * x)
        log = -0.5 * ((k[..., None] / f - 1.0) / NOISE) ** 2
        return logsumexp(log + np.log(w)[:, None], axis=-2)

    known = {share: by_test(share) for share in np.unique(shares)}
    total = np.stack([sum(known[r][..., t] for t, r in enumerate(row)) + prior for row in shares])
    total += np.log(widths)[:, None, None, None]
    p = np.exp(total - logsumexp(total))
    marginal = [(p.sum(axis=0) * of).sum() for of in (m, s, d)]
    squares = [(p.sum(axis=0) * of**2).sum() for of in (m, s, d)]
    return np.array(marginal), np.sqrt(np.array(squares) - np.square(marginal)), p.sum(axis=(1, 2, 3))


def test_the_posterior_of_date_and_loss_is_that_of_a_grid():
    problem = storey()
    trace = fmu.sample(problem, fmu.GibbsSampler(step_size=0.5), draws=50, warmup=25, chains=80, seed=1)
    posterior = trace["posterior"]
    mean, sd, p = moments_on_grid(problem)
    for k, name in enumerate(("k1 median", "k1 log sd", "k1 loss")):
        drawn = posterior[name].to_numpy()
        ess = chain_ess(drawn)
        assert ess > 300, name
        assert abs(drawn.mean() - mean[k]) < 4.5 * sd[k] / np.sqrt(ess), name
        assert abs(drawn.std() / sd[k] - 1.0) < 0.15, name
    dates = posterior["day of damage"].to_numpy()
    of_gap = np.array([np.mean((dates > low) & (dates <= high)) for low, high in pairwise(TIMES)])
    expected = p.reshape(len(TIMES) - 1, -1).sum(axis=1)
    errors = np.sqrt(expected * (1.0 - expected) / chain_ess(dates))
    assert np.all(np.abs(of_gap - expected) < 4.5 * errors)
    assert np.mean(trace["sample_stats"]["dates_accepted"]) > 0.8


@pytest.mark.parametrize("pose", [two_storeys, partial(storey, "normal"), partial(storey, noise=0.003)])
@pytest.mark.usefixtures("half_centred")
def test_candidates_have_the_density_of_date_and_losses_without_scores(pose):
    problem = pose()
    known, rng = conditionals(problem), np.random.default_rng(1)
    (event,), given = known.events, known.scores
    theta = np.repeat(known.typical, 60, axis=0)
    found, ratio = event.propose(rng, given, theta, known.scales)
    assert np.all(np.isfinite(ratio))
    assert np.all(found[:, event.losses] != theta[:, event.losses])
    others = np.setdiff1d(np.arange(problem.ndim), [event.date, *event.losses])
    assert np.array_equal(found[:, others], theta[:, others])
    now, new = (given.log_evidence(given.linearise(at)).sum(axis=1) + event.log_prior(at) for at in (theta, found))
    error = new - now + ratio
    assert np.mean(np.exp(np.minimum(error, 0.0))) > 0.85


@pytest.mark.usefixtures("half_centred")
def test_the_typical_point_has_the_date_of_the_loss():
    problem = two_storeys()
    assert 4.0 < conditionals(problem).typical[0, problem.names.index("day of damage")] < 5.0


def test_the_date_of_a_growing_loss_is_a_main_parameter():
    problem = storey(grows=True)
    known = conditionals(problem)
    assert known.events == ()
    assert problem.names.index("day of damage") in known.marginal.columns
