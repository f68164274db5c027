"""A reader that goes, a full disk, and what a run leaves that was killed in its first seconds."""

import shutil
import subprocess
import sys

import pytest
from click.testing import CliRunner

from fmu.cli import main
from fmu.cli.messages import _of_system
from fmu.cli.output import claim_directory
from fmu.config.kept import ORIGIN
from fmu.runs.run_directory import FOLDER


def test_a_reader_that_goes():
    """The first line is read and the pipe closed: the command ends as it would have ended, without a word."""
    code = (
        "import click, sys\nfrom fmu.cli.messages import Commands\n"
        "@click.group(cls=Commands)\ndef main(): pass\n"
        "@main.command()\ndef go():\n"
        "    for i in range(20000): click.echo(f'line {i}')\n"
        "    click.echo('written', err=True)\n    return 3\n"
        "main(['go'])\n"
    )
    run = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert run.stdout.readline() == "line 0\n"
    run.stdout.close()
    said = run.stderr.read()
    run.stderr.close()
    assert (run.wait(60), said) == (3, "written\n")


@pytest.mark.parametrize(("number", "name"), [(28, "r/trace.nc"), (27, None)])
def test_a_full_disk_is_said_with_the_file(number, name):
    said = _of_system(OSError(number, "No space left on device", name))
    assert said.startswith(
        f"{name or 'standard output, or a file of the output directory'} could not be written: "
    )
    assert "Free space" in said


def test_standard_output_on_a_full_device():
    with open("/dev/full", "w") as full:
        run = subprocess.run(
            [sys.executable, "-m", "fmu", "--version"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert run.returncode == 2
    assert "could not be written: No space left on device. Free space" in run.stderr


def test_what_a_run_killed_at_once_leaves_is_no_obstacle(tmp_path):
    (tmp_path / "run" / FOLDER).mkdir(parents=True)
    (tmp_path / "run" / FOLDER / "lock").touch()
    with claim_directory(tmp_path / "run", False) as directory:
        assert directory == tmp_path / "run"
    (tmp_path / "run" / "notes.txt").touch()
    with (
        pytest.raises(ValueError, match=r"exists; choose another directory or add --overwrite"),
        claim_directory(tmp_path / "run", False),
    ):
        pass


def test_a_run_that_was_killed_is_to_be_resumed(tmp_path):
    run = tmp_path / "run"
    (run / FOLDER).mkdir(parents=True)
    (run / FOLDER / ORIGIN).write_text("{}")
    with (
        pytest.raises(ValueError, match=rf"not ended: resume it with fmu run --resume {run}, choose"),
        claim_directory(run, False),
    ):
        pass
    for command in ("report", "export", "damage", "compare"):
        said = CliRunner().invoke(main, [command, str(run)])
        assert said.exit_code == 2
        assert f"its run was interrupted. To resume: fmu run --resume {run}" in said.stderr, command
    shutil.rmtree(run / FOLDER)
    assert "contains no traces (*.nc)" in CliRunner().invoke(main, ["report", str(run)]).stderr
