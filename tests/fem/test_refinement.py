"""Factors in single precision give solutions in double precision and count eigenvalues, or are refused."""

import numpy as np
import pytest
import scipy.linalg as sl
import scipy.sparse as sp
from numpy.testing import assert_allclose

from fmu.fem import refinement
from fmu.fem.refinement import RefinedFactor, StalledError
from tests.posterior.reduction.test_large_structure import SIZE
from tests.validation.scale_model import E, frame_model


class DenseInSingle:
    """Dense factors in single precision, Cholesky's or L D Lᵀ."""

    def __init__(self, matrix, is_definite):
        dense = matrix.toarray().astype(np.float32)
        self.n_entries, self.n_bytes, self._definite = dense.size, dense.nbytes, is_definite
        if is_definite:
            self.negative, self._factors = 0, sl.cho_factor(dense)
        else:
            lower, D, order = sl.ldl(dense)
            self.negative, self._factors = int(np.sum(np.linalg.eigvalsh(D) <= 0.0)), (lower[order], D, order)

    def solve(self, loads):
        loads = loads.astype(np.float32)
        if self._definite:
            return sl.cho_solve(self._factors, loads).astype(float)
        lower, D, order = self._factors
        half = np.linalg.solve(D, sl.solve_triangular(lower, loads[order], lower=True, unit_diagonal=True))
        found = np.empty_like(half)
        found[order] = sl.solve_triangular(lower.T, half, unit_diagonal=True)
        return found.astype(float)


def beam(n):
    """Return the fourth differences of a clamped beam, with a diagonal of one; its lowest λ falls as n⁻⁴."""
    bands = [[1.0] * n, [-4.0 / 6.0] * (n - 1), [1.0 / 6.0] * (n - 2)]
    return sp.csr_array(sp.diags_array([bands[0], *bands[1:], *bands[1:]], offsets=[0, 1, 2, -1, -2]))


def error_of(A, found, loads):
    """Return errors in the energy norm, relative to solutions by residuals in extended precision."""
    dense = A.toarray()
    exact = np.zeros(loads.shape, dtype=np.longdouble)
    for _ in range(4):
        exact += np.linalg.solve(dense, (loads - dense.astype(np.longdouble) @ exact).astype(float))
    off = (found - exact).astype(float)
    return np.sqrt(np.sum(off * (A @ off), axis=0) / np.sum(exact.astype(float) * loads, axis=0))


# lowest eigenvalues of 6e-6, 5e-8 and 1e-9: at the last of them factors in single precision err by all of it
@pytest.mark.parametrize("n", [60, 200, 500])
def test_solutions_are_as_accurate_as_in_double_precision(n):
    A, loads = beam(n), np.random.default_rng(0).standard_normal((n, 4))
    loads[:, 2] = 0.0
    loads[:, 3] *= 1e60  # beyond the range of single precision
    factor = RefinedFactor(A, DenseInSingle, True)
    found = factor.solve(loads)
    assert factor.is_single
    assert factor.negative == 0
    assert not np.any(found[:, 2])
    some = [0, 1, 3]
    # ten times the rounding of b − A x
    rounding = 1e-16 / np.linalg.eigvalsh(A.toarray())[0]
    assert np.max(error_of(A, found[:, some], loads[:, some])) < 10 * rounding
    assert np.max(error_of(A, factor.solve(loads[:, 0])[:, None], loads[:, :1])) < 10 * rounding


def test_eigenvalues_below_zero_are_counted_and_solved_for():
    A = beam(60)
    lam = np.linalg.eigvalsh(A.toarray())
    for below in (1, 7, 30):
        shifted = sp.csr_array(A - 0.5 * (lam[below - 1] + lam[below]) * sp.eye_array(60))
        loads = np.random.default_rng(1).standard_normal((60, 2))
        for expected in (False, True):  # as definite, it is found not to be
            factor = RefinedFactor(shifted, DenseInSingle, expected)
            assert factor.negative == below
            assert_allclose(shifted @ factor.solve(loads), loads, rtol=1e-7, atol=1e-9)


def test_a_count_that_single_precision_cannot_make_is_refused():
    A = beam(200)
    lam = np.linalg.eigvalsh(A.toarray())
    with pytest.raises(StalledError, match=r"too inaccurate: a step of refinement leaves \S+ of the error; hold"):
        RefinedFactor(sp.csr_array(A - (1.0 + 1e-4) * lam[0] * sp.eye_array(200)), DenseInSingle, False)


def test_a_free_structure_is_refused():
    n = 40
    stretch = sp.diags_array([[-1.0] * n, [1.0] * n], offsets=[0, 1], shape=(n, n + 1))
    free = sp.csr_array(stretch.T @ sp.diags_array(np.random.default_rng(3).uniform(1.0, 2.0, n)) @ stretch)
    with pytest.raises(MemoryError, match="hold the structure if it is free"):
        RefinedFactor(free, DenseInSingle, True)


@pytest.mark.parametrize("name", ["_STEPS", "_REFINED"])
def test_iterations_end_at_their_budget_with_a_message(monkeypatch, name):
    A = beam(100) if name == "_STEPS" else sp.csr_array(beam(60) - 1e-3 * sp.eye_array(60))
    factor = RefinedFactor(A, DenseInSingle, name == "_STEPS")
    monkeypatch.setattr(refinement, name, 1)
    with pytest.raises(StalledError, match=r"2 solutions have not converged after 1 step"):
        factor.solve(np.random.default_rng(2).standard_normal((A.shape[0], 2)))


def test_frames_have_the_frequencies_of_factors_in_double_precision(monkeypatch):
    from fmu.fem.modes import eigensolver

    model = frame_model(SIZE, 2)
    K, M = model.K([E, E]), model.M([E, E])
    exact = eigensolver.eigen(K, M, 6)[0]
    made = []

    def in_single(matrix, is_definite=True):
        made.append(RefinedFactor(sp.csr_array(matrix), DenseInSingle, is_definite))
        return made[-1]

    monkeypatch.setattr(eigensolver, "factorise", in_single)
    assert_allclose(np.sqrt(eigensolver.eigen(K, M, 6)[0]), np.sqrt(exact), rtol=1e-9)
    assert made
