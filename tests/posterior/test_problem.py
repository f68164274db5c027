"""The log-probability that every sampler shares."""

import emcee
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Uniform
from fmu.posterior.problem import UpdatingProblem

BOUNDED = (
    Parameter("k0", 2.0, 1.0, 4.0, prior=Normal(1.0, mean=2.0), unit="N/m"),
    Parameter("k1", 1.5, 0.5, 3.0, prior=Uniform(), unit="N/m"),
)
UNBOUNDED = (
    Parameter("k0", 2.0, prior=Normal(0.3, mean=2.0)),
    Parameter("k1", 1.5, lower=-5.0, prior=Normal(0.3, mean=1.5)),
)
MEASURED = ModalData([0.1, 0.2])


@pytest.fixture(scope="module")
def bounded(chain):
    return UpdatingProblem.reduced(chain, MEASURED, BOUNDED, beta=[50.0, 20.0], name="chain")


@pytest.fixture(scope="module")
def unbounded(chain):
    return UpdatingProblem.reduced(chain, MEASURED, UNBOUNDED, pairing="index")


def test_log_prob_is_the_sum_of_normalised_parts(bounded, chain):
    theta = bounded.sample_prior(np.random.default_rng(0), 8)
    assert_allclose(bounded.log_prob(theta), bounded.log_likelihood(theta) + bounded.log_prior(theta), rtol=1e-13)
    assert_allclose(bounded.log_likelihood(theta), bounded.log_likelihood_terms(theta).sum(axis=1), rtol=1e-13)
    for point, value in zip(theta, bounded.log_likelihood(theta), strict=True):
        lam = np.linalg.eigvals(np.linalg.solve(chain.M(point).toarray(), chain.K(point).toarray()))
        error = np.sqrt(np.sort(lam.real)[:2]) / (2 * np.pi) - [0.1, 0.2]
        beta = np.array([50.0, 20.0])
        assert value == pytest.approx(np.sum(0.5 * np.log(beta / np.pi) - beta * error**2), rel=1e-10)


def test_prior_is_normalised_over_the_box(bounded):
    x = np.linspace(1.0, 4.0, 401)
    y = np.linspace(0.5, 3.0, 11)
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    density = np.exp(bounded.log_prior(grid.reshape(-1, 2))).reshape(401, 11)
    assert np.trapezoid(np.trapezoid(density, y, axis=1), x) == pytest.approx(1.0, rel=1e-5)


def test_shapes(bounded):
    theta = bounded.start
    batch = np.stack([theta, theta, [0.0, 0.0]])
    for function in (bounded.log_prob, bounded.log_prior, bounded.log_likelihood):
        assert type(function(theta)) is float
        assert type(function(list(theta))) is float
        assert function(batch).shape == (3,)
        assert function(batch)[1] == function(theta)
        assert function(np.empty((0, 2))).shape == (0,)
    for function in (bounded.frequencies, bounded.log_likelihood_terms):
        assert function(theta).shape == (2,)
        assert function(batch).shape == (3, 2)
    value, gradient = bounded.log_prob_and_grad(theta)
    assert type(value) is float
    assert gradient.shape == (2,)
    assert value == pytest.approx(bounded.log_prob(theta), rel=1e-13)
    values, gradients = bounded.log_prob_and_grad(batch)
    assert (values.shape, gradients.shape) == ((3,), (3, 2))


@pytest.mark.parametrize("theta", [1.0, [1.0], [1.0, 2.0, 3.0], np.ones((2, 3)), np.ones((1, 1, 2))])
@pytest.mark.parametrize(
    "function", ["log_prob", "log_prob_and_grad", "log_prior", "log_likelihood", "frequencies"]
)
def test_wrong_shapes(bounded, function, theta):
    with pytest.raises(ValueError, match=r"^theta: must have shape \(2,\) or \(n, 2\) \(got \("):
        getattr(bounded, function)(theta)


def test_outside_the_bounds(bounded):
    edge, beyond = np.array([1.0, 3.0]), np.array([[0.999, 2.0], [2.0, 3.001], [-1.0, -1.0]])
    assert np.isfinite(bounded.log_prob(edge))
    assert_array_equal(bounded.log_prob(beyond), -np.inf)
    assert_array_equal(bounded.log_prior(beyond), -np.inf)
    values, gradients = bounded.log_prob_and_grad(np.vstack([beyond, edge]))
    assert_array_equal(np.isfinite(values), [False, False, False, True])
    assert_array_equal(np.isnan(gradients).any(axis=1), [True, True, True, False])
    assert np.all(np.isfinite(bounded.frequencies(beyond[:2])))
    assert np.all(np.isfinite(bounded.log_likelihood(beyond[:2])))


