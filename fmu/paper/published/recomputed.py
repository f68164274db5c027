"""The forty published frequencies, computed again from the published parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from fmu.numbers import fixed, given, share
from fmu.paper.pages.run_sections import rows_of
from fmu.paper.published.tables import EXPERIMENTS
from fmu.report.markdown import table as markdown_table

if TYPE_CHECKING:
    import pandas as pd

    from fmu.posterior.problem import UpdatingProblem

TOLERANCE = 1e-3
"""Relative, beyond the rounding of the printed frequency: the parameters were rounded too."""


def recompute(problems: Mapping[str, UpdatingProblem]) -> pd.DataFrame:
    """Compare the frequencies of Tables 2 and 4 with the model at the parameters of Tables 1 and 3.

    Parameters
    ----------
    problems : mapping of str to UpdatingProblem
        Every experiment's problem, paired by number, by case.

    Returns
    -------
    DataFrame
        One row a frequency: ``table``, ``column``, ``mode``; ``printed_hz``, and ``meant_hz`` where another cell
        shows that a misprint stands there; ``model_hz``; ``difference_hz`` and ``tolerance_hz``, of the model from
        what was meant; ``within``; ``remark``.
    """
    import pandas as pd

    rows = []
    for case, experiment in EXPERIMENTS.items():
        for column in experiment.columns.values():
            model_hz = problems[case].frequencies(column.theta)
            for i, label in enumerate(problems[case].data.labels):
                difference = float(model_hz[i] - column.meant_hz[i])
                tolerance = float(column.half_unit_hz[i] + TOLERANCE * column.meant_hz[i])
                remarks = []
                if i in column.corrected_frequencies:
                    remarks.append(
                        f"misprint: its error column, {column.errors[i]} %, means {given(column.meant_hz[i])}"
                    )
                if column.corrected_parameters:
                    remarks.append("from the corrected parameters")
                rows.append(
                    {
                        "table": experiment.frequency_table,
                        "column": column.title,
                        "mode": label,
                        "printed_hz": str(column.frequencies[i]),
                        "meant_hz": column.meant_hz[i],
                        "model_hz": float(model_hz[i]),
                        "difference_hz": difference,
                        "tolerance_hz": tolerance,
                        "within": abs(difference) <= tolerance,
                        "remark": "; ".join(remarks),
                    }
                )
    return pd.DataFrame(rows)


def recomputed_page(table: pd.DataFrame) -> str:
    """Return recomputed.md."""
    rows: list[tuple[Any, ...]] = [
        (
            f"Table {row.table}", row.column, row.mode, row.printed_hz, fixed(row.model_hz, 3),
            fixed(row.difference_hz, 3), fixed(row.tolerance_hz, 3), "yes" if row.within else "**no**", row.remark,
        )
        for _, row in rows_of(table)
    ]  # fmt: skip
    passed = int(table["within"].sum())
    return (
        "# The published frequencies, recomputed\n\n"
        f"The model at the parameters of Tables 1 and 3, modes paired by number: {passed} of {len(table)} "
        f"frequencies of Tables 2 and 4 come out within {share(TOLERANCE)} beyond the rounding of the printed "
        "digit. The difference is taken from what was meant where the remark says that a misprint is "
        "printed.\n\n"
        + markdown_table(
            (
                "table",
                "column",
                "mode",
                "printed, Hz",
                "model, Hz",
                "difference, Hz",
                "tolerance, Hz",
                "within",
                "remark",
            ),
            rows,
            words=(0, 1, -1),
        )
    )
