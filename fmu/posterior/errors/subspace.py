"""Modes too close to have shapes of their own: compared as the plane, or the space, that they span."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.types import FloatArray

_RIDGE = 1e-14
"""Added to the Gram matrix of shapes, of its trace: two that are one at the sensors span a line."""

Groups = tuple[tuple[int, ...], ...]


def groups_of(together: Sequence[Sequence[str]], labels: Sequence[str], n_sensors: int) -> Groups:
    """Return groups of modes, given by their names, as numbers from 0.

    Raises
    ------
    ValueError
        If a mode is unknown or named twice, or a group is of one mode or of as many as there are sensors.
    """
    named = [str(name) for group in together for name in group]
    unknown = [name for name in named if name not in labels]
    if unknown:
        raise ValueError(f"together: must name measured modes, {', '.join(labels)} (got {unknown[0]!r})")
    if len(set(named)) < len(named):
        raise ValueError(f"together: must name no mode twice (got {named})")
    for group in together:
        if not 2 <= len(group) < n_sensors:
            raise ValueError(
                f"together: a group must be of 2 modes or more, and fewer than the {n_sensors} sensors "
                f"(got {list(group)})"
            )
    return tuple(tuple(list(labels).index(str(name)) for name in group) for group in together)


def in_span(seen: ModalPrediction, unit: FloatArray, groups: Groups) -> ModalPrediction:
    """Return what is seen with each shape of a group replaced by what the group's span has of the measured one.

    With S the computed shapes of a group at the sensors and P = S (SᵀS)⁻¹ Sᵀ, the shape of mode i becomes P u_i,
    so that its MAC with u_i is ‖P u_i‖², whatever basis of the span the eigensolver returned (cf. D'Ambrogio &
    Fregolent 2003, Higher-order MAC for the correlation of close and multiple modes, *Mech. Syst. Signal Process.*
    17). Its slopes are ∂P u = (I − P) ∂S S⁺u + S⁺ᵀ ∂Sᵀ (I − P) u, from which turns of the shapes within their span
    drop out: through a veering they stay of order one.

    Parameters
    ----------
    seen : ModalPrediction
    unit : ndarray, shape (n_sensors, n_modes)
        Measured shapes of unit length.
    groups : tuple of tuple of int
    """
    shapes = seen.shapes.copy()
    slopes = None if seen.shape_slopes is None else seen.shape_slopes.copy()
    for group in groups:
        modes = list(group)
        S, u = seen.shapes[:, :, modes], unit[:, modes]
        gram = np.swapaxes(S, 1, 2) @ S
        ridge = _RIDGE * np.trace(gram, axis1=1, axis2=2) + np.finfo(float).tiny
        pseudo = np.linalg.solve(gram + ridge[:, None, None] * np.eye(len(modes)), np.swapaxes(S, 1, 2))
        a = pseudo @ u
        shapes[:, :, modes] = S @ a
        if slopes is None or seen.shape_slopes is None:
            continue
        dS = seen.shape_slopes[:, :, modes]
        across = np.einsum("nqrp,nrm->nqmp", dS, a)  # ∂S S⁺u
        across -= np.einsum("nqr,nrmp->nqmp", S, np.einsum("nrq,nqmp->nrmp", pseudo, across))
        left = u - S @ a
        turned = np.einsum("nrq,nrmp->nqmp", pseudo, np.einsum("nqrp,nqm->nrmp", dS, left))
        slopes[:, :, modes] = across + turned
    return replace(seen, shapes=shapes, shape_slopes=slopes)
