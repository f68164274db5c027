"""What every engine promises: order, lines, errors, and no difference to having done it here."""

import engine_tasks
import numpy as np
import pytest

from fmu.engines import default_workers, engine
from fmu.engines.base import InProcess


@pytest.fixture(scope="module", params=["in process", "processes", "cluster"])
def any_engine(request):
    arguments = {"in process": {}, "processes": {"workers": 2}}.get(request.param)
    if arguments is None:
        arguments = {"cluster": request.getfixturevalue("dask_processes").scheduler_address}
    with engine(**arguments) as any_engine:
        yield any_engine


def test_results_come_in_the_order_of_the_tasks(any_engine):
    seen = []
    assert any_engine.run_tasks(
        engine_tasks.square, None, [3, 1, 2], report=lambda *message: seen.append(message)
    ) == [9, 1, 4]
    assert sorted(seen, key=lambda message: message[3]["run"]) == [
        ("squares", 1, 1, {"run": k, "size": 0.5}) for k in "123"
    ]


def test_no_tasks_no_results(any_engine):
    assert any_engine.run_tasks(engine_tasks.square, None, []) == []


def test_work_reports_only_if_somebody_listens(any_engine):
    assert any_engine.run_tasks(engine_tasks.listens, None, [0, 0]) == [False, False]
    assert any_engine.run_tasks(engine_tasks.listens, None, [0], report=lambda *_: None) == [True]


def test_a_line_goes_on_as_long_as_something_follows(any_engine):
    """1, 2, 4 … until a limit; the lines are of different lengths, and each is followed in order."""
    limits, seen = [4, 100, 1, 30], {i: [] for i in range(4)}

    def follow(i, result):
        seen[i].append(result)
        return result if result < limits[i] else None

    assert any_engine.run_tasks(engine_tasks.add, np.float64(1.0), [0, 10, 0, 20], follow) == [4, 100, 1, 30]
    assert seen[0] == [1, 2, 3, 4]
    assert seen[1] == list(range(11, 101))


def test_what_is_shared_may_change_from_call_to_call(any_engine):
    shared = np.arange(3.0)
    for _ in range(2):
        np.testing.assert_array_equal(any_engine.run_tasks(engine_tasks.add, shared, [1.0])[0], [1, 2, 3])
    assert any_engine.run_tasks(engine_tasks.add, 5, [1, 2, 3]) == [6, 7, 8]


def test_the_error_of_a_task_is_the_error_of_the_whole(any_engine):
    with pytest.raises(ValueError, match="must not be negative"):
        any_engine.run_tasks(engine_tasks.square, None, [-1, 2])
    assert any_engine.run_tasks(engine_tasks.square, None, [4, 5]) == [16, 25]


def test_an_error_of_what_follows_is_an_error_too(any_engine):
    def follow(i, result):
        raise KeyError(result)

    with pytest.raises(KeyError, match="9"):
        any_engine.run_tasks(engine_tasks.square, None, [3], follow)


def test_work_started_from_what_follows_is_done(any_engine):
    found = []

    def follow(i, result):
        found.append(any_engine.run_tasks(engine_tasks.add, 100, [result]))

    any_engine.run_tasks(engine_tasks.add, 1, [1, 2], follow)
    assert sorted(found) == [[102], [103]]


def test_functions_that_cannot_be_imported_travel(any_engine):
    factor = 3
    assert any_engine.run_tasks(lambda shared, task, report: factor * shared * task, 2, [1, 2]) == [6, 12]


@pytest.mark.parametrize(
    ("arguments", "rule"), [({"workers": 0}, "workers: must be a whole number of at least 1")]
)
def test_arguments(arguments, rule):
    with pytest.raises(ValueError, match=rule):
        engine(**arguments)


def test_default_number_of_workers():
    assert default_workers() >= 1


def test_lines_take_turns_in_process():
    order = []

    def follow(i, result):
        order.append(i)
        return 0 if order.count(i) < 3 - i else None

    InProcess().run_tasks(engine_tasks.add, 0, [0, 0, 0], follow)
    assert order == [0, 1, 2, 0, 1, 0]