finite = st.floats(allow_nan=False, allow_infinity=False)
quiet = {"deadline": None, "derandomize": True, "suppress_health_check": [HealthCheck.function_scoped_fixture]}


@settings(max_examples=80, **quiet)
@given(st.lists(st.floats(-1e300, 1e300), min_size=2, max_size=2))
def test_no_finite_theta_is_an_exception(unbounded, theta):
    value = unbounded.log_prob(theta)
    assert value < np.inf  # neither NaN nor +inf
    assert unbounded.log_prob_and_grad(theta)[0] == pytest.approx(value, rel=1e-9)
    assert not np.isnan(unbounded.log_likelihood(theta))
    assert unbounded.frequencies(theta).shape == (2,)


@pytest.mark.parametrize("theta", [[0.0, 1.7e308], [1.7e308, 1.7e308]])
def test_largest_numbers_are_no_exception_either(unbounded, theta):
    assert unbounded.log_prob(theta) == -np.inf
    assert unbounded.log_prob_and_grad(theta)[0] == -np.inf


@pytest.mark.parametrize("case", ["cantilever-young", "cantilever-section"])
@settings(max_examples=40, **quiet)
@given(data=st.data())
def test_no_finite_theta_is_an_exception_in_the_cases(load_case, case, data):
    problem = load_case(case, "shape")
    scaled = data.draw(st.lists(finite | st.floats(-0.5, 1.5), min_size=problem.ndim, max_size=problem.ndim))
    with np.errstate(over="ignore"):
        theta = problem.offset + problem.scale * np.array(scaled)
    theta = np.nan_to_num(theta)
    value = problem.log_prob(theta)
    inside = np.all((theta >= problem.lower) & (theta <= problem.upper))
    assert np.isfinite(value) if inside else value == -np.inf


@pytest.mark.parametrize("theta", [[np.nan, 1.0], [1.5, np.nan], [np.inf, 1.0], [-np.inf, np.nan]])
def test_nan_and_infinite_theta_are_outside(bounded, unbounded, theta):
    for problem in (bounded, unbounded):
        assert problem.log_prob(theta) == -np.inf
        assert problem.log_prior(theta) == -np.inf
        assert problem.log_prob_and_grad(theta)[0] == -np.inf


def test_failed_solves_are_recorded(oscillators):
    parameters = [Parameter("a", 1.0, 0.5, 4.0), Parameter("b", 1.0, 0.5, 4.0)]
    problem = UpdatingProblem.reduced(oscillators(2, fails_above=3.0), ModalData([1.0, 1.5]), parameters)
    theta = np.array([[1.0, 2.0], [3.5, 2.0], [9.0, 2.0], [2.0, 1.0], [3.2, 1.0]])
    value = problem.log_prob(theta)
    assert_array_equal(np.isfinite(value), [True, False, False, True, False])
    assert_array_equal(
        [f.theta for f in problem.failures], [[3.5, 2.0], [3.2, 1.0]]
    )  # not that outside the bounds
    assert problem.log_prob_and_grad([3.9, 1.0])[0] == -np.inf
    assert_array_equal([f.theta for f in problem.failures[2:]], [[3.9, 1.0]])
    assert_array_equal(np.isnan(problem.frequencies(theta)[:, 0]), [False, True, True, False, True])
    assert len(problem.failures) == 3


def test_model_of_any_kind(oscillators):
    parameters = [Parameter("a", 1.0, 0.5, 4.0), Parameter("b", 1.0, prior=Normal(2.0, mean=1.0))]
    problem = UpdatingProblem.reduced(oscillators(2), ModalData([1.0, 1.5]), parameters, beta=[2.0, 1.0])
    theta = np.array([2.0, 3.0])
    expected = -2 * (np.sqrt(2) - 1) ** 2 - (np.sqrt(3) - 1.5) ** 2 + 0.5 * np.log(2 / np.pi**2)
    assert problem.log_likelihood(theta) == pytest.approx(expected, rel=1e-13)
    prior = -np.log(3.5) - 0.5 - np.log(2.0 * np.sqrt(2 * np.pi))
    assert problem.log_prior(theta) == pytest.approx(prior, rel=1e-13)
    _, gradient = problem.log_prob_and_grad(theta)
    assert_allclose(gradient, [-2 * (1 - 1 / np.sqrt(2)), -(1 - 1.5 / np.sqrt(3)) - 0.5], rtol=1e-12)


