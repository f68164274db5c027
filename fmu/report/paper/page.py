"""The page of one experiment: the paper's tables beside ours."""

from __future__ import annotations

import json
from typing import Any

from fmu.report.markdown import MISSING, interval, number, table, whole
from fmu.report.paper.claims import SEPARATED, judge, statement
from fmu.report.paper.experiment import PAIRED_BY
from fmu.report.paper.findings import Findings
from fmu.report.paper.plan import PAPER_SAMPLERS
from fmu.report.paper.tables import CI_PROB
from fmu.report.plots import TITLES

ENDS = tuple(f"eti{100 * CI_PROB:g}_{end}" for end in ("lb", "ub"))
_PRINTED = {"mh": "M-H", "slice": "slice sampling", "hmc": "HMC"}

_REACHED = ("sampler", "converged", "R-hat", "bulk ESS", "tail ESS", "mcse/sd", "moved", "divergences")
_COST = (
    "sampler", "model solves", "of them gradients", "to converge", "ESS per solve", "without warm-up",
    "time, s", "ESS per s", "the paper's protocol: solves", "its mean, sd off", "published, sd off",
)  # fmt: skip


def experiment_page(findings: Findings) -> str:
    """Return tables.md."""
    published = findings.published
    parts = [
        f"# Section {published.section} of the paper, modes paired {PAIRED_BY[findings.pairing]}\n",
        _how_to_read(findings),
        "## Before updating\n",
        _initial(findings),
    ]
    for name in PAPER_SAMPLERS:
        parts += [f"## {TITLES[name]}\n", _parameters(findings, name), _frequencies(findings, name)]
    parts += ["## Convergence and cost\n", _comparison(findings), statement(findings).strip() + "\n"]
    parts += ["## What the paper says on its samplers\n", _claims(findings)]
    parts += ["## Where the posterior has its maxima\n", _maxima(findings), _places(findings)]
    parts += ["## Settings\n", _settings(findings)]
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
        f"protocol, "
        "ours*: 1000 samples of one chain from the paper's start vector, all of them kept, settings fixed by "
        "hand. "
        "*Long run*: several chains from draws of the prior, after a warm-up; mean of the parameters with "
        "the "
        f"{CI_PROB:.0%} equal-tailed interval. Frequencies are those of the model at the parameters' mean, "
        f"and errors "
        f"|f − f_m|/f_m, as in the paper; *predicted* is the posterior predictive mean with its "
        f"{CI_PROB:.0%} interval "
        "for a new measurement, eq. (10).\n\n"
        "Files: `parameters.csv`, `frequencies.csv` and `comparison.csv` hold the same numbers in SI units "
        "and in full; "
        "`trace-*.png`, `corner-*.png`, `frequencies-*.png` and `convergence.png` show them.\n"
    )


def _mean_and_interval(findings: Findings, parameter: str, sampler: str) -> str:
    columns = (f"long_{sampler}_mean", *(f"long_{sampler}_{end}" for end in ENDS))
    mean, low, high = findings.in_paper_units(parameter, *columns)
    return interval(mean, low, high, ".3f")


def _initial(findings: Findings) -> str:
    column = findings.published.columns["initial"]
    cells = []
    for j, name in enumerate(findings.parameters.index):
        text = f"{name} = {column.parameters[j]}"
        cells.append(
            text + (f" (must be {number(column.theta[j], '.3g')})" if j in column.corrected_parameters else "")
        )
    rows = [
        (
            mode, f"{row.measured_hz:g}", f"{row.published_initial_hz:g}", f"{row.published_initial_error:g}",
            f"{row.recomputed_initial_hz:.2f}", f"{row.recomputed_initial_error:.2f}",
        )
        for mode, row in _rows(findings.frequencies)
    ]  # fmt: skip
    header = ("mode", "measured, Hz", "published, Hz", "error, %", "recomputed, Hz", "error, %")
    return f"Start vector: {', '.join(cells)}.\n\n" + table(header, rows)


def _parameters(findings: Findings, sampler: str) -> str:
    rows = []
    for name in findings.parameters.index:
        _, unit = findings.unit_of_paper(name)
        published, protocol, maximum = findings.in_paper_units(
            name, f"published_{sampler}", f"paper_{sampler}", "maximum"
        )
        rows.append((
            name, unit, f"{published:g}", f"{protocol:.3f}", _mean_and_interval(findings, name, sampler),
            _mean_and_interval(findings, name, "emcee"), f"{maximum:.3f}",
        ))  # fmt: skip
    header = (
        "parameter", "unit", "published", "the paper's protocol, ours", _long(findings, sampler),
        _long(findings, "emcee"), "maximum",
    )  # fmt: skip
    return table(header, rows, left=2)


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
    for mode, row in _rows(findings.frequencies):
        cells = [mode, f"{row.measured_hz:g}"]
        for source in sources:
            hz, error = getattr(row, f"{source}_hz"), getattr(row, f"{source}_error")
            printed = source.startswith("published_")
            cells += [f"{hz:g}", f"{error:g}"] if printed else [f"{hz:.2f}", f"{error:.2f}"]
            if source.startswith("long_"):
                low, high = (getattr(row, f"{source}_predictive_{end}") for end in ENDS)
                cells.append(interval(getattr(row, f"{source}_predictive"), low, high, ".1f"))
        rows.append(cells)
    return table(header, rows)


def _long(findings: Findings, sampler: str) -> str:
    words = "emcee, long run" if sampler == "emcee" else "long run"
    return words + ("" if findings.is_converged(sampler) else " (not converged)")


