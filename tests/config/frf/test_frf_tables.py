"""Frequency response functions and damping from files: as from Python, or a mistake with its place in the file."""

import re

import numpy as np
import pytest

import fmu
from fmu.config import ConfigurationError, load
from tests.measured_frfs import (
    LINES,
    POINTS,
    RATIOS,
    STIFFNESS,
    TRUTH,
    building,
    modes,
    parameters,
    ratios,
    simulate,
)

MATRICES = """\
name = "storeys"
reduction = false
{extra}
[model]
type = "matrices"
dofs = [[0, "x"], [1, "x"], [2, "x"]]

[[model.mass]]
matrix = [[1000.0, 0.0, 0.0], [0.0, 1000.0, 0.0], [0.0, 0.0, 1000.0]]
"""
FRFS = """
[[error]]
of = "frf"
data = "frfs.csv"
kind = "accelerance"
"""
MODAL = """
[[damping]]
kind = "modal"
ratios = ["zeta1", "zeta2", "zeta3"]
"""
MODES = """
[measurement]
frequencies = {frequencies}
sd = 0.05
"""


def storey_tables():
    text = ""
    for i, name in enumerate(("k1", "k2", "k3")):
        K = np.zeros((3, 3))
        K[i, i] = STIFFNESS
        if i:
            K[i - 1 : i + 1, i - 1 : i + 1] = STIFFNESS * np.array([[1.0, -1.0], [-1.0, 1.0]])
        text += f"\n[[model.stiffness]]\nmatrix = {K.tolist()}\npowers = {{ {name} = 1.0 }}\n"
        text += f'\n[[parameters]]\nname = "{name}"\nstart = 1.0\nlower = 0.6\nupper = 1.6\n'
    return text


def ratio_tables():
    return "".join(
        f'\n[[parameters]]\nname = "zeta{i}"\nstart = 0.015\nlower = 0.001\nupper = 0.1\n'
        'prior = { distribution = "log-normal", median = 0.015, sigma = 0.5 }\n'
        for i in (1, 2, 3)
    )


def write_table(path, data, change=lambda values: values):
    """Write FRFs with their standard deviations as a table."""
    columns = [f"{label} {part}" for label in data.labels for part in ("re", "im", "sd")]
    values = change(np.array(data.values))
    parts = np.stack([values.real, values.imag, data.standard_deviation], axis=1).reshape(-1, data.n_lines)
    rows = np.concatenate([np.asarray(data.frequencies_hz)[None], parts]).T
    body = "\n".join(",".join(repr(float(x)) for x in row) for row in rows)
    path.write_text(",".join(["frequency_hz", *columns]) + "\n" + body + "\n")


@pytest.fixture(scope="module")
def text():
    return MATRICES.format(extra=FRFS + MODAL) + storey_tables() + ratio_tables()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frfs")
    write_table(folder / "frfs.csv", simulate())
    return folder


def problem_of(text, folder):
    (folder / "problem.toml").write_text(text)
    return load(folder / "problem.toml")


def mistakes_of(text, folder):
    with pytest.raises(ConfigurationError) as caught:
        problem_of(text, folder)
    return " ".join(str(caught.value).split())


def test_a_file_gives_the_density_of_python(text, folder):
    found = problem_of(text, folder)
    own = fmu.FRFErrors(simulate(), fmu.ModalDamping(ratios()))
    expected = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    assert found.names == expected.names
    theta = np.r_[TRUTH, RATIOS]
    assert np.isclose(found.log_prob(theta), expected.log_prob(theta), rtol=1e-12)


def test_without_a_measurement_the_modes_are_the_resonances(text, folder):
    found = problem_of(text, folder)
    truth = np.asarray(modes().frequencies_hz)
    assert np.allclose(found.data.frequencies_hz, truth, rtol=0.01)
    assert np.allclose(found.data.sd_hz, 0.01 * np.asarray(found.data.frequencies_hz))
    assert found.data.sensors == POINTS
    assert found.data.use == (False,) * 3
    numbered = problem_of(text.replace('kind = "acc', 'modes = [1, 2, 3]\nkind = "acc', 1), folder)
    assert numbered.data.counterparts == (1, 2, 3)


def test_measured_modes_begin_the_search_if_they_are_given(text, folder):
    f = np.asarray(modes().frequencies_hz).tolist()
    found = problem_of(text + MODES.format(frequencies=f), folder)
    assert np.allclose(found.data.frequencies_hz, f, rtol=0, atol=0)
    assert found.data.use == (False,) * 3


