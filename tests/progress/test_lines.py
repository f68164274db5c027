"""Lines of a log: a first one soon, one for every stage, and one at least every so often."""

import io
import re
import time

import pytest

from fmu.progress import lines
from fmu.progress.lines import ProgressLines
from fmu.progress.phases import phase, progress_lines, tell_fact, told_to


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(lines, "FIRST_S", 0.0)
    monkeypatch.setattr(lines, "EVERY_S", 0.02)


def wait_for(stream, words):
    """Wait until the words are written; fail if they are not."""
    for _ in range(2000):
        if words in stream.getvalue():
            return
        time.sleep(0.005)
    pytest.fail(f"not written: {words!r} in {stream.getvalue()!r}")


@pytest.mark.usefixtures("quick")
def test_a_stage_that_reports_nothing_is_not_silent():
    stream = io.StringIO()
    with ProgressLines(stream, "checking beam.toml", look_s=0.005):
        wait_for(stream, "checking beam.toml: 0:01 so far\nchecking beam.toml: 0:01 so far\n")


@pytest.mark.usefixtures("quick")
def test_every_stage_says_how_far_it_is_and_how_large_the_model_is():
    stream = io.StringIO()
    with (
        ProgressLines(stream, "preparing", look_s=0.005) as log,
        told_to(log.report, log.note, log.tell),
    ):
        tell_fact("941 degrees of freedom, 17 parameters")
        wait_for(stream, "941 degrees of freedom, 17 parameters\npreparing: ")
        with phase("training", 400) as under_way:
            wait_for(stream, "training: 0 of 400")
            time.sleep(0.01)
            under_way.advance(100)
            wait_for(stream, "training: 100 of 400")
        wait_for(stream, "to go")
        seen = len(stream.getvalue())
        for _ in range(100):
            time.sleep(0.005)
            if re.search(r"\npreparing: 0:01 so far\n", stream.getvalue()[seen:]):
                break
        else:
            pytest.fail("the stage around it is not told again")


def test_what_takes_no_time_is_not_told():
    stream = io.StringIO()
    with ProgressLines(stream, "checking"):
        pass
    assert stream.getvalue() == ""


@pytest.mark.usefixtures("quick")
def test_a_broken_stream_stops_nothing():
    stream = io.StringIO()
    stream.close()
    with ProgressLines(stream, "checking", look_s=0.005):
        time.sleep(0.05)


@pytest.mark.usefixtures("quick")
def test_nothing_is_written_at_a_terminal(monkeypatch):
    stream = io.StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", stream)
    with progress_lines("checking") as report:
        assert report is None
        time.sleep(0.05)
    assert stream.getvalue() == ""
