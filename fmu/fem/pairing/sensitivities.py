"""Frequencies, their gradients, and their second derivatives along one direction per mode.

With λ = (2πf)² and the second derivatives H^λ of an eigenvalue (`fmu.fem.modes.block.Block.eigenvalue_curvature`),
the second derivatives of a frequency along d are H d = (H^λ d/(8π²) − ∂f/∂θ (∂f/∂θ·d))/f. For models given by
matrices they are exact and come from the same eigenproblem as the gradients; for other models they are differences
of gradients. Weighted sums of the shapes' second derivatives (`fmu.fem.modes.block.Block.shape_curvature`) are
available only for models given by matrices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fmu.engines.blas import single_thread
from fmu.fem.modes.block import Block, Solved, shapes_at
from fmu.fem.modes.modal import frequency_gradient, frequency_hz
from fmu.fem.modes.solver import Matrix
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.types import BoolArray, FloatArray, IntArray

_STEP = 1e-4
"""Largest difference step for a parameter, in units of its size. The relative error is about its square."""


class Steps(NamedTuple):
    """Parameter sizes and bounds that limit the steps for differences of gradients.

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
    """A model's frequencies and their derivatives at n parameter vectors.

    Attributes
    ----------
    frequencies : ndarray, shape (n, m), Hz; NaN where a solve failed or λ is clearly negative
    gradient : ndarray, shape (n, m, n_parameters)
    shapes, shape_slopes : ndarray, shapes (n, q, m) and (n, q, m, n_parameters), or None
        Shapes at the q sensors and their derivatives, if requested.
    """

    frequencies: FloatArray
    gradient: FloatArray
    shapes: FloatArray | None = None
    shape_slopes: FloatArray | None = None

    @property
    def prediction(self) -> ModalPrediction:
        """The frequencies and their derivatives as a `ModalPrediction`.

        Shapes are included if they were requested; otherwise the prediction has no sensors.
        """
        n, m = self.frequencies.shape
        shapes = np.empty((n, 0, m)) if self.shapes is None else self.shapes
        return ModalPrediction(self.frequencies, shapes, self.gradient, self.shape_slopes)

    def curvature(self, d: FloatArray, of_shapes: FloatArray | None = None) -> FloatArray:
        """Return H_i d_i, (n, m, n_parameters): each frequency's second derivatives H_i along its direction d_i.

        Parameters
        ----------
        d : ndarray, shape (n, m, n_parameters)
            A direction for each mode at each theta, of any length.
        of_shapes : ndarray, shape (n, q, m, n_parameters), optional
            Weights C for second derivatives of shapes: Σ_sj C_sj ∂²φ_s/∂θ_j∂θ is added for each mode.
        """
        raise NotImplementedError


class SensitivitiesByDifferences(Sensitivities):
    """A model's gradients, with second derivatives by central differences of the gradients.

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

    def curvature(self, d: FloatArray, of_shapes: FloatArray | None = None) -> FloatArray:
        """Return second derivatives along `d` from 2 m gradients per theta; see `Sensitivities.curvature`.

        `of_shapes` is ignored. Near a bound, the midpoint of the difference is moved inwards by up to one step, so
        the relative error may be as large as the step.
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
    """Sensitivities for a batch whose rows were solved by different models or in different batches.

    Parameters
    ----------
    n : int
        Number of rows in the batch.
    parts : sequence of (rows, Sensitivities)
        Batch rows, as a slice or a mask, and their sensitivities. Later parts replace earlier ones.
    """

    def __init__(self, n: int, parts: Sequence[tuple[slice | BoolArray, Sensitivities]]) -> None:
        self._parts = parts
        self.frequencies = np.empty((n, parts[0][1].frequencies.shape[1]))
        self.gradient = np.empty((n, *parts[0][1].gradient.shape[1:]))
        first = parts[0][1]
        if first.shapes is not None and first.shape_slopes is not None:
            self.shapes = np.empty((n, *first.shapes.shape[1:]))
            self.shape_slopes = np.empty((n, *first.shape_slopes.shape[1:]))
        for rows, part in parts:
            self.frequencies[rows], self.gradient[rows] = part.frequencies, part.gradient
            if self.shapes is not None and self.shape_slopes is not None:
                self.shapes[rows], self.shape_slopes[rows] = part.shapes, part.shape_slopes

    def curvature(self, d: FloatArray, of_shapes: FloatArray | None = None) -> FloatArray:
        """Return second derivatives along `d`, plus weighted ones of shapes; see `Sensitivities.curvature`."""
        found = np.empty(d.shape)
        for rows, part in self._parts:
            found[rows] = part.curvature(d[rows], None if of_shapes is None else of_shapes[rows])
        return found


