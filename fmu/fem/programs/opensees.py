"""Models that a Python function builds in OpenSees through the package openseespy.

The package is installed by ``pip install 'fmu[opensees]'``. The function ``build(theta)`` calls openseespy to
create a model with nodes, supports, elements and masses; it defines no analysis. OpenSees has one model per
process, so an existing model in the process is wiped.

Stiffness and mass are the tangent matrices at rest. The integrator GimmeMCK assembles a M + b C + c K for given
factors a, b and c, and the solver FullGeneral stores this matrix densely:
https://portwooddigital.com/2020/05/17/gimme-all-your-damping-all-your-mass-and-stiffness-too/
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from types import ModuleType
from typing import Annotated

import numpy as np
import scipy.sparse as sp
from annotated_types import Interval

from fmu.arguments import ArgumentError, check_arguments
from fmu.engines.blas import single_thread
from fmu.engines.program import last_lines
from fmu.fem.black_box import BlackBoxModel
from fmu.fem.exports.from_exports import from_exports
from fmu.fem.exports.recovery import Export
from fmu.fem.modes.eigensolver import eigen, rank
from fmu.fem.modes.modal import frequency_hz
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.fem.programs.followers import begin_analysis, follower_motions
from fmu.formats.matrices.limits import RefusedError
from fmu.formats.models.exported import DofName, ExportedModel, mesh_of
from fmu.formats.shown import in_words, quote
from fmu.numbers import typed
from fmu.types import Dof, FloatArray, Positive

Build = Callable[[FloatArray], object]

MOST_DOFS = 5000
"""Largest number of degrees of freedom: OpenSees prints dense matrices, of 200 MB each at this size."""
MODES = 20
_DIRECTIONS = {
    (1, 1): ("x",),
    (2, 1): ("x",),
    (2, 2): ("x", "y"),
    (2, 3): ("x", "y", "rz"),
    (3, 1): ("x",),
    (3, 3): ("x", "y", "z"),
    (3, 6): ("x", "y", "z", "rx", "ry", "rz"),
}
"""Names of a node's degrees of freedom, keyed by the model's dimension ndm and their number ndf."""
_KINDS = {
    1: "vertex", 2: "line", 3: "triangle", 4: "quad", 6: "triangle6", 8: "hexahedron", 9: "quad9",
    10: "tetra10", 20: "hexahedron20",
}  # fmt: skip
_LEVELS, _JOINT, _CHECKS = 5, 6, 2
"""Number of values for each parameter when only it varies; number of points where all vary, to be multiplied by
one plus the number of parameters; and number of points at which the model is checked."""
_INSIDE = 0.02
_ASYMMETRIC = 1e-10


def export_matrices(build: Build, theta: FloatArray) -> ExportedModel:
    """Export the stiffness, mass and mesh of the model that ``build(theta)`` creates in OpenSees.

    Parameters
    ----------
    build : callable
    theta : ndarray, shape (n_parameters,)

    Returns
    -------
    ExportedModel
        Its matrices contain the degrees of freedom that are neither fixed nor constrained to others. Its `motions`
        give the constrained degrees of freedom as weighted sums of the free ones; a note lists any exceptions.

    Raises
    ------
    ValueError
        If openseespy is missing, `build` raises an exception or creates no nodes, no degree of freedom is free or
        more than `MOST_DOFS` are, the directions of a node's degrees of freedom are not known, or the stiffness or
        mass is zero, not symmetric or not finite.
    """
    ops = _openseespy()
    with _alone(ops):
        try:
            build(np.array(theta, dtype=float))
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise ArgumentError(
                "build", f"must work at {np.asarray(theta).tolist()} ({in_words(error)})"
            ) from error
        nodes = ops.getNodeTags() or []
        if not nodes:
            raise ArgumentError("build", "must make nodes in OpenSees (it made none)")
        followers = _followers(ops)
        dofs_at = _assemble_matrix(ops, bool(followers))
        dofs: dict[int, DofName] = {}
        directions: dict[int, tuple[str, ...]] = {}
        places: dict[int, Sequence[float]] = {}
        for node in nodes:
            place = ops.nodeCoord(node)
            places[node] = (*place, 0.0, 0.0)[:3]
            ndf = ops.getNDF(node)[0]
            names = _DIRECTIONS.get((len(place), ndf))
            if names is None:
                rule = f"node {node} has {ndf} in {len(place)} dimensions"
                raise ArgumentError("build", f"must make degrees of freedom of structures ({rule})")
            directions[node] = names
            own = [name for j, name in enumerate(names, 1) if j not in followers.get(node, ())]
            dofs |= {row: (node, name) for row, name in zip(dofs_at[node], own, strict=False) if row >= 0}
        n = ops.systemSize()
        stiffness, mass = (_matrix(ops, what, n, factors) for what, factors in _WHAT.items())
        step = 2.0 * float(
            np.sqrt(mass.diagonal().max() / stiffness.diagonal().max())
        )  # K and 4 M/Δt² are of similar size
        motions, notes = follower_motions(ops, directions, frozenset(dofs.values()), step)
        elements = {tag: tuple(ops.eleNodes(tag)) for tag in ops.getEleTags() or []}
    if len(dofs) < n:
        raise ArgumentError("build", f"OpenSees must name its {n} equations (it names {len(dofs)})")
    known = {tag: nodes for tag, nodes in elements.items() if len(nodes) in _KINDS}
    if len(known) < len(elements):
        notes.append(f"Of {len(elements)} elements, {len(elements) - len(known)} are not drawn.")
    try:
        mesh = mesh_of(places, list(known.values()), [_KINDS[len(nodes)] for nodes in known.values()])
    except RefusedError as error:
        raise ArgumentError("build", str(error)) from error
    order = sorted(dofs, key=lambda row: (dofs[row][0], _DIRECTIONS[3, 6].index(dofs[row][1])))
    return ExportedModel(
        stiffness[order][:, order],
        mass[order][:, order],
        tuple(dofs[row] for row in order),
        mesh.nodes,
        mesh.coordinates,
        mesh.elements,
        mesh.kinds,
        tuple(notes),
        motions,
    )


@check_arguments
def from_opensees(
    build: Build, names: Sequence[str], start: FloatArray, lower: FloatArray, upper: FloatArray
) -> SeparableModel:
    """Return a model whose K(θ) and M(θ) are fitted to OpenSees matrices at several θ; see `fmu.from_exports`.

    Parameters
    ----------
    build : callable
        See `fmu.fem.programs.opensees`.
    names : sequence of str
        Parameter names, in the order of theta.
    start, lower, upper : array_like, shape (n_parameters,)
        The starting point and the bounds. Matrices are assembled at the starting point, at points where one
        parameter varies, and at points where all vary. An infinite lower bound is replaced by the smaller of
        half and twice the starting value, and an infinite upper bound by the larger.

    Returns
    -------
    SeparableModel
        The model. It reproduces each entry a_ij of the matrices at two further points to 1e-8 √(a_ii a_jj).

    Raises
    ------
    ValueError
        If there are no names, if `start`, `lower` or `upper` is not one number per name, if a parameter starts at
        zero or changes nothing, if the degrees of freedom or the constraints depend on theta, if the matrices are
        not sums of products of parameter powers, or in the cases listed for `export_matrices`.
    """
    for key, values in (("start", start), ("lower", lower), ("upper", upper)):
        if not len(names) or np.shape(values) != (len(names),) or not np.isfinite(values).all():
            raise ArgumentError(key, f"must be numbers, one for each of {list(names)}", list(np.ravel(values)))
    points, checks = _points(*(np.array(values, dtype=float) for values in (start, lower, upper)))
    exports = [
        Export(
            dict(zip(names, point.tolist(), strict=True)),
            export_matrices(build, point),
            bool(check),
            f"the model at {', '.join(f'{name} = {typed(x)}' for name, x in zip(names, point, strict=True))}",
        )
        for point, check in zip(points, checks, strict=True)
    ]
    bounds = {name: (float(points[:, j].min()), float(points[:, j].max())) for j, name in enumerate(names)}
    try:
        model = from_exports(exports, bounds)
    except ValueError as error:
        raise ArgumentError.of(error).replace_key("exports", "") from error
    model.notes = (*model.notes, *exports[0].model.notes)
    return model


@check_arguments
class OpenSeesModel(BlackBoxModel):
    """A model that OpenSees assembles anew at every theta; its matrices may depend on theta in any way.

    Parameters
    ----------
    build : callable
        See `fmu.fem.programs.opensees`.
    start : array_like, shape (n_parameters,)
        Parameters at which the model is built once to obtain its degrees of freedom.
    modes : int
        Largest number of modes to compute. If the model has fewer modes of finite frequency, because degrees of
        freedom have no mass, all of these are computed.
    step, store
        See `BlackBoxModel`.

    Raises
    ------
    ValueError
        If `start` is not a list of finite numbers, `modes` or `step` is out of range, a store is given and `build`
        is not in a file or holds a value whose changes are not noticed, or in the cases listed for
        `export_matrices`.
    """

    place = "model.file"

    def __init__(
        self,
        build: Build,
        start: FloatArray,
        *,
        modes: Annotated[int, Interval(ge=1, le=MOST_DOFS)] = MODES,
        step: Positive = 1e-4,
        store: str | os.PathLike[str] | None = None,
    ) -> None:
        if np.ndim(start) != 1 or not len(start) or not np.isfinite(start).all():
            raise ArgumentError("start", "must be a list of finite numbers", np.asarray(start).tolist())
        self.build, self.modes = build, modes
        self.assembled = _fixed_model(export_matrices(build, start))
        name = getattr(inspect.unwrap(build), "__qualname__", "build")
        super().__init__(self._describe_run(), len(start), step=step, store=store, name=f"{name} in OpenSees")

    def sees(self, sensor: Dof) -> bool:
        """Return True if a sensor's degree of freedom is free, or follows free ones through a constraint."""
        return self.assembled.sees(sensor)

    def at_sensors(self, sensors: Sequence[Dof]) -> OpenSeesModel:
        """Return a copy of the model that gives shapes at these sensors."""
        return self._copy_with(tuple(sensors))

    def _describe_run(self) -> ModesInOpenSees:
        return ModesInOpenSees(self.build, self.modes, self.sensors)

    def configuration(self) -> dict[str, object]:
        """Return data that identify the model, including a hash of the source of `build`."""
        own = {"modes": self.modes, "sha256": self.sha256}
        return {"function": self.name, "batched": False, "step": self.step, **own}

    @property
    def _source(self) -> Build:
        return self.build


