"""Predictions of modes by draws: the modes at the draws are solved once, however many modes are predicted."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.analysis.fit.checks import _limits
from fmu.analysis.held_out import modes
from fmu.analysis.held_out.prediction import Draws
from fmu.analysis.held_out.refit import LeftOut
from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood
from tests.shear_building import frequencies_hz, shear_building


def posed():
    names = ["k1", "k2", "k3"]
    model = shear_building(names, 1e3, mass=[1.0, 1.5, 1.2], dofs=[(j, "x") for j in range(1, 4)])
    data = fmu.ModalData(1.02 * frequencies_hz(model, np.ones(3))[0], sd_hz=0.05)
    return fmu.UpdatingProblem(
        model, data, [fmu.Parameter(name, 1.0, 0.5, 2.0) for name in names], pairing="index",
        discrepancy=fmu.Discrepancy(tau=0.05),
    )  # fmt: skip


def test_all_modes_are_predicted_by_one_solve_of_each_draw(monkeypatch):
    problem = posed()
    distinct = problem.sample_prior(np.random.default_rng(1), 20)
    theta = np.concatenate([distinct, distinct[::-1]])
    draws, solved = Draws(problem, theta, problem.frequencies(theta)), []
    observed = DiscrepantLikelihood.observed
    monkeypatch.setattr(
        DiscrepantLikelihood,
        "observed",
        lambda self, at, *more: solved.append(len(at)) or observed(self, at, *more),
    )
    weights = np.full(40, -np.log(40.0))
    found = [draws.predict(k, weights) for k in range(3)]
    assert solved == [20]
    slopes = problem.model.frequencies_and_gradient(theta)[1]
    variance = np.sum((0.05 * theta[:, None] * slopes) ** 2, axis=2) + 0.05**2
    for k, one in enumerate(found):
        assert_allclose(one.mean, draws.hz[:, k].mean())
        assert_allclose(one.sd**2, variance[:, k].mean() + draws.hz[:, k].var())


def test_modes_may_have_draws_of_their_own(monkeypatch):
    """Modes are left out in rounds; each round has draws of its own."""
    problem, rng = posed(), np.random.default_rng(1)
    rounds = []
    for n in (4000, 4100):
        theta = problem.sample_prior(rng, n)
        even = np.full((2, n), -np.log(n))
        rounds.append(LeftOut(theta, problem.frequencies(theta), even, 0.0, 0.01, np.zeros(2)))
    monkeypatch.setattr(modes, "left_out_together", lambda *given: [rounds[0], rounds[1], rounds[0]])
    found = modes._left_out_together(problem, [0, 1, 2])
    for k, one in enumerate([rounds[0], rounds[1], rounds[0]]):
        assert_allclose(found[k][1].mean, one.hz[:, k].mean())


@pytest.mark.parametrize(
    "nu", [np.full(40, 1.2), np.full(40, 2.01), np.linspace(1.5, 60.0, 40), np.full(40, 1e7), 2.01]
)
def test_predictions_with_errors_of_student_are_how_simulated_measurements_scatter(nu):
    """The degrees of freedom are inferred, or the number is known."""
    is_known, rng, n, level = np.ndim(nu) == 0, np.random.default_rng(3), 400_000, 0.01
    freedom = nu if is_known else fmu.Parameter("nu", 5.0, 1.0, 1e8)
    other = posed()
    problem = fmu.UpdatingProblem(
        other.model, fmu.ModalData(other.data.frequencies_hz), other.parameters, pairing="index",
        error=fmu.StudentErrors("relative", sd=0.02, freedom=freedom),
    )  # fmt: skip
    theta = np.column_stack([rng.uniform(0.98, 1.02, (40, 3))] + [nu] * (not is_known))
    hz, weight = problem.frequencies(theta), rng.uniform(0.2, 1.0, 40)
    weight /= weight.sum()
    row = Draws(problem, theta, hz).predict(1, np.log(weight))
    chosen = rng.choice(40, n, p=weight)
    simulated = problem.simulate_data(rng, hz[chosen], theta[chosen])[:, 1]
    assert_allclose(row.mean, weight @ hz[:, 1])
    assert_allclose(row.freedom, nu if is_known else 1.0 / (weight @ (1.0 / nu)))

    def check(found, expected):
        assert found == pytest.approx(expected, abs=4.5 * np.sqrt(expected / n))

    check(np.mean(simulated < row.eti90_lb), 0.05)
    check(np.mean(simulated > row.eti90_ub), 0.05)
    check(2.0 * min(np.mean(simulated < row.measured), np.mean(simulated > row.measured)), row.p)
    if np.ptp(nu) == 0.0:  # one distribution, but for the small scatter of the computed frequencies
        lower, upper = _limits(row._asdict(), level)
        assert np.mean((simulated < lower) | (simulated > upper)) == pytest.approx(level, rel=0.1)
        width = np.quantile(np.abs(simulated - hz[chosen, 1]), 0.95) / 1.96
        assert row.sd == pytest.approx(np.hypot(width, hz[chosen, 1].std()), rel=0.02)


def test_a_problem_with_inferred_degrees_of_freedom_is_sampled_and_its_modes_left_out():
    parameters = [fmu.Parameter(name, 1.0, 0.7, 1.5) for name in ("k1", "k2")]
    model = shear_building(["k1", "k2"], 2e6, 1000.0)
    errors = fmu.StudentErrors("relative", sd=0.01, freedom=fmu.Parameter("nu", 5.0, 1.0, 60.0))
    data = fmu.ModalData(frequencies_hz(model, (1.1, 0.9))[0])
    problem = fmu.UpdatingProblem(model, data, parameters, pairing="index", error=errors)
    maxima = fmu.find_map(problem, starts=2)
    trace = fmu.sample(problem, "mh", draws=120, warmup=50, chains=2, seed=1, maxima=maxima)
    table = fmu.leave_one_out(trace, problem)
    assert np.isfinite(table[["mean", "sd", "eti90_lb", "eti90_ub", "p", "elpd"]].to_numpy()).all()
    assert table["freedom"].between(1.0, 60.0).all()
