"""The command ``fmu predict``: whether new tests are what the earlier tests of a run let one expect."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fmu.arguments import ArgumentError
from fmu.cli.damage import DIRECTORY, MODEL, SAMPLER
from fmu.cli.messages import DEPARTED
from fmu.config.mistakes import ConfigurationError
from fmu.formats.shown import names_shown
from fmu.numbers import fixed, names_in_words, significant
from fmu.tables import text_table, wrap_text

if TYPE_CHECKING:
    import pandas as pd

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.formats.modes.csv import Campaign
    from fmu.posterior.joint.modal_test import Test, TestsError
    from fmu.posterior.problem import UpdatingProblem
    from fmu.runs.predictions import Predictions, Row

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

    CSV has a row per test with its name, group, covariates and frequencies, like a table for campaign in
    [[tests]]. A test departs if its p-value is at most --false-alarms. Results are added to
    DIRECTORY/predictions.csv. Tests that are there already are not predicted again.

    The exit status is 0 if no new test departs, 3 if one does, 2 if the input is wrong, and 1 if the prediction
    failed.
    """
    from fmu.analysis.next_test import predict_tests, require_population
    from fmu.formats.modes.csv import read_campaign
    from fmu.formats.modes.measured_modes import ModesError
    from fmu.posterior.joint.modal_test import TestsError
    from fmu.report.export import read_choice, read_problem
    from fmu.runs.predictions import open_predictions
    from fmu.runs.run_directory import folder_of_order

    if folder_of_order(directory) != directory:
        raise ValueError(f"{directory}: must be of a run that has ended; go on with fmu run --resume {directory}")
    name, trace, diagnosis = read_choice(directory, sampler)
    problem = read_problem(directory, trace, model)
    require_population(problem)
    labels = list(dict.fromkeys(label for test in problem.tests for label in test.data.labels))
    known = list(dict.fromkeys(covariate for test in problem.tests for covariate in test.covariates))
    populations = [p.name for p in problem.layout.structural if p.name in problem.layout.populations]
    try:
        campaign = read_campaign(table, labels, known)
    except ModesError as error:
        raise ConfigurationError(table.name, [ArgumentError("", one) for one in error.mistakes]) from None
    tests = _tests(campaign, labels, table)
    measured = [_row(test, known, labels) for test in tests]
    found = [*_FOUND, *(f"score {one}" for one in populations), "draws"]
    draws_of = f"{name} {str(trace.attrs.get('configuration_hash', ''))[:12]}"
    with open_predictions(directory, list(measured[0]), found, draws_of) as predictions:
        new, departs = predictions.find_new(measured), False
        if new:
            try:
                table_of_new = predict_tests(trace, problem, [tests[i] for i in new], like=like, draws=draws)
            except TestsError as error:
                raise _at_lines(error, [campaign.lines[i] for i in new], table) from None
            least = 1.0 / (1 + int(table_of_new["draws"].min()))
            if false_alarms < least:
                raise ValueError(
                    f"--false-alarms: must be at least {significant(least, 2)}, the smallest p-value of "
                    f"{table_of_new['draws'].min()} draws (got {false_alarms:g}); sample more draws, or allow "
                    "more false alarms"
                )
            table_of_new.insert(1, "false_alarms", false_alarms)
            table_of_new.insert(2, "departs", table_of_new["p_value"] <= false_alarms)
            answers = table_of_new.to_dict("records")
            predictions.add(
                [
                    {**measured[i], **{str(column): _text(value) for column, value in answer.items()}}
                    for i, answer in zip(new, answers, strict=True)
                ]
            )
            _echo_new(table_of_new)
            departs = bool(table_of_new["departs"].any())
    _echo_remarks(problem, [tests[i] for i in new], known, diagnosis)
    _echo_all(predictions, [test.name for test in tests], [tests[i].name for i in new], false_alarms)
    return DEPARTED if departs else 0


