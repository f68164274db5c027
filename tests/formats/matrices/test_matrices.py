"""What is written is read back; what other programs write is read; what is no matrix is refused in a sentence."""

import gzip
import io
import tracemalloc

import h5py
import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from scipy.io import hb_write, mmwrite, savemat

from fmu.formats.matrices import limits
from fmu.formats.matrices.read import read_labelled, read_matrix
from tests.matrix_files import write_matrix

K = np.array([[4.0, -1.0, 0.0, 0.0], [-1.0, 3.0, 1 / 3, 0.0], [0.0, 1 / 3, 2.0, -0.1], [0.0, 0.0, -0.1, 1e12]])
TWO = np.array([[2.0, -1.0], [-1.0, 2.0]])


def rsa(matrix, values="(3D26.18)", right_hand_sides=0):
    """A symmetric matrix as Ansys writes it: the lower triangle by columns, D for the exponent."""
    half = sp.csc_array(np.tril(matrix))
    width = int(values.rstrip(")").split("D")[1].split(".")[0])
    words = [f"{x:{width}.{width - 8}E}".replace("E", "D") for x in half.data]
    parts = [
        [
            "".join(f"{n + 1:8d}" for n in row)
            for row in (indices[at : at + 10] for at in range(0, len(indices), 10))
        ]
        for indices in (half.indptr, half.indices)
    ] + [["".join(words[at : at + 3]) for at in range(0, len(words), 3)]]
    counts = [len(part) for part in parts]
    lines = [f"{'stiffness':72}{'fmu':8}"]
    lines.append("".join(f"{n:14d}" for n in (sum(counts) + right_hand_sides, *counts, right_hand_sides)))
    lines.append(f"{'RSA':14}" + "".join(f"{n:14d}" for n in (*half.shape, half.nnz, 0)))
    lines.append(f"{'(10I8)':16}{'(10I8)':16}{values:20}{values:20}")
    lines += [f"{'F':14}{1:14d}{0:14d}"] * (right_hand_sides > 0)
    return "\n".join([*lines, *(line for part in parts for line in part), *["0.0"] * right_hand_sides, ""])


def v73(path, name, matrix):
    """A sparse matrix as MATLAB's version 7.3 keeps it."""
    columns = sp.csc_array(matrix)
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group(name)
        group.attrs["MATLAB_sparse"] = np.uint64(matrix.shape[0])
        group.attrs["MATLAB_class"] = np.bytes_("double")
        group["data"], group["ir"], group["jc"] = columns.data, columns.indices, columns.indptr
        file.create_group("#refs#")["a"] = np.ones((5, 5))
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


@pytest.mark.parametrize("suffix", [".mtx", ".npz", ".npy", ".mat", ".h5", ".hdf5", ".csv"])
def test_what_is_written_is_read_back_to_the_last_bit(tmp_path, suffix):
    for given_as in (K, sp.coo_array(K)):
        write_matrix(tmp_path / f"k{suffix}", given_as)
        found = read_matrix(tmp_path / f"k{suffix}")
        assert isinstance(found, sp.csr_array)
        assert_array_equal(found.toarray(), K)


def test_matrix_market_symmetric_and_compressed(tmp_path):
    half = io.BytesIO()
    mmwrite(half, sp.coo_array(K), symmetry="symmetric", precision=17)
    (tmp_path / "k.mtx.gz").write_bytes(gzip.compress(half.getvalue()))
    assert_array_equal(read_matrix(tmp_path / "k.mtx.gz").toarray(), K)


def test_matrix_market_of_every_kind(tmp_path):
    path = tmp_path / "k.mtx"
    for layout in (sp.coo_array(TWO), TWO):
        for symmetry in ("general", "symmetric"):
            for comment in ("", "two\n lines"):
                mmwrite(path, layout, symmetry=symmetry, comment=comment)
                assert_array_equal(read_matrix(path).toarray(), TWO)
    for layout in (sp.coo_array(TWO.astype(int)), TWO.astype(int)):
        mmwrite(path, layout)
        assert_array_equal(read_matrix(path).toarray(), TWO)
    for wrong in (np.array([[0.0, 1.0], [-1.0, 0.0]]), sp.coo_array([[0.0, 1.0], [-1.0, 0.0]])):
        mmwrite(path, wrong, symmetry="skew-symmetric")
        with pytest.raises(ValueError, match=r"must be symmetric \(row 1, column 2 differs by 2\)"):
            read_matrix(path)
    mmwrite(path, sp.coo_array((3, 3)))
    assert read_matrix(path).nnz == 0


