"""Matrix files that are broken, lie about their size, or hold what no model can use."""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import scipy.sparse as sp

from fmu.formats.matrices import write_matrix

K = np.diag([2.0, 2.0, 2.0, 2.0, 1.0]) - np.eye(5, k=1) - np.eye(5, k=-1)
K *= 4e6
HUGE = 2**30
MARKET = "%%MatrixMarket matrix "
BOMB = 2**30

Writer = Callable[[Path], object]


def right(suffix: str, path: Path) -> bytes:
    """Return a file of a kind as it should be."""
    if suffix == ".mtx.gz":
        buffer = io.BytesIO()
        scipy.io.mmwrite(buffer, sp.coo_array(K))
        return gzip.compress(buffer.getvalue(), mtime=0)
    if suffix in (".hb", ".rua"):
        with warnings_off():
            scipy.io.hb_write(path, sp.csc_matrix(K))
    elif suffix == "full.mat":
        scipy.io.savemat(path, {"K": K})
    elif suffix == "packed.mat":
        scipy.io.savemat(path, {"K": sp.csc_array(K)}, do_compression=True)
    elif suffix == "abaqus.mtx":
        rows = [f"{i + 1},1, {j + 1},1, {K[i, j]:.17e}" for i in range(5) for j in range(i + 1) if K[i, j]]
        path.write_text("** STIFFNESS\n*MATRIX, TYPE=STIFFNESS\n" + "\n".join(rows) + "\n")
    else:
        write_matrix(path.with_suffix(suffix), K)
        path = path.with_suffix(suffix)
    return path.read_bytes()


def warnings_off() -> Any:
    """Return a context without warnings of writers."""
    import warnings

    return warnings.catch_warnings(action="ignore")


KINDS = (
    ".mtx",
    ".mtx.gz",
    ".npz",
    ".npy",
    ".mat",
    "full.mat",
    "packed.mat",
    ".h5",
    ".hb",
    ".rua",
    ".csv",
    "abaqus.mtx",
)
"""All of them are changed at random, too."""


def _of(content: bytes | str) -> Writer:
    return lambda path: path.write_bytes(content.encode() if isinstance(content, str) else content)


def _sparse_file(size: int, head: bytes = b"", at: int = 0, tail: bytes = b"") -> Writer:
    """Return what writes a file of holes."""

    def write(path: Path) -> None:
        with path.open("wb") as file:
            file.write(head)
            file.truncate(size)
            if tail:
                file.seek(at or size)
                file.write(tail)

    return write


