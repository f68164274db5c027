"""Scatter between groups of tests in addition to the scatter within them."""

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import fmu
from tests.gradients import assert_gradient

WITHIN, BETWEEN = fmu.HalfNormal(0.05), fmu.HalfNormal(0.1)
SPRING = fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)])


def posed(groups, distribution="normal", between=0.0, within=0.01, noise=0.001, varies=None, seed=1, **options):
    """Return a problem of a mass on a spring, f² = k/(4π²), which scatters between and within groups of tests."""
    rng, tests = np.random.default_rng(seed), []
    effects = {group: between * rng.standard_normal() for group in dict.fromkeys(groups)}
    for t, group in enumerate(groups):
        k = (1 + within * rng.standard_normal()) * (1 + effects[group])
        f = np.sqrt(k) / (2 * np.pi) * (1 + noise * rng.standard_normal())
        tests.append(fmu.Test(f"t{t}", fmu.ModalData([f], sd_hz=noise * f), group))
    varies = varies or fmu.Population(distribution, WITHIN, BETWEEN)
    parameter = fmu.Parameter("k", 1.0, 0.6, 1.6)
    return fmu.JointProblem(SPRING, tests, [parameter], varies={"k": varies}, pairing="index", **options)


@pytest.mark.parametrize("noise", [0.001, 0.1], ids=["centred", "not centred"])
@pytest.mark.parametrize("distribution", ["normal", "log-normal"])
def test_values_gradient_and_box(distribution, noise):
    problem = posed("aabbcc", distribution, noise=noise, reduction=False)
    kinds = ("mean", "sd") if distribution == "normal" else ("median", "log sd")
    assert problem.names[:3] == (*(f"k {kind}" for kind in kinds), "k sd between groups")
    assert problem.names[3:6] == tuple(f"k effect [{group}]" for group in "abc")
    assert problem.roles[4] == ("effect", 0, "b")
    theta = 0.7 * problem.start + 0.3 * problem.sample_prior(np.random.default_rng(1), 5)
    without = theta.copy()
    without[:, 2] = 0.0
    effect = (theta[:, [2]] * theta[:, 3:6])[:, [0, 0, 1, 1, 2, 2]]
    factor = 1 + effect if distribution == "normal" else np.exp(effect)
    assert_allclose(problem.values(theta)[:, :, 0], problem.values(without)[:, :, 0] * factor, rtol=1e-12)
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-4, of_largest=1e-5)
    low, high = problem.layout.box()
    values = problem.values(problem.sample_prior(np.random.default_rng(0), 1000))
    assert np.mean((values >= low) & (values <= high)) > 0.995
    rng = np.random.default_rng(3)
    scores = rng.standard_normal((5, 1))
    further = [problem.layout.of_next_test(theta, rng, scores, t, {})[:, 0] for t in (0, 3)]
    assert_allclose(further[1] / further[0], factor[:, 3] / factor[:, 0], rtol=1e-12)


@pytest.mark.parametrize("noise", [0.001, 0.1], ids=["centred", "not centred"])
@pytest.mark.parametrize("distribution", ["normal", "log-normal"])
def test_an_sd_in_each_group(distribution, noise):
    """The values beside SciPy's truncated normal distributions; a further test has the sd of its group."""
    varies = fmu.Population(distribution, WITHIN, sd_by_group=True)
    problem = posed("aababb", noise=noise, varies=varies, reduction=False)
    of_logarithm = distribution == "log-normal"
    centre, width = ("median", "log sd") if of_logarithm else ("mean", "sd")
    assert problem.names[:3] == (f"k {centre}", f"k {width} [a]", f"k {width} [b]")
    assert problem.roles[2] == ("sd", 0, "b")
    theta = 0.7 * problem.start + 0.3 * problem.sample_prior(np.random.default_rng(1), 5)
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-4, of_largest=1e-5)
    plain = problem.with_layout(problem.layout.remove_centring())
    mean = np.log(theta[:, [0]]) if of_logarithm else theta[:, [0]]
    sd, (low, high) = theta[:, [1, 1, 2, 1, 2, 2]], np.log([0.6, 1.6]) if of_logarithm else (0.6, 1.6)
    values = plain.values(theta)[:, :, 0]
    unit = scipy.stats.truncnorm.cdf(
        np.log(values) if of_logarithm else values, (low - mean) / sd, (high - mean) / sd, mean, sd
    )
    assert_allclose(unit, scipy.stats.norm.cdf(theta[:, 3:]), rtol=1e-9)
    further = [plain.layout.of_next_test(theta, None, theta[:, [k]], k - 3, {})[:, 0] for k in (3, 5)]
    assert_allclose(further, values[:, [0, 2]].T, rtol=1e-12)
    low, high = problem.layout.box()
    values = problem.values(problem.sample_prior(np.random.default_rng(0), 1000))
    assert np.mean((values >= low) & (values <= high)) > 0.995


