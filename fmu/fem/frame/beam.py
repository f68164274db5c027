"""The 3-D Euler–Bernoulli beam element with rotary inertia, as a sum of unit matrices.

The nodes are in the order (i, j). Each node has the degrees of freedom u, v, w, θx, θy, θz in local axes, with x
along the element. Bending in the local x–z plane (w, θy) has the stiffness E·Iy with Iy = ∫z² dA. Bending in the
local x–y plane (v, θz) has the stiffness E·Iz with Iz = ∫y² dA. Displacements are interpolated linearly (bar,
torsion) and by cubic Hermite polynomials (bending). The mass matrix is consistent with this interpolation and
includes the rotary inertia of the section (Rayleigh 1894; Przemieniecki 1968, *Theory of Matrix Structural
Analysis*, ch. 11).

The element matrices are ``K = EA·K_EA + EIy·K_EIy + EIz·K_EIz + GJ·K_GJ`` and
``M = ρA·M_ρA + ρIy·M_ρIy + ρIz·M_ρIz``. This module gives the unit matrices, which depend on the length alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError
from fmu.types import FloatArray

_AXIAL = (0, 6)
_TORSION = (3, 9)
# (displacement, rotation) of both nodes; in the x–z plane a positive θy decreases w, hence the sign.
_BENDING_XZ = (2, 4, 8, 10)
_BENDING_XY = (1, 5, 7, 11)
_ROTATION_SIGN: dict[tuple[int, ...], float] = {_BENDING_XY: 1.0, _BENDING_XZ: -1.0}


def stiffness_terms(length: ArrayLike) -> dict[str, FloatArray]:
    """Return the unit stiffness matrices of beam elements.

    Parameters
    ----------
    length : array_like, shape (n,)
        Element lengths in m.

    Returns
    -------
    dict of str to ndarray, shape (n, 12, 12)
        ``"EA"``, ``"EIy"``, ``"EIz"``, ``"GJ"``. The sum of these matrices, each times the rigidity of that name,
        is the element stiffness.

    Raises
    ------
    ValueError
        If a length is not positive.
    """
    L = _lengths(length)
    bar = np.array([[1.0, -1.0], [-1.0, 1.0]]) / L[:, None, None]
    return {
        "EA": _place(bar, _AXIAL),
        "EIy": _bending_stiffness(L, _BENDING_XZ),
        "EIz": _bending_stiffness(L, _BENDING_XY),
        "GJ": _place(bar, _TORSION),
    }


def mass_terms(length: ArrayLike) -> dict[str, FloatArray]:
    """Return the unit consistent mass matrices of beam elements.

    Parameters
    ----------
    length : array_like, shape (n,)
        Element lengths in m.

    Returns
    -------
    dict of str to ndarray, shape (n, 12, 12)
        ``"rhoA"`` (translation), ``"rhoIy"`` (rotary inertia in the x–z plane) and ``"rhoIz"`` (rotary inertia in
        the x–y plane). The last two each contain their part of the torsional inertia ρ(Iy + Iz). The sum of these
        matrices, each times the quantity of that name, is the element mass.

    Raises
    ------
    ValueError
        If a length is not positive.
    """
    L = _lengths(length)
    bar = np.array([[2.0, 1.0], [1.0, 2.0]]) * L[:, None, None] / 6.0
    translation = _place(bar, _AXIAL) + _translational_mass(L, _BENDING_XY) + _translational_mass(L, _BENDING_XZ)
    torsion = _place(bar, _TORSION)
    return {
        "rhoA": translation,
        "rhoIy": _rotary_mass(L, _BENDING_XZ) + torsion,
        "rhoIz": _rotary_mass(L, _BENDING_XY) + torsion,
    }


def local_axes(axis: ArrayLike, y_direction: ArrayLike) -> FloatArray:
    """Return the rotation matrices from global to local coordinates.

    Parameters
    ----------
    axis : array_like, shape (n, 3)
        Vectors from node i to node j.
    y_direction : array_like, shape (3,) or (n, 3)
        A vector in the local x–y plane; its component normal to `axis` gives the local y axis.

    Returns
    -------
    ndarray, shape (n, 3, 3)
        Rows are the local x, y, z axes in global coordinates.

    Raises
    ------
    ValueError
        If `y_direction` is zero or parallel to an element, or an element has no length.
    """
    x = np.asarray(axis, dtype=float)
    x = x / _lengths(np.linalg.norm(x, axis=1))[:, None]
    direction = np.broadcast_to(np.asarray(y_direction, dtype=float), x.shape)
    y = direction - np.sum(x * direction, axis=1, keepdims=True) * x
    norm = np.linalg.norm(y, axis=1, keepdims=True)
    # Closer to parallel than this, the normal component is only rounding; "not >" also catches zero and NaN.
    parallel = ~(norm > 1e-6 * np.linalg.norm(direction, axis=1, keepdims=True))[:, 0]
    if np.any(parallel):
        element = int(np.argmax(parallel))
        raise ArgumentError(
            "y_direction", f"must not be zero or parallel to an element (wrong for element {element})"
        )
    y = y / norm
    return np.stack([x, y, np.cross(x, y)], axis=1)


def horizontal(axis: ArrayLike) -> FloatArray:
    """Return the default direction of the elements' local y axis.

    Parameters
    ----------
    axis : array_like, shape (n, 3)
        Vectors from node i to node j.

    Returns
    -------
    ndarray, shape (n, 3)
        Vectors that are horizontal (global z is up) and normal to each element. They are not normalised. For an
        element within 0.001 rad of the vertical, the vector is global y instead, because the horizontal normal
        would depend on rounding.
    """
    vector = np.asarray(axis, dtype=float)
    direction = np.stack([-vector[:, 1], vector[:, 0], np.zeros(len(vector))], axis=1)
    vertical = np.linalg.norm(direction, axis=1) <= 1e-3 * np.linalg.norm(vector, axis=1)
    return np.where(vertical[:, None], [0.0, 1.0, 0.0], direction)


def to_global(matrices: FloatArray, axes: FloatArray) -> FloatArray:
    """Rotate element matrices from local to global axes, ``Tᵀ K T``.

    Parameters
    ----------
    matrices : ndarray, shape (n, 12, 12)
    axes : ndarray, shape (n, 3, 3)
        Rotation matrices from `local_axes`.
    """
    T = np.zeros((len(axes), 12, 12))
    for k in range(4):
        T[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = axes
    return np.swapaxes(T, 1, 2) @ matrices @ T


def _lengths(length: ArrayLike) -> FloatArray:
    L = np.atleast_1d(np.asarray(length, dtype=float))
    if not np.all(L > 0.0):
        raise ArgumentError("length", "must be positive", f"{float(np.min(L))} m")
    return L


def _place(small: FloatArray, dofs: tuple[int, ...]) -> FloatArray:
    matrix = np.zeros((len(small), 12, 12))
    matrix[:, np.array(dofs)[:, None], np.array(dofs)] = small
    return matrix


def _apply_signs(rows: list[list[FloatArray]], plane: tuple[int, ...]) -> FloatArray:
    small = np.array(rows).transpose(2, 0, 1)
    sign = np.array([1.0, _ROTATION_SIGN[plane]] * 2)
    return _place(small * sign[:, None] * sign, plane)


def _bending_stiffness(L: FloatArray, plane: tuple[int, ...]) -> FloatArray:
    a, b, c, d = 12 / L**3, 6 / L**2, 4 / L, 2 / L
    return _apply_signs([[a, b, -a, b], [b, c, -b, d], [-a, -b, a, -b], [b, d, -b, c]], plane)


def _translational_mass(L: FloatArray, plane: tuple[int, ...]) -> FloatArray:
    a, b, c = 156 * L / 420, 22 * L**2 / 420, 54 * L / 420
    d, e, f = 13 * L**2 / 420, 4 * L**3 / 420, 3 * L**3 / 420
    return _apply_signs([[a, b, c, -d], [b, e, d, -f], [c, d, a, -b], [-d, -f, -b, e]], plane)


def _rotary_mass(L: FloatArray, plane: tuple[int, ...]) -> FloatArray:
    a, b = 36 / (30 * L), 3.0 / 30 * np.ones_like(L)
    c, d = 4 * L / 30, L / 30
    return _apply_signs([[a, b, -a, b], [b, c, -b, -d], [-a, -b, a, -b], [b, -d, -b, c]], plane)
