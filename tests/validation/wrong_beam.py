"""A beam of two parts with a bolted joint: the model that is updated, and structures that differ from it.

The beam is clamped at one end. It bends about two axes and stretches: its matrices have three blocks. The joint at
midspan turns about one axis and stretches. The parameters are the moduli of both parts and three values that are
not updated, all relative: the stiffness of the joint, the thickness, and the mass, which is 1 plus the mass of the
joint's flange as a part of the mass of the beam.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, eigh

import fmu
from fmu.types import FloatArray

ELEMENTS, LENGTH = 12, 2.0
EI, EI_OTHER, EA = 4.0e4, 3.6e5, 8.0e8
"""Bending stiffnesses, N m², and tension stiffness, N."""
MASS = 12.0
"""Mass a length, kg/m."""
JOINT, JOINT_TENSION = EI_OTHER / LENGTH, EA / LENGTH
"""Stiffness of the joint, N m and N/m."""
NUMBERS = (4, 8, 6)
MODES = sum(NUMBERS)
"""Number of measured modes of each block, and of all."""
MODULI, HELD = ("E1", "E2"), ("joint", "thickness", "mass")
PRIOR_SD, ERRORS = 0.05, (0.01, 0.02)
SOFT, FORGOTTEN, THICKNESS = (0.05, 0.30), (0.02, 0.06), 0.03
"""Errors of a model: by how much the joint is softer, the forgotten mass, and the error of the thickness."""
SIZES = {
    "joint": float(np.sqrt((SOFT[1] ** 3 - SOFT[0] ** 3) / (SOFT[1] - SOFT[0]) / 3.0)),
    "thickness": THICKNESS,
    "mass": float(np.sqrt((FORGOTTEN[1] ** 3 - FORGOTTEN[0] ** 3) / (FORGOTTEN[1] - FORGOTTEN[0]) / 3.0)),
}
"""Root mean squares of these errors, the standard deviations of the priors of τ."""


class Blocks(NamedTuple):
    """Matrices of the beam without units of its parameters: K of both parts and of the joint, M, M of the flange.

    Attributes
    ----------
    parts : list of tuple (block, part, ndarray)
    joint : list of tuple (block, ndarray)
    mass, flange : list of ndarray
        One a block.
    """

    parts: list[tuple[int, int, FloatArray]]
    joint: list[tuple[int, FloatArray]]
    mass: list[FloatArray]
    flange: list[FloatArray]


def _element(kind: str) -> tuple[FloatArray, FloatArray]:
    """Return the stiffness and mass matrix of an element of unit stiffness and unit mass a length."""
    h = LENGTH / ELEMENTS
    if kind == "rod":
        return np.array([[1.0, -1.0], [-1.0, 1.0]]) / h, np.array([[2.0, 1.0], [1.0, 2.0]]) * h / 6.0
    k = np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2]])
    k = np.vstack([k, [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]]) / h**3
    m = np.array([[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2]])
    m = np.vstack([m, [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2]]) * h / 420.0
    return k, m


def blocks() -> Blocks:
    """Return the matrices of bending, bending about the other axis, and tension."""
    found = Blocks([], [], [], [])
    middle = ELEMENTS // 2
    kinds = (("beam", EI, 0.0), ("beam", EI_OTHER, JOINT), ("rod", EA, JOINT_TENSION))
    for b, (kind, stiffness, joint) in enumerate(kinds):
        k, m = _element(kind)
        q = 2 if kind == "beam" else 1
        n = q * (ELEMENTS + 1) + (joint > 0.0)  # the last is the motion of the right side of the joint
        K, M, flange = np.zeros((2, n, n)), np.zeros((n, n)), np.zeros((n, n))
        turned = q * middle + q - 1
        for e in range(ELEMENTS):
            dofs = np.arange(q * e, q * (e + 2))
            if joint and e >= middle:
                dofs[dofs == turned] = n - 1
            K[e // middle][np.ix_(dofs, dofs)] += stiffness * k
            M[np.ix_(dofs, dofs)] += MASS * m
        flange[q * middle, q * middle] = MASS * LENGTH
        found.parts.extend((b, part, K[part][q:, q:]) for part in range(2))
        found.mass.append(M[q:, q:])
        found.flange.append(flange[q:, q:])
        if joint:
            spring = np.zeros((n, n))
            spring[np.ix_([turned, n - 1], [turned, n - 1])] = joint * np.array([[1.0, -1.0], [-1.0, 1.0]])
            found.joint.append((b, spring[q:, q:]))
    return found


_BLOCKS = blocks()
_POWERS = (3, 1, 1)
"""Powers of the thickness in the stiffness of the blocks."""


def _in_place(b: int, matrix: FloatArray) -> FloatArray:
    """Return a matrix of all degrees of freedom with the one of block `b`."""
    return np.asarray(block_diag(*(matrix if b == i else np.zeros_like(m) for i, m in enumerate(_BLOCKS.mass))))


def model() -> fmu.SeparableModel:
    """Return the model; its parameters are `MODULI` and `HELD`."""
    stiffness = [
        (_in_place(b, K), {MODULI[part]: 1, "thickness": _POWERS[b]}) for b, part, K in _BLOCKS.parts
    ]  # fmt: skip
    stiffness += [(_in_place(b, K), "joint") for b, K in _BLOCKS.joint]
    flange = np.asarray(block_diag(*_BLOCKS.flange))
    mass = [(np.asarray(block_diag(*_BLOCKS.mass)), "thickness"), (flange, "mass"), -flange]
    return fmu.SeparableModel.from_terms([*MODULI, *HELD], stiffness, mass)


def _matrices(
    b: int, moduli: FloatArray, joint: float = 1.0, thickness: float = 1.0, mass: float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Return K and M of a block."""
    parts = [moduli[part] * thickness ** _POWERS[b] * k for block, part, k in _BLOCKS.parts if block == b]
    K = np.sum([*parts, *(joint * k for block, k in _BLOCKS.joint if block == b)], axis=0)
    return K, thickness * _BLOCKS.mass[b] + (mass - 1.0) * _BLOCKS.flange[b]


