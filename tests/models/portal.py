"""A portal frame with rotational springs at its feet and corners, whose stiffnesses span four decades."""

import numpy as np
import scipy.linalg as sl

import fmu

E, AREA, INERTIA, RHO, HEIGHT, SPAN, ELEMENTS = 2.1e11, 6e-3, 4e-5, 7850.0, 4.0, 6.0, 4
TRUTH = np.array([1.02, 3e6, 8e5, 2e7, 5e6])
"""Factor of E; springs at the feet and at the corners, N m/rad."""
MODES, SD, SIGMA = 6, 0.003, 2.0
"""Modes measured, their relative standard deviation, and that of the logarithm of a spring."""


def _element(p, q):
    length = np.hypot(*(q - p))
    c, s = (q - p) / length
    K, M = np.zeros((6, 6)), np.zeros((6, 6))
    axial, bending = np.ix_([0, 3], [0, 3]), np.ix_([1, 2, 4, 5], [1, 2, 4, 5])
    K[axial] = E * AREA / length * np.array([[1, -1], [-1, 1]])
    K[bending] = E * INERTIA / length**3 * np.array(
        [
            [12, 6 * length, -12, 6 * length],
            [6 * length, 4 * length**2, -6 * length, 2 * length**2],
            [-12, -6 * length, 12, -6 * length],
            [6 * length, 2 * length**2, -6 * length, 4 * length**2],
        ]
    )  # fmt: skip
    M[axial] = RHO * AREA * length / 6 * np.array([[2, 1], [1, 2]])
    M[bending] = RHO * AREA * length / 420 * np.array(
        [
            [156, 22 * length, 54, -13 * length],
            [22 * length, 4 * length**2, 13 * length, -3 * length**2],
            [54, 13 * length, 156, -22 * length],
            [-13 * length, -3 * length**2, -22 * length, 4 * length**2],
        ]
    )  # fmt: skip
    T = np.kron(np.eye(2), np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    return T.T @ K @ T, T.T @ M @ T


def matrices():
    """Return K and M of the steel, and K of each unit spring: feet, then corners."""
    ends = [np.array(p) for p in ((0.0, 0.0), (0.0, HEIGHT), (SPAN, HEIGHT), (SPAN, 0.0))]
    n = 3 * (ELEMENTS + 1)  # nodes: those at a corner belong to the column, and to the beam with its own rotation
    K, M = np.zeros((3 * n, 3 * n)), np.zeros((3 * n, 3 * n))
    for member in range(3):
        line = np.linspace(ends[member], ends[member + 1], ELEMENTS + 1)
        for i in range(ELEMENTS):
            of_K, of_M = _element(line[i], line[i + 1])
            first = 3 * (member * (ELEMENTS + 1) + i)
            K[first : first + 6, first : first + 6] += of_K
            M[first : first + 6, first : first + 6] += of_M
    corners = [(m * (ELEMENTS + 1) - 1, m * (ELEMENTS + 1)) for m in (1, 2)]
    free = [i for i in range(3 * n) if i not in (0, 1, 3 * n - 3, 3 * n - 2)]
    T = np.eye(3 * n)
    for kept, tied in corners:
        for d in (0, 1):
            T[3 * tied + d] = T[3 * kept + d]
            free.remove(3 * tied + d)
    T = T[:, free]
    springs = []
    for nodes in ((0,), (n - 1,), *corners):
        turn = np.zeros(3 * n)
        turn[[3 * node + 2 for node in nodes]] = [1.0, -1.0][: len(nodes)]
        springs.append(np.outer(T.T @ turn, T.T @ turn))
    return T.T @ K @ T, T.T @ M @ T, springs


def problem(n_springs, mean=1.0):
    """Return the problem of a Python function whose first `n_springs` springs are updated, and the truth.

    `mean` is that of the prior of the factor of E.
    """
    K, M, springs = matrices()

    def frequencies(theta):
        values = np.concatenate([theta, TRUTH[len(theta) :]])
        stiffness = values[0] * K + sum(k * of for k, of in zip(values[1:], springs, strict=True))
        return np.sqrt(np.abs(sl.eigh(stiffness, M, eigvals_only=True)[:MODES])) / (2.0 * np.pi)

    measured = frequencies(TRUTH) * (1.0 + SD * np.random.default_rng(0).standard_normal(MODES))
    parameters = [fmu.Parameter("E", 1.0, prior=fmu.Normal(0.05, mean=mean))] + [
        fmu.Parameter(f"k{i}", 3e6, prior=fmu.LogNormal(3e6, SIGMA), unit="N m/rad") for i in range(n_springs)
    ]
    model = fmu.BlackBoxModel(frequencies, len(parameters))
    return fmu.UpdatingProblem(model, fmu.ModalData(measured, sd_hz=SD * measured), parameters)
