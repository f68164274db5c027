"""Universal files, there and back, and as other programs write them."""

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import eigh

from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.formats.modes.measured_modes import ModesError
from fmu.formats.modes.uff import read_uff
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.problem import UpdatingProblem

pyuff = pytest.importorskip("pyuff")

SENSORS = ((1, "x"), (2, "-x"), (2, "ry"))
DATA = ModalData([3.12345, 9.87654], (1, 3), SENSORS, shapes=[[0.612345, 1.0], [-1.0, 0.6], [0.0, -0.25]])


def a_set(number=1, frequency=3.0, values=((1.0, 0.0, 0.0),), nodes=(11,), **fields):
    table = np.array(values)
    return {
        "type": 55,
        "analysis_type": 2,
        "data_ch": 2,
        "spec_data_type": 8,
        "load_case": 0,
        "mode_n": number,
        "freq": frequency,
        "node_nums": list(nodes),
        **{f"r{i + 1}": table[:, i] for i in range(table.shape[1])},
        **fields,
    }


def written(path, *sets):
    pyuff.UFF(str(path)).write_sets(list(sets), mode="overwrite")
    return path


def test_there_and_back(tmp_path):
    path = tmp_path / "modes.uff"
    DATA.to_uff(path)
    data = ModalData.from_uff(path, numbers=(1, 3), sensors=SENSORS)
    assert_allclose(data.frequencies_hz, DATA.frequencies_hz, rtol=1e-12)
    assert_allclose(data.shapes, DATA.shapes, rtol=1e-12)
    assert data.sensors == SENSORS
    assert data.numbers == (1, 3)
    assert data.labels == ("1", "3")
    assert data.sd_hz is None


def test_sensors_are_what_moves(tmp_path):
    path = tmp_path / "modes.uff"
    DATA.to_uff(path)
    data = ModalData.from_uff(path, modes=[3], sd_hz=0.1)
    assert data.sensors == ((1, "x"), (2, "x"), (2, "ry"))
    assert_allclose(data.shapes[:, 0], [1.0, -0.6, -0.25])
    assert_array_equal(data.sd_hz, [0.1])


def test_places_have_node_numbers(tmp_path):
    path, nodes = tmp_path / "modes.uff", {11: "tip", 12: "middle"}
    data = ModalData([3.0], sensors=(("tip", "z"), ("middle", "z")), shapes=[[1.0], [0.4]])
    data.to_uff(path, nodes)
    again = ModalData.from_uff(path, nodes)
    assert again.sensors == data.sensors
    assert_allclose(again.shapes, data.shapes)
    assert ModalData.from_uff(path, {11: "tip"}).sensors == (("tip", "z"),)
    assert ModalData.from_uff(path).sensors == ((11, "z"), (12, "z"))


def test_the_posterior_is_the_same(tmp_path):
    """The shapes pair the modes, which are not in the order of the spectrum."""
    ends, between = np.diag([1.0, 0.0, 1.0]), np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    K = [Term(sp.csr_array(ends), (1.0, 0.0)), Term(sp.csr_array(between), (0.0, 1.0))]
    model = SeparableModel(K, [Term(sp.csr_array(np.diag([1.0, 2.0, 3.0])), (0.0, 0.0))])
    theta = np.array([[60.0, 100.0], [80.0, 140.0]])
    start = theta[0]
    values, shapes = eigh(model.K(start).toarray(), model.M(start).toarray())
    chosen = [2, 0]
    frequencies = np.array([float(f"{f:.5e}") for f in np.sqrt(values[chosen]) / (2 * np.pi)])
    sensors = ((0, "x"), (1, "x"), (2, "x"))
    data = ModalData(frequencies, sensors=sensors, shapes=shapes[:, chosen], sd_hz=0.01)
    path = tmp_path / "modes.uff"
    data.to_uff(path)
    again = ModalData.from_uff(path, sd_hz=0.01)
    parameters = [Parameter("a", 60.0, 30.0, 120.0), Parameter("b", 100.0, 50.0, 200.0)]
    one, other = (UpdatingProblem(model, d, parameters) for d in (data, again))
    assert_allclose(one.log_prob(theta), other.log_prob(theta), rtol=1e-9)
    assert one.log_prob(start) > one.log_prob(theta[1]) + 10.0


