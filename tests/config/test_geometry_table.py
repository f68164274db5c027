"""``[measurement.geometry]``: sensors named by points of the test, in its axes and units."""

import numpy as np
import pytest
import pyuff
from scipy.spatial.transform import Rotation

import fmu
from fmu.config import ConfigurationError, load
from fmu.report.check_page import check_page
from tests.config.conftest import FRAME

GIVEN = 'sensors = [["corner", "x"], ["other", "y"]]\n'
PLACES = {
    "P1": [0.0, 0.0, 2 / 3], "P2": [0.0, 0.0, 4 / 3], "P3": [0.0, 0.0, 2.0], "P4": [0.75, 0.0, 2.0],
    "P5": [1.5, 0.0, 2.0], "P6": [2.25, 0.0, 2.0], "P7": [3.0, 0.0, 2.0], "P8": [3.0, 0.0, 4 / 3],
}  # fmt: skip
TURN = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
"""Of the model's axes into those of the test: x of the model is −z there, y is −x, z is y."""
SENSORS = 'sensors = [["P3", "-z"], ["P7", "-x"], ["P5", "y"]]\n'
MM = 'file = "points.csv"\nunit = "mm"'
KNOWN = '[measurement.geometry.nodes]\nP1 = 1\nP3 = "corner"\nP7 = "other"\n'


def in_the_test(factor=1e3):
    return {name: factor * (TURN @ place + [1.0, 2.0, -3.0]) for name, place in PLACES.items()}


def write_csv(path, points):
    rows = "".join(f"{name},{x},{y},{z}\n" for name, (x, y, z) in points.items())
    path.write_text(f"point,x,y,z\n{rows}")


def frame(tmp_path, sensors, geometry):
    text = FRAME.replace(GIVEN, f"{sensors}\n[measurement.geometry]\n{geometry}\n")
    (tmp_path / "portal.toml").write_text(text)
    return tmp_path / "portal.toml"


def test_points_of_a_turned_test_in_mm(tmp_path):
    write_csv(tmp_path / "points.csv", in_the_test())
    problem = load(frame(tmp_path, SENSORS, f'file = "points.csv"\nunit = "mm"\n{KNOWN}'))
    corner, other = (load(_plain(tmp_path)).data.sensors[k][0] for k in (0, 1))
    middle = problem.data.sensors[2][0]
    assert problem.data.sensors == ((corner, "x"), (other, "y"), (middle, "z"))
    assert problem.model.structure.geometry.nodes[middle] == pytest.approx([1.5, 0.0, 2.0])
    assert problem.data.points.distances == pytest.approx(np.zeros(8), abs=1e-9)
    assert problem.data.points.doubts == ()


def _plain(tmp_path):
    (tmp_path / "plain.toml").write_text(FRAME)
    return tmp_path / "plain.toml"


def test_a_universal_file_has_them_too(tmp_path):
    points = in_the_test(1.0)
    numbers = [int(name[1:]) for name in points]
    x, y, z = np.array(list(points.values())).T
    for kind in (15, 2411):
        columns = {"def_cs": [0] * 8, "disp_cs": [0] * 8, "color": [1] * 8}
        dataset = {"type": kind, "node_nums": numbers, "x": x, "y": y, "z": z, **columns}
        pyuff.UFF(str(tmp_path / "test.unv")).write_sets([dataset], mode="overwrite")
        known = KNOWN.replace("P", "")
        found = load(frame(tmp_path, SENSORS.replace("P", ""), f'file = "test.unv"\n{known}')).data.sensors
        assert [direction for _, direction in found] == ["x", "y", "z"]


def test_without_known_nodes_a_symmetric_frame_is_ambiguous_and_the_check_says_so(tmp_path):
    write_csv(tmp_path / "points.csv", in_the_test())
    problem = load(frame(tmp_path, SENSORS, 'file = "points.csv"\nunit = "mm"'))
    found = fmu.check(problem, draws=5)
    assert any("the mesh as well as the one" in doubt for doubt in found.doubts)
    verdict = next(v for v in check_page(found).verdicts if "sensors" in v.question)
    assert verdict.is_good is False
    said = " ".join(str(found).split())
    assert "To fit the mesh the points of the test were turned by" in said
    assert "8 points are on nodes of the mesh" in said
    known = fmu.check(load(frame(tmp_path, SENSORS, f'file = "points.csv"\nunit = "mm"\n{KNOWN}')), draws=5)
    verdict = next(v for v in check_page(known).verdicts if "sensors" in v.question)
    assert (verdict.answer, verdict.is_good) == ("Yes", True)


def test_points_in_the_file_itself(tmp_path):
    points = "points = { a = [0.0, 0.0, 2.0], b = [1.5, 0.0, 2.0], c = [3.0, 0.02, 2.0] }"
    problem = load(frame(tmp_path, 'sensors = [["a", "x"], ["b", "z"]]', points))
    assert [direction for _, direction in problem.data.sensors] == ["x", "z"]
    assert np.array_equal(problem.data.points.rotation, np.eye(3))
    assert problem.data.points.table()["distance"].to_list() == pytest.approx([0.0, 0.0, 0.02])


