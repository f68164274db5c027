"""Predictions of modes by draws: the modes at the draws are solved once, however many modes are predicted."""

import numpy as np
from numpy.testing import assert_allclose

import fmu
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
