"""Factors of symmetric matrices: each solver solves a block, and counts the eigenvalues below zero."""

import sys
import time
from functools import reduce
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose

from fmu.fem.modes import eigensolver, solver
from fmu.fem.modes.factors import memory, pardiso, superlu
from fmu.fem.modes.factors.pardiso import n_threads
from fmu.fem.modes.solver import PARDISO, SUPERLU, factorise, sparse_solver
from fmu.progress.phases import told_to

fast = pytest.mark.skipif(find_spec("pypardiso") is None, reason="pypardiso, the extra fast, is not installed")
BANDED = None  # what a narrow band gets where no solver is named
SPARSE = [SUPERLU, pytest.param(PARDISO, marks=fast)]
SOLVERS = [SUPERLU, pytest.param(PARDISO, marks=fast), "LAPACK", BANDED]
N = 60


def chain(shift=0.0):
    """Return the stiffness of a chain of springs less `shift`; its eigenvalues are 2 − 2 cos(k π/(n + 1))."""
    return sp.csr_array(
        sp.diags_array([[2.0 - shift] * N, [-1.0] * (N - 1), [-1.0] * (N - 1)], offsets=[0, 1, -1])
    )


def arrow(n=600):
    """Return a matrix whose first row is full: every order of its rows has a wide band."""
    spread = sp.csr_array((np.full(n - 1, -1.0), (np.zeros(n - 1, dtype=int), np.arange(1, n))), shape=(n, n))
    return sp.csr_array(sp.diags_array(np.full(n, 2.0 * n)) + spread + spread.T)


def grid(*points):
    """Return the matrix of a grid of 40 x 20 x 20 points, or of others."""
    lines = [
        sp.csr_array(sp.diags_array([[2.0] * n, [-1.0] * (n - 1), [-1.0] * (n - 1)], offsets=[0, 1, -1]))
        for n in points or (40, 20, 20)
    ]
    return sp.csr_array(reduce(sp.kronsum, lines))


def factors(matrix, name):
    return factorise(matrix.toarray() if name == "LAPACK" else matrix, name)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("shift", [0.0, 1.03])