def _tests(campaign: Campaign, labels: Sequence[str], table: Path) -> list[Test]:
    """Return the list of new tests; ConfigurationError if one has a name that is not allowed."""
    from fmu.posterior.data.modal_data import ModalData
    from fmu.posterior.joint.modal_test import Test

    modes, tests, wrong = ModalData([1.0] * len(labels), labels=tuple(labels)), [], []
    for name, group, covariates, frequencies, line in zip(*campaign, strict=True):
        try:
            tests.append(Test(name, modes.with_frequencies(frequencies), group, covariates))
        except ValueError as error:
            wrong.append(ArgumentError(f"line {line}", str(error)))
    if wrong:
        raise ConfigurationError(table.name, wrong)
    return tests


def _row(test: Test, covariates: Sequence[str], labels: Sequence[str]) -> Row:
    """Return the cells of what was measured in a test, by column."""
    import numpy as np

    frequencies = np.asarray(test.data.frequencies_hz).tolist()
    numbers = {name: test.covariates.get(name) for name in covariates} | dict.fromkeys(labels)
    numbers |= zip(test.data.labels, frequencies, strict=True)
    cells = {name: "" if value is None else repr(value) for name, value in numbers.items()}
    return {"name": test.name, "group": test.group} | cells


def _text(value: object) -> str:
    return (
        repr(value) if isinstance(value, float) else str(value).lower() if isinstance(value, bool) else str(value)
    )


def _at_lines(error: TestsError, lines: Sequence[int], table: Path) -> ConfigurationError:
    """Return the errors of new tests at their lines of the table; of equal errors, the first one."""
    found: dict[str, ArgumentError] = {}
    for mistake in error.mistakes:
        where, _, rule = mistake.partition(": ")
        _, number, key = where.split(".", 2)
        place = f"line {lines[int(number)]}, {'--like' if key == 'like' else key}"
        found.setdefault(f"{key}: {rule}", ArgumentError(place, rule))
    return ConfigurationError(table.name, list(found.values()))


def _echo_new(found: pd.DataFrame) -> None:
    """Print a table with a row per new test, and the parameter of each departure."""
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


def _echo_remarks(
    problem: UpdatingProblem, tests: Sequence[Test], covariates: Sequence[str], diagnosis: Diagnosis
) -> None:
    """Print a warning if covariates are beyond those of the run, and if its draws are not to be relied on."""
    for name in covariates:
        known = [test.covariates[name] for test in problem.tests if name in test.covariates]
        low, high = min(known), max(known)
        beyond = [test for test in tests if not low <= test.covariates.get(name, low) <= high]
        if beyond:
            rule = f"{name} is beyond {low:g} to {high:g}, the range of the earlier tests, in"
            click.echo(wrap_text(f"Warning: {rule} {names_in_words([one.name for one in beyond])}.", width=_WIDTH))
    if diagnosis.doubts:
        click.echo(wrap_text(f"Do not rely on p: {' and '.join(diagnosis.doubts)}.", width=_WIDTH))


def _echo_all(predictions: Predictions, asked: Sequence[str], new: Sequence[str], false_alarms: float) -> None:
    """Print how many tests have departed since the first prediction, and how many would by chance."""
    rows = predictions.rows
    departed = [row["name"] for row in rows if row["departs"] == "true"]
    before = [name for name in asked if name not in new]
    if before:
        again = [name for name in before if name in departed]
        of_them = f"; of them, {names_shown(again)} departed" if again else ""
        click.echo(wrap_text(f"{len(before)} tests had been predicted before{of_them}.", width=_WIDTH))
    chance = sum(float(row["false_alarms"]) for row in rows)
    click.echo(
        wrap_text(
            f"Tests so far: {len(rows)}, of which {len(departed)} departed; {significant(chance, 2)} would by "
            "chance if nothing had changed. Each test is judged alone: of tests without any change, the share "
            f"{false_alarms:g} departs.",
            width=_WIDTH,
        )
    )
    click.echo(f"Results: {predictions.path}")
