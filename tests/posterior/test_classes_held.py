"""A problem consists of few kinds of object; a new one is worth a thought."""

import pytest

import fmu
from tests.classes_held import classes_held


@pytest.mark.parametrize(("case", "most"), [("cantilever-young", 25), ("shear-12dof-damage", 28)])
def test_a_problem_holds_few_classes(case, most):
    held = classes_held(fmu.cases.load(case))
    assert len(held) <= most, ", ".join(held)
    assert {"Layout", "Parameter", "Normal", "Term", "FullBlock", "ReducedBlock"} <= set(held)
