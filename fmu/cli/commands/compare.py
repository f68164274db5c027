"""``fmu compare``."""

from __future__ import annotations

from pathlib import Path

import click

from fmu.cli.tables import echo_comparison


@click.command("compare")
@click.argument("directory", type=click.Path(path_type=Path, exists=True, file_okay=False))
def command(directory: Path) -> None:
    """Compare the samplers of the run in DIRECTORY."""
    paths = sorted(directory.glob("*.nc"))
    if not paths:
        raise click.BadParameter(f"{directory} contains no traces (*.nc).", param_hint="'DIRECTORY'")
    from fmu.analysis.convergence.diagnosis import diagnose_all, side_by_side
    from fmu.analysis.convergence.diagnostics import summary
    from fmu.analysis.trace.conversion import load_trace

    traces = {path.stem: load_trace(path) for path in paths}
    problems = {trace.attrs["problem"] for trace in traces.values()}
    if len(problems) > 1:
        raise click.BadParameter(f"{directory} contains runs of different problems: "
                                 f"{', '.join(sorted(problems))}.",
                                 param_hint="'DIRECTORY'")  # fmt: skip
    summaries = {name: summary(trace) for name, trace in traces.items()}
    verdicts = diagnose_all(traces, summaries=summaries)
    echo_comparison(side_by_side(traces, summaries, verdicts), verdicts)
