"""From what pyOMA_2 identified in ambient vibrations to a posterior, without a number copied by hand."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.testing import assert_allclose, assert_array_equal

from fmu.analysis.trace.reading import parameter_draws
from fmu.fem.modes.separable import SeparableModel
from fmu.fem.modes.terms import Term
from fmu.formats.modes.measured_modes import ModesError
from fmu.formats.modes.pyoma import FORMAT, load_pyoma, pyoma_modes, save_pyoma
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.frequency import FrequencyErrors
from fmu.posterior.errors.shape import ShapeErrors
from fmu.posterior.parameters import Parameter
from fmu.posterior.problem import UpdatingProblem
from fmu.sampling import sample

FOLDER = Path(__file__).parent
SENSORS = ((0, "x"), (1, "x"), (2, "x"))


@pytest.fixture(scope="module")
def frame():
    """The script beside this file, by its path."""
    sys.path.insert(0, str(FOLDER))
    try:
        import ambient
    finally:
        sys.path.remove(str(FOLDER))
    return ambient


@pytest.fixture(scope="module")
def result():
    """What pyOMA_2 1.4.3 gave for a simulated record."""
    with np.load(FOLDER / "ambient.npz", allow_pickle=False) as file:
        return SimpleNamespace(**file)


def posterior(frame, data):
    """Return draws of the storeys' stiffnesses over the true ones, shape (n, 3)."""
    terms = []
    for k in range(3):
        unit = frame.stiffness_matrix(np.eye(3)[k] * frame.STIFFNESS)
        terms.append(Term(sp.csr_array(unit), tuple(np.eye(3)[k])))
    model = SeparableModel(terms, [Term(sp.csr_array(frame.MASS), (0.0, 0.0, 0.0))])
    parameters = [Parameter(f"k{k + 1}", 1.1, 0.5, 2.0) for k in range(3)]
    problem = UpdatingProblem(model, data, parameters)
    # three frequencies have several sets of storeys; the shapes only pair
    trace = sample(problem, "hmc", draws=100, warmup=60, chains=2, seed=1, init="start")
    return parameter_draws(trace).reshape(-1, 3)


def test_conversion(frame, result):
    data = ModalData.from_pyoma(result, SENSORS)
    frequencies, shapes = frame.exact_modes()
    assert_array_equal(data.frequencies_hz, result.Fn)
    assert_array_equal(data.sd_hz, result.Fn_std)
    assert_allclose(data.frequencies_hz, frequencies, atol=5 * data.sd_hz.max())
    assert data.shapes.dtype == float
    mac = np.sum(data.shapes * shapes, axis=0) ** 2 / np.sum(data.shapes**2, axis=0) / np.sum(shapes**2, axis=0)
    assert np.all(mac > 0.999)
    assert data.sensors == SENSORS


def test_deviations_of_shapes(frame, result):
    """They are of shapes of unit length, and belong to the modes that are taken."""
    data = ModalData.from_pyoma(result, SENSORS, modes=[3, 1])
    length = np.linalg.norm(data.shapes, axis=0)
    assert_allclose(data.shapes_sd * length, result.Phi_std[:, [2, 0]], rtol=1e-14)
    problem = UpdatingProblem(
        SeparableModel(
            [Term(sp.csr_array(frame.stiffness_matrix(frame.STIFFNESS)), (1.0,))],
            [Term(sp.csr_array(frame.MASS), (0.0,))],
        ),
        data,
        [Parameter("k", 1.0, 0.5, 2.0)],
        error=[FrequencyErrors(), ShapeErrors()],
    )
    assert np.isfinite(problem.log_prob([1.0]))


def test_the_component_that_scales_a_shape_takes_the_error_of_no_other(result):
    """With the largest component 1 without error, ratios to it have the errors of the others."""
    largest = np.argmax(np.abs(result.Phi), axis=0)
    deviations = result.Phi_std.copy()
    deviations[largest, range(3)] = 0.0
    modes = pyoma_modes(vars(result) | {"Phi_std": deviations}, SENSORS)
    for k, at in enumerate(largest):
        sd, u = modes.shapes_sd[:, k], modes.shapes[:, k] / np.linalg.norm(modes.shapes[:, k])
        of_ratio = np.hypot(sd / u[at], u * sd[at] / u[at] ** 2)
        rest = np.arange(3) != at
        assert 0.0 < sd[at] < 1.1e-3 * sd[rest].min()
        assert_allclose(of_ratio[rest], result.Phi_std[rest, k] / abs(modes.shapes[at, k]), rtol=1e-5)


