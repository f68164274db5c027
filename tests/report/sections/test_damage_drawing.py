"""Losses on the drawn structure: which element has which colour."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

import fmu
from fmu.analysis.start.model_words import structure_drawing as drawing_before_sampling
from fmu.analysis.trace.damage import ANY
from fmu.analysis.trace.modal_states import drawn_structure, sketch_of
from fmu.fem.frame.changed_elements import changed_elements
from fmu.fem.frame.drawing import COLOURS, UNCHANGED
from fmu.report.model_view import damage_view
from fmu.report.sections.structure import structure_drawing
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
        assert mean[k] == max(table.loc[("after", name), "mean"], 0.0)
        assert probability[k] == table.loc[("after", name)].iloc[-1]
        assert view.content["tips"][view.content["groups"][k]].startswith(f"{name} in after: loss ")
    assert np.isnan([mean[2], probability[2]]).all()
    assert len(view.packed) > 100


@pytest.mark.parametrize("means", [(0.3, -0.02), (-0.01, -0.02)])
def test_a_negative_mean_loss_is_drawn_as_no_loss(run, means):
    """It was drawn as if the element had no parameter, and without a colour for the means if all were negative."""
    table = fmu.damage(run.trace, (0.05,)).drop(index=ANY, level=1)
    table["mean"] = means
    view = damage_view(sketch_of(run.trace), NAMES, table, "5 %")
    colouring = view.content["colourings"][0]
    np.testing.assert_array_equal(colouring["values"], [max(means[0], 0.0), 0.0, np.nan])
    assert colouring["label"] == "after: mean loss"
    assert view.content["tips"][view.content["groups"][1]].startswith("columns 2 in after: loss -2 %")


def test_the_legend_names_the_parameters_of_the_structure(run):
    """Theta also has the losses, between the stiffnesses."""
    assert list(run.trace["posterior"].data_vars)[1] == "columns 1 loss [after]"
    legend = re.findall(r'background:(#\w+)"></span>([^<]*)<', str(structure_drawing(run.trace)))
    assert legend == [(COLOURS[0], "columns 1"), (COLOURS[1], "columns 2"), (UNCHANGED, "no parameter")]


def test_what_is_known_in_the_first_test_can_still_have_a_colour(mast):
    data = fmu.ModalData([5.0, 20.0], sd_hz=[0.1, 0.1], numbers=[1, 2])
    tests = [fmu.Test("first", data, known={"columns 1": 1.0}), fmu.Test("second", data)]
    parameters = [fmu.Parameter(name, 1.0, 0.4, 1.6) for name in NAMES]
    problem = fmu.JointProblem(mast, tests, parameters, varies={"columns 2": fmu.Population()}, pairing="index")
    found = drawn_structure(problem)["structure"]
    np.testing.assert_array_equal(found["changed"], changed_elements(mast))
    drawing, colours = drawing_before_sampling(problem)
    drawn = re.findall(r'<line [^>]* stroke="(#\w+)" stroke-width="4"', drawing)
    assert drawn == [COLOURS[0], COLOURS[1], UNCHANGED]
    assert dict(zip(problem.names, colours, strict=False)) == {  # scores are not listed
        "columns 1": COLOURS[0], "columns 2 mean": COLOURS[1], "columns 2 sd": COLOURS[1]
    }  # fmt: skip
    squares = re.findall(r'style="color:(#\w+)"[^>]*>&#9632;</span> ([\w ]+?)<', problem._repr_html_())
    assert squares[:3] == [(COLOURS[0], "columns 1"), (COLOURS[1], "columns 2 mean"), (COLOURS[1], "columns 2 sd")]


def test_springs_keep_their_parameter_where_another_one_is_known():
    steel, section = fmu.Material(E=2.1e11, nu=0.3, rho=7850.0), fmu.Section(A=5e-3, Iy=5e-5, Iz=3e-5, J=1e-6)
    beam = fmu.ElementGroup("g", [(0, 1), (1, 2)], section, steel)
    springs = [fmu.JointSpring("left", (0, None), {"ry": 1e6}), fmu.JointSpring("right", (2, None), {"ry": 1e6})]
    held = {0: ("x", "y", "z", "rx", "rz"), 2: ("y", "z", "rx", "rz")}
    frame = fmu.Frame(np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0]], float), [beam], held, springs=springs)
    names = {"E": [("E", "g")], "k": [("stiffness", "left")], "K": [("stiffness", "right")]}
    model = frame.separable({name: fmu.Factor(of) for name, of in names.items()})
    data = fmu.ModalData([10.0, 40.0], sd_hz=[0.1, 0.1], numbers=[1, 2])
    tests = [fmu.Test("first", data, known={"k": 1.0}), fmu.Test("second", data)]
    parameters = [fmu.Parameter(name, 1.0, 0.4, 1.6) for name in names]
    found = drawn_structure(fmu.JointProblem(model, tests, parameters, pairing="index"))["structure"]
    owners = found["symbol_parameter"].to_numpy()[found["symbol"].to_numpy() == "spring"]
    assert found["structural"].to_numpy()[owners].tolist() == ["k", "K"]
