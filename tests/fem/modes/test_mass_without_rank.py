"""Solids of reduced integration, whose mass matrix is zero for hundreds of motions."""

import shutil

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose
from skfem import Basis, BilinearForm, ElementHex1, ElementVector, MeshHex
from skfem.helpers import dot

import fmu
from fmu.fem.exports.from_exports import from_exports
from fmu.fem.exports.recovery import Export
from fmu.fem.frame.stability import require_stable
from fmu.fem.modes.eigensolver import DENSE_LIMIT, SingularMassError, eigen, is_semidefinite, rank
from fmu.formats.models.exported import NO_MESH, ExportedModel
from tests.models import bracket, free_bar
from tests.models.written import dense_frequencies
from tests.work import counted


def read_model_of(K, M, dofs):
    """Return matrices without a mesh as another program would have exported them."""
    return ExportedModel(K, M, dofs, *NO_MESH[:4])


@pytest.fixture(scope="module")
def solid():
    """Return K of a clamped bar, its mass by one point an element, and the nodes: 600 DOF and a rank of 384."""
    n = (8, 4, 4)
    K, _, dofs = free_bar.matrices(n)
    ends = (free_bar.LENGTH, free_bar.WIDTH, free_bar.WIDTH)
    mesh = MeshHex.init_tensor(*(np.linspace(0.0, end, m + 1) for end, m in zip(ends, n, strict=True)))
    basis = Basis(mesh, ElementVector(ElementHex1()), quadrature=(np.full((3, 1), 0.5), np.ones(1)))
    M = 7850.0 * BilinearForm(lambda u, v, _: dot(u, v)).assemble(basis)
    free = np.flatnonzero(basis.doflocs[0] > 1e-9)
    return K[free][:, free], sp.csr_array(0.5 * (M + M.T))[free][:, free], [dofs[i] for i in free]


def test_zeros_of_the_mass_are_counted_by_inertia(solid):
    _, M, _ = solid
    exact = np.linalg.matrix_rank(M.toarray(), tol=1e-10 * abs(M).max(), hermitian=True)
    assert exact < M.shape[0] - 200
    with counted() as work:
        assert rank(M) == exact
    assert work.factorisations <= 3
    assert work.solves == 0


def test_digits_of_an_export_do_not_change_the_count(solid):
    _, M, _ = solid
    printed = M.copy()
    printed.data = np.array([float(f"{x:.9e}") for x in M.data])
    assert rank(printed) == rank(M)


def test_negative_masses_are_still_refused(solid):
    _, M, _ = solid
    wrong = (M - 1e-3 * sp.diags_array(M.diagonal())).tocsr()
    assert not is_semidefinite(wrong)
    with pytest.raises(SingularMassError, match="not positive semidefinite"):
        rank(wrong)


def test_modes_and_the_note_on_digits_cost_a_few_factorisations(solid):
    K, M, dofs = solid
    with counted() as work:
        lam, _ = eigen(K, M, 5)
        exports = [Export({"E": E}, read_model_of(K * E, M, dofs)) for E in (1.0, 1.5, 0.7)]
        model = from_exports(exports)
        require_stable(model, [1.0])
    assert_allclose(np.sqrt(lam) / (2 * np.pi), dense_frequencies(K, M, 5), rtol=1e-8)
    assert work.factorisations <= 20
    assert work.solves <= 600


@pytest.mark.skipif(shutil.which("ccx") is None, reason="needs CalculiX (ccx)")
def test_a_bracket_of_calculix(tmp_path):
    planted = bracket.write(tmp_path, bracket.SMALL)
    with counted() as work:
        problem = fmu.load(planted.path)
    assert problem.model.structure.n_dof > DENSE_LIMIT
    assert work.factorisations <= 40
    assert problem.model.full_solves == 0
    theta = np.array(list(bracket.TRUTH.values()))
    # CalculiX prints seven digits of the frequencies
    assert_allclose(problem.frequencies(theta), planted.frequencies_hz(bracket.TRUTH), rtol=1e-6)
    spring = [term for term in problem.model.structure.K_terms if term.constant]
    assert spring[0].matrix.nnz == 1  # found among thousands of entries
    assert_allclose(spring[0].matrix.data, 4e7, rtol=1e-6)
