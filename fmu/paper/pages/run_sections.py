"""The parts of an experiment's page that are about the runs: convergence, cost, maxima, fit and settings."""

from __future__ import annotations

import json
from typing import Any

from fmu.numbers import MISSING, about, fixed, share, significant, whole
from fmu.paper.findings import Findings
from fmu.paper.published.claims import SEPARATED, judge
from fmu.report.markdown import table
from fmu.report.plots import TITLES

WOULD_NEED = (
    "*Would need*: solves that the paper's settings take for an effective sample size of 400, at the pace of "
    "chains that start in the posterior, a rough estimate where they mix slowly; the way there is not in it."
)
_REACHED = ("sampler", "converged", "R-hat", "bulk ESS", "tail ESS", "mcse/sd", "moved", "divergences")
_COST = (
    "sampler", "model solves", "of them gradients", "to converge", "ESS per solve", "without warm-up",
    "ESS per s", "time, s", "the paper's protocol: solves", "its mean, sd off", "would need",
    "published, sd off",
)  # fmt: skip


def reached_and_cost(findings: Findings) -> str:
    """Return what the long runs reached, what they cost, and what the paper's protocol cost and gave."""
    rows = list(rows_of(findings.comparison))
    reached = [
        (
            TITLES[name], "yes" if findings.is_converged(name) else "**no**", fixed(row.rhat_max, 4),
            fixed(row.ess_bulk_min, 0), fixed(row.ess_tail_min, 0), fixed(row.mcse_over_sd_max, 3),
            fixed(row.accept_rate, 2), whole(row.divergences),
        )
        for name, row in rows
    ]  # fmt: skip
    cost = [
        (
            TITLES[name], whole(row.n_solves), whole(row.n_gradients), whole(row.needed_solves),
            *_efficiency(findings, name), fixed(row.wall_s, 1), whole(row.paper_solves),
            fixed(row.paper_error, 1), about(row.paper_needed_solves), fixed(row.published_error, 1),
        )
        for name, row in rows
    ]  # fmt: skip
    failed = [
        f"- {TITLES[name]} has not converged:\n" + "".join(f"  - {reason}\n" for reason in reasons)
        for name, reasons in findings.reasons.items()
        if reasons
    ]
    return (
        "The long runs; of every statistic the worst parameter's.\n\n"
        + table(_REACHED, reached, words=(0, 1))
        + ("\n" if failed else "")
        + "".join(failed)
        + "\nWhat they cost, all chains and the warm-up counted, and the paper's protocol beside them. An "
        "exact gradient is one solve. *To converge*: after how many solves the long run passed for converged, "
        f"and did at every greater length looked at; {MISSING} if it never did, and an ESS then means nothing. "
        f"{WOULD_NEED} *Off*: distance of the worst parameter's mean from the reference, in posterior standard "
        f"deviations. Reference: {findings.origin}.\n\n" + table(_COST, cost)
    )


def _efficiency(findings: Findings, sampler: str) -> list[str]:
    """Return effective draws per solve, per solve after the warm-up, and per second, of a converged run."""
    columns = {"ess_per_solve": 2, "ess_per_sampling_solve": 2, "ess_per_s": 3}
    is_known = findings.is_converged(sampler)
    return [significant(findings.value(sampler, name) if is_known else None, n) for name, n in columns.items()]


def claims(findings: Findings) -> str:
    """Return the paper's statements on its samplers and what became of them."""
    rows = [(j.statement, j.outcome, j.evidence) for j in judge(findings)]
    return table(("the paper", "this run", "why"), rows, words=range(3))


