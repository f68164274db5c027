"""Answers of a slow function on disk: kept whole, found again by anyone, never asked for twice."""

import importlib.util
import multiprocessing

import numpy as np
import pytest

import fmu

SOURCE = """
import time
from pathlib import Path

calls = Path(__file__).with_name("calls")


def modes(theta):
    with calls.open("a") as file:
        file.write("x")
    time.sleep({seconds})
    if theta[0] > 5.0:
        raise RuntimeError("no convergence")
    return {{"frequencies": [theta[0], 2.0], "shapes": [[1.0, theta[1]]], "gradient": [[1.0, 0.0], [0.0, 0.0]]}}
"""


def written(folder, seconds=0.06):
    (folder / "slow.py").write_text(SOURCE.format(seconds=seconds))
    spec = importlib.util.spec_from_file_location("slow", folder / "slow.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return fmu.BlackBoxModel(module.modes, 2, store=folder / "solves")


def n_calls(folder):
    return len((folder / "calls").read_text()) if (folder / "calls").exists() else 0


def test_no_answer_is_computed_twice(tmp_path):
    theta = np.array([[1.0, 3.0], [6.0, 3.0]])
    answer, failed = written(tmp_path).answers(theta)
    again, failed_again = written(tmp_path).answers(theta)
    assert n_calls(tmp_path) == 2
    assert failed is failed_again is None
    for one, other in zip(answer, again, strict=True):
        np.testing.assert_array_equal(one, other)
    model = written(tmp_path)
    assert {(*solve.theta, bool(solve.reason)) for solve in model.solves} == {(1.0, 3.0, False), (6.0, 3.0, True)}
    assert all(solve.seconds >= 0.06 for solve in model.solves)
    model.answers(theta[1:])
    assert model.reason_at(theta[1]) == "RuntimeError: no convergence"


def test_a_changed_file_is_another_model(tmp_path):
    theta = np.array([[1.0, 3.0]])
    written(tmp_path).answers(theta)
    written(tmp_path, 0.07).answers(theta)
    assert n_calls(tmp_path) == 2


def test_a_fast_function_leaves_nothing(tmp_path):
    model = written(tmp_path, 0.0)
    model.answers(np.array([[1.0, 3.0], [2.0, 3.0]]))
    model.answers(np.array([[1.0, 3.0]]))
    assert n_calls(tmp_path) == 3
    assert not list(model.solves)


def test_a_folder_that_cannot_be_written_does_not_stop_the_model(tmp_path):
    model = written(tmp_path)
    (tmp_path / "solves").write_text("in the way")
    with pytest.warns(UserWarning, match="solves cannot be kept"):
        answer = model.answers(np.array([[1.0, 3.0]]))[0]
    assert answer.frequencies.tolist() == [1.0, 2.0]
    model.answers(np.array([[2.0, 3.0]]))
    assert n_calls(tmp_path) == 2


def solve_there(folder):
    written_again = importlib.util.spec_from_file_location("slow", folder / "slow.py")
    module = importlib.util.module_from_spec(written_again)
    written_again.loader.exec_module(module)
    fmu.BlackBoxModel(module.modes, 2, store=folder / "solves").answers(np.array([[1.0, 3.0]]))


def test_two_processes_solve_a_theta_once(tmp_path):
    written(tmp_path, 0.5)
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=solve_there, args=(tmp_path,)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert n_calls(tmp_path) == 1


def test_a_function_without_a_file_has_no_store(tmp_path):
    with pytest.raises(ValueError, match="store: the function must be in a file"):
        fmu.BlackBoxModel(np.sqrt, 2, store=tmp_path)
