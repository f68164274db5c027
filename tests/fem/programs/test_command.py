"""A program run for every theta: what it gives, is stored, and everything that can be wrong with it."""

import json
import os
import runpy
import signal
import subprocess
import sys
import threading
import time
from contextlib import chdir, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fmu
from fmu.config.measurement import MeasurementTable
from fmu.config.models.command import CommandTable
from fmu.engines.process_pool import ProcessPool
from fmu.engines.program import run_program
from fmu.fem.programs import deck_run
from fmu.fem.programs.command import CommandError
from fmu.formats.modes import READERS

SOLVER = Path(__file__).with_name("solver.py")
DECK = "k1 {k1}\nk2 {k2:.16e}\n"
FREQUENCIES = {"file": "{job}.dat", "pattern": r"^mode \d+ frequency (\S+) Hz$"}
THETA = np.array([1.2, 0.7])


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Return a function with the values for which the program has run."""
    monkeypatch.setenv("FMU_TEST_COUNTER", str(tmp_path / "runs.txt"))
    return lambda: (tmp_path / "runs.txt").read_text().splitlines() if (tmp_path / "runs.txt").exists() else []


@pytest.fixture
def solved_here(monkeypatch):
    """Run the solver in this process, where a process of its own is not the point of a test."""

    def run(command, folder, output, timeout_s):
        with open(output, "w") as file, chdir(folder), redirect_stdout(file):
            monkeypatch.setattr(sys, "argv", command[command.index("solver.py") :])
            try:
                runpy.run_path("solver.py")
            except SystemExit as end:
                return f"ended with exit code {end.code}" if end.code else ""
        return ""

    monkeypatch.setattr(deck_run, "run_program", run)


def command_model(folder, how="", **changes):
    (folder / "springs.txt.in").write_text(changes.pop("deck", DECK))
    (folder / "solver.py").write_bytes(SOLVER.read_bytes())
    given = {
        "names": ["k1", "k2"],
        "template": "springs.txt.in",
        "command": [sys.executable, "-I", "-S", "solver.py", "{deck}", how],
        "frequencies": fmu.FoundFrequencies(**FREQUENCIES),
        "inputs": ["solver.py"],
        "folder": folder,
    }
    return fmu.CommandModel(**given | changes)


def exact(theta):
    K = np.array([[theta[0] + theta[1], -theta[1]], [-theta[1], theta[1]]])
    return np.sqrt(np.linalg.eigvalsh(K))


def problem(model):
    parameters = [fmu.Parameter(name, 1.0, 0.5, 1.5) for name in ("k1", "k2")]
    return fmu.UpdatingProblem(model, fmu.ModalData([0.62, 1.62]), parameters, beta=0.5 / 0.01**2)


def test_frequencies_are_those_of_the_program_with_all_digits(tmp_path, runs):
    model = command_model(tmp_path)
    for theta in (THETA, np.array([1 / 3, 2 / 3])):
        assert_allclose(model.at(theta).frequencies, exact(theta), rtol=1e-13)
    assert len(runs()) == 2
    assert runs()[0].split()[1] == "6.9999999999999996e-01"  # as {k2:.16e} says
    [folder] = (tmp_path / "solves").iterdir()
    assert list((folder / "running").iterdir()) == []  # folders of runs that went well are removed


@pytest.mark.parametrize(
    "form",
    ["{k2:.2f}", "{k2}", *(pytest.param(form, marks=pytest.mark.validate) for form in ("{k2:.3f}", "{k2:8}"))],
)
def test_gradients_of_a_deck_that_rounds(tmp_path, solved_here, form):
    """Differences are divided by the distance in the deck, which is another one, or 0, for the step of 1e-3."""
    model = command_model(tmp_path, deck=f"k1 {{k1:16}}\nk2 {form}\n")
    parameters = [fmu.Parameter("k1", 1.0, 0.5, 1.5), fmu.Parameter("k2", 1.0, 0.2, 10.3)]
    paired = fmu.UpdatingProblem(model, fmu.ModalData([0.62, 1.62]), parameters).model
    theta = np.array([[1.2, 0.7], [0.9033, 4.12345], [0.777, 10.2951]])
    rounded = model.round_values(theta)
    h = 1e-6
    expected = np.array(
        [np.transpose([(exact(x + h * e) - exact(x - h * e)) / (2 * h) for e in np.eye(2)]) for x in rounded]
    )
    assert_allclose(paired.frequencies_and_gradient(theta)[1], expected, rtol=0.02, atol=1e-5)


def test_a_deck_with_too_few_digits(tmp_path, solved_here):
    model = command_model(tmp_path, deck="k1 {k1:.1f}\nk2 {k2}\n")
    with pytest.raises(
        ValueError, match=r"more digits of parameter 1, as \{NAME\} .*\{NAME:16\} .*multiples of 0.1"
    ):
        problem(model)


def test_nothing_is_solved_twice_by_any_model_or_process(tmp_path, runs):
    model = command_model(tmp_path)
    theta = np.random.default_rng(1).uniform(0.5, 1.5, (6, 2))
    first = [answer.frequencies for answer in model.answers(theta)]
    again = command_model(tmp_path)
    assert_array_equal([answer.frequencies for answer in again.answers(theta)], first)
    assert len(runs()) == 6
    with ProcessPool(1) as engine, again.spread_over(engine):
        assert_array_equal([answer.frequencies for answer in again.answers(theta)], first)
        more = [answer.frequencies for answer in again.answers(theta + 0.1)]
    assert_allclose(more, [exact(point) for point in theta + 0.1], rtol=1e-13)
    assert len(runs()) == len(set(runs())) == 12


def test_the_store_gives_theta_frequencies_time_and_reasons(tmp_path):
    model = command_model(tmp_path, "soft")
    model.answers(np.array([[1.2, 0.7], [0.8, 0.7]]))
    well, badly = sorted(model.solves, key=lambda solve: bool(solve.reason))
    assert_array_equal(well.theta, [1.2, 0.7])
    assert_allclose(well.frequencies, exact(THETA), rtol=1e-13)
    assert well.shapes is None
    assert well.seconds > 0.0
    assert_array_equal(badly.theta, [0.8, 0.7])
    assert len(badly.frequencies) == 0
    assert "ended with exit code 1; it printed at the end: solving for k1 = 0.8 / *ERROR: negative pivot" in (
        badly.reason
    )
    assert fmu.SolveStore(model.solves.folder).find(THETA).seconds == well.seconds


def test_what_a_solve_depends_on_is_in_the_name_of_its_store(tmp_path, runs, solved_here):
    def ran(**changes):
        command_model(tmp_path, **changes).solve(THETA)
        return len(runs())

    assert ran() == 1
    assert ran(timeout=50.0, retries=1) == 1
    assert ran(deck=DECK + "damping 0.0\n") == 2
    assert ran(how="other") == 3
    (tmp_path / "more.txt").write_text("1")
    assert ran(inputs=["solver.py", "more.txt"]) == 4
    (tmp_path / "more.txt").write_text("2")
    assert ran(inputs=["solver.py", "more.txt"]) == 5
    assert ran() == 5


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("exit", r"ended with exit code 1; it printed at the end: solving for k1 = 1\. / \*ERROR: no licence"),
        ("crash", r"was ended by SIGABRT; it printed at the end: solving for"),
        ("nothing", r"no such file: .*springs\.dat; it printed"),
        ("garbage", r"springs\.dat has nothing that the pattern '.*' matches"),
        ("words", r"springs\.dat: the pattern must match numbers \(got 'none'\)"),
        ("nan", r"frequencies: must be finite \(got \[0\.\d+, nan\]\)"),
        ("half", r"springs\.dat has nothing that the pattern"),
    ],
)
def test_a_solve_that_fails_says_what_happened(tmp_path, runs, how, said):
    model = command_model(tmp_path, how)
    with pytest.raises(ValueError, match=said):
        problem(model)
    with pytest.raises(ValueError, match=f"model.command: must work at the start .*{said}"):
        problem(model)
    assert len(runs()) == 1  # the failure is stored
    failed = model.solves.failed_folder(np.array([1.0, 1.0]))
    assert (failed / "springs.txt").read_text().startswith("k1 1.")
    assert (failed / "output.txt").read_text().startswith("solving for k1 = 1.")


def test_a_point_that_fails_does_not_stop_a_run(tmp_path):
    found = problem(command_model(tmp_path, "soft"))
    log_prob = found.log_prob([[1.0, 1.0], [0.7, 1.0], [1.1, 1.0]])
    assert np.isfinite(log_prob).tolist() == [True, False, True]
    [(theta, reason)] = found.model.reasons
    assert_array_equal(theta, [0.7, 1.0])
    assert "negative pivot" in reason


def test_a_program_that_hangs_is_ended_with_its_children(tmp_path):
    model = command_model(tmp_path, "hang", timeout=0.6)
    began = time.monotonic()
    solve = model.solve(THETA)
    assert time.monotonic() - began < 10.0
    assert "took longer than the time limit of 0.6 s; it printed at the end: solving for k1 = 1.2" in solve.reason


def test_with_a_longer_time_limit_it_is_tried_again(tmp_path, runs, monkeypatch):
    monkeypatch.setenv("FMU_TEST_SECONDS", "1.0")
    for _ in range(2):
        assert command_model(tmp_path, "slow", timeout=0.7).solve(THETA).reason
    assert len(runs()) == 1
    model = command_model(tmp_path, "slow", timeout=60.0)
    assert_allclose(model.solve(THETA).frequencies, exact(THETA), rtol=1e-13)
    assert len(list(model.solves)) == 1
    assert len(runs()) == 2


def test_a_run_that_fails_is_repeated(tmp_path, runs, solved_here):
    model = command_model(tmp_path, "exit", retries=2)
    assert model.solve(THETA).reason
    assert len(runs()) == 3


def test_folders_are_kept_if_asked_and_only_some_of_those_that_failed(tmp_path, solved_here):
    kept = command_model(tmp_path, keep=True)
    kept.solve(THETA)
    [folder] = (kept.solves.folder / "running").iterdir()
    assert sorted(path.name for path in folder.iterdir()) == [
        "output.txt",
        "solver.py",
        "springs.dat",
        "springs.txt",
    ]
    failing = command_model(tmp_path, "exit")
    for k in range(22):
        failing.solve(np.array([1.0, 1.0 + k]))
    folders = [path for path in (failing.solves.folder / "failed").iterdir() if path.is_dir()]
    assert len(folders) == 20
    assert sum(bool(solve.reason) for solve in failing.solves) == 22


def test_a_damaged_file_of_the_store_is_solved_again(tmp_path, runs, solved_here):
    model = command_model(tmp_path)
    model.solve(THETA)
    [path] = model.solves.folder.glob("*.json")
    whole = path.read_bytes()
    for damaged in (b"", whole[:-10], b"x" * len(whole), whole.replace(b"0.7", b"0.8")):
        path.write_bytes(damaged)
        assert list(model.solves) == []
        assert_allclose(command_model(tmp_path).solve(THETA).frequencies, exact(THETA), rtol=1e-13)
    assert len(runs()) == 5
    assert json.loads(path.read_bytes().split(b"\n", 2)[2])["theta"] == THETA.tolist()


def test_two_runs_at_once_solve_each_theta_once(tmp_path, runs):
    theta = np.random.default_rng(2).uniform(0.5, 1.5, (5, 2))
    both = [command_model(tmp_path, "slow") for _ in range(2)]
    threads = [threading.Thread(target=model.answers, args=(theta,)) for model in both]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(runs()) == 5
    assert_allclose([one.solve(point).frequencies for one in both for point in theta],
                    [exact(point) for _ in both for point in theta], rtol=1e-13)  # fmt: skip


def test_no_shell_sees_a_value_or_a_name(tmp_path):
    bad = "x; touch pwned; $(touch pwned) `touch pwned` && touch pwned"
    (tmp_path / "echo.py").write_text("import sys; print('frequency', 1.0, sys.argv[1:])\n")
    model = command_model(
        tmp_path,
        command=[sys.executable, "-I", "echo.py", bad, "{job}"],
        inputs=["echo.py"],
        frequencies=fmu.FoundFrequencies("output.txt", r"frequency (\S+)"),
    )
    solve = model.solve(THETA)
    assert solve.frequencies.tolist() == [1.0]
    assert not list(tmp_path.rglob("pwned"))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"deck": "k1 1.0\n"}, r"template: must have a placeholder, as \{k1\} \(it has none\)"),
        ({"deck": "k1 {k1}\n"}, r"template: must have the placeholder \{k2\} \(it has none\)"),
        ({"deck": "k1 {k1}\nk2 {k2}\nk3 {k3}\n"}, r"template: line 3: \{k3\} must name one of k1, k2"),
        ({"template": "none.in"}, r"template: must be a text file \(no such file: .*none\.in\)"),
        ({"template": "."}, r"template: must be a text file \(.* is a directory\)"),
        ({"command": []}, r"command: must be a list of a program and its arguments \(got \[\]\)"),
        ({"command": [""]}, r"command: must be a list"),
        (
            {"command": ["ccx-9.9", "x"]},
            r"command\.0: must be a program that is installed, on the PATH, and may be",
        ),
        ({"command": ["./solver.py"]}, r"command\.0: must be a program that is beside the file, and may be run"),
        (
            {"command": [sys.executable, "{k1}"]},
            r"command\.1: may have \{job\} and \{deck\} in braces \(got \{k1\}\)",
        ),
        ({"frequencies": None}, r"frequencies: must be given, or a reader instead"),
        ({"reader": "calculix"}, r"frequencies: must be given, or a reader instead"),
        (
            {"frequencies": None, "reader": "nastran"},
            r"reader: must be one of uff, oma, f06, calculix \(got",
        ),
        ({"inputs": ["mesh.inp"]}, r"inputs\.0: no such file"),
        ({"inputs": ["springs.txt"]}, r"inputs\.0: must not have the name of the deck"),
        ({"timeout": 0.0}, r"timeout: must be positive, in seconds \(got 0\.0\)"),
        ({"retries": -1}, r"retries: must be from 0 to 100 \(got -1\)"),
    ],
)
def test_what_is_wrong_with_a_command_is_told_at_the_start(tmp_path, changes, said):
    (tmp_path / "springs.txt").write_text("")
    with pytest.raises(CommandError, match=said):
        command_model(tmp_path, **changes)


def test_what_is_no_text_and_no_number(tmp_path):
    for changes, said in (
        ({"command": ["a\0b"]}, r"command\.0: must be text"),
        ({"timeout": float("nan")}, "timeout: must be a finite"),
    ):
        with pytest.raises(ValueError, match=said):
            command_model(tmp_path, deck="k1 {k1} {k2}", **changes)


def test_all_mistakes_are_told_together(tmp_path):
    with pytest.raises(CommandError) as told:
        command_model(tmp_path, deck="k1 {k1}", command=["none"], inputs=["no", "nor"], retries=1000)
    assert [mistake.key for mistake in told.value.mistakes] == [
        "retries", "template", "command.0", "inputs.0", "inputs.1"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("pattern", "said"),
    [
        ("(", r"pattern: must be a regular expression \(missing \), unterminated subpattern"),
        (r"frequency \S+", r"pattern: must have one group, as \(…\), for the frequency \(got 0 groups\)"),
        (r"(\d+) (\S+)", r"pattern: must have one group, .* \(got 2 groups\)"),
    ],
)
def test_patterns(pattern, said):
    with pytest.raises(ValueError, match=said):
        fmu.FoundFrequencies("{job}.dat", pattern)


def test_a_result_file_with_a_placeholder_of_its_own():
    with pytest.raises(ValueError, match=r"file: may have \{job\} and \{deck\} in braces \(got \{E\}\)"):
        fmu.FoundFrequencies("{E}.dat", "(x)")


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def gone(pids):
    end = time.monotonic() + 10.0
    while any(map(alive, pids)) and time.monotonic() < end:
        time.sleep(0.05)
    return not any(map(alive, pids))


PARENT = """\
import sys
from pathlib import Path
from fmu.engines.program import run_program
here = Path(sys.argv[1])
run_program([sys.executable, "-I", "-S", "-c", sys.argv[2], str(here / "pids")], here, here / "out", 60.0)
"""
POOL = """\
import sys
from pathlib import Path
import fmu
from fmu.engines.program import run_program
here = Path(sys.argv[1])
def work(shared, task, report):
    return run_program([sys.executable, "-I", "-S", "-c", shared, str(here / "pids")], here, here / "out", 60.0)
