"""The check of a problem with frequency response functions: doubts, agreement at the start, and the page."""

import numpy as np
import pytest

import fmu
from fmu.report.check_page import check_page
from tests.measured_frfs import LINES, building, modes, parameters, ratios, simulate


def checked(data):
    own = fmu.FRFErrors(data, fmu.ModalDamping(ratios()))
    return fmu.check(fmu.UpdatingProblem(building(), modes(), parameters(), error=own), draws=50)


@pytest.fixture(scope="module")
def found():
    return checked(simulate(use=(LINES < 5.0) | (LINES > 6.0)))


def test_the_functions_of_the_model_at_the_start_stand_beside_the_measured_ones(found):
    problem = fmu.UpdatingProblem(
        building(), modes(), parameters(), error=fmu.FRFErrors(simulate(), fmu.ModalDamping(ratios()))
    )
    (computed,) = problem.frfs(problem.start)
    np.testing.assert_allclose(found.frfs.tests[0].computed, computed, rtol=1e-10)
    table = found.frfs.table()
    assert list(table.index) == ["2 x / 2 x", "0 x / 2 x"]
    assert table["lines in use"].tolist() == ["112", "112"]
    assert table["sd / |H|, median"].tolist() == ["0.03", "0.03"]


def test_it_says_what_is_inferred_and_that_modes_are_no_data(found):
    said = str(found)
    assert found.parameters["changes"].tolist()[3:] == ["damping"] * 3
    assert "The modes are no data" in said
    assert "thus a test of the model" not in said
    assert not found.frfs.doubts
    assert "FRAC at the start" in said


def test_the_page_draws_each_function(found):
    page = check_page(found)
    (section,) = [one for one in page.sections if one.id == "frfs"]
    assert len([part for part in section.parts if part.kind == "pictures"]) == 2
    (verdict,) = [one for one in page.verdicts if "FRFs" in one.question]
    assert verdict.answer == "No doubts"


def test_a_mobility_taken_for_an_accelerance_is_doubted():
    mobility = simulate(kind="mobility")
    wrong = fmu.FRFData(
        LINES, mobility.values, mobility.drives, mobility.responses, "accelerance", mobility.standard_deviation
    )
    found = checked(wrong)
    (doubt,) = found.frfs.doubts
    assert "are said to be accelerance" in doubt
    assert "look like mobility" in doubt
    assert doubt in found.doubts
    assert doubt in found.sentences()
