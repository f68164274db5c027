"""Progress: bars on a terminal and in a notebook, lines of JSON where wanted, and nothing elsewhere."""

import io
import json
import sys
import time
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest

import fmu.progress
from fmu.progress import add_label, json_lines, progress_bars, reporting
from fmu.progress.displays import terminal_bars
from fmu.progress.pace import Pace
from fmu.progress.words import bar_name, duration, in_words, number


class Display:
    """Stands in for IPython.display: keeps what a cell would show last."""

    def __init__(self):
        self.shown = None
        self.cells = 0

    def HTML(self, text):
        return text

    def display(self, content, display_id):
        assert display_id
        self.shown, self.cells = content, self.cells + 1
        return self

    def update(self, content):
        self.shown = content


class Clock:
    """Stands still until it is moved."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock)
    return clock


@pytest.fixture
def notebook(monkeypatch):
    display = Display()
    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell, display=display))
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    return display


def test_no_bars_where_nobody_looks(capsys):
    with progress_bars() as report:
        assert report is None
    for progress in (None, False):
        with reporting(progress, "hmc") as report:
            assert report is None
    assert capsys.readouterr().out == ""


def test_without_a_terminal_there_are_lines_if_progress_is_asked_for(monkeypatch, capsys):
    monkeypatch.setattr("fmu.progress.lines.FIRST_S", 0.0)
    with reporting(True, "hmc") as report:
        report("draws", 30, 200, {})
        time.sleep(0.5)
    said = capsys.readouterr()
    assert (said.out, said.err.splitlines()[0][:22]) == ("", "hmc draws: 30 of 200, ")


def test_a_shell_without_a_kernel_is_no_notebook(monkeypatch):
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=SimpleNamespace))
    assert not fmu.progress.in_notebook()
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))
    assert not fmu.progress.in_notebook()


def test_a_callable_is_taken_as_it_is():
    seen = []
    with reporting(lambda *call: seen.append(call), "hmc") as report:
        report("draws", 1, 2, {})
    assert seen == [("draws", 1, 2, {})]


def test_labels_go_before_the_phase():
    seen = []
    add_label(lambda *call: seen.append(call), "hmc")("draws", 1, 2, {"group": "1/2"})
    assert seen == [("draws", 1, 2, {"label": "hmc", "group": "1/2"})]
    assert bar_name("draws", seen[0][3]) == "hmc draws 1/2"


def test_a_notebook_shows_one_bar_a_phase_in_one_cell(notebook):
    with reporting(None, "hmc") as report:
        for done in range(1, 4):
            report("warmup", done, 3, {})
        for done in range(1, 6):
            report("draws", done, 5, {"accepted": "0.9"})
    assert notebook.cells == 1
    assert notebook.shown.count("<progress") == 2
    assert '<progress value="3" max="3" aria-label="hmc warmup">' in notebook.shown
    assert '<progress value="5" max="5" aria-label="hmc draws">' in notebook.shown
    assert notebook.shown.rstrip("</div>").endswith("accepted 0.9")


def test_a_notebook_shows_names_and_does_not_run_them(notebook):
    with reporting(None, "<script>") as report:
        report("draws", 1, 1, {"accepted": "<b>"})
    assert "<script>" not in notebook.shown
    assert "<b>" not in notebook.shown


def test_not_every_step_is_drawn(notebook, monkeypatch):
    monkeypatch.setattr(time, "monotonic", lambda: 5.0)
    updates = []
    notebook.update = updates.append
    with reporting(True, "mh") as report:
        for done in range(1, 101):
            report("draws", done, 100, {})
    assert notebook.cells == 1
    assert len(updates) == 1
    assert 'value="100"' in updates[0]


def test_a_terminal_shows_bars(monkeypatch, capsys):
    monkeypatch.setattr(fmu.progress, "on_terminal", lambda: True)
    with reporting(True, "mh") as report:
        report("draws", 7, 7, {})
    assert "mh draws" in capsys.readouterr().out


def test_no_bars_on_a_terminal_unless_asked_for(monkeypatch):
    monkeypatch.setattr(fmu.progress, "on_terminal", lambda: True)
    with reporting(None, "mh") as report:
        assert report is None


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0, "0"),
        (7, "7"),
        (999, "999"),
        (1000, "1.0k"),
        (1234.5, "1.2k"),
        (999.9, "1.0k"),
        (99_940, "99.9k"),
        (123_456, "123k"),
        (5.3e6, "5.3M"),
        (0.83123, "0.831"),
        (-12.345, "-12.3"),
        (-4321.0, "-4.3k"),
        (3e-9, "3e-9"),
        (np.nan, "–"),
        (np.inf, "–"),
        (np.int64(12), "12"),
    ],
)
def test_numbers_are_short(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "-:--"), (0.0, "0:00"), (0.2, "0:01"), (61.0, "1:01"), (3723.0, "1:02:03"), (np.inf, "-:--")],
)
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_words_of_a_sampler():
    info = {
        "group": "1/2",
        "lp": -3.2,
        "accept": 0.8312,
        "solves": 9,
        "solves_per_s": 5312.0,
        "rhat": 1.0123,
        "ess": 1234,
    }
    assert in_words(info) == "accept 0.83 rhat 1.012 ess 1.2k 5.3k solves/s"
    assert in_words(info, brief=True) == "accept 0.83 rhat 1.012 ess 1.2k 5.3k/s"
    assert in_words({"rhat": np.nan, "ess": np.nan, "run": "all"}) == "rhat – ess – run all"
    assert in_words({"rhat": 123.4, "accept": 1.0}) == "rhat 123 accept 1.00"


def test_time_left_is_that_of_the_last_seconds():
    pace = Pace(window_s=10.0)
    assert pace.remaining(0.0) is None
    pace.add(0.0, 0, 1000)
    assert pace.remaining(0.0) is None
    for t in range(1, 101):  # slow at first: a step a second
        pace.add(float(t), t, 1000)
    assert pace.remaining(100.0) == pytest.approx(900.0)
    for t in range(101, 121):  # ten a second
        pace.add(float(t), 100 + 10 * (t - 100), 1000)
    assert pace.per_s() == pytest.approx(10.0)
    assert pace.remaining(120.0) == pytest.approx(70.0)
    assert pace.remaining(125.0) == pytest.approx(65.0)  # time goes on between reports
    assert pace.remaining(500.0) == 0.0


def test_time_left_where_reports_are_rare_or_many():
    pace = Pace(window_s=10.0)
    for part in range(4):
        pace.add(100.0 * part, 50 * part, 400)
    assert pace.remaining(300.0) == pytest.approx(500.0)
    pace.add(301.0, 10, 400)  # it began again
    assert pace.remaining(301.0) is None
    many = Pace(window_s=10.0)
    for step in range(100_000):
        many.add(step * 1e-3, step, 200_000)
    assert many.remaining(99.999) == pytest.approx(100.0, rel=1e-3)
    assert len(many._steps) < 200


def test_nothing_moves_nothing_is_known():
    pace = Pace()
    pace.add(0.0, 5, 10)
    pace.add(4.0, 5, 10)
    assert pace.remaining(4.0) is None
    pace.add(5.0, 10, 10)
    assert pace.remaining(9.0) == 0.0


def drawn(width, height, play):
    """Return the last lines that `play` leaves on a terminal of that size."""
    from rich.console import Console

    console = Console(width=width, height=height, force_terminal=False, file=io.StringIO())
    with terminal_bars(console) as report:
        play(report)
    return [line.rstrip() for line in console.file.getvalue().splitlines() if line.strip()]


def test_every_sampler_and_group_has_a_bar_on_eighty_columns(clock):
    def play(report):
        for name, groups in (("hmc", ({},)), ("emcee", ({"group": "1/2"}, {"group": "2/2"}))):
            for group in groups:
                for done in range(1, 21):
                    clock.now += 1.0
                    numbers = {
                        "lp": -12.3,
                        "accept": 0.8312,
                        "rhat": 1.0123,
                        "ess": 1234.5,
                        "solves_per_s": 5312.0,
                    }
                    add_label(report, name)("draws", 130 * done, 10_000, {**group, **numbers})

    lines = drawn(80, 20, play)
    assert [line.split("2600/")[0].rstrip("━╺╸ ") for line in lines] == [
        "hmc draws",
        "emcee draws 1/2",
        "emcee draws 2/2",
    ]
    for line in lines:
        assert len(line) <= 80
        assert line.endswith("accept 0.83 rhat 1.012 ess 1.2k 5.3k/s")
    assert "2600/10000 0:57" in lines[-1]


def test_bars_that_are_done_make_room(clock):
    def play(report):
        for phase in range(12):
            for done in range(1, 6):
                clock.now += 0.1
                report(f"phase {phase}", done, 5, {})

    lines = drawn(80, 8, play)
    assert len(lines) == 6
    assert lines[-1].startswith("phase 11")


def written(stream):
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def test_lines_of_json(clock):
    stream = io.StringIO()
    report = add_label(json_lines(stream), "hmc")
    began = datetime.now(UTC)
    numbers = {"accept": 0.8312, "rhat": np.float64(1.0123), "ess": np.nan, "solves": np.int64(12), "group": "1/2"}
    report("draws", 1, 10, numbers)
    clock.now += 2.0
    report("draws", 3, 10, {"ess": np.inf, "done": 99})
    report("draws", 10, 10, {})
    first, second, last = written(stream)
    assert (datetime.fromisoformat(first.pop("time")) - began).total_seconds() < 60.0
    assert first == {
        "label": "hmc",
        "phase": "draws",
        "done": 1,
        "total": 10,
        "remaining_s": None,
        "accept": 0.8312,
        "rhat": 1.0123,
        "ess": None,
        "solves": 12,
        "group": "1/2",
    }
    assert second["time"].endswith("Z")
    assert (second["done"], second["ess"]) == (3, None)
    assert last["remaining_s"] == 0.0


def test_one_line_a_second_and_phase_and_the_last(clock):
    stream = io.StringIO()
    with json_lines(stream) as report:
        for step in range(1, 31):
            clock.now += 0.125
            report("warmup", step, 30, {})
            add_label(report, "mh")("draws", step, 100, {})
            report("draws", step, 100, {"group": "1/2"})
            report("draws", step, 100, {"group": "2/2"})
        assert [line["done"] for line in written(stream) if line["phase"] == "warmup"] == [1, 9, 17, 25, 30]
        assert len(written(stream)) == 5 + 3 * 4
    last = written(stream)[-3:]  # the draws ended early: what was held back is written at the end
    assert [(line.get("label"), line.get("group"), line["done"]) for line in last] == [
        ("mh", None, 30),
        (None, "1/2", 30),
        (None, "2/2", 30),
    ]


def test_time_left_in_json(clock):
    stream = io.StringIO()
    report = json_lines(stream)
    for step in range(1, 5):
        clock.now += 2.0
        report("draws", step, 10, {})
    assert [line["remaining_s"] for line in written(stream)] == [None, 16.0, 14.0, 12.0]
    assert "label" not in written(stream)[0]


class Broken(io.StringIO):
    """A pipe whose other end is gone."""

    writes = 0

    def write(self, text):
        self.writes += 1
        raise BrokenPipeError


def test_a_stream_that_breaks_ends_no_run():
    broken, closed = Broken(), io.StringIO()
    closed.close()
    for stream in (broken, closed):
        with json_lines(stream) as report:
            report("warmup", 1, 1, {})
            report("draws", 1, 1, {})
    assert broken.writes == 1


def test_lines_are_made_as_often_as_wanted():
    """The function must not be hidden by the module that it imports."""
    for _ in range(2):
        assert callable(fmu.progress.json_lines(io.StringIO()))
