"""Models from exported matrices: every format gives the posterior of the structure that was exported."""

import re
from contextlib import suppress

import h5py
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.io import hb_write, savemat

import fmu
from fmu.config import ConfigurationError, load
from tests import cantilever
from tests.matrix_files import write_matrix


def with_suffix(suffix):
    def write(folder, name, matrix):
        write_matrix(folder / f"{name}{suffix}", matrix)
        return f'file = "{name}{suffix}"'

    return write


def one_triangle(folder, name, matrix):
    write_matrix(folder / f"{name}.mtx", sp.tril(matrix))
    return f'file = "{name}.mtx"\ntriangle = "lower"'


def harwell_boeing(folder, name, matrix):
    hb_write(folder / f"{name}.rua", sp.csc_array(matrix))
    return f'file = "{name}.rua"'


def one_matlab_file(folder, name, matrix):
    """Both matrices in a file need a name; each call adds one."""
    from scipy.io import loadmat

    path = folder / "model.mat"
    kept = (
        {k: sp.csc_array(v) for k, v in loadmat(path, spmatrix=False).items() if k[0] != "_"}
        if path.exists()
        else {}
    )
    savemat(path, kept | {name: sp.csc_array(matrix)})
    return f'file = "model.mat"\nvariable = "{name}"'


def one_hdf5_file(folder, name, matrix):
    with h5py.File(folder / "model.h5", "a") as file:
        file[f"terms/{name}"] = matrix.toarray()
    return f'file = "model.h5"\nvariable = "terms/{name}"'


def abaqus(folder, name, matrix):
    """As Abaqus writes it: one triangle, supports held by 1e36, dofs by node and number, zeros left out."""
    lines = ["** written for a test"]
    entries = sp.coo_array(sp.tril(matrix))
    for row, column, value in zip(entries.row, entries.col, entries.data, strict=True):
        (a, d), (b, e) = (BEAM.dofs[i] for i in (row, column))
        lines.append(f"{a + 1},{NUMBER[d]}, {b + 1},{NUMBER[e]}, {value:.17e}")
    if name.startswith("stiffness"):
        lines += [f"1000,{k}, 1000,{k}, 1e36" for k in (1, 2, 3)]
    (folder / f"{name}.mtx").write_text("\n".join(lines))
    return f'file = "{name}.mtx"'


NUMBER = {d: i for i, d in enumerate(("x", "y", "z", "rx", "ry", "rz"), start=1)}
YOUNG = cantilever.young("index")
BEAM = YOUNG.model.structure
BUILT = fmu.UpdatingProblem(BEAM, YOUNG.data, YOUNG.parameters, pairing="index", beta=1.0)
FORMATS = {suffix: with_suffix(suffix) for suffix in (".mtx", ".npz", ".npy", ".mat", ".h5", ".csv")} | {
    "one triangle": one_triangle,
    "Harwell-Boeing": harwell_boeing,
    "variables of MATLAB": one_matlab_file,
    "datasets of HDF5": one_hdf5_file,
    "Abaqus": abaqus,
}


def exported(folder, write):
    """Write the beam as matrices, and a file that names them."""
    text = ['name = "exported"', 'pairing = "index"', "reduction = false", "[model]", 'type = "matrices"']
    if write is not abaqus:
        text.append(f"dofs = {[list(dof) for dof in BEAM.dofs]}")
    for key, terms in (("stiffness", BEAM.K_terms), ("mass", BEAM.M_terms)):
        for k, term in enumerate(terms):
            powers = ", ".join(f"{n} = {p:g}" for n, p in zip(BUILT.names, term.powers, strict=True) if p)
            text += [f"[[model.{key}]]", write(folder, f"{key}{k}", term.matrix), f"powers = {{ {powers} }}"]
    text += ["[measurement]", "frequencies = [31.9, 197.9, 553.0, 1082.2, 1781.5]", "numbers = [1, 3, 5, 7, 9]"]
    text += ["beta = 1.0", f'sensors = [[{49 + (write is abaqus)}, "z"]]']
    for name in BUILT.names:
        text += ["[[parameters]]", f'name = "{name}"', "start = 2.4e11", "lower = 1.7e11", "upper = 2.5e11"]
        text.append('prior = { distribution = "normal", sd = 2e11 }')
    (folder / "exported.toml").write_text("\n".join(text))
    return folder / "exported.toml"