def test_some_modes_and_an_uncertainty_of_ones_own(result):
    data = ModalData.from_pyoma(result, SENSORS, modes=[3, 1], numbers=(3, 1), sd_hz=0.02)
    assert_array_equal(data.frequencies_hz, result.Fn[[2, 0]])
    assert_array_equal(data.sd_hz, [0.02, 0.02])
    assert data.labels == ("3", "1")
    assert data.numbers == (3, 1)
    given = ModalData.from_pyoma(result, SENSORS, covariance_hz2=np.diag([1e-4, 1e-4, 1e-4]))
    assert given.sd_hz is None


def test_scatter_between_setups_is_not_the_uncertainty_of_the_mean(result):
    merged = SimpleNamespace(Fn=result.Fn, Phi=result.Phi, Fn_std=result.Fn_std, setups_used=[[0, 1]] * 3)
    merged.Phi_std = result.Phi_std
    modes = pyoma_modes(merged, SENSORS)
    assert modes.sd_hz is None
    assert modes.shapes_sd is None


@pytest.mark.validate
def test_posterior_of_a_kept_result_covers_the_truth(frame, result):
    draws = posterior(frame, ModalData.from_pyoma(result, SENSORS))
    assert np.all(np.abs(draws.mean(axis=0) - 1.0) < 4.0 * draws.std(axis=0))
    assert np.all(draws.std(axis=0) < 0.02)


def test_from_a_record_to_what_was_kept(frame, result):
    pytest.importorskip("pyoma2")
    identified = frame.identified(seed=1)
    # rounding differs between kinds of CPU, and what is identified is a small part of a large matrix
    assert_allclose(identified.Fn, result.Fn, rtol=1e-6)
    assert_allclose(identified.Fn_std, result.Fn_std, rtol=1e-3)
    assert ModalData.from_pyoma(identified, SENSORS).n_modes == 3


def test_result_in_a_file(tmp_path, result):
    path = tmp_path / "result.npz"
    save_pyoma(path, result)
    one, other = ModalData.from_pyoma(load_pyoma(path), SENSORS), ModalData.from_pyoma(result, SENSORS)
    assert one.as_dict() == other.as_dict()


def test_frequencies_of_a_file_without_sensors(tmp_path, result):
    path = tmp_path / "result.npz"
    save_pyoma(path, result)
    frequencies, shapes = FORMAT.computed(path, (), path)
    assert_array_equal(frequencies, result.Fn)
    assert shapes is None
    for wrong in ({}, {"Fn": np.zeros(0)}, {"Fn": [1.0, np.nan]}, {"Fn": [-1.0]}):
        save_pyoma(path, wrong)
        with pytest.raises(ModesError, match=r"^result\.npz: Fn: must be 1 to \d+ positive frequencies \(got \["):
            FORMAT.computed(path, (), path)


def test_no_pickle_is_read(tmp_path):
    path = tmp_path / "result.npz"
    np.savez(path, Fn=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ModesError, match=r"pyoma\.save_pyoma .*Python objects"):
        load_pyoma(path)
    path.write_text("no archive")
    with pytest.raises(ModesError, match=r"must be a file of fmu\.formats\.modes\.pyoma\.save_pyoma"):
        load_pyoma(path)
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_pyoma(tmp_path / "none.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Fn": None}, r"must have frequencies Fn and shapes Phi \(got none: was mpe called\?\)"),
        ({"Phi": np.ones((2, 3))}, r"Phi: must have shape \(3, 3\), .* \(got \(2, 3\)\)"),
        ({"Fn_std": np.ones(2)}, r"Fn_std: must be 3, one per mode \(got 2\)"),
        ({"Fn": [1.0, np.nan, 2.0]}, r"Fn: mode 2 must be positive and finite \(got nan Hz\)"),
        ({"Fn_std": [0.1, 0.1, 0.0]}, r"Fn_std: mode 3 must be positive and finite \(got 0\.0 Hz\)"),
        ({"Phi_std": np.ones((3, 2))}, r"Phi_std: must have the shape of Phi, \(3, 3\) \(got \(3, 2\)\)"),
        ({"Phi_std": np.full((3, 3), np.nan)}, r"Phi_std: must be finite and not negative"),
        ({"Phi_std": np.zeros((3, 3))}, r"Phi_std: must be positive but at one channel, which scales the shape"),
        ({"Phi": np.ones((3, 3)) * [[1.0], [1j], [0.1]]}, r"shapes: mode 1 must have a phase collinearity .*"),
    ],
)
def test_wrong_results(result, changes, message):
    with pytest.raises(ModesError, match=f"^dict: {message}$"):
        pyoma_modes(vars(result) | changes, SENSORS)


def test_wrong_modes(result):
    with pytest.raises(ModesError, match=r"modes: must lie in 1\.\.3 \(got \[0, 4\]\)"):
        pyoma_modes(result, SENSORS, modes=[0, 4])


def test_formats_import_no_other_program():
    code = "import sys, fmu.posterior.data.modal_data; print({'pyuff', 'pyoma2', 'sklearn'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
