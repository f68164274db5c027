"""Print tables and verdicts as text on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fmu.config.variants import VARIANTS
from fmu.durable_files import write_durably
from fmu.numbers import MISSING, apart, customary_unit, fixed, round_by_sd, significant
from fmu.tables import text_table, wrap_text

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.analysis.evidence import FoundEvidence
    from fmu.analysis.maxima.results import Maxima

_DECIMALS = {
    "rhat": 4, "rhat_max": 4, "ess_bulk": 0, "ess_tail": 0, "ess_bulk_min": 0, "ess_tail_min": 0, "wall_s": 1,
}  # fmt: skip
_WORDS = ("", "unit", "from")
_IN_WORDS = {
    "eti90_lb": "5 %", "eti90_ub": "95 %", "rhat": "R-hat", "ess_bulk": "bulk ESS", "ess_tail": "tail ESS",
    "mcse_mean": "MCSE", "mcse_eti90_lb": "±", "mcse_eti90_ub": "±", "rhat_max": "largest R-hat",
    "ess_bulk_min": "smallest bulk ESS", "ess_tail_min": "smallest tail ESS",
    "mcse_over_sd_max": "largest MCSE / sd", "accept_rate": "acceptance rate", "n_solves": "solves",
    "n_gradients": "gradients", "gradient_cost": "solves that a gradient costs",
    "wall_s": "time, s", "ess_per_solve": "ESS per solve", "ess_per_s": "ESS per second",
}  # fmt: skip
"""Printed headings of columns of `fmu.summary` and `fmu.compare`; all other columns keep their names."""


def echo_maxima(maxima: Maxima, most_rows: int = 40) -> None:
    """Print the posterior maxima. If the table has more than `most_rows` rows, print only their probabilities."""
    click.echo(f"Posterior maxima\n{maxima.as_text(most_rows)}")
    if len(maxima.side_by_side()) > most_rows:
        click.echo("Parameters and frequencies at the maxima are in map.csv.")
    click.echo()


def echo_summary(name: str, trace: xr.DataTree, table: pd.DataFrame) -> None:
    """Print the summary of a sampler's trace, with means and intervals rounded by their standard deviation.

    Each end of an interval is followed by its Monte Carlo standard error. The last column says what determines
    each value, such as data or prior, if known. Rows of parameters that the data did not inform are dimmed. Losses
    between groups of tests have a separate table (`fmu.cli.damage.echo_losses`). If `told_names` leaves out the
    scores of single tests, because there are many parameters, only their number is printed.
    """
    from fmu.analysis.information import information
    from fmu.analysis.trace.reading import is_loss, told_names, without_scores

    told, attributes = told_names(trace), table.attrs
    n_scores = len(table) - len(told)
    table = table.loc[[name for name in told if not is_loss(trace, name)]]
    table.attrs = attributes
    columns = {"": list(map(str, table.index))}
    units = [customary_unit(table.attrs["units"][name]) for name in table.index]
    for column in _beside_the_ends(list(map(str, table.columns))):
        scales = (1.0 if column in _DECIMALS else unit.factor for unit in units)
        cells = zip(table[column], table["sd"], scales, strict=True)
        columns[column] = [_summary_cell(column, x / scale, sd / scale) for x, sd, scale in cells]
    columns["unit"] = [unit.name for unit in units]
    found = information(without_scores(trace))
    dim = () if found is None else found.not_informed
    if found is not None:
        columns["from"] = [found.basis[found.names.index(name)] for name in table.index]
    rows = list(zip(*columns.values(), strict=True))
    header = [_IN_WORDS.get(column, column) for column in columns]
    text = text_table(header, rows, words=[i for i, column in enumerate(columns) if column in _WORDS])
    width = max(map(len, table.index))
    lines = [click.style(line, dim=True) if line[:width].strip() in dim else line for line in text.splitlines()]
    if n_scores:
        lines.append(f"and {n_scores} scores of single tests, in summary-{name}.csv")
    click.echo("\n".join([name, *lines, ""]))


def echo_verdict(name: str, found: Diagnosis, width: int = 0) -> None:
    """Print the verdict on a sampler's run with its reasons. The name is padded to `width` columns."""
    width = max(width, len(name)) + 2
    indent = " " * width
    click.echo(wrap_text(found.verdict, f"{name:{width}}", indent))
    for remark in found.remarks[not found.converged :]:  # the verdict already states the first reason
        click.echo(wrap_text(remark, f"{indent}- ", f"{indent}  "))