@pytest.mark.parametrize("name", FORMATS)
def test_the_beam_exported_and_read_back(tmp_path, name):
    problem = load(exported(tmp_path, FORMATS[name]))
    theta = BUILT.sample_prior(np.random.default_rng(4), 5)
    assert_allclose(problem.log_prob(theta), BUILT.log_prob(theta), rtol=1e-9)
    assert problem.model.structure.n_dof == BEAM.n_dof


def changed(folder, text, old="", new=""):
    assert old in text
    (folder / "changed.toml").write_text(text.replace(old, new, 1))
    return load(folder / "changed.toml")


def complaint(folder, text, old="", new=""):
    with pytest.raises(ConfigurationError) as caught:
        changed(folder, text, old, new)
    return str(caught.value)


@pytest.fixture
def broken(folder):
    """The two storeys with files beside theirs that fit, or do not."""
    write_matrix(folder / "three.npz", np.eye(3))
    write_matrix(folder / "massless.npz", np.diag([16.5e3, 0.0]))
    write_matrix(folder / "indefinite.npz", [[1e3, 2e3], [2e3, 1e3]])
    write_matrix(folder / "lower.npz", [[1e3, 0.0], [500.0, 1e3]])
    write_matrix(folder / "minus.npz", np.diag([-8.0, 0.0]))
    write_matrix(folder / "held.npz", np.diag([1.0, 1e36]))
    write_matrix(folder / "nothing.npz", np.zeros((2, 2)))
    savemat(folder / "model.mat", {"K1": np.diag([1.0, 0.0]), "K2": np.eye(2)})
    (folder / "STIF1.mtx").write_text("1,1, 1,1, 2.0\n1,1, 2,1, -1.0\n2,1, 2,1, 1.0\n")
    return folder


M, K = 'file = "m.mtx"', 'file = "k1.mtx"'
BROKEN = [
    (M, 'file = "three.npz"', "model.mass.0.file: must have 2 rows, as model.stiffness.0 has (got 3)"),
    (M, 'file = "massless.npz"', "the 2 measured modes need as many of finite frequency: the mass matrix gives 1"),
    (
        M,
        'file = "indefinite.npz"',
        "model: the mass matrix must be positive semidefinite (it is not where",
    ),
    (
        M,
        'file = "lower.npz"',
        "model.mass.0.file: must be symmetric (row 1, column 2 differs by 500); it holds only its low",
    ),
    (
        M,
        'file = "lower.npz"\ntriangle = "upper"',
        "model.mass.0.triangle: the file must have only its upper triangle",
    ),
    (M, 'file = "lower.npz"\ntriangle = "left"', "model.mass.0.triangle"),
    (K, 'file = "minus.npz"', "model: the stiffness matrix must be positive semidefinite"),
    (K, 'file = "nothing.npz"', "model: the structure is a mechanism: it can move without strain in 1 way"),
    (K, 'file = "nothing.npz"', "set free = true if it is free on purpose"),
    (K, 'file = "model.mat"', "model.stiffness.0.variable: must be given, one of K1, K2"),
    (K, 'file = "model.mat"\nvariable = "K3"', "model.stiffness.0.variable: must be one of K1, K2 (got 'K3')"),
    (K, 'file = "k1.mtx"\nvariable = "K3"', "model.stiffness.0.variable: a .mtx file has one matrix"),
    (K, 'file = "STIF1.mtx"', "model.stiffness.1.file: must name its degrees of freedom, as the other files do"),
    (K, 'file = "STIF1.mtx"', "model.dofs: must not be given: the files name the degrees of freedom"),
    (K, 'file = ""', "model.stiffness.0.file: must have at least 1 character"),
    (K, "", "model.stiffness.0: must have either file or matrix"),
    (K, f"{K}\nmatrix = [[1.0, 0.0], [0.0, 0.0]]", "model.stiffness.0: must have either file or matrix"),
    (K, 'matrix = [[1.0]]\nvariable = "K"', "model.stiffness.0: variable must not be given together with matrix"),
    (
        K,
        "matrix = [[1.0, 2.0], [3.0]]",
        "matrix: must have rows of one length, one value per column (got [2, 1])",
    ),
    (K, "matrix = [[1.0, 2.0]]", "model.stiffness.0.matrix: must hold a real square matrix (got float64 of shape"),
    (K, "matrix = []", "model.stiffness.0.matrix: must have at least 1 item"),
    (K, "matrix = [[]]", "model.stiffness.0.matrix: must hold a real square matrix (got float64 of shape (1, 0))"),
    (K, "matrix = [[1.0, 5.0], [4.0, 1.0]]", "model.stiffness.0.matrix: must be symmetric (row 1, column 2"),
    (K, "matrix = [[1.0, nan], [nan, 1.0]]", "model.stiffness.0.matrix"),
    (M, "matrix = [[1.0]]", "model.mass.0.matrix: must have 2 rows, as model.stiffness.0 has (got 1)"),
    ('["second", "x"]]', '["second", "w"]]', "model.dofs.1: must be a node and one of x, y, z, rx, ry, rz (got"),
    (
        '["second", "x"]]',
        '["first", "x"]]',
        "model.dofs.1: must not be the name of another row (got ['first', 'x'])",
    ),
    (
        'name = "k1"',
        'name = "k1"\nproperty = "E"\ngroups = ["a"]',
        "parameters.0.groups: is allowed for frames only",
    ),
]


