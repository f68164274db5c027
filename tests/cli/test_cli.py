import copy
import os
import re
import shutil
import subprocess
import sys
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import fmu
import fmu.analysis.maxima.search
from fmu import cli
from fmu.analysis.convergence.diagnosis import maxima_of
from fmu.analysis.trace.conversion import save_trace
from fmu.config.kept import KeptProblem
from fmu.samplers.kernel import Sampler

BUILT_IN = fmu.cases.path("cantilever-young").read_bytes()


@pytest.fixture(scope="module")
def young():
    """A built-in problem; its chains start where the posterior is, for six draws would not get there."""
    problem = fmu.cases.load("cantilever-young")
    best = fmu.find_map(problem, starts=16)[0]

    def sample_prior(rng, n):
        theta = best.mean + 0.3 * best.sd * rng.standard_normal((n, problem.ndim))
        return np.clip(theta, problem.lower, problem.upper)

    problem.sample_prior = sample_prior
    return problem


def loading(monkeypatch, problem, load=KeptProblem.load):
    """Have this problem loaded in place of the built-in one."""

    def replaced(kept, engine=None):
        return problem if kept.file.read_bytes() == BUILT_IN else load(kept, engine)

    monkeypatch.setattr(KeptProblem, "load", replaced)


def commands_in(folder, patch, problem):
    """Return what runs a command there; the built-in problem is loaded once for all tests."""
    patch.chdir(folder)
    loading(patch, problem)
    patch.setattr("fmu.analysis.estimate.estimates", lambda *_: [])  # told only where a machine is slow
    return lambda *args: CliRunner().invoke(cli.main, list(map(str, args)), prog_name="fmu")


@pytest.fixture
def invoke(young, monkeypatch, tmp_path):
    """Run a command in an empty directory."""
    return commands_in(tmp_path, monkeypatch, young)


MAXIMA = "Posterior maxima\n"
SHORT = ("--draws", 6, "--warmup", 3, "--chains", 2, "--sampler", "mh", "--no-report")


@pytest.fixture(scope="module")
def ran(young, tmp_path_factory):
    """The directory of a short run, and what it printed."""
    folder = tmp_path_factory.mktemp("ran")
    with pytest.MonkeyPatch.context() as patch:
        result = commands_in(folder, patch, young)("run", "cantilever-young", *SHORT, "--out", "here")
    assert result.exit_code == 0, result.output
    return folder / "here", result


@pytest.fixture(scope="module")
def converged(young, tmp_path_factory):
    """The directory of a run that was long enough, and what it printed."""
    folder = tmp_path_factory.mktemp("converged")
    length = ("--warmup", 200, "--sampler", "mixture", "--out", "here", "--until-ess", 450)
    with pytest.MonkeyPatch.context() as patch:
        result = commands_in(folder, patch, young)("run", "cantilever-young", *length, "--no-report")
    assert result.exit_code == 0, result.output
    return folder / "here", result


def assert_one_line(result, *parts, begins=""):
    """One line on standard error holds `parts`, the exit code is 2, and other output begins as said, if any."""
    assert result.exit_code == 2
    assert result.stdout.startswith(begins)
    assert bool(result.stdout) == bool(begins)
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("Error: ")
    for part in parts:
        assert part in result.stderr


