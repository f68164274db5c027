"""Scatter between groups of tests in addition to the scatter within them."""

import numpy as np
import pytest
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
    ("groups", "message"),
    [
        ("aabb", "needs 3 groups or more"),
        (["a", "b", "c", ""], r"tests.3.group: must be given, as k scatters between groups \(got none\)"),
    ],
)
def test_groups_that_are_too_few_or_have_no_name(groups, message):
    with pytest.raises(ValueError, match=message):
        posed(groups)
