"""fmu run, broken off and resumed: what is drawn is bit for bit what it would have been, and every end is told."""

import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from click.testing import CliRunner

import fmu
from fmu.checkpoints.run_directory import RunDirectory
from fmu.checkpoints.store import Store
from fmu.cli import main

PROBLEM = """\
name = "two storeys"
reduction = false

[model]
type = "matrices"
dofs = [["first", "x"], ["second", "x"]]

[[model.stiffness]]
matrix = [[1.0, 0.0], [0.0, 0.0]]
powers = { k1 = 1 }

[[model.stiffness]]
file = "k2.csv"
powers = { k2 = 1 }

[[model.mass]]
matrix = [[16.5e3, 0.0], [0.0, 16.1e3]]

[measurement]
frequencies = [4.1, 10.9]
sd = 0.3

[[parameters]]
name = "k1"
start = 2.97e7
lower = 1e7
upper = 6e7

[[parameters]]
name = "k2"
start = 2.97e7
lower = 1e7
upper = 6e7
"""
SECOND = "1.0,-1.0\n-1.0,1.0\n"
ALL = ("mh", "slice", "hmc", "emcee", "tempering")
LENGTH = ("--warmup", 10, "--draws", 15, "--chains", 2, "--starts", 2)
QUIET = ("--no-report", "--progress", "none")
CLOCKS = {"wall_s", "warmup_wall_s", "after_n_solves"}  # a function is called again where that was forgotten


