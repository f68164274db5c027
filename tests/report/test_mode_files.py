"""Mode shapes for ParaView and SDynPy: what other programs read is what fmu computed, node by node."""

import base64
import xml.etree.ElementTree as ET

import numpy as np
import pytest
import pyuff
import xarray as xr

import fmu
from fmu.analysis.trace.modal_states import MEAN, START, modal_states
from fmu.config import load
from fmu.fem.modes.modal import mac
from fmu.formats.decks import MEASURED_MODES, MESH_MODES, UPDATED_MODES
from fmu.formats.modes.vtu import CELLS, write_vtu
from fmu.report import plots
from fmu.report.export import export
from fmu.report.mode_files import write_modes
from tests.config.conftest import FRAME
from tests.report.exported import run

SENSORS = [
    ("corner", "x"),
    ("corner", "-y"),
    ("other", "y"),
    ("other", "x"),
    (1, "x"),
    (2, "-y"),
    (9, "z"),
    (9, "y"),
]


def portal(folder, noise=0.01):
    """Return a problem of a portal frame with shapes measured at eight sensors, in any scale and sign."""
    (folder / "plain.toml").write_text(FRAME)
    plain = load(folder / "plain.toml")
    node = {"corner": 3, "other": 4}
    sensors = [(node.get(place, place), direction) for place, direction in SENSORS]
    model = plain.model.structure
    full = plain.model.truth.truth.shapes(plain.start[: plain.n_structural])
    seen = model.observation(sensors) @ full * [2.0, -3.0]
    seen = seen + noise * np.abs(seen).max() * np.random.default_rng(1).normal(size=seen.shape)
    rows = ", ".join(str(column.tolist()) for column in seen.T)
    listed = ", ".join(
        f"[{place if isinstance(place, int) else chr(34) + place + chr(34)}, {d!r}]" for place, d in SENSORS
    )
    text = FRAME.replace('sensors = [["corner", "x"], ["other", "y"]]', f"sensors = [{listed}]\nshapes = [{rows}]")
    path = folder / "portal.toml"
    path.write_text(text.replace('pairing = "index"\n', ""))
    return path


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("modes")
    problem = load(portal(folder))
    assert write_modes(problem, problem.start, folder) == []
    return folder, problem


def arrays(path):
    """Return the arrays of a VTU file by name, read by its definition alone."""
    kinds = {"Float64": "<f8", "Float32": "<f4", "Int64": "<i8", "UInt8": "u1"}
    found = {}
    for part in ET.parse(path).iter("DataArray"):
        raw = base64.b64decode(part.text)
        assert int(np.frombuffer(raw[:8], "<u8")[0]) == len(raw) - 8
        values = np.frombuffer(raw[8:], kinds[part.get("type")])
        found[part.get("Name")] = values.reshape(-1, int(part.get("NumberOfComponents", 1)))
    return found


def expected(problem, k):
    model = problem.model.structure
    shape = problem.model.truth.truth.shapes(problem.start[: problem.n_structural])[:, k]
    moved = np.zeros((len(model.geometry.nodes), 3))
    for (node, direction), i in model.dof_of.items():
        if direction in "xyz":
            moved[node, "xyz".index(direction)] = shape[i]
    return moved


def test_the_vtu_file_has_mesh_and_shapes(written):
    folder, problem = written
    found, geometry = arrays(folder / MESH_MODES), problem.model.structure.geometry
    assert np.array_equal(found["Points"], geometry.nodes)
    assert np.array_equal(found["connectivity"].reshape(-1, 2), geometry.elements)
    assert np.array_equal(found["offsets"].ravel(), 2 * np.arange(1, len(geometry.elements) + 1))
    assert set(found["types"].ravel()) == {3}
    names = [name for name in found if name[:2] in ("up", "me")]
    hz = problem.frequencies(problem.start)
    assert names[0] == f"updated 1: {hz[0]:.3f} Hz"[: len(names[0]) - 3] + " Hz"
    for k in range(2):
        assert found[names[k]] == pytest.approx(
            expected(problem, k), rel=1e-6, abs=1e-7 * np.abs(expected(problem, k)).max()
        )
        measured = found[names[2 + k]]
        assert np.sum(measured * found[names[k]]) > 0  # in the sign of the computed one
        assert measured == pytest.approx(expected(problem, k), abs=0.05 * np.abs(expected(problem, k)).max())


