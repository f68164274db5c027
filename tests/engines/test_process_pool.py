"""Processes: they are quick to stop, replaced when they die, and none outlives its use."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import engine_tasks
import pytest

from fmu.engines import engine
from fmu.engines.base import LostTaskError


@pytest.fixture(scope="module")
def pool():
    with engine(workers=2) as pool:
        yield pool


def pids(pool):
    return set(pool.run_tasks(engine_tasks.process_id, None, [0.01] * 20))


def is_still(path):
    """Say whether nothing writes to a file any more."""
    before = path.read_text()
    time.sleep(0.1)
    return path.read_text() == before


def test_workers_stay_and_what_is_shared_is_sent_once(pool, tmp_path):
    shared = engine_tasks.Counted(tmp_path / "arrivals")
    first = set(pool.run_tasks(engine_tasks.process_id, shared, [0.01] * 20))
    assert set(pool.run_tasks(engine_tasks.process_id, shared, [0.01] * 20)) == first
    assert len((tmp_path / "arrivals").read_text()) == len(first) == 2
    assert os.getpid() not in first


def test_workers_ignore_interrupts_and_have_one_thread(pool):
    for ignores_interrupts, threads in pool.run_tasks(engine_tasks.threads, None, [0, 0]):
        assert ignores_interrupts
        assert set(threads) == {1}


def test_where_an_error_was_raised_is_its_cause(pool):
    with pytest.raises(ValueError, match="negative") as error:
        pool.run_tasks(engine_tasks.square, None, [-1])
    assert "engine_tasks.py" in str(error.value.__cause__)


def test_an_object_that_cannot_travel_is_refused_in_words(pool):
    with pytest.raises(ValueError, match=r"workers: the problem cannot be sent .*'_thread\.lock' .*workers=1"):
        pool.run_tasks(engine_tasks.process_id, threading.Lock(), [0.01])
    assert pids(pool)


def test_an_error_that_cannot_travel_comes_in_words(pool):
    with pytest.raises(RuntimeError, match="HardToPickleError: no because luck"):
        pool.run_tasks(engine_tasks.fail_oddly, None, [0])


def test_the_error_of_one_task_stops_the_others(pool, tmp_path):
    began = time.monotonic()
    with pytest.raises(ValueError, match="must be long"):
        pool.run_tasks(engine_tasks.beat, str(tmp_path), ["beat", "fail", "never"], report=lambda *_: None)
    assert time.monotonic() - began < 100  # what the long task would take is ten times that
    assert is_still(tmp_path / "beat")
    assert not (tmp_path / "never").exists()


@pytest.fixture
def interrupts():
    """SIGINT raises KeyboardInterrupt, also where the tests run in the background of a shell, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interrupts")
def test_an_interrupt_stops_the_tasks(pool, tmp_path):
    def interrupt():
        engine_tasks.wait_for(tmp_path / "beat")
        signal.raise_signal(signal.SIGINT)  # to the main thread, which waits for results

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        pool.run_tasks(engine_tasks.beat, str(tmp_path), ["beat"])
    assert is_still(tmp_path / "beat")


def test_a_task_whose_worker_was_killed_is_done_again(pool, tmp_path):
    given = ["a", "mortal", "b", "c", "d"]
    assert pool.run_tasks(engine_tasks.die_once, str(tmp_path), given) == given
    assert len(pids(pool)) == 2


def test_a_task_that_kills_three_workers_is_given_up(pool, tmp_path):
    results = {}
    with pytest.raises(LostTaskError, match=r"task 1: its worker died 3 times in a row \(SIGKILL\)") as error:
        pool.run_tasks(engine_tasks.die_often, str(tmp_path), ["a", "lethal", "b"], results.__setitem__)
    assert error.value.sequence == 1
    assert (tmp_path / "tries-lethal").read_text() == "xxx"
    assert pool.run_tasks(engine_tasks.square, None, [2, 3]) == [4, 9]


SCRIPT = """
import sys, time
import fmu
sys.path.insert(0, {tests!r})
import engine_tasks

def three_times(shared, task, report):
    return 3 * task

engine = fmu.engine(workers=2)
print(engine.run_tasks(three_times, None, [1, 2]), flush=True)
engine.run_tasks(engine_tasks.beat, {folder!r}, {tasks!r})
"""


def script(folder, tasks):
    text = SCRIPT.format(tests=str(Path(__file__).parent), folder=str(folder), tasks=tasks)
    (folder / "script.py").write_text(text)
    return subprocess.Popen(
        [sys.executable, str(folder / "script.py")], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_no_worker_outlives_a_program_that_is_killed(tmp_path):
    """Nor does a worker run the program, which has no ``if __name__ == "__main__":``, once more."""
    with script(tmp_path, ["beat"]) as program:
        assert program.stdout.readline() == "[3, 6]\n"
        engine_tasks.wait_for(tmp_path / "beat")
        program.kill()
    until = time.monotonic() + 20.0
    while not is_still(tmp_path / "beat") and time.monotonic() < until:
        pass
    assert is_still(tmp_path / "beat")


def test_a_program_that_closes_nothing_ends(tmp_path):
    with script(tmp_path, []) as program:
        output, errors = program.communicate(timeout=60)
    assert (output, errors, program.returncode) == ("[3, 6]\n", "", 0)