with fmu.engine(workers=2) as engine:
    engine.run_tasks(work, sys.argv[2], [0])
"""
FAMILY = """\
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-I", "-S", "-c", "import time; time.sleep(60)"])
open(sys.argv[1] + ".new", "w").write(f"{os.getpid()} {child.pid}")
os.replace(sys.argv[1] + ".new", sys.argv[1])
time.sleep(60)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    ("script", "by"),
    [
        (PARENT, "SIGKILL"),
        (PARENT, "SIGINT"),
        (POOL, "SIGKILL"),
        *(pytest.param(*given, marks=pytest.mark.validate) for given in ((PARENT, "SIGTERM"), (POOL, "SIGINT"))),
    ],
)
def test_a_program_ends_with_the_process_that_runs_it(tmp_path, script, by):
    parent = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path), FAMILY], stderr=subprocess.DEVNULL, env=os.environ.copy()
    )
    end = time.monotonic() + 30.0
    while not (tmp_path / "pids").exists() and time.monotonic() < end:
        time.sleep(0.05)
    pids = [int(pid) for pid in (tmp_path / "pids").read_text().split()]
    assert all(map(alive, pids))
    parent.send_signal(getattr(signal, by))
    parent.wait(timeout=30.0)  # half of what the program takes by itself
    assert gone(pids)


