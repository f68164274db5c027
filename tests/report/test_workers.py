"""The same results from any number of processes, and errors and progress from all of them."""

import time

import pytest

from fmu.report.paper.workers import default_workers, in_processes


def square(x, progress):
    if progress is not None:
        progress("squares", 1, 1, {"run": str(x)})
    if x < 0:
        raise ValueError(f"x: must not be negative (got {x})")
    return x * x


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_the_order_of_the_tasks(workers):
    seen = []
    tasks = [(3,), (1,), (2,)]
    assert in_processes(square, tasks, workers, lambda *message: seen.append(message)) == [9, 1, 4]
    assert sorted(seen, key=lambda message: message[3]["run"]) == [("squares", 1, 1, {"run": k}) for k in "123"]


@pytest.mark.parametrize("workers", [1, 2])
def test_the_error_of_a_task_is_the_error_of_the_whole(workers):
    with pytest.raises(ValueError, match="must not be negative"):
        in_processes(square, [(-1,), (2,)], workers, None)


def count_slowly(until, progress):
    for step in range(until):
        progress("counting", step, until, {})
        time.sleep(0.01)
    if until < 1000:
        raise ValueError("until: must be long")
    return until


def test_the_error_of_one_task_stops_the_others():
    began = time.monotonic()
    with pytest.raises(ValueError, match="must be long"):
        in_processes(count_slowly, [(100_000,), (3,), (100_000,)], 2, None)
    assert time.monotonic() - began < 100  # what one of the long tasks would take is ten times that


def test_default_number_of_workers():
    assert default_workers() >= 1
