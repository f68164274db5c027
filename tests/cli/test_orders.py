"""What fmu run and --resume refuse, and how they tell the end of a run."""

import json

import pytest

import fmu
from fmu.config.kept import KeptProblem
from tests.cli.runs import Cut, assert_refused, cut, invoke, of, resume, run


def test_what_must_not_be_said_anew(folder, at_keep):
    at_keep(3, cut)
    with pytest.raises(Cut):
        run(*of("mh"))
    for said in (("--draws", 15), ("--seed", 1), ("--sampler", "mh"), ("--keep-draws", 5), ("--overwrite",)):
        assert_refused(resume(*said), "--resume", f"{said[0]} cannot be changed when the run", "leave it out")
    assert_refused(invoke("run", "two.toml", "--resume", "out"), "CASE cannot be changed when the run")
    assert resume("--max-failure-rate", 0.4).exit_code == 0


def test_no_run(folder):
    assert_refused(invoke("run", "--resume", "none"), "'none' does not exist")
    (folder / "empty").mkdir()
    assert_refused(invoke("run", "--resume", "empty"), "empty contains no run that can be resumed")
    assert list((folder / "empty").iterdir()) == []


@pytest.mark.parametrize("said", [("--groups", 3), ("--cluster", "nowhere"), ("--max-solves", 3), ("--groups", 2)])
def test_bad_input_writes_nothing(folder, said):
    assert_refused(run(*of("hmc", "tempering"), *said))
    assert sorted(path.name for path in folder.iterdir()) == ["k2.csv", "two.toml"]


def test_progress_for_programs(folder):
    result = run(*of("mh"), "--progress", "json")
    lines = [json.loads(line) for line in result.stderr.splitlines()]
    # and, on a slow machine, other phases
    assert {(line.get("label"), line["phase"]) for line in lines} >= {("mh", "warmup"), ("mh", "draws")}
    drawn = [line for line in lines if line["phase"] == "draws"]
    assert (drawn[-1]["done"], drawn[-1]["total"]) == (15, 15)


def test_too_many_failures(folder):
    (folder / "brittle.py").write_text(
        "import math\n\n\ndef hz(theta):\n    if theta[0] > 1.02:\n        raise RuntimeError('no licence')\n"
        "    return [4.0 * math.sqrt(theta[0] * theta[1]), 9.0 * math.sqrt(theta[1])]\n"
    )
    parameter = '\n[[parameters]]\nname = "{}"\nstart = 1.0\nlower = 0.5\nupper = 1.5\n'
    (folder / "two.toml").write_text(
        'name = "brittle"\n[model]\ntype = "python"\nfunction = "brittle:hz"\n'
        "[measurement]\nfrequencies = [4.0, 9.0]\nsd = 0.5\n" + parameter.format("a") + parameter.format("b")
    )
    length = ("--warmup", 30, "--draws", 40, "--chains", 4, "--starts", 2, "--init", "start", "--sampler", "mh")
    stopped = run("--max-failure-rate", 0.05, length=length)
    assert stopped.exit_code == 1, stopped.output
    *_, line = stopped.stderr.splitlines()
    assert line.startswith("Error: mh: ")
    assert "more than the limit of 5 %; most often: RuntimeError: no licence. See out/failures-mh.csv" in line
    assert line.endswith("to continue regardless: fmu run --resume out --max-failure-rate 1")
    short = (folder / "out" / "failures-mh.csv").read_text()
    assert "no licence" in short
    result = resume("--max-failure-rate", 1)
    assert result.exit_code == 0, result.output
    ledger = (folder / "out" / "failures-mh.csv").read_text()
    assert ledger.startswith(short)
    assert len(ledger) > len(short)
    trace = fmu.load_trace(folder / "out" / "mh.nc")
    failed = sum(int(trace[g]["n_nonfinite"].sum()) for g in ("warmup_sample_stats", "sample_stats"))
    assert f"mh: {failed} points inside the bounds" in result.stderr
    (folder / "out").rename(folder / "one")
    assert run("--max-failure-rate", 1, length=length).exit_code == 0
    assert (folder / "out" / "failures-mh.csv").read_text().count("no licence") == ledger.count("no licence")


def test_an_ended_run_is_told_again(folder):
    told = run(*of("mh"))
    before = {path.name: path.stat().st_mtime_ns for path in (folder / "out").glob("*.nc")}
    again = resume()
    assert again.exit_code == 0, again.output
    assert again.stdout == told.stdout
    assert {path.name: path.stat().st_mtime_ns for path in (folder / "out").glob("*.nc")} == before
    assert not (folder / "out" / "checkpoints").exists()


@pytest.mark.parametrize("error", [ValueError, OSError])
def test_a_problem_that_cannot_be_built_leaves_nothing_behind(folder, monkeypatch, error):
    def failing(self, engine=None):
        raise error("cannot be read")

    monkeypatch.setattr(KeptProblem, "load", failing)
    assert_refused(run(*of("mh")), "cannot be read")
    assert not (folder / "out").exists()