def test_complex_modes(tmp_path):
    eigenvalue = 2 * np.pi * 5.0 * (-0.02 + 1j * np.sqrt(1 - 0.02**2))
    shape = np.array([[1.0, 0.0, 0.0], [-0.5, 0.0, 0.0]]) * np.exp(0.7j)
    shape[1, 0] *= np.exp(0.1j)
    fields = {"analysis_type": 3, "eig": eigenvalue, "modal_a": 1 + 0j, "modal_b": 1 + 0j}
    path = written(tmp_path / "complex.uff", a_set(values=shape, nodes=(11, 12), **fields))
    modes = read_uff(path)
    assert modes.frequencies_hz[0] == pytest.approx(5.0, rel=1e-5)
    assert modes.shapes[1, 0] / modes.shapes[0, 0] == pytest.approx(-0.5, rel=0.01)
    with pytest.raises(ModesError, match=r"shapes: mode 1 must have a phase collinearity .* of at least 0\.9999"):
        read_uff(path, least_mpc=0.9999)
    assert ModalData.from_uff(path, least_mpc=0.0).n_modes == 1


def test_a_node_that_a_mode_lacks_was_not_measured_there(tmp_path):
    two = a_set(2, 8.0, [[4, 2, 0], [0, 3, 0]], nodes=(11, 12))
    path = written(tmp_path / "modes.uff", a_set(), two)
    with pytest.raises(ModesError, match=r"must have all nodes in all modes, .* \(mode 1 has no y of 12\)$"):
        read_uff(path)
    assert_allclose(read_uff(path, modes=[2]).shapes, [[4.0], [2.0], [3.0]])
    assert read_uff(path, modes=[1]).shapes.shape[1] == 1
    assert_allclose(read_uff(path, sensors=[(11, "x")]).shapes, [[1.0, 4.0]])


def test_a_direction_of_a_node_may_be_zero_in_all_modes(tmp_path):
    modes = read_uff(written(tmp_path / "modes.uff", a_set()), sensors=[(11, "x"), (11, "-z")])
    assert_allclose(modes.shapes, [[1.0], [0.0]])


@pytest.mark.parametrize(
    ("sets", "options", "message"),
    [
        ([a_set(spec_data_type=3)], {}, r"dataset 1: shapes must be of displacement, .* \(got type 3\)"),
        ([a_set(), a_set()], {}, r"must have each mode once \(got the numbers \[1, 1\]\)"),
        ([a_set()], {"modes": [2]}, r"modes: must be some of \[1\] \(got \[2\]\)"),
        ([a_set()], {"modes": []}, r"modes: must be some of \[1\] \(got \[\]\)"),
        ([a_set()], {"nodes": {12: "tip"}}, r"nodes: must be some of \[11\] \(got \[12\]\)"),
        ([a_set(frequency=0.0)], {}, r"modes: must have frequencies above 0 Hz \(got 1 at 0\.0 Hz\)"),
        ([a_set(values=[[0, 0, 0]])], {}, r"shapes: must move at one of the nodes \(got zeros\)"),
        ([a_set()], {"sensors": [(11, "x"), (99, "z")]}, r"sensors: must be at places in the file, 11 \(got 99\)"),
        (
            [a_set(), a_set(2, nodes=(12,))],
            {"sensors": [(11, "x"), (12, "-rz")], "nodes": {11: "tip", 12: "middle"}},
            r"sensors: must be at places in the file, tip, middle \(got 11\)",
        ),
        ([a_set()], {"sensors": [(11, "x"), (11, "-rz")]}, r"sensors: must be along x, y, z at 11 \(got '-rz'\)"),
        (
            [a_set()],
            {"sensors": [(11, "y")]},
            r"shapes: must not be zero at every sensor: .* \(got zeros for mode 1\)",
        ),
        ([a_set(analysis_type=5, freq_step_n=1)], {}, r"must have mode shapes, dataset 55 .* \(got none\)"),
    ],
)
def test_wrong_contents(tmp_path, sets, options, message):
    path = written(tmp_path / "modes.uff", *sets)
    with pytest.raises(ModesError, match=f"^modes.uff: {message}$"):
        read_uff(path, **options)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        ModalData.from_uff(tmp_path / "none.uff")
    path = tmp_path / "broken.uff"
    path.write_text("some text\n")
    with pytest.raises(ModesError, match=r"must be a universal file \(it has no dataset\)"):
        read_uff(path)
    text = written(path, a_set()).read_text().replace("1.00000e+00", "1.0000x+00")
    path.write_text(text)
    with pytest.raises(ModesError, match="must be a universal file"):
        read_uff(path)


def test_what_cannot_be_written(tmp_path):
    path = tmp_path / "modes.uff"
    with pytest.raises(ValueError, match="shapes: must have been measured"):
        ModalData([3.0]).to_uff(path)
    with pytest.raises(ValueError, match="nodes: must say which node number 'tip' is"):
        ModalData([3.0], sensors=(("tip", "x"),), shapes=[[1.0]]).to_uff(path)
    with pytest.raises(ValueError, match="sensors: must be distinct"):
        ModalData([3.0], sensors=((1, "x"), (1, "-x")), shapes=[[1.0], [1.0]]).to_uff(path)
