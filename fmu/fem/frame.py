"""Frames of beam elements: nodes, groups of elements, supports and point masses -> a SeparableModel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from fmu.fem import beam
from fmu.fem.separable import Geometry, RigidArm, SeparableModel, Term, merge_terms

FloatArray = NDArray[np.float64]

DIRECTIONS = ("x", "y", "z", "rx", "ry", "rz")
PROPERTIES = ("E", "rho", "A", "Iy", "Iz", "J")

# What multiplies each unit matrix of beam.py; G = E / (2 (1 + nu)) makes torsion follow E.
_STIFFNESS = {"EA": ("E", "A"), "EIy": ("E", "Iy"), "EIz": ("E", "Iz"), "GJ": ("E", "J")}
_MASS = {"rhoA": ("rho", "A"), "rhoIy": ("rho", "Iy"), "rhoIz": ("rho", "Iz")}


@dataclass(frozen=True)
class Section:
    """Cross-section constants.

    Attributes
    ----------
    A : float
        Area, m².
    Iy, Iz : float
        Second moments of area ∫z² dA and ∫y² dA about the local axes, m⁴.
    J : float
        St-Venant torsion constant, m⁴.
    """

    A: float
    Iy: float
    Iz: float
    J: float

    def __post_init__(self) -> None:
        for name in ("A", "Iy", "Iz", "J"):
            _require_positive(name, getattr(self, name))

    @classmethod
    def rectangle(cls, width: float, height: float) -> Section:
        """Return the section of a rectangle, `width` along local y and `height` along local z, in m.

        The torsion constant is b t³/3 · (1 − 0.63 t/b + 0.052 (t/b)⁵) with the longer side b
        (Timoshenko & Goodier 1970, §109, the series cut after its leading terms).
        """
        _require_positive("width", width)
        _require_positive("height", height)
        b, t = max(width, height), min(width, height)
        J = b * t**3 / 3 * (1 - 0.63 * t / b + 0.052 * (t / b) ** 5)
        return cls(A=width * height, Iy=width * height**3 / 12, Iz=height * width**3 / 12, J=J)


@dataclass(frozen=True)
class Material:
    """Isotropic material: Young's modulus E (N/m²), Poisson's ratio nu, density rho (kg/m³)."""

    E: float
    nu: float
    rho: float

    def __post_init__(self) -> None:
        _require_positive("E", self.E)
        _require_positive("rho", self.rho)
        if not -1.0 < self.nu <= 0.5:
            raise ValueError(f"nu: must lie in (-1, 0.5] (got {self.nu})")


@dataclass(frozen=True)
class ElementGroup:
    """Beam elements that share a section, a material and, in an update, their parameters.

    Attributes
    ----------
    name : str
    elements : array_like of int, shape (n, 2)
        Node numbers (from 0) of both ends.
    section : Section
    material : Material
    y_direction : tuple of float, length 3
        A vector in the local x–y plane, in global axes; it fixes what Iy and Iz mean.
    """

    name: str
    elements: ArrayLike
    section: Section
    material: Material
    y_direction: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def value(self, name: str) -> float:
        """Return the initial value of a property of `PROPERTIES`."""
        return float(getattr(self.material if name in ("E", "rho") else self.section, name))


@dataclass(frozen=True)
class PointMass:
    """A mass (kg) on the three translations of a node, and rotary inertias (kg·m²) about its global axes."""

    node: int
    mass: float
    inertia: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Frame:
    """A structure of beam elements.

    Attributes
    ----------
    nodes : array_like, shape (n_nodes, 3)
        Coordinates in m.
    groups : sequence of ElementGroup
    supports : mapping of int to sequence of str
        Fixed directions ("x" … "rz") of a node.
    masses : sequence of PointMass
    arms : mapping of hashable to RigidArm
        Places beside the nodes at which sensors may sit, by name.
    """

    nodes: ArrayLike
    groups: Sequence[ElementGroup]
    supports: Mapping[int, Sequence[str]] = field(default_factory=dict)
    masses: Sequence[PointMass] = ()
    arms: Mapping[Any, RigidArm] = field(default_factory=dict)

    def separable(self, updates: Mapping[str, Sequence[tuple[str, str]]] | None = None) -> SeparableModel:
        """Assemble K(theta) and M(theta).

        Parameters
        ----------
        updates : mapping of parameter name to sequence of (property, group)
            What each parameter stands for, in the order of theta: the value of a property (one of ``"E"``,
            ``"rho"``, ``"A"``, ``"Iy"``, ``"Iz"``, ``"J"``, SI units) in a group of elements. E acts on
            bending, axial and, through G = E/(2(1+ν)), torsional stiffness; Iy and Iz act on bending
            stiffness, rotary inertia and torsional inertia; A on axial stiffness and translational mass.

        Raises
        ------
        ValueError
            For an unknown property or group, two groups of one name, a property updated twice, an element,
            support or mass at a node that does not exist, or a free node without an element.
        """
        owner = self._owners(updates or {})
        coordinates = self._coordinates()
        n_parameters = len(updates or {})
        free, dofs = self._free_dofs(len(coordinates))
        K_terms: list[Term] = []
        M_terms: list[Term] = []
        for group in self.groups:
            ends = np.asarray(group.elements, dtype=int)
            axis = coordinates[ends[:, 1]] - coordinates[ends[:, 0]]
            length = np.linalg.norm(axis, axis=1)
            axes = beam.local_axes(axis, group.y_direction)
            for recipe, unit, terms in (
                (_STIFFNESS, beam.stiffness_terms(length), K_terms),
                (_MASS, beam.mass_terms(length), M_terms),
            ):
                for name, properties in recipe.items():
                    scale, powers = _coefficient(group, properties, owner, n_parameters)
                    if name == "GJ":
                        scale /= 2 * (1 + group.material.nu)
                    matrix = _assemble(beam.to_global(unit[name], axes) * scale, ends, len(coordinates))
                    terms.append(Term(matrix[free][:, free], powers))
        if self.masses:
            lumped = self._lumped_mass(len(coordinates))
            M_terms.append(Term(sp.csr_array(sp.diags_array(lumped[free])), (0.0,) * n_parameters))
        elements = np.concatenate([np.asarray(group.elements, dtype=np.int64) for group in self.groups])
        geometry = Geometry(coordinates, elements)
        return SeparableModel(merge_terms(K_terms), merge_terms(M_terms), dofs, geometry, self.arms)

    def _owners(self, updates: Mapping[str, Sequence[tuple[str, str]]]) -> dict[tuple[str, str], int]:
        groups = {group.name for group in self.groups}
        if len(groups) < len(self.groups):
            raise ValueError(f"groups: names must be distinct (got {[group.name for group in self.groups]})")
        owner: dict[tuple[str, str], int] = {}
        for j, (parameter, targets) in enumerate(updates.items()):
            for name, group in targets:
                if name not in PROPERTIES:
                    raise ValueError(f"{parameter}: property must be one of {PROPERTIES} (got {name!r})")
                if group not in groups:
                    raise ValueError(f"{parameter}: group must be one of {sorted(groups)} (got {group!r})")
                if (name, group) in owner:
                    raise ValueError(f"{parameter}: {name} of group {group!r} is updated already")
                owner[name, group] = j
        return owner

    def _coordinates(self) -> FloatArray:
        nodes = np.asarray(self.nodes, dtype=float)
        if nodes.ndim != 2 or nodes.shape[1] != 3 or not np.all(np.isfinite(nodes)):
            raise ValueError(f"nodes: must be finite x, y, z of every node (got shape {nodes.shape})")
        return nodes

    def _free_dofs(self, n_nodes: int) -> tuple[NDArray[np.int64], list[tuple[int, str]]]:
        fixed: set[tuple[int, str]] = set()
        for node, directions in self.supports.items():
            _require_node("supports", node, n_nodes)
            for direction in directions:
                if direction not in DIRECTIONS:
                    raise ValueError(f"supports: direction must be one of {DIRECTIONS} (got {direction!r})")
                fixed.add((node, direction))
        used: set[int] = set()
        for group in self.groups:
            ends = np.asarray(group.elements)
            if ends.ndim != 2 or ends.shape[1] != 2 or not np.issubdtype(ends.dtype, np.integer):
                received = f"shape {ends.shape} of {ends.dtype}"
                raise ValueError(f"group {group.name!r}: elements must be pairs of node numbers (got {received})")
            for node in map(int, ends.ravel()):
                _require_node(f"group {group.name!r}", node, n_nodes)
                used.add(node)
        # Nothing holds such a node: it would make the mass matrix singular.
        loose = [n for n in range(n_nodes) if n not in used and any((n, d) not in fixed for d in DIRECTIONS)]
        if loose:
            raise ValueError(f"nodes: a node without an element must be fixed (got nodes {loose})")
        names = [(node, direction) for node in range(n_nodes) for direction in DIRECTIONS]
        free = [i for i, name in enumerate(names) if name not in fixed]
        if not free:
            raise ValueError(f"supports: must leave a degree of freedom free (got all {len(names)} fixed)")
        return np.array(free, dtype=np.int64), [names[i] for i in free]

    def _lumped_mass(self, n_nodes: int) -> FloatArray:
        lumped = np.zeros(6 * n_nodes)
        for mass in self.masses:
            _require_node("masses", mass.node, n_nodes)
            if not all(0.0 <= value < np.inf for value in (mass.mass, *mass.inertia)):
                raise ValueError(f"masses: mass and inertia must be finite and not negative (got {mass})")
            lumped[6 * mass.node : 6 * mass.node + 6] += (*(mass.mass,) * 3, *mass.inertia)
        return lumped


def _coefficient(
    group: ElementGroup, properties: Sequence[str], owner: Mapping[tuple[str, str], int], n_parameters: int
) -> tuple[float, tuple[float, ...]]:
    scale, powers = 1.0, [0.0] * n_parameters
    for name in properties:
        if (name, group.name) in owner:
            powers[owner[name, group.name]] += 1.0
        else:
            scale *= group.value(name)
    return scale, tuple(powers)


def _assemble(matrices: FloatArray, ends: NDArray[np.int64], n_nodes: int) -> sp.csr_array:
    dofs = (6 * ends[:, :, None] + np.arange(6)).reshape(len(ends), 12)
    rows = np.repeat(dofs, 12, axis=1).ravel()
    columns = np.tile(dofs, (1, 12)).ravel()
    matrix = sp.coo_array((matrices.ravel(), (rows, columns)), shape=(6 * n_nodes,) * 2).tocsr()
    matrix.eliminate_zeros()
    return matrix


def _require_positive(name: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name}: must be positive and finite (got {value})")


def _require_node(where: str, node: int, n_nodes: int) -> None:
    if not 0 <= node < n_nodes:
        raise ValueError(f"{where}: node must lie in 0..{n_nodes - 1} (got {node})")
