"""What a frame has at its nodes beside elements: point masses, springs, ties."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from fmu.fem.modes.separable import RigidArm
from fmu.numbers import significant
from fmu.types import FloatArray, NotNegative, require_positive

Direction = Literal["x", "y", "z", "rx", "ry", "rz"]
DIRECTIONS: tuple[str, ...] = get_args(Direction)

# Nodes closer than this, relative to the structure's extent, are at the same place.
_COINCIDENT = 1e-9


@dataclass(frozen=True)
class PointMass:
    """A mass on the three translations of a node, and rotary inertias about its global axes.

    Attributes
    ----------
    node : int
    mass : float
        kg.
    inertia : tuple of float, length 3
        About global x, y and z, kg·m².
    name : str
        What a parameter of its mass or inertia calls it; in a problem file, by default, the name of its point.
    """

    node: int
    mass: NotNegative
    inertia: tuple[NotNegative, NotNegative, NotNegative] = (0.0, 0.0, 0.0)
    name: str = ""

    def value(self, direction: str) -> float:
        """Return what resists acceleration in one of `DIRECTIONS`: the mass, or an inertia."""
        return self.inertia[DIRECTIONS.index(direction) - 3] if direction.startswith("r") else self.mass


@dataclass(frozen=True)
class JointSpring:
    """Springs between two nodes, or between a node and the ground, along global axes.

    Attributes
    ----------
    name : str
        By which a parameter may have its stiffness.
    nodes : tuple of int, length 2
        Node numbers; None as the second one stands for the ground.
    stiffness : mapping of str to float
        N/m of ``"x" "y" "z"``, N·m/rad of ``"rx" "ry" "rz"``. Where two nodes lie apart, the springs act half-way
        between them, on rigid arms from both: the structure still moves as a rigid body without strain.
    tied : sequence of str
        Directions in which two nodes at the same place move as one: they share that degree of freedom. In
        directions that are neither here nor in `stiffness` the spring does nothing; a hinge is a spring with
        ties alone.

    Raises
    ------
    ValueError
        For an unknown direction, one in both `stiffness` and `tied` or none in either, a stiffness that is not
        positive, a node tied to the ground (that is a support), or one node twice.

    Examples
    --------
    An elastic clamp of node 0, which no support holds in these directions, and a semi-rigid joint about y:

    >>> clamp = JointSpring("clamp", (0, None), {"x": 1e8, "y": 1e8, "z": 1e8, "rx": 1e5, "ry": 1e5, "rz": 1e5})
    >>> knee = JointSpring("knee", (4, 5), {"ry": 2e5}, tied=("x", "y", "z", "rx", "rz"))
    """

    name: str
    nodes: tuple[int, int | None]
    stiffness: Mapping[str, float]
    tied: Sequence[str] = ()

    def __post_init__(self) -> None:
        here = f"spring {self.name!r}"
        for direction in (*self.stiffness, *self.tied):
            if direction not in DIRECTIONS:
                raise ValueError(f"{here}: direction must be one of {DIRECTIONS} (got {direction!r})")
        for direction, value in self.stiffness.items():
            if direction in self.tied:
                raise ValueError(
                    f"{here}: must be either elastic or tied in a direction (got {direction!r} as both)"
                )
            require_positive(f"{here}.{direction}", value)
        if not self.stiffness and not self.tied:
            raise ValueError(f"{here}: must have a stiffness or a tied direction (got neither)")
        if self.tied and self.nodes[1] is None:
            raise ValueError(f"{here}: must have two ends to be tied; a support holds one to the ground")
        if self.nodes[0] == self.nodes[1]:
            raise ValueError(f"{here}: ends must differ (got {self.nodes})")

    def elongation(self, direction: str, nodes: FloatArray) -> dict[int, float]:
        """Return the spring's elongation in a direction as weights of the degrees of freedom 6 · node + 0 … 5.

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
        """Raise ValueError if nodes (n_nodes, 3) that are tied do not lie at the same place."""
        first, second = self.nodes
        if not self.tied or second is None:
            return
        distance = float(np.linalg.norm(nodes[second] - nodes[first]))
        if distance > _COINCIDENT * max(float(np.ptp(nodes, axis=0).max()), 1e-300):
            rule = "tied nodes must be at the same place"
            raise ValueError(f"spring {self.name!r}: {rule} (got a distance of {significant(distance)} m)")