def _packed(line: bytes, size: int = BOMB, head: bytes = b"") -> Writer:
    """Return what writes a line over and over into a compressed file."""

    def write(path: Path) -> None:
        block = line * max(2**20 // len(line), 1)
        with gzip.open(path, "wb", compresslevel=1) as file:
            file.write(head)
            for _ in range(size // len(block)):
                file.write(block)

    return write


def _npy(shape: str, descr: str = "'<f8'", body: bytes = b"", fortran: bool = False) -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + body


def _saved(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _zip(members: dict[str, bytes], kind: int = zipfile.ZIP_DEFLATED) -> Writer:
    def write(path: Path) -> None:
        with zipfile.ZipFile(path, "w", kind) as archive:
            for name, content in members.items():
                archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content, compress_type=kind)

    return write


def _csr(**changed: Any) -> Writer:
    """Return what writes a sparse matrix of SciPy with parts that are not right."""
    matrix = sp.csr_array(K)
    parts = {"format": np.array(b"csr"), "shape": np.array([5, 5]), "data": matrix.data}
    parts |= {"indices": matrix.indices, "indptr": matrix.indptr, "_is_array": np.array(True)} | changed
    return _zip({name: _saved(part) for name, part in parts.items() if part is not None})


def _bombed(path: Path) -> None:
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("K.npy", "w", force_zip64=True) as member,
    ):
        member.write(_npy("(11585, 11585)"))
        for _ in range(1024):
            member.write(bytes(2**20))


def _element(kind: int, body: bytes) -> bytes:
    return struct.pack("<II", kind, len(body)) + body + bytes(-len(body) % 8)


def _mat(*elements: bytes) -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"".join(elements)


def _array(
    cls: int, shape: tuple[int, ...], *parts: bytes, name: bytes = b"K", flags: int = 0, limit: int = 0
) -> bytes:
    body = _element(6, struct.pack("<II", cls | flags, limit)) + _element(
        5, struct.pack(f"<{len(shape)}i", *shape)
    )
    return _element(14, body + _element(1, name) + b"".join(parts))


def _values(*numbers: float) -> bytes:
    return _element(9, struct.pack(f"<{len(numbers)}d", *numbers))


def _ints(*numbers: int) -> bytes:
    return _element(5, struct.pack(f"<{len(numbers)}i", *numbers))


def _hdf5(fill: Callable[[Any], object]) -> Writer:
    def write(path: Path) -> None:
        import h5py

        with h5py.File(path, "w") as file:
            fill(file)

    return write


def _group(**parts: Any) -> Callable[[Any], object]:
    """Return what makes a sparse group with parts that are not right."""
    matrix = sp.csr_array(K)
    given = {"data": matrix.data, "indices": matrix.indices, "indptr": matrix.indptr, "shape": [5, 5]} | parts

    def fill(file: Any) -> None:
        group = file.create_group("K")
        for name, part in given.items():
            if part is not None:
                group[name] = part

    return fill


def _linked(make: Callable[[Any], Any]) -> Callable[[Any], object]:
    def fill(file: Any) -> None:
        file["K"] = make(file)

    return fill


def _hdf5_cases() -> dict[str, Writer]:
    import h5py

    def external(file: Any) -> None:
        file.create_dataset("K", (5, 5), "f8", external=[("/dev/zero", 0, 200)])

    def virtual(file: Any) -> None:
        layout = h5py.VirtualLayout((5, 5), "f8")
        layout[:] = h5py.VirtualSource("elsewhere.h5", "K", (5, 5))
        file.create_virtual_dataset("K", layout)

    def recursive(file: Any) -> None:
        file.create_group("a")["b"] = file["/"]
        file["a"]["c"] = file["a"]

    def groups(file: Any) -> None:
        for i in range(20_000):
            file.create_group(f"g{i}")

    def deep(file: Any) -> None:
        group = file
        for _ in range(2000):
            group = group.create_group("g")
        group["K"] = K

    def chunk(file: Any) -> None:
        file.create_dataset("K", (5, 5), "f8", chunks=(20_000, 20_000), maxshape=(None, None))

    def packed(file: Any) -> None:
        file.create_dataset("K", (11_000, 11_000), "f8", compression="gzip", chunks=(1000, 1000))

    def marked(n: Any) -> Callable[[Any], object]:
        def fill(file: Any) -> None:
            group = file.create_group("K")
            group.attrs["MATLAB_sparse"] = n
            group["data"], group["ir"], group["jc"] = [1.0], [0], [0, 1]

        return fill

    fills: dict[str, Callable[[Any], object]] = {
        "of an absurd shape": lambda f: f.create_dataset("K", (2**40, 2**40), "f8", chunks=(10, 10)),
        "of a gigabyte of nothing": packed,
        "in another file": external,
        "made of other files": virtual,
        "whose groups contain themselves": recursive,
        "with twenty thousand groups": groups,
        "nested 2000 deep": deep,
        "with a chunk of gigabytes": chunk,
        "with an external link": _linked(lambda f: h5py.ExternalLink("/dev/zero", "K")),
        "with a link to itself": _linked(lambda f: h5py.SoftLink("/K")),
        "with a link to nowhere": _linked(lambda f: h5py.SoftLink("/nowhere")),
        "of text": _linked(lambda f: np.array([[b"a", b"b"], [b"c", b"d"]])),
        "of a table": _linked(lambda f: np.zeros((5, 5), dtype=[("a", "f8"), ("b", "i4")])),
        "of complex numbers": _linked(lambda f: K.astype(complex)),
        "of NaN": _linked(lambda f: np.full((5, 5), np.nan)),
        "of one number": _linked(lambda f: 3.0),
        "without anything": lambda f: None,
        "whose parts are groups": lambda f: [f.create_group(f"K/{n}") for n in ("data", "indices", "indptr")],
        "whose parts are links": lambda f: [
            f.create_group("K").__setitem__(n, h5py.ExternalLink("/dev/zero", "K")) if n == "data" else f["K"].create_dataset(n, data=[1])
            for n in ("data", "indices", "indptr")
        ],
        "with negative indices": _group(indices=-np.arange(13)),
        "with indices beyond": _group(indices=np.arange(13) + 2**40),
        "with pointers that decrease": _group(indptr=[0, 13, 2, 1, 0, 13]),
        "with pointers as text": _group(indptr=["a"] * 6),
        "with a shape as text": _group(shape="5 by 5"),
        "with a negative shape": _group(shape=[-5, 5]),
        "with an absurd size": _group(shape=[2**62, 2**62]),
        "with data in two dimensions": _group(data=np.ones((13, 2))),
        "with data as text": _group(data=["x"] * 13),
        "of MATLAB with a negative size": marked(-1),
        "of MATLAB with an absurd size": marked(2**62),
        "of MATLAB with a text for its size": marked("five"),
        "of MATLAB with many sizes": marked([5, 5, 5]),
    }  # fmt: skip
    return {f"{name}.h5": _hdf5(fill) for name, fill in fills.items()}


def _text_cases() -> dict[str, Writer]:
    head = MARKET + "coordinate real general\n"
    return {
        "negative size.mtx": _of(head + "-5 -5 -1\n"),
        "absurd size.mtx": _of(head + "99999999999999999999 99999999999999999999 1\n1 1 1.0\n"),
        "size of 5000 digits.mtx": _of(head + "9" * 5000 + " 5 1\n1 1 1.0\n"),
        "absurd number of entries.mtx": _of(head + "5 5 999999999999\n1 1 1.0\n"),
        "too many entries.mtx": _of(head + "5 5 1\n" + "1 1 1.0\n" * 100_000),
        "no size.mtx": _of(head),
        "no entries.mtx": _of(head + "5 5 0\n"),
        "nothing.mtx": _of(head + "0 0 0\n"),
        "half a banner.mtx": _of(MARKET + "coordinate\n5 5 1\n1 1 1.0\n"),
        "complex.mtx": _of(MARKET + "coordinate complex general\n1 1 1\n1 1 1.0 2.0\n"),
        "pattern.mtx": _of(MARKET + "coordinate pattern general\n1 1 1\n1 1\n"),
        "hermitian.mtx": _of(MARKET + "coordinate real hermitian\n1 1 1\n1 1 1.0\n"),
        "row zero.mtx": _of(head + "5 5 1\n0 0 1.0\n"),
        "row beyond.mtx": _of(head + "5 5 1\n6 6 1.0\n"),
        "absurd row.mtx": _of(head + "5 5 1\n1e300 1e300 1.0\n"),
        "row that is NaN.mtx": _of(head + "5 5 1\nnan nan 1.0\n"),
        "broken row.mtx": _of(head + "5 5 1\n1.5 1.5 1.0\n"),
        "NaN.mtx": _of(head + "5 5 2\n1 1 nan\n2 2 inf\n"),
        "words.mtx": _of(head + "5 5 1\none one one\n"),
        "long line.mtx": _of(head + "5 5 1\n" + "1 " * 5_000_000),
        "long word.mtx": _of(head + "5 5 1\n1 1 " + "1" * 10_000_000),
        "long banner.mtx": _of(MARKET + "x" * 10_000_000),
        "many comments.mtx": _of(head + "%\n" * 3_000_000 + "1 1 1\n1 1 1.0\n"),
        "many blank lines.mtx": _of(head + "5 5 1\n" + "\n" * 10_000_000),
        "array with too little.mtx": _of(MARKET + "array real general\n5 5\n1.0\n"),
        "array of an absurd size.mtx": _of(MARKET + "array real symmetric\n1000000 1000000\n1.0\n"),
        "symmetric array of no square.mtx": _of(MARKET + "array real symmetric\n2 3\n" + "1.0\n" * 6),
        "many blocks that nothing joins.mtx": _of(
            head + "300000 300000 300000\n" + "".join(f"{i} {i} 1.0\n" for i in range(1, 300_001))
        ),
        "four columns.abaqus.mtx": _of("1 1 1 1.0\n"),
        "node that is broken.abaqus.mtx": _of("1.5,1,1,1,1.0\n"),
        "direction 9.abaqus.mtx": _of("1,9,1,9,1.0\n"),
        "absurd node.abaqus.mtx": _of("1e300,1,1,1,1.0\n"),
        "absurd row of three.abaqus.mtx": _of("999999999999 1 1.0\n"),
        "stars.abaqus.mtx": _of("*\n" * 1_000_000),
        "binary.mtx": _of(bytes(range(256)) * 1000),
        "not compressed.mtx.gz": _of(head + "1 1 1\n1 1 1.0\n"),
        "cut short.mtx.gz": _of(gzip.compress((head + "5 5 1\n1 1 1.0\n").encode(), mtime=0)[:-9]),
        "rows of different length.csv": _of("1,2\n3\n"),
        "one column.csv": _of("1\n" * 200_000),
        "one row.csv": _of(",".join(["1"] * 500_000)),
        "words.csv": _of("a,b\nc,d\n"),
        "NaN.csv": _of("nan,nan\nnan,nan\n"),
        "quoted.csv": _of('"1","2"\n"2","1"\n'),
        "empty.csv": _of(""),
        "blank lines.csv": _of("\n" * 10_000_000),
        "comments.csv": _of("# \n" * 3_000_000),
        "UTF-16.csv": _of("1,0\n0,1\n".encode("utf-16")),
        "NUL.csv": _of(bytes(1000)),
        "cell of a megabyte.csv": _of("1" * 2**20 + ",1\n1,1\n"),
        "huge, of holes.mtx": _sparse_file(HUGE),
        "huge, of holes after a right header.mtx": _sparse_file(HUGE, (head + "5 5 1\n1 1 1.0\n").encode()),
        "huge, of holes after a header of many entries.mtx": _sparse_file(HUGE, (head + "9999 9999 9999999\n1 1 1.0\n").encode()),
        "huge, of holes.csv": _sparse_file(HUGE),
        "huge, of holes after a row.csv": _sparse_file(HUGE, b"1,0\n"),
        "huge, of holes after a star.abaqus.mtx": _sparse_file(HUGE, b"*MATRIX\n1,1,1,1,1.0\n"),
        "huge, of holes.npy": _sparse_file(HUGE, _npy("(11585, 11585)")),
        "huge, of holes.npz": _sparse_file(HUGE, b"PK\x03\x04"),
        "huge, of holes.mat": _sparse_file(HUGE, _mat()),
        "huge, of holes in a matrix.mat": _sparse_file(HUGE, _mat(struct.pack("<II", 14, HUGE - 200))),
        "huge, of holes.h5": _sparse_file(HUGE, b"\x89HDF\r\n\x1a\n"),
        "huge, of holes.hb": _sparse_file(HUGE),
        "huge, with a beam of numbers.csv": _packed_plain(b"1,0\n", 200 * 2**20),
        "huge, with lines of numbers.mtx": _packed_plain(b"1 1 1.0\n", 200 * 2**20, (head + "5 5 9\n").encode()),
        "huge, packed holes.mtx.gz": _packed(bytes(2**16)),
        "huge, packed blank lines.mtx.gz": _packed(b"\n", head=(head + "5 5 9\n").encode()),
        "huge, packed entries.mtx.gz": _packed(b"1 1 1.0\n", head=(head + "5 5 9\n").encode()),
        "huge, packed stars.mtx.gz": _packed(b"*\n"),
    }  # fmt: skip


def _packed_plain(line: bytes, size: int, head: bytes = b"") -> Writer:
    def write(path: Path) -> None:
        block = line * (2**20 // len(line))
        with path.open("wb") as file:
            file.write(head)
            for _ in range(size // len(block)):
                file.write(block)

    return write


def _numpy_cases() -> dict[str, Writer]:
    eye = np.eye(5)
    return {
        "absurd shape.npy": _of(_npy("(1099511627776, 1099511627776)", body=bytes(200))),
        "negative shape.npy": _of(_npy("(-5, -5)", body=bytes(200))),
        "shape of text.npy": _of(_npy("('a', 'b')", body=bytes(200))),
        "shape of none.npy": _of(_npy("None", body=bytes(200))),
        "shape of True.npy": _of(_npy("(True, True)", body=bytes(8))),
        "shape of many.npy": _of(_npy("(" + "1, " * 60 + ")", body=bytes(8))),
        "long header.npy": _of(b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**31) + bytes(100)),
        "deep header.npy": _of(_npy("(" * 900 + ")" * 900)),
        "unknown version.npy": _of(b"\x93NUMPY\x09\x09" + bytes(100)),
        "pickled.npy": _of(_npy("(2, 2)", "'|O'", b"cos\nsystem\n(S'true'\ntR.")),
        "text.npy": _of(_saved(np.array([["a", "b"], ["c", "d"]]))),
        "dates.npy": _of(_saved(np.array([["2024-01-01"]], dtype="M8[D]"))),
        "table.npy": _of(_saved(np.zeros((2, 2), dtype=[("a", "f8")]))),
        "items of a gigabyte.npy": _of(_npy("(1, 1)", "'|V1073741824'")),
        "cut short.npy": _of(_saved(eye)[:-20]),
        "three dimensions.npy": _of(_saved(np.ones((2, 2, 2)))),
        "one number.npy": _of(_saved(np.float64(3.0))),
        "nothing.npy": _of(_saved(np.zeros((0, 0)))),
        "NaN.npy": _of(_saved(np.full((5, 5), np.nan))),
        "complex.npy": _of(_saved(K + 1j)),
        "bomb.npz": _bombed,
        "absurd shape.npz": _zip({"K": _npy("(1099511627776, 1099511627776)")}),
        "pickled.npz": _zip({"K": _npy("(2, 2)", "'|O'", b"cos\nsystem\n(S'true'\ntR.")}),
        "cut short.npz": _zip({"K": _saved(eye)[:-20]}),
        "no array.npz": _zip({"K": b"hello"}),
        "twenty thousand arrays.npz": _zip({f"K{i}": b"" for i in range(20_000)}),
        "names with control characters.npz": _zip({"a\x1b[31m": _saved(eye), "b\n": _saved(eye)}),
        "names of a megabyte.npz": _zip({"n" * 60_000: _saved(eye), "m" * 60_000: _saved(eye)}),
        "unknown format.npz": _csr(format=np.array(b"xyz")),
        "format as number.npz": _csr(format=np.array(3)),
        "format as array.npz": _csr(format=np.array([b"csr", b"csc"])),
        "no shape.npz": _csr(shape=None),
        "no data.npz": _csr(data=None),
        "negative shape of parts.npz": _csr(shape=np.array([-5, 5])),
        "absurd shape of parts.npz": _csr(shape=np.array([2**62, 2**62])),
        "shape of NaN.npz": _csr(shape=np.array([np.nan, 5.0])),
        "negative indices.npz": _csr(indices=-np.arange(13)),
        "absurd indices.npz": _csr(indices=np.arange(13) + 2**40),
        "pointers that decrease.npz": _csr(indptr=np.array([0, 13, 2, 1, 0, 13])),
        "pointers that overflow.npz": _csr(indptr=np.array([0, 2**63 - 1, -(2**63), 1, 2, 13])),
        "text for data.npz": _csr(data=np.array(["x"] * 13)),
        "two dimensions of data.npz": _csr(data=np.ones((13, 2))),
        "a million rows of nothing.npz": lambda path: sp.save_npz(path, sp.csr_array((2**20, 2**20))),
    }  # fmt: skip


def _matlab_cases() -> dict[str, Writer]:
    zeros = zlib.compress(bytes(2**26))
    return {
        "no version.mat": _of(b"MATLAB".ljust(200)),
        "version 4.mat": _of(struct.pack("<5i", 0, 1, 1, 0, 2) + b"K\x00" + bytes(8)),
        "nothing.mat": _of(_mat()),
        "unknown element.mat": _of(_mat(_element(99, bytes(16)))),
        "element cut short.mat": _of(_mat(struct.pack("<II", 14, 2**31))),
        "many empty elements.mat": _of(_mat(bytes(8 * 500_000))),
        "negative dimensions.mat": _of(_mat(_array(6, (-5, -5), _values(1.0)))),
        "absurd dimensions.mat": _of(_mat(_array(6, (2**31 - 1, 2**31 - 1), _values(1.0)))),
        "three dimensions.mat": _of(_mat(_array(6, (1, 1, 1), _values(1.0)))),
        "too few numbers.mat": _of(_mat(_array(6, (5, 5), _values(1.0)))),
        "no numbers.mat": _of(_mat(_array(6, (5, 5)))),
        "numbers of an unknown type.mat": _of(_mat(_array(6, (1, 2), _element(77, bytes(16))))),
        "name that is no text.mat": _of(_mat(_array(6, (1, 2), _values(1, 2), name=b"\xff\x00"))),
        "complex.mat": _of(_mat(_array(6, (2, 2), _values(1, 0, 0, 1), _values(1, 0, 0, 1), flags=0x800))),
        "cell.mat": _of(_mat(_array(1, (2, 2), _values(1.0)))),
        "structure.mat": _of(_mat(_array(2, (1, 1), _values(1.0)))),
        "text.mat": _of(_mat(_array(4, (1, 2), _element(4, b"a\0b\0")))),
        "empty sparse.mat": _of(_mat(_array(5, (5, 5), _ints(), _ints(), _values()))),
        "sparse without parts.mat": _of(_mat(_array(5, (5, 5)))),
        "sparse with a negative count.mat": _of(_mat(_array(5, (2, 2), _ints(0, 1), _ints(0, 1, -2), _values(1, 1)))),
        "sparse with indices beyond.mat": _of(_mat(_array(5, (2, 2), _ints(0, 2**30), _ints(0, 1, 2), _values(1, 1)))),
        "sparse with pointers as numbers.mat": _of(_mat(_array(5, (2, 2), _ints(0, 1), _values(0, np.nan, np.inf), _values(1, 1)))),
        "sparse of an absurd size.mat": _of(_mat(_array(5, (2**31 - 1, 2**31 - 1), _ints(0), _ints(0, 1), _values(1)))),
        "packed nothing.mat": _of(_mat(_element(15, b""))),
        "packed garbage.mat": _of(_mat(_element(15, bytes(100)))),
        "packed bomb.mat": _of(_mat(_element(15, zeros))),
        "packed matrix that is a bomb.mat": _of(
            _mat(_element(15, zlib.compress(_array(6, (11_000, 11_000), _values(1.0))[:64] + bytes(2**27))))
        ),
        "variables of the same name.mat": _of(_mat(*[_array(6, (2, 2), _values(1, 0, 0, 1))] * 3)),
        "hundred thousand variables.mat": _of(
            _mat(*[_array(6, (1, 2), _values(1, 2), name=f"K{i}".encode()) for i in range(100_000)])
        ),
        "version 7.3 of nothing.mat": _of(b"MATLAB 7.3 MAT-file".ljust(512)),
        "version 7.3 by name only.mat": _of(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(1000)),
    }  # fmt: skip


def _boeing_cases() -> dict[str, Writer]:
    def boeing(
        counts: str = "3 1 1 1",
        sizes: str = "2 2 2 0",
        kind: str = "RUA",
        formats: str = "(3I8) (2I8) (2E20.8)",
        body: str = "",
    ) -> Writer:
        total, *each = counts.split()
        second = f"{total:>14}" + "".join(f"{count:>14}" for count in each)
        third = f"{kind:14}" + "".join(f"{size:>14}" for size in sizes.split())
        fourth = "".join(f"{text:16}" for text in formats.split())
        body = body or "       1       2       3\n       1       2\n      1.0                 1.0\n"
        return _of(f"{'title':72}{'key':8}\n{second}\n{third}\n{fourth}\n{body}")

    return {
        "as it should be.hb": boeing(),
        "empty.hb": _of(""),
        "negative counts.hb": boeing("-3 -1 -1 -1"),
        "absurd counts.hb": boeing("3 99999999999 1 1"),
        "negative sizes.hb": boeing(sizes="-2 -2 -2 0"),
        "absurd sizes.hb": boeing(sizes="99999999999 99999999999 99999999999 0"),
        "absurd entries.hb": boeing(sizes="2 2 9999999999 0"),
        "complex.hb": boeing(kind="CUA"),
        "of elements.hb": boeing(kind="RUE"),
        "format without width.hb": boeing(formats="(I) (I) (E)"),
        "format of no width.hb": boeing(formats="(3I0) (2I0) (2E0)"),
        "format of 5000 digits.hb": boeing(formats=f"(I{'9' * 14}) (2I8) (2E20.8)"),
        "words.hb": boeing(body="one two three\n1 2\n1.0 1.0\n"),
        "NaN.hb": boeing(body="1 nan 3\n1 2\n1.0 1.0\n"),
        "pointers beyond.hb": boeing(body="1 2 99\n1 2\n1.0 1.0\n"),
        "symmetric without values.hb": boeing(kind="RSA", body="\n\n\n"),
        "long line.hb": boeing(body="1 " * 5_000_000),
    }  # fmt: skip


def crafted() -> dict[str, Writer]:
    """Return what writes each file that was made by hand; its name ends as the file's does."""
    return _text_cases() | _numpy_cases() | _matlab_cases() | _hdf5_cases() | _boeing_cases()
