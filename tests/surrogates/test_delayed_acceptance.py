"""Delayed acceptance: the model's posterior from a surrogate that is off, few solves, failures rejected."""

import numpy as np
import pytest

import fmu
from fmu.analysis.certificate import exact_in_words
from fmu.fem.approximation import Approximation
from fmu.fem.surrogate import process
from fmu.surrogates import learning
from fmu.surrogates.delayed_acceptance import proposals
from fmu.surrogates.second_stage import independence_chain
from tests.shear_building import two_frequencies_hz

SD = np.array([0.004, 0.012])
START = np.array([5.2e7, 3.1e7])


class Storeys:
    """Frequencies of a shear building of two storeys; counts its calls, and fails above an edge of k1."""

    __qualname__ = "Storeys"

    def __init__(self):
        self.calls, self.edge = 0, np.inf

    def __call__(self, theta):
        self.calls += 1
        if np.any(theta.T[0] > self.edge):
            raise RuntimeError("no convergence")
        return two_frequencies_hz(theta)


def posed(function, **options):
    """The problem of a function; within these bounds the posterior has one maximum."""
    parameters = [fmu.Parameter("k1", 5e7, 3e7, 6e7, unit="N/m"), fmu.Parameter("k2", 3e7, 2.5e7, 5e7, unit="N/m")]
    data = fmu.ModalData(Storeys()(START).tolist())
    model = fmu.BlackBoxModel(function, 2, **options)
    return fmu.UpdatingProblem(model, data, parameters, error=fmu.FrequencyErrors("absolute", sd=SD))


def moments(most=np.inf):
    """Mean and sd by quadrature around the true stiffnesses, where k1 is at most `most`."""
    problem = posed(Storeys(), batched=True)
    width = np.array([2.2e6, 1.2e6])
    axes = [np.linspace(max(START[j] - width[j], problem.lower[j]), START[j] + width[j], 101) for j in (0, 1)]
    theta = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    log = np.where(theta[:, 0] > most, -np.inf, problem.log_prob(theta))
    w = np.exp(log - log.max())
    mean = w @ theta / w.sum()
    return mean, np.sqrt(w @ (theta - mean) ** 2 / w.sum())


def of_another(surrogate, function):
    """The problem of a surrogate that was learnt from one function, and now stands for another."""
    model = surrogate.model
    return surrogate.with_model(Approximation(posed(function).model, model.cheap, model.certificate))


@pytest.fixture(scope="module")
def first_stage():
    """The function, a surrogate whose frequencies are off by 0.2 of their errors, and draws of its posterior."""
    function = Storeys()
    with pytest.MonkeyPatch.context() as patch:  # the surrogate is off anyway: learn it with less effort
        for name, value in {"_STARTS": 8, "_CHAINS": 4, "_WARMUP": 100, "_DRAWS": 100}.items():
            patch.setattr(learning, name, value)
        patch.setattr(process, "_STARTS", (4.0,))
        off = fmu.surrogate(posed(lambda theta: Storeys()(theta) + [0.2, -0.2] * SD))
    surrogate = of_another(off, function)
    return function, surrogate, fmu.sample(surrogate, draws=2000, warmup=200, init="start")


@pytest.fixture(scope="module")
def exact(first_stage):
    """The exact draws, and how many calls they took."""
    function, surrogate, trace = first_stage
    before = function.calls
    return fmu.delayed_acceptance(surrogate, trace), function.calls - before


def test_the_chain_has_the_distribution_of_the_model():
    p, q = np.array([0.5, 0.3, 0.2, 0.0]), np.array([0.2, 0.2, 0.3, 0.3])
    rng = np.random.default_rng(1)
    state = rng.choice(4, size=40_000, p=q)
    with np.errstate(divide="ignore"):
        path, start = independence_chain(np.log(p / q)[state], rng)
    assert p[state[start]] > 0.0
    found = np.array([np.mean(state[path] == k) for k in range(4)])
    assert found[3] == 0.0  # where the model failed
    np.testing.assert_allclose(found, p, atol=5 * 2.5 * np.sqrt(0.25 / 40_000))  # as its draws are correlated
    # the flow from one state to another and that back are equal
    both = np.zeros((4, 4))
    np.add.at(both, (state[path][:-1], state[path][1:]), 1.0)
    rates = np.minimum(1.0, (p / q)[None, :3] / (p / q)[:3, None]) * q[None, :3] * p[:3, None]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        np.testing.assert_allclose([both[i, j], both[j, i]], 40_000 * rates[i, j], rtol=0.1)


def test_the_start_has_the_distribution_of_the_model():
    p, q = np.array([0.7, 0.3]), np.array([0.3, 0.7])
    state = np.array([0, 1, 1, 1, 0, 1, 1, 0, 1, 1])  # in proportion to q
    starts = [independence_chain(np.log(p / q)[state], np.random.default_rng(k))[1] for k in range(2000)]
    assert np.mean(state[starts] == 0) == pytest.approx(0.7, abs=5 * np.sqrt(0.21 / 2000))


def test_correlated_proposals_and_a_start_among_them_are_nearly_exact():
    # proposals N(0, 1) with the correlation that thinning leaves, target N(0.5, 1): 400 chains of 125
    rng = np.random.default_rng(2)
    x = rng.standard_normal((400, 125))
    for j in range(1, 125):
        x[:, j] = np.exp(-4.0) * x[:, j - 1] + np.sqrt(1.0 - np.exp(-8.0)) * x[:, j]
    draws = np.array([one[independence_chain(0.5 * one, rng)[0]] for one in x])
    means, squares = draws.mean(axis=1), (draws - 0.5) ** 2
    assert abs(means.mean() - 0.5) < 4 * means.std() / 20
    assert abs(squares.mean() - 1.0) < 4 * squares.mean(axis=1).std() / 20