@pytest.mark.parametrize(("old", "new", "expected"), BROKEN)
def test_what_is_wrong_is_said(broken, matrices_text, old, new, expected):
    assert expected in complaint(broken, matrices_text, old, new)


def test_a_free_structure_has_to_be_meant(broken, matrices_text):
    text = matrices_text.replace(K, 'file = "nothing.npz"').replace("shapes = [[0.6, 1.0], [1.0, -0.6]]", "")
    text = text.replace("[3.1, 9.8]", "[9.8]").replace('type = "matrices"', 'type = "matrices"\nfree = true')
    problem = changed(broken, text)
    stiffness, (m1, m2) = 2.97e7, (16.5e3, 16.1e3)
    expected = np.sqrt(stiffness * (1 / m1 + 1 / m2)) / (2 * np.pi)
    assert_allclose(problem.frequencies(problem.start), [expected], rtol=1e-9)


def test_a_triangle_alone_and_files_in_folders(broken, matrices_text):
    (broken / "parts").mkdir()
    write_matrix(broken / "parts" / "m.npz", [[16.5e3, 0.0], [5e3, 16.1e3]])
    whole = changed(broken, matrices_text, M, 'file = "parts/m.npz"\ntriangle = true')
    assert_allclose(whole.model.structure.M(whole.start).toarray(), [[16.5e3, 5e3], [5e3, 16.1e3]])


def test_a_small_matrix_is_given_by_its_rows(folder, matrices_text):
    from_file = changed(folder, matrices_text)
    for rows in ("[[16.5e3, 0.0], [0.0, 16.1e3]]", "[[16.5e3, 0.0], [0.0, 16.1e3]]\ntriangle = true"):
        given = changed(folder, matrices_text, M, f"matrix = {rows}")
        theta = from_file.sample_prior(np.random.default_rng(2), 5)
        assert_allclose(given.log_prob(theta), from_file.log_prob(theta), rtol=1e-12)


def test_what_a_support_holds_is_left_out(broken, matrices_text):
    text = matrices_text.replace("shapes = [[0.6, 1.0], [1.0, -0.6]]", "").replace("[3.1, 9.8]", "[3.1]")
    problem = changed(
        broken, text.replace('sensors = [["first", "x"], ["second", "x"]]', ""), K, 'file = "held.npz"'
    )
    assert problem.model.structure.dofs == (("first", "x"),)
    assert_allclose(problem.frequencies(problem.start), [np.sqrt(2 * 2.97e7 / 16.5e3) / (2 * np.pi)], rtol=1e-9)


def test_a_held_dof_of_which_nothing_is_left(broken, matrices_text):
    write_matrix(broken / "k1.mtx", np.diag([1e36, 1e36]))
    assert "model.stiffness: must have a diagonal entry below 1e+30" in complaint(broken, matrices_text)


NASTY = st.sampled_from(
    [
        '""',
        "0",
        "-1",
        "1e400",
        "nan",
        "inf",
        "true",
        "[]",
        "{}",
        '"x"',
        "[[]]",
        '"model.mat"',
        "[[1.0, 0.0], [0.0, 1.0]]",
        '"STIF1.mtx"',
        '"lower"',
    ]
)


@settings(
    max_examples=80, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_values_changed_at_random_never_crash(broken, matrices_text, data):
    """A changed file is a problem or a configuration error; nothing else."""
    text = matrices_text.replace(M, f'{M}\nvariable = "M"\ntriangle = false', 1).replace(
        "factor", "free = 1\nfactor", 0
    )
    places = [m.span(1) for m in re.finditer(r"= (.+)$", text, re.MULTILINE)]
    first, last = data.draw(st.sampled_from(places))
    with suppress(ConfigurationError):
        changed(broken, text[:first] + data.draw(NASTY) + text[last:])