def test_harwell_boeing(tmp_path):
    hb_write(tmp_path / "k.rua", sp.csc_array(K))
    assert_array_equal(read_matrix(tmp_path / "k.rua").toarray(), K)
    for name, right_hand_sides in (("k.rsa", 0), ("k.hb", 2)):
        (tmp_path / name).write_text(rsa(K, right_hand_sides=right_hand_sides))
        assert_array_equal(read_matrix(tmp_path / name).toarray(), K)


def test_abaqus_matrix_input_names_its_degrees_of_freedom(tmp_path):
    lines = ["** STIFFNESS", "7,1, 7,1, 4.0", "7,1, 7,6, -1.0", "7,6, 7,6, 3.0", "3,2, 3,2, 5.0", "7,6, 3,2, 0.5"]
    (tmp_path / "job_STIF1.mtx").write_text("\n".join(lines))
    found = read_labelled(tmp_path / "job_STIF1.mtx")
    assert found.dofs == ((3, "y"), (7, "x"), (7, "rz"))
    assert_array_equal(found.matrix.toarray(), [[5.0, 0.0, 0.5], [0.0, 4.0, -1.0], [0.5, -1.0, 3.0]])
    (tmp_path / "full.mtx").write_text("\n".join([*lines, "7,6, 7,1, -1.0", "3,2, 7,6, 0.5"]))
    assert_array_equal(read_labelled(tmp_path / "full.mtx").matrix.toarray(), found.matrix.toarray())


def test_abaqus_coordinates(tmp_path):
    entries = sp.coo_array(K)
    lines = [f"{r + 1}  {c + 1}  {x:.17e}" for r, c, x in zip(entries.row, entries.col, entries.data, strict=True)]
    (tmp_path / "job_STIF1.mtx").write_text("\n".join(lines))
    found = read_labelled(tmp_path / "job_STIF1.mtx")
    assert found.dofs is None
    assert_array_equal(found.matrix.toarray(), K)


def test_matlab_by_name_and_alone(tmp_path):
    savemat(tmp_path / "model.mat", {"K1": K, "M": sp.csc_array(TWO), "note": "text", "f": 3.0})
    assert_array_equal(read_matrix(tmp_path / "model.mat", "K1").toarray(), K)
    assert_array_equal(read_matrix(tmp_path / "model.mat", "M").toarray(), TWO)
    assert_array_equal(read_matrix(tmp_path / "model.mat", "f").toarray(), [[3.0]])
    with pytest.raises(ValueError, match=r"^variable: must be given, one of K1, M$"):
        read_matrix(tmp_path / "model.mat")
    with pytest.raises(ValueError, match=r"^variable: must be one of K1, M, f \(got 'K2'\)$"):
        read_matrix(tmp_path / "model.mat", "K2")
    savemat(
        tmp_path / "whole.mat", {"K": TWO.astype(np.int16), "text": "K", "cell": np.array([1, "a"], dtype=object)}
    )
    assert_array_equal(read_matrix(tmp_path / "whole.mat").toarray(), TWO)
    savemat(tmp_path / "complex.mat", {"K": 1j * K}, do_compression=True)
    with pytest.raises(ValueError, match=r"must hold a real matrix \(it is complex\)"):
        read_matrix(tmp_path / "complex.mat")
    savemat(tmp_path / "alone.mat", {"K": K, "f": 3.0}, do_compression=True)
    assert_array_equal(read_matrix(tmp_path / "alone.mat").toarray(), K)


def test_matlab_seven_three(tmp_path):
    v73(tmp_path / "model.mat", "K", K)
    for name in (None, "K"):
        assert_array_equal(read_matrix(tmp_path / "model.mat", name).toarray(), K)


@pytest.mark.parametrize("kind", ["csr", "csc", "coo"])
@pytest.mark.parametrize("where", ["/", "matrices/K"])
def test_sparse_groups_of_hdf5(tmp_path, kind, where):
    lower = sp.csc_array(np.tril(K)) if kind == "csc" else sp.csr_array(np.tril(K))
    with h5py.File(tmp_path / "model.h5", "w") as file:
        group = file.require_group(where)
        group.attrs["shape"] = lower.shape
        group["data"] = lower.data
        if kind == "coo":
            group["row"], group["col"] = lower.tocoo().coords
        else:
            group.attrs["format"] = kind
            group["indices"], group["indptr"] = lower.indices, lower.indptr
    assert_array_equal(read_matrix(tmp_path / "model.h5", where, "lower").toarray(), K)


