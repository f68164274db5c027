"""Tables as text on a terminal."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    import pandas as pd

    from fmu.analysis.diagnosis import Diagnosis

_FORMATS = {"rhat": ".4f", "rhat_max": ".4f", "ess_bulk": ".0f", "ess_tail": ".0f"}


def text(table: pd.DataFrame) -> str:
    """Return a table as text, with as many digits as mean something."""
    formats: dict[Any, Any] = {
        name: f"{{:{_FORMATS.get(name, '.4g')}}}".format for name in table.select_dtypes("float").columns
    }
    return table.rename_axis(None).to_string(formatters=formats)


def echo_comparison(table: pd.DataFrame, verdicts: Mapping[str, Diagnosis]) -> None:
    """Print the numbers with a column a sampler, then the verdicts and what speaks against the model, in words."""
    numbers = table.drop(columns="verdict").astype(object).T
    cells = numbers.apply(lambda row: row.map(partial(_number, _FORMATS.get(row.name, ".4g"))), axis=1)
    click.echo(cells.rename_axis(None, axis=1).to_string())
    click.echo()
    width = max(map(len, table.index))
    for name, found in verdicts.items():
        click.echo(f"{name:{width}}  {found.verdict}")
        for remark in found.remarks[not found.converged :]:  # the verdict has the first reason
            click.echo(f"{'':{width}}  - {remark}")
    told = next((name for name, found in verdicts.items() if found.converged), next(iter(verdicts)))
    if verdicts[told].warnings:
        doubt = "" if verdicts[told].converged else ", which has not converged"
        click.echo(f"\nThe model, by the draws of {told}{doubt}")
        for warning in verdicts[told].warnings:
            click.echo(f"  - {warning}")


def _number(style: str, value: Any) -> str:
    """Format a number: whole ones in full, what does not apply as a dash."""
    if str(value) == "<NA>":
        return "-"
    return format(value, style) if isinstance(value, float) else str(value)
