"""Short runs that the tests of breaking off and resuming compare with."""

import os
import subprocess
import sys
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest

import fmu.analysis.maxima.search
from tests.cli.forked import RUN, reduced_problem_in
from tests.cli.runs import QUIET, SAMPLERS, invoke, of, problem_in
from tests.runs.keeping import at_keep

ROOT = Path(__file__).parents[2]
FOUND = {}


@contextmanager
def searched_once():
    """Search for the maxima of a problem once: the tests are of what comes after."""
    search = fmu.analysis.maxima.search.find_map

    def remembered(problem, starts=None, seed=1):
        key = (problem.name, starts, seed)
        if key not in FOUND:
            FOUND[key] = search(problem, starts, seed)
        return FOUND[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fmu.analysis.maxima.search, "find_map", remembered)
        yield


@pytest.fixture(scope="module")
def _searched_once():
    with searched_once():
        yield


def undisturbed_run(folder, samplers):
    """Return the directory of a run that nothing happens to."""
    problem_in(folder)
    with pytest.MonkeyPatch.context() as patch, searched_once():
        patch.chdir(folder)
        result = invoke("run", "two.toml", *of(*samplers), "--out", "out", *QUIET)
    assert result.exit_code == 0, result.output
    return folder / "out"


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """A run of the samplers that are stopped every day."""
    return undisturbed_run(tmp_path_factory.mktemp("whole"), ("mh", "hmc"))


@pytest.fixture(scope="session")
def whole_of_all(tmp_path_factory):
    """A run of SAMPLERS that nothing happened to."""
    return undisturbed_run(tmp_path_factory.mktemp("all"), SAMPLERS)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The folder of the undisturbed run that `forked_runs` began with."""
    return reduced_problem_in(tmp_path_factory.mktemp("undisturbed") / "whole")


@pytest.fixture(scope="session")
def forked_runs(undisturbed):
    """The process that runs are forked from, after the undisturbed one."""
    environment = os.environ | {"PYTHONPATH": os.fspath(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "tests.cli.slowed", *map(str, (undisturbed, *RUN, "--no-report"))]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, cwd=undisturbed, env=environment, stdin=pipe, stdout=pipe, stderr=pipe, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture
def folder(tmp_path, monkeypatch, _searched_once):
    """The problem in the current directory."""
    monkeypatch.chdir(tmp_path)
    return problem_in(tmp_path)


@pytest.fixture
def no_verdicts(monkeypatch):
    """Leave out what a run says of its draws: other tests are of that, and these of the draws."""
    monkeypatch.setattr("fmu.cli.sampled._tell_draws", lambda *_: None)
    monkeypatch.setattr(import_module("fmu.cli.run"), "tell", lambda *_: 0)


@pytest.fixture(name="at_keep")
def _at_keep(monkeypatch):
    return partial(at_keep, monkeypatch)
