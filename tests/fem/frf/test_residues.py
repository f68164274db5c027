"""Residues and resonances against the modal sum and its derivatives."""

import numpy as np
from numpy.testing import assert_allclose

import fmu
from fmu.fem.frf.model import Damping, FRFModel
from fmu.fem.frf.proportional import Source
from fmu.fem.frf.residues import Residues, Resonances
from fmu.fem.frf.training import Lines
from fmu.fem.modes.terms import Term
from tests.gradients import assert_gradient
from tests.measured_frfs import LINES, RATIOS, TRUTH, problem

THETA, VALUES, OMEGA = (
    np.stack([TRUTH, TRUTH * [1.1, 0.9, 1.0]]),
    np.stack([RATIOS, 1.2 * RATIOS]),
    2 * np.pi * LINES,
)


def test_they_give_the_responses_and_their_derivatives():
    model = problem().likelihood.responses[0].model
    direct = model.at(THETA, VALUES)
    modes = Residues.of(model, THETA)
    g = Resonances.of(model.of_block, modes.lam, VALUES, OMEGA)
    assert_allclose(modes.amplitudes @ g.g, direct.frfs(OMEGA), rtol=1e-12)
    found = np.einsum("nfrp,nrl->nflp", modes.by_amplitude, g.g)
    found += np.einsum("nfr,nrl,nrp->nflp", modes.amplitudes, g.by_lam, modes.by_lam)
    viscous, hysteretic = model.of_block.slopes(modes.lam, VALUES)
    of_damping = np.einsum("nfr,nrl,nrq->nflq", modes.amplitudes, g.by_viscous, viscous)
    of_damping += np.einsum("nfr,nrl,nrq->nflq", modes.amplitudes, g.by_hysteretic, hysteretic)
    expected = direct.slopes(OMEGA)
    scale = np.abs(expected).max(axis=2, keepdims=True)
    assert_allclose(np.concatenate([found, of_damping], axis=3) / scale, expected / scale, rtol=0, atol=1e-10)


def test_derivatives_where_masses_are_parameters_are_those_of_differences():
    rng = np.random.default_rng(0)
    K, M, added = ((lambda a: a @ a.T + 4.0 * np.eye(4))(rng.standard_normal((4, 4))) for _ in range(3))
    structure = fmu.SeparableModel([Term(1e4 * K, (1, 0))], [Term(M, (0, 0)), Term(added, (0, 1))])
    theta, ends = np.array([[1.0, 0.9], [1.2, 1.1]]), ((0, "x"), (2, "x"))
    lines = Lines(np.linspace(3.0, 280.0, 41), np.ones((2, 41)))
    damping, box = Damping(2, ratios=(Source(0.0, 0),)), (np.full(2, 0.5), np.full(2, 1.5))
    model = FRFModel(structure, ends, (ends[0],) * 2, damping, theta[0], *box, np.array([0.02]), lines)
    found = Residues.of(model, theta)
    settings = {"order": 4, "rtol": 1e-6, "of_largest": 1e-7}
    assert_gradient(found.by_lam, lambda x: Residues.of(model, x).lam, theta, 1e-3, **settings)
    assert_gradient(found.by_amplitude, lambda x: Residues.of(model, x).amplitudes, theta, 1e-3, **settings)
