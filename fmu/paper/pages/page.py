"""The page of one experiment: the paper's tables beside ours."""

from __future__ import annotations

from fmu.numbers import fixed, given, share, significant, with_interval
from fmu.paper.experiment import PAIRED_BY
from fmu.paper.findings import Findings
from fmu.paper.pages.run_sections import claims, fit, maxima, places, reached_and_cost, rows_of, settings
from fmu.paper.pages.tables import CI_PROB
from fmu.paper.plan import PAPER_SAMPLERS
from fmu.paper.published.claims import statement
from fmu.report.markdown import table
from fmu.report.plots import TITLES

ENDS = tuple(f"eti{100 * CI_PROB:g}_{end}" for end in ("lb", "ub"))


def experiment_page(findings: Findings) -> str:
    """Return tables.md."""
    published = findings.published
    parts = [
        f"# Section {published.section} of the paper, modes paired {PAIRED_BY[findings.pairing]}\n",
        _how_to_read(findings),
        "## Before updating, and by optimisation\n",
        _initial(findings),
    ]
    for name in PAPER_SAMPLERS:
        parts += [f"## {TITLES[name]}\n", _parameters(findings, name), _frequencies(findings, name)]
    parts += ["## Convergence and cost\n", reached_and_cost(findings), statement(findings).strip() + "\n"]
    parts += ["## What the paper says on its samplers\n", claims(findings)]
    parts += ["## Where the posterior has its maxima\n", maxima(findings), places(findings)]
    parts += ["## Whether the model fits\n", fit(findings)]
    parts += ["## Settings\n", settings(findings)]
    return "\n".join(parts)


def _how_to_read(findings: Findings) -> str:
    tables = f"Tables {findings.published.parameter_table} and {findings.published.frequency_table}"
    by_shape = (
        " The paper pairs by number; recomputed with shapes, its fourth frequency is another one."
        if findings.pairing == "shape"
        else ""
    )
    return (
        f"*Published*: {tables}. *Recomputed*: the model at the published parameters.{by_shape} *The paper's "
        "protocol, ours*: 1000 samples of one chain from the paper's start vector, all of them kept, settings "
        "fixed by hand. *Long run*: several chains from draws of the prior, after a warm-up; mean of the "
        f"parameters with the {share(CI_PROB)} equal-tailed interval. Frequencies are those of the model at the "
        "parameters' mean, and errors |f − f_m|/f_m, as in the paper; *predicted* is the posterior predictive "
        f"mean with its {share(CI_PROB)} interval for a new measurement, eq. (10).\n\n"
        "Files: `parameters.csv`, `frequencies.csv` and `comparison.csv` hold the same numbers in SI units and "
        "in full; `trace-*.png`, `corner-*.png`, `frequencies-*.png` and `convergence.png` show them. A report on "
        "the long runs, to open in a browser: [report/index.html](report/index.html).\n"
    )


def _mean_and_interval(findings: Findings, parameter: str, sampler: str) -> str:
    columns = (f"long_{sampler}_mean", *(f"long_{sampler}_{end}" for end in ENDS))
    mean, low, high = findings.in_paper_units(parameter, *columns)
    return with_interval(mean, low, high, 3)


def _initial(findings: Findings) -> str:
    column = findings.published.columns["initial"]
    cells = []
    for j, name in enumerate(findings.parameters.index):
        text = f"{name} = {column.parameters[j]}"
        cells.append(
            text + (f" (must be {significant(column.theta[j], 3)})" if j in column.corrected_parameters else "")
        )
    rows = [
        (
            mode, given(row.measured_hz), given(row.published_initial_hz), given(row.published_initial_error),
            fixed(row.recomputed_initial_hz, 2), fixed(row.recomputed_initial_error, 2),
            fixed(row.maximum_hz, 2), fixed(row.maximum_error, 2),
        )
        for mode, row in rows_of(findings.frequencies)
    ]  # fmt: skip
    header = (
        "mode", "measured, Hz", "published, Hz", "error, %", "recomputed, Hz", "error, %",
        "at the maximum, Hz", "error, %",
    )  # fmt: skip
    return (
        f"Start vector: {', '.join(cells)}. *At the maximum*: the one vector that deterministic updating gives, "
        "where the posterior is highest.\n\n" + table(header, rows)
    )


def _parameters(findings: Findings, sampler: str) -> str:
    rows = []
    for name in findings.parameters.index:
        _, unit = findings.unit_of_paper(name)
        published, protocol, maximum = findings.in_paper_units(
            name, f"published_{sampler}", f"paper_{sampler}", "maximum"
        )
        rows.append((
            name, unit, given(published), fixed(protocol, 3), _mean_and_interval(findings, name, sampler),
            _mean_and_interval(findings, name, "emcee"), fixed(maximum, 3),
        ))  # fmt: skip
    header = (
        "parameter", "unit", "published", "the paper's protocol, ours", _long(findings, sampler),
        _long(findings, "emcee"), "maximum",
    )  # fmt: skip
    return table(header, rows, words=(0, 1))


def _frequencies(findings: Findings, sampler: str) -> str:
    header = ["mode", "measured, Hz"]
    sources = {
        f"published_{sampler}": "published",
        f"recomputed_{sampler}": "recomputed",
        f"paper_{sampler}": "the paper's protocol, ours",
        f"long_{sampler}": _long(findings, sampler),
        "long_emcee": _long(findings, "emcee"),
    }
    for source, words in sources.items():
        header += [f"{words}, Hz", "error, %"] + (["predicted, Hz"] if source.startswith("long_") else [])
    rows = []
    for mode, row in rows_of(findings.frequencies):
        cells = [mode, given(row.measured_hz)]
        for source in sources:
            hz, error = getattr(row, f"{source}_hz"), getattr(row, f"{source}_error")
            printed = source.startswith("published_")
            cells += [given(hz), given(error)] if printed else [fixed(hz, 2), fixed(error, 2)]
            if source.startswith("long_"):
                low, high = (getattr(row, f"{source}_predictive_{end}") for end in ENDS)
                cells.append(with_interval(getattr(row, f"{source}_predictive"), low, high, 1))
        rows.append(cells)
    return table(header, rows)


def _long(findings: Findings, sampler: str) -> str:
    words = "emcee, long run" if sampler == "emcee" else "long run"
    return words + ("" if findings.is_converged(sampler) else " (not converged)")
