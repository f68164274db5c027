"""Commands of fmu in processes that are forked from one that has imported everything (`tests.cli.slowed`)."""

import json
import os
import time

import pytest

from tests.cli.runs import PROBLEM, SECOND

RUN = ("run", "two.toml", "--sampler", "mh", "--warmup", 10, "--draws", 15, "--chains", 2, "--starts", 2, "--out",
       "out", "--progress", "none")  # fmt: skip


def reduced_problem_in(folder):
    """Write the two storeys, with a reduced model."""
    folder.mkdir()
    (folder / "two.toml").write_text(PROBLEM.replace("reduction = false\n", ""))
    (folder / "k2.csv").write_text(SECOND)
    return folder


def begun(runs, folder, phase, *arguments):
    """Begin a run that lingers in a phase, or another command, and return its process's number."""
    runs.stdin.write(json.dumps([str(folder), phase, *map(str, arguments)]) + "\n")
    runs.stdin.flush()
    return int(line_of(runs, "pid")[1])


def line_of(runs, *firsts):
    """The first line of standard output that begins with one of these words."""
    for line in runs.stdout:
        if line.startswith(firsts):
            return line.split()
    pytest.fail(f"ended: {runs.stderr.read()}")


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def exit_code(runs, pid, most_s=60.0):
    """Return the exit code of a process, which has to end within some seconds."""
    until = time.monotonic() + most_s
    while is_running(pid) and time.monotonic() < until:
        time.sleep(0.01)
    assert not is_running(pid)
    return int(line_of(runs, f"ended {pid} ")[2])
