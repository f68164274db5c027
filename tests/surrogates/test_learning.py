"""Surrogates learnt from few solves: right, certified by unseen solves, and told where they are not."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import fmu
from fmu.fem.approximation import Approximation
from fmu.fem.surrogate import process
from fmu.surrogates import learning
from fmu.surrogates.learning import SurrogateWarning
from tests.gradients import assert_gradient
from tests.samplers.loop.test_groups import Backwards
from tests.shear_building import two_frequencies_hz as storeys

START, SD = np.array([5e7, 3e7]), np.array([0.01, 0.03])


def problem(function=storeys, *, sd=SD, batched=False):
    parameters = [
        fmu.Parameter("k1", 5e7, 2e7, 9e7, unit="N/m"),
        fmu.Parameter("k2", 3e7, 1e7, 6e7, unit="N/m", prior=fmu.LogNormal(3e7, 0.4)),
    ]
    data = fmu.ModalData((1.02 * storeys(START)).tolist())
    return fmu.UpdatingProblem(
        fmu.BlackBoxModel(function, 2, batched=batched),
        data,
        parameters,
        error=fmu.FrequencyErrors("absolute", sd=sd),
    )


def moments(of):
    """Mean and sd of a posterior by quadrature around its maximum."""
    best = fmu.find_map(of, 16)[0]
    axes = [
        np.linspace(max(of.lower[j], best.mean[j] - 7 * best.sd[j]), best.mean[j] + 7 * best.sd[j], 61)
        for j in (0, 1)
    ]
    theta = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    log = of.log_prob(theta)
    w = np.exp(log - log.max())
    mean = w @ theta / w.sum()
    return mean, np.sqrt(w @ (theta - mean) ** 2 / w.sum())


@pytest.fixture(scope="module")
def exact_moments():
    """Return those of the model's own posterior."""
    return moments(problem())


@pytest.fixture(scope="module")
def learnt():
    """The surrogate, and every theta in the order in which it was solved."""
    solved = []

    def counted(theta):
        solved.append(theta.copy())
        return storeys(theta)

    return fmu.surrogate(problem(counted)), np.array(solved)


@pytest.fixture
def few_draws(monkeypatch):
    """Search and draw a quarter of what a user's rounds do: enough where a test asks what is told."""
    for name, value in {"_STARTS": 8, "_CHAINS": 4, "_WARMUP": 100, "_DRAWS": 100}.items():
        monkeypatch.setattr(learning, name, value)
    monkeypatch.setattr(process, "_STARTS", (4.0,))


def test_the_posterior_is_that_of_the_model(learnt, exact_moments):
    mean, sd = exact_moments
    found_mean, found_sd = moments(learnt[0])
    record = learnt[0].model.certificate
    assert np.max(np.abs(found_mean - mean) / sd) <= record.shift <= 0.05
    np.testing.assert_allclose(found_sd, sd, rtol=0.05)


def test_solves_are_few_and_counted(learnt):
    surrogate, solved = learnt
    record = surrogate.model.certificate
    assert len(solved) == record.solves <= 40
    assert record.solves == record.design + record.draws


def test_the_certificate_is_from_solves_that_the_surrogate_has_not_seen(learnt):
    surrogate, solved = learnt
    checks, design = solved[-surrogate.model.certificate.draws :], surrogate.model.cheap.design.theta
    assert not {theta.tobytes() for theta in checks} & {theta.tobytes() for theta in design}
    exact = surrogate.with_model(surrogate.model.truth).log_likelihood(checks)
    error = exact - surrogate.log_likelihood(checks)
    assert surrogate.model.certificate.log_prob_sd == pytest.approx(np.std(error, ddof=1))


def test_its_gradient_is_that_of_its_value(learnt):
    surrogate = learnt[0]
    theta = surrogate.model.cheap.design.theta[5:10]
    gradient = surrogate.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, surrogate.log_prob, theta, 1e-6 * theta, rtol=1e-3, of_largest=1e-5)


def test_batches_are_exact(learnt):
    surrogate = learnt[0]
    theta = surrogate.sample_prior(np.random.default_rng(1), 33)
    together = surrogate.log_prob(theta)
    assert [surrogate.log_prob(one) for one in theta] == together.tolist()


@pytest.mark.parametrize("is_batched", [False, pytest.param(True, marks=pytest.mark.validate)])
def test_neither_the_order_of_the_solves_nor_batches_change_anything(learnt, is_batched):
    """Workers end in any order; that they give the solves of this process is tested with the model itself."""
    if is_batched:
        given, engine = problem(lambda theta: np.stack([storeys(one) for one in theta]), batched=True), None
    else:
        given, engine = problem(), Backwards()
    other = fmu.surrogate(given, engine=engine)
    assert np.array_equal(other.model.cheap.design.theta, learnt[0].model.cheap.design.theta)
    assert other.model.certificate == learnt[0].model.certificate


