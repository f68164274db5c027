"""Residuals from shared right-hand sides: bounds and corrections as if each residual were solved for."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fmu.fem.modes.full_block import full_blocks
from fmu.fem.reduced import shared
from fmu.fem.reduced.anchors import Anchors
from fmu.fem.reduced.residuals import bound_errors
from fmu.fem.reduced.shared import SharedResiduals
from tests.fem.reduced.test_frequency_bound import BUILT, box

COUNT = 4


def anchors_of(built):
    model, lower, upper = box(built)
    return Anchors(full_blocks(model)[0], lower, upper)


@pytest.fixture(autouse=True)
def _all_are_large(monkeypatch):
    monkeypatch.setattr(shared, "LARGE", 10)


@pytest.fixture(params=[built for built in BUILT if len(anchors_of(built).theta) == 1])
def trial(request):
    """Return a space of random vectors besides the anchor's modes, its anchors, and points of the box."""
    _, lower, upper = box(request.param)
    anchors, rng = anchors_of(request.param), np.random.default_rng(3)
    block = anchors.block
    space = anchors.modes(COUNT)
    residuals = SharedResiduals.of(block).grown(space.V, anchors.factor(0).solve)
    more = space.grown(rng.standard_normal((block.size, 3)), anchors.first)
    residuals = residuals.grown(more.V[:, space.size :], anchors.factor(0).solve)
    return more, anchors, residuals, rng.uniform(lower, upper, size=(6, len(lower)))


def test_the_bounds_and_corrections_are_equal(trial):
    space, anchors, residuals, theta = trial
    apart, together = (bound_errors(space, anchors, theta, COUNT, by) for by in (None, residuals))
    # the energies are differences of numbers of the size of λ
    assert_allclose(together.error, apart.error, rtol=1e-6, atol=1e-10)
    assert np.max(apart.error) > 1e-6
    mask = np.ones((len(theta), COUNT), dtype=bool)
    mask[0, 1] = False
    one, other = together.corrections(mask), apart.corrections(mask)
    assert_allclose(one, other, rtol=0, atol=1e-8 * np.abs(other).max())


def test_a_basis_of_part_of_the_space_has_them_too(trial):
    space, anchors, residuals, theta = trial
    Q = np.linalg.qr(np.random.default_rng(4).standard_normal((space.size, space.size - 1)))[0]
    part = space.restrict(Q)
    of_part = residuals.restrict(space.V.T @ (anchors.first @ part.V))
    apart, together = (bound_errors(part, anchors, theta, COUNT, by) for by in (None, of_part))
    assert_allclose(together.error, apart.error, rtol=1e-6, atol=1e-10)
