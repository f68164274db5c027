"""The command ``fmu predict``, which tests whether new tests agree with the earlier tests in a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fmu.arguments import ArgumentError
from fmu.cli.damage import DIRECTORY, MODEL, SAMPLER
from fmu.cli.messages import DEPARTED
from fmu.config.mistakes import ConfigurationError, Mistakes
from fmu.formats.shown import names_shown
from fmu.numbers import fixed, given, significant
from fmu.tables import text_table, wrap_text

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.posterior.joint.modal_test import Test, TestsError
    from fmu.posterior.problem import UpdatingProblem
    from fmu.runs.predictions import Predictions

_WIDTH = 80
_FOUND = ("p_value", "false_alarms", "departs", "parameter", "or_parameters", "change")


@click.command()
@DIRECTORY
@click.argument("table", metavar="CSV", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--false-alarms", type=click.FloatRange(0.0, 1.0, min_open=True, max_open=True), default=0.01,
              show_default=True, help="Share of the tests without any change that raise an alarm.")  # fmt: skip
@click.option("--like", help="Earlier test whose masses, springs, known parameters and errors the new tests have."
              "  [default: the first one of the group]")  # fmt: skip
@click.option("--draws", type=click.IntRange(min=2), default=4000, show_default=True,
              help="Largest number of draws at which the model is solved.")  # fmt: skip
@SAMPLER
@MODEL
def predict(
    directory: Path,
    table: Path,
    false_alarms: float,
    like: str | None,
    draws: int,
    sampler: str | None,
    model: Path | None,
) -> int:
    """Compare the new tests in CSV with the population of the earlier tests of the run in DIRECTORY.

    CSV has one row per test with its name, group, covariates and frequencies, in the format of a campaign file for
    [[tests]]. A test departs if its p-value is at most --false-alarms. Results are added to
    DIRECTORY/predictions.csv. A test that is already there is not predicted again; it is an error if its data or
    --like differ from those in predictions.csv.

    The exit status is 0 if no new test departs, 3 if one does, 2 if the input is wrong, and 1 if the prediction
    failed.
    """
    from fmu.analysis.next_test import require_next_test
    from fmu.report.export import read_choice, read_problem
    from fmu.runs.predictions import open_predictions
    from fmu.runs.run_directory import folder_of_order

    if folder_of_order(directory) != directory:
        raise ValueError(f"{directory}: must be of a run that has ended; go on with fmu run --resume {directory}")
    name, trace, diagnosis = read_choice(directory, sampler)
    problem = read_problem(directory, trace, model)
    require_next_test(problem)
    labels = list(dict.fromkeys(label for test in problem.tests for label in test.data.labels))
    covariates = list(dict.fromkeys(covariate for test in problem.tests for covariate in test.covariates))
    tests = _read_tests(table, labels, covariates)
    rows = [_row(test, covariates, labels, like) for test in tests.values()]
    populations = [p.name for p in problem.layout.structural if p.name in problem.layout.populations]
    found = [*_FOUND, *(f"score {one}" for one in populations), "draws"]
    draws_of = f"{name} {str(trace.attrs.get('configuration_hash', ''))[:12]}"
    departs = False
    with open_predictions(directory, list(rows[0]), found, draws_of) as predictions:
        numbers = predictions.find_new(rows)
        new = {line: test for i, (line, test) in enumerate(tests.items()) if i in numbers}
        if new:
            answers = _predict(trace, problem, new, table, like, draws, false_alarms)
            cells = [
                {str(column): _text(value) for column, value in answer.items()}
                for answer in answers.to_dict("records")
            ]
            predictions.add([rows[i] | answer for i, answer in zip(numbers, cells, strict=True)])
            _echo_new(answers)
            departs = bool(answers["departs"].any())
    _echo_remarks(problem, list(new.values()), diagnosis)
    _echo_all(predictions, [test.name for test in tests.values() if test not in new.values()])
    return DEPARTED if departs else 0


def _predict(
    trace: xr.DataTree,
    problem: UpdatingProblem,
    tests: Mapping[int, Test],
    table: Path,
    like: str | None,
    draws: int,
    false_alarms: float,
) -> pd.DataFrame:
    """Return the table from `fmu.predict_tests`, with columns ``false_alarms`` and ``departs`` (a bool) added.

    `tests` maps line numbers in the file to tests. Raise ConfigurationError if a test is wrong, and ValueError if
    `false_alarms` is below the smallest p-value that the draws can give.
    """
    from fmu.analysis.next_test import predict_tests
    from fmu.posterior.joint.modal_test import TestsError

    try:
        found = predict_tests(trace, problem, list(tests.values()), like=like, draws=draws)
    except TestsError as error:
        raise _at_lines(error, list(tests), table) from None
    n = int(found["draws"].min())
    least = 1.0 / (1 + n)
    if false_alarms < least:
        raise ValueError(
            f"--false-alarms: must be at least {significant(least, 2)}, the smallest p-value of {n} draws "
            f"(got {given(false_alarms)}); sample more draws, or allow more false alarms"
        )
    found.insert(1, "false_alarms", false_alarms)
    found.insert(2, "departs", found["p_value"] <= false_alarms)
    return found


def _read_tests(table: Path, labels: Sequence[str], covariates: Sequence[str]) -> dict[int, Test]:
    """Return the tests in a table, keyed by line number; raise ConfigurationError if the table is wrong."""
    from fmu.formats.modes.csv import read_campaign
    from fmu.formats.modes.measured_modes import ModesError
    from fmu.posterior.data.modal_data import ModalData
    from fmu.posterior.joint.modal_test import Test

    try:
        campaign = read_campaign(table, labels, covariates)
    except ModesError as error:
        raise ConfigurationError(table.name, [ArgumentError("", one) for one in error.mistakes]) from None
    modes, wrong = ModalData([1.0] * len(labels), labels=tuple(labels)), Mistakes()
    tests: dict[int, Test] = {}
    for name, group, values, frequencies, line in zip(*campaign, strict=True):
        try:
            tests[line] = Test(name, modes.with_frequencies(frequencies), group, values)
        except ValueError as error:
            wrong.add(f"line {line}", str(error))
    if wrong:
        raise ConfigurationError(table.name, wrong)
    return tests


def _row(test: Test, covariates: Sequence[str], labels: Sequence[str], like: str | None) -> dict[str, str]:
    """Return a test's data and --like as table cells, keyed by column. The cell of a missing value is empty."""
    import numpy as np

    frequencies = np.asarray(test.data.frequencies_hz).tolist()
    numbers = {name: test.covariates.get(name) for name in covariates} | dict.fromkeys(labels)
    numbers |= zip(test.data.labels, frequencies, strict=True)
    cells = {name: "" if value is None else repr(value) for name, value in numbers.items()}
    return {"name": test.name, "group": test.group, "like": like or ""} | cells


