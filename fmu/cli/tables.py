"""Tables and verdicts as text on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from fmu.numbers import MISSING, apart, fixed, rounded, significant
from fmu.text_table import text_table, wrapped

if TYPE_CHECKING:
    import pandas as pd

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
    """Return ``fmu.summary(trace)`` as text: of means and intervals as many digits as their sd leaves.

    With `updated`, a last column says of each parameter whether the data updated it.
    """
    more = [] if updated is None else ["updated"]
    rows = []
    for k, (name, row) in enumerate(table.iterrows()):
        cells = [_FORMATS[c](row[c]) if c in _FORMATS else rounded(row[c], row["sd"]) for c in table.columns]
        rows.append([str(name), *cells, table.attrs["units"][name], *([] if updated is None else [updated[k]])])
    n = len(table.columns) + 1
    return text_table(["", *map(str, table.columns), "unit", *more], rows, words=(0, n, n + 1)[: 2 + len(more)])


def echo_comparison(table: pd.DataFrame, verdicts: Mapping[str, Diagnosis]) -> None:
    """Print the numbers with a column a sampler, then the verdicts and what speaks against the model, in words."""
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


def echo_evidences(found: Sequence[FoundEvidence]) -> None:
    """Print every log-evidence with what it rests on, if there is any."""
    if found:
        click.echo("\nEvidence (natural logarithm)")
    for one in found:
        click.echo(wrapped(f"{one.value}, from {one.basis}: {one.is_reliable}", "  ", "    "))


def _cell(name: str, value: Any) -> str:
    """Format a number of the comparison: whole ones in full, what does not apply as a dash."""
    if str(value) == "<NA>":
        return MISSING
    if not isinstance(value, float):
        return str(value)
    return _FORMATS.get(name, significant)(value)
