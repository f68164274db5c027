"""Programs in problem files: mistakes at their places, a killed run that goes on, and CalculiX for real."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu import cli
from fmu.config import ConfigurationError, load
from fmu.config.template import write_template
from fmu.fem.programs.store import SolveStore
from fmu.formats.decks import fill_deck, read_deck
from tests.cli.runs import Cut

SOLVER = Path(__file__).parents[2] / "fem" / "programs" / "solver.py"
TOML = f"""\
name = "two springs"

[model]
type = "command"
template = "springs.txt.in"
command = [{sys.executable!r}, "-I", "-S", "solver.py", "{{deck}}", "soft"]
inputs = ["solver.py"]
frequencies = {{ file = "{{job}}.dat", pattern = '^mode \\d+ frequency (\\S+) Hz$' }}

[measurement]
frequencies = [0.65, 1.65]
sd = 0.02

[[parameters]]
name = "k1"
start = 1.0
lower = 0.5
upper = 1.5

[[parameters]]
name = "k2"
start = 1.0
lower = 0.5
upper = 1.5
"""
RUN = "import sys; from tests.config.models.test_command_table import sampled; sampled(*sys.argv[1:])"
WHOLE_RUN = [
    *("--sampler", "mh", "--draws", "60", "--warmup", "40", "--chains", "2", "--starts", "2", "--no-report"),
    *("--progress", "none", "--keep-draws", "5", "--pairing", "index", "--max-failure-rate", "0.9"),
]
CCX = pytest.mark.skipif(shutil.which("ccx") is None, reason="needs CalculiX (ccx)")


def folder_of(path, text=TOML):
    path.mkdir(exist_ok=True)
    shutil.copy(SOLVER, path)
    (path / "springs.txt.in").write_text("k1 {k1:.17g}\nk2 {k2:.17g}\n")
    (path / "springs.toml").write_text(text)
    return path / "springs.toml"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("springs.txt.in", "none.in", "model.template: must be a text file (no such file: "),
        ('inputs = ["solver.py"]', 'inputs = ["mesh"]', "model.inputs.0: no such file: "),
        (repr(sys.executable), '"ccx-9.9"', "model.command.0: must be a program that is installed, on the PATH"),
        (r"(\S+) Hz$' }", r"\S+' }", "model.frequencies.pattern: must have one group, as (…), for the frequency"),
        (r"(\S+) Hz$' }", r"((' }", "model.frequencies.pattern: must be a regular expression (missing ), "),
        ("{job}", "{E}", "model.frequencies.file: may have {job} and {deck} in braces (got {E})"),
        ('inputs = ["solver.py"]', "timeout = 0", "model.timeout: must be greater than 0 (got 0)"),
        ('inputs = ["solver.py"]', "retries = -1", "model.retries: must be greater than or equal to 0 (got -1)"),
        ('inputs = ["solver.py"]', 'reader = "calculix"', "model.frequencies: must be given, or a reader instead"),
        (
            'inputs = ["solver.py"]',
            'reader = "ansys"',
            "model.reader: must be 'uff', 'oma', 'f06' or 'calculix' (got 'ansys')",
        ),
        ('inputs = ["solver.py"]', "shell = true", "model.shell: is not a known key"),
        ('name = "k2"', 'name = "k3"', "model.template: line 2: {k2:.17g} must name one of k1, k3"),
        ('name = "k2"', 'name = "k2"\nproperty = "E"', "parameters.1.property: is allowed for frames only"),
        ('"{deck}", "soft"', '"{deck}", "exit"', "model.command: must work at the start [1.0, 1.0] ("),
        ('"{deck}", "soft"', '"{deck}", "nan"', "frequencies: must be finite"),
        ("frequencies = [0.65, 1.65]", "frequencies = [0.65, 1.65, 2.0]", "numbers [1, 2, 3] (gave 2 modes)"),
    ],
)
def test_what_is_wrong_is_told_at_its_place(tmp_path, old, new, said):
    assert old in TOML
    with pytest.raises(ConfigurationError) as told:
        load(folder_of(tmp_path / "a", TOML.replace(old, new)))
    assert said in str(told.value)


def test_an_empty_command(tmp_path):
    text = "\n".join("command = []" if line.startswith("command") else line for line in TOML.splitlines())
    with pytest.raises(ConfigurationError, match=r"model\.command: must have at least 1 item"):
        load(folder_of(tmp_path / "a", text))


def counted(path):
    """Return the values of every run of the program for a problem."""
    counter = path.parent / "runs.txt"
    return counter.read_text().splitlines() if counter.exists() else []


def kill_at(path, n, words):
    """Start a process, and kill it when the program has run n times; return the values of the last run."""
    process = subprocess.Popen([sys.executable, "-c", *words], env=os.environ.copy(), stdout=subprocess.DEVNULL)
    while len(counted(path)) < n and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    time.sleep(0.2)
    return counted(path)[-1:]


def nothing_twice(whole, killed, running):
    """Check the runs of the program: only the start, and those that a kill interrupted, were repeated."""
    assert len(counted(whole)) == len(set(counted(whole)))
    assert set(counted(killed)) == set(counted(whole))
    twice = [values for values in set(counted(killed)) if counted(killed).count(values) > 1]
    assert set(twice) <= {"1 1", *running}
    assert all(counted(killed).count(values) <= 1 + len(running) for values in twice)


def find_maxima(problem):
    """Return the maxima of the two springs by the closed form in SOLVER: the program is not run."""

    def frequencies(theta):
        half = 0.5 * (theta[0] + 2.0 * theta[1])
        return np.sqrt(half + np.array([-1.0, 1.0]) * np.sqrt(half**2 - theta.prod()))

    model = fmu.BlackBoxModel(frequencies, 2)
    twin = fmu.UpdatingProblem(model, problem.data, problem.parameters)
    return fmu.find_map(twin, starts=2)


def sampled(path, directory):
    """Draw, and keep the draws in a directory."""
    kept, problem = fmu.Checkpoint(directory, draws=2), fmu.load(path, pairing="index")
    options = {"maxima": find_maxima(problem), "checkpoint": kept, "progress": False}
    fmu.sample(problem, "mh", draws=2, warmup=2, chains=1, init="start", **options)


def test_a_run_that_is_cut_off_goes_on_without_solving_anything_twice(tmp_path, monkeypatch):
    """It ends after a run of the program and before its answer is kept."""
    whole, broken = (folder_of(tmp_path / name) for name in ("whole", "broken"))
    monkeypatch.setenv("FMU_TEST_COUNTER", str(whole.parent / "runs.txt"))
    sampled(whole, tmp_path / "a")
    monkeypatch.setenv("FMU_TEST_COUNTER", str(broken.parent / "runs.txt"))
    keep = SolveStore.keep

    def cut_at_the_eighth(store, solve):
        if len(counted(broken)) == 8:
            raise Cut
        keep(store, solve)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SolveStore, "keep", cut_at_the_eighth)
        with pytest.raises(Cut):
            sampled(broken, tmp_path / "b")
    running = counted(broken)[-1:]
    sampled(broken, tmp_path / "b")
    assert len(counted(whole)) > 10
    nothing_twice(whole, broken, running)
    assert counted(broken).count(*running) == 2


@pytest.mark.validate
def test_a_killed_process_goes_on_without_solving_anything_twice(tmp_path, monkeypatch):
    whole, killed = (folder_of(tmp_path / name) for name in ("whole", "killed"))
    monkeypatch.setenv("FMU_TEST_COUNTER", str(whole.parent / "runs.txt"))
    sampled(whole, tmp_path / "a")
    monkeypatch.setenv("FMU_TEST_COUNTER", str(killed.parent / "runs.txt"))
    running = kill_at(killed, 8, [RUN, str(killed), str(tmp_path / "b")])
    sampled(killed, tmp_path / "b")
    assert len(counted(whole)) > 10
    nothing_twice(whole, killed, running)


@pytest.mark.validate
def test_a_killed_run_goes_on_without_solving_anything_twice(tmp_path, monkeypatch):
    whole, killed = (folder_of(tmp_path / name) for name in ("whole", "killed"))
    monkeypatch.setenv("FMU_TEST_COUNTER", str(whole.parent / "runs.txt"))
    assert (
        CliRunner().invoke(cli.main, ["run", str(whole), *WHOLE_RUN, "--out", str(tmp_path / "a")]).exit_code == 0
    )
    monkeypatch.setenv("FMU_TEST_COUNTER", str(killed.parent / "runs.txt"))
    n, end = len(counted(whole)), ["run", "--resume", str(tmp_path / "b")]
    program = "from fmu.cli import main; main()"
    running = kill_at(killed, n // 3, [program, "run", str(killed), *WHOLE_RUN, "--out", str(tmp_path / "b")])
    running += kill_at(killed, 2 * n // 3, [program, *end])
    outcome = CliRunner().invoke(cli.main, [*end, "--workers", "2"])
    assert outcome.exit_code == 0, outcome.output
    nothing_twice(whole, killed, running)
    traces = [fmu.load_trace(tmp_path / name / "mh.nc") for name in ("a", "b")]
    for name in ("k1", "k2"):
        assert_array_equal(*(trace["posterior"][name].values for trace in traces))


@CCX
def test_calculix_gives_frequencies_and_shapes_of_its_own_run(tmp_path):
    problem = load(write_template("command", tmp_path))
    assert problem.model.by_shape
    rng = np.random.default_rng(1)
    for theta in rng.uniform(problem.lower, problem.upper, (3, 2)):
        deck = fill_deck(read_deck(tmp_path / "plate.inp.in"), dict(zip(problem.names, theta, strict=True)))
        (tmp_path / "own.inp").write_text(deck)
        subprocess.run(["ccx", "-i", "own"], cwd=tmp_path, check=True, stdout=subprocess.DEVNULL)
        lines = [line.split() for line in (tmp_path / "own.dat").read_text().splitlines()]
        own = [float(words[3]) for words in lines if len(words) == 5 and words[0].isdecimal()]
        assert_array_equal(problem.model.functions[0].at(theta).frequencies, own)
        assert_array_equal(problem.frequencies(theta), np.array(own)[[0, 1, 2, 3]])
    stored = list(problem.model.functions[0].solves)
    assert len(stored) >= 4  # of the start, too
    assert all(solve.shapes.shape == (6, 6) and solve.seconds > 0.0 for solve in stored)
    scaled = problem.frequencies(2.0 * problem.start)
    assert_allclose(scaled, np.sqrt(2.0) * problem.frequencies(problem.start), rtol=1e-6)


def planted(path):
    """Write the frequencies of the truth, 0.2 % off, into the plate's problem file; return the truth."""
    truth = np.array([1.9e11, 2.2e11])
    exact = load(path).frequencies(truth)
    measured = (exact * (1.0 + 0.002 * np.array([1.0, -1.0, 0.5, -0.5]))).tolist()
    text = path.read_text().replace("frequencies = [8.26, 54.70, 77.35, 163.9] ", f"frequencies = {measured} ")
    path.write_text(text.replace("sd = [0.03, 0.2, 0.25, 0.5]", f"sd = {(0.003 * exact).tolist()}"))
    return truth


