"""Errors of frequencies and shapes, with standard deviations inferred: one log-probability still."""

import emcee
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.posterior.errors.likelihood import ModalLikelihood
from tests.gradients import assert_gradient
from tests.shear_building import shear_building

TRUTH = np.array([1.1, 0.9])
SENSORS = ((0, "x"), (2, "x"), (3, "x"))
MODES = 4
SIGMA_F, SIGMA_S = 0.01, 0.03
SLICE = fmu.Slice(scheme="coordinate")  # slices in all directions at once seldom leave a sigma f near 0


def storeys():
    """Four storeys; the stiffnesses of the lower and the upper two are the parameters, in units of 1000 N/m.

    There are more modes than parameters: where a model can fit all of them, errors of no size at all are most
    probable.
    """
    return shear_building(["k1", "k1", "k2", "k2"], 1e3, [1.0, 1.5, 1.2, 0.8])


def measured(rng):
    model = fmu.UpdatingProblem(
        storeys(), fmu.ModalData([1.0, 2.0, 3.0, 4.0], sensors=SENSORS), parameters()
    ).model
    seen = model.observed(TRUTH[None])
    shapes = seen.shapes[0] / np.linalg.norm(seen.shapes[0], axis=0) + SIGMA_S * rng.standard_normal((3, MODES))
    return fmu.ModalData(
        seen.frequencies[0] * (1 + SIGMA_F * rng.standard_normal(MODES)), sensors=SENSORS, shapes=shapes
    )


def parameters():
    return [fmu.Parameter(f"k{k}", start=1.0, prior=fmu.LogNormal(1.0, 0.3)) for k in (1, 2)]


@pytest.fixture(scope="module")
def problem():
    sigma = fmu.Parameter("sigma f", start=0.02, prior=fmu.HalfNormal(0.05))
    tau = fmu.Parameter("sigma s", start=0.05, lower=1e-3, upper=0.5)
    errors = [fmu.FrequencyErrors("relative", sd=sigma), fmu.ShapeErrors(sd=tau)]
    return fmu.UpdatingProblem.reduced(storeys(), measured(np.random.default_rng(1)), parameters(), error=errors)


def test_standard_deviations_are_parameters(problem):
    assert isinstance(problem.likelihood, ModalLikelihood)
    assert problem.names == ("k1", "k2", "sigma f", "sigma s")
    assert (problem.ndim, problem.n_structural) == (4, 2)
    theta = np.array([[1.0, 1.1, 0.02, 0.03], [1.0, 1.1, 0.04, 0.05]])
    assert_array_equal(*problem.frequencies(theta))
    assert np.diff(problem.log_prob(theta))[0] != 0
    outside = [[1.0, 1.0, -0.01, 0.1], [1.0, 1.0, 0.01, 0.6]]
    assert_array_equal(problem.log_prob(outside), [-np.inf, -np.inf])


def test_gradient_against_differences(problem):
    theta = problem.sample_prior(np.random.default_rng(2), 5)
    theta[:, 2:] = np.maximum(theta[:, 2:], 0.01)
    value, gradient = problem.log_prob_and_grad(theta)
    assert_allclose(value, problem.log_prob(theta), rtol=1e-12)
    assert_gradient(gradient, problem.log_prob, theta, 1e-4 * theta, order=4, rtol=1e-6)


def test_rows_do_not_depend_on_their_batch(problem):
    theta = problem.sample_prior(np.random.default_rng(3), 9)
    assert_array_equal(problem.log_prob(theta), [problem.log_prob(row) for row in theta])


def test_maxima_are_found_and_stationary(problem):
    found = fmu.find_map(problem, starts=16)
    assert len(found) == 1
    gradient = problem.log_prob_and_grad(found[0].theta)[1] * found[0].sd
    assert_allclose(gradient, 0.0, atol=1e-3)
    assert_allclose(found[0].theta[:2], TRUTH, atol=0.1)


@pytest.mark.parametrize(
    "others",
    [{"mh": 250}, pytest.param({"slice": 75, "mh": 250, "emcee": 15}, marks=pytest.mark.validate)],
    ids=" and ".join,
)
def test_samplers_agree(problem, others):
    """Four parameters, two of them scales: the posteriors of the samplers are one."""
    maxima = fmu.find_map(problem, 8)
    options = {"warmup": 100, "chains": 16, "seed": 4, "maxima": maxima}
    traces = {
        n: fmu.sample(problem, SLICE if n == "slice" else n, draws=draws, **options)
        for n, draws in ({"hmc": 25} | others).items()
    }
    tables = {name: fmu.summary(trace) for name, trace in traces.items()}
    for name, table in tables.items():
        assert table["ess_bulk"].min() > 50, name
        error = np.hypot(table["mcse_mean"], tables["hmc"]["mcse_mean"])
        assert np.all(np.abs(table["mean"] - tables["hmc"]["mean"]) < 4.5 * error + 1e-12), name
    trace = traces["hmc"]
    assert set(trace["log_likelihood"].data_vars) == {"modes"}
    total = trace["log_likelihood"]["modes"].sum("mode") + problem.log_prior(
        np.stack([trace["posterior"][name].to_numpy() for name in problem.names], axis=-1).reshape(-1, 4)
    ).reshape(trace["sample_stats"]["lp"].shape)
    assert_allclose(total, trace["sample_stats"]["lp"], rtol=1e-9, atol=1e-9)
    assert "frequency" in trace["posterior_predictive"]
    assert list(trace["identifiability"]["parameter"].to_numpy()) == ["k1", "k2"]


