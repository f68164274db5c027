"""Reasons, in terms of structural dynamics, why a model gave no frequencies at a parameter vector.

To save time, solvers return NaN on failure without a reason. Here a structure is solved again at a failed theta to
find the reason.
"""

from __future__ import annotations

import numpy as np

from fmu.engines.blas import single_thread
from fmu.fem.modes.modal import why_unsolved
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.paired_structure import structure_of
from fmu.numbers import typed
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
            with single_thread():  # a reduced model is not examined: the full one is solved where it fails
                counts = structure.rule.counts(structure.blocks)
                found = why_unsolved(structure.blocks, theta, counts, structure.structure)
            if found is not None:
                return found
        frequencies = model.frequencies(theta[None])[0]
    if np.all(np.isfinite(frequencies)):
        return None
    return f"{NOT_FINITE} ({', '.join(map(typed, frequencies))} Hz)"
