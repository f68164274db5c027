"""Reader for Nastran OUTPUT4 files, ``.op4``, which are text or binary, with full or sparse columns.

Binary files may have either byte order. The format is described in MSC Nastran, *DMAP programmer's guide*,
OUTPUT4. The files do not name their rows: see `fmu.formats.models.bulk`. The DMAP statements are::

    ASSIGN OUTPUT4='model.op4',UNIT=31,FORM=BIG64
    OUTPUT4 KGG,MGG,,,//0/31///16

MYSTRAN writes these files as ``job.OU1`` to ``job.OU7``, with ``OUTPUT4 KGG,MGG,,,//-1/21`` in the executive
control. MYSTRAN orders the rows as the deck defines the nodes, unless PARAM,GRIDSEQ says otherwise.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices.limits import (
    MOST_NAMES,
    Labelled,
    MatrixFormat,
    RefusedError,
    choose_variable,
    entries_within,
    rows_within,
    text_lines,
)
from fmu.types import AnyArray

REAL = (1, 2)
"""Real matrix types in single and double precision; types 3 and 4 are complex."""
LARGEST = 2**34
"""Largest file size, bytes: a matrix of 46 000 rows with full columns."""
LARGEST_RECORD = 2**26
"""Largest column size, bytes."""
SMALL_ROWS = 65535
"""Largest number of rows in a sparse matrix without BIGMAT; with BIGMAT, two integers precede each string."""
_OF_MYSTRAN = tuple(f".ou{unit}" for unit in range(1, 8))


class _Header(NamedTuple):
    """Matrix header: number of rows (negative with BIGMAT), number of columns, type and name."""

    rows: int
    columns: int
    type: int
    name: str

    @property
    def big(self) -> bool:
        return self.rows < 0 or self.rows > SMALL_ROWS


class _Entries:
    def __init__(self, header: _Header) -> None:
        self.header = header
        self.n = 0
        self.strings: list[tuple[int, int, AnyArray]] = []

    def add(self, column: int, row: int, values: AnyArray) -> None:
        """Add consecutive values of a column, starting at `row`; column and row are counted from 1.

        If at most half of the values are nonzero, as in the full columns that MYSTRAN writes, only the runs of
        nonzeros are stored. Raise ValueError if a value is outside the rows of the matrix, and RefusedError if
        there are too many entries.
        """
        header = self.header
        if row < 1 or column < 1 or row - 1 + len(values) > abs(header.rows):
            raise ValueError(f"{header.name} has an entry outside its {abs(header.rows)} rows")
        nonzero = np.flatnonzero(values)
        if 2 * len(nonzero) > len(values):
            self._keep(row - 1, column - 1, values)
            return
        for run in np.split(nonzero, np.flatnonzero(np.diff(nonzero) > 1) + 1) if len(nonzero) else ():
            self._keep(row - 1 + int(run[0]), column - 1, values[run[0] : run[-1] + 1].copy())

    def _keep(self, row: int, column: int, values: AnyArray) -> None:
        self.n += len(values)
        entries_within(self.n)
        self.strings.append((row, column, values))

    def matrix(self) -> sp.csr_array:
        """Return the matrix, and release the collected entries. Raise RefusedError if it has too many rows."""
        header = self.header
        rows_within(max(abs(header.rows), header.columns))
        counts = np.array([len(values) for *_, values in self.strings], dtype=np.int64)
        firsts = np.array([row for row, *_ in self.strings], dtype=np.int64)
        shift = firsts - np.cumsum(counts) + counts  # from the index of a value to its row
        row = np.arange(self.n, dtype=np.int32) + np.repeat(shift.astype(np.int32), counts)
        column = np.repeat(np.array([column for _, column, _ in self.strings], dtype=np.int32), counts)
        values = np.concatenate([values for *_, values in self.strings]) if self.strings else np.zeros(0)
        self.strings.clear()
        return sp.csr_array(
            (values.astype(float, copy=False), (row, column)), shape=(abs(header.rows), header.columns)
        )


def _read(path: Path, variable: str | None) -> Labelled:
    with open(path, "rb") as file:
        start = file.read(4)
        file.seek(0)
        order = {(b"\x18\0\0\0"): "<", b"\x30\0\0\0": "<", b"\0\0\0\x18": ">", b"\0\0\0\x30": ">"}.get(start)
        parts = _of_text(text_lines(file), variable) if order is None else _of_binary(file, order, variable)
        found: dict[str, _Entries | None] = {}
        repeated = set[str]()
        for name, entries in parts:
            if name in found:
                repeated.add(name)
            found[name] = entries
            if len(found) > MOST_NAMES:
                raise RefusedError(f"must hold at most {MOST_NAMES} matrices")
        chosen = choose_variable(list(found), variable)
        if chosen in repeated:
            raise RefusedError(f"must hold one matrix of the name {chosen} (it holds several)")
        entries = found[chosen]
    if entries is None:  # the only matrix: its entries were not read, as no name was given
        return _read(path, next(iter(found)))
    if entries.header.type not in REAL:
        raise RefusedError(f"must hold a real matrix ({entries.header.name} is complex)")
    return Labelled(entries.matrix(), in_input_order=path.suffix.lower() in _OF_MYSTRAN)


def _of_binary(file: BinaryIO, order: str, variable: str | None) -> Iterator[tuple[str, _Entries | None]]:
    """Yield the name and entries of each matrix. The entries are None for every matrix except `variable`.

    Raise ValueError if the file is broken, and RefusedError if a column is too large.
    """
    end = file.seek(0, 2)
    file.seek(0)

    def record(wanted: bool = True, first: int = 0) -> bytes:
        """Return the next record, or only its first `first` bytes if it is not `wanted`.

        Raise ValueError if the record is broken, and RefusedError if it is larger than `LARGEST_RECORD`.
        """
        size = _length(file.read(4))
        if file.tell() + size + 4 > end:
            raise ValueError("it is cut short")
        if size > LARGEST_RECORD:
            raise RefusedError(f"must have columns of at most {LARGEST_RECORD} bytes (got {size})")
        content = file.read(size if wanted else min(first, size))
        file.seek(size - len(content), 1)
        if _length(file.read(4)) != size:
            raise ValueError("its records do not end as they begin")
        return content

    def _length(marker: bytes) -> int:
        if len(marker) < 4:
            raise ValueError("it is cut short")
        return int(np.frombuffer(marker, f"{order}i4")[0]) & 0x7FFFFFFF

    while file.tell() < end:
        head = record()
        if len(head) not in (24, 48):
            raise ValueError(f"a matrix must begin with 24 or 48 bytes (got {len(head)})")
        width = len(head) // 6
        columns, rows, _, kind = np.frombuffer(head[: 4 * width], f"{order}i{width}").tolist()
        header = _Header(rows, columns, kind, head[4 * width :].decode("latin-1").strip().upper())
        _check(header)
        is_wanted = header.name == variable and kind in REAL
        entries = _Entries(header) if header.name == variable else None
        whole = np.dtype(f"{order}i{width}")
        real = np.dtype(f"{order}f{8 if kind == 2 else width}")
        while True:
            content = record(is_wanted, 3 * width)
            if len(content) < 3 * width:
                raise ValueError(f"a column of {header.name} is cut short")
            column, row, words = np.frombuffer(content[: 3 * width], whole).tolist()
            if column > columns:
                break
            if entries is not None and is_wanted:
                data = content[3 * width :]
                if words < 0 or words * width > len(data):
                    raise ValueError(f"column {column} of {header.name} is cut short")
                data = data[: words * width]
                if row:
                    entries.add(
                        column, row, np.frombuffer(data[: len(data) // real.itemsize * real.itemsize], real)
                    )
                else:
                    _strings(entries, column, data, whole, real)
        yield header.name, entries


def _strings(entries: _Entries, column: int, data: bytes, whole: np.dtype, real: np.dtype) -> None:
    """Add the strings (runs of consecutive nonzeros) of a sparse column.

    Raise ValueError if the column is cut short, or a string does not fit in it.
    """
    at = 0
    while at < len(data):
        if entries.header.big:
            if at + 2 * whole.itemsize > len(data):
                raise ValueError(f"column {column} of {entries.header.name} is cut short")
            length, row = np.frombuffer(data, whole, 2, at).tolist()
            length, at = length - 1, at + 2 * whole.itemsize
        else:
            both = int(np.frombuffer(data, whole, 1, at)[0])
            length, row, at = both // 65536 - 1, both % 65536, at + whole.itemsize
        size = length * whole.itemsize
        if length < 1 or at + size > len(data) or size % real.itemsize:
            raise ValueError(f"column {column} of {entries.header.name} has a string of {length} words")
        entries.add(column, row, np.frombuffer(data, real, size // real.itemsize, at))
        at += size


_TITLE = re.compile(r"\s*(\d+)\s*(-?\d+)\s+(\d+)\s+(\d+)\s*([A-Za-z]\w*)\s*(?:1P,)?\s*\d+[ED](\d+)\.\d+")


def _of_text(lines: Iterator[str], variable: str | None) -> Iterator[tuple[str, _Entries | None]]:
    """Yield the name and entries of each matrix. The entries are None for every matrix except `variable`.

    Lines with a decimal point contain values; the other lines give the column and row of the values that follow.
    The word counts on these lines are ignored, because some programs write wrong counts. Raise ValueError if the
    text is broken.
    """
    header, entries, width = None, None, 0
    column = row = 0
    values: list[float] = []

    def flush_values() -> None:
        if entries is not None and values:
            entries.add(column, row, np.array(values))
        values.clear()

    for line in lines:
        if not line.strip():
            continue
        if header is None:
            title = _TITLE.match(line)
            if title is None:
                raise ValueError(
                    "a matrix must begin with columns, rows, form, type, name and format, as OP4 has them"
                )
            columns, rows, _, kind = (int(word) for word in title.groups()[:4])
            header, width = _Header(rows, columns, kind, title[5].upper()), int(title[6])
            _check(header)
            if width < 8:
                raise ValueError(f"its numbers must have 8 characters or more (got {width})")
            entries = _Entries(header) if header.name == variable else None
            column = row = 0
            continue
        if "." in line:
            if column > header.columns:  # the column after the last holds a meaningless value
                yield header.name, entries
                header = None
            elif entries is not None and header.type in REAL:
                values += [float(line[at : at + width].upper().replace("D", "E")) for at in _starts(line, width)]
                if len(values) > abs(header.rows):
                    raise ValueError(f"{header.name} has an entry outside its {abs(header.rows)} rows")
            continue
        flush_values()
        words = [int(word) for word in _whole_numbers(line)]
        if len(words) == 3:
            column, row = words[:2]
        elif len(words) == 2:
            row = words[1]
        elif len(words) == 1:
            row = words[0] % 65536
    if header is not None:
        raise ValueError("it is cut short")


def _starts(line: str, width: int) -> range:
    return range(0, len(line.rstrip()), width)


def _whole_numbers(line: str) -> list[str]:
    """Return the one to three whole numbers on a line, as text. Raise ValueError if it contains anything else."""
    words = line.split()
    if all(re.fullmatch(r"-?\d{1,10}", word) for word in words) and 1 <= len(words) <= 3:
        return words
    raise ValueError(f"a column must begin with its number, first row and number of words (got {line[:40]!r})")


def _check(header: _Header) -> None:
    if not header.rows or header.columns < 1 or not 1 <= header.type <= 4:
        shape = f"{abs(header.rows)} by {header.columns}"
        raise ValueError(
            f"{header.name or 'a matrix'} must have rows, columns and a type from 1 to 4 (got {shape})"
        )


FORMAT = MatrixFormat((".op4", *_OF_MYSTRAN), _read, has_names=True, largest=LARGEST)
