"""Multi-point constraints in OpenSees: rigid diaphragms, rigid links and equal degrees of freedom.

A constrained degree of freedom is called a follower here. Its displacement is a weighted sum of the displacements
of retained degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from types import ModuleType

import numpy as np

from fmu.formats.models.exported import DofName
from fmu.formats.shown import names_shown
from fmu.types import FloatArray

_SPARE = 2
"""Number of load cases in addition to the number of weights; they test whether u is a weighted sum."""
_UNEXPLAINED = 1e-9
"""Largest relative error of a follower's displacement; OpenSees imposes the constraint to rounding."""
_TAG = 987_654_321
"""Tag of the time series and load pattern; builds use smaller tags."""


def follower_motions(
    ops: ModuleType, directions: Mapping[int, Sequence[str]], dofs: Collection[DofName], step: float
) -> tuple[dict[DofName, dict[DofName, float]], list[str]]:
    """Return each follower's displacement as a weighted sum of retained degrees of freedom.

    OpenSees does not print C in u_follower = C u_retained. C is therefore fitted by least squares to displacements
    under random loads, for which the handler Transformation satisfies the constraints to rounding. The loads act
    during a step of Newmark's method, whose matrix K + 4 M/Δt² is regular for free structures too.

    Parameters
    ----------
    ops : module
        The module openseespy.opensees, with a model. Its state and its analysis are changed.
    directions : mapping of int to sequence of str
        Names of each node's degrees of freedom.
    dofs : collection of (node, direction)
        The free degrees of freedom that are not followers.
    step : float, s
        The time step Δt, for which K and 4 M/Δt² are of similar size.

    Returns
    -------
    motions : dict of (node, direction) to dict of (node, direction) to float
        For each follower, the weights of the free degrees of freedom. Followers that do not move are omitted.
    notes : list of str
        One sentence that lists the followers whose displacement is not such a sum. They cannot have sensors. The
        list is empty if there are no such followers.
    """
    retained = {
        node: sorted(set(ops.getRetainedNodes(node))) for node in sorted(set(ops.getConstrainedNodes() or []))
    }
    if not retained:
        return {}, []
    sources = {
        node: [(other, d) for other in others for d in directions[other]] for node, others in retained.items()
    }
    moved = _displacements(ops, directions, max(map(len, sources.values())) + _SPARE, step)
    motions: dict[DofName, dict[DofName, float]] = {}
    unknown: list[DofName] = []
    for node, source in sources.items():
        u = np.column_stack([moved[other, d] for other, d in source])
        for j in ops.getConstrainedDOFs(node):
            name = (node, directions[node][j - 1])
            weights = _weights(u, moved[name])
            if weights is None:
                unknown.append(name)
                continue
            found = {dof: w for dof, w in zip(source, weights.tolist(), strict=True) if w and dof in dofs}
            motions |= {name: found} if found else {}
    which = names_shown([f"{node} {direction}" for node, direction in unknown])
    return motions, [f"No sensors can be at followers whose motion is not known: {which}."] if unknown else []


def begin_analysis(ops: ModuleType, constraints: str, integrator: str, *parameters: float) -> None:
    """Set up an analysis of a linear model with dense matrices. It replaces the current OpenSees analysis."""
    ops.wipeAnalysis()
    ops.constraints(constraints)
    ops.numberer("Plain")
    ops.system("FullGeneral")
    ops.algorithm("Linear")
    ops.integrator(integrator, *parameters)
    ops.analysis("Transient")


def _weights(u: FloatArray, own: FloatArray) -> FloatArray | None:
    """Solve u (n, m) w = own (n,) for w (m,) by least squares; return None if the residual is not negligible.

    Weights that contribute only rounding are set to zero.
    """
    size = np.linalg.norm(u, axis=0)
    size[size == 0.0] = 1.0
    scaled = np.linalg.lstsq(u / size, own, rcond=1e-12)[0]
    allowed = _UNEXPLAINED * np.linalg.norm(own)
    if not np.linalg.norm(u / size @ scaled - own) <= allowed:  # NaN too: the step failed
        return None
    scaled[np.abs(scaled) <= allowed] = 0.0
    return scaled / size


def _displacements(
    ops: ModuleType, directions: Mapping[int, Sequence[str]], n_loads: int, step: float
) -> dict[DofName, FloatArray]:
    """Return the displacements (n_loads,) of each degree of freedom, fixed or free, under random loads."""
    rng = np.random.default_rng(0)
    begin_analysis(ops, "Transformation", "Newmark", 0.5, 0.25)
    ops.timeSeries("Constant", _TAG)
    rows = []
    for _ in range(n_loads):
        ops.pattern("Plain", _TAG, _TAG)
        for node, names in directions.items():
            ops.load(node, *rng.standard_normal(len(names)).tolist())
        ops.analyze(1, step)
        ops.remove("loadPattern", _TAG)
        rows.append([x for node in directions for x in ops.nodeDisp(node)])
    dofs = [(node, d) for node, own in directions.items() for d in own]
    return dict(zip(dofs, np.array(rows, dtype=float).T, strict=True))
