"""Losses between a reference state and later ones."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.fit.check import POPULATION
from fmu.analysis.fit.model_fit import model_fit
from fmu.analysis.trace.damage import before_and_after
from fmu.posterior.joint.joint_problem import find_mistakes
from fmu.posterior.joint.varies import way_of
from fmu.posterior.joint.varies.taken import Shared
from tests.gradients import assert_gradient
from tests.shear_building import frequencies_hz, shear_building

STOREYS = 4
NAMES = tuple(f"k{i + 1}" for i in range(STOREYS))


@pytest.fixture(scope="module")
def building():
    return shear_building(NAMES, 2e6, 1000.0, dofs=[(f"floor {i + 1}", "x") for i in range(STOREYS)])


def measured_states(building, losses, noise=0.002, seed=1):
    """Return a test of the undamaged building, and one of each state: frequencies and shapes with errors."""
    rng, found = np.random.default_rng(seed), []
    for state, loss in {"reference": np.zeros(STOREYS), **losses}.items():
        f, shapes = frequencies_hz(building, 1.0 - np.asarray(loss))
        f = f * (1 + noise * rng.standard_normal(STOREYS))
        shapes = shapes + 0.01 * rng.standard_normal(shapes.shape)
        data = fmu.ModalData(f, sensors=building.dofs, shapes=shapes, sd_hz=noise * f, shapes_sd=0.01)
        found.append(fmu.Test(state, data, group=state))
    return found


def posed(building, losses, damage, **options):
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in NAMES]
    errors = [fmu.FrequencyErrors("absolute"), fmu.ShapeErrors()]
    varies = dict.fromkeys(NAMES, damage)
    return fmu.JointProblem(
        building, measured_states(building, losses), parameters, varies=varies, error=errors, **options
    )


@pytest.mark.parametrize(
    "damage", [fmu.Damage(), fmu.Damage(fmu.SpikeAndSlab()), "group"], ids=["plain", "sparse", "group"]
)
def test_gradient_and_losses(building, damage):
    problem = posed(building, {"later": [0.2, 0.0, 0.0, 0.0], "last": [0.2, 0.0, 0.1, 0.0]}, damage)
    assert problem.layout.states == ("later", "last")
    theta = problem.sample_prior(np.random.default_rng(1), 5)
    theta[:, :4] = np.clip(theta[:, :4], 0.6, 1.4)
    values = problem.values(theta)
    assert_allclose(problem.layout.losses(theta), 1 - values[:, 1:] / values[:, :1], rtol=1e-12, atol=1e-14)
    points = 0.9 * problem.start + 0.1 * theta
    gradient = problem.log_prob_and_grad(points)[1]
    assert_gradient(gradient, problem.log_prob, points, 1e-6 * problem.scale, rtol=1e-4, of_largest=1e-5)


GROUPS = ("old", "old", "new", "repaired", "repaired")


def campaign_with(known):
    """Return two storeys, tests in `GROUPS` with k2 known in the tests with these numbers, and the parameters."""
    two, _, parameters = scattering(n=0)
    f = frequencies_hz(two, [1.0, 1.0])[0]
    tests = [
        fmu.Test(f"t{t}", fmu.ModalData(f, sd_hz=0.01 * f), group, known={"k2": known[t]} if t in known else {})
        for t, group in enumerate(GROUPS)
    ]
    return two, tests, parameters


def known_in(known, varies="group"):
    return fmu.JointProblem(*campaign_with(known), varies={"k2": varies}, pairing="index", reduction=False)


@pytest.mark.parametrize("known", [{0: 0.6}, {1: 0.6}, {0: 0.6, 3: 0.9}], ids=str)
def test_losses_are_of_tests_in_which_the_parameter_is_unknown(known):
    problem = known_in(known)
    assert problem.names == ("k1", "k2 [old]", "k2 [new]", "k2 [repaired]")
    assert_allclose(problem.layout.losses(np.array([[1.4, 1.0, 0.75, 0.8]]))[0, :, 0], [0.25, 0.2], rtol=1e-14)


def test_losses_of_a_group_in_which_the_parameter_is_known():
    problem = known_in({3: 0.9, 4: 0.9})
    assert problem.names == ("k1", "k2 [old]", "k2 [new]")
    assert_allclose(problem.layout.losses(np.array([[1.4, 1.2, 0.75]]))[0, :, 0], [0.375, 0.25], rtol=1e-14)
    reference = known_in({0: 0.8, 1: 0.8})
    assert_allclose(reference.layout.losses(np.array([[1.4, 0.6, 0.8]]))[0, :, 0], [0.25, 0.0], atol=1e-14)


@pytest.mark.parametrize("varies", ["group", fmu.Damage()], ids=["group", "damage"])
def test_a_reference_in_which_the_parameter_is_known_to_be_zero(varies):
    with pytest.raises(ValueError, match=r"reference: must have a test in which k2 is not known to be 0"):
        known_in({0: 0.0, 1: 0.0}, varies)
    _, tests, parameters = campaign_with({0: 0.0})
    assert not find_mistakes(tests, parameters, 2, {"k1": Shared(), "k2": way_of(varies)}, {}, "old")


@pytest.mark.parametrize("known", [{0: 0.8, 1: 0.8}, {2: 0.9}], ids=["reference", "later"])
def test_a_loss_needs_a_test_in_which_the_parameter_is_unknown(known):
    group = GROUPS[min(known)]
    with pytest.raises(ValueError, match=rf"^varies\.k2: needs a test of '{group}' in which k2 is unknown"):
        known_in(known, fmu.Damage())
    assert known_in(known).layout.states == ("new", "repaired")
    assert known_in({0: 0.8, 3: 0.9}, fmu.Damage()).names == ("k1", "k2", "k2 loss [new]", "k2 loss [repaired]")


def test_values_before_the_damage_are_of_tests_in_which_the_parameter_is_unknown():
    problem = known_in({0: 0.6})
    maxima = fmu.find_map(problem, starts=1)
    trace = fmu.sample(problem, "mh", draws=20, warmup=20, chains=2, seed=1, init="prior", maxima=maxima)
    before = before_and_after(trace)["before"]
    assert_allclose(before, float(trace["posterior"]["k2 [old]"].mean()), rtol=1e-12)


def test_the_damaged_storey_is_found_and_no_other(building):
    problem = posed(building, {"later": [0.0, 0.15, 0.0, 0.0]}, fmu.Damage())
    maxima = fmu.find_map(problem, starts=4)
    trace = fmu.sample(problem, draws=100, warmup=80, seed=2, maxima=maxima)
    table = fmu.damage(trace, beyond=(0.05, 0.1))
    assert list(table.index) == [("later", name) for name in NAMES] + [("later", "any")]
    assert table.loc[("later", "k2"), "P(loss > 5 %)"] > 0.99
    assert abs(table.loc[("later", "k2"), "mean"] - 0.15) < 4 * table.loc[("later", "k2"), "sd"]
    others = table.loc[[("later", name) for name in ("k1", "k3", "k4")]]
    assert others["P(loss > 5 %)"].max() < 0.2
    assert table.loc[("later", "any"), "P(loss > 10 %)"] >= table.loc[("later", "k2"), "P(loss > 10 %)"]
    with pytest.raises(ValueError, match="beyond: must be between 0 and 1"):
        fmu.damage(trace, beyond=(5.0,))
    with pytest.raises(ValueError, match="no parameter that varies between groups"):
        fmu.damage(trace.filter(lambda node: node.name != "loss"))


@pytest.mark.parametrize(
    ("prior", "start"),
    [(fmu.HalfNormal(0.2), 0.0), (fmu.ScaledBeta(2.0, 5.0), 0.2645), (fmu.LogNormal(0.1, 0.5), 0.1)],
)
def test_a_loss_starts_where_its_prior_has_a_density(building, prior, start):
    problem = posed(building, {"later": np.zeros(4)}, fmu.Damage(prior))
    (loss,) = [one for one in problem.parameters if one.name == "k2 loss [later]"]
    assert loss.start == pytest.approx(start, abs=1e-3)
    assert np.isfinite(problem.log_prob(problem.start))


def test_a_reference_that_is_no_group(building):
    with pytest.raises(ValueError, match="reference: must be the group of a test"):
        posed(building, {"later": np.zeros(4)}, fmu.Damage(), reference="none")


@pytest.mark.validate
def test_a_spike_and_slab_pulls_small_losses_to_nothing(building):
    lost = {"later": [0.0, 0.15, 0.0, 0.0]}
    tables = []
    for prior in (fmu.Normal(0.3), fmu.SpikeAndSlab(0.1, spike=0.002)):
        trace = fmu.sample(posed(building, lost, fmu.Damage(prior)), draws=200, warmup=120, seed=2)
        assert fmu.summary(trace)["rhat"].max() < 1.05
        tables.append(fmu.damage(trace, beyond=(0.01,)).loc["later"])
    plain, sparse = tables
    others = ["k1", "k3", "k4"]
    assert (sparse.loc[others, "sd"] < 0.6 * plain.loc[others, "sd"]).all()
    assert abs(sparse.loc["k2", "mean"] - plain.loc["k2", "mean"]) < 0.5 * plain.loc["k2", "sd"]
    assert sparse.loc["k2", "P(loss > 1 %)"] > 0.99


def scattering(seed=1, n=16, loss=0.08, scatter=0.02, noise=1e-3):
    """Return a campaign on two storeys, of which the lower scatters and loses a share in the second half."""
    rng, tests = np.random.default_rng(seed), []
    two = shear_building(["k1", "k2"], 2e6, 1000.0)
    for t in range(n):
        k1 = (1 + scatter * rng.standard_normal()) * (1 - loss * (t >= n // 2))
        f = frequencies_hz(two, [k1, 1.0])[0] * (1 + noise * rng.standard_normal(2))
        tests.append(fmu.Test(f"t{t}", fmu.ModalData(f, sd_hz=noise * f), "old" if t < n // 2 else "new"))
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in ("k1", "k2")]
    return two, tests, parameters


SCATTERS = {
    name: fmu.Damage(scatter=fmu.Population(name, sd=fmu.HalfNormal(0.05))) for name in ("normal", "log-normal")
}


@pytest.mark.parametrize("damage", SCATTERS.values(), ids=SCATTERS)
@pytest.mark.parametrize("noise", [0.001, 0.1], ids=["centred", "not centred"])
def test_a_loss_of_a_parameter_that_scatters(damage, noise):
    problem = fmu.JointProblem(
        *scattering(noise=noise, n=6), varies={"k1": damage}, pairing="index", reduction=False
    )
    kind = ("mean", "sd") if damage.scatter.distribution == "normal" else ("median", "log sd")
    assert problem.names[:4] == (*(f"k1 {one}" for one in kind), "k1 loss [new]", "k2")
    assert problem.names[4:] == tuple(f"k1 score [t{t}]" for t in range(6))
    assert np.all(problem.layout.drawn[0].centring > 0.1) == (noise < 0.01)
    theta = 0.7 * problem.start + 0.3 * problem.sample_prior(np.random.default_rng(1), 5)
    undamaged = theta.copy()
    undamaged[:, 2] = 0.0
    kept = np.repeat([[1.0] * 3 + [0.0] * 3], 5, axis=0) + np.outer(1 - theta[:, 2], [0.0] * 3 + [1.0] * 3)
    assert_allclose(problem.values(theta)[:, :, 0], problem.values(undamaged)[:, :, 0] * kept, rtol=1e-12)
    assert_allclose(problem.layout.losses(theta)[:, 0, 0], theta[:, 2], rtol=0)
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-6 * problem.scale, rtol=1e-4, of_largest=1e-5)
    rng = np.random.default_rng(3)
    scores = rng.standard_normal((5, 1))
    of_state = [problem.layout.of_next_test(theta, rng, scores, t, {})[:, 0] for t in (0, 5)]
    assert_allclose(of_state[1], of_state[0] * (1 - theta[:, 2]), rtol=1e-12)
    prior = problem.values(problem.sample_prior(rng, 2000))[:, :, 0]
    low, high = problem.layout.box()
    assert np.mean((prior >= low[:, 0]) & (prior <= high[:, 0])) > 0.995


def test_the_loss_of_a_parameter_that_scatters_is_recovered():
    problem = fmu.JointProblem(*scattering(n=10), varies={"k1": SCATTERS["normal"]}, pairing="index")
    trace = fmu.sample(problem, draws=20, warmup=20, chains=12, seed=2)
    loss = trace["loss"]["k1"].to_numpy()
    assert abs(loss.mean() - 0.08) < 4 * loss.std()
    assert 0.5 < loss.std() / (0.02 * np.sqrt(1 / 5 + 1 / 5)) < 2.0  # of the difference of two means of 5
    table = fmu.damage(trace)
    assert table.loc[("new", "k1"), "P(loss > 5 %)"] > 0.9
    (of_k1,) = (check for check in model_fit(trace).checks if check.kind == POPULATION)
    assert not of_k1.failed  # the loss is no dependence of the population on the group


def test_a_parameter_that_scatters_needs_two_tests():
    two, tests, parameters = scattering(n=3)
    known = [fmu.Test(t.name, t.data, t.group, known={"k1": 1.0} if t.name != "t0" else {}) for t in tests]
    with pytest.raises(ValueError, match=r"varies\.k1: varies by test, and needs two tests or more"):
        fmu.JointProblem(two, known, parameters, varies={"k1": SCATTERS["normal"]}, pairing="index")


def test_derivatives_name_only_parameters_that_change_a_value():
    """No entry of a derivative stands, with the value zero, for a parameter of another kind."""
    two, tests, parameters = scattering(n=6)
    given = [None, fmu.Normal(0.5, mean=8.0), 1.0, 12.0, 20.0, 25.0]
    tests = [
        fmu.Test(one.name, one.data, one.group, {"temperature": x}) for one, x in zip(tests, given, strict=True)
    ]
    slopes = {"k1": {"temperature": fmu.Normal(0.002)}}
    problem = fmu.JointProblem(
        two, tests, parameters, varies={"k1": SCATTERS["normal"]}, slopes=slopes, pairing="index", reduction=False
    )
    theta = problem.sample_prior(np.random.default_rng(0), 3)
    kinds = [
        {problem.roles[k].kind for k in slope.columns.tolist()} for slope in problem.layout.values_of[0](theta)[1]
    ]
    assert kinds == [{"score"}, {"mean"}, {"sd"}, {"loss"}, {"slope"}, {"covariate"}]