def test_all_settings_of_the_errors(text, folder):
    given = """\
scale = "log"
model_sd = "model"
gain_sd = { "0 x" = 0.1 }
force_gain_sd = { "2 x" = 0.05 }
delay_sd = 1e-4
band = [[2.0, 6.0], [7.0, 15.0]]
use = [true, false]
factor = 2.0
window = ["hann", 20.0]
"""
    noise = '\n[[noise]]\nname = "model"\nstart = 0.01\nlower = 0.001\nupper = 0.5\n'
    found = problem_of(text.replace('kind = "acc', given + 'kind = "acc', 1) + noise, folder)
    (term,) = found.likelihood.responses
    settings = term.as_dict()
    assert (settings["scale"], settings["model_sd"]) == ("log", "model")
    assert settings["gain_sd"] == {"0 x": 0.1}
    assert settings["force_gain_sd"] == {"2 x": 0.05}
    assert settings["delay_sd"] == {"2 x": 1e-4, "0 x": 1e-4}
    assert term.data.window == ("hann", 20.0)
    inside = ((LINES >= 2.0) & (LINES <= 6.0)) | ((LINES >= 7.0) & (LINES <= 15.0))
    assert np.array_equal(term.data.used, np.stack([inside, np.zeros_like(inside)]))
    assert np.allclose(np.asarray(term.data.values), 2.0 * np.asarray(simulate().values), rtol=1e-12)
    of_channels = ("delay of 2 x", "delay of 0 x", "gain error of force 2 x")
    assert found.names[3:] == ("zeta1", "zeta2", "zeta3", *of_channels, "model")


@pytest.mark.parametrize(
    ("tables", "damping"),
    [
        ('kind = "modal"\nratios = 0.01', fmu.ModalDamping(0.01)),
        ('kind = "rayleigh"\nalpha = 0.5\nbeta = 1e-4', fmu.RayleighDamping(0.5, 1e-4)),
        ('kind = "structural"\nloss = 0.02\nof = { k1 = 0.05 }', fmu.StructuralDamping(0.02, {"k1": 0.05})),
        (
            'kind = "dashpot"\nat = [2, "x"]\nto = [1, "x"]\ncoefficient = 500.0',
            fmu.Dashpot((2, "x"), 500.0, (1, "x")),
        ),
        ('kind = "matrix"\nmatrix = "C.csv"\ncoefficient = 2.0', fmu.DampingMatrix(np.eye(3) * 300.0, 2.0)),
    ],
)
def test_each_kind_of_damping(tables, damping, folder):
    np.savetxt(folder / "C.csv", 300.0 * np.eye(3), delimiter=",")
    text = MATRICES.format(extra=FRFS + f"\n[[damping]]\n{tables}\n") + storey_tables()
    found = problem_of(text, folder)
    expected = fmu.UpdatingProblem(building(), modes(), parameters(), error=fmu.FRFErrors(simulate(), damping))
    assert np.isclose(found.log_prob(TRUTH), expected.log_prob(TRUTH), rtol=1e-12)


