"""``fmu predict``: one command a day, whose results and exit status a scheduler can rely on."""

import csv
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import fmu
import fmu.durable_files
from fmu.cli import main
from fmu.report import export
from fmu.runs.predictions import FILE
from tests.cli.runs import Cut, cut
from tests.config.test_tests_tables import K1, K2, written
from tests.runs.keeping import at_keep
from tests.shear_building import two_frequencies_hz

MODES = np.array([0.003, 0.008])
SHORT = ("--draws", "60", "--warmup", "60", "--no-report")
POPULATION = (
    'varies = "population"\npopulation = { sd = { distribution = "half-normal", sd = 0.02 } }\n'
    'slopes = { temperature = { distribution = "normal", sd = 0.005 } }\n'
)
TESTS = '[[tests]]\ncampaign = "campaign.csv"\nlabels = ["bend", "sway"]\nsd = [0.003, 0.008]\n'
HEADER = "name,temperature,bend,sway\n"


def row(name, rng, factors=(1.0, 1.0), temperature=10.0, missed=None):
    """Return the row of a test of two storeys, whose stiffnesses scatter by 0.5 %."""
    k = 2e6 * (1.0 + 0.005 * rng.standard_normal(2)) * np.array(factors)
    f = two_frequencies_hz(k, (1000.0, 1000.0)) + MODES * rng.standard_normal(2)
    cells = ["" if i == missed else f"{x:.5f}" for i, x in enumerate(f)]
    return ",".join([name, str(temperature), *cells])


