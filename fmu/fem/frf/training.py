"""Training of a reduced basis for FRFs, from modes and responses at points in the parameter box.

The basis contains the modes in the frequency band, and the undamped responses to unit forces at all points, at
a few frequencies up to the band's upper end. These responses include the contribution of all higher modes, so no
residual term is missing. Forces are applied at both the drive and the response points. The error of an FRF is
therefore a product of two small errors (Quarteroni, Manzoni & Negri 2016, *Reduced Basis Methods for Partial
Differential Equations*, chapter 3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from fmu.engines.blas import single_thread
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.solver import factorise
from fmu.fem.modes.terms import sum_at
from fmu.fem.reduced.basis import ReducedBlock
from fmu.fem.reduced.points import box_points, mass_orthonormal
from fmu.fem.reduced.space import new_directions
from fmu.progress.phases import phase
from fmu.types import ComplexArray, FloatArray, IntArray

EXACT_LIMIT = 64
"""Block size up to which the basis has all degrees of freedom."""
TOLERANCE = 1.0
"""Largest combined error of all FRFs and lines, where each error is divided by its unit (`Lines.error`). Errors of
this size move a posterior by only a small part of a standard deviation, because most of the error does not
resemble the effect of a parameter (`fmu.fem.frf.confirming`)."""
_BEYOND = 1.3
"""Modes up to this multiple of the band's highest frequency are in the basis."""
_SHIFTS = (0.0, 0.55, 1.02)
"""Frequencies at which responses are computed, in multiples of the band's highest frequency."""
_SOFT = 1e-3
"""Share of the band's lowest squared frequency that makes the stiffness of a free structure definite."""
_OF_TRUNCATION = 0.5
"""Share of the tolerance that truncation may use."""
_PASSES, _MOST_POINTS, _SHOWN, _EVEN = 4, 64, 16, 60
_DEPENDENT = 1e-10
"""Eigenvalue of the Gram matrix of responses, relative to the largest, below which a direction is negligible."""


class Solved(Protocol):
    """Responses of a reduced block at n parameter vectors."""

    def frfs(self, omega: FloatArray) -> ComplexArray:
        """Return the receptances at lines ω in rad/s, shape (n, n_frfs, n_lines)."""
        ...

    def displacements(self, omega: FloatArray) -> ComplexArray:
        """Return displacements per unit force at each point, in basis coordinates, (n, n_points, r, n_lines)."""
        ...


class Bound(Protocol):
    """Responses of a reduced block as a function of the structural parameters."""

    def at(self, theta: FloatArray) -> Solved:
        """Return the frequency responses at theta (n, n_parameters)."""
        ...

    def least_unit(self, point: int, unit: FloatArray) -> FloatArray:
        """Return, for each line, the smallest error unit of all FRFs that involve a point, shape (n_lines,).

        `unit` has shape (n_frfs, n_lines).
        """
        ...


@dataclass(frozen=True, eq=False)
class Lines:
    """Frequency lines at which FRFs are needed.

    Attributes
    ----------
    omega : ndarray, shape (n_lines,), rad/s
    unit : ndarray, shape (n_frfs, n_lines)
        Unit in which receptance errors are measured, such as their standard deviation; infinite for unused lines.
    """

    omega: FloatArray
    unit: FloatArray

    def error(self, one: ComplexArray, other: ComplexArray) -> FloatArray:
        """Return √(Σ |(one − other) / unit|²), summed over all FRFs and lines, shape (n,).

        `one` and `other` are receptances, shape (n, n_frfs, n_lines).
        """
        return np.asarray(np.sqrt(np.sum(np.abs((one - other) / self.unit) ** 2, axis=(1, 2))))


@dataclass(frozen=True, eq=False)
class TrainedFRFs:
    """Result of training; see `fmu.fem.frf.model.FRFModel` for the attributes."""

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
    bind: Callable[[ReducedBlock], Bound],
    tolerance: float = TOLERANCE,
) -> TrainedFRFs:
    """Train a reduced block whose FRFs are accurate in a parameter box.

    Parameters
    ----------
    full : FullBlock
        A block of at most `EXACT_LIMIT` degrees of freedom keeps them all, without training.
    rows : sparse, shape (n_points, full.size)
        Matrix that maps the block's displacements to displacements of the drive and response points.
    lower, upper : ndarray, shape (n_parameters,)
    lines : Lines
    bind : callable
        Returns the responses of a reduced block as a function of theta.
    tolerance : float
        Largest `Lines.error` allowed at a training point.

    Notes
    -----
    At each training point, the receptances are compared with receptances from a basis enlarged by the modes and
    responses at that point. The enlarged basis is kept if the error exceeds the tolerance. Training ends when the
    error is within the tolerance at `_PASSES` successive points, or after `_MOST_POINTS` points. The basis is then
    truncated to the fewest leading directions whose error, compared with the whole basis, is at most half the
    tolerance at the first `_SHOWN` points.
    """
    centre = 0.5 * (lower + upper)
    if full.size <= EXACT_LIMIT:
        return TrainedFRFs(_reduce(full, np.eye(full.size), centre), np.nan, True, 0)
    points = box_points(lower, upper, 64, 0)
    points = np.concatenate([centre[None], points[np.random.default_rng(0).permutation(len(points))]])
    A = _energy(full, centre, lines)
    V, passes, error = np.empty((full.size, 0)), 0, np.inf
    with single_thread(), phase("training", _PASSES + 1) as under_way:
        for theta in points[:_MOST_POINTS]:
            X = np.concatenate([V, new_directions(V, _snapshots(full, rows, theta, lines), A)], axis=1)
            larger = _reduce(full, X, centre)
            if V.shape[1]:
                smaller = larger.truncate(V.shape[1])
                frfs = (bind(one).at(theta[None]).frfs(lines.omega) for one in (smaller, larger))
                error = float(lines.error(*frfs)[0])
            passes = passes + 1 if error <= tolerance else 0
            under_way.advance()
            if passes == _PASSES:
                break
            if error > tolerance:
                V, whole = X, larger
                under_way.expect(1)
        block = _truncate(full, whole, A, centre, points[:_SHOWN], lines, bind, _OF_TRUNCATION * tolerance)
    return TrainedFRFs(block, error, passes == _PASSES, under_way.done)