def test_the_measured_universal_file_is_read_back_as_the_data(written):
    folder, problem = written
    again = fmu.ModalData.from_uff(folder / MEASURED_MODES)
    order = [again.sensors.index((node, d.removeprefix("-"))) for node, d in problem.data.sensors]
    sign = np.array([-1.0 if d.startswith("-") else 1.0 for _, d in problem.data.sensors])
    assert again.shapes[order] == pytest.approx(problem.data.shapes * sign[:, None], rel=1e-5)
    assert again.frequencies_hz == pytest.approx(problem.data.frequencies_hz, rel=1e-5)


def test_the_updated_universal_file_has_nodes_elements_and_shapes(written):
    folder, problem = written
    sets = pyuff.UFF(str(folder / UPDATED_MODES)).read_sets()
    assert [one["type"] for one in sets] == [2411, 2412, 55, 55]
    geometry = problem.model.structure.geometry
    places = np.stack([sets[0][axis] for axis in "xyz"], axis=1)
    assert np.array_equal(places, geometry.nodes)
    assert sets[0]["node_nums"].astype(int).tolist() == list(range(len(geometry.nodes)))
    assert [one["nodes_nums"] for one in sets[1][11]] == np.asarray(geometry.elements).tolist()
    for k, one in enumerate(sets[2:]):
        at = np.array(one["node_nums"], dtype=int)
        moved = np.stack([one[f"r{i}"] for i in (1, 2, 3)], axis=1)
        assert moved == pytest.approx(
            expected(problem, k)[at], rel=1e-5, abs=1e-5 * np.abs(expected(problem, k)).max()
        )
        assert one["freq"] == pytest.approx(problem.frequencies(problem.start)[k], rel=1e-5)


def test_a_wrong_sensor_is_told_by_what_the_expansion_keeps(tmp_path):
    problem = load(portal(tmp_path))
    shapes = np.array(problem.data.shapes)
    shapes[[0, 2]] = shapes[[2, 0]] * [[-1.0], [1.0]]
    data = fmu.ModalData(problem.data.frequencies_hz, sensors=problem.data.sensors, shapes=shapes, sd_hz=0.1)
    wrong = fmu.UpdatingProblem(problem.model.structure, data, problem.parameters)
    (said,) = write_modes(wrong, wrong.start, tmp_path)
    assert said.startswith("Expanded, the measured shapes keep less than 90 % of what was measured: mode 1 (")


def test_too_few_sensors_leave_the_measured_shapes_out(tmp_path):
    problem = load(portal(tmp_path))
    data = fmu.ModalData(
        problem.data.frequencies_hz, sensors=problem.data.sensors[:1], shapes=problem.data.shapes[:1], sd_hz=0.1
    )
    few = fmu.UpdatingProblem(problem.model.structure, data, problem.parameters)
    (said,) = write_modes(few, few.start, tmp_path)
    assert "sensors: must tell 2 modes apart to expand shapes (they tell 1)" in said
    assert not any(name.startswith("measured") for name in arrays(tmp_path / MESH_MODES))


def test_nothing_is_written_without_geometry(tmp_path):
    problem = fmu.cases.load("shear-10dof")
    assert write_modes(problem, problem.start, tmp_path) == []
    assert list(tmp_path.iterdir()) == []


def test_a_sensor_beside_a_node_has_a_place_of_its_own(tmp_path):
    path = portal(tmp_path)
    text = path.read_text().replace(
        "[model.supports]", '[model.offsets.skin]\npoint = "corner"\noffset = [0.0, 0.1, 0.05]\n\n[model.supports]'
    )
    path.write_text(text.replace("[\"corner\", 'x']", "[\"skin\", 'x']"))
    problem = load(path)
    assert problem.data.sensors[0] == ("skin", "x")
    write_modes(problem, problem.start, tmp_path)
    nodes = pyuff.UFF(str(tmp_path / MEASURED_MODES)).read_sets(0)
    k = int(np.argmax(nodes["node_nums"]))
    assert [nodes[axis][k] for axis in "xyz"] == pytest.approx([0.0, 0.1, 2.05])