def echo_comparison(
    traces: Mapping[str, xr.DataTree], summaries: Mapping[str, pd.DataFrame], *, with_verdicts: bool = True
) -> tuple[pd.DataFrame, dict[str, Diagnosis]]:
    """Print a table with one column per sampler, the verdicts if requested, and whether the model fits the data.

    If there are several samplers, also print whether they agree, and their costs relative to the baseline.

    Returns
    -------
    tuple of pandas.DataFrame and dict
        The table, and the verdicts keyed by sampler.
    """
    from fmu.analysis.convergence.comparison import compare_runs
    from fmu.analysis.convergence.diagnosis import NOTES, choose_run

    _, verdicts, table = compare_runs(traces, summaries=summaries)
    columns = table.drop(columns="verdict")
    rows = [
        [_IN_WORDS.get(name, name), *(_cell(name, value) for value in columns[name])] for name in map(str, columns)
    ]
    click.echo(text_table(["", *map(str, table.index)], rows))
    if with_verdicts:
        click.echo()
        for name, found in verdicts.items():
            echo_verdict(name, found, max(map(len, verdicts)))
    if len(traces) > 1:
        table = table.join(_echo_costs(traces, summaries, verdicts))
    name = choose_run(verdicts, summaries)
    chosen = verdicts[name]
    source = f"from the draws of {name}" + ("" if chosen.converged else " (not converged)")
    if chosen.fit.checks:
        _echo_list(f"The model, {source}: {chosen.fit.answer}", chosen.fit.said)
    if chosen.notes:
        _echo_list(f"{NOTES[0].upper()}{NOTES[1:]}, {source}", chosen.notes)
    return table, verdicts


def _echo_costs(
    traces: Mapping[str, xr.DataTree], summaries: Mapping[str, pd.DataFrame], verdicts: Mapping[str, Diagnosis]
) -> pd.DataFrame:
    """Print whether the samplers agree, and their costs relative to the baseline. Return the cost table."""
    from fmu.analysis.convergence.agreement import agreement
    from fmu.analysis.convergence.comparison import COUNTED, at_both_points, cost_rows, costs_side_by_side

    click.echo("\n" + wrap_text(agreement(traces, summaries).sentence))
    costs = costs_side_by_side(traces)
    click.echo("\n" + wrap_text(COUNTED))
    click.echo(text_table(["", *map(str, costs.index)], cost_rows(costs)))
    said = at_both_points(costs, {name: one.converged for name, one in verdicts.items()}, traces)
    if said:
        click.echo(wrap_text(said))
    return costs


def _echo_list(title: str, items: Iterable[str]) -> None:
    click.echo(f"\n{title}")
    for item in items:
        click.echo(wrap_text(item, "  - ", "    "))


def echo_evidences(found: Sequence[FoundEvidence]) -> None:
    """Print the log-evidences, if there are any, each with its method and reliability."""
    if found:
        click.echo()
    for one in found:
        click.echo(wrap_text(str(one), others="  "))


def echo_models(directory: Path, with_page: bool = True) -> None:
    """Compare the runs in a directory's subdirectories, one for each discrepancy; print and write the result.

    Raises
    ------
    ValueError
        If there are fewer than two runs with traces.
    """
    from fmu.analysis.convergence.comparison import compare_runs
    from fmu.analysis.convergence.diagnosis import choose_run
    from fmu.analysis.models.comparison import compare_traces
    from fmu.analysis.models.scatter import interval_ratios, ratio_words, scatter_words, scatters
    from fmu.analysis.trace.conversion import load_traces
    from fmu.report.pages import publish_models

    traces, pages = {}, {}
    for kind, (title, *_) in VARIANTS.items():
        found = load_traces(directory / kind) if (directory / kind).is_dir() else {}
        if found:
            summaries, verdicts, _ = compare_runs(found)
            traces[title] = found[choose_run(verdicts, summaries)]
            pages[title] = f"../{kind}/report/index.html"
    compared = compare_traces(traces)
    click.echo(f"Discrepancies compared\n{compared}")
    reference = next(iter(traces))
    words = [*ratio_words(interval_ratios(traces, reference), reference)]
    most = max(traces, key=lambda name: len(scatters(traces[name])))
    words = scatter_words(scatters(traces[most])) + words
    _echo_list(f"Where the misfit lives, by the model {most}; and what a discrepancy changes", words)
    write_durably(directory / "models.csv", compared.table.to_csv().encode())
    click.echo(f"\nWritten to {directory / 'models.csv'}")
    if with_page:
        click.echo(f"Page: {publish_models(traces, compared, directory, pages)}")


def _summary_cell(name: str, value: float, sd: float) -> str:
    if name in _DECIMALS:
        return fixed(value, _DECIMALS[name])
    is_spread = name == "sd" or name.startswith("mcse_")
    return apart(value, digits=2)[0] if is_spread else round_by_sd(value, sd)


def _beside_the_ends(columns: list[str]) -> list[str]:
    """Return a summary's columns in a new order: each interval end is followed by its standard error."""
    errors = {column.removeprefix("mcse_"): column for column in columns if column.startswith("mcse_eti")}
    others = [column for column in columns if column not in errors.values()]
    return [name for column in others for name in (column, errors.get(column)) if name is not None]


def _cell(name: str, value: object) -> str:
    """Return a value in the comparison as text. Floats are rounded; a value that does not apply is a dash."""
    if str(value) == "<NA>":
        return MISSING
    if not isinstance(value, float):
        return str(value)
    return fixed(value, _DECIMALS[name]) if name in _DECIMALS else significant(value)
