"""Components of a frame: cross-sections, materials, element groups, point masses, springs and ties."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, Place, check_arguments
from fmu.fem.modes.separable import RigidArm
from fmu.numbers import significant, typed
from fmu.types import DIRECTIONS as DIRECTIONS
from fmu.types import FloatArray, NotNegative, Positive

# Nodes closer than this, relative to the structure's extent, count as coincident.
_COINCIDENT = 1e-9

Length = Annotated[float, Interval(gt=0.0, lt=1e6)]
"""Dimension of a cross-section, m."""


@check_arguments
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

    Raises
    ------
    ValueError
        If a constant is not positive and finite.
    """

    A: Positive
    Iy: Positive
    Iz: Positive
    J: Positive

    @classmethod
    @check_arguments
    def rectangle(cls, width: Length, height: Length) -> Section:
        """Return a rectangular section, `width` along local y and `height` along local z, in m.

        The torsion constant is b t³/3 · (1 − 0.63 t/b + 0.052 (t/b)⁵) with the longer side b and the shorter side
        t (Timoshenko & Goodier 1970, §109, the series truncated after its leading terms).

        Raises
        ------
        ValueError
            If a dimension is not between 0 and 1e6 m.
        """
        b, t = max(width, height), min(width, height)
        J = b * t**3 / 3 * (1 - 0.63 * t / b + 0.052 * (t / b) ** 5)
        return cls(A=width * height, Iy=width * height**3 / 12, Iz=height * width**3 / 12, J=J)

    @classmethod
    @check_arguments
    def tube(cls, diameter: Length, thickness: Length) -> Section:
        """Return a circular tube section with outer `diameter` and wall `thickness`, in m.

        A = π (R² − r²), Iy = Iz = π/4 (R⁴ − r⁴) and J = 2 Iy are exact. A `thickness` of half the diameter gives a
        solid rod.

        Raises
        ------
        ValueError
            If a dimension is not between 0 and 1e6 m, or the wall is thicker than half the diameter.
        """
        if thickness > diameter / 2:
            raise ArgumentError("thickness", f"must not exceed half the diameter {typed(diameter)}", thickness)
        outer, inner = diameter / 2, diameter / 2 - thickness
        second = np.pi / 4 * (outer**4 - inner**4)
        return cls(A=np.pi * (outer**2 - inner**2), Iy=second, Iz=second, J=2 * second)

    @classmethod
    @check_arguments
    def i_section(cls, height: Length, width: Length, web: Length, flange: Length) -> Section:
        """Return a doubly symmetric I-section with dimensions in m. Iy resists bending in the plane of the web.

        The overall `height` and the web lie along local z, and the `width` of the flanges along local y. `web` and
        `flange` are thicknesses. Fillets are neglected. The torsion constant is Σ b t³/3 over the two flanges and
        the web between them (Timoshenko & Goodier 1970, §112).

        Raises
        ------
        ValueError
            If a dimension is not between 0 and 1e6 m, the flanges leave no web, or the web is wider than the
            flanges.
        """
        if 2 * flange >= height:
            raise ArgumentError("flange", f"must be thinner than half the height {typed(height)}", flange)
        if web > width:
            raise ArgumentError("web", f"must not exceed the width {typed(width)}", web)
        depth = height - 2 * flange
        return cls(
            A=2 * width * flange + web * depth,
            Iy=(width * height**3 - (width - web) * depth**3) / 12,
            Iz=(2 * flange * width**3 + depth * web**3) / 12,
            J=(2 * width * flange**3 + depth * web**3) / 3,
        )


@check_arguments
@dataclass(frozen=True)
class Material:
    """Isotropic, linearly elastic material.

    Attributes
    ----------
    E : float
        Young's modulus, N/m².
    nu : float
        Poisson's ratio; the shear modulus is E / (2 (1 + nu)).
    rho : float
        Density, kg/m³.

    Raises
    ------
    ValueError
        If E or rho is not positive and finite, or nu does not lie in (-1, 0.5].
    """

    E: Positive
    nu: Annotated[float, Interval(gt=-1.0, le=0.5)]
    rho: Positive


@check_arguments
@dataclass(frozen=True)
class ElementGroup:
    """Beam elements that share a section, a material and, in model updating, their parameters.

    Attributes
    ----------
    name : str
    elements : array_like of int, shape (n, 2)
        Indices (from 0) of the nodes at both ends.
    section : Section
    material : Material
    y_direction : tuple of float, length 3, optional
        A vector in the local x–y plane, in global axes; it defines the axes of Iy and Iz. By default, local y is
        horizontal (global z points up), so that Iy resists bending in the vertical plane. For vertical elements,
        local y is global y by default.

    Raises
    ------
    ValueError
        If the elements are not pairs of whole numbers.
    """

    name: str
    elements: ArrayLike
    section: Section
    material: Material
    y_direction: tuple[float, float, float] | None = None
    directions: ClassVar[tuple[str, ...]] = ()
    """Directions that a target may name for a property; elements have no such directions."""

    def __post_init__(self) -> None:
        ends = np.asarray(self.elements)
        if ends.ndim != 2 or ends.shape[1] != 2 or not np.issubdtype(ends.dtype, np.integer):
            raise ArgumentError("elements", "must be pairs of node numbers", f"shape {ends.shape} of {ends.dtype}")

    def value(self, name: str) -> float:
        """Return the initial value, in SI units, of a property listed in `fmu.fem.frame.updates.PROPERTIES`."""
        return float((vars(self.material) | vars(self.section))[name])


