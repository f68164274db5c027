"""Directions that are added to a reduced basis."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fmu.fem.reduced.space import new_directions


@pytest.mark.parametrize("dependent", [False, True])
def test_new_directions_are_orthonormal_in_the_given_product(dependent):
    rng = np.random.default_rng(1)
    root = rng.standard_normal((12, 12)) + 4.0 * np.eye(12)
    A = root.T @ root
    V = np.linalg.solve(np.linalg.cholesky(A).T, np.linalg.qr(rng.standard_normal((12, 3)))[0])
    assert_allclose(V.T @ A @ V, np.eye(3), atol=1e-12)
    X = rng.standard_normal((12, 4))
    if dependent:
        X[:, 3] = V @ [1.0, -2.0, 0.5] + X[:, 0]
    W = new_directions(V, X, A)
    assert W.shape == (12, 3 if dependent else 4)
    assert_allclose(V.T @ A @ W, 0.0, atol=1e-12)
    assert_allclose(W.T @ A @ W, np.eye(W.shape[1]), atol=1e-12)
    both = np.concatenate([V, W], axis=1)
    assert_allclose(both @ (both.T @ (A @ X)), X, atol=1e-10)