def test_the_sd_of_each_group_is_found():
    """Twelve tests of each group; 99 % intervals hold the truth, and do not overlap."""
    rng, tests = np.random.default_rng(4), []
    for t in range(24):
        k = 1.0 + (0.01, 0.05)[t % 2] * rng.standard_normal()
        tests.append(fmu.Test(f"t{t}", fmu.ModalData([np.sqrt(k) / (2 * np.pi)], sd_hz=1e-4), "ab"[t % 2]))
    varies = {"k": fmu.Population(sd=WITHIN, sd_by_group=True)}
    problem = fmu.JointProblem(SPRING, tests, [fmu.Parameter("k", 1.0, 0.6, 1.6)], varies=varies, pairing="index")
    trace = fmu.sample(problem, draws=25, warmup=25, chains=12, seed=1)
    ends = [np.quantile(trace["posterior"][f"k sd [{g}]"].to_numpy(), (0.005, 0.995)) for g in "ab"]
    assert ends[0][0] < 0.01 < ends[0][1] < ends[1][0] < 0.05 < ends[1][1]


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ("aaaa", r"varies.k: has an sd in each group, and needs two groups or more \(got 1\)"),
        ("aaab", r"varies.k: has an sd in each group, and needs two tests or more in it \(got 1 in 'b'\)"),
        (["a", "a", "b", ""], r"tests.3.group: must be given, as the sd of k differs between groups \(got none\)"),
    ],
)
def test_groups_without_an_sd(groups, message):
    with pytest.raises(ValueError, match=message):
        posed(groups, varies=fmu.Population(sd_by_group=True))


@pytest.mark.validate
def test_both_standard_deviations_are_recovered():
    problem = posed(np.repeat(list("abcdefgh"), 3).tolist(), between=0.05)
    trace = fmu.sample(problem, draws=150, warmup=250, chains=2, seed=1)
    for name, truth in (("k sd", 0.01), ("k sd between groups", 0.05)):
        draws = trace["posterior"][name].to_numpy()
        low, high = np.quantile(draws, (0.005, 0.995))
        assert low < truth < high
        assert draws.std() < 0.5 * truth


def test_a_loss_beside_scatter_between_groups():
    scatter = fmu.Population(sd=WITHIN, between=BETWEEN)
    problem = posed("aabbcc", varies=fmu.UndatedDamage(scatter=scatter), reduction=False)
    theta = 0.7 * problem.start + 0.3 * problem.sample_prior(np.random.default_rng(1), 4)
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-4, of_largest=1e-5)


@pytest.mark.parametrize(
    ("population", "name"),
    [
        ({"sd": fmu.Uniform()}, "k sd"),
        ({"sd": WITHIN, "between": fmu.Uniform()}, "k sd between groups"),
        ({"sd": WITHIN, "correlation_time": fmu.Uniform(), "by": "day"}, "k correlation time"),
    ],
)
def test_priors_that_need_bounds_are_refused_by_name(population, name):
    tests = [
        fmu.Test(f"t{t}", fmu.ModalData([0.16], sd_hz=0.001), group, {"day": t}) for t, group in enumerate("abc")
    ]
    with pytest.raises(ValueError, match=rf"{name}: needs a prior that does not need bounds"):
        fmu.JointProblem(
            SPRING,
            tests,
            [fmu.Parameter("k", 1.0, 0.6, 1.6)],
            varies={"k": fmu.Population(**population)},
            pairing="index",
        )


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ("aabb", "needs 3 groups or more"),
        (["a", "b", "c", ""], r"tests.3.group: must be given, as k scatters between groups \(got none\)"),
    ],
)
def test_groups_that_are_too_few_or_have_no_name(groups, message):
    with pytest.raises(ValueError, match=message):
        posed(groups)
