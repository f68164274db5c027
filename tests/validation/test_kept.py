"""Units of a study: kept, continued, counted, and none begun when the budget is spent."""

from dataclasses import dataclass

import numpy as np
import pytest

from tests.validation.kept import Units, fields_of


@dataclass(frozen=True)
class Run:
    number: int
    draws: np.ndarray


def make(number):
    return Run(number, np.full(2, number / 3.0))


def test_units_go_on_from_what_is_kept(tmp_path, capsys):
    read = fields_of(Run, np.array)
    some = Units(tmp_path).completed("runs", ((("a", n), n) for n in range(2)), make, read)
    with (tmp_path / "runs.jsonl").open("a") as file:
        file.write('{"key": ["a", 2], "resu')  # cut short by a kill
    calls = []
    again = Units(tmp_path)
    every = again.completed("runs", ((("a", n), n) for n in range(3)), lambda n: calls.append(n) or make(n), read)
    assert calls == [2]
    assert [run.number for run in every] == [0, 1, 2]
    assert all(np.array_equal(run.draws, make(run.number).draws) for run in (*some, *every))
    assert again.counts == "3 of 3 runs"
    assert "3 of 3 runs (0.0 min): ('a', 2)" in capsys.readouterr().out


def test_no_unit_is_begun_when_the_budget_is_spent(tmp_path):
    units = Units(tmp_path, minutes=1.0)
    units.wall_s = 61.0
    assert units.completed("runs", ((n, n) for n in range(3)), make, least=0) == []
    assert units.counts == "0 of 3 runs"
    assert units.completed("squares", ((n, n) for n in range(3)), lambda n: n**2, least=2) == [0, 1]
    units.wall_s = 59.0
    assert len(units.completed("runs", ((n, n) for n in range(3)), lambda n: n)) == 3


def test_results_without_a_directory_are_as_those_with_one(tmp_path):
    jobs = [(n, n) for n in range(2)]
    kept, not_kept = (Units(of).completed("tuples", jobs, lambda n: (n, [n])) for of in (tmp_path, None))
    assert kept == not_kept == [[0, [0]], [1, [1]]]


def test_jobs_side_by_side_give_the_same(tmp_path):
    jobs = [(n, n) for n in range(5)]
    together = Units(tmp_path).completed("squares", jobs, lambda n: n**2, at_once=2)
    assert together == Units().completed("squares", jobs, lambda n: n**2) == [0, 1, 4, 9, 16]
    assert Units(tmp_path).completed("squares", jobs, None) == together


def test_processor_time_is_that_of_all_units(tmp_path):
    one = Units(tmp_path)
    one.completed("runs", [(1, 1)], lambda n: sum(range(300_000)))
    two = Units(tmp_path)
    assert two.processor_s == pytest.approx(one.processor_s)
    assert two.wall_s == pytest.approx(one.wall_s)