def test_dense_hdf5_and_npz_by_name(tmp_path):
    with h5py.File(tmp_path / "model.h5", "w") as file:
        file["parts/K"], file["parts/M"], file["note"] = K, TWO, "text"
    np.savez(tmp_path / "model.npz", K=K, M=TWO)
    assert_array_equal(read_matrix(tmp_path / "model.h5", "parts/M").toarray(), TWO)
    assert_array_equal(read_matrix(tmp_path / "model.npz", "M").toarray(), TWO)
    for name in ("model.h5", "model.npz"):
        with pytest.raises(ValueError, match="variable: must be given, one of"):
            read_matrix(tmp_path / name)


@pytest.mark.parametrize(("half", "triangle"), [(np.tril(K), "lower"), (np.triu(K), "upper"), (np.tril(K), True)])
def test_one_triangle_is_filled_in(tmp_path, half, triangle):
    write_matrix(tmp_path / "k.npz", half)
    assert_array_equal(read_matrix(tmp_path / "k.npz", triangle=triangle).toarray(), K)
    with pytest.raises(
        ValueError, match=r"must be symmetric .*; it holds only its (lower|upper) triangle: triangle"
    ):
        read_matrix(tmp_path / "k.npz")


def test_a_half_that_renumbering_has_scattered(tmp_path):
    order = [2, 0, 3, 1]
    write_matrix(tmp_path / "k.npz", np.tril(K)[order][:, order])
    assert_array_equal(read_matrix(tmp_path / "k.npz", triangle=True).toarray(), K[order][:, order])


def test_the_wrong_triangle(tmp_path):
    write_matrix(tmp_path / "k.npz", np.tril(K))
    with pytest.raises(
        ValueError, match=r"triangle: the file must have only its upper triangle \(it has entries: 0"
    ):
        read_matrix(tmp_path / "k.npz", triangle="upper")
    write_matrix(tmp_path / "k.npz", K)
    with pytest.raises(ValueError, match="triangle: the file must have each pair of entries once"):
        read_matrix(tmp_path / "k.npz", triangle=True)


REFUSED = [
    (np.ones((2, 3)), r"must hold a real square matrix \(got float64 of shape \(2, 3\)\)"),
    (np.array([[1j, 0.0], [0.0, 1.0]]), "must hold a real square matrix"),
    (np.array([[1.0, np.nan], [np.nan, 1.0]]), "must be finite"),
    (np.array([[1.0, 2.0], [0.5, 1.0]]), r"must be symmetric \(row 1, column 2 differs by 1.5\)$"),
    (np.zeros((0, 0)), "must have 1 to 1048576 degrees of freedom"),
    (np.array([["a", "b"], ["c", "d"]]), "must hold a real square matrix"),
]


@pytest.mark.parametrize(("array", "words"), REFUSED)
def test_what_is_no_symmetric_matrix(tmp_path, array, words):
    np.save(tmp_path / "k.npy", array)
    with pytest.raises(ValueError, match=words):
        read_matrix(tmp_path / "k.npy")


