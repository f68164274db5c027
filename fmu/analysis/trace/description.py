"""A model and its parameters in words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.fem.frame.drawing import changed_elements, drawing, parameter_colours
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.pairing.paired_black_box import PairedBlackBox
from fmu.fem.pairing.paired_model import PairedStructure
from fmu.fem.pairing.rules import IndexPairing
from fmu.fem.reduced.basis import ReducedBlock
from fmu.numbers import given, listed, significant

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.problem import UpdatingProblem

_MOST_ELEMENTS = 5000
_MOST_BLOCKS = 6
_TRANSLATIONS = ("x", "y", "z")


def model_in_words(problem: UpdatingProblem) -> list[str]:
    """Say what a problem's model is: its size, its decoupled parts, its mass, what answers for it."""
    model = problem.model
    if not isinstance(model, PairedStructure):
        name = model.black_box.name if isinstance(model, PairedBlackBox) else type(model).__name__
        return [f"The model is the function {name}, treated as a black box."]
    structure = model.structure
    sizes = [str(len(block)) for block in structure.blocks]
    parts = "in one block" if len(sizes) == 1 else f"in {len(sizes)} decoupled blocks"
    if 1 < len(sizes) <= _MOST_BLOCKS:
        parts += f" of {', '.join(sizes[:-1])} and {sizes[-1]}"
    said = [f"The model has {structure.n_dof} free degrees of freedom, {parts}."]
    said += _masses(problem, structure)
    said.append(_pairing(problem, model))
    if model.reduced is not None:
        reduced = [str(block.size) for block in model.reduced.blocks if isinstance(block, ReducedBlock)]
        if reduced:
            said.append(
                f"Within the bounds a reduced model with {' + '.join(reduced)} unknowns replaces it, "
                f"certified against the full model."
            )
    else:
        said.append("The full model is used everywhere; there is no reduced model.")
    return said


def parameter_table(problem: UpdatingProblem) -> pd.DataFrame:
    """Return one row a parameter: unit, start, bounds (SI units), prior in words, what it changes if known."""
    import pandas as pd

    structure = getattr(problem.model, "structure", None)
    rows = []
    for j, parameter in enumerate(problem.parameters):
        changes = _changes(structure, j) if isinstance(structure, SeparableModel) else ""
        if j >= problem.model.n_parameters:
            changes = "measurement errors"
        rows.append(
            {
                "unit": parameter.unit,
                "start": parameter.start,
                "lower": parameter.lower,
                "upper": parameter.upper,
                "prior": prior_in_words(parameter.prior.as_dict()),
                "changes": changes,
            }
        )
    table = pd.DataFrame(rows, index=pd.Index(problem.names, name="parameter"))
    return table if any(table["changes"]) else table.drop(columns="changes")


def prior_in_words(settings: dict[str, Any]) -> str:
    """Return a prior's name and numbers: ``"normal, mean 0, sd 2e11"``."""
    parts = [
        f"{key} {given(value)}" if isinstance(value, float) else f"{key} {value}"
        for key, value in settings.items()
    ]
    return ", ".join(parts).removeprefix("distribution ")


def structure_drawing(problem: UpdatingProblem) -> tuple[str, list[str | None]]:
    """Return the structure as SVG and the colour of what each parameter changes; empty and None if not drawn."""
    structure = getattr(problem.model, "structure", None)
    if not isinstance(structure, SeparableModel) or not _is_drawable(structure):
        return "", [None] * problem.ndim
    others = [None] * (problem.ndim - structure.n_parameters)
    return drawing(structure, problem.data.sensors), [*parameter_colours(structure), *others]


def _is_drawable(structure: SeparableModel) -> bool:
    return structure.geometry is not None and len(structure.geometry.elements) <= _MOST_ELEMENTS


def _masses(problem: UpdatingProblem, structure: SeparableModel) -> list[str]:
    """Say what mass moves when all that is free to does so in one direction: a check on units and densities.

    Of three directions the smallest mass counts: beside a support, where such a motion bends the elements, their
    rotary inertia takes part in the others. Degrees of freedom without names may point anywhere: theirs are not
    added up.
    """
    M = structure.M(problem.start[: structure.n_parameters])
    if all(isinstance(node, int) and direction == "x" for node, direction in structure.dofs):
        least, most = (significant(float(end), 4) for end in (M.diagonal().min(), M.diagonal().max()))
        between = f"is {least} kg" if least == most else f"ranges from {least} to {most} kg"
        return [
            f"At the start the diagonal of the mass matrix {between}; its rows have no directions (dofs in "
            f"[model]), so the total mass is not known."
        ]
    directions = np.array([direction for _, direction in structure.dofs])
    rigid = [(directions == name).astype(float) for name in _TRANSLATIONS if name in directions]
    if not rigid:
        return []
    mass = min(float(motion @ (M @ motion)) for motion in rigid)
    return [f"At the start the free degrees of freedom move a mass of about {significant(mass)} kg."]


def _pairing(problem: UpdatingProblem, model: PairedStructure) -> str:
    if isinstance(model.rule, IndexPairing):
        return f"Modes are paired by number in the sorted spectrum: {', '.join(map(str, model.rule.numbers))}."
    if problem.data.shapes is not None:
        return (
            f"Modes are paired by shape: by MAC with the shapes measured at {len(problem.data.sensors)} sensors."
        )
    return "Modes are paired by shape: by MAC with the model's own shapes at the start."


def _changes(structure: SeparableModel, j: int) -> str:
    """Say what a parameter changes: ``"stiffness of 10 of 50 elements"``."""
    if j >= structure.n_parameters:
        return ""
    kinds = []
    touched = np.zeros(structure.n_dof, dtype=bool)
    for kind, terms in (("stiffness", structure.K_terms), ("mass", structure.M_terms)):
        own = [term for term in terms if term.powers[j]]
        powers = sorted({term.powers[j] for term in own})
        if own:
            power = "" if powers == [1] else f" (to the power {listed(powers)})"
            kinds.append(kind + power)
        for term in own:
            touched[term.matrix.tocoo().row] = True
    if not kinds:
        return "nothing"
    if _is_drawable(structure):
        changed = changed_elements(structure)[:, j]
        if np.any(changed):
            return f"{' and '.join(kinds)} of {changed.sum()} of {len(changed)} elements"
    return f"{' and '.join(kinds)} at {touched.sum()} of {structure.n_dof} degrees of freedom"
