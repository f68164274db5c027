"""Describe a problem's model in words, and the quantities that each parameter changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.fem.frame.changed_elements import Elements, find_elements
from fmu.fem.frame.drawing import draw_svg, is_drawable
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.static import TRANSLATIONS, uniform_motion
from fmu.fem.pairing.paired_structure import structure_of
from fmu.fem.reduced.cost import memory_in_words
from fmu.formats.modes.measured_modes import is_node
from fmu.numbers import customary_unit, listed, names_in_words, significant, with_unit
from fmu.posterior.card import colours_in_sketch, structure_sketch
from fmu.posterior.parameters import prior_in_words
from fmu.tables import data_frame

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.problem import UpdatingProblem


_MOST_ELEMENTS = 5000
_MOST_BLOCKS = 6
_SAME_MASS = 1.1


def model_in_words(problem: UpdatingProblem) -> list[str]:
    """Return sentences on a problem's model: its size, blocks, mass, parameters not updated, and reduced model.

    For several tests, or a model without matrices, there are fewer.
    """
    model = structure_of(problem.model)
    if len(problem.tests) > 1:
        n, unknowns = len(problem.model.parts), " + ".join(map(str, problem.model.sizes))
        many = "" if n == 1 else f" in {n} configurations, each with matrices of its own"
        reduced = f" The reduced models have {unknowns} unknowns." if unknowns else ""
        return [f"{len(problem.tests)} tests of one structure{many}.{reduced}", *_describe_held(problem)]
    if model is None:
        return [f"The model is {problem.model.name}, treated as a black box."]
    structure = model.structure
    sizes = [str(len(block)) for block in structure.blocks]
    parts = "in one block" if len(sizes) == 1 else f"in {len(sizes)} decoupled blocks"
    if 1 < len(sizes) <= _MOST_BLOCKS:
        parts += f" of {names_in_words(sizes)}"
    said = [f"The model has {structure.n_dof} free degrees of freedom, {parts}."]
    said += [*structure.notes, *_masses(problem, structure), *_describe_held(problem)]
    if problem.model.sizes:
        said.append(f"Its reduced model has {' + '.join(map(str, problem.model.sizes))} unknowns.")
    said += [model.why_full] if model.why_full else []
    said.append(f"Its matrices are factorised by {model.solver}.")
    said += [memory] if (memory := memory_in_words(structure)) else []
    return said


def _describe_held(problem: UpdatingProblem) -> list[str]:
    """Return a list with a sentence on the parameters that are not updated, or an empty list if all are."""
    held = [f"{p.name} = {with_unit(p.start, p.unit)}" for p in problem.layout.structural if not p.updated]
    return [f"Not updated: {', '.join(held)}."] if held else []


def parameter_table(problem: UpdatingProblem) -> pd.DataFrame:
    """Return a table of each parameter's unit, starting value, bounds, prior, and the quantities that it changes.

    The test scores of a population are omitted, because all of them are standard normal. The last column is
    omitted if it is empty, as for a user's function.
    """
    rows, listed, elements = [], _find_listed(problem), dict[SeparableModel, Elements | None]()
    for k in listed:
        parameter = problem.parameters[k]
        found, unit = problem.matrices_of(k), customary_unit(parameter.unit)
        changes = _beside_structure(problem, k) if found is None else _changes(*found, elements)
        rows.append(
            {
                "unit": unit.name,
                "start": parameter.start / unit.factor,
                "lower": parameter.lower / unit.factor,
                "upper": parameter.upper / unit.factor,
                "prior": prior_in_words(parameter.prior.as_dict(), parameter.unit),
                "changes": changes,
            }
        )
    table = data_frame(rows, "parameter", [problem.names[k] for k in listed])
    return table if any(table["changes"]) else table.drop(columns="changes")


def _beside_structure(problem: UpdatingProblem, k: int) -> str:
    """Return the quantity outside the structure that parameter `k` (an index from 0) changes; "" if none."""
    roles = {
        p.name: role
        for term in problem.likelihood.responses
        for p, role in zip(term.inferred, term.roles, strict=True)
    }
    of, is_of_errors = problem.roles[k].of, k >= problem.n_structural
    name = problem.names[k] if of is None else problem.layout.structural[of].name
    return roles.get(name, "measurement errors" if is_of_errors else "")


def structure_drawing(problem: UpdatingProblem) -> tuple[str, list[str | None]]:
    """Return the structure as SVG, and for each row of `parameter_table` the colour of the changed elements.

    The colour is None for a parameter that changes nothing in the drawn structure. If the structure cannot be
    drawn, the SVG is empty and each colour is None.
    """
    listed, found = _find_listed(problem), structure_sketch(problem, _MOST_ELEMENTS)
    if found is None:
        return "", [None] * len(listed)
    colours = colours_in_sketch(problem, found)
    return draw_svg(found), [colours[k] for k in listed]


def _find_listed(problem: UpdatingProblem) -> list[int]:
    """Return the indices of all parameters except the test scores of populations."""
    return [k for k, role in enumerate(problem.roles) if role.kind != "score"]


def _masses(problem: UpdatingProblem, structure: SeparableModel) -> list[str]:
    """Return a list with a sentence on the mass that moves if all free degrees of freedom translate together.

    This mass is a check on units and densities. Next to a support the translation bends the elements, whose rotary
    inertia adds to the transverse mass. If the masses in all directions agree within 10 %, only the smallest is
    stated. Degrees of freedom without named directions are not summed: the sentence then gives the range of the
    mass matrix's diagonal. The list is empty if there are no free translations.
    """
    M = structure.M(problem.model_parameters(problem.start[None])[0])
    if all(is_node(node) and direction == "x" for node, direction in structure.dofs):
        least, most = (significant(float(end), 4) for end in (M.diagonal().min(), M.diagonal().max()))
        between = f"is {least} kg" if least == most else f"ranges from {least} to {most} kg"
        return [
            f"At the start the diagonal of the mass matrix {between}; its rows have no directions (dofs in "
            f"[model]), so the total mass is not known."
        ]
    rigid = {name: uniform_motion(structure, name) for name in TRANSLATIONS}
    masses = {name: float(motion @ (M @ motion)) for name, motion in rigid.items() if motion.any()}
    if not masses:
        return []
    if max(masses.values()) <= _SAME_MASS * min(masses.values()):
        carried = f"{significant(min(masses.values()))} kg in {names_in_words(list(masses))}"
    else:
        carried = ", ".join(f"{significant(mass)} kg in {name}" for name, mass in masses.items())
    return [f"At the start the free degrees of freedom carry {carried}."]


def _changes(structure: SeparableModel, j: int, elements: dict[SeparableModel, Elements | None]) -> str:
    """Describe what parameter `j` changes: ``"stiffness of 10 of 50 elements"``, or ``"nothing"``.

    If the elements are too many, unknown or hidden by constraints, degrees of freedom are counted instead.
    `elements` caches the elements of each structure, or None without a geometry or with too many elements.
    """
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
    if structure not in elements:
        is_known = structure.geometry is not None and is_drawable(structure, _MOST_ELEMENTS)
        elements[structure] = find_elements(structure) if is_known else None
    found = elements[structure]
    if found is not None and np.any(found.changed[:, j]) and not np.any(found.hidden[:, j]):
        return f"{' and '.join(kinds)} of {found.changed[:, j].sum()} of {len(found.changed)} elements"
    return f"{' and '.join(kinds)} at {touched.sum()} of {structure.n_dof} degrees of freedom"