@CCX
def test_the_density_by_calculix_is_that_of_the_planted_errors(tmp_path):
    path = write_template("command", tmp_path)
    truth = planted(path)
    problem = load(path)
    chi2, density = [], []
    for theta in (truth, truth * [0.95, 1.05]):
        off = (problem.frequencies(theta) - problem.data.frequencies_hz) / problem.data.sd_hz
        chi2.append(np.sum(off**2))
        density.append(problem.log_likelihood(theta))
    assert chi2[0] == pytest.approx((2.0 / 3.0) ** 2 * 2.5, rel=1e-3)  # 0.2 %, and half of it, in sd of 0.3 %
    assert density[0] - density[1] == pytest.approx(0.5 * (chi2[1] - chi2[0]), rel=1e-9)
    assert density[0] - density[1] > 2.0


@CCX
@pytest.mark.validate
def test_draws_by_calculix_are_about_the_planted_truth(tmp_path):
    path = write_template("command", tmp_path)
    truth = planted(path)
    problem = load(path)
    maxima = fmu.find_map(fmu.surrogate(problem))
    trace = fmu.sample(problem, "mh", draws=12, warmup=12, chains=2, init=truth * [[0.98], [1.02]], maxima=maxima)
    draws = np.stack([trace["posterior"][name].values.ravel() for name in ("E1", "E2")])
    assert np.all(np.abs(draws.mean(axis=1) - truth) < 3.0 * draws.std(axis=1))
    assert np.all(draws.std(axis=1) < 0.05 * truth)
    stored = list(problem.model.functions[0].solves)
    assert len(stored) > 20
    assert all(solve.shapes.shape == (6, 6) and solve.seconds > 0.0 for solve in stored)


