"""Matrices in text that are broken, lie about their size, or are huge."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

HUGE = 2**30
MARKET = "%%MatrixMarket matrix "

USER = """\
** ELEMENT NUMBER 1 STEP NUMBER 1 INCREMENT NUMBER 1
*USER ELEMENT, NODES= 2, LINEAR
** ELEMENT NODES
** 4, 9
1, 2
*MATRIX,TYPE=STIFFNESS
3.0
1.0, 4.0
0.0, 1.0, 5.0
0.0, 0.0, 1.0, 6.0
"""

Writer = Callable[[Path], object]


def of(content: bytes | str) -> Writer:
    return lambda path: path.write_bytes(content.encode() if isinstance(content, str) else content)


def sparse_file(size: int, head: bytes = b"", at: int = 0, tail: bytes = b"") -> Writer:
    """Return what writes a file of holes."""

    def write(path: Path) -> None:
        with path.open("wb") as file:
            file.write(head)
            file.truncate(size)
            if tail:
                file.seek(at or size)
                file.write(tail)

    return write


def _packed(line: bytes, size: int = HUGE, head: bytes = b"") -> Writer:
    """Return what writes a line over and over into a compressed file."""

    def write(path: Path) -> None:
        block = line * max(2**20 // len(line), 1)
        with gzip.open(path, "wb", compresslevel=1) as file:
            file.write(head)
            for _ in range(size // len(block)):
                file.write(block)

    return write


def _packed_plain(line: bytes, size: int, head: bytes = b"") -> Writer:
    def write(path: Path) -> None:
        block = line * (2**20 // len(line))
        with path.open("wb") as file:
            file.write(head)
            for _ in range(size // len(block)):
                file.write(block)

    return write


def text_cases() -> dict[str, Writer]:
    """Return files of numbers in text, and what of other kinds is nothing but holes."""
    head = MARKET + "coordinate real general\n"
    return {
        "negative size.mtx": of(head + "-5 -5 -1\n"),
        "absurd size.mtx": of(head + "99999999999999999999 99999999999999999999 1\n1 1 1.0\n"),
        "size of 5000 digits.mtx": of(head + "9" * 5000 + " 5 1\n1 1 1.0\n"),
        "absurd number of entries.mtx": of(head + "5 5 999999999999\n1 1 1.0\n"),
        "too many entries.mtx": of(head + "5 5 1\n" + "1 1 1.0\n" * 100_000),
        "no size.mtx": of(head),
        "no entries.mtx": of(head + "5 5 0\n"),
        "nothing.mtx": of(head + "0 0 0\n"),
        "half a banner.mtx": of(MARKET + "coordinate\n5 5 1\n1 1 1.0\n"),
        "complex.mtx": of(MARKET + "coordinate complex general\n1 1 1\n1 1 1.0 2.0\n"),
        "pattern.mtx": of(MARKET + "coordinate pattern general\n1 1 1\n1 1\n"),
        "hermitian.mtx": of(MARKET + "coordinate real hermitian\n1 1 1\n1 1 1.0\n"),
        "row zero.mtx": of(head + "5 5 1\n0 0 1.0\n"),
        "row beyond.mtx": of(head + "5 5 1\n6 6 1.0\n"),
        "absurd row.mtx": of(head + "5 5 1\n1e300 1e300 1.0\n"),
        "row that is NaN.mtx": of(head + "5 5 1\nnan nan 1.0\n"),
        "broken row.mtx": of(head + "5 5 1\n1.5 1.5 1.0\n"),
        "NaN.mtx": of(head + "5 5 2\n1 1 nan\n2 2 inf\n"),
        "words.mtx": of(head + "5 5 1\none one one\n"),
        "long line.mtx": of(head + "5 5 1\n" + "1 " * 5_000_000),
        "long word.mtx": of(head + "5 5 1\n1 1 " + "1" * 10_000_000),
        "long banner.mtx": of(MARKET + "x" * 10_000_000),
        "many comments.mtx": of(head + "%\n" * 3_000_000 + "1 1 1\n1 1 1.0\n"),
        "many blank lines.mtx": of(head + "5 5 1\n" + "\n" * 10_000_000),
        "array with too little.mtx": of(MARKET + "array real general\n5 5\n1.0\n"),
        "array of an absurd size.mtx": of(MARKET + "array real symmetric\n1000000 1000000\n1.0\n"),
        "symmetric array of no square.mtx": of(MARKET + "array real symmetric\n2 3\n" + "1.0\n" * 6),
        "many blocks that nothing joins.mtx": of(
            head + "300000 300000 300000\n" + "".join(f"{i} {i} 1.0\n" for i in range(1, 300_001))
        ),
        "four columns.abaqus.mtx": of("1 1 1 1.0\n"),
        "node that is broken.abaqus.mtx": of("1.5,1,1,1,1.0\n"),
        "direction 9.abaqus.mtx": of("1,9,1,9,1.0\n"),
        "absurd node.abaqus.mtx": of("1e300,1,1,1,1.0\n"),
        "absurd row of three.abaqus.mtx": of("999999999999 1 1.0\n"),
        "stars.abaqus.mtx": of("*\n" * 1_000_000),
        "elements without nodes.abaqus.mtx": of(USER.replace("** 4, 9\n", "")),
        "elements of an absurd number of nodes.abaqus.mtx": of(USER.replace("NODES= 2", "NODES= 999999999999")),
        "elements of direction 9.abaqus.mtx": of(USER.replace("\n1, 2\n", "\n1, 9\n")),
        "elements cut short.abaqus.mtx": of(USER[:-12]),
        "elements of words.abaqus.mtx": of(USER.replace("3.0", "three")),
        "elements that are NaN.abaqus.mtx": of(USER.replace("3.0", "nan")),
        "elements twice.abaqus.mtx": of(USER * 2),
        "elements of many entries.abaqus.mtx": of(USER + "1.0, 1.0, 1.0, 1.0\n" * 500_000),
        "many elements.abaqus.mtx": of("".join(USER.replace("NUMBER 1 ", f"NUMBER {k} ").replace("4, 9", f"{k}, {k + 1}") for k in range(1, 60_000))),
        "elements without a type.abaqus.mtx": of(USER.replace(",TYPE=STIFFNESS", "")),
        "binary.mtx": of(bytes(range(256)) * 1000),
        "not compressed.mtx.gz": of(head + "1 1 1\n1 1 1.0\n"),
        "cut short.mtx.gz": of(gzip.compress((head + "5 5 1\n1 1 1.0\n").encode(), mtime=0)[:-9]),
        "rows of different length.csv": of("1,2\n3\n"),
        "one column.csv": of("1\n" * 200_000),
        "one row.csv": of(",".join(["1"] * 500_000)),
        "words.csv": of("a,b\nc,d\n"),
        "NaN.csv": of("nan,nan\nnan,nan\n"),
        "quoted.csv": of('"1","2"\n"2","1"\n'),
        "empty.csv": of(""),
        "blank lines.csv": of("\n" * 10_000_000),
        "comments.csv": of("# \n" * 3_000_000),
        "UTF-16.csv": of("1,0\n0,1\n".encode("utf-16")),
        "NUL.csv": of(bytes(1000)),
        "cell of a megabyte.csv": of("1" * 2**20 + ",1\n1,1\n"),
        "huge, of holes.mtx": sparse_file(HUGE),
        "huge, of holes after a right header.mtx": sparse_file(HUGE, (head + "5 5 1\n1 1 1.0\n").encode()),
        "huge, of holes after a header of many entries.mtx": sparse_file(HUGE, (head + "9999 9999 9999999\n1 1 1.0\n").encode()),
        "huge, of holes.csv": sparse_file(HUGE),
        "huge, of holes after a row.csv": sparse_file(HUGE, b"1,0\n"),
        "huge, of holes after a star.abaqus.mtx": sparse_file(HUGE, b"*MATRIX\n1,1,1,1,1.0\n"),
        "huge, of holes.npz": sparse_file(HUGE, b"PK\x03\x04"),
        "huge, of holes.h5": sparse_file(HUGE, b"\x89HDF\r\n\x1a\n"),
        "huge, of holes.hb": sparse_file(HUGE),
        "huge, with a beam of numbers.csv": _packed_plain(b"1,0\n", 200 * 2**20),
        "huge, with lines of numbers.mtx": _packed_plain(b"1 1 1.0\n", 200 * 2**20, (head + "5 5 9\n").encode()),
        "huge, packed holes.mtx.gz": _packed(bytes(2**16)),
        "huge, packed blank lines.mtx.gz": _packed(b"\n", head=(head + "5 5 9\n").encode()),
        "huge, packed entries.mtx.gz": _packed(b"1 1 1.0\n", head=(head + "5 5 9\n").encode()),
        "huge, packed stars.mtx.gz": _packed(b"*\n"),
    }  # fmt: skip


def boeing_cases() -> dict[str, Writer]:
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
        return of(f"{'title':72}{'key':8}\n{second}\n{third}\n{fourth}\n{body}")

    return {
        "as it should be.hb": boeing(),
        "empty.hb": of(""),
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
