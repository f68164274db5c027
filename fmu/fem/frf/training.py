"""Training of a basis for frequency response functions: modes and responses at points of the parameters' box.

The basis contains the modes of the band, and undamped responses to unit forces at all points, at some frequencies
of the band. The latter carry the part of all higher modes, so that no residual term is missing. As the responses
to the drives and to the points of response are both in the basis, the error of a response function is a product of
two small errors (Quarteroni, Manzoni & Negri 2016, *Reduced Basis Methods for Partial Differential Equations*,
chapter 3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import single_thread
from fmu.fem.modes.solver import factorise
from fmu.fem.modes.terms import sum_at
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.points import box_points, mass_orthonormal
from fmu.progress.phases import phase
from fmu.types import ComplexArray, FloatArray

EXACT_LIMIT = 64
"""Size up to which the basis has all degrees of freedom."""
TOLERANCE = 0.1
"""Largest error of all lines together, in units of their errors."""
_BEYOND = 1.3
"""Modes up to this multiple of the highest frequency of the band are in the basis."""
_SHIFTS = (0.0, 0.55, 1.02)
"""Frequencies of the responses, in multiples of the highest frequency of the band."""
_SOFT = 1e-3
"""Share of the lowest squared frequency of the band that makes the stiffness of a free structure definite."""
_PASSES, _MOST_POINTS, _SHOWN = 4, 64, 24
_DEPENDENT = 1e-10
"""Singular value, relative to the largest, below which a direction adds nothing."""

Frfs = Callable[[FloatArray, FloatArray], ComplexArray]
"""A function from theta (n, p) and ω (n_lines,) to receptances (n, n_frfs, n_lines)."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines at which response functions are needed.

    Attributes
    ----------
    omega : ndarray, shape (n_lines,), rad/s
    unit : ndarray, shape (n_frfs, n_lines)
        Unit of the errors of the receptances, such as their standard deviation; infinite where a line is not used.
    """

    omega: FloatArray
    unit: FloatArray

    def error(self, one: ComplexArray, other: ComplexArray) -> FloatArray:
        """Return the root of the sum of the squared differences of all lines in their units, shape (n,)."""
        return np.asarray(np.sqrt(np.sum(np.abs((one - other) / self.unit) ** 2, axis=(1, 2))))


@dataclass(frozen=True, eq=False)
class TrainedFRFs:
    """The outcome of training; see `fmu.fem.frf.model.FRFModel` for the attributes."""

    block: ReducedBlock
    error: float
    is_confirmed: bool
    n_solves: int


def train(
    full: FullBlock,
    rows: sp.csr_array,
    lower: FloatArray,
    upper: FloatArray,
    lines: Lines,
    bind: Callable[[ReducedBlock], Frfs],
    tolerance: float = TOLERANCE,
) -> TrainedFRFs:
    """Return a reduced block whose response functions are accurate in a box.

    Parameters
    ----------
    full : FullBlock
    rows : sparse, shape (n_points, full.size)
        The drive and response points.
    lower, upper : ndarray, shape (n_parameters,)
    lines : Lines
    bind : callable
        Returns the receptances of a reduced block as a function.
    tolerance : float

    Notes
    -----
    At each point, the receptances on the basis are compared with those on the basis enlarged by the modes and
    responses of that point. Training ends when `_PASSES` points in succession agree, or after `_MOST_POINTS`. Then
    the basis is truncated to the leading directions, as long as the errors at the points and at further ones
    allow.
    """
    centre = 0.5 * (lower + upper)
    if full.size <= EXACT_LIMIT:
        basis = mass_orthonormal(full, np.eye(full.size), centre)
        return TrainedFRFs(ReducedBlock(full, basis, full.size), np.nan, True, 0)
    points = box_points(lower, upper, 64, 0)
    points = np.concatenate([centre[None], points[np.random.default_rng(0).permutation(len(points))]])
    snapshots: list[FloatArray] = []
    passes, error = 0, np.inf
    with single_thread(), phase("training", _PASSES + 1) as under_way:
        for theta in points[:_MOST_POINTS]:
            X = _snapshots(full, rows, theta, lines)
            if snapshots:
                block, larger = (_reduce(full, part, centre) for part in (snapshots, [*snapshots, X]))
                error = float(lines.error(*(bind(one)(theta[None], lines.omega) for one in (block, larger)))[0])
            passes = passes + 1 if error <= tolerance else 0
            under_way.advance()
            if passes == _PASSES:
                break
            if error > tolerance:
                snapshots.append(X)
                under_way.expect(1)
        block = _truncate(full, snapshots, centre, points[:_SHOWN], lines, bind, 0.5 * tolerance)
    return TrainedFRFs(block, error, passes == _PASSES, under_way.done)


def _snapshots(full: FullBlock, rows: sp.csr_array, theta: FloatArray, lines: Lines) -> FloatArray:
    """Return modes of the band and undamped responses at theta (n_parameters,), shape (size, m)."""
    top, low = float(np.max(lines.omega)), float(np.min(lines.omega))
    count = 8
    while True:
        count = min(count, full.n_modes)
        lam, phi = full.modes(theta[None], count)
        if count == full.n_modes or lam[0, -1] > (_BEYOND * top) ** 2:
            break
        count *= 2
    found = [phi[0][:, lam[0] <= (_BEYOND * top) ** 2]]
    K, M = sum_at(full.K_terms, theta), sum_at(full.M_terms, theta)
    loads = rows.T.toarray()
    for share in _SHIFTS:
        shift = (share * top) ** 2 if share else -_SOFT * low**2
        factor = factorise(sp.csr_array(K - shift * M), is_definite=not share)
        found.append(np.asarray(factor.solve(loads)))
    return np.concatenate(found, axis=1)


def _directions(full: FullBlock, snapshots: list[FloatArray], centre: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return directions of the snapshots, orthonormal in K + s M at the centre, and their sizes, descending."""
    X = np.concatenate(snapshots, axis=1)
    K, M = sum_at(full.K_terms, centre), sum_at(full.M_terms, centre)
    A = K + (np.sum(X * (K @ X)) / np.sum(X * (M @ X))) * M * _SOFT
    X = X / np.sqrt(np.sum(X * (A @ X), axis=0))
    gram = X.T @ (A @ X)
    size, U = np.linalg.eigh(0.5 * (gram + gram.T))
    kept = size > _DEPENDENT * size[-1]
    X, sizes = (X @ (U[:, kept] / np.sqrt(size[kept])))[:, ::-1], size[kept][::-1]
    return X, sizes


def _reduce(full: FullBlock, snapshots: list[FloatArray], centre: FloatArray) -> ReducedBlock:
    X, _ = _directions(full, snapshots, centre)
    return ReducedBlock(full, mass_orthonormal(full, X, centre), X.shape[1])


def _truncate(
    full: FullBlock,
    snapshots: list[FloatArray],
    centre: FloatArray,
    points: FloatArray,
    lines: Lines,
    bind: Callable[[ReducedBlock], Frfs],
    tolerance: float,
) -> ReducedBlock:
    """Return the block on the fewest leading directions with errors within the tolerance at the points."""
    X, _ = _directions(full, snapshots, centre)
    whole = ReducedBlock(full, mass_orthonormal(full, X, centre), X.shape[1])
    exact = bind(whole)(points, lines.omega)
    fewest, most = 1, X.shape[1]
    best = whole
    while fewest < most:
        r = (fewest + most) // 2
        block = ReducedBlock(full, mass_orthonormal(full, X[:, :r], centre), r)
        if np.max(lines.error(bind(block)(points, lines.omega), exact)) <= tolerance:
            most, best = r, block
        else:
            fewest = r + 1
    return best
