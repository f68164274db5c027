"""The command ``fmu damage``, which prints the losses between a structure's states as tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fmu.numbers import customary_unit, decimals, fixed, interval
from fmu.tables import text_table, wrap_text

if TYPE_CHECKING:
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis

_WIDTH = 80
BEYOND = (0.05, 0.1)
"""Losses for which the probability of being exceeded is printed."""


def echo_losses(trace: xr.DataTree, diagnosis: Diagnosis, beyond: Sequence[float] = BEYOND) -> None:
    """Print the losses in each later state, with the values before and after. Warn if they are unreliable.

    For each limit in `beyond`, the probability that a loss exceeds it is printed too. If the tests contradict a
    law of the model, these probabilities are withheld, and the reason is printed instead. Raise ValueError if the
    trace has no losses, or a limit is below 0, or is 1 or more.
    """
    from fmu.analysis.trace.damage import (
        ANY,
        WITHHELD,
        before_and_after,
        before_in_words,
        damage,
        limits_of,
        probably,
        state_in_words,
    )

    table, values = damage(trace, beyond), before_and_after(trace)
    header = ["", "before", "after", "loss", "90 % interval", *(f"P > {limit}" for limit in limits_of(beyond))]
    click.echo(wrap_text(f"Losses since {before_in_words(trace)}", width=_WIDTH))
    for state in table.index.unique("state"):
        rows = []
        for name, (mean, sd, low, high, *exceeded) in table.loc[state].iterrows():
            n = decimals(100.0 * sd)
            cells = [f"{fixed(100.0 * mean, n)} %", f"{interval(100.0 * low, 100.0 * high, n)} %"]
            cells += map(probably, exceeded)
            if name == ANY:
                rows.append(["the largest", "", "", *cells])
                continue
            unit = customary_unit(trace["tests"][name].attrs.get("units", ""))
            before, after = (values.loc[(state, name), when] / unit.factor for when in ("before", "after"))
            places = decimals(abs(before) * sd)
            label = f"{name} ({unit.name})" if unit.name else str(name)
            rows.append([label, fixed(before, places), fixed(after, places), *cells])
        click.echo("\n" + wrap_text(f"After: {state_in_words(trace, state)}", width=_WIDTH))
        click.echo(text_table(header, rows, width=_WIDTH))
    answer = f"The model: {diagnosis.fit.answer}. " if diagnosis.fit.checks else ""
    rests = "P is the probability of a loss beyond that limit, given the model, its errors and its priors."
    withheld = table.attrs[WITHHELD]
    click.echo("\n" + wrap_text(answer + (withheld or rests), width=_WIDTH))
    if diagnosis.doubts and not withheld:
        click.echo(wrap_text(f"Do not rely on P: {' and '.join(diagnosis.doubts)}.", width=_WIDTH))


DIRECTORY = click.argument("directory", type=click.Path(path_type=Path, exists=True, file_okay=False))
SAMPLER = click.option(
    "--sampler",
    help="Sampler whose draws are used.  [default: of those that converged, the one with most effective draws]",
)
MODEL = click.option(
    "--model",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Problem file to use instead of the saved copy, if files it refers to have moved.",
)


@click.command()
@DIRECTORY
@click.option("--beyond", type=click.FloatRange(0.0, 1.0, max_open=True), multiple=True, default=BEYOND,
              show_default=True, help="Loss whose probability of being exceeded is wanted.")  # fmt: skip
@SAMPLER
def damage(directory: Path, beyond: tuple[float, ...], sampler: str | None) -> None:
    """Print the losses between states of the structure for the run in DIRECTORY, and draw them (damage.png).

    The problem must have several [[tests]] in groups, and parameters with varies = "group" or varies = "damage".
    """
    from fmu.report.export import read_choice
    from fmu.report.plots import DPI, plot_losses

    name, trace, diagnosis = read_choice(directory, sampler)
    echo_losses(trace, diagnosis, beyond)
    path = directory / "damage.png"
    plot_losses(trace, beyond[0])[0].figure.savefig(path, dpi=DPI)
    click.echo(f"\nDraws of {name}. Picture: {path}")


COMMANDS = (damage,)
