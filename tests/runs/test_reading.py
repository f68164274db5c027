"""How far a run is, from its files: what is right is said, what is damaged too, and nothing is touched."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest

import fmu
from fmu.analysis.convergence.effective import live_diagnostics
from fmu.analysis.trace.reading import parameter_draws
from fmu.runs import Checkpoint
from fmu.runs.lock import FILE, announce, leave, present
from fmu.runs.status import SILENT_S, RunReader
from fmu.sampling import StoppedRun
from tests.runs.keeping import at_keep
from tests.samplers.targets import CorrelatedGaussian

STEPS = {"warmup": 20, "draws": 60, "chains": 4, "groups": 2, "seed": 3}


class Failing(CorrelatedGaussian):
    """A Gaussian with a side on which it fails."""

    def log_prob(self, theta):
        value = super().log_prob(theta)
        return np.where(theta[:, 0] > self.mean[0] + 1.0, -np.inf, value)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run that was asked to stop after half of its draws, and the trace of what there is."""
    directory = tmp_path_factory.mktemp("run") / "kept"
    with pytest.MonkeyPatch.context() as patch:
        at_keep(patch, 11, lambda: signal.raise_signal(signal.SIGINT))
        with pytest.raises(StoppedRun) as stop:
            sampled(directory)
    return directory, stop.value.trace


def sampled(directory):
    density = Failing()
    start = np.tile(density.mean, (4, 1))
    return fmu.sample(density, "mh", **STEPS, init=start, checkpoint=Checkpoint(directory, draws=10))


@pytest.fixture
def kept(stopped, tmp_path):
    """A copy of it, to be damaged."""
    return shutil.copytree(stopped[0], tmp_path / "kept")


def read(directory):
    return RunReader(directory).read()


def test_a_stopped_run(stopped):
    directory, trace = stopped
    reading = read(directory)
    assert (reading.state, reading.is_of_command, reading.notes) == ("stopped", False, ())
    (sampler,) = reading.samplers
    assert (sampler.name, sampler.state) == ("mh", "stopped")
    assert [group.group for group in sampler.groups] == ["1/2", "2/2"]
    at, draws = sampler.together, parameter_draws(trace)
    assert (at.phase, at.done, at.total) == ("draws", draws.shape[1], 60)
    live = live_diagnostics(draws)
    assert (at.rhat, at.ess) == (live["rhat"], live["ess"])
    assert at.solves == sum(group.solves for group in sampler.groups) > 0
    assert at.remaining_s > 0
    assert at.solves_per_s > 0
    assert 0 <= at.kept_s < 600


def test_it_goes_on_and_ends(kept):
    reader = RunReader(kept)
    assert reader.read().state == "stopped"
    trace = sampled(kept)
    stats = [trace[group] for group in ("warmup_sample_stats", "sample_stats")]
    for _ in range(2):  # what was read before is remembered
        (sampler,) = reader.read().samplers
        assert (sampler.state, sampler.together.done, sampler.together.remaining_s) == ("finished", 60, 0.0)
        assert sampler.together.solves == sum(int(one["n_solves"].sum()) for one in stats)
        assert sampler.together.failed == sum(int(one["n_nonfinite"].sum()) for one in stats) > 0
        assert sampler.together.accept == pytest.approx(float(stats[1]["accepted"].mean()))
        assert sampler.together.ess == live_diagnostics(parameter_draws(trace))["ess"]


def test_who_is_at_work(kept, monkeypatch):
    announce(kept)
    at_work = present(kept)
    assert (at_work.pid, at_work.host, at_work.is_alive()) == (os.getpid(), socket.gethostname(), True)
    assert read(kept).state == "running"
    leave(kept)
    assert present(kept) is None
    assert read(kept).state == "stopped"


def test_a_killed_process(kept):
    announce(kept)
    note = json.loads((kept / FILE).read_text())
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    (kept / FILE).write_text(json.dumps({**note, "pid": ended.pid}))
    assert read(kept).state == "killed"
    (kept / FILE).write_text(json.dumps({**note, "birth": f"{note['birth']}0"}))
    assert read(kept).state == "killed"  # its number is another process's now


def test_on_another_machine_files_tell(kept):
    announce(kept)
    note = json.loads((kept / FILE).read_text())
    (kept / FILE).write_text(json.dumps({**note, "host": "elsewhere"}))
    assert read(kept).state == "running"
    for path in kept.rglob("*"):
        before = path.stat().st_mtime - SILENT_S - 1.0
        os.utime(path, (before, before))
    assert read(kept).state == "silent"


def test_nothing_is_touched(kept):
    def look():
        return {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in (kept, *kept.rglob("*"))}

    before = look()
    read(kept)
    assert look() == before


def test_a_damaged_state(kept):
    *_, last = sorted((kept / "group-1").glob("state-*"))
    whole = read(kept).samplers[0].groups[0]
    last.write_bytes(last.read_bytes()[:-7])
    reading = read(kept)
    assert reading.samplers[0].groups[0].done < whole.done
    assert reading.notes == (f"group-1/{last.name} is damaged: its checksum is wrong",)


def test_states_of_an_earlier_version(kept):
    for state in kept.glob("group-1/state-*"):
        state.write_bytes(state.read_bytes().replace(b"fmu state 3", b"fmu state 2", 1))
    reading = read(kept)
    assert [group.done > 0 for group in reading.samplers[0].groups] == [False, True]
    (note,) = reading.notes
    assert f"{state.parent}" in note
    assert "was written by an earlier version of fmu" in note


def test_damaged_draws(kept):
    *_, last = sorted((kept / "group-2").glob("steps-*"))
    last.write_bytes(b"")
    reading = read(kept)
    at = reading.samplers[0].together
    assert at.done > 0
    assert np.isnan(at.rhat)
    assert reading.notes == (f"group-2 is damaged: the checksum of {last.name} is wrong",)


def test_whatever_is_damaged_there_is_an_answer(stopped, tmp_path):
    names = [path.relative_to(stopped[0]) for path in stopped[0].rglob("*") if path.is_file()]
    for k, name in enumerate(names):
        for j, spoil in enumerate((lambda b: b[: len(b) // 2], lambda b: b"\xff" * len(b))):
            directory = shutil.copytree(stopped[0], tmp_path / f"{k}-{j}")
            (directory / name).write_bytes(spoil((directory / name).read_bytes()))
            assert read(directory).state == "stopped"


@pytest.mark.parametrize("note", ["", "[]", "{}", '{"host": 1, "pid": "x"}', "\0"])
def test_a_damaged_note(kept, note):
    (kept / FILE).write_text(note)
    assert read(kept).state == "stopped"


def test_no_run(tmp_path):
    (tmp_path / "notes.txt").touch()
    with pytest.raises(ValueError, match=r"directory: must be the directory of a run \(got "):
        read(tmp_path)


def test_a_run_that_begins(tmp_path):
    """Its directory is there before it has said who it is."""
    lock = tmp_path / "checkpoints" / "lock"
    lock.parent.mkdir()
    lock.touch()
    assert read(tmp_path).state == "running"
    os.utime(lock.parent, (1.0, 1.0))
    assert read(tmp_path).state == "stopped"