def test_export_writes_them(tmp_path):
    path = portal(tmp_path)
    run(path, tmp_path / "out", draws=4, warmup=4)
    files = export(tmp_path / "out").files
    assert {MESH_MODES, UPDATED_MODES, MEASURED_MODES} <= set(files)


EVERY = {
    "line": 2, "triangle6": 6, "quad8": 8, "tetra10": 10, "pyramid": 5, "wedge15": 15, "hexahedron20": 20,
    "sphere": 9,
}  # fmt: skip


def test_elements_of_every_kind_and_names_with_angles(tmp_path):
    places = np.random.default_rng(1).normal(size=(20, 3))
    elements = [list(range(n)) for n in EVERY.values()]
    vectors = {'<b> & "1"': places}
    write_vtu(tmp_path / "a.vtu", places, elements, list(EVERY), vectors, {"node": np.arange(20)})
    found = arrays(tmp_path / "a.vtu")
    assert found["types"].ravel().tolist() == [3, 5, 9, 10, 14, 13, 12]  # VTK has no sphere
    assert np.diff(found["offsets"].ravel(), prepend=0).tolist() == [2, 3, 4, 4, 5, 6, 8]
    assert np.array_equal(found['<b> & "1"'], places.astype(np.float32))
    meshio = pytest.importorskip("meshio")
    mesh = meshio.read(tmp_path / "a.vtu")
    assert [(block.type, block.data.tolist()) for block in mesh.cells] == [
        (kind, [list(range(CELLS[kind].corners))])
        for kind in ("line", "triangle", "quad", "tetra", "pyramid", "wedge", "hexahedron")
    ]
    assert np.array_equal(mesh.points, places)


def test_vtk_reads_the_same(written):
    pyvista = pytest.importorskip("pyvista")
    folder, problem = written
    grid = pyvista.read(folder / MESH_MODES)
    assert np.array_equal(grid.points, problem.model.structure.geometry.nodes)
    assert grid.n_cells == len(problem.model.structure.geometry.elements)
    updated = [name for name in grid.point_data if name.startswith("updated")]
    for k, name in enumerate(updated):
        assert (
            mac(np.asarray(grid[name], dtype=float).reshape(-1, 1), expected(problem, k).reshape(-1, 1)) > 1 - 1e-9
        )


def test_the_pictures_of_a_report_have_the_expanded_shapes(tmp_path):
    """Without noise they are those of the model, and at the sensors what was measured."""
    problem = load(portal(tmp_path, noise=0.0))
    found = modal_states(problem, {START: problem.start})
    drawn = found["displacement"].sel(state=START).to_numpy()
    node_of = {name: node for node, name in problem.model.structure.place_names.items()}
    for k in range(2):
        whole = found["expanded"].to_numpy()[k]
        scale = np.sum(whole * drawn[k]) / np.sum(whole**2)
        assert scale * whole == pytest.approx(drawn[k], abs=1e-9)
        for place, value in zip(found["place"].to_numpy(), found["measured"].to_numpy()[k], strict=True):
            name, direction = str(place).split(" ")
            assert whole[int(node_of.get(name, name)), "xyz".index(direction)] == pytest.approx(
                value, abs=1e-9 * np.abs(whole).max()
            )
    figure = plots.plot_mode_shapes(_with_mean(found))[0].figure
    assert "measured, expanded" in [text.get_text() for text in figure.legends[0].get_texts()]


def _with_mean(found):
    both = xr.concat([found, found.assign_coords(state=[MEAN])], "state", data_vars="minimal")
    tree = xr.DataTree.from_dict({"modes": both})
    tree.attrs["sampler"] = "hmc"
    return tree
