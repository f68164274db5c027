"""Runs in processes of their own that are killed, stopped, watched, and run out of disk."""

import multiprocessing
import os
import signal
import subprocess
import time
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing.connection import Connection

import numpy as np
import pytest

from fmu.durable_files import digest
from fmu.runs.content import numbered_files, read_state
from tests.runs.watched import DRAWS, STEPS, Watched, main, sampled

posix = pytest.mark.skipif(os.name != "posix", reason="signals and limits of POSIX")
pytestmark = posix


@pytest.fixture(scope="module")
def whole():
    return sampled(None)


@pytest.fixture(scope="module")
def context():
    """Starts processes from one that has imported everything."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.runs.warm"])
    return context


@pytest.fixture
def started(context):
    """Start a run in another process, which is there no longer afterwards."""

    @contextmanager
    def starting(directory, *arguments):
        with ExitStack() as stack:
            (out, to_out), (err, to_err) = os.pipe(), os.pipe()
            with Connection(to_out, readable=False) as output, Connection(to_err, readable=False) as errors:
                process = context.Process(target=main, args=(output, errors, directory, *arguments))
                process.start()
            process.stdout, process.stderr = (stack.enter_context(os.fdopen(end)) for end in (out, err))
            try:
                yield process
            finally:
                process.kill()
                process.join()

    return starting


def wait_for(line, process):
    for found in process.stdout:
        if found.strip() == line:
            return
    pytest.fail(f"no {line!r}: {process.stderr.read()}")


def said_at_last(process):
    """What it still says when it has ended, on standard output and standard error."""
    process.join(30)
    assert process.exitcode == 0
    return process.stdout.read(), process.stderr.read()


def gone_on(directory, whole):
    """Go on to the end, demand that it is bitwise what it would have been, and return the first step drawn."""
    steps = []
    trace = sampled(directory, progress=lambda phase, done, *_: steps.append((phase, done)))
    for group in ("posterior", "warmup_posterior", "sample_stats", "warmup_sample_stats"):
        assert trace[group].identical(whole[group])
    assert trace.attrs["n_solves"] == whole.attrs["n_solves"]
    assert trace.attrs["complete"] == 1
    return next((step for step in steps if step[0] != "search"), None)  # which is reported where it takes long


def test_killed(tmp_path, whole, started):
    """Nobody else is let in before, everybody at once afterwards."""
    with started(tmp_path, DRAWS, "draws", 25) as process:
        wait_for("draws 25", process)
        with pytest.raises(ValueError, match=rf"^checkpoint: another run is running in {tmp_path}$"):
            sampled(tmp_path)
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        assert gone_on(tmp_path, whole) == ("draws", 21)


def test_watched_from_outside(tmp_path, whole, started):
    """Whatever is read while it is written is whole; and who is refused does no harm."""
    group, seen = tmp_path / "group-1", set()
    with started(tmp_path, DRAWS) as process:
        wait_for("warmup 1", process)
        with pytest.raises(ValueError, match="another run is running"):
            sampled(tmp_path)
        while process.is_alive():
            for number, path in numbered_files(group, "state"):
                with suppress(FileNotFoundError):  # replaced meanwhile by a later one
                    state = read_state(path)
                    seen.add(number)
                    for segment in state.segments:
                        assert digest((group / segment.name).read_bytes()) == segment.sha256
        assert process.stdout.read().endswith("complete\n")
    assert len(seen) > 3
    assert gone_on(tmp_path, whole) is None


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_asked_to_stop(tmp_path, whole, started, number):
    with started(tmp_path, 2000) as process:
        wait_for("draws 25", process)
        os.kill(process.pid, number)
        said, complaints = said_at_last(process)
        *steps, last = said.splitlines()
    drawn = int(steps[-1].split()[1]) if steps else 25  # as has been waited for
    assert last == f"stopped after {drawn} of 2000 draws, {drawn} in the trace"
    assert complaints == "Stopping after the current step; interrupt again to stop at once.\n"
    first = gone_on(tmp_path, whole)
    assert first == (None if drawn >= DRAWS else ("draws", drawn + 1))


def test_asked_twice_it_stops_at_once(tmp_path, whole, started):
    with started(tmp_path, DRAWS, "warmup", 15) as process:
        wait_for("warmup 15", process)
        time.sleep(1.0)  # until it is in the step that takes for ever, not before it, where one signal is enough
        os.kill(process.pid, signal.SIGINT)
        assert process.stderr.readline().startswith("Stopping after the current step")
        began = time.monotonic()
        os.kill(process.pid, signal.SIGINT)
        said, complaints = said_at_last(process)
        assert time.monotonic() - began < 10.0
    assert said == "stopped in warm-up, None in the trace\n"
    assert complaints == ""
    # of the step that takes for ever nothing is left, nor of those before it in the same part
    assert gone_on(tmp_path, whole)[0] == "warmup"


def test_a_file_that_is_too_large(tmp_path, whole, started):
    with started(tmp_path, DRAWS, "draws", 25, True) as process:
        said, _ = said_at_last(process)
    assert said.splitlines()[-1] == (
        f"OSError checkpoint: cannot write to {tmp_path} (File too large); everything before draws step 21 of "
        "group 1 is saved there"
    )
    assert not list(tmp_path.rglob("*.part"))
    assert gone_on(tmp_path, whole) == ("draws", 21)


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 96 kB, and what gives it other options."""

    def mount(*options):
        return subprocess.run(["mount", *options, os.fspath(tmp_path)], capture_output=True).returncode

    if os.geteuid() != 0 or mount("-t", "tmpfs", "-o", "size=96k", "tmpfs"):
        pytest.skip("may not mount file systems")
    yield tmp_path, mount
    subprocess.run(["umount", os.fspath(tmp_path)], check=True)


def test_a_full_disk(small_disk, whole):
    directory, mount = small_disk
    with pytest.raises(
        OSError, match=rf"^checkpoint: cannot write to {directory} \(No space left on device\); everything "
    ):
        sampled(directory)
    assert not list(directory.rglob("*.part"))
    assert mount("-o", "remount,size=10M") == 0
    phase, first = gone_on(directory, whole)
    assert first % STEPS == 1
    assert (phase, first) != ("warmup", 1)


def test_a_disk_that_may_only_be_read(small_disk, whole):
    directory, mount = small_disk
    assert mount("-o", "remount,size=10M") == 0
    assert gone_on(directory, whole) == ("warmup", 1)
    assert mount("-o", "remount,ro") == 0
    for path in (directory, directory / "new"):
        with pytest.raises(OSError, match="Read-only file system"):
            sampled(path)


def test_the_watched_density_fails_now_and_then(whole):
    failed = int(whole["sample_stats"]["n_nonfinite"].sum())
    assert 0 < failed < whole.attrs["n_solves"]
    assert np.isneginf(Watched().log_prob(Watched().mean[None] + 1.0)).all()
