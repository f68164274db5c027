"""A Dask cluster: workers that die take nothing with them, and what cannot work is said in one line."""

import os
import signal
import socket
import sys
import time

import engine_tasks
import pytest

import fmu
from fmu.engines.engine import LostTaskError, engine
from tests.test_workers import SETTINGS, LinearProblem, assert_same

pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster():
    with engine(cluster="local:2") as cluster:
        yield cluster


@pytest.fixture(scope="module")
def mortal():
    """A cluster whose workers are killed: Dask may not replace one that is killed while it starts."""
    with engine(cluster="local:2") as cluster:
        yield cluster


def test_workers_are_processes_of_one_thread(cluster):
    assert cluster.workers == 2
    pids = set(cluster.lines(engine_tasks.process_id, None, [0.05] * 20))
    assert len(pids) == 2
    assert os.getpid() not in pids
    for interrupt, threads in cluster.lines(engine_tasks.threads, None, [0, 0]):
        assert interrupt == signal.SIG_IGN
        assert set(threads) == {1}


def test_what_is_shared_is_sent_once(cluster, tmp_path):
    shared = engine_tasks.Counted(tmp_path / "arrivals")
    for _ in range(2):
        cluster.lines(engine_tasks.process_id, shared, [0.05] * 10)
    assert len((tmp_path / "arrivals").read_text()) == 2


def test_a_task_whose_worker_was_killed_is_done_again(mortal, tmp_path):
    given = ["a", "mortal", "b", "c", "d"]
    assert mortal.lines(engine_tasks.die_once, str(tmp_path), given) == given


def test_a_run_whose_worker_was_killed_draws_the_same(mortal, tmp_path):
    alone = fmu.sample(LinearProblem(), "hmc", **SETTINGS)
    address = mortal._client.scheduler.address
    trace = fmu.sample(LinearProblem(tmp_path / "died"), "hmc", workers=address, **SETTINGS)
    assert (tmp_path / "died").exists()
    assert_same(trace, alone)


def test_workers_that_die_between_calls_are_replaced(mortal):
    """Nobody waits for a worker that cannot answer any more, to be told what the next tasks share."""
    for shared in (10, 20):
        for nanny in mortal._processes.workers.values():
            os.kill(nanny.pid, signal.SIGKILL)
        assert mortal.lines(engine_tasks.add, shared, [1, 2, 3]) == [shared + 1, shared + 2, shared + 3]


def test_a_task_that_kills_three_workers_is_given_up(mortal, tmp_path):
    with pytest.raises(LostTaskError, match="task 1: its worker died 3 times in a row") as error:
        mortal.lines(engine_tasks.die_often, str(tmp_path), ["a", "lethal"])
    assert error.value.line == 1
    assert (tmp_path / "tries-lethal").read_text() == "xxx"
    assert mortal.lines(engine_tasks.square, None, [2, 3]) == [4, 9]


def test_the_error_of_one_task_stops_the_others(cluster, tmp_path):
    with pytest.raises(ValueError, match="must be long"):
        cluster.lines(engine_tasks.beat, str(tmp_path), ["beat", "fail"])
    assert cluster.lines(engine_tasks.square, None, [2, 3]) == [4, 9]
    before = (tmp_path / "beat").read_text()
    time.sleep(0.1)
    assert (tmp_path / "beat").read_text() == before


def test_a_cluster_that_is_there_already(cluster, tmp_path):
    """It has one user more for a while; what the workers of one kept is no business of the other."""
    address = cluster._client.scheduler.address
    cluster._client.wait_for_workers(2, timeout=30)
    seen = []
    with engine(cluster=address) as another:
        assert another.workers == 2
        results = another.lines(engine_tasks.square, None, [1, 2, 3], report=lambda *message: seen.append(message))
    assert results == [1, 4, 9]
    assert sorted(message[3]["run"] for message in seen) == ["1", "2", "3"]
    assert cluster.lines(engine_tasks.square, None, [4]) == [16]


def test_what_was_lost_with_the_last_worker_is_sent_again(tmp_path):
    with engine(cluster="local:1") as cluster:
        assert cluster.lines(engine_tasks.die_once, str(tmp_path), ["mortal", "a"]) == ["mortal", "a"]
        with pytest.raises(LostTaskError, match="task 0"):
            cluster.lines(engine_tasks.die_often, str(tmp_path), ["lethal"])
    assert (tmp_path / "tries-lethal").read_text() == "xxx"


@pytest.mark.parametrize("cluster", ["here", "local:0", "local:two", "tcp://host", "http://host:80"])
def test_what_a_cluster_is_called(cluster):
    with pytest.raises(ValueError, match=r"--cluster: must be tcp://host:port or local:N \(got"):
        engine(cluster=cluster)


@pytest.mark.parametrize("listens", [False, True])
def test_an_address_that_does_not_answer(listens, monkeypatch, capfd):
    monkeypatch.setattr("fmu.engines.dask_cluster._ANSWER_S", 0.5)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        if listens:
            silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(ValueError, match=f"--cluster: no scheduler answers .got {address}.") as error:
            engine(cluster=address)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_without_the_package(monkeypatch):
    monkeypatch.delitem(sys.modules, "fmu.engines.dask_cluster", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"--cluster: needs the package distributed: pip install 'fmu\[dist"):
        engine(cluster="local:2")
