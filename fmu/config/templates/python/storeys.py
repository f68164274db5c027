"""A three-storey building as a Python function, which could also call a finite-element program."""

import numpy as np
from numpy.typing import NDArray

MASSES = np.array([2.1e4, 2.1e4, 1.6e4])
"""Masses of the floors, kg."""
STIFFNESS = np.array([2.4e7, 1.8e7, 1.8e7])
"""Initial stiffnesses of the storeys, N/m."""


def modes(theta: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the modes at theta, shape (2,): stiffness factors for the lowest storey and for the upper storeys.

    The function may also return just an array of frequencies in Hz, shape (n_modes,), with any number of modes.
    """
    k1, k2, k3 = STIFFNESS * [theta[0], theta[1], theta[1]]
    K = np.array([[k1 + k2, -k2, 0.0], [-k2, k2 + k3, -k3], [0.0, -k3, k3]])
    root = np.sqrt(MASSES)
    squared, vectors = np.linalg.eigh(K / np.outer(root, root))
    shapes = vectors / root[:, None]
    return {
        "frequencies": np.sqrt(squared) / (2.0 * np.pi),
        # optional: shapes at the sensors of the measurement, (n_sensors, n_modes), used to pair the modes
        "shapes": shapes[[0, 2]],
        # optional: the derivatives of the frequencies, (n_modes, n_parameters); by default central differences
        "gradient": _gradient(squared, shapes),
    }


def _gradient(squared: NDArray[np.float64], shapes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ∂f/∂θ = φᵀ ∂K/∂θ φ / (8π² f) (Fox & Kapoor 1968), computed from the springs' elongations."""
    stretched = np.diff(shapes, axis=0, prepend=0.0) ** 2 * STIFFNESS[:, None]
    slopes = np.stack([stretched[0], stretched[1] + stretched[2]], axis=1)
    frequencies = np.sqrt(squared) / (2.0 * np.pi)
    gradient: NDArray[np.float64] = slopes / (8.0 * np.pi**2 * frequencies[:, None])
    return gradient
