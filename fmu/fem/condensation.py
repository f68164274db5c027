"""Classical reductions of a stiffness and a mass matrix: Guyan and Craig–Bampton.

Both are Ritz approximations K_r = Tᵀ K T, M_r = Tᵀ M T, so the reduced frequencies are never below the exact
ones. Both reduce a single pair K, M. For a model that is solved at many theta, the basis in
`fmu.fem.reduced.basis` is smaller and certified.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as ssl
from annotated_types import Ge
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components

from fmu.arguments import ArgumentError, Numbers, check_arguments, require, shown
from fmu.fem.modes.eigensolver import eigen, rank
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.solver import Matrix
from fmu.types import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Reduction:
    """Stiffness and mass matrices reduced by a Ritz basis.

    Attributes
    ----------
    K, M : ndarray, shape (r, r)
    basis : ndarray, shape (n_dof, r)
        T in u = T q. Its first columns belong to the retained degrees of freedom.
    retained : ndarray of int, shape (n_retained,)
        Indices of the physical degrees of freedom among the coordinates q, in the order of q.
    """

    K: FloatArray
    M: FloatArray
    basis: FloatArray
    retained: IntArray

    def eigen(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the lowest eigenvalues (count,) in (rad/s)², and the full mode shapes (n_dof, count).

        Raise ValueError if `count` is less than 1 or exceeds the number of modes with a finite frequency.
        """
        lam, q = eigen(sp.csr_array(self.K), sp.csr_array(self.M), count)
        return lam, self.basis @ q


@check_arguments
def guyan(K: Matrix, M: Matrix, masters: ArrayLike) -> Reduction:
    """Condense K and M statically onto master degrees of freedom (Guyan 1965).

    All other degrees of freedom, the slaves, are in static equilibrium, so the basis is T = [I; −K_ss⁻¹ K_sm],
    where m are the masters and s the slaves. The reduction is exact at zero frequency. Its error grows with
    ω²/λ_1, where λ_1 is the lowest eigenvalue of the structure with its masters fixed.

    Parameters
    ----------
    K, M : array_like or sparse, shape (n_dof, n_dof)
        Symmetric.
    masters : array_like of int, shape (n_masters,)
        Indices of the degrees of freedom to retain, in the desired order.

    Returns
    -------
    Reduction

    Raises
    ------
    ValueError
        If the matrices are not finite, not square or not of the same size, there is no master, a master is not a
        whole number, does not exist or is given twice, or the structure can still move with all masters fixed.
    """
    K, M = _matrices(K, M)
    masters = _index("masters", masters, K.shape[0])
    return _ritz(K, M, StaticCondensation(K, masters).extend(np.eye(len(masters))), masters)


@check_arguments
def craig_bampton(K: Matrix, M: Matrix, boundary: ArrayLike, n_modes: Annotated[int, Ge(0)]) -> Reduction:
    """Reduce K and M by the Craig–Bampton method (Craig & Bampton 1968).

    The boundary separates the interior (all other degrees of freedom) into substructures. The basis consists of
    one constraint mode per boundary degree of freedom and, for each substructure, its lowest `n_modes`
    fixed-interface modes with finite frequency.

    Parameters
    ----------
    K, M : array_like or sparse, shape (n_dof, n_dof)
        Symmetric.
    boundary : array_like of int, shape (n_boundary,)
        Indices of the boundary degrees of freedom.
    n_modes : int
        Number of fixed-interface modes for each substructure; a substructure with fewer modes uses all of them.
        With 0, `guyan` with the boundary as masters gives the same result.

    Returns
    -------
    Reduction

    Raises
    ------
    ValueError
        In the cases listed for `guyan`, where `boundary` replaces the masters. Also if `n_modes` is negative, or a
        substructure's mass matrix is not positive semidefinite.

    Notes
    -----
    If parameters only scale the stiffness of whole substructures, constraint modes and fixed-interface modes do
    not change and the basis can be reused. The basis cannot be reused if a parameter changes a substructure's
    mass, or its stiffness unevenly; see `reusable`.
    """
    K, M = _matrices(K, M)
    boundary = _index("boundary", boundary, K.shape[0])
    columns = [StaticCondensation(K, boundary).extend(np.eye(len(boundary)))]
    for interior in substructures(K, M, boundary):
        inner = M[interior][:, interior]
        finite = rank(inner)
        count = min(n_modes, finite)
        if count:
            modes = np.zeros((K.shape[0], count))
            modes[interior] = eigen(K[interior][:, interior], inner, count, finite)[1]
            columns.append(modes)
    return _ritz(K, M, np.concatenate(columns, axis=1), boundary)


def substructures(K: Matrix, M: Matrix, boundary: ArrayLike) -> tuple[IntArray, ...]:
    """Return the interior degrees of freedom of each part into which the boundary divides the structure.

    There is one index array per substructure.
    """
    interior = np.setdiff1d(np.arange(K.shape[0]), np.asarray(boundary, dtype=np.int64))
    pattern = sp.csr_array(abs(K) + abs(M))[interior][:, interior]
    count, label = connected_components(pattern, directed=False)
    return tuple(interior[label == k] for k in range(count))


