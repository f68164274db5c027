"""How the chains of a run moved: where one stood still, and whether momenta explored the energies."""

from __future__ import annotations

import numpy as np

from fmu.analysis.convergence.effective import by_walker
from fmu.types import FloatArray, IntArray


def longest_stands(position: FloatArray, walkers: int = 1) -> IntArray:
    """Return the greatest number of draws in a row that are one and the same, shape (chains, walkers).

    Parameters
    ----------
    position : ndarray, shape (chains, steps · walkers, ndim)
        Step-major.
    walkers : int
    """
    path = by_walker(position, walkers)
    step = np.arange(path.shape[2])
    moved = np.ones(path.shape[:3], dtype=bool)
    moved[:, :, 1:] = np.any(path[:, :, 1:] != path[:, :, :-1], axis=-1)
    arrived = np.maximum.accumulate(np.where(moved, step, 0), axis=2)
    return np.max(step - arrived, axis=2) + 1


def energy_fraction(energy: FloatArray) -> FloatArray:
    """Return the Bayesian fraction of missing information of each chain, shape (chains,).

    E-BFMI = Σ (E_n − E_{n−1})² / Σ (E_n − Ē)² (Betancourt 2016, arXiv:1604.00695): small where the momenta drawn
    afresh change the energy by little of what it varies, so that the chain wanders through the energies. NaN where
    the energy never changes.

    Parameters
    ----------
    energy : ndarray, shape (chains, draws)
    """
    spread = np.sum((energy - energy.mean(axis=1, keepdims=True)) ** 2, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sum(np.diff(energy, axis=1) ** 2, axis=1) / spread