def test_it_solves_one_load_and_a_block_of_them(name, shift):
    A, loads = chain(shift), np.random.default_rng(0).standard_normal((N, 7))
    factor = factors(A, name)
    found = factor.solve(loads)
    # ten times the rounding of a matrix of condition 2000, or of 60 at a shift between its eigenvalues
    assert_allclose(A @ found, loads, atol=1e-11)
    assert_allclose(factor.solve(loads[:, 2]), found[:, 2], rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("name", SOLVERS)
@pytest.mark.parametrize("below", [0, 1, 17, N])
def test_inertia_is_the_number_of_eigenvalues_below(name, below):
    values = np.concatenate([[0.0], 2.0 - 2.0 * np.cos(np.arange(1, N + 1) * np.pi / (N + 1)), [4.2]])
    assert factors(chain(0.5 * (values[below] + values[below + 1])), name).negative == below


@pytest.mark.parametrize("name", SOLVERS)
def test_a_singular_matrix_is_an_error(name):
    singular = sp.csr_array(sp.diags_array([1.0] * (N - 1) + [0.0]))
    with pytest.raises(np.linalg.LinAlgError):
        factors(singular, name)


@pytest.mark.parametrize("name", SOLVERS)
def test_small_pivots_are_left_as_they_are(name):
    """A stiffness of 1e-12 of the others is one, not rounding."""
    soft = sp.csr_array(sp.diags_array(np.where(np.arange(N) % 7, 1.0, 1e-12)))
    assert_allclose(factors(soft, name).solve(np.ones(N)), np.where(np.arange(N) % 7, 1.0, 1e12), rtol=1e-10)


def test_pardiso_where_it_is_installed_else_superlu(monkeypatch):
    assert sparse_solver() == (PARDISO if find_spec("pypardiso") else SUPERLU)
    monkeypatch.setattr(solver, "find_spec", lambda name: None)
    assert sparse_solver() == SUPERLU
    assert type(factorise(arrow())).__name__ == "SuperLU"


def test_a_narrow_band_is_factorised_as_one_whatever_the_order_of_its_rows():
    order = np.random.default_rng(1).permutation(N)
    A = chain()[order][:, order]
    factor, loads = factorise(A), np.random.default_rng(2).standard_normal((N, 3))
    assert type(factor).__name__ == "BandedFactor"
    assert factor.n_entries == 4 * N  # of the diagonal and one beside it, and of the transpose
    assert_allclose(A @ factor.solve(loads), loads, atol=1e-11)
    heavier = factorise(2.0 * A)  # the same pattern
    assert_allclose(heavier.solve(loads[:, 0]), 0.5 * factor.solve(loads[:, 0]), rtol=1e-9)


def test_an_entry_given_in_parts_counts_in_full():
    A = sp.csr_array((np.array([1.0, 1.0, -1.0, -1.0, 2.0]), np.array([0, 0, 1, 0, 1]), np.array([0, 3, 5])))
    assert_allclose(factorise(A).solve(np.array([1.0, 0.0])), [2.0 / 3.0, 1.0 / 3.0], rtol=1e-14)


@pytest.mark.parametrize("name", SPARSE)
def test_entries_that_are_zero_change_no_bit_of_kept_factors(monkeypatch, name):
    """A model sums its terms in two ways, of which one drops entries that cancel."""
    monkeypatch.setattr(eigensolver, "LARGE", 1000)
    monkeypatch.setattr(solver, "sparse_solver", lambda: name)
    A = grid(20, 10, 10)
    some = np.random.default_rng(5).integers(0, 2000, size=(2, 4000))
    ones = sp.coo_array((np.ones(4000), some), shape=A.shape).tocsr()
    stored = sp.csr_array(A + 0.25 * (ones + ones.T))
    near = A.toarray()[stored.nonzero()]  # the entries of A at more places
    stored.data[:] = near
    assert stored.nnz > A.nnz == np.count_nonzero(near)
    loads, scale = np.random.default_rng(0).standard_normal((2000, 2)), np.ones(2000)
    one, other = (eigensolver.clear_factor(matrix, scale).solve(loads) for matrix in (A, stored))
    np.testing.assert_array_equal(one, other)


@fast
def test_pardiso_releases_what_it_holds():
    import weakref

    factor = factorise(chain(), PARDISO)
    held = weakref.ref(factor)
    del factor
    assert held() is None
    assert "pypardiso" in sys.modules


@fast
def test_pardiso_tells_the_number_of_entries():
    """From it follow the costs that decide on the size of a reduced basis."""
    n = 600
    # the first row is eliminated last: L has the diagonal and that row, stored with a few zeros
    assert 2 * n - 1 <= factorise(arrow(n), PARDISO).n_entries / 2 <= 2 * n + 20


@pytest.mark.parametrize("name", SPARSE)
def test_factors_that_do_not_fit_are_refused_before_they_are_made(monkeypatch, name):
    for module in (memory, pardiso):
        monkeypatch.setattr(module, "free_memory", lambda: 2**10)
    monkeypatch.setattr(superlu, "LARGE", 600)
    monkeypatch.setattr(superlu.ssl, "splu", None)
    with pytest.raises(MemoryError, match=r"the factors of 600 degrees of freedom need \S+ GiB, and 9.54e-7"):
        factorise(sp.csr_array(arrow()), name)


@pytest.mark.parametrize("name", SPARSE)
def test_the_memory_of_factors_is_told_before_they_are_made(monkeypatch, name):
    told = []
    monkeypatch.setattr(memory, "LARGE", 599)
    monkeypatch.setattr(superlu, "LARGE", 599)
    memory._tell_once.cache_clear()
    with told_to(None, tell=told.append):
        for _ in range(2):
            factorise(arrow(599), name)
    (fact,) = told
    assert fact.startswith("The factors of 599 degrees of freedom will take ")


@pytest.mark.parametrize("points", [grid(12, 10, 9), arrow(), chain()], ids=["grid", "arrow", "chain"])
def test_the_entries_of_superlu_are_counted_before(points):
    """Three motions in each point have rows with the same pattern; SuperLU stores a few zeros more."""
    matrix = sp.csc_array(sp.kron(points, np.ones((3, 3)) + 9.0 * np.eye(3)))
    counted, made = superlu.count_entries(matrix), superlu.SuperLU(matrix).n_entries
    assert counted <= made <= 1.02 * counted
    assert superlu.count_entries(2.0 * matrix) == counted


@fast
@pytest.mark.parametrize("is_definite", [True, False])
def test_factors_that_do_not_fit_are_kept_in_files(monkeypatch, tmp_path, is_definite):
    """Each has files of its own, which go with it."""
    A, loads = grid(20, 16, 15), np.random.default_rng(0).standard_normal((4800, 3))
    if not is_definite:
        A = sp.csr_array(A - 0.5 * sp.eye_array(4800))
    within = factorise(A, PARDISO, is_definite)
    monkeypatch.setattr(pardiso, "is_short", lambda needed: True)
    monkeypatch.setattr(pardiso, "_USERS_FOLDER", str(tmp_path))
    with pytest.warns(UserWarning, match="of 4.?800 degrees of freedom need .* they are kept in files in"):
        factors = [factorise(times * A, PARDISO, is_definite) for times in (1.0, 2.0)]
    sizes = [sum(file.stat().st_size for file in folder.iterdir()) for folder in tmp_path.iterdir()]
    assert len(sizes) == 2
    assert all(size > 4 * within.n_entries / 2 for size in sizes)
    exact = within.solve(loads)
    for times, factor in zip((1.0, 2.0), factors, strict=True):
        assert factor.negative == within.negative
        assert_allclose(times * factor.solve(loads), exact, rtol=1e-9, atol=1e-10 * np.abs(exact).max())
        assert_allclose(
            times * factor.solve(loads[:, 0]), exact[:, 0], rtol=1e-9, atol=1e-10 * np.abs(exact).max()
        )
    del factors, factor
    assert not list(tmp_path.iterdir())


@fast
def test_factors_in_single_precision_are_kept_in_files_too(monkeypatch, tmp_path):
    A, loads = grid(20, 16, 15), np.random.default_rng(0).standard_normal((4800, 2))
    exact = factorise(A, PARDISO).solve(loads)
    monkeypatch.setattr(pardiso, "is_short", lambda needed: True)
    monkeypatch.setattr(pardiso, "_USERS_FOLDER", str(tmp_path))
    monkeypatch.setattr(pardiso, "_SHARE", 0.0)
    with pytest.warns(UserWarning, match="they are kept in files"):
        factor = factorise(A, PARDISO)
    assert factor.is_single
    assert len(list(tmp_path.iterdir())) == 1
    assert_allclose(factor.solve(loads), exact, rtol=1e-9, atol=1e-10 * np.abs(exact).max())


@fast
def test_without_room_on_the_disk_factors_are_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(pardiso, "_USERS_FOLDER", str(tmp_path))
    monkeypatch.setattr(pardiso, "is_short", lambda needed: True)
    monkeypatch.setattr(pardiso.shutil, "disk_usage", lambda folder: SimpleNamespace(free=0))
    monkeypatch.setattr(memory, "free_memory", lambda: 2**10)
    with pytest.raises(MemoryError, match="of memory are free; coarsen or condense the model"):
        factorise(arrow(), PARDISO)
    assert not list(tmp_path.iterdir())


@fast
def test_factors_that_would_take_much_of_the_memory_are_in_single_precision(monkeypatch):
    loads = np.random.default_rng(4).standard_normal((N, 3))
    values = 2.0 - 2.0 * np.cos(np.arange(1, N + 1) * np.pi / (N + 1))
    for below in (0, 17):
        A = chain(0.5 * values[0] if not below else 0.5 * (values[below - 1] + values[below]))
        double = factorise(A, PARDISO, is_definite=not below)
        with monkeypatch.context() as patch:
            patch.setattr(pardiso, "total_memory", lambda double=double: 5.0 * double.n_bytes)
            single = factorise(A, PARDISO, is_definite=not below)
        assert (double.is_single, single.is_single) == (False, True)
        assert single.negative == double.negative == below
        assert single.n_entries == double.n_entries
        assert_allclose(single.solve(loads), double.solve(loads), rtol=1e-9, atol=1e-9)
        with monkeypatch.context() as patch:
            patch.setattr(pardiso, "total_memory", lambda double=double: 7.0 * double.n_bytes)
            assert not factorise(A, PARDISO, is_definite=not below).is_single


def test_free_memory_is_a_number_or_unknown():
    free = memory.free_memory()
    assert free is None or free > 2**20


@fast
@pytest.mark.parametrize("is_definite", [True, False])
def test_factors_do_not_depend_on_the_number_of_threads(monkeypatch, is_definite):
    """A grid of 40 x 20 x 20 points has fronts that several threads share."""
    monkeypatch.setattr(pardiso, "LARGE", 1000)
    loads = np.random.default_rng(0).standard_normal((16_000, 5))
    found = []
    for threads in ("1", "2"):
        monkeypatch.setenv("MKL_NUM_THREADS", threads)
        found.append(factorise(grid(), PARDISO, is_definite).solve(loads))
    np.testing.assert_array_equal(*found)


@fast
@pytest.mark.skipif(n_threads() < 2, reason="one processor")
def test_threads_share_the_factorisation(monkeypatch):
    monkeypatch.setattr(pardiso, "LARGE", 1000)
    monkeypatch.setenv("MKL_NUM_THREADS", "2")
    solver = factorise(grid(), PARDISO)
    in_all, here = time.process_time(), time.thread_time()
    pardiso._call(solver._solver, solver._upper, pardiso._ELIMINATE)
    in_all, here = time.process_time() - in_all, time.thread_time() - here
    assert here < 0.9 * in_all


def test_the_number_of_threads_is_the_users_or_that_of_processors(monkeypatch):
    for name in ("MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pardiso.os, "sched_getaffinity", lambda _: range(3), raising=False)
    assert n_threads() == 3
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert n_threads() == 1
    monkeypatch.setenv("MKL_NUM_THREADS", "32")
    assert n_threads() == 8


@fast
def test_the_library_is_looked_for_once(monkeypatch):
    """A search takes a second, and every factorisation makes a solver of its own."""
    factorise(arrow(), PARDISO)
    monkeypatch.setattr("pypardiso.pardiso_wrapper.find_library", None)
    monkeypatch.setattr("pypardiso.pardiso_wrapper.glob.glob", None)
    loads = np.ones(600)
    assert_allclose(arrow() @ factorise(arrow(), PARDISO).solve(loads), loads, rtol=1e-12)
