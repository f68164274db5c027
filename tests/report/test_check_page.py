"""The page of a problem that was looked at: it says what the check found, and holds all that it shows."""

import re
import shutil

import pytest

import fmu
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.problem import UpdatingProblem
from fmu.report.check_page import check_page, write_check
from tests.linear import LinearModel
from tests.report.parsed import Parsed

pytestmark = pytest.mark.usefixtures("quick_figures")

HOSTILE = "<script>alert('x')</script>"


@pytest.fixture(scope="module")
def found():
    return fmu.check(fmu.cases.load("cantilever-young"), draws=50)


@pytest.fixture(scope="module")
def doubtful():
    """A function with a hostile name, and a measurement that the prior does not expect."""
    parameters = [Parameter(name, 1.0, 0.0, 2.0) for name in (HOSTILE.replace("/", "\\"), "b")]
    data = ModalData([103.0, 99.5, 120.0], labels=(HOSTILE, "$2$", "3"))
    return fmu.check(UpdatingProblem(LinearModel(), data, parameters, name=HOSTILE), draws=50)


def test_the_verdicts_are_those_of_the_check(found, doubtful):
    assert [(v.answer, v.is_good) for v in check_page(found).verdicts] == [
        ("No warnings", True),
        ("Yes", True),
        ("4 of 5 directions, linearised", None),
        ("Yes", True),
    ]
    verdicts = check_page(doubtful).verdicts
    assert [v.is_good for v in verdicts] == [True, False, True, True]
    assert verdicts[1].answer == "1 of 3 modes not covered"
    assert verdicts[1].reasons == tuple(doubtful.prior.sentences())


def test_tables_have_the_numbers_of_the_check(found, tmp_path):
    text = write_check(found, tmp_path / "new").read_text(encoding="utf-8")
    assert text.count("<svg") == 1 + 5 + 1  # the structure, its modes, the prior's predictions
    assert "Mode 5: computed mode 9, 1961.7 Hz, measured 1781.5 Hz." in text
    for row in found.mode_table().itertuples(index=False):
        assert f"<td>{row[1]}</td>" in text
    for sentence in (*found.model, *found.modes.notes, found.gradient.sentence()):
        assert sentence.replace("'", "&#39;") in text
    legend = re.search(r'<ul class="legend">.*?</ul>', text)[0]
    assert re.findall(r"</span>([^<]*)</li>", legend) == ["E1", "E2", "E3", "E4", "E5"]


def test_names_are_escaped_and_nothing_is_fetched(doubtful, tmp_path):
    text = write_check(doubtful, tmp_path).read_text(encoding="utf-8")
    assert Parsed(text).foreign_scripts == []
    assert "&lt;script&gt;" in text
    assert re.findall(r'(?:src|href)="(?!#|data:)[^"]*"', text) == []


def test_the_page_replaces_itself_and_nothing_else(found, tmp_path):
    first = write_check(found, tmp_path)
    (tmp_path / "notes.txt").write_text("precious")
    assert write_check(found, tmp_path) == first
    assert (tmp_path / "notes.txt").read_text() == "precious"
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "index.html").write_text("precious")
    with pytest.raises(ValueError, match="does not replace"):
        write_check(found, tmp_path / "other")


def test_tests_of_a_structure_that_is_drawn_but_has_no_common_shapes(tmp_path):
    case = fmu.cases.path("shear-12dof-damage")
    text = case.read_text(encoding="utf-8")
    shutil.copytree(case.with_suffix(""), tmp_path / case.stem)
    changed = "reduction = false\n" + text.replace('"0 nw" = [-2.5, 2.5, 0.0]', '"0 nw" = [-2.5, 2.5, 1e-30]')
    (tmp_path / "two.toml").write_text(changed, encoding="utf-8")
    found = fmu.check(fmu.load(tmp_path / "two.toml"), draws=4)
    assert found.drawing
    assert "displacement" not in found.shapes
    assert check_page(found).sections
