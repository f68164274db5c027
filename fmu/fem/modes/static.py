"""Static displacements and mass properties of a structure as functions of theta, with exact derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from fmu.engines.blas import single_thread
from fmu.fem.modes.separable import RigidArm, SeparableModel
from fmu.fem.modes.solver import factorise
from fmu.fem.modes.terms import ParametricMatrix, sum_at
from fmu.numbers import significant
from fmu.types import DIRECTIONS, Dof, FloatArray

TRANSLATIONS, ROTATIONS = DIRECTIONS[:3], DIRECTIONS[3:]
_FIRST, _CHECKS, _MOST = 32, 8, 1024
"""Numbers of points at which the full stiffness is solved: initially, for the check, and at most."""
_CONVERGED = 1e-9
"""Largest displacement error at the check points, relative to the scale of `StaticDisplacement.error`."""
_DEPENDENT = 1e-13
"""Singular value, relative to the largest, below which a vector adds nothing to the basis."""


def uniform_motion(model: SeparableModel, direction: str) -> FloatArray:
    """Return the displacement vector (n_dof,) that moves all free nodes by 1 m along x, y or z.

    For direction rx, ry or rz it turns all free nodes by 1 rad, each about itself. It is zero if no node is free
    in this direction. For degrees of freedom along a node's local axes, the entries are the components along these
    axes.
    """
    names = np.array([d for _, d in model.dofs])
    if model.geometry is not None and model.geometry.ids is not None:
        known = {i for *_, seen in model.locate_motions() for i in seen}
        names = np.array([d if i in known else "" for i, d in enumerate(names)])  # not inside elements
    motion = (names == direction).astype(float)
    for name in _along_own_axes(model, TRANSLATIONS if direction in TRANSLATIONS else ROTATIONS):
        motion[model.dof_of[name]] = model.motions.get((name[0], direction), {}).get(name, 0.0)
    return motion


def _along_own_axes(model: SeparableModel, directions: Sequence[str]) -> set[Dof]:
    """Return the names of degrees of freedom in some of `directions` that are along a local axis of their node."""
    return {
        name
        for (node, _), weights in model.motions.items()
        for name in weights
        if name[0] == node and name[1] in directions and name in model.motions
    }


class MassMoments:
    """Mass and centre of gravity of the parts that are free to move along one direction.

    m(θ) = rᵀ M(θ) r and x_c(θ) = rᵀ M(θ) (x ∘ r + t) / m(θ), where r is the unit translation of all nodes along
    the direction, and x is one coordinate of the nodes. The vector t contains the nodal rotations in the rigid
    rotation of the structure that moves each point along the direction by its coordinate x. A mass on a rigid arm
    therefore counts at its own place. For the coordinate along the direction itself, there is no such rotation. If
    another translation moves the same mass, this translation replaces r for that coordinate; otherwise t = 0.
    Where t = 0, or nodes cannot rotate, masses on arms count at their nodes. The sums over nodes are computed
    once, for each term of M.

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
        motions = {d: uniform_motion(model, d) for d in TRANSLATIONS}
        M = model.M(start)
        masses = {d: float(r @ (M @ r)) for d, r in motions.items() if r.any()}
        if not masses:
            raise ValueError("mass: needs degrees of freedom that are translations, named x, y or z")
        self.direction = max(masses, key=masses.__getitem__)
        r = motions[self.direction]
        self._map = ParametricMatrix(model.M_terms)
        sums = [self._moments(r, r)]
        if with_centre:
            turned = {d: uniform_motion(model, d) for d in ROTATIONS}
            for (i, j, k), x in zip(np.eye(3).tolist(), _coordinates(model).T, strict=True):
                along = self._direction_across(TRANSLATIONS[[i, j, k].index(1.0)], motions)
                point = RigidArm(0, (i, j, k)).motion(along)  # at 1 m from the axes of rotation
                turn = sum(weight * turned[d] for d, weight in point.items() if d in turned)
                sums.append(self._moments(motions[along], x * motions[along] + turn))
        self._sums = np.stack(sums, axis=1)

    def _moments(self, r: FloatArray, v: FloatArray) -> FloatArray:
        """Return rᵀ M_k v for each term of M, shape (n_terms,)."""
        return np.array([float(r @ (term.matrix @ v)) for term in self._map.terms])

    def _direction_across(self, axis: str, motions: Mapping[str, FloatArray]) -> str:
        """Return a direction that is not along `axis` and moves the same mass as `direction`, if there is one."""
        mass = self._moments(motions[self.direction], motions[self.direction])
        for d in (self.direction, *TRANSLATIONS):
            r = motions[d]
            if d != axis and np.allclose(self._moments(r, r), mass, rtol=1e-9, atol=1e-9 * np.abs(mass).max()):
                return d
        return self.direction

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
        Largest error at points that are not used for the basis, relative to √(fᵀK⁻¹f · bᵀK⁻¹b). This is the
        largest displacement that the Cauchy–Schwarz inequality allows; u may be far smaller, or zero by symmetry.
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
            exact = np.array([loads.T @ _solve_loads(model, one, loads) for one in theta])
            scale = np.sqrt(exact[:, 0, 0] * exact[:, 1, 1])
            while True:
                solved += [_solve_loads(model, one, loads) for one in points(n)]
                self.n_solves += n
                self._project(model, np.concatenate(solved, axis=1), loads)
                self.error = float(np.max(np.abs(self(theta)[0][:, 0] - exact[:, 1, 0]) / scale))
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
    """Return the node coordinates for each displacement, shape (n_dof, 3), and zeros for each rotation.

    Raise ValueError if a node that can be displaced has no coordinates.
    """
    geometry = model.geometry
    shifts = [(i, node) for i, (node, d) in enumerate(model.dofs) if d in TRANSLATIONS]
    if geometry is None or not all(node in geometry.row_of for _, node in shifts):
        raise ValueError("centre: needs the coordinates of all nodes; give the model a mesh or a geometry")
    places = np.zeros((model.n_dof, 3))
    for i, node in shifts:
        places[i] = geometry.nodes[geometry.row_of[node]]
    return places


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
