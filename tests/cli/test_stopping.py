"""A signal in every phase of a real fmu run: gone within seconds, and resumed to what it would have been."""

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
from tests.cli.test_resuming import PROBLEM, SECOND, assert_same

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
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True)


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


def assert_obeys(process, number, phase=""):
    """It ends soon after the signal, says how to go on, and nothing else."""
    sent = time.monotonic()
    process.send_signal(number)
    _, said = process.communicate(timeout=STARTED_S)
    took = time.monotonic() - sent
    assert process.returncode == 130, (phase, said)
    assert took < OBEYED_S, (phase, took)
    *rest, last = said.splitlines()
    assert last.startswith("Stopped")
    assert last.endswith("To go on: fmu run --resume out")
    assert [line for line in rest if "Traceback" in line or "ignored" in line] == []


def test_a_stop_is_obeyed_in_every_phase(tmp_path, monkeypatch):
    """One run, stopped in each of its phases, is at last the run that nobody stopped."""
    folder = problem_in(tmp_path / "stopped")
    for k, phase in enumerate(PHASES):
        asked = ("run", "--resume", "out", "--progress", "none") if k else RUN
        with ended_at_last(begun(folder, "tests.cli.slowed", phase, *asked)) as process:
            for line in process.stdout:
                if line == "lingering\n":
                    break
            watched = invoke("watch", folder / "out").stdout.splitlines()[0]
            assert (f", {phase} 0/" in watched) == (phase not in ("warmup", "draws")), (phase, watched)
            assert_obeys(process, (signal.SIGINT, signal.SIGTERM)[k % 2], phase)
        assert not list(folder.rglob("*.part")), phase
    monkeypatch.chdir(folder)
    assert invoke("run", "--resume", "out", "--no-report").exit_code == 0
    monkeypatch.chdir(problem_in(tmp_path / "whole"))
    assert invoke(*RUN, "--no-report").exit_code == 0
    assert_same("mh", folder / "out", tmp_path / "whole" / "out")
    assert not (folder / "out" / "checkpoints").exists()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_solve_that_takes_long_is_not_waited_for(tmp_path, monkeypatch, workers):
    """Of a function in this process, and in a worker."""
    (tmp_path / "two.toml").write_text(PYTHON_PROBLEM)
    (tmp_path / "function.py").write_text(PYTHON)
    monkeypatch.chdir(tmp_path)
    assert invoke(*RUN, "--no-report").exit_code == 0
    (tmp_path / "out").rename(tmp_path / "whole")
    (tmp_path / "hang").touch()
    keep = ("--keep-draws", 5, "--workers", workers, "--no-report")
    with ended_at_last(begun(tmp_path, "fmu", *RUN, *keep)) as process:
        until = time.monotonic() + STARTED_S
        while not (tmp_path / "hanging").exists() and process.poll() is None and time.monotonic() < until:
            time.sleep(0.01)
        assert_obeys(process, signal.SIGTERM)
    (tmp_path / "hang").unlink()
    result = invoke("run", "--resume", "out", "--progress", "none", "--no-report")
    assert result.exit_code == 0, result.output
    assert_same("mh", tmp_path / "out", tmp_path / "whole")