@dataclass(frozen=True)
class ModesInOpenSees:
    """Callable that returns the modes of an OpenSees model at theta (n_parameters,).

    Attributes
    ----------
    build : callable
    modes : int
        Largest number of modes. If the model has fewer modes of finite frequency, all of these are returned.
    sensors : tuple of (node, direction)
        Sensors at which shapes are given.
    """

    build: Build
    modes: int
    sensors: tuple[Dof, ...] = ()

    def __call__(self, theta: FloatArray) -> dict[str, object]:
        """Return a dict of frequencies in Hz, shape (m,), and sensor shapes (None if there are no sensors)."""
        model = export_matrices(self.build, theta)
        with single_thread():
            finite = rank(model.mass)
            eigenvalues, phi = eigen(model.stiffness, model.mass, min(self.modes, finite), finite)
        shapes = _fixed_model(model).observation(self.sensors) @ phi if self.sensors else None
        return {"frequencies": frequency_hz(eigenvalues), "shapes": shapes}


def _fixed_model(model: ExportedModel) -> SeparableModel:
    """Convert a model that was exported at one theta to a `SeparableModel` without parameters."""
    return SeparableModel([Term(model.stiffness, ())], [Term(model.mass, ())], model.dofs, motions=model.motions)


_lock = Lock()
"""OpenSees has one model per process, which the threads of a Dask worker share."""
_WHAT = {"stiffness": (0.0, 0.0, 1.0), "mass": (1.0, 0.0, 0.0)}
"""Factors of M, C and K in GimmeMCK."""


