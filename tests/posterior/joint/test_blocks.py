"""Hessians in blocks against the whole matrix."""

import numpy as np
from numpy.testing import assert_allclose

from fmu.posterior.joint.blocks import BlockHessian

N, P, D = 4, 2, 3


def both():
    """Return a Hessian of three main parameters and of two scores in each of four tests, and the whole matrix."""
    rng = np.random.default_rng(1)
    root, cross = rng.standard_normal((N, P, P)), rng.standard_normal((N, P, D))
    scores = root @ np.swapaxes(root, 1, 2) + np.eye(P)
    main = np.eye(D) + np.einsum("tik,tij,tjl->kl", cross, np.linalg.inv(scores), cross)
    whole = np.zeros((D + N * P, D + N * P))
    whole[:D, :D] = main
    for t in range(N):
        own = slice(D + t * P, D + (t + 1) * P)
        whole[own, own], whole[own, :D], whole[:D, own] = scores[t], cross[t], cross[t].T
    return BlockHessian(main, cross, scores), whole


def test_solutions_are_those_of_the_whole_matrix():
    hessian, whole = both()
    b = np.random.default_rng(2).standard_normal(len(whole))
    main, scores = hessian.solve(b[:D], b[D:].reshape(N, P))
    assert_allclose(np.concatenate([main, scores.ravel()]), np.linalg.solve(whole, b), rtol=1e-8, atol=1e-8)


def test_variances_of_scores_are_those_of_the_whole_matrix():
    hessian, whole = both()
    assert_allclose(hessian.score_variances().ravel(), np.diag(np.linalg.inv(whole))[D:], rtol=1e-8)
