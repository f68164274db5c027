"""Save comparisons of new tests with a run, one row per test, in ``predictions.csv`` in the run's directory."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from fmu.durable_files import write_durably
from fmu.formats.shown import quote
from fmu.numbers import given

FILE = "predictions.csv"
NAME = "name"
_WAIT_S = 60.0
Row = Mapping[str, str]


class Predictions:
    """Predictions saved with a run. Read and extend them only within an `open_predictions` block.

    Parameters
    ----------
    directory : Path
        The run's directory.
    measured : sequence of str
        Names of the columns for what is known of a test, such as its measured data. The first is ``name``.
    found : sequence of str
        Names of the columns for the prediction results.
    draws : str
        Identifier of the draws that were used, for the last column, ``draws_of``.

    Raises
    ------
    ValueError
        If the file exists but does not have these columns, is malformed, or contains predictions made with other
        draws.
    """

    def __init__(self, directory: Path, measured: Sequence[str], found: Sequence[str], draws: str) -> None:
        self.path, self._measured, self._draws = directory / FILE, tuple(measured), draws
        self._columns = (*measured, *found, "draws_of")
        self.rows: list[Row] = self._read() if self.path.exists() else []

    def find_new(self, tests: Sequence[Row]) -> list[int]:
        """Return the indices of the tests that have no row in the file yet.

        Raises
        ------
        ValueError
            If a test has a row with other data.
        """
        known = {row[NAME]: row for row in self.rows}
        for test in tests:
            before = known.get(test[NAME], test)
            for column in self._measured:
                if before[column] != test[column]:
                    raise ValueError(
                        f"{test[NAME]}: was predicted with another {column} (now {quote(test[column])}, but "
                        f"{quote(before[column])} in {self.path}). If it is another test, give it another name; "
                        "if the numbers were corrected, delete its line there"
                    )
        return [i for i, test in enumerate(tests) if test[NAME] not in known]

    def add(self, rows: Sequence[Row]) -> None:
        """Append rows and write the file. If the process is killed, the file has its old or its new content."""
        self.rows += [{**row, "draws_of": self._draws} for row in rows]
        text = io.StringIO()
        writer = csv.DictWriter(text, self._columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        write_durably(self.path, text.getvalue().encode())

    def _read(self) -> list[Row]:
        advice = f"; move it away (mv {self.path} {self.path}.old), and predict again"
        try:
            header, *lines = csv.reader(io.StringIO(self.path.read_text(encoding="utf-8")), strict=True)
        except (ValueError, csv.Error):
            header, lines = [], []
        wrong = next((number for number, line in enumerate(lines, 2) if len(line) != len(header)), None)
        if tuple(header) != self._columns or wrong is not None:
            at = "its first line" if wrong is None else f"line {wrong}"
            raise ValueError(f"{self.path}: must be as fmu predict wrote it for this run ({at} differs){advice}")
        rows: list[Row] = [dict(zip(header, line, strict=True)) for line in lines]
        others = [row["draws_of"] for row in rows if row["draws_of"] != self._draws]
        if others:
            raise ValueError(
                f"{self.path}: must be of the draws of {self._draws} (got those of {others[0]}){advice}, or name "
                "the sampler (--sampler)"
            )
        return rows


@contextmanager
def open_predictions(
    directory: Path, measured: Sequence[str], found: Sequence[str], draws: str
) -> Iterator[Predictions]:
    """Yield a run's predictions. Within the block, no other process can read or write them.

    Raise ValueError if another process still uses the predictions after a minute, or if `Predictions` raises it.
    """
    try:
        with FileLock(directory / f".{FILE}.lock", timeout=_WAIT_S):
            yield Predictions(directory, measured, found, draws)
    except Timeout:
        raise ValueError(f"{directory}: another fmu predict has run there for {given(_WAIT_S)} s") from None
