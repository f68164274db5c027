"""A real fmu run, stopped in every phase or killed: gone within seconds, resumed to what it would have been."""

import os
import signal
import time

import pytest

from tests.cli.forked import RUN, begun, exit_code, line_of, reduced_problem_in
from tests.cli.runs import QUIET, assert_same, invoke, of, resume

pytestmark = [
    pytest.mark.skipif(os.name != "posix", reason="signals of POSIX"),
    pytest.mark.usefixtures("certified"),  # as in the processes beside this one
]

PHASES = ("training", "search", "warmup", "draws", "predictions", "certificate", "report")
OBEYED_S = 5.0
STARTED_S = 120.0
PYTHON = """\
import os
import time
from pathlib import Path


def hz(theta):
    here = Path(__file__).parent
    if (here / "hang").exists() and len(list(here.glob("out/checkpoints/mh/group-1/state-*"))):
        (here / "hanging").touch()
        time.sleep(60.0)
    return [4.0 * theta[0] ** 0.5, 9.0 * theta[1] ** 0.5]
"""
PYTHON_PROBLEM = (
    'name = "function"\n[model]\ntype = "python"\nfunction = "function:hz"\n'
    "[measurement]\nfrequencies = [4.0, 9.0]\nsd = 0.5\n"
) + "".join(f'\n[[parameters]]\nname = "{name}"\nstart = 1.0\nlower = 0.5\nupper = 1.5\n' for name in "ab")


def assert_obeys(runs, pid, number, folder):
    """It ends soon after the signal, says how to go on, and nothing else."""
    sent = time.monotonic()
    os.kill(pid, number)
    ended = exit_code(runs, pid)
    took = time.monotonic() - sent
    *rest, last = (folder / "said").read_text().splitlines()
    assert ended == 130, last
    assert took < OBEYED_S
    assert last.startswith("Stopped")
    assert last.endswith("To resume: fmu run --resume out")
    assert [line for line in rest if "Traceback" in line or "ignored" in line] == []


@pytest.mark.validate
def test_a_stop_is_obeyed_in_every_phase(forked_runs, undisturbed, tmp_path, monkeypatch):
    """One run, stopped in each of its phases, is at last the run that nobody stopped."""
    folder = reduced_problem_in(tmp_path / "stopped")
    for k, phase in enumerate(PHASES):
        asked = ("run", "--resume", "out", "--progress", "none") if k else RUN
        pid = begun(forked_runs, folder, phase, *asked)
        assert line_of(forked_runs, "lingering", "ended") == ["lingering"], phase
        watched = invoke("watch", folder / "out").stdout.splitlines()[0]
        assert (f", {phase} 0/" in watched) == (phase not in ("warmup", "draws")), (phase, watched)
        assert_obeys(forked_runs, pid, (signal.SIGINT, signal.SIGTERM)[k % 2], folder)
        assert not list(folder.rglob("*.part")), phase
    assert (folder / "said").read_text().count("To resume: fmu run --resume out\n") == len(PHASES)
    monkeypatch.chdir(folder)
    assert invoke("run", "--resume", "out", "--no-report").exit_code == 0
    assert_same("mh", folder / "out", undisturbed / "out")
    assert not (folder / "out" / "checkpoints").exists()


def test_a_solve_that_takes_long_is_not_waited_for(forked_runs, tmp_path, monkeypatch):
    """Of a function in a worker."""
    (tmp_path / "two.toml").write_text(PYTHON_PROBLEM)
    (tmp_path / "function.py").write_text(PYTHON)
    monkeypatch.chdir(tmp_path)
    assert invoke(*RUN, "--no-report").exit_code == 0
    (tmp_path / "out").rename(tmp_path / "whole")
    (tmp_path / "hang").touch()
    pid = begun(forked_runs, tmp_path, "", *RUN, "--keep-draws", 5, "--workers", 2, "--no-report")
    until = time.monotonic() + STARTED_S
    while not (tmp_path / "hanging").exists() and time.monotonic() < until:
        time.sleep(0.01)
    assert (tmp_path / "hanging").exists()
    assert_obeys(forked_runs, pid, signal.SIGTERM, tmp_path)
    (tmp_path / "hang").unlink()
    result = invoke("run", "--resume", "out", "--progress", "none", "--no-report")
    assert result.exit_code == 0, result.output
    assert_same("mh", tmp_path / "out", tmp_path / "whole")


def test_killed_by_the_system(forked_runs, tmp_path, monkeypatch):
    """In the middle of the second of two samplers."""
    undisturbed, folder = (reduced_problem_in(tmp_path / name) for name in ("undisturbed", "killed"))
    samplers = ("mh", "slice")
    arguments = ("run", "two.toml", *of(*samplers), "--out", "out", *QUIET)
    pid = begun(forked_runs, folder, "", *arguments, "--keep-draws", 1)
    until = time.monotonic() + STARTED_S
    state = folder / "out" / "checkpoints" / "slice" / "group-1" / "state-000012"
    while not state.exists() and time.monotonic() < until:
        time.sleep(0.001)
    os.kill(pid, signal.SIGKILL)
    assert exit_code(forked_runs, pid) == -signal.SIGKILL
    monkeypatch.chdir(folder)
    assert f"killed (process {pid} on " in invoke("watch", "out").stdout
    result = resume()
    assert result.exit_code == 0, result.output
    monkeypatch.chdir(undisturbed)
    assert invoke(*arguments).exit_code == 0
    for name in samplers:
        assert_same(name, folder / "out", undisturbed / "out")
