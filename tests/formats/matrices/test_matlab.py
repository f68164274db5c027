"""Matrices of MATLAB: in structs, with names of rows, and as text."""

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.io import savemat

import fmu
from fmu.formats.matrices.read import read_labelled

K = np.array([[3.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.5]])
M = np.diag([1.0, 2.0, 3.0])
ROWS = np.array([[7, 1], [7, 5], [12, 3]])
NAMES = ((7, "x"), (7, "ry"), (12, "z"))


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", [np.asarray, sp.csc_array])
@pytest.mark.parametrize("inside", [False, True])
def test_both_matrices_of_a_file_with_names(tmp_path, compressed, kind, inside):
    content = {"Kgg": kind(K), "Mgg": kind(M), "dofs": ROWS, "title": "model", "n": 3}
    savemat(tmp_path / "a.mat", {"model": content} if inside else content, do_compression=compressed)
    read = fmu.read_model(tmp_path / "a.mat")
    assert read.dofs == NAMES
    np.testing.assert_array_equal(read.stiffness.toarray(), K)
    np.testing.assert_array_equal(read.mass.toarray(), M)


def test_a_lower_triangle_is_filled(tmp_path):
    savemat(tmp_path / "a.mat", {"K": np.tril(K), "M": M, "dofs": ROWS})
    np.testing.assert_array_equal(fmu.read_model(tmp_path / "a.mat").stiffness.toarray(), K)


TEXT = """\
%% exported by a script: K = [1 2 3];
n = 3;
K = [ 3 -1  0;   % first
     -1, 2, ...
      -1
      0 -1 1.5 ];
M = sparse([1 2 3], [1; 2; 3], ...
           [1.0 2.0 3e0], 3, 3);
system('touch executed');
S = spconvert([1 1 3; 2 1 -1; 2 2 2; 3 2 -1; 3 3 1.5]);
"""


def test_text(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.m").write_text(TEXT)
    (tmp_path / "n.csv").write_text("7,1\n7,5\n12,3\n")
    read = fmu.read_model(tmp_path / "a.m", dofs=tmp_path / "n.csv")
    np.testing.assert_array_equal(read.stiffness.toarray(), K)
    np.testing.assert_array_equal(read.mass.toarray(), M)
    assert read.dofs == NAMES
    lower = read_labelled(tmp_path / "a.m", "S", "lower").matrix
    np.testing.assert_array_equal(lower.toarray(), K)
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    "after", ["K = sparse(K);", "fprintf('K = stiffness');", "[" * 20_000, "KK = 3; a.K = 2;"]
)
def test_statements_that_do_not_change_a_matrix(tmp_path, after):
    (tmp_path / "k.m").write_text(f"K = [2 -1; -1 2];\n{after}\n")
    found = read_labelled(tmp_path / "k.m", "K").matrix.toarray()
    np.testing.assert_array_equal(found, [[2.0, -1.0], [-1.0, 2.0]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("K = [1 2; 3", "K is cut short"),
        ("K = [1 2; 3];", "K must have 2 numbers in each row"),
        ("K = [a b; 1 2];", "written out .got 'a'"),
        ("K = sparse([1 2], [1 2], x);", r"sparse\(rows, columns, entries\) with each in brackets"),
        ("K = sparse([1 2], [1 2], [1]);", r"as many rows as columns and entries \(got 2, 2, 1\)"),
        ("K = sparse([1 2], [1 2], [1 1], 900000000, 900000000);", "at most 1048576 degrees"),
        ("K = spconvert([0 1 1]);", "whole numbers from 1"),
        ("K = 3;", "it holds none"),
        ("%{\nK = [9 0; 0 9];\n%}\n# K = [1 2; 2 1];", "it holds none"),
        ("K = [2 0; 0 0] + [0 -1; -1 2];", r"no arithmetic but one factor .* after it \(got '\+ \[0 -1; -1 2\];'"),
        ("K = [2 -1; -1 2]*k;", "K must have no arithmetic"),
        ("K = [2 -1; -1 2]*1e6*2;", "K must have no arithmetic"),
        ("K = [2 -1; -1 2]';", "K must have no arithmetic"),
        ("K = [2 -1 0; -1 2 0; 0 0 0](1:2, 1:2);", "K must have no arithmetic"),
        ("K = [2 -1; -1 2]/0;", "K must not be divided by zero"),
        ("K = [1 1 2; 2 1 -1; 2 2 2; 3 3 1]*5;", r"K must be square, as it has a factor \(got 4 by 3\)"),
        ("K = sparse([1 2], [1 2], [1 1]*1e6, 2, 2);", "K must have no arithmetic inside its parentheses"),
        ("K = sparse([1 2], [1 2], [1 1]) + S;", "K must have no arithmetic but"),
        ("K = sparse([1 2], [1 2], [1 1], n, max(n, 2)) + S;", "K must have no arithmetic but"),
        ("K = spconvert([1 1 2; 2 2 2]*2);", "K must have no arithmetic inside its parentheses"),
        ("a = [1 1 2; 2 2 2]*5;\nK = spconvert(a);", "a must have no factor: it has rows and columns too"),
        (
            "a = [1 1 2; 2 2 2];\na(:,3) = 5*a(:,3);\nK = spconvert(a);",
            "a must not be changed by a later statement",
        ),
        ("a = [1 1 2; 2 2 2];\nK = sparse(a(:,1), a(:,2), a(:,3)) + S;", "K must have no arithmetic but"),
        (
            "a = [1 1 2; 2 2 2];\nK = sparse(a(:,1), a(:,2), a(:,3), n + 1, 3) + S;",
            "K must have no arithmetic but",
        ),
        ("K = [2 -1; -1 2];\nK = K*1e6;", r"K must not be changed by a later statement \(got 'K = K\*1e6;'\)"),
        ("K = [2 -1; -1 2];\nK(1, 1) = 5;", "K must not be changed"),
        ("K = [2 -1; -1 2];\nK *= 2;", "K must not be changed"),
        ("K = [2 -1; -1 2];\n[K, n] = scale(K);", "K must not be changed"),
    ],
)
def test_broken_text_is_refused(tmp_path, text, message):
    (tmp_path / "a.m").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_labelled(tmp_path / "a.m")