def maxima(findings: Findings) -> str:
    """Return where the posterior has its maxima, and what they weigh."""
    names = list(findings.parameters.index)
    units = [findings.unit_of_paper(name) for name in names]
    header = ["", *(f"{name}, {unit}" for name, (_, unit) in zip(names, units, strict=True))]
    rows = []
    for k, row in rows_of(findings.maxima):
        cells = [str(k)]
        for name, (factor, _) in zip(names, units, strict=True):
            at, mean, sd = (getattr(row, name + end) / factor for end in ("", "_mean", "_sd"))
            cells.append(f"{fixed(at, 3)} ({fixed(mean, 3)} ± {fixed(sd, 3)})")
        below = findings.maxima["log_prob"].iloc[0] - row.log_prob
        rows.append((*cells, fixed(below, 1), share(row.share), row.modes, whole(row.starts)))
    text = (
        "At each maximum, and in brackets mean and sd of the part of the posterior around it (importance "
        "sampling, no chain). *Lower*: in log-probability than number 1.\n\n"
        + table([*header, "lower", "share of the probability", "modes paired", "climbs"], rows, words=(0, -2))
    )
    if len(findings.separate_maxima) > 1:
        text += f"\n{SEPARATED}"
        if findings.never_visited:
            text += f"Never near number 1: {', '.join(TITLES[s] for s in findings.never_visited)}. "
        text += "A test that looks at chains alone cannot see a mode that no chain has visited.\n"
    return text


def fit(findings: Findings) -> str:
    """Say what speaks against the model, by the first of the converged runs."""
    for name in ("hmc", "emcee", "mh", "slice"):
        if findings.is_converged(name):
            listed = "".join(f"- {warning}.\n" for warning in findings.warnings[name])
            return listed or "Nothing speaks against it.\n"
    return "No converged run to tell from.\n"


def places(findings: Findings) -> str:
    """Say which physical modes were paired along each long run, where that changes."""
    if len({combination for parts in findings.places.values() for combination in parts}) < 2:
        return ""
    rows = [
        (TITLES[name], "; ".join(f"{modes}: {share(part)}" for modes, part in parts.items() if part >= 5e-4))
        for name, parts in findings.places.items()
    ]
    return (
        "\nWhich modes are compared with the measured ones, along the long runs (W: weak plane, S: strong "
        "plane, "
        "T: torsion, A: axial):\n\n" + table(("sampler", "share of the draws"), rows, words=(0, 1))
    )


def settings(findings: Findings) -> str:
    """Return how long every run was, with what settings, and how good its reduced model."""
    rows = []
    for key, settings in findings.settings.items():
        chains, warmup, draws = findings.lengths[key]
        errors = [findings.certificates[key].get(name) for name in ("frequency_error", "log_prob_error")]
        given = json.loads(settings)
        learnt = {name: x for name, x in json.loads(findings.learnt[key]).items() if given.get(name) is None}
        steps = f"{chains} × ({warmup} + {draws})"
        rows.append(
            (
                key,
                steps,
                *(significant(e, 2) for e in errors),
                "; ".join(_brief("", learnt)) or MISSING,
                f"`{settings}`",
            )
        )
    return (
        "Steps are chains (ensembles) × (warm-up + kept). Settings are in scaled units (the bounds at 0 and "
        "1); those that are null were learnt in warm-up. Frequency and log-probability: the largest error of "
        "the reduced model, relative and absolute, against the full one at draws of the run; far below the "
        "maximum, where the paper's protocol starts, only the frequency matters.\n\n"
        + table(("run", "steps", "frequency", "log-probability", "learnt", "settings"), rows, words=(0, 1, 4, 5))
    )


def _brief(name: str, value: Any) -> list[str]:
    """Return settings as words: numbers as they are, of arrays the shape."""
    if isinstance(value, dict):
        return [words for key, item in value.items() for words in _brief(key, item)]
    if isinstance(value, list):
        shape = f"{len(value)} × {len(value[0])}" if value and isinstance(value[0], list) else str(len(value))
        return [f"{name}: {shape} numbers"]
    return [f"{name} {significant(value, 3)}"] if isinstance(value, int | float) else []


def rows_of(frame: Any) -> list[tuple[Any, Any]]:
    """Return index and row of a table, the row's cells by attribute."""
    return [(row.Index, row) for row in frame.itertuples()]