def test_a_test_at_an_angle_with_three_components_at_each_point(tmp_path):
    """The same data as in the axes of the model; without all three components it is refused."""
    turn = Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix()
    points = {name: turn @ place for name, place in PLACES.items()}
    motion = np.random.default_rng(2).normal(size=(2, 2, 3))  # modes, points, components in the model's axes
    seen = np.einsum("ab,mpb->mpa", turn, motion).reshape(2, 6).tolist()
    write_csv(tmp_path / "points.csv", points)
    sensors = [[point, axis] for point in ("P3", "P7") for axis in "xyz"]
    text = f"sensors = {sensors}\nshapes = {seen}"
    known = f'file = "points.csv"\n{KNOWN}'
    data = load(frame(tmp_path, text, known)).data
    assert data.sensors == tuple((node, axis) for node in (3, 4) for axis in "xyz")
    assert data.shapes == pytest.approx(motion.reshape(2, 6).T, abs=1e-6)
    with pytest.raises(
        ConfigurationError, match=r"measurement\.sensors: must be along an axis of the model .* off"
    ):
        load(frame(tmp_path, 'sensors = [["P3", "x"]]', known))


@pytest.mark.parametrize(
    ("sensors", "geometry", "rule"),
    [
        (SENSORS, "", "measurement.geometry: must have either file or points"),
        (SENSORS, 'file = "none.csv"', "measurement.geometry.file: must be a file (no such file"),
        (SENSORS, 'file = "points.csv"\nunit = "km"', "measurement.geometry.unit: "),
        (SENSORS, 'file = "points.csv"', "measurement.geometry.file: must fit the mesh"),
        (SENSORS, 'file = "points.csv"', "they fit in mm: unit = 'mm'"),
        ('sensors = [["Q", "x"]]', MM, "measurement.sensors.0: must be a point of the"),
        (SENSORS, f"{MM}\nnodes = {{ P1 = 1, P2 = 2 }}", "measurement.geometry.nodes: must be of three"),
        (SENSORS, f"{MM}\nnodes = {{ P1 = 99, P2 = 2, P7 = 3 }}", "nodes of the model (got 99)"),
        (SENSORS, 'file = "twice.csv"', "line 3, column point: must be a name that no other point has (got 'a')"),
        (SENSORS, 'file = "columns.csv"', "measurement.geometry.file: column z: is missing"),
        (SENSORS, 'file = "words.csv"', "line 2, column y: must be a number (got 'two')"),
        (SENSORS, 'file = "empty.unv"', "measurement.geometry.file: must be a universal file (it has no dataset)"),
        (SENSORS, 'file = "modes.unv"', "must have nodes, dataset 15 or 2411 (it has none)"),
        (SENSORS, "points = { a = [0.0, 1.0] }", "measurement.geometry.points.a: "),
        ('sensors = [["F", "x"]]', "points = { F = [0.0, 0.0, 0.0] }", "sensors.0: must be a point and"),
    ],
)  # fmt: skip
def test_broken_geometries(tmp_path, sensors, geometry, rule):
    write_csv(tmp_path / "points.csv", in_the_test())
    (tmp_path / "twice.csv").write_text("point,x,y,z\na,0,0,0\na,1,0,0\n")
    (tmp_path / "columns.csv").write_text("point,x,y\na,0,0\n")
    (tmp_path / "words.csv").write_text("point,x,y,z\na,0,two,0\n")
    (tmp_path / "empty.unv").write_text("nothing\n")
    fmu.ModalData([3.0], sensors=((1, "x"),), shapes=[[1.0]]).to_uff(tmp_path / "modes.unv")
    with pytest.raises(ConfigurationError) as caught:
        load(frame(tmp_path, sensors, geometry))
    assert rule in str(caught.value)


def test_a_model_without_coordinates_cannot_have_it(folder, matrices_text):
    path = folder / "storeys.toml"
    path.write_text(
        matrices_text.replace("sensors =", "geometry = { points = { a = [0.0, 0.0, 0.0] } }\nsensors =")
    )
    with pytest.raises(ConfigurationError, match=r"measurement\.geometry: must be given with a model whose nodes"):
        load(path)


def test_the_same_from_python():
    model = fmu.cases.load("cantilever-young").model.structure
    points = {f"P{k}": model.geometry.nodes[k] for k in (10, 30, 50)}
    found = fmu.match_points(points, model)
    assert [found.sensor(name, "z") for name in points] == [(10, "z"), (30, "z"), (50, "z")]
    with pytest.raises(ValueError, match="model: must know the coordinates of its nodes"):
        fmu.match_points(points, fmu.cases.load("shear-10dof").model.structure)
