"""Derivatives of mode shapes with respect to the parameters.

For a simple eigenvalue of K φ = λ M φ with φᵀMφ = 1,

    (K − λM) ∂φ − ∂λ Mφ = −(∂K − λ ∂M) φ,      φᵀM ∂φ = −½ φᵀ ∂M φ.

These equations are solved in two ways. If all modes are known (a reduced model), ∂φ is a sum over all modes (Fox &
Kapoor 1968, *AIAA Journal* 6, 2426–2429). Otherwise, or if a singular M leaves some modes without a finite λ, both
equations form one regular system for ∂φ and ∂λ; Nelson (1976, *AIAA Journal* 14, 1201–1205) solves the same
equations with one component of ∂φ fixed.

Shapes of repeated eigenvalues have no derivative, because any rotation among these shapes also gives modes. If two
eigenvalues are closer than `REPEATED`, the sum omits the rotation, and the system is singular unless the rotation
is excluded. If they are slightly further apart, the rotation is large, and correctly so: the closer two modes are,
the faster their shapes rotate into each other. If two eigenvalues λ differ by δλ, the derivatives are of the order
of λ/δλ. Like the shapes, they have a relative error of the rounding error times λ_max/δλ: 1e-6 for modes 1e-4
apart, if the highest eigenvalue is below about 10⁶ λ. A reduced basis with a relative frequency error ε gives
shapes with an error of ε divided by the gap.

Second derivatives of an eigenvalue contain these rotations and are of the order of λ²/δλ. There the rotation is
omitted if two eigenvalues are closer than `CLOSE`, because rounding may exceed it. One step of a sampler changes
the eigenvalues by far more than this gap.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as ssl

from fmu.fem.modes.solver import Matrix
from fmu.types import FloatArray

REPEATED = 1e-9
"""Eigenvalues whose difference is less than this share of the larger count as repeated."""
CLOSE = 1e-7
"""The same as `REPEATED`, for second derivatives of eigenvalues."""


def by_all_modes(
    lam: FloatArray, phi: FloatArray, dK: FloatArray, dM: FloatArray | None, count: int, repeated: float = REPEATED
) -> FloatArray:
    """Return the derivatives ∂φ of the lowest `count` shapes, as sums over all modes.

    Parameters
    ----------
    lam : ndarray, shape (n, r)
        Eigenvalues of all modes.
    phi : ndarray, shape (n, r, r)
        Shapes of all modes, φᵀMφ = 1.
    dK, dM : ndarray, shape (n, r, count, n_parameters)
        φ_kᵀ ∂K φ_i and φ_kᵀ ∂M φ_i; `dM` is None if the mass is constant.
    repeated : float
        Relative difference up to which two eigenvalues count as repeated; the sum omits the rotation of such modes
        into each other.

    Returns
    -------
    ndarray, shape (n, r, count, n_parameters)
    """
    # ∂φ_i = Σ_k w_k φ_k with w_k = φ_kᵀ(∂K − λ_i ∂M)φ_i / (λ_i − λ_k) for k ≠ i, as the modes are M-orthogonal
    own, other = lam[:, None, :count], lam[:, :, None]
    gap = own - other
    gap[~(np.abs(gap) > repeated * np.maximum(np.abs(own), np.abs(other)))] = np.inf
    weight = (dK if dM is None else dK - own[..., None] * dM) / gap[..., None]
    i = np.arange(count)
    # and w_i = −½ φ_iᵀ ∂M φ_i, from φᵀMφ = 1 at every theta
    weight[:, i, i] = 0.0 if dM is None else -0.5 * dM[:, i, i]
    n, r = lam.shape
    return (phi @ weight.reshape(n, r, -1)).reshape(dK.shape)


def by_bordered_system(
    K: Matrix,
    M: Matrix,
    lam: float,
    phi: FloatArray,
    dK_phi: FloatArray,
    dM_phi: FloatArray,
    beside: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return one mode's shape derivative ∂φ, (size, n_parameters), and eigenvalue derivative ∂λ, (n_parameters,).

    Parameters
    ----------
    K, M : ndarray or sparse arrays, shape (size, size)
        Both dense or both sparse.
    lam : float
    phi : ndarray, shape (size,)
    dK_phi, dM_phi : ndarray, shape (size, n_parameters)
        ∂K φ and ∂M φ.
    beside : ndarray, shape (size, q), optional
        Shapes of other modes with the same eigenvalue. The derivative has no component along them.

    Notes
    -----
    The derivatives are NaN if the system is singular, for instance if the eigenvalue is repeated and `beside` is
    not given. They may be infinite if the system is regular only because of rounding.
    """
    # K − λM alone is singular, with φ as its null vector; the border M φ, which is not orthogonal to φ, makes the
    # system regular. The border is scaled to the size of K, so that all entries have one scale.
    M_phi = M @ phi
    scale = np.max(np.abs(K.diagonal())) / np.max(np.abs(M_phi))
    border = (scale * M_phi)[:, None]
    load = np.concatenate([lam * dM_phi - dK_phi, -0.5 * scale * (phi @ dM_phi)[None]])
    if beside is not None:
        border = np.concatenate([border, scale * (M @ beside)], axis=1)
        load = np.concatenate([load, np.zeros((beside.shape[1], load.shape[1]))])
    try:
        if sp.issparse(K):
            column = sp.csc_array(border)
            system = sp.block_array([[K - lam * M, -column], [column.T, None]], format="csc")
            solution = ssl.splu(system).solve(load)
        else:
            corner = np.zeros((border.shape[1], border.shape[1]))
            solution = np.linalg.solve(np.block([[K - lam * M, -border], [border.T, corner]]), load)
    except (RuntimeError, np.linalg.LinAlgError):
        solution = np.full(load.shape, np.nan)
    with np.errstate(over="ignore"):
        return solution[: len(phi)], scale * solution[len(phi)]


def by_bordered_matrices(
    K: FloatArray, M: FloatArray, lam: FloatArray, phi: FloatArray, dK_phi: FloatArray, dM_phi: FloatArray
) -> FloatArray:
    """Return the shape derivatives ∂φ for one mode of each of n small matrix pairs, (n, r, n_parameters).

    Parameters
    ----------
    K, M : ndarray, shape (n, r, r)
    lam : ndarray, shape (n,)
    phi : ndarray, shape (n, r)
    dK_phi, dM_phi : ndarray, shape (n, r, n_parameters)

    Raises
    ------
    LinAlgError
        If a system is singular, as for a repeated eigenvalue.
    """
    n, r = phi.shape
    M_phi = (M @ phi[..., None])[..., 0]
    diagonal = np.max(np.abs(np.diagonal(K, axis1=1, axis2=2)), axis=1)
    scale = (diagonal / np.max(np.abs(M_phi), axis=1))[:, None]
    system = np.zeros((n, r + 1, r + 1))
    system[:, :r, :r] = K - lam[:, None, None] * M
    system[:, :r, r] = -scale * M_phi
    system[:, r, :r] = scale * M_phi
    load = np.empty((n, r + 1, dK_phi.shape[2]))
    load[:, :r] = lam[:, None, None] * dM_phi - dK_phi
    load[:, r] = -0.5 * scale * np.sum(phi[..., None] * dM_phi, axis=1)
    return np.asarray(np.linalg.solve(system, load)[:, :r])
