"""Modes left out of updating: closed forms of a linear model, quadrature, and what is stored."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import fmu
from fmu.analysis.held_out import modes, own_run
from fmu.analysis.held_out.modes import left_out_warnings, with_left_out
from fmu.analysis.held_out.prediction import Draws
from fmu.analysis.held_out.refit import approximation, cheaper, compare_posteriors, left_out
from fmu.analysis.trace.conversion import to_trace
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from tests.gradients import assert_gradient
from tests.two_storeys import left_out as by_quadrature

pytestmark = pytest.mark.usefixtures("refits")

# The model of conftest.py: f = 100 + SLOPES @ theta, with independent priors.
SLOPES, PRIOR_SD = np.array([[2.0, 1.0], [0.5, -1.0], [1.0, 3.0]]), np.array([1.0, 2.0])
MEASURED, BETA = np.array([101.0, 99.5, 102.0]), np.array([0.5, 1.0, 2.0])
COVARIANCE = np.array([[1.0, 0.4, 0.1], [0.4, 0.5, -0.2], [0.1, -0.2, 0.25]])
BY_REFITS = ["refit"] * 3


def test_the_error_of_an_elpd_is_how_it_scatters():
    rng, found = np.random.default_rng(1), []
    for _ in range(200):
        theta = 1.2 * rng.standard_normal((300, 1))
        log_p = norm.logpdf(theta.T) + np.stack([np.zeros(300), norm.logpdf(0.5, theta[:, 0], 2.0)])
        found.append(compare_posteriors(theta, log_p, theta, norm.logpdf(theta[:, 0], scale=1.2)))
    elpd, error = (np.array([getattr(one, name) for one in found]) for name in ("elpd", "error"))
    assert elpd.mean() == pytest.approx(norm.logpdf(0.5, 0.0, np.sqrt(5.0)), abs=4.0 * elpd.std() / np.sqrt(200))
    assert elpd.std() == pytest.approx(error.mean(), rel=0.2)  # four standard errors of a standard deviation


def given(k, others, covariance):
    """Mean and variance of a measurement of mode k given those of other modes."""
    joint = SLOPES @ np.diag(PRIOR_SD**2) @ SLOPES.T + covariance
    weight = np.linalg.solve(joint[np.ix_(others, others)], joint[others, k])
    return 100.0 + weight @ (MEASURED[others] - 100.0), joint[k, k] - weight @ joint[others, k]


def check(table, use, covariance, sigmas=4.0):
    """Hold the table against the closed form; the bounds of the first parameter, at 4 sd, hardly matter."""
    for k, row in enumerate(table.itertuples()):
        others = [j for j in np.flatnonzero(use) if j != k]
        mean, variance = given(k, others, covariance)
        exact = norm(mean, np.sqrt(variance))
        assert row.used == use[k]
        assert row.measured == MEASURED[k]
        assert row.elpd == pytest.approx(exact.logpdf(MEASURED[k]), abs=sigmas * row.mcse_elpd + 0.01)
        assert row.mcse_elpd < 0.06
        assert row.mean == pytest.approx(mean, abs=0.15 * exact.std())
        assert row.sd == pytest.approx(exact.std(), rel=0.1)
        assert (row.eti90_lb, row.eti90_ub) == pytest.approx(exact.interval(0.9), abs=0.3 * exact.std())
        assert row.p == pytest.approx(2 * min(exact.cdf(MEASURED[k]), exact.sf(MEASURED[k])), abs=0.06)
        prior_sd = np.sqrt(SLOPES[k] ** 2 @ PRIOR_SD**2 + covariance[k, k])
        assert row.prior_sd == pytest.approx(prior_sd, rel=5 / np.sqrt(2 * 200))


@pytest.fixture
def few(make_result):
    """A trace of draws that tell nothing: too few, and anywhere."""
    theta = np.random.default_rng(1).standard_normal((2, 30, 2))
    return lambda problem: to_trace(make_result(theta), problem)


def test_refits_of_a_linear_model(few, problem):
    table = fmu.leave_one_out(few(problem), problem)
    assert list(table["method"]) == BY_REFITS
    assert list(table.index) == ["W1", "W2", "T1"]
    check(table, (True,) * 3, np.diag(0.5 / BETA))


@pytest.mark.parametrize("use", [(True, True, True), (True, True, False)])
def test_refits_with_correlated_errors(few, problem, use):
    data = ModalData(MEASURED, covariance_hz2=COVARIANCE, use=use)
    correlated = UpdatingProblem(problem.model, data, problem.parameters)
    trace = few(correlated)
    if all(use):
        check(fmu.leave_one_out(trace, correlated), use, COVARIANCE)
        return
    theta = np.random.default_rng(2).standard_normal((5, 2))
    alone = ModalData(MEASURED[:2], covariance_hz2=COVARIANCE[:2, :2])
    expected = UpdatingProblem(First(problem.model, 2), alone, problem.parameters)
    np.testing.assert_allclose(correlated.log_prob(theta), expected.log_prob(theta), rtol=1e-12)
    slopes = correlated.log_prob_and_grad(theta)[1]
    np.testing.assert_allclose(slopes, expected.log_prob_and_grad(theta)[1], rtol=1e-9)
    assert list(trace["log_likelihood"]["mode"].to_numpy()) == ["1", "2"]
    assert list(trace["posterior_predictive"]["mode"].to_numpy()) == ["1", "2", "3"]
    assert trace["observed_data"]["used"].to_numpy().tolist() == list(use)


class First:
    """The first modes of a model."""

    def __init__(self, model, n_modes):
        self.model, self.n_modes, self.n_parameters = model, n_modes, model.n_parameters

    def frequencies(self, theta):
        return self.model.frequencies(theta)[:, : self.n_modes]

    def frequencies_and_gradient(self, theta):
        return tuple(part[:, : self.n_modes] for part in self.model.frequencies_and_gradient(theta))


def posterior_of(use, covariance):
    """Mean and covariance of the parameters given the modes in use."""
    A, weight = SLOPES[list(use)], np.linalg.inv(covariance[np.ix_(use, use)])
    spread = np.linalg.inv(np.diag(PRIOR_SD**-2.0) + A.T @ weight @ A)
    return spread @ A.T @ weight @ (MEASURED[list(use)] - 100.0), spread


@pytest.mark.parametrize("covariance", [np.diag(0.5 / BETA), COVARIANCE])
def test_a_mode_that_is_not_used_is_predicted_by_the_posterior(make_result, problem, covariance):
    use = (True, True, False)
    data = ModalData(MEASURED, covariance_hz2=covariance, use=use)
    with_test = UpdatingProblem(problem.model, data, problem.parameters)
    draws = np.random.default_rng(3).multivariate_normal(*posterior_of(use, covariance), (4, 2000))
    table = fmu.leave_one_out(to_trace(make_result(draws), with_test), with_test)
    assert table["method"].iloc[2] == "not used in updating"
    check(table, use, covariance)


def test_draws_alone_give_the_density_of_a_mode_that_is_not_used(make_result, problem):
    """Without a refit, which replaces an inaccurate density."""
    use, covariance = (True, True, False), np.diag(0.5 / BETA)
    data = ModalData(MEASURED, covariance_hz2=covariance, use=use)
    with_test = UpdatingProblem(problem.model, data, problem.parameters)
    theta = np.random.default_rng(3).multivariate_normal(*posterior_of(use, covariance), (4, 2000))
    flat = theta.reshape(-1, 2)
    draws = Draws(with_test, flat, problem.model.frequencies(flat))
    row = modes._not_used(to_trace(make_result(theta), with_test), with_test, 2, draws)
    mean, variance = given(2, [0, 1], covariance)
    assert row.elpd == pytest.approx(norm(mean, np.sqrt(variance)).logpdf(MEASURED[2]), abs=0.1)


def test_a_measurement_far_out_has_its_probability(few, problem):
    """The density of the draws there is tiny; draws of the posterior with the mode reach it."""
    far = MEASURED + np.array([0.0, 0.0, 40.0])
    data = replace(problem.data, frequencies_hz=far)
    problem = UpdatingProblem(problem.model, data, problem.parameters, beta=BETA)
    mean, variance = given(2, [0, 1], np.diag(0.5 / BETA))
    exact = norm(mean, np.sqrt(variance))
    row = fmu.leave_one_out(few(problem), problem).loc["T1"]
    assert exact.sf(far[2]) < 1e-20
    assert row["elpd"] == pytest.approx(exact.logpdf(far[2]), abs=0.1)
    assert np.log(row["p"]) == pytest.approx(np.log(2 * exact.sf(far[2])), abs=0.3)


@pytest.mark.validate
def test_a_bent_ridge_against_quadrature():
    """One frequency leaves two stiffnesses on a long ridge, and the prior has heavy tails."""
    problem, rng = fmu.cases.load("shear-2dof"), np.random.default_rng(1)
    known = approximation(problem, problem.start[None], rng)
    for k, label in enumerate(problem.data.labels):
        without = problem.using([other for other in problem.data.labels if other != label])
        found = left_out(without, problem, [approximation(without, problem.start[None], rng), known], rng)
        assert found.is_known
        assert found.predicts
        assert found.elpd == pytest.approx(by_quadrature()[k], abs=0.1)


def test_the_only_mode_in_use_is_not_left_out(few, problem):
    """There would be nothing to update with; the other modes are predicted by it."""
    only = problem.using(problem.data.labels[:1])
    table = fmu.leave_one_out(few(only), only)
    assert table["method"].iloc[0] != "refit"
    assert list(table["method"].iloc[1:]) == 2 * ["not used in updating"]


def test_the_table_is_kept_in_the_trace(make_result, problem, tmp_path):
    mean, spread = posterior_of((True,) * 3, np.diag(0.5 / BETA))
    draws = np.random.default_rng(4).multivariate_normal(mean, spread, (4, 500))
    kept = with_left_out(to_trace(make_result(draws), problem), problem)
    path = fmu.save_trace(kept, tmp_path / "trace.nc")
    table = fmu.leave_one_out(fmu.load_trace(path))
    assert set(table["method"]) <= {"refit", "importance weights"}
    check(table, (True,) * 3, np.diag(0.5 / BETA))


def test_no_number_where_updating_anew_would_take_long(few, problem, monkeypatch):
    monkeypatch.setattr(modes, "seconds_of_a_solve", lambda problem, theta: 1.0)
    table = fmu.leave_one_out(with_left_out(few(problem), problem))
    assert not table["method"].any()
    assert table[["mean", "sd", "p", "elpd", "mcse_elpd"]].isna().all(axis=None)


def with_poor_weights(make_result, problem, monkeypatch, seconds):
    """A run of which all modes would take too long to leave out, and the weights of W1 and T1 are unreliable."""
    monkeypatch.setattr(modes, "seconds_of_a_solve", lambda problem, theta: seconds)
    draws = np.random.default_rng(1).multivariate_normal(*posterior_of((True,) * 3, np.diag(0.5 / BETA)), (4, 500))
    trace = to_trace(make_result(draws), problem)
    trace.attrs["n_solves"] = 1
    return with_left_out(trace, problem)


def test_a_mode_with_unreliable_weights_is_left_out_where_that_takes_seconds(make_result, problem, monkeypatch):
    trace = with_poor_weights(make_result, problem, monkeypatch, 2e-4)
    table = fmu.leave_one_out(trace)
    assert table["method"].tolist() == ["refit", "importance weights", "refit"]
    check(table, (True,) * 3, np.diag(0.5 / BETA))
    assert not left_out_warnings(trace)


def test_a_mode_that_was_not_left_out_is_named(make_result, problem, monkeypatch):
    trace = with_poor_weights(make_result, problem, monkeypatch, 0.1)
    assert fmu.leave_one_out(trace)["method"].tolist() == ["", "importance weights", ""]
    (warning,) = left_out_warnings(trace)
    assert warning.startswith("modes W1 and T1 of 3 are not predicted by the others")
    assert warning in fmu.diagnose(trace).notes


@pytest.mark.parametrize("by_rounds", [True, False])
def test_modes_that_importance_sampling_does_not_predict_have_draws_of_their_own(
    few, problem, monkeypatch, by_rounds
):
    """For a caller who waits however long it takes: by rounds of candidates, else by a run."""
    monkeypatch.setattr(modes, "_left_out_all", lambda *_: {})
    monkeypatch.setattr(own_run, "_WARMUP", 100)
    monkeypatch.setattr(own_run, "_FIRST", 500)
    if not by_rounds:
        monkeypatch.setattr(own_run, "_by_rounds", lambda *_: None)
    table = fmu.leave_one_out(few(problem), problem)
    assert table["method"].tolist() == BY_REFITS
    check(table, (True,) * 3, np.diag(0.5 / BETA), sigmas=6.0)


def test_a_run_that_does_not_converge_predicts_nothing(few, problem, monkeypatch):
    monkeypatch.setattr(modes, "_left_out_all", lambda *_: {})
    monkeypatch.setattr(own_run, "_by_rounds", lambda *_: None)
    for name, number in (("_WARMUP", 20), ("_FIRST", 50), ("_MOST", 50)):
        monkeypatch.setattr(own_run, name, number)
    monkeypatch.setattr(own_run, "_is_converged", lambda draws: False)
    assert not fmu.leave_one_out(few(problem), problem)["method"].any()


def test_a_maximum_outside_the_draws_needs_a_run(problem):
    """Candidates around draws with the mode do not lead to a maximum that only the other modes allow."""
    maxima, scaled = fmu.find_map(problem, 2), ScaledDensity(problem)
    far = replace(maxima, maxima=(*maxima.maxima, replace(maxima[0], theta=maxima[0].theta + 9.0)))
    draws = maxima[0].theta + np.random.default_rng(2).standard_normal((500, 2))
    assert not own_run._lacks_a_maximum(maxima, scaled, draws)
    assert own_run._lacks_a_maximum(far, scaled, draws)


def test_what_is_affordable_does_not_depend_on_the_clock():
    """By the sizes of the matrices: a run that is resumed on a busy machine has the same table."""
    young, building = (fmu.cases.load(name) for name in ("cantilever-young", "shear-10dof"))
    nowhere = np.empty((0, 5))
    assert modes.seconds_of_a_solve(young, nowhere) == pytest.approx(6e-8 * young.model.sizes[0] ** 2)
    assert modes.seconds_of_a_solve(building, nowhere) == 1e-5  # the least, of small matrices


def test_one_search_serves_all_runs(few, problem, monkeypatch):
    first = fmu.leave_one_out(few(problem), problem)
    monkeypatch.setattr(modes, "left_out", None)
    assert fmu.leave_one_out(few(problem), problem).equals(first)


def test_a_problem_with_other_modes_shares_the_model(problem):
    other = problem.using(["W1", "T1"])
    theta = np.random.default_rng(5).standard_normal((4, 2))
    np.testing.assert_array_equal(
        other.log_likelihood_terms(theta), problem.log_likelihood_terms(theta)[:, [0, 2]]
    )
    assert other.model is problem.model
    assert "use" not in problem.configuration()["data"]
    assert other.configuration()["data"]["use"] == [True, False, True]
    np.testing.assert_array_equal(other.using(["W1", "W2", "T1"]).log_prob(theta), problem.log_prob(theta))


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (["W1", "W9"], r"labels: must be of W1, W2, T1 \(got 'W9'\)"),
        ([], r"labels: must name at least one of W1, W2, T1 \(got none\)"),
    ],
)
def test_modes_that_cannot_be_used(problem, labels, message):
    with pytest.raises(ValueError, match=message):
        problem.using(labels)


@pytest.mark.parametrize("pairing", ["shape", pytest.param("index", marks=pytest.mark.validate)])
def test_chains_for_proposals_take_a_part_of_the_basis(pairing):
    problem = fmu.cases.load("cantilever-young", pairing=pairing)
    theta, sizes = problem.sample_prior(np.random.default_rng(6), 256), problem.model.sizes
    before, scaled = problem.log_prob(theta), ScaledDensity(problem)
    u = scaled.to_scaled(theta)
    coarse = cheaper(problem, u, scaled.log_prob(u))
    assert sum(coarse.model.sizes) < 0.8 * sum(sizes)
    np.testing.assert_allclose(coarse.frequencies(theta), problem.frequencies(theta), rtol=1e-3)
    assert not np.array_equal(coarse.log_prob(theta), before)
    values, slopes = coarse.log_prob_and_grad(theta[:1])
    step = 1e-5 * problem.scale[0] * np.eye(problem.ndim)[0]
    ahead, behind = coarse.log_prob(theta[:1] + step), coarse.log_prob(theta[:1] - step)
    assert slopes[0, 0] * 2 * step[0] == pytest.approx(ahead[0] - behind[0], rel=1e-3)
    assert values[0] == pytest.approx(coarse.log_prob(theta[0]), rel=1e-9)
    assert problem.model.sizes == sizes  # the problem itself is as it was
    np.testing.assert_array_equal(problem.log_prob(theta), before)


def test_chains_for_proposals_keep_a_basis_of_which_all_matters(problem):
    rng, nowhere = np.random.default_rng(7), np.empty((0, 2))
    assert cheaper(problem, nowhere, np.empty(0)) is problem  # no basis
    building = fmu.cases.load("shear-10dof")
    assert cheaper(building, nowhere, np.empty(0)) is building  # a basis of all unknowns
    young = fmu.cases.load("cantilever-young")
    u = ScaledDensity(young).to_scaled(young.sample_prior(rng, 256))
    elsewhere = ScaledDensity(young).log_prob(u) + rng.standard_normal(256)
    assert cheaper(young, u, elsewhere) is young  # log P would change


@pytest.mark.parametrize("pairing", ["shape", "soft"])
@pytest.mark.parametrize("error", ["frequencies", "shapes"])
def test_a_mode_leaves_with_its_shape(pairing, error):
    """Frequencies and shapes with an inferred error; the terms and derivatives are those of the modes in use."""
    K = 400.0 * np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    dofs = [(k, "x") for k in range(3)]
    model = fmu.SeparableModel.from_terms(["k"], stiffness=[(K, "k")], mass=[np.eye(3)], dofs=dofs)
    lam, shapes = np.linalg.eigh(K)
    data = ModalData(1.02 * np.sqrt(lam) / (2 * np.pi), sensors=dofs, shapes=shapes + 0.05)
    sd = fmu.Parameter("sd", 0.02, 0.001, 0.5)
    errors = [fmu.FrequencyErrors(sd=sd)] + [fmu.ShapeErrors(0.1), fmu.MACErrors(0.05)] * (error == "shapes")
    whole = UpdatingProblem(model, data, [fmu.Parameter("k", 1.0, 0.5, 2.0)], pairing=pairing, error=errors)
    part, theta = whole.using(["1", "3"]), np.array([[1.0, 0.02], [1.1, 0.05]])
    np.testing.assert_array_equal(part.log_likelihood_terms(theta), whole.log_likelihood_terms(theta)[:, [0, 2]])
    assert_gradient(part.log_prob_and_grad(theta)[1], part.log_prob, theta, 1e-6, rtol=1e-4, atol=1e-4)
    residuals, of_all = (problem.likelihood.residuals_and_slopes(theta)[0] for problem in (part, whole))
    assert 3 * residuals.shape[1] == 2 * of_all.shape[1]
    labels = part.likelihood.labels(data.labels)
    assert len(labels) == residuals.shape[1]
    assert not any(label.startswith("2") for label in labels)
    noise = [problem.likelihood.quadratic(theta)[2][:, 1, 1] for problem in (part, whole)]
    np.testing.assert_allclose(noise[0], noise[1] * 2 / 3, rtol=1e-9)
    assert sum(part.data.use) == fmu.FrequencyErrors().n_errors(part.data) == 2
    assert fmu.ShapeErrors(0.1).n_errors(part.data) == 6


def test_the_modal_residual_of_the_modes_in_use():
    whole = fmu.cases.load("shear-10dof")
    data = whole.data
    shapes = np.eye(len(data.sensors), data.n_modes) + 0.1 if data.shapes is None else data.shapes
    data = replace(data, shapes=shapes, shapes_sd=None)
    problem = UpdatingProblem(whole.model.structure, data, whole.parameters[: whole.n_structural],
                              error="modal-residual")  # fmt: skip
    part, theta = problem.using(data.labels[:2]), problem.start[None]
    np.testing.assert_array_equal(part.log_likelihood_terms(theta), problem.log_likelihood_terms(theta)[:, :2])
    found, slopes = part.log_prob_and_grad(theta)
    assert np.isfinite(found).all()
    assert slopes.shape == theta.shape


@pytest.mark.validate
@pytest.mark.parametrize(("left", "reference"), [("3", -13.457), ("5", -14.990)])
def test_modes_far_from_their_prediction_against_bridge_sampling(left, reference):
    """Reference: evidences by bridge sampling from HMC with and without the mode, tests/validation/left_out.py."""
    problem, rng = fmu.cases.load("cantilever-young"), np.random.default_rng(2)
    known = approximation(problem, problem.start[None], rng)
    without = problem.using([label for label in problem.data.labels if label != left])
    found = left_out(without, problem, [approximation(without, problem.start[None], rng), known], rng)
    assert found.is_known
    assert found.elpd == pytest.approx(reference, abs=0.1)  # standard errors 0.024 and 0.019