def test_emcee_takes_it_as_it_is(problem):
    sampler = emcee.EnsembleSampler(20, problem.ndim, problem.log_prob, vectorize=True)
    sampler.random_state = np.random.RandomState(1).get_state()
    start = problem.start * (1 + 0.05 * np.random.default_rng(1).standard_normal((20, 4)))
    sampler.run_mcmc(start, 20)
    assert np.all(np.isfinite(sampler.get_log_prob()))


def test_the_reduced_model_is_good_enough_for_shapes_too():
    """A structure large enough to be reduced: where the posterior lives, shapes are as good as it needs."""
    n, sensors = 60, tuple((k, "x") for k in (9, 24, 39, 54))
    model = shear_building(["lower"] * (n // 2) + ["upper"] * (n // 2), 1e5)
    bounded = [fmu.Parameter(name, 1.0, 0.7, 1.3) for name in ("lower", "upper")]
    bare = fmu.UpdatingProblem(model, fmu.ModalData([1.0, 2.0, 3.0], sensors=sensors), bounded)
    seen = bare.model.observed(np.array([[1.1, 0.9]]))
    data = fmu.ModalData(seen.frequencies[0], sensors=sensors, shapes=seen.shapes[0])
    errors = [fmu.FrequencyErrors(sd=0.002), fmu.ShapeErrors(sd=0.002)]
    problem = fmu.UpdatingProblem.reduced(model, data, bounded, error=errors)
    assert problem.model.sizes
    theta = np.array([1.1, 0.9]) + 0.002 * np.random.default_rng(5).standard_normal((50, 2))
    exact = problem.with_model(problem.model.truth).likelihood.terms(theta).sum(axis=1)
    near = exact > exact.max() - 50
    assert np.sum(near) > 20
    assert_allclose(problem.log_likelihood(theta)[near], exact[near], atol=1e-3)


def test_errors_given_as_models_are_described_by_their_deviations():
    """As in the configurations of earlier versions, whose runs are exported and resumed."""
    data = fmu.ModalData([1.0, 2.0, 3.0, 4.0])
    likelihood = fmu.UpdatingProblem(
        storeys(), data, parameters(), error=fmu.FrequencyErrors("absolute", sd=0.1)
    ).likelihood
    spread = {"fixed": [0.1] * 4, "inferred": {}}
    assert likelihood.as_dict() == {"errors": [{"error": "absolute frequency", "spread": spread}], "noise": []}
    plain = fmu.UpdatingProblem(storeys(), data, parameters(), beta=2.0).likelihood
    assert plain.as_dict() == {"error": "frequency", "beta": [2.0] * 4}


def test_beta_and_error_models_exclude_each_other():
    with pytest.raises(ValueError, match=r"^beta: must not be given together with error models"):
        fmu.UpdatingProblem.reduced(
            storeys(),
            fmu.ModalData([1.0, 2.0, 3.0, 4.0]),
            parameters(),
            beta=1.0,
            error=fmu.FrequencyErrors(sd=0.1),
        )


def test_names_of_noise_and_model_must_differ():
    sigma = fmu.Parameter("k1", start=0.02, lower=0.001, upper=0.1)
    with pytest.raises(ValueError, match=r"^parameters: names must be distinct \(got twice: \['k1'\]\)$"):
        fmu.UpdatingProblem.reduced(
            storeys(), fmu.ModalData([1.0, 2.0, 3.0, 4.0]), parameters(), error=fmu.FrequencyErrors(sd=sigma)
        )


def test_a_trace_of_errors_of_shapes_alone():
    data = measured(np.random.default_rng(1))
    of_shapes = fmu.UpdatingProblem(storeys(), data, parameters(), error=fmu.ShapeErrors(sd=0.1))
    maxima = fmu.find_map(of_shapes, starts=4)
    trace = fmu.sample(of_shapes, "mh", draws=20, warmup=20, chains=2, maxima=maxima)
    assert set(trace["log_likelihood"].data_vars) == {"modes"}
    assert set(trace["posterior_predictive"].data_vars) == {"model_frequency"}
    with pytest.raises(ValueError, match="must be a distribution of the frequencies"):
        of_shapes.simulate_data(np.random.default_rng(1), np.ones((1, 4)))
