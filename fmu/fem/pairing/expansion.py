"""Expansion of measured shapes to all of a model's degrees of freedom, for plots.

SEREP, the default, fits the model's modes to the measured shapes. It averages out noise at single sensors, works
with any sensors that can tell the modes apart, and its residual shows how far to trust the plot. Dynamic expansion
reproduces the measured values exactly and computes the other degrees of freedom from the model's inertia and
stiffness. Noise remains as kinks at the sensors. The expanded shape is unbounded if a measured frequency is a
natural frequency of the model with its sensors fixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as ssl
from numpy.typing import ArrayLike

from fmu.fem.modes.separable import SeparableModel
from fmu.numbers import typed
from fmu.types import Dof, FloatArray

METHODS = ("serep", "dynamic")


@dataclass(frozen=True, eq=False)
class Expanded:
    """Measured shapes expanded to all degrees of freedom.

    Attributes
    ----------
    shapes : ndarray, shape (n_dof, n_modes)
        Expanded shapes, in the scale of the measured shapes.
    kept : ndarray, shape (n_modes,)
        Share of each measured shape's sum of squares that the expanded shape reproduces at the sensors. It is 1 if
        the two shapes are equal there.
    """

    shapes: FloatArray
    kept: FloatArray


def serep(measured: FloatArray, rows: sp.sparray, modes: FloatArray) -> FloatArray:
    """Return Φ (C Φ)⁺ φ: for each measured shape, the closest combination of model modes at the sensors.

    This is the smoothed form of the system equivalent reduction expansion process (O'Callahan, Avitabile & Riemer
    1989, IMAC VII).

    Parameters
    ----------
    measured : ndarray, shape (n_sensors, m)
        φ.
    rows : sparse, shape (n_sensors, n_dof)
        C, from `fmu.fem.modes.separable.SeparableModel.observation`.
    modes : ndarray, shape (n_dof, r)
        Φ.

    Returns
    -------
    ndarray, shape (n_dof, m)

    Raises
    ------
    ValueError
        If the sensors cannot tell the modes apart: the modes are linearly dependent at the sensors, as they are if
        there are fewer sensors than modes.
    """
    seen = rows @ modes
    size = np.linalg.norm(seen, axis=0)
    unit = np.divide(seen, size, out=np.zeros_like(seen), where=size > 0)
    rank = np.linalg.matrix_rank(unit, tol=1e-6)
    if rank < modes.shape[1]:
        raise ValueError(f"sensors: must tell {modes.shape[1]} modes apart to expand shapes (they tell {rank})")
    weights = np.linalg.lstsq(unit, measured, rcond=None)[0] / size[:, None]
    return np.asarray(modes @ weights)


def dynamic(
    measured: FloatArray, frequencies_hz: ArrayLike, rows: sp.sparray, K: sp.sparray, M: sp.sparray
) -> FloatArray:
    """Return shapes that equal the measured shapes at the sensors and need no force anywhere else.

    This is dynamic expansion (Kidder 1973, AIAA Journal 11, 251). The expanded shape u of a measured shape φ with
    angular frequency ω satisfies (K − ω²M) u = Cᵀ f and C u = φ, where f are the forces at the sensors.

    Parameters
    ----------
    measured : ndarray, shape (n_sensors, m)
    frequencies_hz : array_like, shape (m,)
    rows : sparse, shape (n_sensors, n_dof)
        C, of full rank.
    K, M : sparse, shape (n_dof, n_dof)

    Returns
    -------
    ndarray, shape (n_dof, m)

    Raises
    ------
    ValueError
        If two sensors see the same motion, or a measured frequency is a natural frequency of the model with its
        sensors fixed.
    """
    n = rows.shape[1]
    shapes = np.empty((n, measured.shape[1]))
    scale = float(np.mean(np.abs(K.diagonal())))  # unit of the forces, so that all rows are of similar size
    for k, frequency in enumerate(np.asarray(frequencies_hz, dtype=float)):
        Z = (K - (2.0 * np.pi * frequency) ** 2 * M) / scale
        system = sp.block_array([[Z, rows.T], [rows, None]], format="csc")
        try:
            u = ssl.splu(system).solve(np.concatenate([np.zeros(n), measured[:, k]]))[:n]
        except RuntimeError:
            u = np.full(n, np.nan)
        if not np.linalg.norm(rows @ u - measured[:, k]) <= 1e-6 * np.linalg.norm(measured[:, k]):
            raise ValueError(
                f"sensors: must be distinct, and the model must not resonate at {typed(frequency)} Hz with them "
                "held, to expand shapes by the dynamic stiffness; use method='serep'"
            )
        shapes[:, k] = u
    return shapes


def expand(
    model: SeparableModel,
    theta: ArrayLike,
    modes: FloatArray,
    sensors: Sequence[Dof],
    measured: ArrayLike,
    frequencies_hz: ArrayLike,
    method: str = "serep",
) -> Expanded:
    """Expand measured shapes to all degrees of freedom of a model.

    Parameters
    ----------
    model : SeparableModel
    theta : array_like, shape (n_parameters,)
    modes : ndarray, shape (n_dof, r)
        Modes of the model at `theta` that are paired with the measured modes; used only by SEREP.
    sensors : sequence of (place, direction)
    measured : array_like, shape (n_sensors, n_modes)
    frequencies_hz : array_like, shape (n_modes,)
        Measured frequencies; used only by dynamic expansion.
    method : {"serep", "dynamic"}

    Raises
    ------
    ValueError
        If the method is unknown, a sensor sees no free degree of freedom, or the method fails as described for
        `serep` and `dynamic`.
    """
    rows, phi = model.observation(sensors), np.asarray(measured, dtype=float)
    if method == "serep":
        shapes = serep(phi, rows, modes)
    elif method == "dynamic":
        shapes = dynamic(phi, frequencies_hz, rows, model.K(theta), model.M(theta))
    else:
        raise ValueError(f"method: must be one of {', '.join(METHODS)} (got {method!r})")
    kept = 1.0 - np.sum((rows @ shapes - phi) ** 2, axis=0) / np.sum(phi**2, axis=0)
    return Expanded(shapes, kept)