def test_pickles_are_not_read(tmp_path):
    np.save(tmp_path / "k.npy", np.array([{}], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "k.npz", K=np.array([{}], dtype=object))
    for name in ("k.npy", "k.npz"):
        with pytest.raises(ValueError, match="must hold a matrix"):
            read_matrix(tmp_path / name)


def test_indices_beyond_the_matrix(tmp_path):
    np.savez(
        tmp_path / "k.npz", format=b"csr", shape=(2, 2), data=[1.0, 1.0], indices=[0, 2**20], indptr=[0, 1, 2]
    )
    with pytest.raises(ValueError, match="must hold a matrix"):
        read_matrix(tmp_path / "k.npz")


ANNOUNCED = [
    (
        "pattern",
        "coordinate pattern general\n2 2 1\n1 1\n",
        r"must have values \(a Matrix Market pattern has none\)",
    ),
    ("entries", "coordinate real general\n2 2 900000000\n1 1 1.0\n", "must have the 900000000 entries"),
    ("size", "coordinate real general\n900000000 900000000 1\n1 1 1.0\n", "must have at most 1048576 degrees"),
    ("array", "array real general\n900000 900000\n1.0\n", "must have the 810000000000 entries"),
]


@pytest.mark.parametrize(("name", "text", "words"), ANNOUNCED)
def test_what_a_matrix_market_file_announces(tmp_path, name, text, words):
    (tmp_path / f"{name}.mtx").write_text(f"%%MatrixMarket matrix {text}")
    with pytest.raises(ValueError, match=words):
        read_matrix(tmp_path / f"{name}.mtx")


def test_sizes_are_looked_at_before_reading(tmp_path, monkeypatch):
    big = np.zeros((500, 500))
    savemat(tmp_path / "k.mat", {"K": big}, do_compression=True)
    np.savez_compressed(tmp_path / "k.npz", K=big)
    head = b"%%MatrixMarket matrix array real general\n500 500\n"
    (tmp_path / "k.mtx.gz").write_bytes(gzip.compress(head + b"0\n" * 250_000))
    with h5py.File(tmp_path / "k.h5", "w") as file:
        file.create_dataset("K", data=big, compression="gzip")
    write_matrix(tmp_path / "k.csv", big)
    monkeypatch.setattr(limits, "MOST_ENTRIES", 200_000)
    for suffix in (".mat", ".npz", ".mtx.gz", ".h5", ".csv"):
        with pytest.raises(ValueError, match=r"at most 200000 entries, both triangles counted \(got 250000\)"):
            read_matrix(tmp_path / f"k{suffix}")
    monkeypatch.setattr("fmu.formats.matrices.read.LARGEST_FILE", 100_000)
    with pytest.raises(ValueError, match="at most 100000 bytes"):
        read_matrix(tmp_path / "k.csv")


HOLES = {
    "nothing.mtx": b"",
    "announced.mtx": b"%%MatrixMarket matrix coordinate real general\n9999 9999 9999999\n1 1 1.0\n",
    "abaqus.mtx": b"*MATRIX\n1,1,1,1,1.0\n",
    "row.csv": b"1,0\n",
    "nothing.csv": b"",
    "nothing.mat": b"MATLAB 5.0".ljust(124) + b"\x00\x01IM",
    "nothing.hb": b"",
    "nothing.npz": b"PK\x03\x04",
}


@pytest.mark.parametrize("name", HOLES)
def test_a_gigabyte_of_nothing_takes_no_memory(tmp_path, name):
    """A sparse file; its text would take four times its size, and its numbers more."""
    with (tmp_path / name).open("wb") as file:
        file.write(HOLES[name])
        file.truncate(2**30)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"must hold a matrix .*(NUL|80 characters|unknown type 0|zip)"):
            read_matrix(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 100e6 + 8 * 3 * 9_999_999 * (name == "announced.mtx")
    finally:
        tracemalloc.stop()


def test_a_matrix_in_several_parts_is_the_same(tmp_path, monkeypatch):
    big = sp.csr_array(sp.diags_array([np.arange(1.0, 301.0), -np.ones(299), -np.ones(299)], offsets=[0, 1, -1]))
    labels = "".join(f"{i + 1},1, {j + 1},1, {float(big[i, j])!r}\n" for i, j in zip(*big.nonzero(), strict=True))
    (tmp_path / "abaqus.mtx").write_text(f"*MATRIX\n{labels}")
    write_matrix(tmp_path / "k.mtx", big)
    write_matrix(tmp_path / "k.csv", big)
    monkeypatch.setattr("fmu.formats.matrices.limits.BLOCK", 5000)
    for name in ("abaqus.mtx", "k.mtx", "k.csv"):
        assert_array_equal(read_matrix(tmp_path / name).toarray(), big.toarray())


def test_numbers_of_another_file_are_not_read(tmp_path):
    (tmp_path / "secret.bin").write_bytes(np.eye(2).tobytes())
    with h5py.File(tmp_path / "k.h5", "w") as file:
        file.create_dataset("K", (2, 2), "f8", external=[(str(tmp_path / "secret.bin"), 0, 32)])
    with pytest.raises(ValueError, match=r"must hold its numbers itself \(/K is kept in other files\)"):
        read_matrix(tmp_path / "k.h5")


def test_not_there_or_not_known(tmp_path):
    with pytest.raises(ValueError, match="must be a file"):
        read_matrix(tmp_path / "k.mtx")
    with pytest.raises(ValueError, match=r"must end in .mtx, .* \(got 'k.mp4'\)"):
        read_matrix(tmp_path / "k.mp4")
    write_matrix(tmp_path / "k.npy", K)
    with pytest.raises(ValueError, match=r"variable: a .npy file has one matrix, without a name \(got 'K'\)"):
        read_matrix(tmp_path / "k.npy", "K")


def files(folder):
    """The bytes of a good file of every kind but HDF5, whose own library does not survive all that is broken."""
    for suffix in (".mtx", ".npz", ".npy", ".mat", ".csv"):
        write_matrix(folder / f"k{suffix}", K)
    (folder / "k.rsa").write_text(rsa(K))
    (folder / "abaqus.mtx").write_text("1,1, 1,1, 4.0\n1,1, 1,2, -1.0\n1,2, 1,2, 3.0\n")
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    return folder, files(folder)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(data=st.data())
def test_bytes_changed_at_random_never_crash(good, data):
    """A changed file is a matrix or a ValueError; nothing else."""
    folder, contents = good
    name = data.draw(st.sampled_from(sorted(contents)))
    content = bytearray(contents[name])
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.sampled_from([len(content), len(content) // 2]))
    path = folder / f"changed-{name}"
    path.write_bytes(content[:cut])
    try:
        found = read_matrix(path)
    except ValueError:
        return
    assert np.all(np.isfinite(found.data))
    assert found.shape[0] == found.shape[1]


TRIPLETS = np.array([[1, 1, 4.0], [2, 1, -1.0], [2, 2, 5.0], [3, 2, -2.0], [3, 3, 6.0]])
FROM_TRIPLETS = [[4.0, -1.0, 0.0], [-1.0, 5.0, -2.0], [0.0, -2.0, 6.0]]


def triplets_text(table):
    return "\n".join(f"{int(row)} {int(column)} {entry!r}" for row, column, entry in table.tolist())


@pytest.mark.parametrize("end", [", 3, 3);", ", n, n);", ");", ",max(a(:,1)),max(a(:,1)));"])
def test_matlab_text_of_triplets_that_are_named_first(tmp_path, end):
    text = f"n = 3;\na = [\n{triplets_text(TRIPLETS)}\n];\nK = sparse(a(:,1), a( : , 2), a(:,3){end}\nclear a\n"
    (tmp_path / "Kssr.m").write_text(text)
    found = read_labelled(tmp_path / "Kssr.m")
    assert_array_equal(found.matrix.toarray(), FROM_TRIPLETS)
    assert found.notes == ("Kssr.m has only the lower triangle: the upper one is filled in.",)


def test_matlab_text_of_several_matrices_from_one_name(tmp_path):
    """A table that is named again is another one; its name is not that of a matrix."""
    both = np.vstack([TRIPLETS, TRIPLETS[1::2, [1, 0, 2]]])
    text = (
        f"a = [{triplets_text(both)}];\nK = spconvert(a);\na = [{triplets_text(TRIPLETS[:, [1, 0, 2]])}];\n"
        "M = sparse(a(:,1), a(:,2), a(:,3), 4, 4);"
    )
    (tmp_path / "model.m").write_text(text)
    with pytest.raises(ValueError, match=r"variable: must be given, one of K, M$"):
        read_matrix(tmp_path / "model.m")
    whole, upper = (read_labelled(tmp_path / "model.m", name) for name in "KM")
    assert_array_equal(whole.matrix.toarray(), FROM_TRIPLETS)
    assert whole.notes == ()
    assert_array_equal(upper.matrix.toarray(), np.pad(FROM_TRIPLETS, (0, 1)))
    assert upper.notes == ("M of model.m has only the upper triangle: the lower one is filled in.",)


@pytest.mark.parametrize("name", ["k.mat", "k.npy", "k.csv", "k.m"])
def test_an_array_of_triplets(tmp_path, name):
    path = tmp_path / name
    if name == "k.mat":
        savemat(path, {"K": TRIPLETS})
    elif name == "k.npy":
        np.save(path, TRIPLETS)
    else:
        text = triplets_text(TRIPLETS)
        path.write_text(text.replace(" ", ",") if name == "k.csv" else f"K = [{text}];")
    found = read_labelled(path)
    assert_array_equal(found.matrix.toarray(), FROM_TRIPLETS)
    assert found.notes == (f"{name} has only the lower triangle: the upper one is filled in.",)


def test_triplets_from_zero_are_refused(tmp_path):
    (tmp_path / "k.m").write_text("a = [0 0 4.0; 1 0 -1.0; 1 1 5.0];\nK = sparse(a(:,1), a(:,2), a(:,3));")
    with pytest.raises(ValueError, match="K must have rows and columns that are whole numbers from 1"):
        read_matrix(tmp_path / "k.m")