def test_a_corner_that_fails_is_learnt_and_told(exact_moments, few_draws):
    mean, sd = exact_moments
    edge = mean[0] + 0.5 * sd[0]  # it cuts through the posterior

    def failing(theta):
        if theta[0] > edge:
            raise RuntimeError("no convergence")
        return storeys(theta)

    found = fmu.surrogate(problem(failing), batch=8)
    record = found.model.certificate
    assert record.failed > 0
    assert "k1 is above" in record.failed_where
    assert any("which the certificate does not contain" in said for said in record.sentences())
    assert found.log_prob(np.array([8.5e7, 3e7])) == -np.inf
    assert np.isfinite(found.log_prob(mean - 0.5 * sd))


def test_a_mode_that_may_have_been_taken_for_another_is_told(few_draws):
    def veering(theta):
        f = storeys(theta)
        angle = 0.5 * np.arctan2(1.0, 1e-7 * (theta[0] - 6.5e7))
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return {"frequencies": f, "shapes": turn}

    given = problem(veering)
    shapes = {"sensors": [(0, "x"), (1, "x")], "shapes": [[1.0, 0.1], [-0.1, 1.0]]}
    data = fmu.ModalData(given.data.frequencies_hz, **shapes)
    turned = fmu.UpdatingProblem(
        fmu.BlackBoxModel(veering, 2), data, given.parameters, error=fmu.FrequencyErrors("absolute", sd=SD)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SurrogateWarning)  # the frequencies jump where the pairing changes
        found = fmu.surrogate(turned, seed=3, max_solves=22)
    assert "has a MAC below 0.6" in found.model.certificate.doubts


def test_scatter_of_the_answers_is_estimated_and_told(exact_moments, few_draws):
    rng = np.random.default_rng(1)
    with pytest.warns(SurrogateWarning, match="answers scatter"):
        found = fmu.surrogate(
            problem(lambda theta: storeys(theta) * (1.0 + 5e-4 * rng.standard_normal(2))), batch=8
        )
    record = found.model.certificate
    assert record.scatter == pytest.approx(5e-4, rel=0.6)
    mean, sd = exact_moments
    assert np.max(np.abs(moments(found)[0] - mean) / sd) <= record.shift


def test_no_verdict_without_the_certificate(learnt):
    """Draws of a surrogate that misses its tolerance have not converged to the posterior of the model."""
    found, seen = learnt[0], []
    trace = fmu.sample(found, draws=200, warmup=100, on_draws=lambda trace: seen.append(fmu.diagnose(trace)))
    assert [seen[0].converged, fmu.diagnose(trace).converged] == [True, True]
    trace.attrs["certificate_shift"] = 3.7
    verdict = fmu.diagnose(trace)
    assert not verdict.converged
    assert verdict.reasons == (
        "the surrogate misses its tolerance: by its certificate posterior means may be off by 3.7 posterior "
        "standard deviations (allowed: 0.05), whatever its draws say",
    )
    trace.attrs["second_stage_proposals"] = 400
    assert fmu.diagnose(trace).converged
    uncertain = replace(found.model.certificate, shift=np.inf)
    unknown = found.with_model(Approximation(found.model.truth, found.model.cheap, uncertain))
    fmu.sample(unknown, draws=20, warmup=20, on_draws=lambda trace: seen.append(fmu.diagnose(trace)))
    assert "may be off by any amount" in seen[-1].reasons[-1]


def test_a_small_budget_is_told_and_its_limit_holds(few_draws):
    with pytest.warns(SurrogateWarning, match="misses its tolerance"):
        found = fmu.surrogate(problem(sd=0.02 * SD), tolerance=1e-4, max_solves=22)
    record = found.model.certificate
    assert record.solves <= 22
    assert record.shift > 1e-4


@pytest.mark.parametrize(
    ("options", "rule"),
    [
        ({"tolerance": 0.0}, "tolerance: must be above 0"),
        ({"batch": 0}, "batch: must be at least 1"),
        ({"checks": 4}, "checks: must be at least 8"),
        ({"max_solves": 10}, "max_solves: must be at least 22"),
    ],
)
def test_numbers_out_of_range_are_refused(options, rule):
    with pytest.raises(ValueError, match=rule):
        fmu.surrogate(problem(), **options)


def test_a_model_with_matrices_has_a_reduced_model_instead():
    with pytest.raises(ValueError, match="a model with matrices has a reduced model"):
        fmu.surrogate(fmu.cases.load("shear-2dof"))


def test_a_function_that_fails_everywhere_is_refused():
    def failing(theta):
        if not np.array_equal(theta, [5e7, 3e7]):
            raise RuntimeError("no licence")
        return storeys(theta)

    with pytest.raises(ValueError, match="must be solved at more points"):
        fmu.surrogate(problem(failing))
