"""Tables and verdicts as text on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from fmu.numbers import MISSING, apart, fixed, rounded, significant
from fmu.tables import text_table, wrapped

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.analysis.evidence import FoundEvidence

_FORMATS: dict[str, Callable[[float], str]] = {
    "rhat": lambda x: fixed(x, 4),
    "rhat_max": lambda x: fixed(x, 4),
    "ess_bulk": lambda x: fixed(x, 0),
    "ess_tail": lambda x: fixed(x, 0),
    "ess_bulk_min": lambda x: fixed(x, 0),
    "ess_tail_min": lambda x: fixed(x, 0),
    "wall_s": lambda x: fixed(x, 1),
    "sd": lambda x: apart(x, digits=2)[0],
    "mcse_mean": lambda x: apart(x, digits=2)[0],
}


def summary_text(table: pd.DataFrame, updated: Sequence[str] | None = None) -> str:
    """Return ``fmu.summary(trace)`` as text; the sd decides how many digits of means and intervals are shown.

    With `updated`, a last column says whether the data updated each parameter.
    """
    more = [] if updated is None else ["updated"]
    rows = []
    for k, (name, row) in enumerate(table.iterrows()):
        cells = [_FORMATS[c](row[c]) if c in _FORMATS else rounded(row[c], row["sd"]) for c in table.columns]
        rows.append([str(name), *cells, table.attrs["units"][name], *([] if updated is None else [updated[k]])])
    n = len(table.columns) + 1
    return text_table(["", *map(str, table.columns), "unit", *more], rows, words=(0, n, n + 1)[: 2 + len(more)])


def echo_summary(name: str, trace: xr.DataTree, table: pd.DataFrame) -> None:
    """Print the summary of a sampler's trace, with a column that says which parameters the data updated."""
    from fmu.analysis.information import COMBINED, DATA, PRIOR, information

    words = {DATA: "yes", PRIOR: "no", COMBINED: "combined"}
    found = information(trace)
    updated = None if found is None else [words[basis] for basis in found.basis]
    click.echo(f"{name}\n{summary_text(table, updated)}\n")


def echo_comparison(
    traces: Mapping[str, xr.DataTree], summaries: Mapping[str, pd.DataFrame]
) -> tuple[pd.DataFrame, dict[str, Diagnosis]]:
    """Print a table with one column per sampler, the verdicts, and the warnings about the model; return both."""
    from fmu.analysis.convergence.diagnosis import diagnose_all, side_by_side

    verdicts = diagnose_all(traces, summaries=summaries)
    table = side_by_side(traces, summaries, verdicts)
    columns = table.drop(columns="verdict")
    rows = [[str(name), *(_cell(str(name), value) for value in columns[name])] for name in columns]
    click.echo(text_table(["", *map(str, table.index)], rows))
    click.echo()
    width = max(map(len, table.index)) + 2
    indent = " " * width
    for name, found in verdicts.items():
        click.echo(wrapped(found.verdict, f"{name:{width}}", indent))
        for remark in found.remarks[not found.converged :]:  # the verdict has the first reason
            click.echo(wrapped(remark, f"{indent}- ", f"{indent}  "))
    told = next((name for name, found in verdicts.items() if found.converged), next(iter(verdicts)))
    if verdicts[told].warnings:
        doubt = "" if verdicts[told].converged else " (not converged)"
        click.echo(f"\nRemarks on the model, from the draws of {told}{doubt}")
        for warning in verdicts[told].warnings:
            click.echo(wrapped(warning, "  - ", "    "))
    return table, verdicts


def echo_evidences(found: Sequence[FoundEvidence]) -> None:
    """Print the log-evidences, if there are any, each with the method and how reliable it is."""
    if found:
        click.echo("\nEvidence (natural logarithm)")
    for one in found:
        click.echo(wrapped(f"{one.value}, from {one.basis}: {one.is_reliable}", "  ", "    "))


def _cell(name: str, value: Any) -> str:
    """Format a value of the comparison: whole numbers in full, a dash for what does not apply."""
    if str(value) == "<NA>":
        return MISSING
    if not isinstance(value, float):
        return str(value)
    return _FORMATS.get(name, significant)(value)
