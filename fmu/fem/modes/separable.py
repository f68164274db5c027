"""Structures of the form K(theta) = Σ c_k(theta) K_k, M(theta) = Σ c_m(theta) M_m.

Frames of beam elements have this form, and so do structures recovered from exported matrices. The coefficients are
constants or monomials of the parameters, so their derivatives are exact.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components

from fmu.arguments import ArgumentError, Place, check_arguments, first_repeated
from fmu.fem.modes.line_picture import LinePicture
from fmu.fem.modes.solver import LastFactor
from fmu.fem.modes.terms import Term, check_terms, named_term, sum_at
from fmu.formats.models.edges import edges
from fmu.formats.models.exported import ExportedModel, Mesh
from fmu.types import Dof, FloatArray, IntArray


@check_arguments
@dataclass(frozen=True, eq=False)
class Geometry:
    """Coordinates and elements of a structure, for plots, point matching and centres of gravity.

    The geometry does not affect the stiffness and mass matrices.

    Attributes
    ----------
    nodes : ndarray, shape (n_nodes, 3), m
        Coordinates. A degree of freedom named ``(node, direction)`` belongs to row `node` or, with `ids`, to the
        row with that id.
    elements : ndarray of int, shape (n_elements, 2)
        Rows of `nodes` at both ends of each plotted line.
    masses : sequence of int
        Rows of nodes with a point mass.
    springs : sequence of (int, int or None)
        Rows of the nodes at both ends of each spring; None as the second end means the ground.
    spring_parameters : sequence of (int or None)
        Index of the first parameter that changes each spring's stiffness, or None; empty if no index is known.
    ids : ndarray of int, shape (n_nodes,), optional
        Node names in the degrees of freedom, if the names are not the rows.
    mesh : Mesh or ExportedModel, optional
        Another program's mesh from which the lines are plotted.

    Raises
    ------
    ValueError
        If nodes or elements have a wrong shape or are not finite, there is not one id per node, or an element,
        mass or spring is at a row that does not exist.
    """

    nodes: FloatArray
    elements: IntArray
    masses: Sequence[int] = ()
    springs: Sequence[tuple[int, int | None]] = ()
    spring_parameters: Sequence[int | None] = ()
    ids: IntArray | None = None
    mesh: Mesh | ExportedModel | None = None

    def __post_init__(self) -> None:
        for name, given, width in (("nodes", self.nodes, 3), ("elements", self.elements, 2)):
            rows = np.asarray(given)
            if rows.size and (rows.ndim != 2 or rows.shape[1] != width or not np.isfinite(rows).all()):
                raise ArgumentError(name, f"must be finite, of shape (n, {width})", f"shape {rows.shape}")
        if self.ids is not None and np.shape(self.ids) != (len(np.asarray(self.nodes)),):
            raise ArgumentError("ids", "must have a name for each node", f"shape {np.shape(self.ids)}")
        ends = [row for spring in self.springs for row in spring if row is not None]
        for name, at in (("elements", self.elements), ("masses", self.masses), ("springs", ends)):
            wrong = np.setdiff1d(np.asarray(at), np.arange(len(self.nodes)))
            if len(wrong):
                raise ArgumentError(name, f"must be at rows of nodes, 0 to {len(self.nodes) - 1}", wrong[0])

    @classmethod
    @check_arguments
    def of_mesh(cls, mesh: Mesh | ExportedModel) -> Geometry | None:
        """Return the geometry of another program's mesh.

        Parameters
        ----------
        mesh : Mesh or ExportedModel
            See `fmu.read_mesh` and `fmu.read_model`.

        Returns
        -------
        Geometry or None
            The geometry with the lines to plot, or None if there is nothing to plot.
        """
        lines = edges(mesh)
        return cls(mesh.coordinates, lines, ids=mesh.nodes, mesh=mesh) if len(lines) else None

    @cached_property
    def drawn(self) -> IntArray:
        """Row indices (m,) of the plotted nodes: all nodes, or only the ends of lines if `ids` is given."""
        return np.arange(len(self.nodes)) if self.ids is None else np.unique(self.elements)

    @cached_property
    def row_of(self) -> dict[Any, int]:
        """Row in `nodes` of each node, keyed by node name."""
        names = range(len(self.nodes)) if self.ids is None else np.asarray(self.ids).tolist()
        return {name: row for row, name in enumerate(names)}


@check_arguments
@dataclass(frozen=True)
class RigidArm:
    """A point rigidly connected to a node, such as a sensor on the skin of a beam or the centre of a mass.

    Attributes
    ----------
    node : hashable
        Name of the node in the model's degrees of freedom.
    offset : tuple of float, length 3, m
        Vector from the node to the point, in global axes. ValueError is raised unless it is three finite numbers.
    """

    node: Place
    offset: tuple[float, float, float]

    def motion(self, direction: str) -> dict[str, float]:
        """Return the point's motion in a direction, u + θ × offset, as weights on the node's motions u and θ."""
        x, y, z = self.offset
        return {direction: 1.0} | {
            "x": {"ry": z, "rz": -y},
            "y": {"rz": x, "rx": -z},
            "z": {"rx": y, "ry": -x},
        }.get(direction, {})


@check_arguments
class SeparableModel:
    """A structure whose matrices are sums of fixed matrices with monomial coefficients.

    Parameters
    ----------
    K_terms, M_terms : sequence of Term
        Stiffness (N/m, N·m/rad, …) and mass terms on the same free degrees of freedom.
    dofs : sequence of tuple (node, direction), optional
        Name of each degree of freedom; direction is one of ``"x" "y" "z" "rx" "ry" "rz"``. By default each degree
        of freedom is the translation x of its own node.
    geometry : Geometry, optional
        Coordinates and elements, for example for plots of the structure and its mode shapes.
    arms : mapping of hashable to RigidArm, optional
        Points rigidly connected to nodes, by name, at which sensors may be placed.
    ties : mapping of tuple to tuple, optional
        Maps the (node, direction) name of each tied degree of freedom to the name in `dofs` that it is tied to.
    motions : mapping of tuple to mapping of tuple to float, optional
        Motions (node, direction) as weighted sums of `dofs`, for nodes whose degrees of freedom are not along
        global axes. They take precedence over `dofs`; no sensor can be at a motion without weights.

    Attributes
    ----------
    names : tuple of str or None
        Parameter names, if they were given; see `from_terms`.
    notes : tuple of str
        Sentences on the origin of the matrices.
    picture : LinePicture or None
        Lines that are plotted if there is no geometry.
    place_names : mapping of node to str
        Names of nodes in messages and on pages; other nodes are shown as they are.

    Raises
    ------
    ValueError
        If there is no stiffness or mass term; a term is not symmetric or not finite, or has the wrong shape or
        number of powers; `dofs` has the wrong length or contains a name twice; a tie refers to a name that is not
        in `dofs`; or a motion refers to a name that is neither in `dofs` nor tied.
    """

    def __init__(
        self,
        K_terms: Sequence[Term],
        M_terms: Sequence[Term],
        dofs: Sequence[Dof] | None = None,
        geometry: Geometry | None = None,
        arms: Mapping[Any, RigidArm] | None = None,
        ties: Mapping[tuple[Any, str], tuple[Any, str]] | None = None,
        motions: Mapping[tuple[Any, str], Mapping[tuple[Any, str], float]] | None = None,
    ) -> None:
        if not K_terms or not M_terms:
            got = f"{len(K_terms)} and {len(M_terms)}"
            raise ArgumentError("K_terms, M_terms", "must have at least one stiffness and one mass term", got)
        self.K_terms, self.M_terms = tuple(K_terms), tuple(M_terms)
        self.n_dof = int(K_terms[0].matrix.shape[0])
        self.n_parameters = len(K_terms[0].powers)
        self.dofs = tuple(dofs) if dofs is not None else tuple((i, "x") for i in range(self.n_dof))
        self.geometry = geometry
        self.arms = dict(arms or {})
        self.ties = dict(ties or {})
        self.motions = dict(motions or {})
        self.names: tuple[str, ...] | None = None
        self.notes: tuple[str, ...] = ()
        self.picture: LinePicture | None = None
        self.place_names: Mapping[Any, str] = {}
        self._last_factors: dict[int, LastFactor] = {}
        _check_names(self)
        for name, terms in (("K_terms", self.K_terms), ("M_terms", self.M_terms)):
            check_terms(name, terms, self.n_dof, self.n_parameters)

    @classmethod
    @check_arguments
    def from_terms(
        cls,
        parameters: Sequence[str],
        stiffness: Sequence[Any],
        mass: Sequence[Any],
        dofs: Sequence[Dof] | None = None,
        geometry: Geometry | None = None,
        motions: Mapping[tuple[Any, str], Mapping[tuple[Any, str], float]] | None = None,
    ) -> SeparableModel:
        """Build a model from matrices and the names of the parameters that multiply them.

        ``SeparableModel.from_terms(["k1", "t"], stiffness=[K0, (K1, "k1"), (K2, {"t": 3})], mass=[M])`` has
        K = K0 + k1 K1 + t³ K2.

        Parameters
        ----------
        parameters : sequence of str
            Names in the order of theta; the parameters of an `UpdatingProblem` must have the same names.
        stiffness, mass : sequence of array_like, sparse, tuple (matrix, str) or (matrix, mapping of str to float)
            A matrix (n_dof, n_dof) alone is constant. With a name, it is multiplied by that parameter. With a
            mapping of names to powers, it is multiplied by the product of the parameters raised to these powers.
        dofs, geometry, motions : optional
            See the class.

        Returns
        -------
        SeparableModel

        Raises
        ------
        ValueError
            As for the class, or if two parameters have one name, a parameter is unknown, a matrix is not real, or
            a power is not finite.
        """
        names, twice = tuple(parameters), first_repeated(parameters)
        if twice is not None:
            raise ArgumentError("parameters", "must be distinct", f"{names[twice]!r} more than once")
        K_terms, M_terms = (
            [named_term(term, names, f"{key}.{k}") for k, term in enumerate(given)]
            for key, given in (("stiffness", stiffness), ("mass", mass))
        )
        model = cls(K_terms, M_terms, dofs, geometry, motions=motions)
        model.names = names
        return model

    def __repr__(self) -> str:
        return (
            f"SeparableModel({self.n_dof} DOF, {len(self.K_terms)} stiffness and {len(self.M_terms)} mass terms, "
            f"{len(self.blocks)} decoupled blocks, {self.n_parameters} parameters)"
        )

    def K(self, theta: ArrayLike) -> sp.csr_array:
        """Return the sparse stiffness matrix, shape (n_dof, n_dof), at `theta` (n_parameters,), in SI units."""
        return sum_at(self.K_terms, np.atleast_2d(np.asarray(theta, dtype=float))[0])

    def M(self, theta: ArrayLike) -> sp.csr_array:
        """Return the sparse mass matrix, shape (n_dof, n_dof), at `theta` (n_parameters,), in SI units."""
        return sum_at(self.M_terms, np.atleast_2d(np.asarray(theta, dtype=float))[0])

    @cached_property
    def blocks(self) -> tuple[IntArray, ...]:
        """Degrees of freedom in each decoupled block: one array of ascending indices per block.

        The blocks are the connected components of the graph of nonzeros in Σ |K_k| + Σ |M_m|, so each block is a
        separate eigenproblem. Entries that are nonzero only because of rounding (as in a rotated element) do not
        connect degrees of freedom.
        """
        rows, columns = [], []
        for term in (*self.K_terms, *self.M_terms):
            entries = term.matrix.tocoo()
            diagonal = np.abs(term.matrix.diagonal())
            size = np.sqrt(diagonal[entries.row] * diagonal[entries.col])
            keep = np.abs(entries.data) > 1e-12 * size
            rows.append(entries.row[keep])
            columns.append(entries.col[keep])
        row, column = np.concatenate(rows), np.concatenate(columns)
        graph = sp.coo_array((np.ones(len(row)), (row, column)), shape=(self.n_dof, self.n_dof))
        count, label = connected_components(graph.tocsr(), directed=False)
        return tuple(np.flatnonzero(label == k) for k in range(count))

    def last_factor(self, dofs: IntArray) -> LastFactor:
        """Return the store for the latest factors of one block; `dofs` is an entry of `blocks`."""
        return self._last_factors.setdefault(int(dofs[0]), LastFactor())

    @cached_property
    def translations(self) -> IntArray:
        """Indices of the translational degrees of freedom, shape (m,)."""
        return np.array([i for i, (_, d) in enumerate(self.dofs) if d in ("x", "y", "z")], dtype=np.int64)

    def dof(self, node: Hashable, direction: str) -> int:
        """Return the index of the degree of freedom (node, direction).

        Raises
        ------
        ValueError
            If the model has no such free degree of freedom.
        """
        try:
            return self.dof_of[(node, direction)]
        except KeyError:
            raise ArgumentError(
                "sensor", "the model has no free degree of freedom", f"node {node!r}, {direction!r}"
            ) from None

    def observation(self, sensors: Sequence[Dof]) -> sp.csr_array:
        """Return the matrix that maps displacements of the degrees of freedom to sensor readings.

        Parameters
        ----------
        sensors : sequence of (place, direction)
            A place is a node or a name in `arms`. A direction is ``"z"``, for example, or ``"-z"`` if the sensor
            has reversed polarity.

        Returns
        -------
        scipy.sparse.csr_array, shape (n_sensors, n_dof)

        Raises
        ------
        ValueError
            If a sensor sees no free degree of freedom.
        """
        rows = [self._seen_by(sensor) for sensor in sensors]
        row = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
        column = [dof for r in rows for dof in r]
        weight = [w for r in rows for w in r.values()]
        return sp.csr_array((weight, (row, column)), shape=(len(rows), self.n_dof), dtype=float)

    def sees(self, sensor: Dof) -> bool:
        """Return True if a sensor sees a free degree of freedom; see `observation`."""
        try:
            return bool(self._seen_by(sensor))
        except ValueError:
            return False

    def _seen_by(self, sensor: Dof) -> dict[int, float]:
        place, direction = sensor
        sign, direction = (-1.0, direction[1:]) if direction.startswith("-") else (1.0, direction)
        if (place, direction) in self.motions:
            if not self.motions[place, direction]:
                raise ArgumentError("sensor", "must be at a motion that is known", f"{place!r}, {direction!r}")
            return {self.dof(*dof): sign * weight for dof, weight in self.motions[place, direction].items()}
        if place not in self.arms:
            return {self.dof(place, direction): sign}
        arm = self.arms[place]
        seen = {
            self.dof_of[arm.node, d]: sign * weight
            for d, weight in arm.motion(direction).items()
            if weight and (arm.node, d) in self.dof_of
        }
        if not seen:
            raise ArgumentError("sensor", "sees no free degree of freedom", f"{place!r}, {direction!r}")
        return seen

    def locate_motions(self) -> Iterator[tuple[int, str, Mapping[int, float]]]:
        """Yield (node row, direction, weights) for each motion of each node; nothing if the model has no geometry.

        The row refers to the geometry's nodes, and the weights are keyed by index in `dofs`.
        """
        row_of = {} if self.geometry is None else self.geometry.row_of
        for node, direction in (*self.motions, *(name for name in self.dof_of if name not in self.motions)):
            if node in row_of and self.motions.get((node, direction)) != {}:
                yield row_of[node], direction, self._seen_by((node, direction))

    @cached_property
    def dof_of(self) -> dict[Dof, int]:
        """Index of the degree of freedom for each (node, direction), including tied ones."""
        index = {name: i for i, name in enumerate(self.dofs)}
        return index | {name: index[other] for name, other in self.ties.items()}


def separable_in(model: object) -> SeparableModel | None:
    """Return the model if it is a `SeparableModel`, otherwise None."""
    return model if isinstance(model, SeparableModel) else None


def selection(dofs: ArrayLike, n_dof: int) -> sp.csr_array:
    """Return the sparse matrix (q, n_dof) that selects the degrees of freedom `dofs` (q,) from displacements."""
    picked = np.asarray(dofs, dtype=np.int64)
    return sp.csr_array((np.ones(len(picked)), picked, np.arange(len(picked) + 1)), shape=(len(picked), n_dof))


def _check_names(model: SeparableModel) -> None:
    """Raise ArgumentError unless `dofs` has a distinct name for each row, and ties and motions use known names."""
    if len(model.dofs) != model.n_dof:
        raise ArgumentError("dofs", f"must name {model.n_dof} degrees of freedom", len(model.dofs))
    twice = first_repeated(model.dofs)
    if twice is not None:
        raise ArgumentError("dofs", "must be distinct", f"{model.dofs[twice]} more than once")
    index = set(model.dofs)
    of_ties = {name: (other,) for name, other in model.ties.items()}
    for key, sums, known in (("ties", of_ties, index), ("motions", model.motions, index | set(model.ties))):
        for name, others in sums.items():
            if unknown := [other for other in others if other not in known]:
                raise ArgumentError(key, "must be of names in dofs", f"{unknown[0]} for {name}")