def test_the_posterior_is_the_models_where_the_surrogates_is_off(first_stage, exact):
    mean, sd = moments()
    off, found = fmu.summary(first_stage[2]), fmu.summary(exact[0])
    assert np.max(np.abs(off["mean"] - mean) / sd) > 0.2
    assert fmu.diagnose(exact[0]).converged
    assert np.max(np.abs(found["mean"] - mean) / found["mcse_mean"]) < 4
    np.testing.assert_allclose(found["sd"], sd, rtol=4 / np.sqrt(2 * found["ess_bulk"].min()))


def test_solves_are_those_of_the_proposals_and_counted(first_stage, exact):
    trace, calls = exact
    attrs = trace.attrs
    assert attrs["second_stage_proposals"] == trace["posterior"].sizes["chain"] * trace["posterior"].sizes["draw"]
    assert attrs["n_solves"] == attrs["second_stage_solves"] <= attrs["second_stage_proposals"]
    assert attrs["warmup_n_solves"] == first_stage[1].model.certificate.solves
    assert calls <= attrs["second_stage_solves"] + 3  # the states that a report shows
    assert 0 < attrs["second_stage_accepted"] < attrs["second_stage_proposals"]
    assert float(trace["sample_stats"]["accepted"].mean()) == pytest.approx(
        attrs["second_stage_accepted"] / attrs["second_stage_proposals"]
    )


def test_the_trace_is_that_of_the_model(first_stage, exact):
    function = first_stage[0]
    problem, trace = posed(function), exact[0]
    theta = np.stack([trace["posterior"][name].to_numpy() for name in problem.names], axis=-1)[:, -3:]
    hz = trace["posterior_predictive"]["model_frequency"].to_numpy()[:, -3:]
    assert np.array_equal(hz.reshape(-1, 2), problem.frequencies(theta.reshape(-1, 2)))
    assert np.array_equal(
        trace["sample_stats"]["lp"][:, -3:].to_numpy().ravel(), problem.log_prob(theta.reshape(-1, 2))
    )
    usual = {
        "posterior",
        "sample_stats",
        "log_likelihood",
        "posterior_predictive",
        "prior",
        "modes",
        "leave_one_out",
    }
    assert usual <= set(trace.children)
    assert (
        "draws of the surrogate were accepted after a solve of the model itself" in exact_in_words(trace.attrs)[0]
    )


def test_draws_depend_neither_on_workers_nor_on_solves_done_before(first_stage, exact):
    _, surrogate, trace = first_stage
    with fmu.engine(workers=2) as engine:
        again = fmu.delayed_acceptance(surrogate, trace, engine=engine)
    assert again.posterior.equals(exact[0].posterior)
    assert again.attrs["second_stage_solves"] == exact[0].attrs["second_stage_solves"]


def test_a_limit_ends_it_and_a_larger_one_goes_on_with_the_same_proposals(first_stage, exact):
    function, surrogate, trace = first_stage
    before = function.calls
    short = fmu.delayed_acceptance(surrogate, trace, max_solves=102)
    assert function.calls <= before + 1  # those of the other run, which has another mean
    assert short["posterior"].sizes["draw"] == 25
    assert short.attrs["limit"] == "100 solves"
    assert not fmu.diagnose(short).converged


def test_draws_at_which_the_model_fails_are_rejected(first_stage):
    _, surrogate, trace = first_stage
    edge = START[0]
    failing = Storeys()
    failing.edge = edge  # the surrogate does not know of it
    problem = of_another(surrogate, failing)
    found = fmu.delayed_acceptance(problem, trace)
    assert found.attrs["second_stage_failed"] > 100
    assert float(found["posterior"]["k1"].max()) <= edge
    mean, _ = moments(most=edge)
    summary = fmu.summary(found)
    assert np.max(np.abs(summary["mean"] - mean) / summary["mcse_mean"]) < 4
    assert "the solve failed; they were rejected" in exact_in_words(found.attrs)[1]
    broken = of_another(surrogate, Storeys())
    broken.model.truth.functions[0].function.edge = 0.0
    with pytest.raises(ValueError, match="must be solved at draws of the surrogate"):
        fmu.delayed_acceptance(broken, trace)


def test_what_cannot_be_corrected_is_refused(first_stage):
    _, surrogate, trace = first_stage
    given = posed(Storeys())
    with pytest.raises(ValueError, match=r"must have a surrogate, from fmu\.surrogate"):
        fmu.delayed_acceptance(given, trace)
    other = fmu.sample(given, draws=20, warmup=20, init="start")
    with pytest.raises(ValueError, match="must be of the posterior by this surrogate"):
        fmu.delayed_acceptance(surrogate, other)
    short = fmu.sample(surrogate, draws=12, warmup=20, init="start")
    with pytest.raises(ValueError, match="must have an ESS of at least 64"):
        fmu.delayed_acceptance(surrogate, short)
    for name, value in (("until_ess", 0), ("max_solves", 3)):
        with pytest.raises(ValueError, match=f"{name}: must be"):
            fmu.delayed_acceptance(surrogate, trace, **{name: value})


def test_as_many_proposals_as_the_verdict_needs():
    assert proposals(None, 4) == 500
    assert proposals(1000.0, 4) == 1252  # 313 a chain
    assert proposals(None, 8) == 1000
