"""A Dask cluster: workers that die lose nothing, and what cannot work is a one-line error."""

import os
import signal
import socket
import sys
import time

import engine_tasks
import numpy as np
import pytest

import fmu
from fmu.engines import engine
from fmu.engines.base import LostTaskError
from fmu.fem.reduced.reduced_structure import train
from tests.fem.reduced.test_training_in_workers import assert_states_equal, chain, paired
from tests.sampling.test_workers import SETTINGS, LinearProblem, assert_same

pytest.importorskip("distributed")

deaths_in_a_row = pytest.mark.validate
"""Needs minutes, and that Dask replaces every process: under load it may not."""


@pytest.fixture(scope="module")
def cluster(dask_processes):
    with engine(cluster=dask_processes.scheduler_address) as cluster:
        yield cluster


@pytest.fixture
def own_processes(local_cluster):
    """Two processes for one test that kills them: Dask may lose a process for good that dies as it starts."""
    with local_cluster(2) as processes:
        yield processes


@pytest.fixture
def own_cluster(own_processes):
    with engine(cluster=own_processes.scheduler_address) as cluster:
        yield cluster


def running(processes):
    """Return the two process ids when both have started."""
    until = time.monotonic() + 60.0
    while time.monotonic() < until:
        started = [
            n.process for n in processes.workers.values() if n.is_alive() and n.process.status.name == "running"
        ]
        if len(started) == 2 == len(processes.scheduler.workers):
            return [process.pid for process in started]
        time.sleep(0.05)
    raise TimeoutError("the processes did not start")


def test_workers_are_processes_of_one_thread(cluster):
    assert cluster.workers == 2
    pids = set(cluster.run_tasks(engine_tasks.process_id, None, [0.05] * 20))
    assert len(pids) == 2
    assert os.getpid() not in pids
    for _, threads in cluster.run_tasks(engine_tasks.threads, None, [0, 0]):
        assert set(threads) == {1}


def test_what_is_shared_is_sent_once(cluster, tmp_path):
    shared = engine_tasks.Counted(tmp_path / "arrivals")
    for _ in range(2):
        cluster.run_tasks(engine_tasks.process_id, shared, [0.05] * 10)
    assert len((tmp_path / "arrivals").read_text()) == 2


def test_large_tasks_are_sent_without_a_warning(cluster):
    """Dask warns of tasks of more than 10 MB, as the states of large groups of chains are."""
    assert cluster.run_tasks(engine_tasks.length, None, [b"x" * 11_000_000]) == [11_000_000]


@deaths_in_a_row
def test_workers_that_die_between_calls_are_replaced(own_cluster, own_processes):
    """Sending what tasks share does not wait for a worker that has died."""
    for shared in (10, 20):
        for pid in running(own_processes):
            os.kill(pid, signal.SIGKILL)
        assert own_cluster.run_tasks(engine_tasks.add, shared, [1, 2, 3]) == [shared + 1, shared + 2, shared + 3]


@deaths_in_a_row
def test_a_task_that_kills_three_workers_is_given_up(own_cluster, tmp_path):
    with pytest.raises(LostTaskError, match="task 1: its worker died 3 times in a row") as error:
        own_cluster.run_tasks(engine_tasks.die_often, str(tmp_path), ["a", "lethal"])
    assert error.value.sequence == 1
    assert (tmp_path / "tries-lethal").read_text() == "xxx"
    assert own_cluster.run_tasks(engine_tasks.square, None, [2, 3]) == [4, 9]


def test_the_error_of_one_task_abandons_the_others(cluster, tmp_path):
    """A task that is running is not waited for, and one that is waiting never starts."""
    with pytest.raises(ValueError, match="must be long"):
        cluster.run_tasks(engine_tasks.wait_or_fail, str(tmp_path), ["wait", "fail", "never"])
    assert not (tmp_path / "ended-wait").exists()
    (tmp_path / "go").touch()
    engine_tasks.wait_for(tmp_path / "ended-wait")
    assert cluster.run_tasks(engine_tasks.square, None, [2, 3]) == [4, 9]
    assert not (tmp_path / "ended-never").exists()


def test_two_engines_on_one_cluster(cluster):
    """What the workers keep for one engine does not reach the other."""
    seen = []
    with engine(cluster=cluster.address) as another:
        assert another.workers == 2
        results = another.run_tasks(
            engine_tasks.square, None, [1, 2, 3], report=lambda *message: seen.append(message)
        )
    assert results == [1, 4, 9]
    assert sorted(message[3]["run"] for message in seen) == ["1", "2", "3"]
    assert cluster.run_tasks(engine_tasks.square, None, [4]) == [16]


@deaths_in_a_row
def test_what_was_lost_with_the_only_worker_is_sent_again(local_cluster, tmp_path):
    with local_cluster(1) as processes, engine(cluster=processes.scheduler_address) as cluster:
        assert cluster.run_tasks(engine_tasks.die_once, str(tmp_path), ["mortal", "a"]) == ["mortal", "a"]
        with pytest.raises(LostTaskError, match="task 0"):
            cluster.run_tasks(engine_tasks.die_often, str(tmp_path), ["lethal"])
    assert (tmp_path / "tries-lethal").read_text() == "xxx"


@pytest.mark.parametrize("address", ["here", "local:2", "tcp://host", "http://host:80"])
def test_addresses_of_a_wrong_form(address):
    with pytest.raises(ValueError, match=r"--cluster: must be tcp://host:port \(got"):
        engine(cluster=address)


@pytest.mark.parametrize("listens", [False, True])
def test_an_address_that_does_not_answer(listens, capfd):
    from fmu.engines.dask_cluster import DaskCluster

    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        if listens:
            silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(ValueError, match=f"--cluster: no scheduler answers .got {address}.") as error:
            DaskCluster(address, answer_s=0.5)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_without_the_package(monkeypatch):
    monkeypatch.delitem(sys.modules, "fmu.engines.dask_cluster", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match=r"--cluster: needs the package distributed: pip install 'fmu\[dist"):
        engine(cluster="tcp://head:8786")


def test_a_large_structure_is_trained_and_solved_the_same(cluster):
    found = []
    for at in (None, cluster):
        structure, lower, upper = paired(chain())
        with structure.spread_over(at):
            model, state = train(structure, lower, upper, 1e-3)
            found.append(
                (state, model.confirmed_modes(np.stack([lower, upper, 0.5 * (lower + upper)])).eigenvalues)
            )
    assert_states_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])


def test_a_task_whose_worker_was_killed_is_done_again(dask_processes, tmp_path):
    """The last, as it kills a process of the cluster of the others."""
    running(dask_processes)
    given = ["a", "mortal", "b", "c", "d"]
    with engine(cluster=dask_processes.scheduler_address) as cluster:
        assert cluster.run_tasks(engine_tasks.die_once, str(tmp_path), given) == given


@pytest.mark.validate
def test_a_run_whose_worker_was_killed_draws_the_same(dask_processes, tmp_path):
    running(dask_processes)
    settings = SETTINGS | {"chains": 4, "groups": 4}
    alone = fmu.sample(LinearProblem(), "hmc", **settings)
    address = dask_processes.scheduler_address
    trace = fmu.sample(LinearProblem(tmp_path / "died"), "hmc", workers=address, **settings)
    assert (tmp_path / "died").exists()
    assert_same(trace, alone)