def test_attributes(bounded):
    assert (bounded.ndim, bounded.names, bounded.units) == (2, ("k0", "k1"), ("N/m", "N/m"))
    assert_array_equal(bounded.start, [2.0, 1.5])
    assert_array_equal(bounded.offset, [1.0, 0.5])
    assert_array_equal(bounded.scale, [3.0, 2.5])
    assert bounded.failures == []
    assert "chain" in repr(bounded)


def test_prior_draws_and_simulated_data(bounded):
    theta = bounded.sample_prior(np.random.default_rng(0), 500)
    assert theta.shape == (500, 2)
    assert np.all((theta >= bounded.lower) & (theta <= bounded.upper))
    assert_array_equal(theta, bounded.sample_prior(np.random.default_rng(0), 500))
    frequencies = bounded.frequencies(theta)
    noise = bounded.simulate_data(np.random.default_rng(1), frequencies) - frequencies
    # sd = 1/√(2β) = 0.1 and 0.158 Hz, known from 500 draws to 3 %; five standard errors
    assert_allclose(noise.std(axis=0), [0.1, 1 / np.sqrt(40)], rtol=0.16)


@pytest.mark.parametrize(("case", "pairing"), [("cantilever-young", "shape"), ("cantilever-section", "index")])
def test_a_batch_changes_no_bit(load_case, case, pairing):
    problem = load_case(case, pairing)
    theta = problem.sample_prior(np.random.default_rng(7), 33)
    batch = problem.log_prob(theta)
    assert_array_equal(batch, [problem.log_prob(row) for row in theta])
    assert_array_equal(batch[3:20], problem.log_prob(theta[3:20]))
    assert_array_equal(batch, problem.log_prob(np.asfortranarray(theta)))


def test_a_batch_changes_no_bit_with_many_parameters_and_modes(oscillators):
    parameters = [Parameter(f"p{i}", 1.0, 0.5, prior=Normal(2.0, mean=1.0)) for i in range(20)]
    problem = UpdatingProblem.reduced(oscillators(20), ModalData(np.linspace(1, 2, 20)), parameters)
    theta = problem.sample_prior(np.random.default_rng(7), 50)
    assert_array_equal(problem.log_prob(theta), [problem.log_prob(row) for row in theta])


def test_emcee_takes_the_callable_as_it_is(load_case):
    problem = load_case("cantilever-young", "shape")
    sampler = emcee.EnsembleSampler(32, problem.ndim, problem.log_prob, vectorize=True)
    sampler.random_state = np.random.RandomState(1).get_state()
    sampler.run_mcmc(problem.sample_prior(np.random.default_rng(1), 32), 20)
    assert np.all(np.isfinite(sampler.get_log_prob()))
    assert np.median(sampler.get_log_prob()[-1]) > np.median(sampler.get_log_prob()[0])


WRONG = {
    "twin names": (
        {"parameters": (BOUNDED[0], BOUNDED[0])},
        r"parameters: names must be distinct \(got twice: \['k0'\]\)",
    ),
    "too few parameters": ({"parameters": BOUNDED[:1]}, r"parameters: the model takes 2 \(got 1\)"),
    "pairing": ({"pairing": "name"}, r"pairing: must be one of \('shape', 'index', 'soft'\) \(got 'name'\)"),
    "beta": ({"beta": [1.0, 2.0, 3.0]}, r"beta: must be a number or 2 numbers \(got shape \(3,\)\)"),
    "sensor": (
        {"data": ModalData([0.1], sensors=((9, "z"),))},
        r"sensor: the model has no free degree of freedom \(got node 9, 'z'\)",
    ),
    "numbers": (
        {"data": ModalData([0.1, 0.2], numbers=(1, 1)), "pairing": "index"},
        r"numbers: must be distinct and count from 1 \(got \(1, 1\)\)",
    ),
}


@pytest.mark.parametrize("case", list(WRONG))
def test_wrong_problems(chain, case):
    changes, message = WRONG[case]
    arguments = {"model": chain, "data": MEASURED, "parameters": BOUNDED} | changes
    with pytest.raises(ValueError, match=f"^{message}$"):
        UpdatingProblem.reduced(**arguments)


def test_model_that_does_not_fit(oscillators):
    with pytest.raises(ValueError, match=r"^data: the model pairs 2 modes \(got 3\)$"):
        UpdatingProblem.reduced(oscillators(2), ModalData([1.0, 2.0, 3.0]), BOUNDED)
    with pytest.raises(ValueError, match=r"^parameters: the model takes 3 \(got 2\)$"):
        UpdatingProblem.reduced(oscillators(3), ModalData([1.0, 2.0, 3.0]), BOUNDED)