@contextmanager
def _alone(ops: ModuleType) -> Iterator[None]:
    """Within a ``with`` block, provide OpenSees to this thread alone, without a model, its messages in a file.

    The model is wiped at the end. The last messages are added to any ValueError. Messages are not printed, because
    OpenSees warns of every singular mass matrix, which is allowed here.
    """
    with _lock, TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        ops.wipe()
        ops.logFile(str(log), "-noEcho")
        try:
            yield
        except ValueError as error:
            said, wrong = last_lines(log), ArgumentError.of(error)
            advice = f"{wrong.advice}; OpenSees said: {said}" if said else wrong.advice
            raise ArgumentError(wrong.key, wrong.rule, wrong.value, advice) from error.__cause__
        finally:
            ops.wipe()
            ops.logFile("", "-echo")


def _openseespy() -> ModuleType:
    try:
        import openseespy.opensees as ops
    except ImportError as error:
        raise ValueError(f"needs the package openseespy: pip install 'fmu[opensees]' ({error})") from error
    return ops


def _followers(ops: ModuleType) -> dict[int, list[int]]:
    """Return the degrees of freedom (from 1) that follow other nodes, keyed by the constrained node.

    Raise ArgumentError if no degree of freedom is free, because OpenSees would crash.
    """
    followers = {node: ops.getConstrainedDOFs(node) for node in sorted(set(ops.getConstrainedNodes() or []))}
    held = sum(len(ops.getFixedDOFs(node)) for node in ops.getFixedNodes() or [])
    held += sum(map(len, followers.values()))
    if sum(ops.getNDF(node)[0] for node in ops.getNodeTags()) <= held:
        raise ArgumentError("build", "must leave degrees of freedom free (all are fixed)")
    return followers


