"""A structure whose computed modes are paired with the measured ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from fmu.fem.modal import frequency_gradient, frequency_hz
from fmu.fem.model import BlockModel
from fmu.fem.pairing import IndexPairing, PairedModes, Pairing, constant_rank, reference_modes
from fmu.fem.separable import SeparableModel

FloatArray = NDArray[np.float64]

PAIRINGS = ("shape", "index")


class PairedStructure:
    """The frequencies of a SeparableModel's modes that answer to the measured ones.

    Parameters
    ----------
    model : SeparableModel
    pairing : {"shape", "index"}
        ``"shape"``: one-to-one assignment by MAC, at all translations, with the modes of the model at
        `reference` that the sensors can see. ``"index"``: by `numbers` in the sorted spectrum.
    numbers : tuple of int
        Number (from 1) of each measured mode.
    sensors : tuple of (node, direction)
        What was measured; all translations if empty.
    reference : ndarray, shape (n_parameters,)
        The model before updating.
    lower, upper : ndarray, shape (n_parameters,)
        Box over which the assignment by shape is checked; where it is constant it becomes a rank in a block.

    Raises
    ------
    ValueError
        For an unknown pairing, a sensor off the model, or modes that the sensors cannot see.
    """

    def __init__(
        self,
        model: SeparableModel,
        *,
        pairing: str,
        numbers: tuple[int, ...],
        sensors: tuple[tuple[Any, str], ...],
        reference: FloatArray,
        lower: FloatArray,
        upper: FloatArray,
    ) -> None:
        if pairing not in PAIRINGS:
            raise ValueError(f"pairing: must be one of {PAIRINGS} (got {pairing!r})")
        self.structure = model
        self.n_parameters = model.n_parameters
        self.n_modes = len(numbers)
        self.full = BlockModel.full(model)
        self.pairing: Pairing
        if pairing == "index":
            self.pairing = IndexPairing(numbers)
        else:
            dofs = model.translations
            seen = np.array([model.dof(*sensor) for sensor in sensors]) if sensors else dofs
            by_shape = reference_modes(self.full, reference, seen, dofs, self.n_modes)
            points = box_points(lower, upper, 32)
            self.pairing = constant_rank(by_shape, self.full, points) or by_shape
        self._solve_full = self.pairing.bind(self.full)

    def __repr__(self) -> str:
        return f"PairedStructure({self.structure!r}, {type(self.pairing).__name__})"

    def modes(self, theta: FloatArray, gradient: bool = False) -> PairedModes:
        """Return the paired modes of the full model at theta (n, n_parameters)."""
        return self._solve_full(theta, gradient)

    def frequencies(self, theta: FloatArray) -> FloatArray:
        """Return frequencies in Hz, shape (n, n_modes); NaN where a solve failed."""
        return frequency_hz(self.modes(theta).eigenvalues)

    def frequencies_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return frequencies (n, n_modes) and their gradients (n, n_modes, n_parameters), exact."""
        modes = self.modes(theta, gradient=True)
        assert modes.gradient is not None  # narrowed for the type checker: asked for above
        frequencies = frequency_hz(modes.eigenvalues)
        return frequencies, frequency_gradient(frequencies, modes.gradient)


def box_points(lower: FloatArray, upper: FloatArray, n: int, seed: int = 0) -> FloatArray:
    """Return points that cover a box: `n` of a scrambled Sobol sequence, and corners.

    All corners up to 2⁶ of them, as many at random beyond.
    """
    ndim = len(lower)
    inside = qmc.Sobol(ndim, seed=seed).random(n)
    if ndim <= 6:
        corners = np.array(np.meshgrid(*[[0.0, 1.0]] * ndim, indexing="ij")).reshape(ndim, -1).T
    else:
        corners = np.random.default_rng(seed).integers(0, 2, size=(64, ndim)).astype(float)
    return lower + (upper - lower) * np.concatenate([inside, corners])