def files_in(directory):
    return {str(p.relative_to(directory)): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


def test_cases_are_listed(invoke):
    result = invoke("cases")
    assert result.exit_code == 0
    lines = result.stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(fmu.cases.names())
    assert all(fmu.cases.describe(line.split()[0]) in line for line in lines)


def test_run_writes_traces_and_tables_and_compare_repeats_the_comparison(invoke, tmp_path):
    result = invoke("run", "cantilever-young", "--sampler", "slice", *SHORT, "--seed", 4)
    assert result.exit_code == 0, result.output
    out = tmp_path / "runs" / "cantilever-young-shape"
    assert {p.name for p in out.iterdir()} == {
        "mh.nc",
        "slice.nc",
        "summary-mh.csv",
        "summary-slice.csv",
        "comparison.csv",
        "map.csv",
        "problem.toml",
        "run.json",
    }
    assert (out / "problem.toml").read_bytes() == fmu.cases.path("cantilever-young").read_bytes()
    trace = fmu.load_trace(out / "slice.nc")
    assert trace["posterior"].sizes == {"chain": 2, "draw": 6}
    assert trace["warmup_posterior"].sizes == {"chain": 2, "draw": 3}
    assert (trace.attrs["seed"], trace.attrs["init"]) == (4, "maxima")
    pd.testing.assert_frame_equal(
        pd.read_csv(out / "summary-slice.csv", index_col="parameter"), fmu.summary(trace), check_index_type=False
    )
    comparison = pd.read_csv(out / "comparison.csv", index_col="sampler")
    assert list(comparison.index) == ["mh", "slice"]
    assert comparison.loc["slice", "n_solves"] == trace.attrs["n_solves"] + trace.attrs["warmup_n_solves"]
    again = invoke("compare", out)
    assert again.exit_code == 0
    assert again.stdout.strip() in result.stdout


@pytest.mark.usefixtures("no_pictures")
def test_run_writes_pages_to_read(invoke, tmp_path):
    result = invoke("run", "cantilever-young", *SHORT, "--out", "here", "--report")
    assert result.exit_code == 0, result.output
    assert result.stdout.endswith("Report: here/report/index.html\n")
    pages = sorted(path.name for path in (tmp_path / "here" / "report").glob("*.html"))
    assert pages == ["index.html"]
    assert "Not converged" in (tmp_path / "here" / "report" / "index.html").read_text()


def test_run_prints_the_tables_and_nothing_else(ran):
    _, result = ran
    assert result.stderr == ""
    lines = result.stdout.splitlines()
    assert lines[0] == "Posterior maxima"
    assert lines[1].split() == ["maximum", "unit", "before", "1", "measured"]
    at = lines.index("mh")
    assert all(column in lines[at + 1] for column in ("mean", "sd", " 5 %", "R-hat", "tail ESS", "unit", "from"))
    cells = re.split(r"\s{2,}", lines[at + 1].strip())
    assert cells[2:6] == ["5 %", "±", "95 %", "±"]
    assert [line.split()[0] for line in lines[at + 2 : at + 7]] == ["E1", "E2", "E3", "E4", "E5"]
    assert any(line.startswith("solves ") for line in lines)
    assert not re.search(r"[a-z]_[a-z]", re.sub(r"\(Python: [^)]*\)+", "", " ".join(result.stdout.split())))
    assert any(re.match(r"mh  not converged: E\d: R-hat is ", line) for line in lines)
    assert any(line.startswith("The model, from the draws of mh (not converged)") for line in lines)
    assert lines[-1] == "Written to here"
    assert "\x1b" not in result.stdout


def test_the_search_takes_as_many_starts_as_asked_for(invoke):
    result = invoke("run", "cantilever-young", *SHORT, "--starts", 8)
    assert "from 8 starts" in result.stderr
    (line,) = (line for line in result.stdout.splitlines() if line.startswith("starts"))
    assert line.split() == ["starts", "8"]


def test_a_function_without_gradients_is_searched_from_fewer_starts(invoke, tmp_path):
    (tmp_path / "own.py").write_text("import numpy as np\n\ndef modes(theta):\n    return np.sqrt(theta)\n")
    (tmp_path / "own.toml").write_text(
        'name = "own"\n[model]\ntype = "python"\nfunction = "own:modes"\n'
        "[measurement]\nfrequencies = [1.1]\nsd = [0.01]\n"
        '[[parameters]]\nname = "k"\nstart = 1.0\nlower = 0.5\nupper = 1.5\n'
    )
    result = invoke("run", "own.toml", *SHORT)
    assert result.exit_code == 0, result.output
    assert "from 16 starts" in result.stderr


@pytest.mark.parametrize(
    ("where", "code", "begins"), [("len(calls) > 100", 2, "Error: init: chain 0"), ("theta[0] > 1.22", 0, "mh: ")]
)
def test_a_function_that_fails_later_is_named_with_its_reason(invoke, tmp_path, where, code, begins):
    (tmp_path / "failing.py").write_text(
        "import numpy as np\ncalls = []\n\ndef modes(theta):\n    calls.append(theta)\n"
        f"    if {where}:\n        raise RuntimeError('no licence')\n    return np.sqrt(theta)\n"
    )
    (tmp_path / "own.toml").write_text(
        'name = "own"\n[model]\ntype = "python"\nfunction = "failing:modes"\n'
        "[measurement]\nfrequencies = [1.1]\nsd = [0.01]\n"
        '[[parameters]]\nname = "k"\nstart = 1.0\nlower = 0.5\nupper = 1.5\n'
    )
    result = invoke("run", "own.toml", *SHORT, "--starts", 2)
    assert result.exit_code == code, result.output
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith(begins)
    assert "; the function first failed at [" in last
    assert last.endswith("RuntimeError: no licence")


def test_run_on_a_terminal_shows_a_bar_for_every_phase(invoke, monkeypatch):
    monkeypatch.setattr(fmu.progress, "on_terminal", lambda: True)
    result = invoke("run", "cantilever-young", *SHORT)
    assert "mh warmup" in result.stdout
    assert "3/3" in result.stdout
    assert "mh draws" in result.stdout
    assert "6/6" in result.stdout


def test_maxima_are_written_and_kept_in_the_trace(ran, young):
    out, result = ran
    table = pd.read_csv(out / "map.csv", index_col="maximum")
    maxima = fmu.find_map(young)
    pd.testing.assert_frame_equal(table, maxima.table().replace("", np.nan), check_index_type=False)
    assert str(maxima) in result.stdout
    assert maxima_of(fmu.load_trace(out / "mh.nc"))[0].log_prob == maxima[0].log_prob


def test_verdicts_know_the_maxima_and_a_saved_run_keeps_its_own(section_maxima, monkeypatch, tmp_path):
    """All chains start in one place, without jumps: the verdict names the maximum that they miss.

    `fmu compare` repeats it. Effective draws in plenty do not make it good: the run ends at its limit.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fmu.analysis.maxima.search, "find_map", lambda problem, starts=None: section_maxima)
    monkeypatch.setitem(fmu.sample.__wrapped__.__kwdefaults__, "jumps", False)
    monkeypatch.setattr(Sampler, "first", (60, 20))
    arguments = ("--pairing", "index", "--sampler", "mh", "--init", "start")
    until = ("--max-solves", "400", "--out", "here", "--no-report")
    run = CliRunner().invoke(cli.main, ["run", "cantilever-section", *arguments, *until])
    assert run.exit_code == 1, run.output
    assert "--max-solves 400 reached before convergence: mh" in run.stdout
    assert "The model, from the draws of mh (not converged)" in run.stdout
    lines = run.stdout.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("mh  not converged"))
    end = next(k for k, line in enumerate(lines) if line.startswith("    - the draws were elsewhere: "))
    said = " ".join(line.strip() for line in lines[at:end])
    assert "maximum 1 at Ix1 = 3904 mm⁴" in said
    assert "holds about 100 % of the probability" in said
    verdict = pd.read_csv("here/comparison.csv", index_col="sampler").loc["mh", "verdict"]
    assert said == f"mh  {verdict}"
    again = CliRunner().invoke(cli.main, ["compare", "here"])
    assert again.exit_code == 0
    assert set(again.stdout.splitlines()) <= set(lines)
    assert lines[at] in again.stdout
    assert max(map(len, lines)) <= 100


def test_sampling_on_until_there_is_enough(converged):
    out, result = converged
    assert "Stopped" not in result.stdout
    assert "mixture  converged" in result.stdout.splitlines()
    assert any(re.match(r"Next: fmu export \S+ writes the updated values and model\.", line) for line in
               result.stdout.splitlines())  # fmt: skip
    trace = fmu.load_trace(out / "mixture.nc")
    assert 50 < trace["posterior"].sizes["draw"] <= 3000  # E4 and E5 lie at their bounds: a far end is known least
    assert trace["warmup_posterior"].sizes["draw"] == 200
    assert "limit" not in trace.attrs
    assert pd.read_csv(out / "summary-mixture.csv")[["ess_bulk", "ess_tail"]].min().min() >= 450


def test_sampling_ends_at_the_limit_and_says_so(invoke, monkeypatch):
    monkeypatch.setattr(Sampler, "first", (20, 10))
    arguments = ("--chains", 2, "--sampler", "mh", "--out", "here", "--no-report")
    result = invoke("run", "cantilever-young", *arguments, "--until-ess", 1e6, "--max-solves", 300)
    assert result.exit_code == 1
    assert result.stderr == ""
    lines = result.stdout.splitlines()
    at = lines.index("--max-solves 300 reached before --until-ess 1e+06: mh")
    assert lines[at + 1] == "To continue: fmu run --resume here --max-solves 3000"
    assert lines[-2:] == ["", "Written to here"]
    assert "- the run ended at its limit of 300 solves" in result.stdout
    trace = fmu.load_trace("here/mh.nc")
    assert trace.attrs["limit"] == "300 solves"
    assert 280 < trace.attrs["n_solves"] + trace.attrs["warmup_n_solves"] < 320
    assert trace["posterior"].sizes["draw"] > 20
    assert trace["warmup_posterior"].sizes["draw"] == 20


def test_draws_are_drawn_exactly_and_need_not_suffice(ran):
    out, result = ran
    assert fmu.load_trace(out / "mh.nc")["posterior"].sizes["draw"] == 6
    assert any(line.startswith("mh  not converged") for line in result.stdout.splitlines())


def test_a_comparison_of_runs_without_maxima_says_what_it_cannot_know(converged, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    trace = fmu.load_trace(converged[0] / "mixture.nc")
    del trace["maxima"]
    save_trace(trace, "mixture.nc")
    result = CliRunner().invoke(cli.main, ["compare", "."])
    lines = result.stdout.splitlines()
    at = lines.index("mixture  converged locally")
    assert lines[at + 1].startswith("         - judged by its own draws only, as no maxima are")


def test_numbers_that_do_not_apply_are_dashes(invoke):
    result = invoke("run", "cantilever-young", *SHORT, "--chains", 1)
    lines = [line.split() for line in result.stdout.splitlines() if line]
    rows = {" ".join(line[:-1]): line[-1] for line in lines}
    assert rows["divergences"] == "–"
    assert rows["largest R-hat"] == "–"
    assert rows["gradients"] == "0"


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["run", "bridge"], ["'bridge'", "cantilever-section, cantilever-young"]),
        (["run"], ["CASE"]),
        (
            ["run", "cantilever-young", "--sampler", "nuts"],
            ["--sampler", "'nuts'", "'mh', 'slice', 'hmc', 'emcee'"],
        ),
        (["run", "cantilever-young", "--draws", "0"], ["--draws", "0 is not in the range x>=1"]),
        (["run", "cantilever-young", "--draws", "-3"], ["--draws", "-3"]),
        (["run", "cantilever-young", "--until-ess", "0"], ["--until-ess", "0"]),
        (["run", "cantilever-young", "--max-solves", "0"], ["--max-solves", "0 is not in the range x>=1"]),
        (
            ["run", "cantilever-young", "--draws", "5", "--until-ess", "9"],
            ["--draws 5 fixes the number of draws: leave out --until-ess"],
        ),
        (
            ["run", "cantilever-young", "--draws", "5", "--max-solves", "9"],
            ["--draws 5 fixes the number of draws: leave out --max-solves"],
        ),
        (["run", "cantilever-young", "--draws", "many"], ["--draws", "'many'"]),
        (["run", "cantilever-young", "--warmup", "-1"], ["--warmup", "-1"]),
        (["run", "cantilever-young", "--chains", "0"], ["--chains", "0"]),
        (["run", "cantilever-young", "--seed", "-1"], ["--seed", "-1"]),
        (["run", "cantilever-young", "--pairing", "luck"], ["--pairing", "'luck'"]),
        (["run", "cantilever-young", "--init", "end"], ["--init", "'end'"]),
        (["run", "cantilever-young", "--speed", "9"], ["--speed"]),
        (["walk"], ["walk"]),
        (["compare", "absent"], ["absent", "neither a built-in problem"]),
    ],
    ids=lambda value: " ".join(value) if "run" in value or "compare" in value else "",
)
def test_bad_input_is_one_line_and_writes_nothing(invoke, tmp_path, arguments, parts):
    assert_one_line(invoke(*arguments), *parts)
    assert list(tmp_path.iterdir()) == []


def test_start_outside_the_bounds(invoke, young, monkeypatch, tmp_path):
    problem = copy.copy(young)
    problem.start = young.upper * 1.1
    loading(monkeypatch, problem)
    assert_one_line(invoke("run", "cantilever-young", *SHORT, "--init", "start"), "2.75e+11", begins=MAXIMA)
    assert list(tmp_path.iterdir()) == []


def test_existing_directory_is_left_alone(invoke, tmp_path):
    out = tmp_path / "mine"
    out.mkdir()
    (out / "notes.txt").touch()
    assert_one_line(invoke("run", "cantilever-young", *SHORT, "--out", out), str(out), "exists", "--overwrite")
    assert [path.name for path in out.iterdir()] == ["notes.txt"]
    (out / "notes.txt").rename(out / "mh.nc").write_text("precious")
    assert_one_line(invoke("run", "cantilever-young", *SHORT, "--out", out))
    assert files_in(out) == {"mh.nc": b"precious"}


def test_overwrite_replaces_only_what_the_command_writes(invoke, tmp_path):
    out = tmp_path / "mine"
    (out / "sub").mkdir(parents=True)
    kept = {"notes.txt": b"n", "hmc.nc": b"h", "summary-hmc.csv": b"s", "sub/mh.nc": b"m"}
    for name, content in (kept | {"mh.nc": b"old", "comparison.csv": b"old"}).items():
        (out / name).write_bytes(content)
    result = invoke("run", "cantilever-young", *SHORT, "--out", out, "--overwrite")
    assert result.exit_code == 0, result.output
    now = files_in(out)
    assert set(now) == set(kept) | {
        "mh.nc", "summary-mh.csv", "comparison.csv", "map.csv", "problem.toml", "run.json",
    }  # fmt: skip
    assert {name: now[name] for name in kept} == kept
    assert b"old" not in (now["mh.nc"], now["comparison.csv"])


def test_failed_run_does_not_touch_an_earlier_one(invoke, ran, young, monkeypatch, tmp_path):
    out = shutil.copytree(ran[0], tmp_path / "mine")
    before = files_in(out)
    problem = copy.copy(young)
    problem.start = young.lower * 0.9
    loading(monkeypatch, problem)
    result = invoke("run", "cantilever-young", *SHORT, "--out", out, "--overwrite", "--init", "start")
    assert_one_line(result, begins=MAXIMA)
    assert files_in(out) == before


def test_what_was_drawn_is_kept_when_a_later_sampler_fails(invoke, monkeypatch, tmp_path):
    import fmu.sampling

    sample = fmu.sampling.sample

    def failing(problem, name, **settings):
        if name == "slice":
            raise ValueError("width: must be positive (got 0)")
        return sample(problem, name, **settings)

    monkeypatch.setattr(fmu.sampling, "sample", failing)
    result = invoke("run", "cantilever-young", *SHORT, "--sampler", "slice", "--out", "mine")
    assert_one_line(result, "width: must be positive (got 0)", begins=MAXIMA)
    assert "mh  not converged" in result.stdout
    assert {p.name for p in (tmp_path / "mine").iterdir()} == {
        "mh.nc",
        "summary-mh.csv",
        "problem.toml",
        "run.json",
    }


def test_directory_that_cannot_be_made(invoke, tmp_path):
    (tmp_path / "file").write_text("precious")
    assert_one_line(invoke("run", "cantilever-young", *SHORT, "--out", "file/run"), "file/run")
    assert_one_line(invoke("run", "cantilever-young", *SHORT, "--out", "file", "--overwrite"), "file")
    assert files_in(tmp_path) == {"file": b"precious"}


def test_directory_without_permission(invoke, monkeypatch, tmp_path):
    # The owner of the machine may write everywhere, so the permission is taken away in name only.
    out = tmp_path / "mine"
    out.mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    assert_one_line(
        invoke("run", "cantilever-young", *SHORT, "--out", out, "--overwrite"), "no permission", str(out)
    )
    assert_one_line(invoke("run", "cantilever-young", *SHORT, "--out", "new/deep"), "no permission")
    assert list(tmp_path.rglob("*")) == [out]


def test_compare_without_traces(invoke, tmp_path):
    (tmp_path / "empty").mkdir()
    assert_one_line(invoke("compare", "empty"), "empty contains no traces")


def test_compare_with_a_foreign_file(invoke, tmp_path):
    (tmp_path / "hmc.nc").write_text("hello")
    assert_one_line(invoke("compare", "."), "hmc.nc", "trace written by fmu")


def test_compare_of_different_problems(invoke, ran, young, monkeypatch):
    shutil.copytree(ran[0], "here")
    other = copy.copy(young)  # whose maxima are searched for anew
    other.name = "another"
    loading(monkeypatch, other)
    arguments = ("--draws", 6, "--warmup", 3, "--sampler", "slice", "--out", "here", "--overwrite", "--no-report")
    assert invoke("run", "cantilever-young", *arguments, "--starts", 1).exit_code == 0
    assert_one_line(invoke("compare", "here"), "here contains runs of different problems", "another")


def test_failed_points_are_reported(invoke, young, monkeypatch):
    """Points inside the bounds where the model fails are counted on standard error; the run goes on."""
    problem, calls = copy.copy(young), []

    def log_prob(theta):
        if len(theta) != 2:
            return young.log_prob(theta)
        calls.append(theta)
        # The second chain's candidates fail, its start does not, which is looked at twice.
        return np.where((np.arange(2) == 1) & (len(calls) > 2), np.nan, young.log_prob(theta))

    problem.log_prob = log_prob
    loading(monkeypatch, problem)
    result = invoke("run", "cantilever-young", *SHORT, "--starts", 1, "--out", "here")
    assert result.exit_code == 0, result.output
    trace = fmu.load_trace("here/mh.nc")
    failed = sum(int(trace[g]["n_nonfinite"].sum()) for g in ("sample_stats", "warmup_sample_stats"))
    assert failed > 0
    assert f"mh: {failed} points inside the bounds had no finite log-probability" in result.stderr


def test_paper_hands_over_the_directory(invoke, monkeypatch, tmp_path):
    calls = []
    module = ModuleType("fmu.paper")
    module.run_paper = lambda out, progress: calls.append((out, progress))
    monkeypatch.setitem(sys.modules, "fmu.paper", module)
    result = invoke("paper", "--out", tmp_path / "tables")
    assert result.exit_code == 0
    assert calls == [(tmp_path / "tables", None)]
    assert result.stdout == f"Written to {tmp_path / 'tables'}\n"


def test_commands_are_listed_in_the_order_of_their_use(invoke):
    listed = re.findall(r"^  (\w+)  ", invoke("--help").stdout.split("Commands:")[1], flags=re.MULTILINE)
    assert listed[:6] == ["cases", "init", "schema", "check", "plan", "run"]
    assert listed.index("run") < listed.index("compare") < listed.index("export") < listed.index("paper")


def test_command_alone_prints_the_help(invoke):
    result = invoke()
    assert result.exit_code == 2
    assert all(command in result.output for command in ("cases", "run", "compare", "paper"))


def test_version(invoke):
    result = invoke("--version")
    assert result.exit_code == 0
    assert fmu.__version__ in result.stdout


def test_nothing_heavy_is_imported_before_it_is_needed():
    """By one command after the other; nor are parts of scipy in a process that only solves a problem."""
    code = """
import sys
from fmu.cli import main
heavy = {"numpy", "scipy", "pandas", "xarray", "arviz", "arviz_stats", "emcee", "matplotlib", "rich"}
for arguments in (["--help"], ["run", "--help"], ["cases"], ["run", "bridge"]):
    try:
        main(arguments)
    except SystemExit:
        pass
    print("heavy:", arguments, heavy & set(sys.modules))
import fmu.config.problem, fmu.samplers.loop.run
print("heavy:", (heavy | {"scipy.stats", "scipy.optimize"}) & set(sys.modules) - {"numpy", "scipy"})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    said = [line for line in done.stdout.splitlines() if line.startswith("heavy:")]
    assert len(said) == 5
    assert [line for line in said if not line.endswith("set()")] == []


def test_installed_command_shows_no_traceback(tmp_path):
    code = "from fmu.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "run", "bridge"], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr


def test_the_package_is_the_command():
    done = subprocess.run([sys.executable, "-m", "fmu", "cases"], capture_output=True, text=True, check=True)
    assert "cantilever-young" in done.stdout


def test_too_little_memory_is_a_line(tmp_path, monkeypatch):
    def read(path):
        raise MemoryError("Unable to allocate 7.28 TiB for an array")

    monkeypatch.setattr("fmu.config.read", read)
    result = CliRunner().invoke(cli.main, ["check", "bridge.toml"], prog_name="fmu")
    assert result.exit_code == 2
    assert "Error: the model needs more memory than is available (Unable to allocate 7.28 TiB" in result.output