def reusable(model: SeparableModel, theta: ArrayLike, boundary: ArrayLike) -> tuple[bool, ...]:
    """Return, for each substructure, whether its Craig–Bampton modes at `theta` are valid at every theta.

    The modes are valid at every theta if a single coefficient scales the stiffness of the substructure's interior
    and of its connection to the boundary, and no parameter changes the interior's mass.

    Parameters
    ----------
    model : SeparableModel
    theta : array_like, shape (n_parameters,)
        Parameters at which the substructures are determined.
    boundary : array_like of int
        Indices of the boundary degrees of freedom.
    """
    verdicts = []
    for interior in substructures(model.K(theta), model.M(theta), boundary):
        scales = {t.powers for t in model.K_terms if abs(t.matrix[interior]).sum() > 0}
        masses = (t for t in model.M_terms if abs(t.matrix[interior][:, interior]).sum() > 0)
        verdicts.append(len(scales) == 1 and all(t.constant for t in masses))
    return tuple(verdicts)


_PIVOT = 1e-13


class SingularCondensationError(ValueError):
    """Raised when the structure can still move with its masters fixed."""


class StaticCondensation:
    """Static response u = T x of the whole structure to displacements x of its masters.

    T = [I; −K_ss⁻¹ K_sm], where m are the masters and s all other degrees of freedom.

    Parameters
    ----------
    K : sparse, shape (n_dof, n_dof)
    masters : ndarray of int
        Indices of the master degrees of freedom.

    Raises
    ------
    SingularCondensationError
        If K_ss is singular to rounding.
    """

    def __init__(self, K: Matrix, masters: IntArray) -> None:
        K = sp.csc_array(K)
        self.n_dof, self.masters = K.shape[0], masters
        self.slaves = np.setdiff1d(np.arange(self.n_dof), masters)
        self._coupling = K[self.slaves][:, masters]
        inner = K[self.slaves][:, self.slaves].tocsc()
        # scaled to a unit diagonal, K_ss has a pivot of the order of the rounding error if the masters do not hold
        # the structure: 1e-15 for any mesh, compared with 1e-8 for a held beam of 4000 elements
        size = np.sqrt(np.abs(inner.diagonal()))
        self._unit = (1.0 / np.where(size > 0, size, 1.0))[:, None]
        if len(self.slaves):
            unit = sp.diags_array(self._unit[:, 0])
            try:
                self._factor = ssl.splu(sp.csc_array(unit @ inner @ unit))
            except RuntimeError as error:
                raise SingularCondensationError(_MOVES) from error
            if not np.min(np.abs(self._factor.U.diagonal())) > _PIVOT:
                raise SingularCondensationError(_MOVES)

    def extend(self, x: FloatArray) -> FloatArray:
        """Return T x, shape (n_dof, m), for master displacements x, shape (n_masters, m)."""
        u = np.zeros((self.n_dof, x.shape[1]))
        u[self.masters] = x
        u[self.slaves] = self._inner(-(self._coupling @ x))
        return u

    def solve_held(self, load: FloatArray) -> FloatArray:
        """Return the displacements (n_dof, m) under loads (n_dof, m), with the masters fixed."""
        u = np.zeros_like(load)
        u[self.slaves] = self._inner(load[self.slaves])
        return u

    def transfer(self, load: FloatArray) -> FloatArray:
        """Return the equivalent loads on the masters, Tᵀ load, shape (n_masters, m)."""
        return np.asarray(load[self.masters] - self._coupling.T @ self._inner(load[self.slaves]))

    def _inner(self, load: FloatArray) -> FloatArray:
        return self._unit * self._factor.solve(self._unit * load) if len(load) else load


_MOVES = "masters: the structure can still move when they are held (singular K_ss)"


def _ritz(K: Matrix, M: Matrix, T: FloatArray, retained: IntArray) -> Reduction:
    K_r, M_r = (T.T @ (sp.csr_array(matrix) @ T) for matrix in (K, M))
    return Reduction(0.5 * (K_r + K_r.T), 0.5 * (M_r + M_r.T), T, retained)


def _matrices(K: Matrix, M: Matrix) -> list[sp.csr_array]:
    """Return both matrices as sparse arrays. Raise ValueError unless they are finite, square and equal in size."""
    found = []
    for name, matrix in (("K", K), ("M", M)):
        if not sp.issparse(matrix):
            require(name, matrix, Numbers)
        if len(np.shape(matrix)) != 2 or np.shape(matrix) != (np.shape(K)[0],) * 2:
            raise ArgumentError(name, "must be a square matrix, of the size of K", f"shape {np.shape(matrix)}")
        found.append(sp.csr_array(matrix))
        if not np.isfinite(found[-1].data).all():
            raise ArgumentError(name, "must be finite", "NaN or infinite entries")
    return found


def _index(name: str, dofs: ArrayLike, n_dof: int) -> IntArray:
    given = np.asarray(dofs)
    if given.ndim != 1 or len(given) == 0 or (given != np.trunc(given)).any() or np.isinf(given).any():
        raise ArgumentError(name, "must be a list of degrees of freedom", shown(dofs))
    index = given.astype(np.int64)
    if index.min() < 0 or index.max() >= n_dof:
        raise ArgumentError(name, f"must lie in 0..{n_dof - 1}", f"{int(index.min())}..{int(index.max())}")
    if len(np.unique(index)) < len(index):
        raise ArgumentError(name, "must be distinct", index.tolist())
    return index