class Cut(BaseException):
    """Ends a process like a kill, as far as the code under test can tell."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of all samplers that nothing happened to, by name."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "two.toml").write_text(PROBLEM)
    (folder / "k2.csv").write_text(SECOND)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        result = invoke("run", "two.toml", *of(*ALL), "--out", "out", *QUIET)
    assert result.exit_code == 0, result.output
    return folder / "out"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "two.toml").write_text(PROBLEM)
    (tmp_path / "k2.csv").write_text(SECOND)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def at_keep(monkeypatch):
    """Have something happen when groups have been kept so many times; with `again` every so many times."""

    def arranged(count, happen, again=False):
        kept, keep = [0], Store.keep

        def keeping(store, group, unkept):
            keep(store, group, unkept)
            kept[0] += 1
            if kept[0] == count or (again and kept[0] % count == 0):
                happen()

        monkeypatch.setattr(Store, "keep", keeping)

    return arranged


def invoke(*arguments):
    return CliRunner().invoke(main, list(map(str, arguments)), prog_name="fmu")


def run(*more, length=LENGTH):
    return invoke("run", "two.toml", *length, "--keep-draws", 5, "--out", "out", *QUIET, *more)


def of(*samplers):
    return (*LENGTH, *(word for name in samplers for word in ("--sampler", name)))


def resume(*more):
    return invoke("run", "--resume", "out", *QUIET, *more)


def cut():
    raise Cut


def assert_same(name, one, other):
    """All groups of the traces and all attributes, but for the clocks, are the same bit for bit."""
    first, second = (fmu.load_trace(folder / f"{name}.nc") for folder in (one, other))
    assert {g: sorted(first[g].data_vars) for g in first.groups} == {
        g: sorted(second[g].data_vars) for g in second.groups
    }
    for group in first.groups:
        for variable in first[group].data_vars:
            np.testing.assert_array_equal(first[group][variable], second[group][variable], f"{group}/{variable}")
    attributes = ({key: value for key, value in t.attrs.items() if key not in CLOCKS} for t in (first, second))
    assert next(attributes) == next(attributes)


def assert_refused(result, *words):
    assert result.exit_code == 2, result.output
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert all(word in result.stderr for word in words), result.stderr


def test_broken_off_again_and_again(folder, whole, at_keep):
    """Five samplers, after every ninth part that is kept."""
    at_keep(9, cut, again=True)
    ends = 0
    with pytest.raises(Cut):
        run(*of(*ALL))
    while True:
        ends += 1
        try:
            result = resume()
        except Cut:
            continue
        break
    assert result.exit_code == 0, result.output
    assert ends > 2
    for name in ALL:
        assert_same(name, folder / "out", whole)
    assert not (folder / "out" / "checkpoints").exists()
    assert {path.name for path in (folder / "out").iterdir()} == {path.name for path in whole.iterdir()}


def test_killed_by_the_system(folder, whole):
    """In the middle of the second of two samplers."""
    samplers = ("mh", "slice")
    arguments = ["run", "two.toml", *of(*samplers), "--keep-draws", 1, "--out", "out", *QUIET]
    killed = subprocess.Popen([sys.executable, "-m", "fmu", *map(str, arguments)], stderr=subprocess.PIPE)
    try:
        states = folder / "out" / "checkpoints" / "slice" / "group-1"
        while killed.poll() is None and not (states / "state-000012").exists():
            time.sleep(0.001)
    finally:
        killed.kill()
        _, said = killed.communicate()
    assert killed.returncode == -signal.SIGKILL, said
    assert f"killed (process {killed.pid} on " in invoke("watch", "out").stdout
    result = resume()
    assert result.exit_code == 0, result.output
    for name in samplers:
        assert_same(name, folder / "out", whole)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_with_what_was_drawn(folder, whole, at_keep, number):
    at_keep(3, lambda: signal.raise_signal(number))
    handlers = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    stopped = run(*of("slice"))
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == handlers
    assert stopped.exit_code == 130, stopped.output
    assert stopped.stdout == ""
    *_, last = stopped.stderr.splitlines()
    assert last == "Stopped: slice after 6 of 15 draws. To go on: fmu run --resume out"
    assert_usable(folder / "out", 6)  # a step after it was kept
    result = resume()
    assert result.exit_code == 0, result.output
    assert_same("slice", folder / "out", whole)


def assert_usable(directory, draws):
    """A trace of so few draws can be worked with, and says what it is."""
    partial = fmu.load_trace(directory / "slice.nc")
    assert partial["posterior"].sizes["draw"] == draws
    assert partial.attrs["complete"] == 0
    compared = invoke("compare", directory)
    assert compared.exit_code == 0, compared.output
    assert "not converged" in compared.stdout


def test_a_signal_in_warm_up(folder, whole, at_keep):
    at_keep(1, lambda: signal.raise_signal(signal.SIGTERM))
    stopped = run(*of("hmc"), "--keep-draws", 3)
    assert stopped.exit_code == 130
    assert stopped.stderr.splitlines()[-1] == "Stopped: hmc in warm-up. To go on: fmu run --resume out"
    assert not (folder / "out" / "hmc.nc").exists()
    assert resume().exit_code == 0
    assert_same("hmc", folder / "out", whole)


def test_the_second_signal_stops_at_once(folder, whole, at_keep):
    at_keep(3, lambda: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    stopped = run(*of("mh"))
    assert stopped.exit_code == 130
    assert stopped.stderr.splitlines()[-1] == "Stopped: mh after 5 of 15 draws. To go on: fmu run --resume out"
    assert resume().exit_code == 0
    assert_same("mh", folder / "out", whole)


def test_a_stop_in_the_search_for_maxima(folder, whole, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("fmu.analysis.search.find_map", interrupted)
        stopped = run(*of("mh"))
    assert stopped.exit_code == 130
    assert stopped.stderr.splitlines()[-1] == "Stopped. To go on: fmu run --resume out"
    assert resume().exit_code == 0
    assert_same("mh", folder / "out", whole)


def test_a_group_of_chains_a_worker(folder, at_keep):
    """Two processes draw what one does, and go on with what one has left."""
    groups = ("--groups", 2, "--chains", 4)
    assert run(*of("hmc"), *groups).exit_code == 0
    (folder / "out").rename(folder / "one")
    with pytest.MonkeyPatch.context() as patch:
        keep, kept = Store.keep, []

        def keeping(store, group, unkept):
            keep(store, group, unkept)
            kept.append(group)
            if len(kept) == 7:
                raise Cut

        patch.setattr(Store, "keep", keeping)
        with pytest.raises(Cut):
            run(*of("hmc"), *groups)
    result = resume("--workers", 2)
    assert result.exit_code == 0, result.output
    assert_same("hmc", folder / "out", folder / "one")
    assert fmu.load_trace(folder / "out" / "hmc.nc").attrs["groups"] == 2


def test_until_enough(folder, at_keep):
    until = ("--until-ess", 60, "--max-draws", 40)
    assert run(*of("mh"), *until).exit_code == 1
    assert fmu.load_trace("out/mh.nc")["posterior"].sizes["draw"] == 40
    (folder / "out").rename(folder / "one")
    at_keep((10 + 30) // 5, cut)  # while the run is carried on
    with pytest.raises(Cut):
        run(*of("mh"), *until)
    assert resume().exit_code == 1
    assert_same("mh", folder / "out", folder / "one")


def test_what_must_not_be_said_anew(folder, at_keep):
    at_keep(3, cut)
    with pytest.raises(Cut):
        run(*of("mh"))
    for said in (("--draws", 15), ("--seed", 1), ("--sampler", "mh"), ("--keep-draws", 5), ("--overwrite",)):
        assert_refused(resume(*said), "--resume", f"{said[0]} is that of the run", "leave it out")
    assert_refused(invoke("run", "two.toml", "--resume", "out"), "CASE is that of the run")
    assert resume("--max-failure-rate", 0.4).exit_code == 0


def test_an_ended_run_is_told_again(folder):
    told = run(*of("mh"))
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "out").glob("*.nc")}
    again = resume()
    assert again.exit_code == 0, again.output
    assert again.stdout == told.stdout
    assert {path.name: path.stat().st_mtime_ns for path in (folder / "out").glob("*.nc")} == before
    assert not (folder / "out" / "checkpoints").exists()


def test_no_run(folder):
    assert_refused(invoke("run", "--resume", "none"), "'none' does not exist")
    (folder / "empty").mkdir()
    assert_refused(invoke("run", "--resume", "empty"), "empty is not of a run that can be resumed")
    assert list((folder / "empty").iterdir()) == []


def test_the_problem_is_that_of_the_beginning(folder, whole, at_keep):
    """The file may change meanwhile; the files that it names must not."""
    at_keep(4, cut)
    with pytest.raises(Cut):
        run(*of("slice"))
    (folder / "two.toml").write_text("something else")
    (folder / "k2.csv").write_text("1.0,-1.0\n-1.0,1.1\n")
    assert_refused(resume(), "checkpoint", "another run")
    (folder / "k2.csv").write_text(SECOND)
    assert resume().exit_code == 0
    assert_same("slice", folder / "out", whole)


def test_one_run_at_a_time(folder, whole, at_keep):
    at_keep(3, cut)
    with pytest.raises(Cut):
        run(*of("mh"))
    with RunDirectory(folder / "out"):
        assert_refused(resume(), "another fmu run is at work in out")
        assert_refused(run("--overwrite", *of("slice")), "another fmu run is at work in out")
    assert resume().exit_code == 0
    assert_same("mh", folder / "out", whole)


def test_another_run_instead(folder, whole, at_keep):
    at_keep(4, cut)
    with pytest.raises(Cut):
        run(*of("mh"), "--seed", 7)
    assert_refused(run(*of("mh")), "out exists", "--overwrite")
    assert run(*of("mh"), "--overwrite").exit_code == 0
    assert_same("mh", folder / "out", whole)


@pytest.mark.parametrize("said", [("--groups", 3), ("--cluster", "nowhere"), ("--max-draws", 3), ("--groups", 2)])
def test_bad_input_writes_nothing(folder, said):
    assert_refused(run(*of("hmc", "tempering"), *said))
    assert sorted(path.name for path in folder.iterdir()) == ["k2.csv", "two.toml"]


def test_progress_for_programs(folder):
    result = run(*of("mh"), "--progress", "json")
    lines = [json.loads(line) for line in result.stderr.splitlines()]
    # and, on a slow machine, other phases
    assert {(line.get("label"), line["phase"]) for line in lines} >= {("mh", "warmup"), ("mh", "draws")}
    drawn = [line for line in lines if line["phase"] == "draws"]
    assert (drawn[-1]["done"], drawn[-1]["total"]) == (15, 15)


def test_too_many_failures(folder):
    (folder / "brittle.py").write_text(
        "import math\n\n\ndef hz(theta):\n    if theta[0] > 1.02:\n        raise RuntimeError('no licence')\n"
        "    return [4.0 * math.sqrt(theta[0] * theta[1]), 9.0 * math.sqrt(theta[1])]\n"
    )
    parameter = '\n[[parameters]]\nname = "{}"\nstart = 1.0\nlower = 0.5\nupper = 1.5\n'
    (folder / "two.toml").write_text(
        'name = "brittle"\n[model]\ntype = "python"\nfunction = "brittle:hz"\n'
        "[measurement]\nfrequencies = [4.0, 9.0]\nsd = 0.5\n" + parameter.format("a") + parameter.format("b")
    )
    length = ("--warmup", 30, "--draws", 100, "--chains", 4, "--starts", 2, "--init", "start", "--sampler", "mh")
    stopped = run("--max-failure-rate", 0.05, length=length)
    assert stopped.exit_code == 1, stopped.output
    *_, line = stopped.stderr.splitlines()
    assert line.startswith("Error: mh: ")
    assert "more than the limit of 5 %; most often: RuntimeError: no licence. See out/failures-mh.csv" in line
    assert line.endswith("to go on all the same: fmu run --resume out --max-failure-rate 1")
    short = (folder / "out" / "failures-mh.csv").read_text()
    assert "no licence" in short
    result = resume("--max-failure-rate", 1)
    assert result.exit_code == 0, result.output
    ledger = (folder / "out" / "failures-mh.csv").read_text()
    assert ledger.startswith(short)
    assert len(ledger) > len(short)
    trace = fmu.load_trace(folder / "out" / "mh.nc")
    failed = sum(int(trace[g]["n_nonfinite"].sum()) for g in ("warmup_sample_stats", "sample_stats"))
    assert f"mh: {failed} points inside the bounds" in result.stderr
    (folder / "out").rename(folder / "one")
    assert run("--max-failure-rate", 1, length=length).exit_code == 0
    assert (folder / "out" / "failures-mh.csv").read_text().count("no licence") == ledger.count("no licence")


def test_a_stop_at_the_very_end_of_a_sampler_begins_no_other(folder, whole, monkeypatch):
    def ended(directory, sampler, problem, finished=RunDirectory.finished):
        finished(directory, sampler, problem)
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(RunDirectory, "finished", ended)
        stopped = invoke("run", "two.toml", *of("mh", "slice"), "--out", "out", *QUIET)
    assert stopped.exit_code == 130
    assert "Stopped. To go on: fmu run --resume out" in stopped.stderr
    assert resume().exit_code == 0
    for name in ("mh", "slice"):
        assert_same(name, folder / "out", whole)


def test_a_stop_with_the_last_draw_is_obeyed(folder, whole, at_keep):
    at_keep(5, lambda: signal.raise_signal(signal.SIGTERM))
    stopped = run(*of("mh"))
    assert stopped.exit_code == 130, stopped.output
    assert not (folder / "out" / "mh.nc").exists()
    assert resume().exit_code == 0
    assert_same("mh", folder / "out", whole)