def table(path, *rows):
    path.write_text(HEADER + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def invoke(*arguments):
    return CliRunner().invoke(main, list(map(str, arguments)))


def predictions(run):
    with (run / FILE).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module", autouse=True)
def _judged_once():
    """Judge the draws of a run once: every command does so, and the tests are of what it does then."""
    judged, judge = {}, export.compare_runs

    def remembered(traces):
        key = tuple((name, trace.attrs["configuration_hash"]) for name, trace in traces.items())
        if key not in judged:
            judged[key] = judge(traces)
        return judged[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "compare_runs", remembered)
        yield


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    """A run with a population over eight tests, beside its problem file."""
    folder = tmp_path_factory.mktemp("monitored")
    rng = np.random.default_rng(1)
    table(folder / "campaign.csv", *(row(f"t{i}", rng, temperature=5.0 + 2 * i) for i in range(8)))
    path = written(folder, K1 + POPULATION, K2 + POPULATION, TESTS)
    done = invoke("run", path, *SHORT, "--out", folder / "run")
    assert done.exit_code == 0, done.output
    return folder


@pytest.fixture
def run(sampled, tmp_path):
    shutil.copytree(sampled, tmp_path / "monitored")
    return tmp_path / "monitored" / "run"


def two_days(folder):
    """Two days: on the second the lower storey has lost 8 %, and a mode was missed on the first."""
    rng = np.random.default_rng(2)
    return table(folder / "new.csv", row("Monday", rng, missed=1), row("Tuesday", rng, (0.92, 1.0)))


@pytest.fixture
def days(run):
    return two_days(run.parent)


@pytest.fixture(scope="module")
def folder_after_both_days(sampled, tmp_path_factory):
    """The folder of the run after both days."""
    folder = shutil.copytree(sampled, tmp_path_factory.mktemp("predicted") / "monitored")
    assert invoke("predict", folder / "run", two_days(folder)).exit_code == 3
    return folder


@pytest.fixture
def run_after_both_days(folder_after_both_days, tmp_path):
    """The run after both days, and their table."""
    folder = shutil.copytree(folder_after_both_days, tmp_path / "monitored")
    return folder / "run", folder / "new.csv"


def test_a_departure_is_told_and_kept_with_its_parameter(run, days):
    done = invoke("predict", run, days)
    assert done.exit_code == 3, done.output
    monday, tuesday = (line for line in done.stdout.splitlines() if line.startswith(("Monday", "Tuesday")))
    assert "as expected" in monday
    assert "DEPARTS      k1" in tuesday
    assert "Tests so far: 2, of which 1 departed; 0.02 would by chance" in " ".join(done.stdout.split())
    first, second = predictions(run)
    assert (first["name"], first["sway"], first["departs"], second["departs"]) == ("Monday", "", "false", "true")
    assert float(first["p_value"]) > 0.01 >= float(second["p_value"]) >= 1 / (1 + int(second["draws"]))
    assert second["parameter"] == "k1"
    assert float(second["change"]) == pytest.approx(-0.08, abs=0.03)
    problem, trace = fmu.load(run.parent / "building.toml"), fmu.load_trace(run / "gibbs.nc")
    tests = fmu.Test.from_csv(days, ["bend", "sway"])
    assert fmu.predict_tests(trace, problem, tests)["p_value"]["Tuesday"] == float(second["p_value"])


def test_the_next_day_is_added_and_the_earlier_ones_are_not_doubled(run_after_both_days):
    run, days = run_after_both_days
    before = (run / FILE).read_text(encoding="utf-8")
    again = invoke("predict", run, days)
    assert again.exit_code == 0, again.output
    assert "Predicted before: Monday, Tuesday; of them, Tuesday departed." in again.stdout
    assert (run / FILE).read_text(encoding="utf-8") == before
    with days.open("a", encoding="utf-8") as file:
        file.write(row("Wednesday", np.random.default_rng(3)) + "\n")
    third = invoke("predict", run, days)
    assert third.exit_code == 0, third.output
    assert (run / FILE).read_text(encoding="utf-8").startswith(before)
    assert [one["name"] for one in predictions(run)] == ["Monday", "Tuesday", "Wednesday"]


def test_the_same_test_with_other_numbers_is_an_error_that_says_what_to_do(run_after_both_days):
    run, days = run_after_both_days
    before = (run / FILE).read_bytes()
    days.write_text(days.read_text(encoding="utf-8").replace("Monday,10.0", "Monday,11.0"), encoding="utf-8")
    done = invoke("predict", run, days)
    assert done.exit_code == 2
    assert "Monday: was predicted with another temperature (now '11.0', but '10.0' in " in done.stderr
    assert "give it another name; if the numbers were corrected, delete its line there" in done.stderr
    assert (run / FILE).read_bytes() == before


def test_the_same_test_like_another_is_an_error_that_says_what_to_do(run, days):
    assert invoke("predict", run, days, "--like", "t1").exit_code == 3
    assert [one["like"] for one in predictions(run)] == ["t1", "t1"]
    done = invoke("predict", run, days, "--like", "t2")
    assert done.exit_code == 2
    assert "Monday: was predicted with another like (now 't2', but 't1' in " in done.stderr
    again = invoke("predict", run, days, "--like", "t1", "--false-alarms", "0.1")
    assert again.exit_code == 0, again.output
    said = " ".join(again.stdout.split())
    assert "0.02 would by chance if nothing had changed. Each test is judged alone: of tests without any " in said
    assert "change, the share in its column false_alarms departs." in said


WRONG = {
    "an unknown column": (
        lambda text: text.replace("temperature", "humidity"),
        "column humidity: must be one of ",
    ),
    "a missing mode": (
        lambda text: "\n".join(line.rpartition(",")[0] for line in text.splitlines()),
        "column sway: must be in the table, which has name, temperature, bend",
    ),
    "one mode more": (lambda text: text.replace("name,", "twist,name,"), "must have "),
    "doubled names": (
        lambda text: text.replace("Tuesday", "Monday"),
        "line 3, column name: must not be the name in ",
    ),
    "no covariate": (
        lambda text: text.replace("temperature,", "").replace("10.0,", ""),
        "line 2, covariates: must have temperature, on which k1 depends (got none)",
    ),
    "an empty covariate": (
        lambda text: text.replace("10.0", "", 1),
        "line 2, covariates.temperature: must be a number in a further test",
    ),
    "text": (
        lambda text: text.replace("Monday,10.0,", "Monday,10.0,x"),
        "line 2, column bend: must be a positive ",
    ),
    "an earlier test": (
        lambda text: text.replace("Monday", "t3"),
        "line 2, name: must not be that of a test that ",
    ),
    "a name no trace can have": (lambda text: text.replace("Monday", "a/b"), "line 2: name: must "),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_input_names_file_line_and_column_and_leaves_nothing(what, run, days):
    change, expected = WRONG[what]
    days.write_text(change(days.read_text(encoding="utf-8")), encoding="utf-8")
    done = invoke("predict", run, days)
    assert done.exit_code == 2, done.output
    assert done.stderr.startswith("Error: new.csv: ")
    assert expected in done.stderr
    assert not (run / FILE).exists()


def test_options_that_cannot_be_followed(run, days):
    rare = invoke("predict", run, days, "--false-alarms", "0.001")
    assert rare.exit_code == 2
    assert "--false-alarms: must be at least 0.0041, the smallest p-value of 240 draws (got 0.001)" in rare.stderr
    other = invoke("predict", run, days, "--like", "t9")
    assert other.exit_code == 2
    assert "line 2, --like: must be one of t0, t1, " in other.stderr
    assert not (run / FILE).exists()


def test_a_file_of_predictions_that_is_not_of_this_run_is_refused(run_after_both_days):
    run, days = run_after_both_days
    kept = (run / FILE).read_text(encoding="utf-8")
    for text, expected in (
        (kept.replace("draws_of", "of"), "must be as fmu predict wrote it for this run (its first line differs)"),
        (kept.replace("Tuesday,", "Tuesday"), "must be as fmu predict wrote it for this run (line 3 differs)"),
        ("", "must be as fmu predict wrote it for this run (its first line differs)"),
        (kept.replace(",gibbs ", ",slice "), "must be of the draws of gibbs "),
    ):
        (run / FILE).write_text(text, encoding="utf-8")
        done = invoke("predict", run, days)
        assert done.exit_code == 2, done.output
        assert expected in done.stderr
        assert f"mv {run / FILE} {run / FILE}.old" in done.stderr


def test_a_table_of_the_run_that_has_changed_is_told(run, days):
    campaign = run.parent / "campaign.csv"
    campaign.write_text(campaign.read_text(encoding="utf-8") + row("t8", np.random.default_rng(4)) + "\n")
    done = invoke("predict", run, days)
    assert done.exit_code == 2
    assert "put new tests into a table of their own" in done.stderr


def test_a_run_without_a_population_or_without_an_end_is_refused(run, days, monkeypatch):
    path = written(run.parent, K1, K2, TESTS)
    length = ("--draws", "10", "--warmup", "10", "--sampler", "mh", "--starts", "2", "--no-report")
    assert invoke("run", path, *length, "--out", run.parent / "b").exit_code == 0
    done = invoke("predict", run.parent / "b", days)
    assert done.exit_code == 2
    assert 'problem: must have a parameter with varies = "population"' in done.stderr
    at_keep(monkeypatch, 3, cut)
    with pytest.raises(Cut):
        invoke("run", path, *length, "--keep-draws", "5", "--out", run.parent / "c")
    done = invoke("predict", run.parent / "c", days)
    assert done.exit_code == 2
    assert f"must be of a run that has ended; go on with fmu run --resume {run.parent / 'c'}" in done.stderr


KILLED = """
import os, signal, sys
import fmu.durable_files
from fmu.cli import main
fmu.durable_files.os.replace = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
main(["predict", *sys.argv[1:]])
"""


def end_like_a_kill(run, days):
    """Predict, and end like a kill before the new file has its name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fmu.durable_files.os, "replace", lambda *_: cut())
        with pytest.raises(Cut):
            invoke("predict", run, days)


def kill(run, days):
    """Predict in another process, which is killed there."""
    environment = os.environ | {"PYTHONPATH": str(Path(fmu.__file__).parent.parent)}
    done = subprocess.run(
        [sys.executable, "-c", KILLED, run, days], env=environment, capture_output=True, check=False
    )
    assert done.returncode == -signal.SIGKILL


@pytest.mark.parametrize("end", [end_like_a_kill, pytest.param(kill, marks=pytest.mark.validate)])
def test_killed_while_it_writes_it_leaves_the_results_of_before(run, days, end):
    whole = days.read_text(encoding="utf-8")
    days.write_text("".join(whole.splitlines(keepends=True)[:2]), encoding="utf-8")
    assert invoke("predict", run, days).exit_code == 0
    before = (run / FILE).read_bytes()
    days.write_text(whole, encoding="utf-8")
    end(run, days)
    assert (run / FILE).read_bytes() == before
    assert invoke("predict", run, days).exit_code == 3
    assert [one["name"] for one in predictions(run)] == ["Monday", "Tuesday"]