@CCX
@pytest.mark.validate
def test_a_run_by_calculix_has_the_planted_truth(tmp_path):
    path = write_template("command", tmp_path)
    truth = planted(path)
    words = ["run", str(path), "--draws", "150", "--warmup", "60", "--starts", "2", "--workers", "2"]
    outcome = CliRunner().invoke(cli.main, [*words, "--progress", "none", "--out", str(tmp_path / "a")])
    assert outcome.exit_code == 0, outcome.output
    draws = fmu.load_trace(tmp_path / "a" / "mixture.nc")["posterior"]
    for name, value in zip(("E1", "E2"), truth, strict=True):
        assert abs(float(draws[name].mean()) - value) < 3.0 * float(draws[name].std())
        assert float(draws[name].std()) < 0.05 * value


@CCX
def test_a_deck_that_calculix_refuses_says_what_it_printed(tmp_path):
    path = write_template("command", tmp_path)
    deck = tmp_path / "plate.inp.in"
    deck.write_text(deck.read_text().replace("*SHELL SECTION, ELSET=ROOT", "*SHELL SECTION, ELSET=ROOTS"))
    with pytest.raises(ConfigurationError, match=r"model\.command: must work at the start .* \*ERROR"):
        load(path)
    assert shutil.which("ccx")


@CCX
def test_a_sensor_that_is_not_printed(tmp_path):
    path = write_template("command", tmp_path)
    text = path.read_text()
    path.write_text(text.replace('[7, "z"]', '[9, "z"]'))
    with pytest.raises(ConfigurationError, match=r"has no displacement of node 9: it must be in a \*NODE PRINT"):
        load(path)
    path.write_text(text.replace('[7, "z"]', '[7, "rx"]'))
    with pytest.raises(ConfigurationError, match=r"measurement\.sensors\.0: must be a point and a direction"):
        load(path)
