"""Errors of the model in a planned first test: the problem's discrepancy as further parameters.

The discrepancy consists of latent errors z with standard normal distributions, some of which belong to one mode,
while others are common to all modes (`fmu.posterior.discrepancy.embedded`, `fmu.posterior.discrepancy.modes`). To
first order they add (∂f_i/∂z) z and (∂φ_i/∂z) z to the modes. The plan extends ψ by z, so that the information
matrix has the blocks of both, and counts only the information about ψ: this is JᵀS⁻¹J with the covariance S of
the likelihood with a discrepancy. As z is the same in all tests of a structure, repeats do not reduce it, and a
test with a structural change has the same z. Inferred standard deviations and correlations have their starting
values.

Errors of shapes (`shape_sd` of the kind "modes") are independent between sensors. They are no parameters: their
variance is added to that of the measurement errors, and repeats do not reduce it. A second test with a structural
change counts them as new.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from fmu.analysis.plan.before import Before
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.types import FloatArray


def with_errors(
    before: Before, seen: ModalPrediction, by_psi: ModalPrediction, modes: Sequence[int]
) -> ModalPrediction:
    """Append the derivatives with respect to the latent errors of `modes` to those with respect to ψ.

    Parameters
    ----------
    before : Before
        With the n draws of `seen`.
    seen : ModalPrediction
        Modes with derivatives with respect to the model parameters.
    by_psi : ModalPrediction
        The same with derivatives with respect to ψ; returned unchanged if the plan has no errors of the model.
    modes : sequence of int
        Indices of the modes to be measured. Modes of two structures have the same errors if they have the same
        position in their sequences.
    """
    errors = before.errors
    if errors is None:
        return by_psi
    assert seen.frequency_slopes is not None  # for the type checker: derivatives were requested
    assert seen.shape_slopes is not None
    assert by_psi.frequency_slopes is not None
    assert by_psi.shape_slopes is not None
    relative = seen.frequency_slopes / seen.frequencies[..., None]
    slopes = np.concatenate([relative[:, None], seen.shape_slopes], axis=1)
    n, rows, m, p = slopes.shape
    of_frequencies = np.repeat([1.0, 0.0], [m, (rows - 1) * m])
    values = np.broadcast_to(before.values(before.draws)[:, None], (n, rows * m, p))
    noise = np.tile(before.noise, (n, 1))
    own, common = errors.in_hz(slopes.reshape(n, -1, p), of_frequencies, values, noise)
    kept = [np.ones(len(errors.of_mode)), *(np.arange(one.n_own) < (one.sd is not None) for one in errors.modes)]
    own = own[..., np.concatenate(kept) > 0].reshape(n, rows, m, -1)  # without errors of shapes
    k = own.shape[3]
    by_errors = np.zeros((n, rows, m, k * len(modes) + common.shape[2]))
    for i, mode in enumerate(modes):
        by_errors[:, :, mode, k * i : k * (i + 1)] = own[:, :, mode]
    by_errors[..., k * len(modes) :] = common.reshape(n, rows, m, -1)
    by_frequency = by_errors[:, 0] * seen.frequencies[..., None]
    return replace(
        by_psi,
        frequency_slopes=np.concatenate([by_psi.frequency_slopes, by_frequency], axis=2),
        shape_slopes=np.concatenate([by_psi.shape_slopes, by_errors[:, 1:]], axis=3),
    )


def scaled_with_errors(
    before: Before, seen: ModalPrediction, rows: FloatArray | None
) -> tuple[FloatArray, FloatArray | None]:
    """Return the scale of ψ and the latent errors, whose covariance is I, and the target's scaled derivatives.

    `seen` is the result of `with_errors` at n draws. `rows` are the target's derivatives with respect to ψ, (n, t,
    P), or None if all of ψ matters equally. The scaled derivatives, (n, t, P + z), are None if there is neither a
    target nor a latent error.
    """
    assert seen.frequency_slopes is not None  # for the type checker: derivatives were requested
    (n, _, columns), p = seen.frequency_slopes.shape, len(before.scale)
    if columns == p:
        return before.scale, None if rows is None else rows @ before.scale
    of_psi = np.tile(np.eye(p), (n, 1, 1)) if rows is None else rows @ before.scale
    scale = block_diag(before.scale, np.eye(columns - p))
    return scale, np.concatenate([of_psi, np.zeros((n, of_psi.shape[1], columns - p))], axis=2)


def shape_sd_of_model(before: Before) -> float:
    """Return the standard deviation of the model's errors in shapes, whose largest component is 1."""
    every = () if before.errors is None else before.errors.modes
    of_shapes = (one.shape_sd.at(before.noise[None])[0] for one in every if one.shape_sd is not None)
    return float(np.sqrt(sum(sd**2 for sd in of_shapes)))


def doubts_of_errors(before: Before) -> list[str]:
    """Return objections to a plan that ignores errors of the model."""
    if not before.problem.likelihood.has_discrepancy:
        return []
    if before.errors is None:
        return [
            "The plan ignores the model's discrepancy: the expected standard deviations are too small, and a "
            "further test of the structure has the same errors of the model."
        ]
    of_modes = before.errors.modes
    if any(one.sd is None or one.shape_sd is None for one in of_modes):
        return [
            "The plan ignores the model's errors in frequencies or shapes of which the problem has no data: the "
            "expected standard deviations after the whole test are too small."
        ]
    if any(np.any(one.root != np.eye(len(one.root))) for one in of_modes):
        return ["The plan takes the model's errors in shapes to be independent from sensor to sensor."]
    return []