class _Solved(NamedTuple):
    """A block's modes at all theta, and which measured modes they are paired with.

    Attributes
    ----------
    block : Block
    sensors : array or sparse, shape (q, size), or None
        Sensor rows of the block, if shapes were requested.
    lam, phi : ndarray
        From `Block.modes`.
    row, column, rank : ndarray of int, shape (k,)
        For each of k pairs, the indices of theta, of the measured mode, and of the mode in the block.
    """

    block: Block
    sensors: Matrix | None
    lam: FloatArray
    phi: FloatArray
    row: IntArray
    column: IntArray
    rank: IntArray


class StructureSensitivities(Sensitivities):
    """Frequencies of a structure given by matrices, with exact derivatives.

    Parameters
    ----------
    blocks : sequence of Block
    located : tuple
        The result of `fmu.fem.pairing.rules.Pairing.locate` at theta with `gradient`.
    counts : dict of int to int
        How many of the lowest modes in each block may be paired, keyed by block index.
    theta : ndarray, shape (n, n_parameters)
    sensors : sequence of matrices, optional
        Sensor rows of each block, if shapes are requested.
    """

    def __init__(
        self,
        blocks: Sequence[Block],
        located: tuple[IntArray, IntArray, Solved],
        counts: dict[int, int],
        theta: FloatArray,
        sensors: Sequence[Matrix] | None = None,
    ) -> None:
        self._theta = theta
        owner, rank, solved = located
        eigenvalues = np.full(owner.shape, np.nan)
        slopes = np.full((*owner.shape, blocks[0].n_parameters), np.nan)
        if sensors is not None:
            (n, m), q = owner.shape, sensors[0].shape[0]
            self.shapes = np.full((n, q, m), np.nan)
            self.shape_slopes = np.full((n, q, m, blocks[0].n_parameters), np.nan)
        self._parts: list[_Solved] = []
        for b in np.unique(owner[owner >= 0]).tolist():
            block, count = blocks[b], counts[b]
            row, column = np.nonzero(owner == b)
            # one mode more, which shows whether the last one is repeated
            lam, phi = solved.get(b) or block.modes(theta, block.n_required(min(count + 1, block.n_modes), True))
            rows = None if sensors is None else sensors[b]
            part = _Solved(block, rows, lam, phi, row, column, rank[row, column])
            of_block = block.eigenvalue_gradient(theta, lam[:, :count], phi[:, :, :count])
            eigenvalues[row, column], slopes[row, column] = lam[row, part.rank], of_block[row, part.rank]
            if rows is not None and self.shapes is not None and self.shape_slopes is not None:
                seen = block.seen(theta, int(part.rank.max()) + 1, rows, True, (lam, phi))
                self.shapes[row, :, column] = seen.shapes[row, :, part.rank]
                self.shape_slopes[row, :, column] = np.asarray(seen.shape_slopes)[row, :, part.rank]
            self._parts.append(part)
        self.frequencies = frequency_hz(eigenvalues)
        self.gradient = frequency_gradient(self.frequencies, slopes)

    def curvature(self, d: FloatArray, of_shapes: FloatArray | None = None) -> FloatArray:
        """Return second derivatives along `d`, plus weighted ones of shapes; see `Sensitivities.curvature`."""
        found = np.full(d.shape, np.nan)
        with single_thread(), np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            rest = np.zeros(d.shape)
            for part in self._parts:
                (block, _, lam, phi, row, column, rank), slopes = part, None
                along = np.zeros((len(d), int(rank.max()) + 1, d.shape[2]))
                along[row, rank] = d[row, column]
                if of_shapes is not None:
                    of_block, slopes = block.shape_curvature(
                        self._theta, lam, phi, self._weigh_block(part, of_shapes)
                    )
                    rest[row, column] = of_block[row, rank]
                of_block = block.eigenvalue_curvature(self._theta, lam, phi, along, slopes)
                found[row, column] = of_block[row, rank]
            turned = self.gradient * np.einsum("nmk,nmk->nm", self.gradient, d)[..., None]
            return np.asarray((found / (8.0 * np.pi**2) - turned) / self.frequencies[..., None] + rest)

    def _weigh_block(self, part: _Solved, weights: FloatArray) -> FloatArray:
        """Convert weights for sensor shapes to weights for a block's shapes, (n, size, m, n_parameters)."""
        assert part.sensors is not None  # shapes were requested
        (n, q, _, p), count = weights.shape, int(part.rank.max()) + 1
        at_sensors = np.zeros((n, q, count, p))
        at_sensors[part.row, :, part.rank] = weights[part.row, :, part.column]
        return np.asarray(shapes_at(part.sensors.T, at_sensors.reshape(n, q, -1))).reshape(n, -1, count, p)