def test_a_time_limit_ends_children_too(tmp_path):
    why = run_program([sys.executable, "-I", "-S", "-c", FAMILY, "pids"], tmp_path, tmp_path / "out", 1.5)
    assert why == "took longer than the time limit of 1.5 s"
    assert gone([int(pid) for pid in (tmp_path / "pids").read_text().split()])


def test_a_file_that_cannot_be_started(tmp_path):
    (tmp_path / "program").write_text("no program")
    (tmp_path / "program").chmod(0o755)
    why = run_program([str(tmp_path / "program")], tmp_path, tmp_path / "out", 5.0)
    assert why == "ended with exit code 1"
    assert "cannot be started: Exec format error" in (tmp_path / "out").read_text()


F06 = """\
import sys
deck = dict(line.split() for line in open("springs.txt"))
for mode, key in ((1, "k1"), (2, "k2")):
    print(f"    CYCLES = {float(deck[key]):.6E}    R E A L   E I G E N V E C T O R   N O .    {mode}")
    print("             7      G      1.000000E+00   0.0           -2.500000E-01   0.0   0.0   5.000000E-01")
"""


@pytest.mark.parametrize("result", [None, "{job}.f06", "output.txt"])
def test_any_reader_of_modes_serves_a_command(tmp_path, result):
    """Frequencies and shapes of an F06, whose name may be in capitals; rotations too."""
    to = "springs.F06" if result is None else "springs.f06" if result == "{job}.f06" else ""
    program = F06 if not to else F06.replace("import sys\n", f"import sys\nsys.stdout = open('{to}', 'w')\n")
    model = command_model(tmp_path, frequencies=None, reader="f06", result=result)
    (tmp_path / "solver.py").write_text(program)
    assert model.sees((7, "-rz"))
    assert not model.sees(("seven", "x"))
    answer = model.at_sensors([(7, "-z"), (7, "rz")]).at(THETA)
    assert_array_equal(answer.frequencies, THETA)
    assert_array_equal(answer.shapes, [[0.25, 0.25], [0.5, 0.5]])


