"""Write the page on one experiment, which compares the paper's tables with our results."""

from __future__ import annotations

import json
from typing import Any

from fmu.analysis.convergence.remedies import LEAST_ESS, MIN_AUTOCORRELATION_TIMES, RHAT_LIMIT
from fmu.numbers import MISSING, about, fixed, given, share, significant, whole, with_interval
from fmu.paper.convergence import LEAST_ESS_OF_PACE
from fmu.paper.experiment import CI_PROB, PAIRED_BY, rows_of
from fmu.paper.findings import CLOSE_LENGTHS, SEPARATED, Findings, judge, statement, to_converge
from fmu.paper.plan import PAPER_SAMPLERS
from fmu.plain_data import list_in, mapping_in, number_in
from fmu.report.plots import TITLES
from fmu.tables import markdown_table

ENDS = tuple(f"eti{100 * CI_PROB:g}_{end}" for end in ("lb", "ub"))


def experiment_page(findings: Findings) -> str:
    """Return the Markdown text of tables.md."""
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
    parts += ["## Chains from one start\n", one_start(findings)]
    parts += ["## Whether the model fits\n", fit(findings)]
    parts += ["## Settings\n", settings(findings)]
    return "\n".join(parts)


def _how_to_read(findings: Findings) -> str:
    tables = f"Tables {findings.published.parameter_table} and {findings.published.frequency_table}"
    by_shape = (
        " The paper pairs by number; paired by shape, its fourth frequency is that of another mode."
        if findings.pairing == "shape"
        else ""
    )
    return (
        f"*Published*: {tables}. *Recomputed*: the model at the published parameters.{by_shape} *The paper's "
        "protocol, ours*: 1000 samples of one chain from the paper's start vector, all of them kept, settings "
        f"fixed by hand. *Long run*: several chains, after a warm-up. {STARTS}Mean of the "
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
            mode, given(row["measured_hz"]),
            *(given(row[f"published_initial_{of}"]) for of in ("hz", "error")),
            *(fixed(row[f"{at}_{of}"], 2) for at in ("recomputed_initial", "maximum") for of in ("hz", "error")),
        )
        for mode, row in rows_of(findings.frequencies)
    ]  # fmt: skip
    header = (
        "mode", "measured, Hz", "published, Hz", "error, %", "recomputed, Hz", "error, %",
        "at the maximum, Hz", "error, %",
    )  # fmt: skip
    return (
        f"Start vector: {', '.join(cells)}. *At the maximum*: the one vector that deterministic updating gives, "
        "where the posterior is highest.\n\n" + markdown_table(header, rows)
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
    return markdown_table(header, rows, words=(0, 1))


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
        cells = [mode, given(row["measured_hz"])]
        for source in sources:
            hz, error = row[f"{source}_hz"], row[f"{source}_error"]
            printed = source.startswith("published_")
            cells += [given(hz), given(error)] if printed else [fixed(hz, 2), fixed(error, 2)]
            if source.startswith("long_"):
                low, high = (row[f"{source}_predictive_{end}"] for end in ENDS)
                cells.append(with_interval(row[f"{source}_predictive"], low, high, 1))
        rows.append(cells)
    return markdown_table(header, rows)


def _long(findings: Findings, sampler: str) -> str:
    words = "emcee, long run" if sampler == "emcee" else "long run"
    return words + ("" if findings.is_converged(sampler) else " (not converged)")


STARTS = (
    "The mixture sampler starts at draws from the prior; so do MH, slice sampling and HMC, unless several maxima "
    "are known. Then they start around the maxima, as emcee always does, because neither emcee nor they, which "
    "here make no jumps, can cross between modes. "
)
WOULD_NEED = (
    "*Would need*: a rough estimate of the solves that the settings chosen for the paper's protocol take to an "
    'effective sample size of 400, from chains that start in the posterior; "more than" if these have one below '
    f"{LEAST_ESS_OF_PACE:g}, which four chains that hardly move cannot tell from less."
)
_REACHED = ("sampler", "converged", "R-hat", "bulk ESS", "tail ESS", "mcse/sd", "moved", "divergences")
SOLVE = (
    "A *solve* is a log-probability. An exact gradient counts as many solves as it takes the time of, measured at "
    "the end of each run (*a gradient costs*); the paper's central difference consists of 2 solves a parameter. "
)
TO_CONVERGE = (
    "*To converge*: samples of all chains, solves and seconds from which on the long run has, at every length "
    f"examined, R-hat below {RHAT_LIMIT}, bulk and tail ESS of at least {LEAST_ESS}, and every important maximum. "
    "This is asked alike of all samplers; *converged* asks more of the whole run, and of emcee a length of "
    f"{MIN_AUTOCORRELATION_TIMES} autocorrelation times. In brackets without the warm-up, whose length was chosen "
    "beforehand for each sampler. "
)
_COST = (
    "sampler", "evaluations", "of them gradients", "a gradient costs, solves", "samples to converge",
    "solves to converge", "seconds to converge", "ESS per solve", "without warm-up", "ESS per s", "time, s",
    "the paper's protocol: solves", "its worst mean, sd off", "would need", "published, sd off",
)  # fmt: skip


def reached_and_cost(findings: Findings) -> str:
    """Return tables of the long runs' convergence and cost, with the cost of the paper's protocol."""
    rows = list(rows_of(findings.comparison))
    reached = [
        (
            TITLES[name], "yes" if findings.is_converged(name) else "**no**", fixed(row["rhat_max"], 4),
            fixed(row["ess_bulk_min"], 0), fixed(row["ess_tail_min"], 0), fixed(row["mcse_over_sd_max"], 3),
            fixed(row["accept_rate"], 2), whole(row["divergences"]),
        )
        for name, row in rows
    ]  # fmt: skip
    cost = [
        (
            TITLES[name], whole(row["n_solves"]), whole(row["n_gradients"]), significant(row["gradient_cost"], 2),
            *to_converge(findings, name), *_efficiency(findings, name), fixed(row["wall_s"], 1),
            whole(row["paper_solves"]),
            fixed(row["paper_error"], 1), would_need(findings, name), fixed(row["published_error"], 1),
        )
        for name, row in rows
    ]  # fmt: skip
    failed = [
        f"- {TITLES[name]} has not converged:\n" + "".join(f"  - {reason}\n" for reason in reasons)
        for name, reasons in findings.reasons.items()
        if reasons
    ]
    return (
        "The long runs. Each statistic is that of the worst parameter.\n\n"
        + markdown_table(_REACHED, reached, words=(0, 1))
        + ("\n" if failed else "")
        + "".join(failed)
        + "\nCost of the long runs, all chains and the warm-up included, beside that of the paper's protocol. "
        f"{SOLVE}{TO_CONVERGE}Where a run has not converged, its ESS means nothing and is left out ({MISSING}). "
        f"{WOULD_NEED} *Off*: distance of the worst parameter's mean from the reference, in posterior standard "
        f"deviations. Reference: {findings.origin}.\n\n" + markdown_table(_COST, cost)
    )


def would_need(findings: Findings, sampler: str) -> str:
    """Return the solves that the paper's settings would need, or ``"more than"`` their number if it is a bound."""
    words = about(findings.value(sampler, "paper_needed_solves"))
    is_bound = findings.value(sampler, "paper_pace_ess") < LEAST_ESS_OF_PACE
    return words.replace("≈", "more than") if is_bound else words


def _efficiency(findings: Findings, sampler: str) -> list[str]:
    """Return three texts: the effective sample size per solve, per solve after warm-up, and per second.

    The texts are dashes if the run has not converged.
    """
    columns = {"ess_per_solve": 2, "ess_per_sampling_solve": 2, "ess_per_s": 3}
    is_known = findings.is_converged(sampler)
    return [significant(findings.value(sampler, name) if is_known else None, n) for name, n in columns.items()]


JUDGED_BY = (
    "The paper does not say by what a sampler *converges faster* (section 5.2: in convergence time); each way to "
    "count is judged for itself, by the long runs of the table of costs. These are of the paper's algorithms, but "
    "tuned in a warm-up, and HMC takes exact gradients; where several maxima are known they start around these, "
    "which does not count. A verdict holds with and without the warm-up. *Better results* are "
    "judged by the paper's own tables: it does not state its step sizes and widths, and what our runs with its "
    "protocol reach depends on those that we chose. *Sd off*: distance of the published means from the reference. "
    f"Each figure is that of one run: less than a factor of {CLOSE_LENGTHS:g} between two is too close to call.\n"
)


def claims(findings: Findings) -> str:
    """Return a table of the paper's statements about its samplers, and our judgements of them."""
    rows = [(j.statement, j.criterion, j.outcome, j.evidence) for j in judge(findings)]
    return f"{JUDGED_BY}\n" + markdown_table(("the paper", "by", "verdict", "figures"), rows, words=range(4))


def maxima(findings: Findings) -> str:
    """Return a table of the posterior maxima, with the probability share of each maximum."""
    names = list(findings.parameters.index)
    units = [findings.unit_of_paper(name) for name in names]
    header = ["", *(f"{name}, {unit}" for name, (_, unit) in zip(names, units, strict=True))]
    rows = []
    for k, row in rows_of(findings.maxima):
        cells = [str(k)]
        for name, (factor, _) in zip(names, units, strict=True):
            at, mean, sd = (row[name + end] / factor for end in ("", "_mean", "_sd"))
            cells.append(f"{fixed(at, 3)} ({fixed(mean, 3)} ± {fixed(sd, 3)})")
        below = findings.maxima["log_prob"].iloc[0] - row["log_prob"]
        rows.append((*cells, fixed(below, 1), share(row["share"]), row["modes"], whole(row["starts"])))
    text = (
        "At each maximum, and in brackets mean and sd of the part of the posterior around it (importance "
        "sampling, no chain). *Lower*: in log-probability than number 1.\n\n"
        + markdown_table(
            [*header, "lower", "share of the probability", "modes paired", "starts"], rows, words=(0, -2)
        )
    )
    if len(findings.separate_maxima) > 1 and not all(map(findings.is_converged, findings.comparison.index)):
        text += f"\n{SEPARATED}"
        if findings.never_near:
            text += f"Never near number 1: {', '.join(TITLES[s] for s in findings.never_near)}. "
        text += "\n"
    return text


def one_start(findings: Findings) -> str:
    """Return the paragraph on R-hat and the error of the run whose chains all have the same starting vector."""
    run = findings.one_start
    text = (
        f"HMC without jumps, {run.chains} chains of {whole(run.draws)} draws, all from the paper's start vector: "
        f"the largest R-hat is {fixed(run.rhat, 4)}, the smallest bulk ESS {whole(run.ess)}, and the worst mean "
        f"lies {fixed(run.off, 1)} posterior standard deviations off the reference. "
    )
    if not run.reasons:
        return text + "The run has converged.\n"
    listed = "".join(f"- {reason}\n" for reason in run.reasons)
    return (
        text
        + "Chains from one start fall into one mode: that they agree shows nothing of the modes that none has "
        f"visited. The search for maxima does. Not converged:\n\n{listed}"
    )


def fit(findings: Findings) -> str:
    """Return the warnings about the model from the first converged run as a list in Markdown.

    Return a sentence if there are no warnings, or if no run has converged.
    """
    for name in ("hmc", "emcee", "mixture", "mh", "slice"):
        if findings.is_converged(name):
            listed = "".join(f"- {warning}.\n" for warning in findings.warnings[name])
            return listed or "No warnings.\n"
    return "No run has converged.\n"


def places(findings: Findings) -> str:
    """Return a table of the physical modes paired in each long run; empty if all draws have the same pairing."""
    if len({combination for parts in findings.places.values() for combination in parts}) < 2:
        return ""
    rows = [
        (TITLES[name], "; ".join(f"{modes}: {share(part)}" for modes, part in parts.items() if part >= 5e-4))
        for name, parts in findings.places.items()
    ]
    return (
        "\nComputed modes paired with the measured ones in the long runs (W: weak plane, S: strong "
        "plane, "
        "T: torsion, A: axial):\n\n" + markdown_table(("sampler", "share of the draws"), rows, words=(0, 1))
    )


def settings(findings: Findings) -> str:
    """Return a table of every run's length, settings and certificate."""
    rows = []
    for key, settings in findings.settings.items():
        chains, warmup, draws = findings.lengths[key]
        errors = [findings.certificates[key].get(name) for name in ("frequency_error", "log_prob_error")]
        given = {name: _count(value) for name, value in json.loads(settings).items()}
        learnt = {name: x for name, x in json.loads(findings.learnt[key]).items() if given.get(name) is None}
        steps = f"{chains} × ({warmup} + {draws})"
        rows.append(
            (
                key,
                steps,
                *(significant(e, 2) for e in errors),
                "; ".join(_brief("", learnt)) or MISSING,
                f"`{json.dumps(given, separators=(',', ':'))}`",
            )
        )
    return (
        "Steps are chains (ensembles) × (warm-up + draws). Settings are in scaled units (the bounds at 0 and "
        "1); null settings were tuned in warm-up. Frequency and log-probability: the largest error of "
        "the reduced model, relative and absolute, against the full one at draws of the run; far below the "
        "maximum, where the paper's protocol starts, only the frequency matters.\n\n"
        + markdown_table(
            ("run", "steps", "frequency", "log-probability", "learnt", "settings"), rows, words=(0, 1, 4, 5)
        )
    )


def _count(value: Any) -> Any:
    """Return a setting unchanged, unless it is a list of mixture components. Then return their number as text."""
    is_long = any(mapping_in(one) is not None for one in list_in(value) or [])
    return f"{len(value)}, at the maxima" if is_long else value


def _brief(name: str, value: Any) -> list[str]:
    """Return a list of texts: the name and value of each number, and the name and shape of each array.

    Values of other types are left out.
    """
    table, several, number = mapping_in(value), list_in(value), number_in(value)
    if table is not None:
        return [words for key, item in table.items() for words in _brief(key, item)]
    if several is not None:
        row = list_in(several[0]) if several else None
        return [f"{name}: {len(several) if row is None else f'{len(several)} × {len(row)}'} numbers"]
    return [] if number is None else [f"{name} {significant(number, 3)}"]
