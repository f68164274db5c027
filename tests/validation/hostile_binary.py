"""Matrices in the files of NumPy, MATLAB and HDF5 that are broken, lie about their size, or are huge."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from tests.validation.hostile_text import HUGE, Writer, of, sparse_file

K = np.diag([2.0, 2.0, 2.0, 2.0, 1.0]) - np.eye(5, k=1) - np.eye(5, k=-1)
K *= 4e6


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


def hdf5_cases() -> dict[str, Writer]:
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


def numpy_cases() -> dict[str, Writer]:
    """Return files of NumPy."""
    eye = np.eye(5)
    return {
        "huge, of holes.npy": sparse_file(HUGE, _npy("(11585, 11585)")),
        "absurd shape.npy": of(_npy("(1099511627776, 1099511627776)", body=bytes(200))),
        "negative shape.npy": of(_npy("(-5, -5)", body=bytes(200))),
        "shape of text.npy": of(_npy("('a', 'b')", body=bytes(200))),
        "shape of none.npy": of(_npy("None", body=bytes(200))),
        "shape of True.npy": of(_npy("(True, True)", body=bytes(8))),
        "shape of many.npy": of(_npy("(" + "1, " * 60 + ")", body=bytes(8))),
        "long header.npy": of(b"\x93NUMPY\x02\x00" + struct.pack("<I", 2**31) + bytes(100)),
        "deep header.npy": of(_npy("(" * 900 + ")" * 900)),
        "unknown version.npy": of(b"\x93NUMPY\x09\x09" + bytes(100)),
        "pickled.npy": of(_npy("(2, 2)", "'|O'", b"cos\nsystem\n(S'true'\ntR.")),
        "text.npy": of(_saved(np.array([["a", "b"], ["c", "d"]]))),
        "dates.npy": of(_saved(np.array([["2024-01-01"]], dtype="M8[D]"))),
        "table.npy": of(_saved(np.zeros((2, 2), dtype=[("a", "f8")]))),
        "items of a gigabyte.npy": of(_npy("(1, 1)", "'|V1073741824'")),
        "cut short.npy": of(_saved(eye)[:-20]),
        "three dimensions.npy": of(_saved(np.ones((2, 2, 2)))),
        "one number.npy": of(_saved(np.float64(3.0))),
        "nothing.npy": of(_saved(np.zeros((0, 0)))),
        "NaN.npy": of(_saved(np.full((5, 5), np.nan))),
        "complex.npy": of(_saved(K + 1j)),
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


def matlab_cases() -> dict[str, Writer]:
    """Return files of MATLAB."""
    zeros = zlib.compress(bytes(2**26))
    return {
        "huge, of holes.mat": sparse_file(HUGE, _mat()),
        "huge, of holes in a matrix.mat": sparse_file(HUGE, _mat(struct.pack("<II", 14, HUGE - 200))),
        "no version.mat": of(b"MATLAB".ljust(200)),
        "version 4.mat": of(struct.pack("<5i", 0, 1, 1, 0, 2) + b"K\x00" + bytes(8)),
        "nothing.mat": of(_mat()),
        "unknown element.mat": of(_mat(_element(99, bytes(16)))),
        "element cut short.mat": of(_mat(struct.pack("<II", 14, 2**31))),
        "many empty elements.mat": of(_mat(bytes(8 * 500_000))),
        "negative dimensions.mat": of(_mat(_array(6, (-5, -5), _values(1.0)))),
        "absurd dimensions.mat": of(_mat(_array(6, (2**31 - 1, 2**31 - 1), _values(1.0)))),
        "three dimensions.mat": of(_mat(_array(6, (1, 1, 1), _values(1.0)))),
        "too few numbers.mat": of(_mat(_array(6, (5, 5), _values(1.0)))),
        "no numbers.mat": of(_mat(_array(6, (5, 5)))),
        "numbers of an unknown type.mat": of(_mat(_array(6, (1, 2), _element(77, bytes(16))))),
        "name that is no text.mat": of(_mat(_array(6, (1, 2), _values(1, 2), name=b"\xff\x00"))),
        "complex.mat": of(_mat(_array(6, (2, 2), _values(1, 0, 0, 1), _values(1, 0, 0, 1), flags=0x800))),
        "cell.mat": of(_mat(_array(1, (2, 2), _values(1.0)))),
        "structure.mat": of(_mat(_array(2, (1, 1), _values(1.0)))),
        "text.mat": of(_mat(_array(4, (1, 2), _element(4, b"a\0b\0")))),
        "empty sparse.mat": of(_mat(_array(5, (5, 5), _ints(), _ints(), _values()))),
        "sparse without parts.mat": of(_mat(_array(5, (5, 5)))),
        "sparse with a negative count.mat": of(_mat(_array(5, (2, 2), _ints(0, 1), _ints(0, 1, -2), _values(1, 1)))),
        "sparse with indices beyond.mat": of(_mat(_array(5, (2, 2), _ints(0, 2**30), _ints(0, 1, 2), _values(1, 1)))),
        "sparse with pointers as numbers.mat": of(_mat(_array(5, (2, 2), _ints(0, 1), _values(0, np.nan, np.inf), _values(1, 1)))),
        "sparse of an absurd size.mat": of(_mat(_array(5, (2**31 - 1, 2**31 - 1), _ints(0), _ints(0, 1), _values(1)))),
        "packed nothing.mat": of(_mat(_element(15, b""))),
        "packed garbage.mat": of(_mat(_element(15, bytes(100)))),
        "packed bomb.mat": of(_mat(_element(15, zeros))),
        "packed matrix that is a bomb.mat": of(
            _mat(_element(15, zlib.compress(_array(6, (11_000, 11_000), _values(1.0))[:64] + bytes(2**27))))
        ),
        "variables of the same name.mat": of(_mat(*[_array(6, (2, 2), _values(1, 0, 0, 1))] * 3)),
        "hundred thousand variables.mat": of(
            _mat(*[_array(6, (1, 2), _values(1, 2), name=f"K{i}".encode()) for i in range(100_000)])
        ),
        "version 7.3 of nothing.mat": of(b"MATLAB 7.3 MAT-file".ljust(512)),
        "version 7.3 by name only.mat": of(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(1000)),
    }  # fmt: skip