def test_shapes_are_turned_from_the_axes_of_the_deck(tmp_path):
    """Nodes of the deck have output coordinate systems, as in `tests.formats.modes.test_f06`."""
    files = Path(__file__).parents[2] / "formats" / "models" / "nastran"
    (tmp_path / "turned.bdf.in").write_text("$ {k1} {k2}\n" + (files / "turned.bdf").read_text())
    copy = "import shutil; shutil.copy('turned.f06', 'deck.f06')"
    (tmp_path / "turned.f06").write_bytes((files / "turned.f06").read_bytes())
    model = fmu.CommandModel(
        ["k1", "k2"],
        "turned.bdf.in",
        [sys.executable, "-c", copy],
        reader="f06",
        result="deck.f06",
        inputs=["turned.f06"],
        folder=tmp_path,
    )
    sensors = [(205, "x"), (303, "-z"), (410, "rx")]
    answer = model.at_sensors(sensors).at(THETA)
    expected = READERS["f06"].read(files / "turned.f06", sensors, files / "turned.bdf")
    assert_array_equal(answer.frequencies, expected.frequencies_hz)
    assert_array_equal(answer.shapes, expected.shapes)


def test_what_bulk_data_include_is_beside_the_deck(tmp_path):
    """It is copied without being named among the inputs, and what was solved with another content is not used."""
    copy = "import shutil; shutil.copy('parts/nodes.bdf', 'out.f06')"
    (tmp_path / "parts").mkdir()
    (tmp_path / "deck.bdf.in").write_text("$ {k1}\nINCLUDE 'parts/nodes.bdf'\n")
    found = []
    for cycles in ("1.0", "2.0"):
        (tmp_path / "parts" / "nodes.bdf").write_text(
            f"$   CYCLES = {cycles}    R E A L   E I G E N V E C T O R   N O .    1\n"[1:]
            + "             7      G      1.000000E+00\n"
        )
        model = fmu.CommandModel(
            ["k1"],
            "deck.bdf.in",
            [sys.executable, "-c", copy],
            frequencies=fmu.FoundFrequencies("out.f06", r"CYCLES = (\S+)"),
            folder=tmp_path,
        )
        assert model.run.inputs == ("parts/nodes.bdf",)
        found.append(model.at(np.array([1.0])).frequencies[0])
    assert found == [1.0, 2.0]


def test_the_registry_of_readers_is_one():
    schema = CommandTable.model_json_schema()["properties"]["reader"]["anyOf"][0]
    assert tuple(schema["enum"]) == tuple(READERS)
    assert set(READERS) < set(MeasurementTable.model_fields)
