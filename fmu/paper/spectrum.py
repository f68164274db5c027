"""Name the computed modes by their plane of motion and their number in that plane."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.fem.modes.modal import frequency_hz, solve_spectrum
from fmu.fem.pairing.paired_structure import PairedStructure, structure_of
from fmu.types import FloatArray, StrArray

if TYPE_CHECKING:
    from fmu.fem.modes.modal import ModalSolution
    from fmu.posterior.problem import UpdatingProblem


PLANES = {"W": "bending in the weak plane", "S": "bending in the strong plane", "T": "torsion", "A": "axial"}
_PLANE_OF = {"z": "W", "ry": "W", "y": "S", "rz": "S", "rx": "T", "x": "A"}
_BATCH = 4096


def _structure(problem: UpdatingProblem) -> PairedStructure:
    """Return a problem's structure; raise ValueError if its model has none."""
    structure = structure_of(problem.model)
    if structure is None:
        raise ValueError(f"problem: must have a structure of beam elements (got {problem.model.name})")
    return structure


def paired_names(problem: UpdatingProblem, theta: FloatArray) -> StrArray:
    """Return the names (``"W1"``, ``"S2"``, …) of the modes paired with the measured modes, shape (n, n_modes).

    Parameters
    ----------
    theta : ndarray, shape (n, ndim)
        Parameter vectors, SI units.

    Raises
    ------
    ValueError
        If the model has no structure, its planes of motion are coupled, or one plane has several matrix blocks.
    """
    structure = _structure(problem)
    model: Any = problem.model
    parts = [model.modes(theta[i : i + _BATCH]) for i in range(0, len(theta), _BATCH)]
    return np.concatenate([_names(structure, modes) for modes in parts])


def lowest_modes(problem: UpdatingProblem, theta: FloatArray, count: int) -> list[tuple[str, float]]:
    """Return the name and the frequency in Hz of each of the `count` lowest modes, in ascending order.

    The parameters are `theta`, shape (ndim,), SI units. Raise ValueError under the same conditions as
    `paired_names`.
    """
    structure = _structure(problem)
    modes = solve_spectrum(structure.blocks, theta[np.newaxis], count)
    return list(
        zip(_names(structure, modes)[0].tolist(), frequency_hz(modes.eigenvalues)[0].tolist(), strict=True)
    )


def shares(names: StrArray) -> dict[str, float]:
    """Return the fraction of rows with each combination of names; the most common combination comes first."""
    counts = Counter(" ".join(row) for row in names.tolist())
    return {combination: count / len(names) for combination, count in counts.most_common()}


def shares_over_the_box(problem: UpdatingProblem, points: int) -> list[dict[str, float]]:
    """Return the fractions of the parameter box in which physical modes are paired with each measured mode.

    The result is a list with one dict per measured mode. The keys of a dict are names of physical modes, such as
    ``"W1"``, and the most frequent mode comes first. The fractions of the volume within the parameter bounds are
    estimated with a scrambled Sobol sequence. Raise ValueError under the same conditions as `paired_names`.

    Parameters
    ----------
    points : int
        Number of points in the sequence; a power of two.
    """
    from scipy.stats import qmc

    unit = qmc.Sobol(problem.ndim, rng=np.random.default_rng(0)).random_base2(int(np.log2(points)))
    names = paired_names(problem, problem.lower + unit * (problem.upper - problem.lower))
    return [shares(column[:, np.newaxis]) for column in names.T]


def _names(structure: PairedStructure, modes: ModalSolution) -> StrArray:
    """Return mode names such as ``"W1"``. Each matrix block of a straight beam describes one plane of motion.

    Raise ValueError if planes of motion are coupled, or if one plane has several blocks.
    """
    planes = []
    for block in structure.blocks:
        letters = {_PLANE_OF[structure.structure.dofs[dof][1]] for dof in block.dofs}
        if len(letters) != 1:
            raise ValueError(f"structure: its planes of motion must not couple (got {sorted(letters)} coupled)")
        planes.append(letters.pop())
    if len(set(planes)) < len(planes):
        raise ValueError(f"structure: every plane of motion must be one part (got {planes})")
    return np.char.add(np.array(planes)[modes.block], (modes.rank + 1).astype(str))
