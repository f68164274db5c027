"""Progress bars: on a terminal, in a notebook, and nowhere else."""

import sys
from types import SimpleNamespace

import pytest

import fmu.progress
from fmu.progress import labelled, progress_bars, reporting


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
    for progress in (None, False, True):
        with reporting(progress, "hmc") as report:
            assert report is None
    assert capsys.readouterr().out == ""


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
    labelled(lambda *call: seen.append(call), "hmc")("draws", 1, 2, {"accepted": "0.9"})
    assert seen == [("hmc draws", 1, 2, {"accepted": "0.9"})]


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
    monkeypatch.setattr(fmu.progress.time, "monotonic", lambda: 5.0)
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
