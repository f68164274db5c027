"""A plate of CalculiX, updated with a test in axes and units of its own, and back into CalculiX and ParaView."""

import shutil

import numpy as np
import pytest

import fmu
from fmu.fem.modes.modal import mac
from tests.formats.models.test_calculix import own, own_shapes
from tests.formats.models.test_calculix import run as calculix
from tests.report.exported import run
from tests.report.test_mode_files import arrays

pytestmark = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not installed")

DECK = """\
** E1: {{E1}}, sd {{E1 sd}}
*NODE
{nodes}
*ELEMENT, TYPE=S4, ELSET=INNER
{inner}
*ELEMENT, TYPE=S4, ELSET=OUTER
{outer}
*MATERIAL, NAME=FIRST
*ELASTIC
{{E1}}, 0.3
*DENSITY
7850.
*MATERIAL, NAME=SECOND
*ELASTIC
{{E2}}, 0.3
*DENSITY
7850.
*SHELL SECTION, ELSET=INNER, MATERIAL=FIRST
0.02
*SHELL SECTION, ELSET=OUTER, MATERIAL=SECOND
0.02
*BOUNDARY
{held}
*STEP
*FREQUENCY
4
*NODE FILE, OUTPUT=2D
U
*END STEP
"""
TRUTH = {"E1": 1.9e11, "E2": 2.25e11}
STORED = {"first": (2.1e11, 2.1e11), "inner": (2.4e11, 2.1e11), "outer": (2.1e11, 2.4e11)}
MEASURED = [1020, 1040, 1060, 1080, 1033, 1052, 1071, 1024, 1044, 1064, 1084, 1083]
TURN = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Of the model's axes into those of the test: z of the model is −y there."""


def template():
    """A clamped plate of 8 × 4 shells of 0.1 m, of two materials; node 1000 + 10 i + j."""
    place = {1000 + 10 * i + j: (0.1 * i, 0.1 * j, 0.0) for i in range(9) for j in range(5)}
    quads = {
        4 * i + j + 1: [1000 + 10 * (i + a) + j + b for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
        for i in range(8)
        for j in range(4)
    }
    rows = [f"{k}, " + ", ".join(map(str, nodes)) for k, nodes in quads.items()]
    return place, DECK.format(
        nodes="\n".join(f"{node}, {x}, {y}, {z}" for node, (x, y, z) in place.items()),
        inner="\n".join(rows[:16]),
        outer="\n".join(rows[16:]),
        held="\n".join(f"{1000 + 10 * i + j}, 1, 3" for i in (0, 1) for j in range(5)),
    )


def with_values(text, E1, E2):
    return text.replace("{E1 sd}", "?").replace("{E1}", f"{E1!r}").replace("{E2}", f"{E2!r}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files of the engineer: the deck as a template, three exports, the points of the test, the problem."""
    folder = tmp_path_factory.mktemp("plate")
    place, text = template()
    (folder / "plate.inp.in").write_text(text)
    for name, values in STORED.items():
        stored = with_values(text, *values).replace("*FREQUENCY", "*FREQUENCY, SOLVER=MATRIXSTORAGE")
        calculix(folder, name, stored)
    truth = calculix(folder, "truth", with_values(text, **TRUTH))
    hz, shapes = own(truth, 4), own_shapes(truth)
    rows = ["point,x,y,z"]
    for node in MEASURED:
        x, y, z = 1e3 * (TURN @ place[node] + [5.0, -1.0, 2.0])
        rows.append(f"P{node},{x},{y},{z}")
    (folder / "points.csv").write_text("\n".join(rows))
    noise = np.random.default_rng(1).normal(size=(4, len(MEASURED)))
    seen = [[-shape[node][2] for node in MEASURED] for shape in shapes]  # along y of the test
    seen = np.array(seen) + 0.01 * np.abs(seen).max(axis=1, keepdims=True) * noise
    exports = "\n".join(
        f'[[model.exports]]\nstiffness = "{name}.sti"\nvalues = {{ E1 = {a}, E2 = {b} }}'
        for name, (a, b) in STORED.items()
    )
    parameters = "\n".join(
        f'[[parameters]]\nname = "{name}"\nstart = 2.1e11\nlower = 1.5e11\nupper = 2.7e11\nunit = "N/m²"'
        for name in TRUTH
    )
    (folder / "plate.toml").write_text(f"""
name = "plate"
[model]
type = "exports"
mesh = "first.inp"
{exports}
[measurement]
frequencies = {hz.tolist()}
sd = {(2e-3 * hz).tolist()}
sensors = {[[f"P{node}", "y"] for node in MEASURED]}
shapes = {seen.tolist()}
[measurement.geometry]
file = "points.csv"
unit = "mm"
nodes = {{ P1020 = 1020, P1080 = 1080, P1084 = 1084 }}
[export]
templates = ["plate.inp.in"]
{parameters}
""")
    return folder


def test_the_points_of_the_test_are_the_nodes_that_they_were(folder):
    data = fmu.load(folder / "plate.toml").data
    assert data.sensors == tuple((node, "-z") for node in MEASURED)
    assert data.points.distances == pytest.approx(np.zeros(len(MEASURED)), abs=1e-9)


def test_the_check_finds_nothing_wrong_and_names_two_exchanged_cables(folder):
    good = fmu.check(fmu.load(folder / "plate.toml"), draws=5)
    assert good.sensor_doubts == ()
    assert good.modes.table()["mac"].min() > 0.99
    wrong = (folder / "plate.toml").read_text().replace("'P1083', 'y'", "'P1033', 'y'", 1)
    before = wrong.index("'P1033', 'y'")
    wrong = wrong[:before] + "'P1083', 'y'" + wrong[before + len("'P1033', 'y'") :]
    (folder / "wrong.toml").write_text(wrong)
    bad = fmu.check(fmu.load(folder / "wrong.toml"), draws=5)
    (said,) = bad.sensor_doubts
    assert said.startswith("Sensors 1083 -z and 1033 -z: exchanged, they would agree with the model")


def test_there_and_back(folder, tmp_path):
    problem, trace = run(folder / "plate.toml", tmp_path / "out", draws=150, warmup=150)
    for name, value in TRUTH.items():
        draws = trace["posterior"][name].to_numpy()
        assert abs(draws.mean() - value) < 4 * draws.std()
    written = fmu.export(tmp_path / "out")
    assert {"plate.inp", "modes.vtu", "updated.uff", "measured.uff"} <= set(written.files)
    updated = fmu.load(written.directory / "updated.toml", pairing="shape").start
    solved = calculix(tmp_path, "updated", (written.directory / "plate.inp").read_text())
    assert own(solved, 4) == pytest.approx(problem.frequencies(updated), rel=1e-5)
    found = arrays(written.directory / "modes.vtu")
    assert found["types"].ravel().tolist() == [9] * 32
    nodes = found["node"].ravel().tolist()
    for k, shape in enumerate(own_shapes(solved)):
        moved = np.array([shape.get(node, [0.0] * 3) for node in nodes])
        for kind, least in (("updated", 1 - 1e-6), ("measured", 0.999)):
            (name,) = (name for name in found if name.startswith(f"{kind} {k + 1}:"))
            drawn = found[name].astype(float)
            assert mac(drawn.reshape(-1, 1), moved.reshape(-1, 1))[0, 0] > least
    again = fmu.ModalData.from_uff(written.directory / "measured.uff")
    order = [again.sensors.index((node, "z")) for node in MEASURED]
    assert again.shapes[order] == pytest.approx(-np.asarray(problem.data.shapes), rel=1e-4, abs=1e-8)
