"""Frequencies, gradients, and second derivatives along one direction per mode, from the same eigenproblem.

With λ = (2πf)² and the second derivatives H^λ of an eigenvalue (`fmu.fem.modes.block.Block.eigenvalue_curvature`),
the second derivatives of a frequency along d are H d = (H^λ d/(8π²) − ∂f/∂θ (∂f/∂θ·d))/f. They are exact for
matrices; for other models exact gradients are differenced.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fmu.fem.modes.block import Block
from fmu.fem.modes.modal import BlockModel, frequency_gradient, frequency_hz, single_thread
from fmu.fem.pairing.rules import PairedSolve
from fmu.types import BoolArray, FloatArray, IntArray

_STEP = 1e-4
"""Longest step of a difference in a parameter, in units of its size. The error is of the order of its square."""


class Steps(NamedTuple):
    """Sizes and limits of the steps by which exact gradients are differenced.

    Attributes
    ----------
    size : ndarray, shape (n, n_parameters)
        Size of each parameter at each theta.
    bounds : ndarray, shape (2, n_parameters)
        Lower and upper bounds, beyond which the model is not solved.
    """

    size: FloatArray
    bounds: FloatArray


class Sensitivities:
    """Frequencies of a model with their derivatives, at n parameter vectors.

    Attributes
    ----------
    frequencies : ndarray, shape (n, m), Hz; NaN where a solve failed
    gradient : ndarray, shape (n, m, n_parameters)
    """

    frequencies: FloatArray
    gradient: FloatArray

    def curvature(self, d: FloatArray) -> FloatArray:
        """Return H_i d_i for the second derivatives H_i of each frequency, shape (n, m, n_parameters).

        Parameters
        ----------
        d : ndarray, shape (n, m, n_parameters)
            A direction for each mode at each theta, of any length.
        """
        raise NotImplementedError


class SensitivitiesByDifferences(Sensitivities):
    """Exact gradients of any model, and central differences of them.

    Parameters
    ----------
    solve : callable
        Maps theta (n, n_parameters) to frequencies and their gradients.
    theta : ndarray, shape (n, n_parameters)
    steps : Steps
    """

    def __init__(
        self, solve: Callable[[FloatArray], tuple[FloatArray, FloatArray]], theta: FloatArray, steps: Steps
    ) -> None:
        self._solve, self._theta, self._steps = solve, theta, steps
        self.frequencies, self.gradient = solve(theta)

    def curvature(self, d: FloatArray) -> FloatArray:
        """Return H_i d_i by 2 m gradients per theta; see `Sensitivities`.

        At a bound the middle of the difference is moved inwards by a step, and the relative error is of its order.
        """
        n, m, p = d.shape
        lower, upper = self._steps.bounds
        longest = np.max(np.abs(d) / self._steps.size[:, None], axis=2)
        step = np.where(longest > 0.0, _STEP / np.where(longest > 0.0, longest, 1.0), 0.0)[..., None]
        reach = np.abs(step * d)
        middle = np.maximum(np.minimum(self._theta[:, None], upper - reach), lower + reach)
        moved = [np.clip(middle + sign * step * d, lower, upper) for sign in (1.0, -1.0)]
        J = self._solve(np.concatenate(moved, axis=1).reshape(2 * n * m, p))[1].reshape(n, 2, m, m, p)
        own = J[:, :, np.arange(m), np.arange(m)]
        return np.asarray((own[:, 0] - own[:, 1]) / np.where(step > 0.0, 2.0 * step, 1.0))


class JoinedSensitivities(Sensitivities):
    """Sensitivities of a batch, of which other models or other batches have solved the rows.

    Parameters
    ----------
    n : int
    parts : sequence of (rows, Sensitivities)
        Rows of the batch, as a slice or a mask, and what was solved for them. Later parts replace earlier ones.
    """

    def __init__(self, n: int, parts: Sequence[tuple[slice | BoolArray, Sensitivities]]) -> None:
        self._parts = parts
        self.frequencies = np.empty((n, parts[0][1].frequencies.shape[1]))
        self.gradient = np.empty((n, *parts[0][1].gradient.shape[1:]))
        for rows, part in parts:
            self.frequencies[rows], self.gradient[rows] = part.frequencies, part.gradient

    def curvature(self, d: FloatArray) -> FloatArray:
        """Return H_i d_i; see `Sensitivities`."""
        found = np.empty(d.shape)
        for rows, part in self._parts:
            found[rows] = part.curvature(d[rows])
        return found


class _Solved(NamedTuple):
    """Modes of a block at all theta, and which of them are paired with which measured modes.

    Attributes
    ----------
    block : Block
    lam, phi : ndarray
        From `Block.modes`.
    n_pairable : int
        Number of the lowest modes that may be paired.
    row, column, rank : ndarray of int, shape (k,)
        Index of theta, of the measured mode, and of the mode of the block.
    """

    block: Block
    lam: FloatArray
    phi: FloatArray
    n_pairable: int
    row: IntArray
    column: IntArray
    rank: IntArray


class StructureSensitivities(Sensitivities):
    """Frequencies of a structure given by matrices, with exact derivatives.

    Parameters
    ----------
    model : BlockModel
    solve : PairedSolve
        The pairing bound to the model.
    counts : dict of int to int
        Number of the lowest modes of each block that may be paired.
    theta : ndarray, shape (n, n_parameters)
    """

    def __init__(self, model: BlockModel, solve: PairedSolve, counts: dict[int, int], theta: FloatArray) -> None:
        self._theta = theta
        owner, rank, solved = solve.locate(theta, True)
        eigenvalues = np.full(owner.shape, np.nan)
        slopes = np.full((*owner.shape, model.n_parameters), np.nan)
        self._parts: list[_Solved] = []
        for b in np.unique(owner[owner >= 0]).tolist():
            block, count = model.blocks[b], counts[b]
            row, column = np.nonzero(owner == b)
            # one mode more, which shows whether the last one is repeated
            lam, phi = solved.get(b) or block.modes(theta, block.n_required(min(count + 1, block.n_modes), True))
            part = _Solved(block, lam, phi, count, row, column, rank[row, column])
            of_block = block.eigenvalue_gradient(theta, lam[:, :count], phi[:, :, :count])
            eigenvalues[row, column], slopes[row, column] = lam[row, part.rank], of_block[row, part.rank]
            self._parts.append(part)
        self.frequencies = frequency_hz(eigenvalues)
        self.gradient = frequency_gradient(self.frequencies, slopes)

    def curvature(self, d: FloatArray) -> FloatArray:
        """Return H_i d_i; see `Sensitivities`."""
        found = np.full(d.shape, np.nan)
        with single_thread(), np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for block, lam, phi, count, row, column, rank in self._parts:
                along = np.zeros((len(d), count, d.shape[2]))
                along[row, rank] = d[row, column]
                of_block = block.eigenvalue_curvature(self._theta, lam, phi, along)
                found[row, column] = of_block[row, rank]
            turned = self.gradient * np.einsum("nmk,nmk->nm", self.gradient, d)[..., None]
            return np.asarray((found / (8.0 * np.pi**2) - turned) / self.frequencies[..., None])
