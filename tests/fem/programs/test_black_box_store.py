"""Answers of a slow function on disk: kept whole, found again, never asked for twice, and told where stale."""

import multiprocessing

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import fmu
from fmu.config.models.python import import_function
from fmu.fem.programs.store import Solve, StoreWarning

SOURCE = """
import time
from pathlib import Path

import numpy as np

here = Path(__file__).parent


def modes(theta):
    with (here / "calls").open("a") as file:
        file.write("x")
    time.sleep({seconds})
    if theta[0] > 5.0:
        raise RuntimeError("no convergence")
    factor, turn = np.loadtxt(here / "data.txt")
    return {{
        "frequencies": [factor * theta[0], 2.0],
        "shapes": [[1.0, theta[1]], [turn, 1.0]],
        "gradient": [[factor, 0.0], [0.0, 0.0]],
    }}


def batch(theta):
    each = [modes(point) for point in theta]
    return {{key: np.array([one[key] for one in each]) for key in each[0]}}
"""
THETA = np.array([[1.0, 3.0], [6.0, 3.0], [1.5, 3.0]])


def written(folder, seconds=0.06, name="modes"):
    (folder / "slow.py").write_text(SOURCE.format(seconds=seconds))
    holding(folder)
    return model_in(folder, name)


def holding(folder, factor=1.0, turn=0.2):
    """Write the data file of the function."""
    np.savetxt(folder / "data.txt", [factor, turn])


def model_in(folder, name="modes"):
    function = import_function(f"slow:{name}", folder)
    return fmu.BlackBoxModel(function, 2, batched=name == "batch", name=name, store=folder / "solves")


def n_calls(folder):
    return len((folder / "calls").read_text()) if (folder / "calls").exists() else 0


def assert_same(answers, others):
    for answer, other in zip(answers, others, strict=True):
        for one, another in zip(answer, other, strict=True):
            assert_array_equal(one, another)


def test_no_answer_is_computed_twice(tmp_path):
    answer, failed, other = written(tmp_path).answers(THETA)
    again, failed_again, other_again = model_in(tmp_path).answers(THETA)
    assert n_calls(tmp_path) == 3
    assert failed is failed_again is None
    assert_same([answer, other], [again, other_again])
    model = model_in(tmp_path)
    assert {(*solve.theta, bool(solve.reason)) for solve in model.solves} == {
        (1.0, 3.0, False), (6.0, 3.0, True), (1.5, 3.0, False)
    }  # fmt: skip
    assert all(solve.seconds >= 0.06 for solve in model.solves)
    model.answers(THETA[1:2])
    assert model.reason_at(THETA[1]) == "RuntimeError: no convergence"


def test_a_batched_function_gets_only_what_is_not_stored(tmp_path):
    model = written(tmp_path, name="batch")
    first = model.answers(THETA[::2])
    assert n_calls(tmp_path) == 2
    assert all(0.06 <= solve.seconds < 0.11 for solve in model.solves)  # each its share of the call
    more = np.array([[2.0, 3.0], *THETA[::2], [2.5, 3.0]])
    found = model_in(tmp_path, "batch").answers(more)
    assert n_calls(tmp_path) == 4
    assert_same(found[1:3], first)
    assert_array_equal([answer.frequencies[0] for answer in found], more[:, 0])
    model_in(tmp_path, "batch").answers(more)
    assert n_calls(tmp_path) == 4


def test_of_a_batch_the_point_that_fails_is_stored_as_failed(tmp_path):
    theta = THETA[[0, 2, 1]]
    answers = written(tmp_path, name="batch").answers(theta)
    calls = n_calls(tmp_path)
    model = model_in(tmp_path, "batch")
    again = model.answers(theta)
    assert n_calls(tmp_path) == calls
    assert answers[2] is again[2] is None
    assert model.reason_at(THETA[1]) == "RuntimeError: no convergence"
    assert_same(answers[:2], again[:2])


def test_a_changed_file_is_another_model(tmp_path):
    written(tmp_path).answers(THETA[:1])
    written(tmp_path, 0.07).answers(THETA[:1])
    assert n_calls(tmp_path) == 2


def test_a_file_that_changes_after_it_was_imported_is_not_what_answers(tmp_path):
    model = written(tmp_path)
    written(tmp_path, 0.07)
    model.answers(THETA[:1])
    assert not list(model_in(tmp_path).solves)


@pytest.mark.parametrize("name", ["modes", "batch"])
def test_a_fast_function_leaves_nothing(tmp_path, name):
    model = written(tmp_path, 0.0, name)
    model.answers(np.array([[1.0, 3.0], [2.0, 3.0]]))
    model.answers(np.array([[1.0, 3.0]]))  # remembered
    assert n_calls(tmp_path) == 2
    assert not list(model.solves)


def test_a_folder_that_cannot_be_written_does_not_stop_the_model(tmp_path):
    model = written(tmp_path)
    (tmp_path / "solves").write_text("in the way")
    with pytest.warns(UserWarning, match="solves cannot be kept"):
        answer = model.answers(np.array([[1.0, 3.0]]))[0]
    assert answer.frequencies.tolist() == [1.0, 2.0]
    model.answers(np.array([[2.0, 3.0]]))
    assert n_calls(tmp_path) == 2


