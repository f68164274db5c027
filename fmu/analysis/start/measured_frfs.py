"""Compare measured FRFs with the model before updating."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.frf.predictions import frac
from fmu.numbers import MISSING, significant, whole
from fmu.posterior.data.frf_data import FRFData
from fmu.posterior.data.held_out_lines import held_out
from fmu.posterior.frf.term import FRFTerm
from fmu.tables import data_frame
from fmu.types import ComplexArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.problem import UpdatingProblem


@dataclass(frozen=True, eq=False)
class MeasuredFRFs:
    """Measured FRFs of all tests, with the same FRFs computed by the model before updating.

    Attributes
    ----------
    tests : tuple of MeasuredInTest
        One entry for each test with FRFs.
    """

    tests: tuple[MeasuredInTest, ...]

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings about measurements, one sentence each.

        They concern FRFs that may have the wrong kind, polarity or position or errors in common, and standard
        deviations from few averages.
        """
        return tuple(f"{one.of_test}{said}" for one in self.tests for said in one.data.doubts())

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on data that were converted, dropped or assumed, one sentence each."""
        return tuple(f"{one.of_test}{said}" for one in self.tests for said in one.data.notes)

    def table(self) -> pd.DataFrame:
        """Return a text table with one row per FRF: lines used and held out, median relative sd, and FRAC."""
        names = [f"{one.of_test}{label}" for one in self.tests for label in one.data.labels]
        return data_frame([row for one in self.tests for row in one.rows()], "FRF", names)


@dataclass(frozen=True, eq=False)
class MeasuredInTest:
    """One test's measured FRFs, with the same FRFs computed by the model before updating.

    Attributes
    ----------
    of_test : str
        Prefix of the FRF names: the test's name and a colon, or nothing for a single test.
    data : FRFData
    computed : ndarray of complex, shape (n_frfs, n_lines)
        In the units of the data; NaN at lines at which no FRF is used or held out.
    """

    of_test: str
    data: FRFData
    computed: ComplexArray

    @classmethod
    def of(cls, term: FRFTerm, own: FloatArray) -> MeasuredInTest:
        """Return the measured FRFs of a likelihood term, with the FRFs that the model computes.

        `own`, shape (1, n_own), are the values of the term's own parameters (`UpdatingProblem.responses_at`).
        """
        there = term.data.used | held_out(term.data)
        computed = np.full(there.shape, np.nan, dtype=complex)
        computed[:, there.any(axis=0)] = term.with_use(there).frfs(own)[0]
        return cls(term.of_test, term.data, computed)

    def rows(self) -> list[dict[str, str]]:
        """Return the table rows of this test: for each FRF, a dict that maps column names to text."""
        measured, used = np.asarray(self.data.values), self.data.used
        receptance = self.data.as_receptance()
        rows = []
        for i in range(self.data.n_frfs):
            lines = used[i]
            alike = frac(np.where(lines, measured[i], 0.0)[None], np.where(lines, self.computed[i], 0.0)[None])
            error = MISSING
            if receptance.sd is not None and lines.any():
                error = significant(float(np.median((receptance.sd[i] / np.abs(receptance.values[i]))[lines])), 2)
            rows.append(
                {
                    "lines in use": whole(int(lines.sum())),
                    "held out": whole(int(held_out(self.data)[i].sum())),
                    "sd / |H|, median": error,
                    "FRAC at the start": significant(float(alike[0]), 2) if lines.any() else MISSING,
                }
            )
        return rows


def measured_frfs(problem: UpdatingProblem) -> MeasuredFRFs | None:
    """Return a problem's measured FRFs, with the model's FRFs at the starting point, or None if there are none."""
    found = tuple(MeasuredInTest.of(*one) for one in problem.responses_at(problem.start[None]))
    return MeasuredFRFs(found) if found else None