@pytest.mark.parametrize(
    "text",
    [
        "K = [2 -1; -1 2]*1e6;",
        "K = [2e9 -1e9; -1e9 2e9] ./ 1000, disp(K)",
        "K = sparse([1 2 1 2], [1 1 2 2], [2 -1 -1 2], 2, 2) * +1.e6 % N/m",
        "n = 2;\nK = sparse([1 2 1 2], [1 1 2 2], [2 -1 -1 2], n, n)*1E+6;",
        "K = spconvert([1 1 2; 2 1 -1; 1 2 -1; 2 2 2])*1000000;",
        "a = [1 1 2; 2 1 -1; 1 2 -1; 2 2 2];\nK = spconvert(a)*1e6;\na = 0;\nif K == 1, K2 = K; s.K = 3; end",
        "a = [1 1 2; 2 1 -1; 1 2 -1; 2 2 2];\nK = sparse(a(:,1), a(:,2), a(:,3), max(a(:,1)), 2)*1e6;",
    ],
)
def test_one_factor_after_a_matrix_is_applied(tmp_path, text):
    (tmp_path / "a.m").write_text(text)
    found = read_labelled(tmp_path / "a.m", "K").matrix.toarray()
    np.testing.assert_allclose(found, 1e6 * np.array([[2.0, -1.0], [-1.0, 2.0]]), rtol=1e-15)


def test_broken_names_are_refused(tmp_path):
    savemat(tmp_path / "a.mat", {"K": K, "M": M, "dofs": np.add(ROWS, [[0, 6]])})
    with pytest.raises(ValueError, match="dofs must have rows of node and direction"):
        fmu.read_model(tmp_path / "a.mat")


def test_random_damage_of_a_struct_is_refused_or_harmless(tmp_path):
    savemat(tmp_path / "a.mat", {"model": {"K": K, "M": M, "dofs": ROWS}})
    content, rng, said = (tmp_path / "a.mat").read_bytes(), np.random.default_rng(1), 0
    for _ in range(300):
        broken = bytearray(content)
        for at in rng.integers(120, len(content), 1 + rng.integers(4)):
            broken[at] = rng.choice([0, 255, 127, rng.integers(256)])
        (tmp_path / "a.mat").write_bytes(bytes(broken))
        try:
            fmu.read_model(tmp_path / "a.mat")
        except ValueError:
            said += 1
    assert said > 0
