"""Check that rounding errors in the matrices are smaller than the measurement errors.

An entry of K is rounded to one part in 10¹⁶. Some stiff parts hardly strain, such as a rigid link, or a spring of
1e16 N/m beside springs of 1e5 N/m. Their strain energy in a mode shape φ, φᵀKφ = Σ K_ij φ_i φ_j, is a small
difference of large numbers. If rounding is independent from entry to entry, the error in the eigenvalue λ is

    δλ ≈ u √(Σ_ij (|K|_ij φ_i φ_j)²) + λ u √(Σ_ij (|M|_ij φ_i φ_j)²),      |K| = Σ_k |c_k| |K_k|,

with u = 1.1e-16 and mass-normalised φ. The terms K_k and their coefficients c_k give K = Σ_k c_k K_k, and |M| is
the corresponding sum for M. This is first-order perturbation theory (Stewart & Sun 1990, *Matrix Perturbation
Theory*, section VI.2). The check multiplies δλ by 4, because solvers and sums round several times. A reduced model
adds rounding relative to its own highest eigenvalue.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from fmu.arguments import ArgumentError
from fmu.fem.modes.modal import RIGID, ModalSolution
from fmu.fem.modes.terms import Term, coefficients
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.paired_structure import PairedStructure, structure_of
from fmu.fem.reduced.reduced_structure import reduced_in
from fmu.numbers import share, significant
from fmu.posterior.density import Posterior
from fmu.types import FloatArray

UNIT = 2.0**-53
WARN, REFUSE = 0.05, 1.0
"""Expected rounding error of a frequency, in standard deviations of its measurement, above which fmu warns, and
above which it raises ValueError."""
# Solvers, and the sums that form an entry, round several times: with this factor the expected error is 2 to 30
# times the error found in extended precision.
_ROUNDINGS = 4.0
# Strain energy of a term in a mode shape, relative to the sum of the magnitudes that cancel. Below the first value
# the shape does not strain the term, apart from rounding, also in matrices exported with ten digits. The second
# value is for shapes with λ exactly zero, whose energy in all terms is rounding error of 16 digits.
_LOST, _LOST_EXACTLY = 1e-6, 1e-9
_RIGID_AT_MOST = 7
# The solution at the last start of each model, which is needed both before and after training.
_SOLVED: WeakKeyDictionary[PairedStructure, tuple[FloatArray, FloatArray, ModalSolution]] = WeakKeyDictionary()


class RoundingWarning(UserWarning):
    """Warns that rounding errors in the matrices are not negligible compared with the measurement errors."""


@dataclass(frozen=True, eq=False)
class Rounding:
    """Expected rounding errors of the frequencies at the starting point.

    Attributes
    ----------
    relative : ndarray, shape (n_modes,)
        Expected relative error of each frequency; infinite for a frequency of 0.
    of_sd : ndarray, shape (n_modes,)
        Expected error of each frequency in measurement standard deviations; 0 for modes that are not used, and if
        frequencies have no error model.
    mode : str
        Label of the measured mode with the largest `of_sd`.
    where : str
        The degree of freedom that contributes most to that mode's error.
    stiffness : float
        Diagonal entry of K at that degree of freedom, SI units.
    """

    relative: FloatArray
    of_sd: FloatArray
    mode: str
    where: str
    stiffness: float

    def sentence(self) -> str:
        """Return the message that states the largest error, its cause and a remedy."""
        k = int(np.argmax(self.of_sd))
        of_sd, relative = significant(100 * self.of_sd[k], 2), significant(self.relative[k], 1)
        return (
            f"rounding: the frequency of mode {self.mode} should be good to {share(WARN)} of the standard "
            f"deviation of its measurement (got {of_sd} %, {relative} of the frequency, as the stiffness at "
            f"{self.where} is {significant(self.stiffness)}); where a part is meant to be rigid, make it 1e3 to "
            "1e6 times as stiff as its neighbours, or tie its ends"
        )


def rounding(problem: Posterior) -> Rounding | None:
    """Return the frequencies' rounding errors at the problem's starting point.

    Return None if the model has no matrices or describes several tests, or if the likelihood does not use computed
    modes.

    Raises
    ------
    ValueError
        If the solve at the starting point fails, a soft part next to a stiff part loses its stiffness in rounding,
        or K is negative for some motion.
    """
    model, likelihood = structure_of(problem.model), problem.likelihood
    if model is None or not likelihood.of_modes:
        return None
    theta = problem.model_parameters(problem.start[None])[0]
    if model not in _SOLVED or not np.array_equal(_SOLVED[model][0], theta):
        shapes = model.shapes(theta)
        modes = model.modes(theta[None])
        if not (np.all(np.isfinite(shapes)) and np.all(np.isfinite(modes.eigenvalues))):
            raise _without_density(problem)
        _require_no_term_lost(problem, model, theta, max(float(modes.eigenvalues.max()), 0.0))
        _SOLVED[model] = theta, shapes, modes
    _, shapes, modes = _SOLVED[model]
    lam = np.maximum(modes.eigenvalues[0], 0.0)
    K, M = (_sizes(terms, theta) for terms in (model.structure.K_terms, model.structure.M_terms))
    stiff, heavy = _energies(K, shapes), _energies(M, shapes)
    error = (
        np.sqrt(stiff.sum(axis=0))
        + lam * np.sqrt(heavy.sum(axis=0))
        + _highest_of_reduced(problem.model, modes.block[0], theta)
    )
    frequencies = np.sqrt(lam) / (2.0 * np.pi)
    off = np.sqrt(lam + _ROUNDINGS * UNIT * error) / (2.0 * np.pi) - frequencies
    relative = np.divide(off, frequencies, out=np.full_like(off, np.inf), where=frequencies > 0.0)
    of_sd = likelihood.in_standard_deviations(frequencies, off, problem.start)
    worst = int(np.argmax(of_sd))
    dof = int(np.argmax(stiff[:, worst]))
    node, direction = model.structure.dofs[dof]
    where = f"node {node} {direction}"
    return Rounding(relative, of_sd, str(problem.data.labels[worst]), where, float(K.diagonal()[dof]))


def bounded_rounding(problem: Posterior) -> Rounding | None:
    """Return the result of `rounding`.

    Raise ValueError if an expected error exceeds the measurement error, and in the cases that `rounding` lists.
    """
    found = rounding(problem)
    if found is not None and np.max(found.of_sd) > REFUSE:
        raise ValueError(found.sentence())
    return found


def require_digits(problem: Posterior) -> None:
    """Raise ValueError if rounding errors exceed the measurement errors; warn if they are not negligible.

    Raise ValueError also if the model has matrices and the log-probability at the starting point is not finite,
    and in the cases that `rounding` lists. For a reduced model, the warning is omitted if it was already given for
    the full model.

    Warns
    -----
    RoundingWarning
        If an expected rounding error exceeds 5 % of the measurement standard deviation.
    """
    if any(map(structure_of, problem.model.parts)) and not np.isfinite(problem.log_prob(problem.start)):
        raise _without_density(problem)
    found = bounded_rounding(problem)
    if found is None or np.max(found.of_sd) <= WARN:
        return
    model = problem.model
    if model.truth is not model and np.max(rounding(problem.with_model(model.truth)).of_sd) > WARN:  # type: ignore[union-attr]
        return  # the warning was already given for the full model
    warnings.warn(found.sentence(), RoundingWarning, skip_file_prefixes=(f"{Path(__file__).parents[1]}{os.sep}",))


def _without_density(problem: Posterior) -> ArgumentError:
    """Return the error that explains why the log-probability at the starting point is not finite."""
    point = problem.layout.of_model(problem.start[None])[0]
    why = problem.likelihood.why_not_finite(point) or "the modes at the start cannot be computed"
    rule = "must have a finite log-probability"
    return ArgumentError("start", rule, f"-inf: {why}", "; correct the model, or the start")


def _require_no_term_lost(problem: Posterior, model: PairedStructure, theta: FloatArray, top: float) -> None:
    """Raise ValueError if an apparent rigid-body mode strains a stiffness term, or K is negative for some motion.

    A mode whose λ is tiny relative to `top`, the highest λ of the paired modes, is treated as a rigid-body mode,
    and pairing ignores such a mode. This treatment is wrong if a term of K has strain energy in the mode: rounding
    of the sum has then removed most of the term.
    """
    structure = model.structure
    counts = model.rule.counts(model.blocks)  # the number of modes solved for in each block
    for b, block in enumerate(model.blocks):
        lam, shapes = block.modes(theta[None], max(counts.get(b, 0), min(_RIGID_AT_MOST, block.n_modes)))
        rigid = lam[0] <= RIGID * top
        N = np.zeros((structure.n_dof, int(np.sum(rigid))))
        N[block.dofs] = shapes[0][:, rigid]
        if np.any(lam[0] < -RIGID * top):
            raise ValueError(_negative(problem, model, theta, N[:, 0]))
        allowed = np.where(lam[0, rigid] == 0.0, _LOST_EXACTLY, _LOST)
        for term in structure.K_terms if N.shape[1] else ():
            energy = N * (term.matrix @ N)
            lost = energy.sum(axis=0) > allowed * np.sum(np.abs(N) * (abs(term.matrix) @ np.abs(N)), axis=0)
            if lost.any():
                energy = energy[:, lost]
                raise ValueError(_lost(model, theta, int(np.argmax(energy.sum(axis=1)))))


def _lost(model: PairedStructure, theta: FloatArray, dof: int) -> str:
    """Return the error message about a soft part whose stiffness at `dof` is lost in rounding."""
    node, direction = model.structure.dofs[dof]
    return (
        "rounding: stiffnesses of neighbours must differ by less than 1e14, and no mode may be below 3e-5 of the "
        f"measured frequencies (got {significant(model.structure.K(theta).diagonal()[dof])} at node {node} "
        f"{direction}, where a soft part is lost in rounding); to make a part rigid, make it 1e3 to 1e6 times as "
        "stiff as its neighbours, or tie its ends"
    )


def _negative(problem: Posterior, model: PairedStructure, theta: FloatArray, motion: FloatArray) -> str:
    """Return the error message about the term, or the rounding, that makes K negative for `motion` (n_dof,)."""
    terms = model.structure.K_terms
    weights = coefficients(terms, theta[None])[0]
    energy = [c * (motion @ (t.matrix @ motion)) for c, t in zip(weights, terms, strict=True)]
    k = int(np.argmin(energy))
    worst, sizes = terms[k], np.abs(weights[k]) * np.abs(motion) * (abs(terms[k].matrix) @ np.abs(motion))
    if energy[k] >= -_LOST_EXACTLY * sizes.sum():
        return _lost(model, theta, int(np.argmax(sizes)))
    names = [p.name for p, power in zip(problem.layout.structural, worst.powers, strict=False) if power]
    of = f"the term of {' and '.join(names)}" if names else "the term that no parameter changes"
    node, direction = model.structure.dofs[int(np.argmax(np.abs(motion)))]
    return (
        f"stiffness: K must not be negative for any motion; at the start it is for one of node {node} "
        f"{direction}, by {of}; correct its matrix, or the start and the bounds"
    )


def _sizes(terms: Sequence[Term], theta: FloatArray) -> Any:
    weights = np.abs(coefficients(terms, theta[None])[0])
    return sp.csr_array(sum(weight * abs(term.matrix) for weight, term in zip(weights, terms, strict=True)))


def _energies(sizes: Any, shapes: FloatArray) -> FloatArray:
    """Return Σ_j (A_ij φ_i φ_j)² for every degree of freedom i and mode shape φ, shape (n_dof, n_modes).

    A is the sparse matrix `sizes` of absolute entries.
    """
    squares = sp.csr_array((sizes.data**2, sizes.indices, sizes.indptr), shape=sizes.shape)
    return np.asarray(shapes**2 * (squares @ shapes**2))


def _highest_of_reduced(model: ModalModel, owners: NDArray[np.int64], theta: FloatArray) -> FloatArray:
    """Return the highest eigenvalue of the reduced block that contains each mode, shape (n_modes,).

    It is 0 for a mode whose block is not reduced or has massless degrees of freedom.
    """
    reduced = reduced_in(model)
    if reduced is None:
        return np.zeros(len(owners))
    highest = {}
    for b in set(owners.tolist()):
        block = reduced.cheap.blocks[b]
        if block.is_reduced and not block.massless:
            highest[b] = float(np.max(block.eigenvalues(theta[None], block.size)))
    return np.array([highest.get(b, 0.0) for b in owners.tolist()])
