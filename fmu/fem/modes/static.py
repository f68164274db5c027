"""Static displacements and mass properties of a structure as functions of theta, with exact derivatives."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fmu.engines.blas import single_thread
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.solver import factorise
from fmu.fem.modes.terms import ParametricMatrix, sum_at
from fmu.numbers import significant
from fmu.types import Dof, FloatArray

TRANSLATIONS = ("x", "y", "z")
_FIRST, _CHECKS, _MOST = 32, 8, 1024
"""Numbers of points at which the full stiffness is solved: initially, for the check, and at most."""
_CONVERGED = 1e-9
"""Largest relative displacement error at the check points."""
_DEPENDENT = 1e-13
"""Singular value, relative to the largest, below which a vector adds nothing to the basis."""


def rigid_translation(model: SeparableModel, direction: str) -> FloatArray:
    """Return the displacement vector (n_dof,) that moves all free nodes by 1 m along one axis.

    It is zero if no node is free along this axis. For degrees of freedom along a node's local axes, the entries
    are the components of this displacement along these axes.
    """
    names = np.array([d for _, d in model.dofs])
    if model.geometry is not None and model.geometry.ids is not None:
        known = {i: d for _, d, seen in model.locate_motions() for i in seen}
        names = np.array([known.get(i, "") for i in range(model.n_dof)])  # not inside elements
    motion = (names == direction).astype(float)
    for name in _along_own_axes(model):
        motion[model.dof_of[name]] = model.motions.get((name[0], direction), {}).get(name, 0.0)
    return motion


def _along_own_axes(model: SeparableModel) -> set[Dof]:
    """Return the names of translational degrees of freedom that are along a local axis of their node."""
    return {
        name
        for (node, _), weights in model.motions.items()
        for name in weights
        if name[0] == node and name[1] in TRANSLATIONS and name in model.motions
    }


class MassMoments:
    """Mass and centre of gravity of the parts that are free to move along one direction.

    m(θ) = rᵀ M(θ) r and x_c(θ) = rᵀ M(θ) (x ∘ r) / m(θ), where r is the translation along the direction and x are
    the node coordinates. The sums over nodes are computed once, for each term of M.

    Parameters
    ----------
    model : SeparableModel
    start : ndarray, shape (n_parameters,)
        Parameters at which the direction is chosen: the axis x, y or z along which most mass moves.
    with_centre : bool
        Whether the centre of gravity is needed too, which requires the model's geometry.

    Attributes
    ----------
    direction : str

    Raises
    ------
    ValueError
        If no degree of freedom is a translation, or the centre is needed and the nodes have no coordinates.
    """

    def __init__(self, model: SeparableModel, start: FloatArray, with_centre: bool) -> None:
        motions = {d: rigid_translation(model, d) for d in TRANSLATIONS}
        M = model.M(start)
        masses = {d: float(r @ (M @ r)) for d, r in motions.items() if r.any()}
        if not masses:
            raise ValueError("mass: needs degrees of freedom that are translations, named x, y or z")
        self.direction = max(masses, key=masses.__getitem__)
        r = motions[self.direction]
        arms = [np.ones(model.n_dof)]
        if with_centre:
            arms += list(_coordinates(model).T)
        self._map = ParametricMatrix(model.M_terms)
        self._sums = np.array([[float(r @ (term.matrix @ (x * r))) for x in arms] for term in model.M_terms])

    def __call__(self, theta: FloatArray, gradient: bool = False) -> tuple[FloatArray, FloatArray | None]:
        """Return the mass in kg and, if `with_centre`, the centre in m, (n, 1 or 4), at theta (n, n_parameters).

        Also return the derivatives, shape (n, 1 or 4, n_parameters), or None if `gradient` is False.
        """
        moments = np.einsum("nk,kq->nq", self._map.coefficients(theta), self._sums)
        mass = moments[:, :1]
        values = np.concatenate([mass, moments[:, 1:] / mass], axis=1)
        if not gradient:
            return values, None
        forms = np.broadcast_to(self._sums, (len(theta), *self._sums.shape))
        slopes = self._map.contract(theta, forms)
        of_centre = (slopes[:, 1:] - values[:, 1:, None] * slopes[:, :1]) / mass[..., None]
        return values, np.concatenate([slopes[:, :1], of_centre], axis=1)


class StaticDisplacement:
    """Displacement u(θ) = bᵀ K(θ)⁻¹ f under a static load f, where b maps displacements to the measured one.

    K is projected onto K(θ_s)⁻¹ [f b] at sampled points θ_s. The basis contains the primal and the dual solution
    at these points. The error of u at any θ is at most the product of the errors of both solutions in the energy
    norm (Quarteroni, Manzoni & Negri 2016, chapter 3).

    Parameters
    ----------
    model : SeparableModel
    force : tuple of (place, direction)
        Place and direction of the load, given as for a sensor.
    load : float, N or N·m
    at : tuple of (place, direction)
        Place and direction of the measured displacement (or rotation).
    points : callable
        Each call ``points(n)`` returns n new parameter vectors, shape (n, n_parameters), in the range where u is
        needed.

    Attributes
    ----------
    error : float
        Largest relative error at points that are not used for the basis; 0 if u is exactly zero at one of them.
    n_solves : int
        Number of solves with the full stiffness for the basis.

    Raises
    ------
    ValueError
        If a place sees no free degree of freedom, K is not positive definite at a sampled point, or the error
        stays above 1e-9 with the largest basis (unless that spans all degrees of freedom).
    """

    def __init__(
        self,
        model: SeparableModel,
        force: Dof,
        load: float,
        at: Dof,
        points: Callable[[int], FloatArray],
    ) -> None:
        rows = model.observation([force, at]).toarray()
        loads = np.stack([load * rows[0], rows[1]], axis=1)
        solved: list[FloatArray] = []
        self.n_solves, n = 0, _FIRST
        with single_thread():
            theta = points(_CHECKS)
            exact = np.array([loads[:, 1] @ _solve_loads(model, one, loads)[:, 0] for one in theta])
            while True:
                solved += [_solve_loads(model, one, loads) for one in points(n)]
                self.n_solves += n
                self._project(model, np.concatenate(solved, axis=1), loads)
                self.error = float(np.max(np.abs(self(theta)[0][:, 0] / exact - 1.0))) if np.all(exact) else 0.0
                if self.error <= _CONVERGED or self._K.shape[1] == model.n_dof:
                    break
                if self.n_solves + n > _MOST:
                    raise ValueError(
                        f"static: the displacement by a reduced stiffness must agree with the full one to "
                        f"{significant(_CONVERGED)} (got {significant(self.error)} after {self.n_solves} solves); "
                        "narrow the bounds"
                    )
                n *= 2

    def _project(self, model: SeparableModel, vectors: FloatArray, loads: FloatArray) -> None:
        """Project the stiffness terms and loads onto a basis of the span of `vectors`.

        The basis is orthonormal in the scaled unknowns. Directions that are linearly dependent up to rounding are
        left out.
        """
        weight = np.sqrt(sum(np.abs(term.matrix.diagonal()) for term in model.K_terms))  # scales the unknowns
        weighted = weight[:, None] * vectors
        U, s, _ = np.linalg.svd(weighted / np.linalg.norm(weighted, axis=0), full_matrices=False)
        V = U[:, s > _DEPENDENT * s[0]] / weight[:, None]
        self._map = ParametricMatrix(model.K_terms)
        self._K = np.array([_symmetric(V.T @ (term.matrix @ V)) for term in model.K_terms])
        self._loads = V.T @ loads

    def __call__(self, theta: FloatArray, gradient: bool = False) -> tuple[FloatArray, FloatArray | None]:
        """Return u in m or rad, shape (n, 1), at theta (n, n_parameters), with NaN where K is singular.

        Also return its derivatives, shape (n, 1, n_parameters), or None if `gradient` is False.
        """
        # einsum without `optimize` adds term by term, so that a result does not depend on the rest of the batch
        K = np.einsum("nk,kij->nij", self._map.coefficients(theta), self._K)
        x = np.full((len(K), *self._loads.shape), np.nan)
        for i, one in enumerate(K):  # a singular matrix at one point must not fail the other points
            try:
                x[i] = np.linalg.solve(one, self._loads)
            except np.linalg.LinAlgError:
                continue
        u = np.einsum("r,nr->n", self._loads[:, 1], x[:, :, 0])[:, None]
        if not gradient:
            return u, None
        forms = -np.einsum("nir,krs,nsi->nki", np.swapaxes(x[:, :, 1:], 1, 2), self._K, x[:, :, :1])
        return u, self._map.contract(theta, forms)


def _coordinates(model: SeparableModel) -> FloatArray:
    """Return the node coordinates for each degree of freedom, (n_dof, 3). Raise ValueError if a node has none."""
    geometry = model.geometry
    if geometry is None or not all(node in geometry.row_of for node, _ in model.dofs):
        raise ValueError("centre: needs the coordinates of all nodes; give the model a mesh or a geometry")
    return np.asarray(geometry.nodes)[[geometry.row_of[node] for node, _ in model.dofs]]


def _solve_loads(model: SeparableModel, theta: FloatArray, loads: FloatArray) -> FloatArray:
    """Return K(θ)⁻¹ times `loads` (n_dof, 2). K is first scaled to a unit diagonal.

    Raise ValueError if K is not positive definite, or too nearly singular for an accurate solution.
    """
    K = sum_at(model.K_terms, theta)
    scale = 1.0 / np.sqrt(np.where(K.diagonal() > 0.0, K.diagonal(), 1.0))
    scaled = K.multiply(scale[:, None]).multiply(scale).tocsr()
    try:
        factor = factorise(scaled)
        x = scale[:, None] * np.asarray(factor.solve(scale[:, None] * loads))
    except np.linalg.LinAlgError:
        raise ValueError(_SINGULAR) from None
    off = np.linalg.norm(K @ x - loads, axis=0)
    if factor.negative or not np.all(off <= 1e-6 * np.linalg.norm(loads, axis=0)):
        raise ValueError(_SINGULAR)
    return x


_SINGULAR = (
    "static: the stiffness must be positive definite within the bounds (it is singular: the structure, or a part "
    "of it, is free to move, and a static load has no displacement)"
)


def _symmetric(matrix: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (matrix + matrix.T))
