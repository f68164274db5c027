"""How far the phases beside the draws are, and what they solve."""

import numpy as np
import pytest

from fmu.progress import phases
from fmu.progress.phases import advance_phase, by_parts, count_solves, phase, solves, told_to


@pytest.fixture
def told(monkeypatch):
    """What is told, from the first step on, without the time."""
    monkeypatch.setattr(phases, "AT_ONCE_S", 0.0)
    lines = []

    def report(name, done, total, info):
        assert info["elapsed_s"] >= 0.0
        lines.append((name, done, total, {key: value for key, value in info.items() if key != "elapsed_s"}))

    with told_to(report):
        yield lines


def test_steps_and_solves(told):
    before = solves()
    with phase("search", 3) as climbs:
        count_solves(10)
        climbs.advance(2)
        advance_phase()
    assert told == [
        ("search", 0, 3, {"solves": 0}),
        ("search", 0, 3, {"solves": 10}),
        ("search", 2, 3, {"solves": 10}),
        ("search", 3, 3, {"solves": 10}),
    ]
    assert solves() - before == 10


def test_one_within_another_is_told_by_itself_and_counted_in_both(told):
    with phase("training", 2) as outer:
        with phase("search", 1):
            count_solves(4)
            advance_phase()
        outer.advance(2)
    assert told[-2:] == [("search", 1, 1, {"solves": 4}), ("training", 2, 2, {"solves": 4})]


def test_an_end_before_the_last_step_is_an_end(told):
    with phase("search", 5) as climbs:
        climbs.advance(2)
    assert told[-1] == ("search", 2, 2, {"solves": 0})


def test_what_takes_no_time_is_not_told():
    lines, notes = [], []
    listening = told_to(lambda *line: lines.append(line), lambda *note: notes.append(note))
    with listening, phase("search", 1) as climbs:
        climbs.advance()
    assert lines == []
    assert notes == [("search", 0, 1), ("search", 1, 1), ("", 0, 0)]
    advance_phase()  # without a phase nothing happens


def test_a_long_phase_without_steps_is_told_at_its_end(monkeypatch):
    lines, clock = [], iter([10.0, 10.1, 14.2, 14.2, 14.2])
    monkeypatch.setattr(phases.time, "monotonic", lambda: next(clock))
    with told_to(lambda *line: lines.append(line)), phase("reading the model"):
        pass
    assert lines == [("reading the model", 1, 1, {"solves": 0, "elapsed_s": 4.2})]


def test_parts_are_the_whole(told):
    points, sizes = np.arange(100.0).reshape(50, 2), []

    def function(part):
        sizes.append(len(part))
        return part.sum(axis=1)

    found = np.concatenate(by_parts("predictions", function, points, 20))
    np.testing.assert_array_equal(found, points.sum(axis=1))
    assert sum(sizes) == 50
    assert max(sizes) <= 20
    assert told[-1][:3] == ("predictions", 50, 50)
    assert len(by_parts("predictions", function, points[:0])) == 1