def solve_there(folder, together):
    for name in ("modes", "batch"):
        model = model_in(folder, name)
        together.wait()
        model.answers(THETA[::2])


def test_two_processes_solve_a_theta_once(tmp_path):
    written(tmp_path, 0.2)
    context = multiprocessing.get_context("spawn")
    together = context.Barrier(2, timeout=60.0)
    process = context.Process(target=solve_there, args=(tmp_path, together))
    process.start()
    solve_there(tmp_path, together)
    process.join()
    assert process.exitcode == 0
    assert n_calls(tmp_path) == 4


def test_a_function_without_a_file_has_no_store(tmp_path):
    with pytest.raises(ValueError, match="store: the function must be in a file"):
        fmu.BlackBoxModel(np.sqrt, 2, store=tmp_path)


def test_the_start_is_solved_again_once_and_what_is_stored_is_taken(tmp_path):
    first = written(tmp_path).at(THETA[0])
    holding(tmp_path, 1.0 + 1e-9)
    model = model_in(tmp_path)
    assert_same([first, first], [model.at(THETA[0]), model.at(THETA[0])])
    assert n_calls(tmp_path) == 2
    assert model.at(THETA[2]).frequencies[0] == 1.5 * (1.0 + 1e-9)  # nothing was stored there


def test_the_time_of_a_solve_is_that_of_a_second_call_and_measured_once(tmp_path):
    model = written(tmp_path)
    model.at(THETA[0])
    assert model.seconds_at(THETA[0]) == model.seconds_at(THETA[0]) >= 0.06
    assert n_calls(tmp_path) == 2
    model.at(THETA[2])  # modules are loaded by now
    assert model.seconds_at(THETA[2]) >= 0.06
    assert n_calls(tmp_path) == 3


@pytest.mark.parametrize(
    ("factor", "turn", "said"),
    [
        (1.03, 0.2, r"frequencies that differ by 3 %: \[1\.03, 2\.0\] Hz, and not \[1\.0, 2\.0\]"),
        (np.nan, 0.2, "frequencies that differ"),
        (1.0, 0.5, r"a shape whose MAC with that stored is 0\.93"),
        (1.0, np.nan, "a shape"),
    ],
)
def test_a_changed_data_file_is_noticed_at_the_start(tmp_path, factor, turn, said):
    folder = written(tmp_path).solves.folder
    model_in(tmp_path).at(THETA[0])
    holding(tmp_path, factor, turn)
    model = model_in(tmp_path)
    for _ in range(2):
        with pytest.raises(
            ValueError, match=rf"must give what is stored; at the start \[1\.0, 3\.0\].*{said}"
        ) as told:
            model.at(THETA[0])
    assert f"if a file that it reads was changed, restore it, or delete {folder}" in str(told.value)


def test_scatter_of_the_solver_is_told(tmp_path):
    written(tmp_path).at(THETA[0])
    holding(tmp_path, 1.0003)
    with pytest.warns(StoreWarning, match=r"frequencies differ by 0\.03 % from those stored.*delete"):
        answer = model_in(tmp_path).at(THETA[0])
    assert answer.frequencies[0] == 1.0


def test_close_modes_may_turn_into_each_other(tmp_path):
    store = fmu.SolveStore(tmp_path)
    frequencies, shapes = np.array([1.0, 1.001, 5.0]), np.eye(3)
    turned = shapes @ [[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]
    store.keep(Solve(THETA[0], frequencies, shapes, 1.0))
    store.check(store.find(THETA[0]), frequencies, turned)
    with pytest.raises(ValueError, match="a shape"):
        store.check(store.find(THETA[0]), frequencies, turned[:, [0, 2, 1]])
    with pytest.raises(ValueError, match="arrays of the shapes"):
        store.check(store.find(THETA[0]), frequencies[:2], shapes[:, :2])


def test_rigid_motions_are_not_compared_digit_by_digit(tmp_path):
    store = fmu.SolveStore(tmp_path)
    store.keep(Solve(THETA[0], np.array([1e-5, 3e-5, 4.0]), None, 1.0))
    store.check(store.find(THETA[0]), np.array([0.0, 4e-5, 4.0]), None)


def test_what_failed_at_the_start_may_work_again(tmp_path):
    model = written(tmp_path)
    (tmp_path / "data.txt").unlink()
    with pytest.raises(ValueError, match=r"must work at the start .* FileNotFoundError|not found"):
        model.at(THETA[0])
    assert [bool(solve.reason) for solve in model.solves] == [True]
    holding(tmp_path)
    assert model_in(tmp_path).at(THETA[0]).frequencies[0] == 1.0
    assert [bool(solve.reason) for solve in model.solves] == [False]


def test_the_folder_of_a_store_may_be_text(tmp_path):
    assert list(fmu.SolveStore(str(tmp_path / "none"))) == []
