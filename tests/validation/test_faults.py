import re

import pytest

from tests.validation import mutants
from tests.validation.faults import FAULTS
from tests.validation.mutants import PROJECT, Verdict, mutated, page


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_fault_has_its_place_and_its_tests(fault):
    text = (PROJECT / fault.file).read_text()
    assert mutated(text, fault) != text
    for test in fault.tests:
        assert (PROJECT / test).is_file()


def test_a_text_that_occurs_twice_is_refused():
    with pytest.raises(ValueError, match="2 times"):
        mutated(2 * FAULTS[0].old, FAULTS[0])


def test_a_survivor_is_named(monkeypatch):
    monkeypatch.setattr(mutants, "NUMERICAL", ("surrogates",))  # to read the modules of all rooms takes a second
    text = page({FAULTS[0]: Verdict("tests/a.py::b", 1.0), FAULTS[1]: Verdict(None, 1.0)}, 2.0)
    assert "1 of 2 faults caught" in text
    assert re.search(rf"{re.escape(FAULTS[1].name)}.*\*\*survives\*\*", text)
