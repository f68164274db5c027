"""Complex shapes made real, and tables of modes."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fmu.formats.modes import measured_modes as limits
from fmu.formats.modes.csv import read_frequencies, read_shapes
from fmu.formats.modes.measured_modes import ModesError, phase_collinearity, real_shapes
from fmu.posterior.data.modal_data import ModalData

FREQUENCIES = """\
mode,number,frequency,sd
# the first bending mode
first,1,31.9,0.1

second,3,1.979e2,0.4
"""
SHAPES = """\
place,direction,second,first
tip,z,1.0,1.0
12,-z,-0.71,0.34
"""


def test_real_shape_in_any_phase_is_found_again():
    shape = np.random.default_rng(0).normal(size=(6, 1))
    for phase in np.linspace(0.0, 6.0, 13):
        real, mpc = real_shapes(shape * np.exp(1j * phase))
        assert_allclose(real * np.sign(real[0] * shape[0]), shape, atol=1e-14)
        assert mpc[0] == pytest.approx(1.0)


def test_real_part_is_the_largest_of_all_phases():
    phi = np.array([[1.0 + 0.2j], [-0.5 + 0.1j], [0.3 - 0.1j]])
    length = np.linalg.norm(real_shapes(phi)[0])
    others = [np.linalg.norm((phi * np.exp(1j * a)).real) for a in np.linspace(0, np.pi, 1000)]
    assert length == pytest.approx(max(others), rel=1e-5)


def test_phase_collinearity_is_the_eigenvalue_ratio():
    """((λ1 − λ2)/(λ1 + λ2))² of the covariance of real and imaginary parts (Pappa et al. 1993)."""
    phi = np.random.default_rng(1).normal(size=(8, 2)) @ np.array([1.0, 0.7j])
    values = np.linalg.eigvalsh(np.array([phi.real, phi.imag]) @ np.array([phi.real, phi.imag]).T)
    assert phase_collinearity(phi[:, None])[0] == pytest.approx(((values[1] - values[0]) / values.sum()) ** 2)
    assert phase_collinearity([[1.0], [1.0j]])[0] == pytest.approx(0.0)


def test_complex_shape_is_refused_unless_asked_for():
    phi = [[1.0 + 0j, 1.0 + 0j], [1.0 + 0j, 0.9j]]
    message = (
        r"^shapes: mode 2 must have a phase collinearity \(MPC\) of at least 0\.8 to be taken for a real one "
        r"\(got 0\.01\); least_mpc=0 takes it anyway$"
    )
    with pytest.raises(ValueError, match=message):
        real_shapes(phi)
    assert real_shapes(phi, least_mpc=0)[0].shape == (2, 2)
    with pytest.raises(ValueError, match=r"must not be zero at every sensor: .* \(got zeros for mode 2\)"):
        real_shapes([[1.0, 0.0], [1.0, 0.0]])


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_tables(tmp_path, separator):
    one, other = tmp_path / "modes.csv", tmp_path / "shapes.csv"
    one.write_text(FREQUENCIES.replace(",", separator), encoding="utf-8-sig")
    other.write_text(SHAPES.replace(",", separator))
    data = ModalData.from_csv(one, other)
    assert_array_equal(data.frequencies_hz, [31.9, 197.9])
    assert_array_equal(data.sd_hz, [0.1, 0.4])
    assert data.numbers == (1, 3)
    assert data.labels == ("first", "second")
    assert data.sensors == (("tip", "z"), (12, "-z"))
    assert_array_equal(data.shapes, [[1.0, 1.0], [0.34, -0.71]])


def test_frequencies_alone(tmp_path):
    path = tmp_path / "modes.csv"
    path.write_text("frequency,mode\n3.0,a\n")
    data = ModalData.from_csv(path)
    assert (data.sd_hz, data.shapes, data.numbers) == (None, None, (1,))


@pytest.mark.parametrize(
    ("text", "mistakes"),
    [
        ("", ["must have a line of column names and a line of values at least"]),
        ("mode,frequency\n", ["must have a line of column names and a line of values at least"]),
        ("mode,sd\na,1\n", ["column frequency: is missing"]),
        (
            "mode,frequency,damping\na,1,2\n",
            ["column damping: must be one of mode, number, frequency, sd"],
        ),
        ("mode,frequency,frequency\na,1,2\n", ["line 1: column names must be distinct"]),
        (
            "mode,frequency\na,1,2\nb\n",
            ["line 2: must have 2 values, one per column (got 3)", "line 3: must have 2"],
        ),
        (
            "mode,frequency,sd,number\na,-1,0,0\n\na,nan,x,1.5\n",
            [
                "line 2, column frequency: must be a positive number (got '-1')",
                "line 4, column frequency: must be a positive number (got 'nan')",
                "line 2, column sd: must be a positive number (got '0')",
                "line 4, column sd: must be a positive number (got 'x')",
                "line 2, column number: must be a whole number from 1 (got '0')",
                "line 4, column number: must be a whole number from 1 (got '1.5')",
                "line 4, column mode: must be a name that no other mode has (got 'a')",
            ],
        ),
    ],
)
def test_wrong_frequencies(tmp_path, text, mistakes):
    path = tmp_path / "modes.csv"
    path.write_text(text)
    with pytest.raises(ModesError) as caught:
        read_frequencies(path)
    assert len(caught.value.mistakes) == len(mistakes)
    for mistake, expected in zip(caught.value.mistakes, mistakes, strict=True):
        assert mistake.startswith(expected)
    assert str(caught.value).startswith("modes.csv: ")


@pytest.mark.parametrize(
    ("text", "mistakes"),
    [
        ("place,first\ntip,1\n", ["column direction: is missing", "column second: is missing"]),
        ("place,direction,first,second,third\ntip,z,1,2,3\n", ["column third: is not a measured mode"]),
        (
            "place,direction,first,second\n,up,1,\ntip,-rx,inf,2\n",
            [
                "line 2, column place: must not be empty",
                "line 2, column direction: must be x, y, z, rx, ry or rz, with or without a leading minus "
                "(got 'up')",
                "line 2, column second: must be a number (got '')",
                "line 3, column first: must be a number (got 'inf')",
            ],
        ),
    ],
)
def test_wrong_shapes(tmp_path, text, mistakes):
    path = tmp_path / "shapes.csv"
    path.write_text(text)
    with pytest.raises(ModesError) as caught:
        read_shapes(path, ("first", "second"))
    assert list(caught.value.mistakes) == mistakes


def test_files_that_cannot_be_read(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match="no such file"):
        ModalData.from_csv(tmp_path / "none.csv")
    path = tmp_path / "modes.csv"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ModesError, match="must be text in UTF-8"):
        ModalData.from_csv(path)
    monkeypatch.setattr(limits, "LARGEST_FILE", 2)
    with pytest.raises(ModesError, match=r"must have at most 2 bytes \(got 3\)"):
        ModalData.from_csv(path)


def test_whether_a_mode_is_used(tmp_path):
    path = tmp_path / "modes.csv"
    path.write_text("mode,frequency,use\na,1.0,True\nb,2.0,no\nc,3.0,0\n")
    assert read_frequencies(path).use == (True, False, False)
    assert ModalData.from_csv(path).use == (True, False, False)
    path.write_text("mode,frequency,use\na,1.0,perhaps\n")
    with pytest.raises(ModesError, match=r"line 2, column use: must be true or false \(got 'perhaps'\)"):
        read_frequencies(path)
