"""A signal in every phase of a real fmu run: gone within seconds, and resumed to what it would have been."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner

from fmu.cli import main
from tests.cli.runs import PROBLEM, SECOND, assert_same

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")

ROOT = Path(__file__).parents[2]
PHASES = ("training", "search", "warmup", "draws", "predictions", "certificate", "report")
OBEYED_S = 5.0
STARTED_S = 120.0
RUN = ("run", "two.toml", "--sampler", "mh", "--warmup", 10, "--draws", 15, "--chains", 2, "--starts", 2, "--out",
       "out", "--progress", "none")  # fmt: skip
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


def begun(folder, module, *arguments):
    """A process in a folder of its own, with a cache of its own."""
    environment = os.environ | {
        "PYTHONPATH": os.fspath(ROOT),
        "FMU_CACHE_DIR": os.fspath(folder / "cache"),
        "OPENBLAS_NUM_THREADS": "1",
    }
    command = [sys.executable, "-m", module, *map(str, arguments)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True)


@contextmanager
def ended_at_last(process):
    with process:
        try:
            yield process
        finally:
            process.kill()


def problem_in(folder):
    folder.mkdir()
    (folder / "two.toml").write_text(PROBLEM.replace("reduction = false\n", ""))
    (folder / "k2.csv").write_text(SECOND)
    return folder


def invoke(*arguments):
    return CliRunner().invoke(main, list(map(str, arguments)), prog_name="fmu")


def assert_obeys(process, number):
    """It ends soon after the signal, says how to go on, and nothing else."""
    sent = time.monotonic()
    process.send_signal(number)
    _, said = process.communicate(timeout=STARTED_S)
    took = time.monotonic() - sent
    assert process.returncode == 130, said
    assert took < OBEYED_S
    *rest, last = said.splitlines()
    assert last.startswith("Stopped")
    assert last.endswith("To go on: fmu run --resume out")
    assert [line for line in rest if "Traceback" in line or "ignored" in line] == []


def line_of(process, *firsts):
    """The first line of standard output that begins with one of these words."""
    for line in process.stdout:
        if line.startswith(firsts):
            return line.split()
    pytest.fail(f"ended: {process.stderr.read()}")


def test_a_stop_is_obeyed_in_every_phase(tmp_path, monkeypatch):
    """One run, stopped in each of its phases, is at last the run that nobody stopped."""
    whole, folder = problem_in(tmp_path / "whole"), problem_in(tmp_path / "stopped")
    with ended_at_last(begun(tmp_path, "tests.cli.slowed", whole, *RUN)) as process:
        for k, phase in enumerate(PHASES):
            asked = ("run", "--resume", "out", "--progress", "none") if k else RUN
            process.stdin.write(json.dumps([str(folder), phase, *map(str, asked)]) + "\n")
            process.stdin.flush()
            pid = int(line_of(process, "pid")[1])
            assert line_of(process, "lingering", "ended") == ["lingering"], phase
            watched = invoke("watch", folder / "out").stdout.splitlines()[0]
            assert (f", {phase} 0/" in watched) == (phase not in ("warmup", "draws")), (phase, watched)
            sent = time.monotonic()
            os.kill(pid, (signal.SIGINT, signal.SIGTERM)[k % 2])
            assert line_of(process, "ended") == ["ended", "130"], phase
            assert time.monotonic() - sent < OBEYED_S, phase
            assert not list(folder.rglob("*.part")), phase
        said = process.communicate()[1]
    assert said.count("To go on: fmu run --resume out\n") == len(PHASES)
    assert "Traceback" not in said
    assert "ignored" not in said
    monkeypatch.chdir(folder)
    assert invoke("run", "--resume", "out", "--no-report").exit_code == 0
    assert_same("mh", folder / "out", whole / "out")
    assert not (folder / "out" / "checkpoints").exists()


def test_a_solve_that_takes_long_is_not_waited_for(tmp_path, monkeypatch):
    """Of a function in a worker."""
    (tmp_path / "two.toml").write_text(PYTHON_PROBLEM)
    (tmp_path / "function.py").write_text(PYTHON)
    monkeypatch.chdir(tmp_path)
    assert invoke(*RUN, "--no-report").exit_code == 0
    (tmp_path / "out").rename(tmp_path / "whole")
    (tmp_path / "hang").touch()
    keep = ("--keep-draws", 5, "--workers", 2, "--no-report")
    with ended_at_last(begun(tmp_path, "fmu", *RUN, *keep)) as process:
        until = time.monotonic() + STARTED_S
        while not (tmp_path / "hanging").exists() and process.poll() is None and time.monotonic() < until:
            time.sleep(0.01)
        assert_obeys(process, signal.SIGTERM)
    (tmp_path / "hang").unlink()
    result = invoke("run", "--resume", "out", "--progress", "none", "--no-report")
    assert result.exit_code == 0, result.output
    assert_same("mh", tmp_path / "out", tmp_path / "whole")