def _comparison(findings: Findings) -> str:
    """Return what the long runs reached, what they cost, and what the paper's protocol cost and gave."""
    rows = list(_rows(findings.comparison))
    reached = [
        (
            TITLES[name], "yes" if findings.is_converged(name) else "**no**", number(row.rhat_max, ".4f"),
            number(row.ess_bulk_min, ".0f"), number(row.ess_tail_min, ".0f"), number(row.mcse_over_sd_max, ".3f"),
            number(row.accept_rate, ".2f"), whole(row.divergences),
        )
        for name, row in rows
    ]  # fmt: skip
    cost = [
        (
            TITLES[name], whole(row.n_solves), whole(row.n_gradients), whole(row.needed_solves),
            number(row.ess_per_solve, ".2g"), number(row.ess_per_sampling_solve, ".2g"), number(row.wall_s, ".1f"),
            number(row.ess_per_s, ".3g"), whole(row.paper_solves), number(row.paper_error, ".1f"),
            number(row.published_error, ".1f"),
        )
        for name, row in rows
    ]  # fmt: skip
    failed = [f"- {TITLES[name]}: {row.verdict}.\n" for name, row in rows if not findings.is_converged(name)]
    origin = findings.origin + ("" if findings.reference_converged else " (no converged run at hand)")
    return (
        "The long runs; of every statistic the worst parameter's.\n\n"
        + table(_REACHED, reached)
        + ("\n" if failed else "")
        + "".join(failed)
        + "\nWhat they cost, all chains and the warm-up counted, and the paper's protocol beside them. An "
        "exact gradient "
        "is one solve. *To converge*: after how many solves the long run passed for converged, and did at "
        "every "
        f"greater length looked at; {MISSING} if it never did. *Off*: distance of the worst parameter's mean "
        f"from the "
        f"reference, in posterior standard deviations. Reference: {origin}.\n\n" + table(_COST, cost)
    )


def _claims(findings: Findings) -> str:
    rows = [(j.statement, j.outcome, j.evidence) for j in judge(findings)]
    return table(("the paper", "this run", "why"), rows, left=3)


def _maxima(findings: Findings) -> str:
    units = [findings.unit_of_paper(name) for name in findings.parameters.index]
    header = ["", *(f"{name}, {unit[1]}" for name, unit in zip(findings.parameters.index, units, strict=True))]
    rows = []
    for k, (_, row) in enumerate(_rows(findings.maxima)):
        values = [f"{getattr(row, n) / u[0]:.3f}" for n, u in zip(findings.parameters.index, units, strict=True)]
        below = findings.maxima["log_prob"].iloc[0] - row.log_prob
        rows.append((chr(ord("A") + k), *values, f"{below:.1f}", row.modes, str(row.starts)))
    text = table([*header, "below A, log", "modes paired", "starts"], rows)
    if len(findings.separate_maxima) > 1:
        missed = [TITLES[s] for s, row in _rows(findings.comparison) if "never visited" in str(row.verdict)]
        text += f"\n{SEPARATED}"
        if missed:
            text += f"Never near maximum A: {', '.join(missed)}. "
        text += "A test that looks at chains alone cannot see a mode that no chain has visited.\n"
    return text


def _places(findings: Findings) -> str:
    """Say which physical modes were paired along each long run, where that changes."""
    if len({combination for share in findings.places.values() for combination in share}) < 2:
        return ""
    rows = [
        (TITLES[name], "; ".join(f"{modes}: {part:.1%}" for modes, part in share.items() if part >= 5e-4))
        for name, share in findings.places.items()
    ]
    return (
        "\nWhich modes are compared with the measured ones, along the long runs (W: weak plane, S: strong "
        "plane, "
        "T: torsion, A: axial):\n\n" + table(("sampler", "share of the draws"), rows, left=2)
    )


def _settings(findings: Findings) -> str:
    rows = []
    for key, settings in findings.settings.items():
        chains, warmup, draws = findings.lengths[key]
        errors = [findings.certificates[key].get(name) for name in ("frequency_error", "log_prob_error")]
        learnt = "; ".join(_brief("", json.loads(findings.learnt[key])))
        steps = f"{chains} × ({warmup} + {draws})"
        rows.append((key, steps, *(number(e, ".1e") for e in errors), learnt or MISSING, f"`{settings}`"))
    return (
        "Steps are chains (ensembles) × (warm-up + kept). Settings are in scaled units (the bounds at 0 and "
        "1); "
        "those that are null were learnt in warm-up. Frequency and log-probability: the largest error of the "
        "reduced model, relative and absolute, against the full one at draws of the run; far below the "
        "maximum, "
        "where the paper's protocol starts, only the frequency matters.\n\n"
        + table(("run", "steps", "frequency", "log-probability", "learnt", "settings"), rows, left=2)
    )


def _brief(name: str, value: Any) -> list[str]:
    """Return settings as words: numbers as they are, of arrays the shape."""
    if isinstance(value, dict):
        return [words for key, item in value.items() for words in _brief(key, item)]
    if isinstance(value, list):
        shape = f"{len(value)} × {len(value[0])}" if value and isinstance(value[0], list) else str(len(value))
        return [f"{name}: {shape} numbers"]
    return [f"{name} {number(value, '.3g')}"] if isinstance(value, int | float) else []


def _rows(frame: Any) -> list[tuple[Any, Any]]:
    """Return index and row of a table, the row's cells by attribute."""
    return [(row.Index, row) for row in frame.itertuples()]
