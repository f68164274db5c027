"""Reasons, in terms of structural dynamics, why a model gave no frequencies at a parameter vector.

To save time, solvers return NaN on failure without a reason. Here a structure is solved again at a failed theta to
find the reason.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fmu.engines.blas import single_thread
from fmu.fem.modes.eigensolver import SingularMassError, eigen
from fmu.fem.modes.full_block import FullBlock
from fmu.fem.modes.modal import NEGATIVE
from fmu.fem.modes.terms import coefficients, weighted_sum
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.paired_structure import PairedStructure, structure_of
from fmu.numbers import significant, typed
from fmu.types import FloatArray

NOT_FINITE = "frequencies are not finite"


def why_no_frequencies(model: ModalModel, theta: FloatArray) -> str | None:
    """Return the reason why a paired model has no finite frequencies at theta, or None if no reason is found.

    None is also returned if the frequencies are finite after all.

    Parameters
    ----------
    model : ModalModel
        If it is a user's function, the recorded reason is returned, and the function is not called again, because
        it may be slow or fail differently. For the surrogate of a function, the reason is that nearby training
        points failed. If the model has several tests, the first reason found is returned, with the name of its
        test.
    theta : ndarray, shape (n_parameters,)
        Parameters at which the model has just failed.
    """
    if model.functions and model.n_tests == 1:
        return model.reason_at(theta)
    if model.is_uncertain:
        first = f" ({model.reasons[0].reason})" if model.reasons else ""
        where = f"near points at which the model could not be solved{first}"
        return f"{where}, where its surrogate expects no frequencies"
    for test, part, point in model.failed_tests(theta):
        found = why_no_frequencies(part, point)
        if found is not None:
            return f"test {test}: {found}"
    if model.n_tests > 1:
        return None
    with np.errstate(all="ignore"):
        structure = structure_of(model)
        if structure is not None:
            with single_thread():
                found = _of_structure(structure, theta)
            if found is not None:
                return found
        frequencies = model.frequencies(theta[None])[0]
    if np.all(np.isfinite(frequencies)):
        return None
    return f"{NOT_FINITE} ({', '.join(map(typed, frequencies))} Hz)"


def _of_structure(model: PairedStructure, theta: FloatArray) -> str | None:
    """Return the reason why the full model fails, or None if no reason is found.

    A reduced model is not examined, because the full model is solved wherever the reduced model fails.
    """
    structure = model.structure
    for b, count in model.rule.counts(model.blocks).items():
        block: Any = model.blocks[b]
        found = _of_block(block, theta, count)
        if found is not None:
            reason, dof = found
            return reason if dof is None else f"{reason} at node {structure.dofs[dof][0]} {structure.dofs[dof][1]}"
    return None


def _of_block(block: FullBlock, theta: FloatArray, count: int) -> tuple[str, int | None] | None:
    """Return why a block fails and, if one degree of freedom is to blame, its index in the model.

    Return None if the block can be solved.
    """
    K, M = (weighted_sum(terms, coefficients(terms, theta[None])[0]) for terms in (block.K_terms, block.M_terms))
    for name, matrix in (("K", K), ("M", M)):
        if not np.all(np.isfinite(matrix.data)):
            return f"{name} is not finite", None
    try:
        lam, _ = eigen(K, M, count)
    except SingularMassError as error:
        mass = M.diagonal()
        least = int(np.argmin(mass))
        if mass[least] < 0.0:
            return f"M is not positive semidefinite: its diagonal is {significant(mass[least])}", int(
                block.dofs[least]
            )
        said = str(error)
        return (
            f"the eigenvalue solver did not converge ({said})" if said.startswith("eigenproblem") else said
        ), None
    if not np.all(np.isfinite(lam)):
        return "the eigenvalue solver did not converge (an eigenvalue is not finite)", None
    # relative to the largest eigenvalue solved for, as in frequency_hz
    if lam[0] < -NEGATIVE * np.max(np.abs(lam)):
        return f"K is not positive semidefinite: an eigenvalue is {significant(lam[0])} (rad/s)²", None
    return None