def _assemble_matrix(ops: ModuleType, follows: bool) -> dict[int, list[int]]:
    """Assemble the model, and return the equation numbers of each node's degrees of freedom.

    Fixed degrees of freedom have negative numbers. `follows` says whether nodes follow others, which requires the
    handler Transformation. For such a node, the equations of the followed nodes come after its own equations.
    Raise ArgumentError if there are no equations or more than `MOST_DOFS`.
    """
    begin_analysis(ops, "Transformation" if follows else "Plain", "GimmeMCK", 0.0, 0.0, 1.0)
    ops.analyze(1, 0.0)
    if not 0 < ops.systemSize() <= MOST_DOFS:
        raise ArgumentError("build", f"must leave 1 to {MOST_DOFS} degrees of freedom free", ops.systemSize())
    return {node: ops.nodeDOFs(node) for node in ops.getNodeTags()}


def _matrix(ops: ModuleType, what: str, n: int, factors: Sequence[float]) -> sp.csr_array:
    """Return a sparse matrix of the model, shape (n, n).

    Raise ArgumentError if it is zero, not finite or not symmetric.
    """
    ops.integrator("GimmeMCK", *factors)
    ops.analyze(1, 0.0)
    entries = np.array(ops.printA("-ret") or [], dtype=float)
    if entries.size != n * n or not np.all(np.isfinite(entries)):
        raise ArgumentError("build", f"OpenSees must assemble a finite {what}")
    if not entries.any():
        raise ArgumentError("build", f"must give {what} (that of OpenSees is zero)")
    matrix = entries.reshape(n, n)
    apart = np.max(np.abs(matrix - matrix.T))
    if apart > _ASYMMETRIC * np.max(np.abs(matrix)):
        raise ArgumentError(
            "build", f"the {what} must be symmetric (it differs from its transpose by {quote(apart)})"
        )
    return sp.csr_array(0.5 * (matrix + matrix.T))


def _points(start: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, list[bool]]:
    """Return the points at which to assemble matrices, (n, n_parameters), and a list that marks the check points.

    The starting point comes first.
    """
    ends = np.sort([0.5 * start, 2.0 * start], axis=0)
    low, high = (
        np.where(np.isfinite(given), given, other) for given, other in zip((lower, upper), ends, strict=True)
    )
    low, high = low + _INSIDE * (high - low), high - _INSIDE * (high - low)
    points = [start]
    for j in range(len(start)):
        for value in np.linspace(low[j], high[j], _LEVELS):
            if abs(value - start[j]) > _INSIDE * (high[j] - low[j]):
                points.append(start.copy())
                points[-1][j] = value
    joint = _JOINT * (1 + len(start)) if len(start) > 1 else 0
    inside = np.random.default_rng(0).uniform(low, high, (joint + _CHECKS, len(start)))
    return np.array([*points, *inside]), [False] * (len(points) + joint) + [True] * _CHECKS
