"""Frames of beam elements: assemble nodes, element groups, supports, masses and springs into a SeparableModel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, check_arguments
from fmu.fem.frame import beam
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, JointSpring, PointMass
from fmu.fem.frame.updates import Factor, Ownership, Quantity, Target, ownership
from fmu.fem.modes.separable import Geometry, RigidArm, SeparableModel
from fmu.fem.modes.terms import Powers, Term, merge_terms
from fmu.types import FloatArray, IntArray

Dof = tuple[int, str]

# Properties whose product multiplies each unit matrix of beam.py; G = E / (2 (1 + nu)) makes torsion follow E.
_STIFFNESS = {"EA": ("E", "A"), "EIy": ("E", "Iy"), "EIz": ("E", "Iz"), "GJ": ("E", "J")}
_MASS = {"rhoA": ("rho", "A"), "rhoIy": ("rho", "Iy"), "rhoIz": ("rho", "Iz")}


@check_arguments
@dataclass(frozen=True)
class Frame:
    """A structure of Euler–Bernoulli beam elements (`fmu.fem.frame.beam`).

    Attributes
    ----------
    nodes : array_like, shape (n_nodes, 3)
        Coordinates in m.
    groups : sequence of ElementGroup
    supports : mapping of int to sequence of str
        Fixed directions ("x" … "rz") of each supported node.
    masses : sequence of PointMass
    arms : mapping of hashable to RigidArm
        Points rigidly connected to nodes, by name, at which sensors may be placed.
    springs : sequence of JointSpring
        Springs to the ground and between nodes, and ties.

    Raises
    ------
    ValueError
        If a coordinate is not finite, a node does not have three coordinates, or there is no group.
    """

    nodes: ArrayLike
    groups: Sequence[ElementGroup]
    supports: Mapping[int, Sequence[str]] = field(default_factory=dict)
    masses: Sequence[PointMass] = ()
    arms: Mapping[Any, RigidArm] = field(default_factory=dict)
    springs: Sequence[JointSpring] = ()

    def __post_init__(self) -> None:
        self._coordinates()
        if not self.groups:
            raise ArgumentError("groups", "must be at least one", "none")

    @check_arguments
    def separable(self, updates: Mapping[str, Sequence[Target] | Factor] | None = None) -> SeparableModel:
        """Assemble K(theta) and M(theta), and return them as a model.

        Parameters
        ----------
        updates : mapping of parameter name to sequence of targets, or to Factor
            Targets of each parameter, in the order of theta. A target is

            - ``(property, group)``: ``"E"``, ``"rho"``, ``"A"``, ``"Iy"``, ``"Iz"`` or ``"J"`` of a group of
              elements. E acts on bending, axial and, through G = E/(2(1+ν)), torsional stiffness; Iy and Iz act
              on bending stiffness, rotary inertia and torsional inertia; A on axial stiffness and
              translational mass; J on torsional stiffness; rho on the mass matrix;
            - ``("mass", name)``, ``("inertia", name)`` or ``("inertia", name, direction)`` of a point mass;
            - ``("stiffness", name)`` or ``("stiffness", name, direction)`` of a spring.

            Without a direction, the target is every direction that the mass or spring has; without a name, as in
            ``("E",)``, it is every group, mass or spring. The parameter is the common value of all its targets,
            in SI units. A parameter given as ``Factor(targets)`` multiplies the value that each target has in the
            frame.

        Returns
        -------
        SeparableModel

        Raises
        ------
        ValueError
            If a target does not exist or is updated twice; an inertia of zero is updated without a direction; a
            factor multiplies a value of zero; the targets of a parameter that is not a `Factor` have values in
            different units; two groups, masses or springs have the same name; an element, support, mass, spring or
            arm is at a node that does not exist; an element has no length or is parallel to its y direction; a
            support has an unknown direction; nothing is free; tied nodes do not coincide; or a node without an
            element is free in a direction in which it has no mass or inertia.
        """
        owned = ownership(updates or {}, self.groups, self.masses, self.springs)
        nodes = self._coordinates()
        numbering = Numbering.of(len(nodes), self.supports, self.springs)
        self._check(nodes, numbering)
        K: list[tuple[sp.csr_array, Powers]] = []
        M: list[tuple[sp.csr_array, Powers]] = []
        for index, group in enumerate(self.groups):
            ends = np.asarray(group.elements, dtype=int)
            axis = nodes[ends[:, 1]] - nodes[ends[:, 0]]
            length = np.linalg.norm(axis, axis=1)
            y_direction = beam.horizontal(axis) if group.y_direction is None else group.y_direction
            axes = beam.local_axes(axis, y_direction)
            for recipe, unit, parts in (
                (_STIFFNESS, beam.stiffness_terms(length), K),
                (_MASS, beam.mass_terms(length), M),
            ):
                for name, properties in recipe.items():
                    scale, powers = owned.coefficient((Quantity(p, index), group.value(p)) for p in properties)
                    if name == "GJ":
                        scale /= 2 * (1 + group.material.nu)
                    matrix = _assemble(beam.to_global(unit[name], axes) * scale, ends, len(nodes))
                    parts.append((matrix, powers))
        K += self._spring_matrices(nodes, owned)
        M += self._mass_matrices(len(nodes), owned)
        elements = np.concatenate([np.asarray(group.elements, dtype=np.int64) for group in self.groups])
        K_terms, M_terms = (merge_terms([Term(numbering.restrict(m), of) for m, of in part]) for part in (K, M))
        return SeparableModel(
            K_terms,
            M_terms,
            numbering.names,
            Geometry(
                nodes,
                elements,
                [mass.node for mass in self.masses],
                [spring.nodes for spring in self.springs],
                [owned.of_spring(index) for index in range(len(self.springs))],
            ),
            self.arms,
            numbering.ties,
        )

    def _coordinates(self) -> FloatArray:
        nodes = np.asarray(self.nodes, dtype=float)
        if nodes.ndim != 2 or nodes.shape[1] != 3 or not np.all(np.isfinite(nodes)):
            raise ArgumentError("nodes", "must be finite x, y, z of every node", f"shape {nodes.shape}")
        return nodes

    def _check(self, nodes: FloatArray, numbering: Numbering) -> None:
        n_nodes = len(nodes)
        has_mass = np.zeros(6 * n_nodes, dtype=bool)
        for group in self.groups:
            for node in map(int, np.asarray(group.elements).ravel()):
                require_node(f"group {group.name!r}", node, n_nodes)
                has_mass[6 * node : 6 * node + 6] = True
        for mass in self.masses:
            require_node("masses", mass.node, n_nodes)
            has_mass[6 * mass.node : 6 * mass.node + 6] |= [mass.value(d) > 0.0 for d in DIRECTIONS]
        for place, arm in self.arms.items():
            require_node(f"arm {place!r}", arm.node, n_nodes)
        for spring in self.springs:
            spring.require_coincident(nodes)
        carried = np.zeros(6 * n_nodes, dtype=bool)
        carried[numbering.owner[has_mass]] = True
        # A free node without mass would make the mass matrix singular.
        loose = np.unique(numbering.free[~carried[numbering.free]] // 6).tolist()
        if loose:
            raise ArgumentError(
                "nodes", "a node without an element must be fixed, tied or have mass", f"nodes {loose}"
            )

    def _mass_matrices(self, n_nodes: int, owned: Ownership) -> list[tuple[sp.csr_array, Powers]]:
        lumped: dict[Powers, FloatArray] = {}
        for index, mass in enumerate(self.masses):
            for k, direction in enumerate(DIRECTIONS):
                quantity = Quantity("mass", index) if k < 3 else Quantity("inertia", index, direction)
                scale, powers = owned.coefficient([(quantity, mass.value(direction))])
                lumped.setdefault(powers, np.zeros(6 * n_nodes))[6 * mass.node + k] += scale
        return [(sp.csr_array(sp.diags_array(diagonal)), powers) for powers, diagonal in lumped.items()]

    def _spring_matrices(self, nodes: FloatArray, owned: Ownership) -> list[tuple[sp.csr_array, Powers]]:
        found = []
        for index, spring in enumerate(self.springs):
            for direction, value in spring.stiffness.items():
                scale, powers = owned.coefficient([(Quantity("stiffness", index, direction), value)])
                weights = spring.elongation(direction, nodes)
                column = sp.csr_array(
                    (list(weights.values()), (list(weights), [0] * len(weights))), shape=(6 * len(nodes), 1)
                )
                found.append((sp.csr_array(scale * column @ column.T), powers))
        return found


def _assemble(matrices: FloatArray, ends: IntArray, n_nodes: int) -> sp.csr_array:
    dofs = (6 * ends[:, :, None] + np.arange(6)).reshape(len(ends), 12)
    rows = np.repeat(dofs, 12, axis=1).ravel()
    columns = np.tile(dofs, (1, 12)).ravel()
    matrix = sp.coo_array((matrices.ravel(), (rows, columns)), shape=(6 * n_nodes,) * 2).tocsr()
    matrix.eliminate_zeros()
    return matrix


@dataclass(frozen=True, eq=False)
class Numbering:
    """Numbering of a frame's free degrees of freedom. A frame has six degrees of freedom per node.

    Attributes
    ----------
    owner : ndarray of int, shape (6 n_nodes,)
        For each degree of freedom 6 · node + 0 … 5, the index of the degree of freedom that represents it: its
        own index, or the index of the degree of freedom to which it is tied.
    free : ndarray of int
        Indices of the degrees of freedom that represent themselves and have no support, ascending.
    """

    owner: IntArray
    free: IntArray

    @classmethod
    def of(cls, n_nodes: int, supports: Mapping[int, Sequence[str]], springs: Sequence[JointSpring]) -> Numbering:
        """Build the numbering for a frame with these supports and springs.

        Raises
        ------
        ValueError
            If a support or spring is at a node that does not exist, a direction is unknown, or nothing is free.
        """
        owner = np.arange(6 * n_nodes)
        for spring in springs:
            for node in spring.nodes:
                if node is not None:
                    require_node(f"spring {spring.name!r}", node, n_nodes)
            for direction in spring.tied:
                k = DIRECTIONS.index(direction)
                pair = owner[[6 * int(node) + k for node in spring.nodes if node is not None]]
                owner[np.isin(owner, pair)] = pair.min()
        fixed: set[int] = set()
        for node, directions in supports.items():
            require_node("supports", node, n_nodes)
            for direction in directions:
                if direction not in DIRECTIONS:
                    raise ArgumentError("supports", f"direction must be one of {DIRECTIONS}", repr(direction))
                fixed.add(int(owner[6 * node + DIRECTIONS.index(direction)]))
        own = np.flatnonzero(owner == np.arange(len(owner)))
        free = own[~np.isin(own, list(fixed))]
        if not len(free):
            raise ArgumentError("supports", "must leave a degree of freedom free", f"all {len(owner)} fixed")
        return cls(owner, free)

    @property
    def names(self) -> list[Dof]:
        """Free degrees of freedom as (node, direction)."""
        return [_name(i) for i in self.free.tolist()]

    @property
    def ties(self) -> dict[Dof, Dof]:
        """The free degree of freedom that each tied degree of freedom follows, keyed by the tied one."""
        tied = np.flatnonzero((self.owner != np.arange(len(self.owner))) & np.isin(self.owner, self.free))
        return {_name(i): _name(j) for i, j in zip(tied.tolist(), self.owner[tied].tolist(), strict=True)}

    def restrict(self, matrix: sp.csr_array) -> sp.csr_array:
        """Reduce a matrix (6 n_nodes, 6 n_nodes) to the free degrees of freedom, with tied ones merged."""
        n = len(self.owner)
        if np.any(self.owner != np.arange(n)):
            T = sp.csr_array((np.ones(n), (np.arange(n), self.owner)), shape=(n, n))
            matrix = sp.csr_array(T.T @ matrix @ T)
        return matrix[self.free][:, self.free]


def require_node(where: str, node: int, n_nodes: int) -> None:
    """Raise ValueError unless `node` is one of 0 … n_nodes − 1."""
    if node not in range(n_nodes):
        raise ArgumentError(where, f"node must lie in 0..{n_nodes - 1}", node)


def _name(dof: int) -> Dof:
    return dof // 6, DIRECTIONS[dof % 6]
