"""Every example of README.md, CONTRIBUTING.md and the guide runs: Python by page, shell commands by line."""

import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
import types
from pathlib import Path
from typing import Annotated

import click
import pytest
from pydantic import TypeAdapter

import fmu
from fmu.analysis.maxima import search
from fmu.cli import main
from fmu.config.problem import ProblemFile
from fmu.config.template import template
from fmu.engines import dask_cluster

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("notebooks/guide/*.md"))]
ELSEWHERE = "head:8786"
"""Address of a cluster: lines that name it are read, not run; nor is the page of ``--web``, which goes on."""

SYSTEM = ("python3", ".", "pip")
"""Programs that install fmu: their lines are read, not run."""


def blocks(page, language):
    """The code blocks of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def lines(page):
    """The words of each shell line, without comments, and the file that its output goes to."""
    for line in "".join(blocks(page, "sh")).splitlines():
        words = shlex.split(line, comments=True)
        if words:
            command, target = (words[:-2], words[-1]) if ">" in words else (words, None)
            yield command, target


def write_files(page, folder):
    """Write the files that a reader has: beam.toml, and those of the page, whose first line is ``# NAME: …``."""
    (folder / "beam.toml").write_text(template("frame"), encoding="utf-8")
    for block in blocks(page, "toml"):
        if name := re.match(r"# (\w+\.toml):", block):
            (folder / name[1]).write_text(block, encoding="utf-8")


def with_blocks(language):
    return [page for page in PAGES if blocks(page, language)]


def names(pages):
    return [page.name for page in pages]


def test_every_block_is_of_a_kind_that_is_tested():
    kinds = {kind for page in PAGES for kind in re.findall(r"^```(\S+)\n", page.read_text("utf-8"), re.MULTILINE)}
    assert {kind for kind in kinds if kind[0] != "{"} <= {"python", "sh", "text", "toml"}
    assert {"README.md", "first-steps.md", "own-structure.md", "own-error-model.md", "own-sampler.md"} < set(
        names(with_blocks("python"))
    )


@pytest.mark.parametrize("page", with_blocks("toml"), ids=lambda page: page.name)
def test_tables_of_problem_files_are_valid(page):
    for block in blocks(page, "toml"):
        for key, table in tomllib.loads(block).items():
            field = ProblemFile.model_fields[key]
            TypeAdapter(Annotated[field.annotation, field]).validate_python(table)


IN_ONE_PROCESS = [page for page in with_blocks("python") if page.name != "cluster.md"]
SLURM = "dask_jobqueue"
"""What the example of cluster.md that needs SLURM imports."""


@pytest.fixture(params=[True, pytest.param(False, marks=pytest.mark.validate)], ids=["short", "whole"])
def _length(request, monkeypatch):
    """Leave the runs of the examples their lengths, or shorten them to some steps, and their searches."""
    sample = fmu.sample

    def shortened(*given, draws=1000, warmup=1000, chains=2, **options):
        return sample(*given, draws=min(draws, 15), warmup=min(warmup, 12), chains=chains, **options)

    if request.param:
        monkeypatch.setattr(fmu, "sample", shortened)
        monkeypatch.setattr(search, "STARTS", 8)
        monkeypatch.setattr(search, "STARTS_WITHOUT_DERIVATIVES", 4)


@pytest.mark.usefixtures("_length")
@pytest.mark.parametrize("page", IN_ONE_PROCESS, ids=lambda page: page.name)
def test_python_examples_run(page, tmp_path, monkeypatch):
    write_files(page, tmp_path)
    monkeypatch.chdir(tmp_path)
    program = tmp_path / "example.py"
    program.write_text("\n".join(blocks(page, "python")), encoding="utf-8")
    runpy.run_path(os.fspath(program), run_name="example")


@pytest.mark.validate
def test_the_example_with_workers_runs(tmp_path):
    page, program = ROOT / "notebooks/guide/cluster.md", tmp_path / "example.py"
    here = [code for code in blocks(page, "python") if SLURM not in code]
    program.write_text("\n".join(here), encoding="utf-8")
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-W", "error", program.name],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_the_slurm_cluster_is_asked_for_as_the_guide_says(tmp_path, monkeypatch):
    """With an object in place of SLURM: it is told what it must know, and the run asks its scheduler."""
    told = {}

    class SLURMCluster:
        scheduler_address = "tcp://127.0.0.1:1"  # where nothing listens

        def __init__(self, **options):
            told.update(options)

        def adapt(self, **options):
            told.update(options)

    (code,) = [code for code in blocks(ROOT / "notebooks/guide/cluster.md", "python") if SLURM in code]
    (tmp_path / "beam.toml").write_text(template("frame"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    ask = dask_cluster._check_scheduler
    monkeypatch.setattr(dask_cluster, "_check_scheduler", lambda address, _: ask(address, 0.5))
    monkeypatch.setitem(sys.modules, SLURM, types.SimpleNamespace(SLURMCluster=SLURMCluster))
    with pytest.raises(ValueError, match="127\\.0\\.0\\.1:1"):
        exec(compile(code, "cluster.md", "exec"), {"__name__": "__main__"})
    assert {"queue", "cores", "walltime", "maximum_jobs"} <= set(told)


def make_runs(folder):
    """Make the folders of the runs that the lines refer to."""
    for name in ("runs/long", "runs/beam-shape", "runs/four", "runs/damage-shape"):
        (folder / name).mkdir(parents=True)


@pytest.mark.parametrize("page", with_blocks("sh"), ids=lambda page: page.name)
def test_shell_examples_are_understood(page, tmp_path, monkeypatch):
    write_files(page, tmp_path)
    make_runs(tmp_path)
    monkeypatch.chdir(tmp_path)
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for (program, name, *arguments), _ in lines(page):
        if program in SYSTEM:
            assert program != "pip" or [name, *arguments] == ["install", "."]
        elif program == "make":
            assert re.search(rf"^[a-z ]*\b{name}\b.*:", makefile, re.MULTILINE)
        elif name == "--version":
            assert not arguments
        else:
            assert program == "fmu"
            with main.commands[name].make_context(name, list(arguments)) as context:
                assert isinstance(context, click.Context)


def test_extras_that_pages_name_exist():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    named = set(",".join(re.findall(r"pip install '\.\[([\w,]+)\]'", text)).split(","))
    page = (ROOT / "notebooks/guide/installing.md").read_text(encoding="utf-8")
    named |= set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE))
    assert {"fast", "ansys", "opensees", "notebooks"} < named <= set(project["optional-dependencies"])


@pytest.mark.validate
@pytest.mark.parametrize("page", with_blocks("sh"), ids=lambda page: page.name)
def test_shell_examples_run(page, tmp_path):
    write_files(page, tmp_path)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    for (program, *arguments), target in lines(page):
        if program in ("make", *SYSTEM) or any(ELSEWHERE in word or word == "--web" for word in arguments):
            continue
        with open(tmp_path / (target or "out.txt"), "w", encoding="utf-8") as file:
            subprocess.run(
                [sys.executable, "-m", "fmu", *arguments], cwd=tmp_path, env=environment, stdout=file, check=True
            )