def enlarge(
    full: FullBlock, rows: sp.csr_array, block: ReducedBlock, theta: FloatArray, lines: Lines
) -> ReducedBlock:
    """Return a reduced block whose basis is enlarged by the modes and responses at theta (n_parameters,)."""
    A, V = _energy(full, theta, lines), block.basis
    V = V / np.sqrt(np.sum(V * (A @ V), axis=0))
    V = np.linalg.solve(np.linalg.cholesky(V.T @ (A @ V)), V.T).T
    new = new_directions(V, _snapshots(full, rows, theta, lines), A)
    return _reduce(full, np.concatenate([V, new], axis=1), theta)


def _reduce(full: FullBlock, V: FloatArray, centre: FloatArray) -> ReducedBlock:
    return ReducedBlock(full, mass_orthonormal(full, V, centre), V.shape[1])


def _energy(full: FullBlock, centre: FloatArray, lines: Lines) -> sp.csr_array:
    """Return K + s M at the parameters `centre`.

    The shift s makes it definite, and is small compared with ω² in the band.
    """
    K, M = sum_at(full.K_terms, centre), sum_at(full.M_terms, centre)
    return sp.csr_array(K + (_SOFT * float(np.min(lines.omega)) ** 2) * M)


def _snapshots(full: FullBlock, rows: sp.csr_array, theta: FloatArray, lines: Lines) -> FloatArray:
    """Return modes and undamped responses at theta (n_parameters,), as columns (size, m).

    The modes are all modes up to `_BEYOND` times the band's highest frequency. The responses are the displacements
    under unit forces at all points, at the frequencies in `_SHIFTS`.
    """
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


def _truncate(
    full: FullBlock,
    whole: ReducedBlock,
    A: sp.csr_array,
    centre: FloatArray,
    points: FloatArray,
    lines: Lines,
    bind: Callable[[ReducedBlock], Bound],
    tolerance: float,
) -> ReducedBlock:
    """Return the block reduced to the fewest basis directions that meet the tolerance at all `points`.

    If no smaller number of directions meets the tolerance, all but negligible directions are kept.

    The directions come from a proper orthogonal decomposition of the responses at `points`, in the energy norm of
    A. Each response is divided by the square root of the smallest error unit of its point (`Bound.least_unit`),
    because an FRF error is a product of two response errors.
    """
    basis = whole.basis
    L = np.linalg.cholesky(basis.T @ (A @ basis))
    of_whole = bind(whole)
    gram = np.zeros_like(L)
    for theta in points:
        some = _some_lines(whole, theta, lines)
        u = of_whole.at(theta[None]).displacements(lines.omega[some])[0]  # (n_points, r, n_lines)
        for q, each in enumerate(u):
            weighted = (L.T @ each) / np.sqrt(of_whole.least_unit(q, lines.unit[:, some]))
            gram += weighted.real @ weighted.real.T + weighted.imag @ weighted.imag.T
    values, Y = np.linalg.eigh(gram)
    directions = np.linalg.solve(L.T, Y[:, ::-1][:, values[::-1] > _DEPENDENT * values[-1]])
    ordered = _reduce(full, basis @ directions, centre)
    exact = [of_whole.at(theta[None]).frfs(lines.omega) for theta in points]

    def error_of(block: ReducedBlock) -> float:
        of = bind(block)
        pairs = zip(points, exact, strict=True)
        return max(float(lines.error(of.at(theta[None]).frfs(lines.omega), one)[0]) for theta, one in pairs)

    fewest, most, best = 1, ordered.size, ordered
    while fewest < most:
        r = (fewest + most) // 2
        block = ordered.truncate(r)
        if error_of(block) <= tolerance:
            most, best = r, block
        else:
            fewest = r + 1
    # projected again, so that the terms have the same last bits as in a block that is restored from the cache
    return ReducedBlock(full, best.basis, best.size)


def _some_lines(block: ReducedBlock, theta: FloatArray, lines: Lines) -> IntArray:
    """Return the indices (m,) of evenly spaced lines, and of the lines nearest to the resonances at theta."""
    even = np.linspace(0, len(lines.omega) - 1, min(_EVEN, len(lines.omega))).astype(np.int64)
    lam = block.eigenvalues(theta[None], min(block.size, 2 * _EVEN))[0]
    omega = np.sqrt(lam[(lam > lines.omega[0] ** 2) & (lam < lines.omega[-1] ** 2)])
    nearest = np.array([np.argmin(np.abs(lines.omega - one)) for one in omega], dtype=np.int64)
    return np.unique(np.concatenate([even, nearest]))