def _text(value: object) -> str:
    """Return a value as text from which the same value can be read back."""
    text = repr(value) if isinstance(value, float) else str(value)
    return text.lower() if isinstance(value, bool) else text


def _at_lines(error: TestsError, lines: Sequence[int], table: Path) -> ConfigurationError:
    """Convert errors in new tests to errors at their table lines. Identical errors are reported once."""
    found: dict[str, ArgumentError] = {}
    for mistake in error.mistakes:
        where, _, rule = mistake.partition(": ")
        _, number, key = where.split(".", 2)
        place = f"line {lines[int(number)]}, {'--like' if key == 'like' else key}"
        found.setdefault(f"{key}: {rule}", ArgumentError(place, rule))
    return ConfigurationError(table.name, list(found.values()))


def _echo_new(found: pd.DataFrame) -> None:
    """Print a table with one row per new test, and the parameter that explains each departure."""
    header = ["new test", "p", "", "parameter", "change", "or"]
    rows = []
    for name, row in found.iterrows():
        cells = [str(name), significant(row["p_value"], 2)]
        if not row["departs"]:
            rows.append([*cells, "as expected", "", "", ""])
            continue
        change = "" if math.isnan(row["change"]) else f"{fixed(100.0 * row['change'], 1)} %"
        rows.append([*cells, "DEPARTS", row["parameter"], change, row["or_parameters"]])
    click.echo(text_table(header, rows, words=(0, 2, 3, 5), width=_WIDTH))


def _echo_remarks(problem: UpdatingProblem, tests: Sequence[Test], diagnosis: Diagnosis) -> None:
    """Print a warning if new tests are outside the range of a covariate, or if the draws are not reliable."""
    from fmu.posterior.joint.varies.covariates import known_values

    for name in dict.fromkeys(role.where for role in problem.roles if role.kind == "slope"):
        earlier = known_values(name, problem.tests)
        low, high = float(earlier.min()), float(earlier.max())
        given = {test.name: test.known_covariate(name) for test in tests}
        beyond = [test for test, x in given.items() if x is not None and not low <= x <= high]
        if beyond:
            rule = (
                f"{name} is beyond {significant(low)} to {significant(high)}, the range of the earlier tests, in"
            )
            click.echo(wrap_text(f"Warning: {rule} {names_shown(beyond)}.", width=_WIDTH))
    if diagnosis.doubts:
        click.echo(wrap_text(f"Do not rely on p: {' and '.join(diagnosis.doubts)}.", width=_WIDTH))


def _echo_all(predictions: Predictions, before: Sequence[str]) -> None:
    """Print the number of tests that have departed so far, and the number expected by chance.

    `before` lists the tests in the table that were predicted by an earlier command.
    """
    rows = predictions.rows
    departed = [row["name"] for row in rows if row["departs"] == "true"]
    if before:
        again = [name for name in before if name in departed]
        of_them = f"; of them, {names_shown(again)} departed" if again else ""
        click.echo(wrap_text(f"Predicted before: {names_shown(before)}{of_them}.", width=_WIDTH))
    chance = sum(float(row["false_alarms"]) for row in rows)
    click.echo(
        wrap_text(
            f"Tests so far: {len(rows)}, of which {len(departed)} departed; {significant(chance, 2)} would by "
            "chance if nothing had changed. Each test is judged alone: of tests without any change, the share in "
            "its column false_alarms departs.",
            width=_WIDTH,
        )
    )
    click.echo(f"Results: {predictions.path}")
