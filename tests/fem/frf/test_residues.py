"""Residues and resonances against the modal sum and its derivatives."""

import numpy as np
from numpy.testing import assert_allclose

from fmu.fem.frf.residues import Residues, Resonances
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