def test_points_and_a_dashpot_have_names_of_a_frame(frame_text, folder):
    lines = np.linspace(5.0, 60.0, 40)
    H = 1.0 / (1.0 - (lines / 30.0) ** 2 + 0.02j * lines / 30.0)
    data = fmu.FRFData(lines, [H], (("corner", "x"),), (("other", "x"),), "receptance", 0.1)
    write_table(folder / "named.csv", data)
    errors = FRFS.replace("frfs.csv", "named.csv").replace("accelerance", "receptance")
    dashpot = '\n[[damping]]\nkind = "dashpot"\nat = ["corner", "x"]\ncoefficient = 100.0\n'
    head, model = frame_text.split("[model]\n", 1)
    model, measurement = model.split("[measurement]\n", 1)
    parameters = measurement[measurement.index("[[parameters]]") :]
    found = problem_of(f"{head}{errors}{dashpot}[model]\n{model}{parameters}", folder)
    (term,) = found.likelihood.responses
    assert term.data.labels == ("other x / corner x",)
    assert all(isinstance(node, int) for node, _ in found.data.sensors)
    assert np.isfinite(found.log_prob(found.start))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"frfs.csv"', '"none.csv"', "error.0.data: must be a .*none.csv"),
        ('"accelerance"', '"inertance"', "error.0.kind: must be .*'receptance'"),
        ('kind = "acc', 'use = [true]\nkind = "acc', r"error.0.use: must be 2, one per FRF \(got 1\)"),
        ('kind = "acc', 'band = [90.0, 99.0]\nkind = "acc', "error.0.* must leave a line with a value"),
        ('kind = "acc', 'band = [9.0, 4.0]\nkind = "acc', "error.0.band: must have a lower frequency below"),
        ('kind = "acc', 'gain_sd = { "7 x" = 0.1 }\nkind = "acc', "error.0.gain_sd: must name .* among 2 x, 0 x"),
        ('kind = "acc', 'model_sd = "m"\nkind = "acc', "error.0.model_sd: must be the name of a .*noise"),
        (
            'kind = "acc',
            'modes = [1, 2]\nband = [1.0, 4.0]\nkind = "acc',
            "error.0.modes: must be 1, one per reson",
        ),
        (
            'kind = "acc',
            'drives = [[9, "x"], [9, "x"]]\nkind = "acc',
            r"error.0.data: must be a place .* free to move \(got 9 x\)",
        ),
        (
            'kind = "acc',
            'responses = [[2, "x"], ["roof", "x"]]\nkind = "acc',
            r"error.0.data: must have responses .* free to move \(got roof x\)",
        ),
        ('"zeta1", ', '"zeta9", ', "damping.0.ratios.0: must be the name of one of the .*parameters.*'zeta9'"),
        ('"zeta1", ', "-0.1, ", "damping.0.ratios.0: must be greater than or equal to 0"),
        ('kind = "modal"', 'kind = "viscous"', "damping.0.kind: must be one of modal, rayleigh"),
        ('name = "zeta1"\n', 'name = "zeta1"\nupdated = false\n', "parameters.3.updated: must not be given for"),
        (MODAL, "", "damping: must be given with an .*frf"),
        (FRFS, "", "damping: is used by frequency response functions only"),
    ],
)
def test_a_mistake_has_its_place_in_the_file(old, new, message, text, folder):
    assert old in text
    assert re.search(message, mistakes_of(text.replace(old, new, 1), folder))


def test_parameters_of_the_damping_come_last(folder):
    text = MATRICES.format(extra=FRFS + MODAL) + ratio_tables() + storey_tables()
    assert "parameters.0.name: must come after the parameters of the structure" in mistakes_of(text, folder)


def test_a_discrepancy_of_the_modes(text, folder):
    table = '\n[[discrepancy]]\nkind = "modes"\nsd = 0.02\ncorrelation = 0.0\n'
    found = problem_of(text + table, folder)
    assert found.names[6:] == (*(f"frequency of mode {k}" for k in (1, 2, 3)), "model error shapes")
    assert "discrepancy: of frequency response functions needs sd and" in mistakes_of(
        text + table.replace("sd = 0.02\n", ""), folder
    )


def test_frfs_without_values_are_a_mistake_of_the_file(text, folder, tmp_path):
    write_table(tmp_path / "frfs.csv", simulate(), lambda values: values * np.array([[1.0], [np.nan]]))
    assert "error.0.data: values.1: must have an FRF with values in each row" in mistakes_of(text, tmp_path)


def test_a_model_error_may_start_at_zero_beside_known_deviations(text, folder):
    """Errors of FRFs were counted as none, which any parameters would fit exactly."""
    noise = '[[noise]]\nname = "model"\nstart = 0.05\nupper = 0.5\n\n'
    free = text.replace("[model]", f"{noise}[model]", 1).replace(FRFS, f'{FRFS}model_sd = "model"\n', 1)
    found = problem_of(free, folder)
    model = fmu.Parameter("model", 0.05, 0.0, 0.5)
    own = fmu.FRFErrors(simulate(), fmu.ModalDamping(ratios()), model_sd=model)
    expected = fmu.UpdatingProblem(building(), modes(), parameters(), error=own)
    theta = np.r_[TRUTH, RATIOS, 0.02]
    assert np.isclose(found.log_prob(theta), expected.log_prob(theta), rtol=1e-12)
    data = simulate()
    one = fmu.FRFData(LINES[:1], data.values[:1, :1], data.drives[:1], data.responses[:1], "accelerance")
    line = folder / "line.csv"
    line.write_text(
        f"frequency_hz,{one.labels[0]} re,{one.labels[0]} im\n"
        f"{float(LINES[0])!r},{float(one.values[0, 0].real)!r},{float(one.values[0, 0].imag)!r}\n"
    )
    of_line = free.replace('data = "frfs.csv"', 'data = "line.csv"') + MODES.format(frequencies=[3.0, 8.0, 12.0])
    assert "noise.0.lower: must be positive" in mistakes_of(of_line, folder)
    assert "6 parameters can fit these 2 errors exactly" in mistakes_of(of_line, folder)