def frequencies(moduli: FloatArray, **values: float) -> FloatArray:
    """Return the frequencies of the measured modes, Hz, of one block after the other, by LAPACK alone.

    `values` are those of `HELD` that differ from 1.
    """
    eigenvalues = [
        eigh(*_matrices(b, moduli, **values), eigvals_only=True)[:number] for b, number in enumerate(NUMBERS)
    ]
    return np.asarray(np.sqrt(np.concatenate(eigenvalues)) / (2.0 * np.pi))


class Simulated(NamedTuple):
    """A simulated structure: true moduli, measured frequencies and their sd, Hz, and the error of the model.

    Attributes
    ----------
    moduli : ndarray, shape (2,)
    measured, sd : ndarray, shape (MODES,)
    size : float
    signal : float
        The change of the frequencies by the error, in standard deviations, as far as the moduli cannot follow.
    cosine : float
        The largest cosine of this change with the changes that another group can make.
    """

    moduli: FloatArray
    measured: FloatArray
    sd: FloatArray
    size: float
    signal: float
    cosine: float


def simulate(rng: np.random.Generator, kind: str) -> Simulated:
    """Return a structure with an error of the model of a kind: "joint", "thickness", "mass" or "right"."""
    moduli = 1.0 + PRIOR_SD * rng.standard_normal(2)
    values = dict.fromkeys(HELD, 1.0)
    size = {
        "joint": -float(rng.uniform(*SOFT)),
        "thickness": float(rng.choice([-1.0, 1.0])) * THICKNESS,
        "mass": float(rng.uniform(*FORGOTTEN)),
        "right": 0.0,
    }[kind]
    if kind != "right":
        values[kind] += size
    f = frequencies(moduli, **values)
    sd = f * np.exp(rng.uniform(*np.log(ERRORS), MODES))
    signal, cosine = (0.0, 0.0) if kind == "right" else told(kind, size, sd)
    return Simulated(moduli, f + sd * rng.standard_normal(MODES), sd, size, signal, cosine)


def told(kind: str, size: float, sd: FloatArray) -> tuple[float, float]:
    """Return the signal-to-noise ratio and the largest cosine of an error of the model, by the linear model.

    With the slopes S of the frequencies by the moduli in standard deviations of their prior, and all in standard
    deviations of the measurement, an error d has the signal √(dᵀ(I + SSᵀ)⁻¹d): the moduli follow it as far as
    their prior lets them. Cosines are in the same inner product; that with the moduli themselves is without it.
    """
    step, one = 1e-4, np.ones(2)

    def slope(**change: float) -> FloatArray:
        at = dict.fromkeys(HELD, 1.0)
        up, down = ({k: v + sign * change.get(k, 0.0) for k, v in at.items()} for sign in (1.0, -1.0))
        return np.asarray((frequencies(one, **up) - frequencies(one, **down)) / (2.0 * step) / sd)

    E = np.stack(
        [(frequencies(one + step * x) - frequencies(one - step * x)) / (2.0 * step) / sd for x in np.eye(2)]
    )
    root = np.linalg.cholesky(np.linalg.inv(np.eye(MODES) + PRIOR_SD**2 * E.T @ E)).T
    d = size * slope(**{kind: step})
    signal = float(np.linalg.norm(root @ d))
    cosines = [np.linalg.norm(np.linalg.qr(E.T)[0].T @ d) / np.linalg.norm(d)]
    for other in set(HELD) - {kind}:
        x = root @ slope(**{other: step})
        cosines.append(abs(x @ root @ d) / np.linalg.norm(x) / signal)
    return signal, float(max(cosines))


def problem(
    measured: FloatArray, sd: FloatArray, discrepancy: bool = False, correlation: float = 0.0
) -> fmu.UpdatingProblem:
    """Return the problem of updating the moduli, with a scatter of each of `HELD` over the modes or without."""
    prior = fmu.Normal(PRIOR_SD, mean=1.0)
    parameters = [fmu.Parameter(name, 1.0, 0.8, 1.2, prior=prior) for name in MODULI]
    parameters += [fmu.Parameter(name, 1.0, 0.99, 1.01, updated=False) for name in HELD]
    before = frequencies(np.ones(2))
    every = np.sqrt(np.concatenate([eigh(*_matrices(b, np.ones(2)), eigvals_only=True) for b in range(3)]))
    rank = 1 + np.searchsorted(np.sort(every / (2.0 * np.pi)), before * (1.0 - 1e-9))
    order = np.argsort(rank)
    data = fmu.ModalData(measured[order], sd_hz=sd[order], counterparts=tuple(rank[order].tolist()))
    scatters = [
        fmu.Discrepancy(groups=(one,), name=f"tau {one}", prior_sd=SIZES[one], correlation=correlation)
        for one in HELD
    ]
    return fmu.UpdatingProblem.reduced(
        model(), data, parameters, pairing="shape", discrepancy=scatters if discrepancy else ()
    )
