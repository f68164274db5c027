"""Stacks of small eigenproblems beside the general solver, and which of them are left to it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.fem.modes import full_block
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.full_block import full_blocks
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.stacks import SMALL, lowest_modes


def storeys(k, m):
    """Return K and M of a shear building with stiffnesses k and masses m, from the ground up."""
    K = np.diag(k) + np.diag(np.append(k[1:], 0.0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)
    return K, np.diag(m)


def stack(pairs):
    return tuple(np.stack(matrices) for matrices in zip(*pairs, strict=True))


@pytest.mark.parametrize(("size", "massless"), [(1, 0), (2, 0), (5, 2), (SMALL, 0), (SMALL, 12)])
def test_modes_are_those_of_the_general_solver(size, massless):
    rng = np.random.default_rng(size)
    mass = rng.uniform(1e3, 2e3, (7, size)) * (np.arange(size) % 2 == 0 if massless else 1.0)
    K, M = stack(storeys(k, m) for k, m in zip(rng.uniform(1e8, 3e8, (7, size)), mass, strict=True))
    count = min(3, size)
    lam, phi = lowest_modes(K, M, count)
    for i in range(7):
        one, shapes = eigen(K[i], M[i], count)
        assert_allclose(lam[i], one, rtol=1e-12)
        assert_allclose(phi[i].T @ M[i] @ phi[i], np.eye(count), atol=1e-13)
        assert_allclose(np.abs(phi[i].T @ M[i] @ shapes), np.eye(count), atol=1e-9)


def test_what_is_not_easy_is_left_to_the_general_solver():
    """Free, nearly free, negative and stiff next to soft, and a good problem among them."""
    mass = [1.0, 2.0, 1.5]
    good = storeys([2.0, 3.0, 4.0], mass)
    bad = [storeys([k, 3.0, 4.0], mass) for k in (0.0, 1e-12, -1.0)] + [storeys([1.0, 1e6, 1e6], mass)]
    lam, phi = lowest_modes(*stack([*bad, good]), 3)
    assert np.all(np.isnan(lam[:4]))
    assert np.all(np.isnan(phi[:4]))
    assert_allclose(lam[4], eigen(*good, 3)[0], rtol=1e-13)


def test_a_block_gives_each_theta_what_it_gives_it_alone():
    """Whatever else the batch has: free, negative, overflowing and NaN."""
    _, mass = storeys([1.0, 1.0, 1.0], [1.0, 2.0, 1.5])
    terms = [(storeys(row, [1.0] * 3)[0], name) for row, name in zip(np.eye(3), "abc", strict=True)]
    (block,) = full_blocks(SeparableModel.from_terms(["a", "b", "c"], terms, [mass]))
    easy = np.random.default_rng(1).uniform(1.0, 5.0, (6, 3))
    theta = np.concatenate([easy, [[0.0, 1, 1], [-1.0, 1, 1], [np.nan, 1, 1], [1e308, 1e308, 1e308]]])
    lam, phi = block.modes(theta, 3)
    assert_allclose(lam[6, 0], 0.0, atol=0.0)
    assert lam[7, 0] < 0.0
    assert np.all(np.isnan(lam[8:]))
    for i, one in enumerate(theta):
        alone = block.modes(one[None], 3)
        assert_array_equal(lam[i], alone[0][0])
        assert_array_equal(phi[i], alone[1][0])


def test_a_stack_is_asked_where_it_can_answer(monkeypatch):
    asked = []
    monkeypatch.setattr(full_block, "eigen", lambda *given: asked.append(given) or eigen(*given))
    K, M = storeys([2.0, 3.0], [1.0, 1.0])
    (block,) = full_blocks(SeparableModel.from_terms(["k"], [(K, "k")], [M]))
    lam, _ = block.modes(np.linspace(1.0, 2.0, 50)[:, None], 2)
    assert not asked
    assert_allclose(lam, np.linspace(1.0, 2.0, 50)[:, None] * np.linalg.eigvalsh(K), rtol=1e-13)


def test_equal_eigenvalues():
    K = np.diag([4.0, 4.0, 9.0])
    lam, phi = lowest_modes(K[None], np.eye(3)[None], 3)
    assert_allclose(lam[0], [4.0, 4.0, 9.0], rtol=1e-14)
    assert_allclose(phi[0].T @ phi[0], np.eye(3), atol=1e-14)