@check_arguments
@dataclass(frozen=True)
class PointMass:
    """A mass that acts on a node's three translations, with rotary inertias about global axes.

    Attributes
    ----------
    node : int or str
        Node index. In a problem file, it is the name of a point, which is replaced by an index when the frame is
        built.
    mass : float
        Mass, kg.
    inertia : tuple of float, length 3
        Moments of inertia about global x, y and z, kg·m².
    name : str
        Name by which a parameter refers to the mass or its inertia. In a problem file, it defaults to the name of
        the point.

    Raises
    ------
    ValueError
        If the mass or an inertia is negative or not finite.
    """

    node: Place
    mass: NotNegative
    inertia: tuple[NotNegative, NotNegative, NotNegative] = (0.0, 0.0, 0.0)
    name: str = ""
    directions: ClassVar[tuple[str, ...]] = DIRECTIONS[3:]
    """Directions that a target may name for an inertia."""

    def value(self, direction: str) -> float:
        """Return the mass in kg or, for ``"rx"``, ``"ry"`` or ``"rz"``, the moment of inertia in kg·m²."""
        return self.inertia[DIRECTIONS.index(direction) - 3] if direction.startswith("r") else self.mass


@check_arguments
@dataclass(frozen=True)
class JointSpring:
    """Springs between two nodes, or between a node and the ground, along global axes.

    Attributes
    ----------
    name : str
        Name by which a parameter refers to the stiffness.
    nodes : tuple of int, length 2
        Node indices; None as the second entry means the ground. In a problem file, the entries are names of
        points, which are replaced by indices when the frame is built.
    stiffness : mapping of str to float
        Stiffness by direction: N/m for ``"x" "y" "z"``, N·m/rad for ``"rx" "ry" "rz"``. If the two nodes do not
        coincide, the springs act midway between the nodes, on rigid arms from both, so that rigid-body motions
        cause no strain.
    tied : sequence of str
        Directions in which two coincident nodes move together: the nodes share that degree of freedom. In
        directions that are neither in `tied` nor in `stiffness` the spring does nothing; a hinge is a spring with
        ties only.

    Raises
    ------
    ValueError
        If a direction is unknown, a direction is in both `stiffness` and `tied`, both are empty, a stiffness is
        not positive, a node is tied to the ground (use a support), or both nodes are the same.

    Examples
    --------
    An elastic clamp at node 0, which has no support in these directions, and a semi-rigid joint about y:

    >>> clamp = JointSpring("clamp", (0, None), {"x": 1e8, "y": 1e8, "z": 1e8, "rx": 1e5, "ry": 1e5, "rz": 1e5})
    >>> knee = JointSpring("knee", (4, 5), {"ry": 2e5}, tied=("x", "y", "z", "rx", "rz"))
    """

    name: str
    nodes: tuple[Place, Place | None]
    stiffness: Mapping[str, Positive]
    tied: Sequence[str] = ()

    def __post_init__(self) -> None:
        here = f"spring {self.name!r}"
        for direction in (*self.stiffness, *self.tied):
            if direction not in DIRECTIONS:
                rule = f"directions of stiffness and tied must be of {DIRECTIONS}"
                raise ArgumentError(here, rule, repr(direction))
        for direction in self.stiffness:
            if direction in self.tied:
                raise ArgumentError(
                    here, "must be either elastic or tied in a direction", f"{direction!r} as both"
                )
        if not self.stiffness and not self.tied:
            raise ArgumentError(here, "must have a stiffness or a tied direction", "neither")
        if self.tied and self.nodes[1] is None:
            raise ArgumentError(here, "must have two ends to be tied; a support holds one to the ground")
        if self.nodes[0] == self.nodes[1]:
            raise ArgumentError(here, "ends must differ", self.nodes)

    @property
    def directions(self) -> tuple[str, ...]:
        """Directions in which the spring has a stiffness."""
        return tuple(self.stiffness)

    def value(self, direction: str) -> float:
        """Return the stiffness in a direction, in N/m or N·m/rad."""
        return self.stiffness[direction]

    def elongation(self, direction: str, nodes: FloatArray) -> dict[int, float]:
        """Return the elongation in a direction as a weighted sum of degrees of freedom.

        The weights are keyed by degree of freedom, 6 · node + 0 … 5.

        Parameters
        ----------
        direction : str
        nodes : ndarray, shape (n_nodes, 3), m
        """
        first, second = self.nodes
        if second is None:
            return {6 * first + DIRECTIONS.index(direction): 1.0}
        half = 0.5 * (nodes[second] - nodes[first])
        return {
            6 * node + DIRECTIONS.index(d): sign * weight
            for node, arm, sign in ((first, half, -1.0), (second, -half, 1.0))
            for d, weight in RigidArm(node, tuple(arm.tolist())).motion(direction).items()
            if weight
        }

    def require_coincident(self, nodes: FloatArray) -> None:
        """Raise ValueError if tied nodes do not coincide. `nodes` (n_nodes, 3) are all coordinates in m."""
        first, second = self.nodes
        if not self.tied or second is None:
            return
        distance = float(np.linalg.norm(nodes[second] - nodes[first]))
        if distance > _COINCIDENT * max(float(np.ptp(nodes, axis=0).max()), 1e-300):
            rule = "tied nodes must be at the same place"
            raise ValueError(f"spring {self.name!r}: {rule} (got a distance of {significant(distance)} m)")
