"""Studies that are killed go on where they were, and their pages are published whole."""

from dataclasses import replace

import pytest

from tests.results.schedule import Schedule
from tests.results.stamps import Stamp, without_stamp
from tests.results.studies import Study, chosen

STUDY = Study("counting", 1.0, "tests.results.counting", ("counting.md",))


@pytest.fixture
def schedule(tmp_path, monkeypatch):
    monkeypatch.setenv("COUNTED", str(tmp_path / "counted"))
    monkeypatch.setenv("DIES_AT", "0")
    (tmp_path / "results").mkdir()
    return Schedule([STUDY], tmp_path / "kept", tmp_path / "results")


def test_a_study_killed_twice_writes_the_page_of_one_that_was_not(schedule, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DIES_AT", "2 4")
    page = tmp_path / "results" / "counting.md"
    for _ in range(2):
        assert "no page; it ended with 9" in schedule.run()[0]
        assert not page.exists()
    assert schedule.run() == []
    assert (tmp_path / "counted").read_text().split() == ["0", "1", "1", "2", "2", "3"]
    text = page.read_text(encoding="utf-8")
    assert without_stamp(text) == "# Squares\n\n[0, 1, 4, 9]\n"
    stamp = Stamp.of(text)
    assert stamp.units == "4 of 4 numbers"
    assert stamp.command == "python -m tests.results.counting results"
    assert "tests" in stamp.rooms
    assert "counting: 4 of 4 numbers" in capsys.readouterr().out


def test_units_of_other_code_are_done_again(schedule, tmp_path):
    assert schedule.run() == []
    (tmp_path / "kept" / "counting" / "rooms.json").write_text("{}")
    assert schedule.run() == []
    assert (tmp_path / "counted").read_text().split() == ["0", "1", "2", "3"] * 2


def test_a_page_whose_gates_fail_is_published_and_told(schedule, tmp_path, monkeypatch):
    monkeypatch.setenv("GATE", "1")
    assert schedule.run() == ["counting: its gates fail, as its page says"]
    assert (tmp_path / "results" / "counting.md").exists()


def test_budgets_are_multiplied():
    for study, longer in zip(chosen(("bound", "frfs")), chosen(("bound", "frfs"), 2.5), strict=True):
        assert longer.minutes == 2.5 * study.minutes
        assert longer.pages == study.pages


def test_a_study_is_given_its_budget(schedule, tmp_path, capsys):
    study = replace(STUDY, minutes=2.5 * STUDY.minutes)
    assert replace(schedule, studies=[study]).run() == []
    assert "counting: begins, at most 2.5 minutes" in capsys.readouterr().out
    assert "budget of 2.5 minutes" in (tmp_path / "kept" / "counting" / "log.txt").read_text()
