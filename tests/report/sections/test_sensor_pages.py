"""Sensors on the pages: a wrong one turns the verdict of the check, and is named in the report of a run."""

import numpy as np
import pytest

import fmu
from fmu.fem.pairing.correlation import LOOK_AT_SENSORS, LOOK_AT_SHAPES
from fmu.report import plots
from fmu.report.check_page import check_page, write_check
from fmu.report.document import Items, Omitted
from fmu.report.run import runs_of
from fmu.report.sections.sensors import sensors
from tests.shear_building import frequencies_hz, shear_building

pytestmark = pytest.mark.usefixtures("quick_figures")

FLOORS, WRONG = 10, 6
DEGREES = tuple((f"f{j}", "x") for j in range(1, FLOORS + 1))


def building(change=None, mpc=None, sd=0.02):
    """Return a problem of a building with shapes measured at every floor, spoilt by `change`."""
    model = shear_building(["k1"] * 5 + ["k2"] * 5, 4e5, 1e3, dofs=DEGREES)
    f, phi = frequencies_hz(model, [1.05, 0.95])
    shapes = phi[:, :4] + sd * np.random.default_rng(1).normal(size=(FLOORS, 4)) * np.abs(phi[:, :4]).max()
    if change is not None:
        change(shapes)
    data = fmu.ModalData(
        f[:4],
        sensors=DEGREES,
        shapes=shapes,
        sd_hz=0.02,
        mpc=mpc,
        labels=("1", "2", "3", "4"),
    )
    parameters = [fmu.Parameter(name, 1.0, 0.5, 2.0, prior=fmu.Normal(0.2, mean=1.0)) for name in ("k1", "k2")]
    return fmu.UpdatingProblem(model, data, parameters, name="floors")


def reversed_sensor(shapes):
    shapes[WRONG] *= -1.0


def verdict(found):
    return next(v for v in check_page(found).verdicts if v.question == "Do the sensors agree with the model?")


def test_the_verdict_turns_with_one_wrong_sensor():
    good, bad = (fmu.check(building(change), draws=10) for change in (None, reversed_sensor))
    of_good, of_bad = verdict(good), verdict(bad)
    assert (of_good.answer, of_good.is_good, of_good.reasons) == ("Yes", True, ())
    assert (of_bad.answer, of_bad.is_good) == ("1 warning", False)
    assert of_bad.reasons[0].startswith(f"Sensor f{WRONG + 1} x: test and model disagree")
    assert bad.sensor_table().sensor[0] == f"f{WRONG + 1} x"
    assert of_bad.reasons[0] in bad.doubts
    assert not set(good.doubts) & set(of_bad.reasons)


def test_a_sensor_put_at_another_floor_is_named_first():
    def moved(shapes):
        shapes[2] = shapes[8]

    assert fmu.check(building(moved), draws=10).sensor_table().sensor[0] == "f3 x"


def test_what_the_terminal_and_the_page_show(tmp_path):
    found = fmu.check(building(reversed_sensor), draws=10)
    said = " ".join(str(found).split())
    assert "The 8 sensors with the largest ECoMAC" in said
    assert LOOK_AT_SENSORS in said
    page = write_check(found, tmp_path).read_text(encoding="utf-8")
    for text in (LOOK_AT_SENSORS, LOOK_AT_SHAPES, "AutoMAC: at most 0.0"):
        assert text in page


def test_phase_collinearity_is_a_column_where_shapes_were_complex():
    table = fmu.check(building(mpc=np.array([1.0, 0.99, 0.9123, 0.97])), draws=10).mode_table()
    assert table["MPC"].tolist()[:4] == ["1.00", "0.99", "0.91", "0.97"]
    assert "MPC" not in fmu.check(building(), draws=10).mode_table()


def test_close_modes_that_are_turned_are_a_note_and_other_shapes_a_warning():
    """A square of masses: its two sways have one frequency, and the measured pair is turned by 40°."""
    k, m = np.diag([1.0, 1.0, 3.0, 4.0]), np.eye(4)
    k[2, 3] = k[3, 2] = 0.5
    model = fmu.SeparableModel.from_terms(["k"], stiffness=[(4e4 * k, "k")], mass=[m], dofs=DEGREES[:4])
    _, phi = np.linalg.eigh(k)
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    hz = np.sqrt(4e4 * np.linalg.eigvalsh(k)[:3]) / (2 * np.pi)
    told = []
    for pair in (phi[:, :2] @ turn, phi[:, :2] @ turn + phi[:, [3, 3]] * [0, 1]):
        shapes = np.hstack([pair, phi[:, [2]]])
        data = fmu.ModalData(hz * [1, 1.001, 1], sensors=DEGREES[:4], shapes=shapes, sd_hz=0.1)
        problem = fmu.UpdatingProblem(model, data, [fmu.Parameter("k", 1.0, 0.5, 2.0)], name="square")
        told.append(fmu.check(problem, draws=10).modes)
    good, bad = told
    assert any("lie in the space of the computed ones (subspace MAC 1.00)" in note for note in good.notes)
    assert not any("below 0.8" in doubt for doubt in good.doubts)
    assert any("below 0.8" in doubt for doubt in bad.doubts)
    assert good.table()["subspace_mac"][:2].to_numpy() == pytest.approx([1.0, 1.0])
    assert good.subspace_mac(2) != good.subspace_mac(2)  # NaN: it is in no group


@pytest.fixture(scope="module")
def run():
    problem = building(reversed_sensor)
    trace = fmu.sample(problem, "hmc", draws=60, warmup=60, chains=2, seed=1)
    return runs_of({"hmc": trace})["hmc"]


def test_the_report_names_it_after_updating_too(run):
    section = sensors(run)
    assert any(
        isinstance(part, Items) and part.items[0].startswith(f"Sensor f{WRONG + 1} x: test and model disagree")
        for part in section.parts
    )
    (table,) = section.parts[-1].parts
    assert len(table.rows) == FLOORS
    assert table.rows[0][0] == f"f{WRONG + 1} x"
    assert LOOK_AT_SENSORS in section.parts[1].pictures[0].caption


def test_without_measured_shapes_there_is_no_such_section(run):
    trace = run.trace.copy()
    trace["modes"] = trace["modes"].to_dataset().drop_vars("measured")
    assert isinstance(sensors(runs_of({"hmc": trace})["hmc"]), Omitted)


def test_the_picture_has_a_mark_for_each_sensor_and_state():
    values = np.linspace(0, 1, 30), np.linspace(1, 0, 30)
    names = [f"{j} z" for j in range(30)]
    axes = plots.plot_sensors(names, {"before updating": values, "posterior mean": values[::-1]})
    assert [line.get_ydata().tolist() for line in axes[0].lines if line.get_marker() == "o"] == [
        values[0].tolist(),
        values[1].tolist(),
    ]
    assert [axis.get_ylabel() for axis in axes] == ["CoMAC", "ECoMAC"]
