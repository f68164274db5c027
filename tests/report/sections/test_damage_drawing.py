"""Losses on the drawn structure: which element has which colour."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

import fmu
from fmu.fem.frame.drawing import UNCHANGED, changed_elements
from fmu.report.sections.tests import losses
from tests.mast import NAMES, damaged, mast


@pytest.fixture(scope="module", name="mast")
def _mast():
    return mast()


def test_a_held_element_is_not_changed_by_what_stands_on_it(mast):
    """Both columns load the node between them: only the lower one is not in equilibrium by itself."""
    assert changed_elements(mast).astype(int).tolist() == [[1, 0], [0, 1], [0, 0]]


def test_what_has_mass_alone_changes_a_held_element(mast):
    """A density has no forces to be in equilibrium."""
    K, M = mast.K([1.0, 1.0]), mast.M([1.0, 1.0])
    model = fmu.SeparableModel.from_terms(["rho"], [K], [(M, "rho")], mast.dofs, mast.geometry)
    assert changed_elements(model)[:, 0].all()


@pytest.fixture(scope="module")
def run():
    return SimpleNamespace(trace=damaged(), name="hmc")


def test_elements_have_the_colours_of_their_losses(run):
    """The lower storey is dark red, the upper one is not, and the arm has no loss."""
    drawings = losses(run).parts[1].pictures
    (drawing,) = drawings
    assert drawing.caption == (
        "after: probability of a loss of more than 5 %, the largest of the parameters that change an element."
    )
    lower, upper, arm = re.findall(r'<line [^>]* stroke="(#\w+)" stroke-width="4"', drawings[0].svg)
    table = fmu.damage(run.trace).loc["after", "P(loss > 5 %)"]
    assert table["columns 1"] > 0.9
    assert table["columns 2"] < 0.9
    assert (lower, arm) == ("#9C1414", UNCHANGED)
    assert upper in ("#C8C8C8", "#F2B25C", "#E0672E")
    assert "columns 1 &gt; 99 %" in drawings[0].svg
    assert "no parameter with a loss" in drawings[0].svg


def test_the_structure_to_be_turned_has_the_losses(run):
    """Of each element the largest loss and its probability; the arm has none."""
    view = losses(run).parts[-1]
    table = fmu.damage(run.trace, (0.05,))
    mean, probability = (one["values"] for one in view.content["colourings"])
    for k, name in enumerate(NAMES):
        assert mean[k] == table.loc[("after", name), "mean"]
        assert probability[k] == table.loc[("after", name)].iloc[-1]
        assert view.content["tips"][view.content["groups"][k]].startswith(f"{name} in after: loss ")
    assert np.isnan([mean[2], probability[2]]).all()
    assert len(view.packed) > 100
