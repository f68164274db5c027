"""Consistency of a problem file's tables for frequency response functions, damping and tests."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

from fmu.arguments import ArgumentError
from fmu.config.frf.damping import mistakes_of_damping
from fmu.config.frf.errors import FRFFile, FRFTable, read_frfs
from fmu.config.parameters import ParameterTable
from fmu.config.tables import Declared
from fmu.config.tests import OfFRFs, TestTable
from fmu.formats.shown import quote
from fmu.posterior.errors.base import ErrorModel
from fmu.posterior.frf.damping import DampingModel
from fmu.posterior.frf.errors import FRFErrors


class FRFsInFile(NamedTuple):
    """The ``[[error]]`` table for frequency response functions, and the files named in it or in ``[[tests]]``.

    Attributes
    ----------
    number : int
        Index of the table in ``[[error]]``, from 0.
    table : FRFTable
    files : list of FRFFile
    """

    number: int
    table: FRFTable
    files: list[FRFFile]

    @classmethod
    def of(cls, errors: Sequence[Declared], tests: Sequence[TestTable] | None) -> Self | None:
        """Return the first table for frequency response functions and its files, or None if there is no table.

        With several tests, the files are those named in ``[[tests]]``.
        """
        for i, table in enumerate(errors):
            if isinstance(table, FRFTable):
                own = [FRFFile(f"error.{i}.data", table.data)] if table.data is not None else []
                return cls(i, table, own if tests is None else _files_of(tests))
        return None

    def reader(self, folder: Path, damping: Sequence[DampingModel]) -> Any:
        """Return the function to pass as `read_frfs` to `fmu.config.errors.build_error_models`."""
        return partial(read_frfs, files=self.files, folder=folder, damping=damping)

    def by_test(self, errors: Sequence[ErrorModel]) -> OfFRFs:
        """Return the table, and the FRF error model of each test."""
        return OfFRFs(self.table, {str(one.test): one for one in errors if isinstance(one, FRFErrors)})

    def mistakes(self, tests: Sequence[TestTable] | None, has_other_errors: bool) -> list[ArgumentError]:
        """Return the errors found in the keys ``data``, which name the FRF files.

        If `tests` is None, the FRF table must have the key. With several tests, the FRF table must not have the
        key, and each test must have it. If there are other error models too, it is enough that one test has the
        key.
        """
        where = f"error.{self.number}.data"
        if tests is None:
            return [ArgumentError(where, "is missing")] * (self.table.data is None)
        found = []
        if self.table.data is not None:
            rule = "must not be given with [[tests]], each of which has the key data"
            found.append(ArgumentError(where, rule, quote(self.table.data)))
        lacking = [i for i, test in enumerate(tests) if test.data is None]
        if has_other_errors and len(lacking) < len(tests):
            return found
        return found + [
            ArgumentError(f"tests.{i}.data", 'is missing, for the [[error]] of = "frf"') for i in lacking
        ]

    def place(self, mistake: ArgumentError, errors: Sequence[ErrorModel]) -> ArgumentError:
        """Return an error in FRF data under the key that names the FRF file in the problem file.

        The key of `mistake` is ``data…``, or ``error.i.data…`` where i is an index in `errors`. An error
        with another key is returned unchanged.
        """
        first, *others = mistake.key.split(".")
        if "data" not in (first, *others[1:2]):
            return mistake
        test = errors[int(others[0])].test if first == "error" else None  # type: ignore[attr-defined]
        return mistake.at(next(file.where for file in self.files if file.test == test))


def mistakes_of_frfs(
    found: FRFsInFile | None,
    errors: Sequence[Declared],
    damping: Sequence[Declared],
    parameters: Sequence[ParameterTable],
    tests: Sequence[TestTable] | None,
) -> list[ArgumentError]:
    """Return inconsistencies between the tables for FRFs, damping and tests.

    An FRF table requires damping. If there is no FRF table (`found` is None), damping and FRF files must not be
    given.
    """
    if found is None:
        rule = 'is used by frequency response functions only, [[error]] with of = "frf"'
        places = [*(file.where for file in _files_of(tests or [])), *["damping"] * bool(damping)]
        return [ArgumentError(place, rule) for place in places]
    if not damping:
        return [ArgumentError("damping", 'must be given with an [[error]] of = "frf"', "none")]
    own = found.mistakes(tests, len(errors) > 1)
    return own + mistakes_of_damping(parameters, damping, tests is not None)


def _files_of(tests: Sequence[TestTable]) -> list[FRFFile]:
    return [
        FRFFile(f"tests.{i}.data", test.data, test.name, test.window)
        for i, test in enumerate(tests)
        if test.data is not None
    ]
