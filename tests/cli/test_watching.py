"""fmu watch: the run of a directory, told in words and as JSON."""

import json
import os
import shutil
import signal
from pathlib import Path

import pytest
from click.testing import CliRunner

import fmu
from fmu.cli import main
from fmu.cli.watch import _lines
from fmu.runs import Checkpoint
from fmu.runs.lock import announce
from fmu.runs.reading import Progress
from fmu.runs.status import RunReading, SamplerReading
from fmu.runs.store import Store
from tests.cli.runs import problem_in
from tests.runs.keeping import at_keep
from tests.samplers.targets import CorrelatedGaussian

RUN = ("run", "two.toml", "--warmup", "10", "--draws", "25", "--chains", "2", "--starts", "2",
       "--keep-draws", "5", "--no-report", "--progress", "none", "--out", "out")  # fmt: skip


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run of three samplers that stopped in the second."""
    folder = problem_in(tmp_path_factory.mktemp("stopped"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        at_keep(patch, 12, lambda: signal.raise_signal(signal.SIGTERM))
        names = (word for name in ("mh", "emcee", "mixture") for word in ("--sampler", name))
        assert CliRunner().invoke(main, [*RUN, *names]).exit_code == 130
    return folder / "out"


@pytest.fixture
def out(stopped, tmp_path, monkeypatch):
    """A copy of it in the current directory."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(stopped, "out"))


def watch(*arguments):
    result = CliRunner().invoke(main, ["watch", *map(str, arguments)], prog_name="fmu")
    assert result.exit_code == 0, result.output
    assert all(len(line) <= 100 or line.startswith(("{", "Note: ")) for line in result.stdout.splitlines())
    return result.stdout.splitlines()


def test_a_stopped_run(out):
    lines = watch("out")
    assert lines[0] == "out: stopped"
    assert lines[2].split()[:6] == ["sampler", "group", "state", "phase", "steps", "save"]
    rows = {line.split()[0]: line.split() for line in lines[3:8]}
    assert rows["mh"][1:4] == ["finished", "draws", "25/25"]
    assert rows["emcee"][1:3] == ["all", "stopped"]
    behind = min(int(rows[group][2].removesuffix("/25")) for group in ("1/2", "2/2"))
    assert rows["emcee"][3:5] == ["draws", f"{behind}/25"]
    assert rows["mixture"] == ["mixture", "waiting"]
    assert lines[-1] == "To resume: fmu run --resume out"
    assert (watch("out/checkpoints")[0], watch("out/checkpoints")[-1]) == (lines[0], lines[-1])


def test_a_sampler_that_reached_its_limit_is_not_at_work(out):
    """The one whose files are the youngest is."""
    (out / "checkpoints" / "mixture").mkdir()
    announce(out / "checkpoints" / "mixture")
    os.utime(out / "checkpoints" / "mixture" / "at-work.json", (2e9, 2e9))
    announce(out / "checkpoints")
    words = [line.split() for line in watch("out")]
    assert [one[:3] for one in words if one[:1] == ["emcee"]] == [["emcee", "all", "stopped"]]
    assert [one[:2] for one in words if one[:1] == ["mixture"]] == [["mixture", "running"]]


def test_as_json(out):
    (line,) = watch("out", "--json")
    told = json.loads(line)
    assert (told["state"], told["directory"], told["notes"]) == ("stopped", "out", [])
    mh, emcee, _ = told["samplers"]
    assert mh["together"]["solves"] == sum(
        int(fmu.load_trace("out/mh.nc").attrs[name]) for name in ("n_solves", "warmup_n_solves")
    )
    assert mh["together"]["kept_s"] is None
    assert len(emcee["groups"]) == 2


def test_a_running_one_is_followed_to_its_end(out, monkeypatch):
    announce(out / "checkpoints")
    waited = []

    def sleep(seconds):
        waited.append(seconds)
        if len(waited) == 2:
            (out / "checkpoints" / "at-work.json").unlink()

    monkeypatch.setattr("fmu.cli.watch.time.sleep", sleep)
    lines = watch("out", "--follow", "--every", 7)
    assert waited == [7.0, 7.0]
    heads = [line for line in lines if line.startswith("out: ")]
    assert len(heads) == 3
    assert heads[0].startswith("out: running for 0:0")
    assert heads[-1] == "out: stopped"
    assert lines[-1] == "To resume: fmu run --resume out"


def test_a_finished_run_has_verdicts(tmp_path, monkeypatch):
    monkeypatch.chdir(problem_in(tmp_path))
    told = CliRunner().invoke(main, [*RUN, "--sampler", "mh"])
    assert told.exit_code == 0, told.output
    lines = watch("out")
    assert lines[0] == "out: finished"
    assert lines[3].split()[:4] == ["mh", "finished", "draws", "25/25"]
    verdict = "mh" + told.stdout.partition("\nmh  not converged")[2].partition("\n    - ")[0]
    assert " ".join(" ".join(lines[5:]).split()) == " ".join(verdict.replace("mh", "mh not converged", 1).split())
    assert watch("out", "--follow") == lines


def test_the_checkpoint_of_a_call(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Store, "keep", lambda *_: signal.raise_signal(signal.SIGINT))
    density = CorrelatedGaussian()
    with pytest.raises(KeyboardInterrupt):
        fmu.sample(density, "slice", warmup=10, draws=20, chains=2, checkpoint=Checkpoint("kept", draws=5))
    os.utime("kept", (1.0, 1.0))  # or it might just be beginning
    assert watch("kept") == [
        "kept: stopped",
        "",
        "sampler  state",
        "sampler  stopped",
        "",
        "To resume: repeat the same call of fmu.sample, with checkpoint='kept'",
    ]


def test_damage_is_said(out):
    for path in (out / "checkpoints").rglob("*"):
        if path.is_file():
            path.write_bytes(b"\xff")
    lines = watch("out")
    assert lines[0] == "out: stopped"
    assert any(line.startswith("Note: out/checkpoints/run.json is not as fmu run wrote it") for line in lines)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("none",), "does not exist"),
        ((".",), "must be the directory of a run (got .)"),
        ((".", "--every", "0"), "x>0"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(main, ["watch", *arguments])
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1
    assert words in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_widest_table_fits():
    numbers = (3599.0, 0.991, 1.0123, 98765.4, 123456789, 98765, 98765.4, 35_999.0)
    at = Progress("12/16", "warmup", 99_998, 99_999, *numbers)
    sampler = SamplerReading("tempering", "finished", at, (at,), "not converged: " + 30 * "word ")
    lines = list(_lines(RunReading(Path("out"), "killed", None, (sampler,), True, "", ())))
    assert max(map(len, lines)) <= 100
    assert any(line.endswith(" 9:59:59") for line in lines)
