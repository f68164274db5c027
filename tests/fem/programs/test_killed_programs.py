"""Programs that are killed from outside, such as by the signal that stops the run: no failure of the model."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.engines import program
from fmu.engines.base import InProcess
from fmu.engines.process_pool import ProcessPool
from fmu.fem.programs.solves import Solves
from fmu.fem.programs.store import Solve, SolveStore
from fmu.interruption import interruptible
from fmu.runs import Checkpoint
from tests.fem.programs.test_command import THETA, command_model, exact

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")


@pytest.fixture
def at_once(monkeypatch):
    """Do not wait for a signal that stops the run."""
    monkeypatch.setattr(program, "GRACE_S", 0.0, raising=False)


class Stopped:
    """Frequencies √θ. If a file exists, a stop of this process ends the program above some θ, after some calls."""

    def __init__(self, file, above=0.0, after=0):
        self.pid, self.file, self.above, self.after, self.calls = os.getpid(), file, above, after, 0

    def __call__(self, theta):
        self.calls += 1
        if theta[0] > self.above and self.calls > self.after and self.file.exists():
            self.file.unlink()
            os.kill(self.pid, signal.SIGINT)
            raise subprocess.CalledProcessError(1, ["solver"])
        return np.sqrt(theta)


@pytest.mark.parametrize("engine", [InProcess(), ProcessPool(1)], ids=["here", "in a worker"])
def test_a_failure_after_a_stop_is_none_of_the_model(tmp_path, engine):
    theta, store, file = np.array([[1.0], [4.0]]), SolveStore(tmp_path / "store"), tmp_path / "stop"
    solves = Solves(Stopped(file, above=1.1), 1, store=store, least_s=0.0)
    file.touch()
    with engine, solves.spread_over(engine):
        with pytest.raises(KeyboardInterrupt), interruptible():
            solves.of(theta)
        assert not any(solve.reason for solve in store)
        assert not solves.reasons
    assert [solve.frequencies.tolist() for solve in solves.of(theta)] == [[1.0], [2.0]]


def test_a_run_whose_programs_are_stopped_too_is_resumed_to_the_same_draws(tmp_path):
    file, parameter = tmp_path / "stop", fmu.Parameter("k", 1.0, 0.5, 1.5)

    def run(where, after=0):
        function = Stopped(file, after=after)
        problem = fmu.UpdatingProblem(fmu.BlackBoxModel(function, 1), fmu.ModalData([1.0], sd_hz=0.2), [parameter])
        settings = {"warmup": 0, "draws": 20, "chains": 1, "init": np.array([[1.0]]), "progress": False}
        trace = fmu.sample(problem, "mh", checkpoint=Checkpoint(tmp_path / where, draws=1), **settings)
        return trace["posterior"]["k"], function.calls

    whole, calls = run("whole")
    file.touch()
    with pytest.raises(KeyboardInterrupt):
        run("stopped", after=calls - 10)
    assert_array_equal(run("stopped")[0], whole)


@pytest.mark.parametrize(
    ("how", "lasts"),
    [("SIGTERM", False), ("SIGKILL", False), ("SIGHUP", False), ("137", False), ("SIGSEGV", True), ("3", True)],
)
def test_a_program_that_was_killed_from_outside_runs_again(tmp_path, at_once, how, lasts):
    (tmp_path / "killed").touch()
    end = f"sys.exit({how})" if how.isdigit() else f"os.kill(os.getpid(), signal.{how})"
    heed = "signal.signal(signal.SIGHUP, signal.SIG_DFL)"  # nohup ignores it
    code = f"import os, runpy, signal, sys\n{heed}\nif os.path.exists({str(tmp_path / 'killed')!r}):\n    {end}\n"
    command = [sys.executable, "-I", "-c", f"{code}runpy.run_path('solver.py')".replace("{", ""), "{deck}", ""]
    solve = command_model(tmp_path, command=command).solve(THETA)
    assert solve.reason
    assert [solve.reason for solve in command_model(tmp_path, command=command).solves] == [solve.reason] * lasts
    (tmp_path / "killed").unlink()
    again = command_model(tmp_path, command=command).solve(THETA)
    assert bool(again.reason) == lasts
    if not lasts:
        assert_allclose(again.frequencies, exact(THETA), rtol=1e-13)


def test_a_kill_that_was_stored_as_a_failure_is_solved_again(tmp_path):
    model = command_model(tmp_path)
    model.solves.keep(Solve(THETA, np.zeros(0), None, 0.1, "python: was ended by SIGKILL; its files are in x"))
    assert_allclose(model.solve(THETA).frequencies, exact(THETA), rtol=1e-13)


@pytest.mark.parametrize(("code", "lasts"), [(-9, False), (143, False), (-11, True), (1, True)])
def test_a_function_whose_program_was_killed_is_called_again(tmp_path, at_once, code, lasts):
    def function(theta):
        raise subprocess.CalledProcessError(code, ["solver"])

    store = SolveStore(tmp_path)
    (solve,) = Solves(function, 1, store=store, least_s=0.0).of(np.array([[1.0]]))
    assert solve.reason
    assert len(list(store)) == lasts
