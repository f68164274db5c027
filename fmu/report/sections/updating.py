"""Report sections on updating results: parameters, frequencies, posterior maxima and evidence."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fmu.analysis.convergence.remedies import MCSE_OF_ENDS, without_scores
from fmu.analysis.evidence import PSEUDO, WHAT, found_evidences
from fmu.analysis.information import PRIOR, information
from fmu.analysis.maxima.missed import Visits, visits
from fmu.analysis.maxima.results import MOST_SHOWN, NEGLIGIBLE, Maxima, share_of_mass
from fmu.analysis.prediction import measured_tests, measurement_in_words, pinned_parameters
from fmu.analysis.trace.reading import constant, is_pseudo, mode_names, modes_are_data, walkers_of
from fmu.numbers import (
    MISSING,
    change,
    customary_unit,
    decimals,
    fixed,
    given,
    given_decimals,
    hertz,
    interval,
    names_in_words,
    round_by_sd,
    share,
    significant,
    whole,
)
from fmu.report.document import Items, Omitted, PageSection, PageTable, Part, Pictures, Text, picture
from fmu.report.plots.frequencies import frequencies_before, plot_frequency_updates
from fmu.report.plots.parameters import plot_parameter_updates
from fmu.report.run import ReportedRun
from fmu.types import FloatArray

LOOK_AT_FREQUENCIES = (
    "Errors of the model's frequencies. Look for bars that miss zero: modes that the model cannot follow, "
    "whatever its parameters."
)
NO_FREQUENCIES = "the trace holds no frequencies to compare with measured ones"
NOT_DATA = (
    "The measured frequencies are no data: the updating follows the frequency response functions. They are the "
    "resonances that were picked from these, or were given to begin the search."
)


def parameters(run: ReportedRun) -> PageSection:
    """Return the section that compares the updated parameters with their priors, bounds and start values.

    Parameters that the data did not inform are shown in grey.
    """
    found = information(run.trace)
    rows, greyed, seen, stopped = [], [], [], pinned_parameters(run.trace)
    for k, name in enumerate(run.names):
        unit = run.unit(name)
        start, lower, upper = (constant(run.trace, c, name) / unit.factor for c in ("start", "lower", "upper"))
        mean, sd, low, high = (run.value(name, c) for c in ("mean", "sd", "eti90_lb", "eti90_ub"))
        n = decimals(sd)
        bounds = interval(lower, upper, n) if np.isfinite([lower, upper]).any() else "none"
        moved = change(mean / start - 1) if start else MISSING
        if found and not found.informed[k]:
            greyed.append(k)
            moved = PRIOR
        basis = "data and bound" if name in stopped and found and found.informed[k] else found and found.basis[k]
        told = (basis,) if basis else ()
        rows.append(
            (
                name, unit.name or MISSING, run.priors.get(name, MISSING), bounds, fixed(start, n), fixed(mean, n),
                interval(low, high, n), fixed(sd, n), moved, *told,
            )
        )  # fmt: skip
        words = f"{name} {fixed(mean, n)} {unit.name} ({interval(low, high, n)})".replace("  ", " ")
        words += " from the prior" if k in greyed else ""
        seen.append(f"{words}, start {fixed(start, n)}, bounds {bounds}")
    header: tuple[str, ...] = (
        "parameter", "unit", "prior", "bounds", "start", "mean", "90 % interval", "sd", "change",
        *(("determined by",) if found else ()),
    )  # fmt: skip
    caption = "Posterior of the parameters."
    if greyed:
        caption = (
            "Posterior of the parameters. Grey: not informed by the data (contraction below 0.3). What is shown "
            "there is the prior, whose mean may differ from the start, and no change. Combination: the data "
            "inform it only together with others."
        )
    caption += f" {_error_of_ends(run)}"
    of_words = (1, 2) if found is None else (1, 2, 9)
    parts: list[Part] = [PageTable(caption, header, tuple(rows), of_words, tuple(greyed))]
    maximum = run.maxima[0].theta if run.maxima else None
    axes = plot_parameter_updates({run.name: run.trace}, maximum=maximum, summaries={run.name: run.summary})
    drawing = picture(axes, "updates", f"Posterior means with 90 % intervals. {'; '.join(seen)}.",
                      "Means and 90 % intervals between the bounds.")  # fmt: skip
    return PageSection("parameters", "Updated parameters", (*parts, Pictures((drawing,))))


def _error_of_ends(run: ReportedRun) -> str:
    """Return a sentence on the largest Monte Carlo error of the interval ends, relative to the parameter's sd.

    If the error is unknown for any parameter, the sentence says that it is unknown.
    """
    table = without_scores(run.summary)
    errors = table[list(MCSE_OF_ENDS)].max(axis=1, skipna=False) / table["sd"]
    if errors.isna().any():
        return "The Monte Carlo error of the ends of the intervals is unknown."
    name = str(errors.idxmax())
    largest = significant(float(errors[name]), 2)
    return f"The ends of the intervals have a Monte Carlo error of at most {largest} sd ({name})."


def frequencies(run: ReportedRun) -> PageSection | Omitted:
    """Return the section that compares the measured frequencies with the model before and after updating.

    Return `Omitted` if the trace has no frequencies.
    """
    title, table = "Frequencies", run.prediction
    if table is None:
        return Omitted(title, NO_FREQUENCIES)
    before = frequencies_before(run.trace)
    before = np.full(len(table), np.nan) if before is None else before
    are_data, tests = modes_are_data(run.trace), measured_tests(run.trace)
    is_noisy = "noisy_sd" in table and are_data
    has_tests = "test_eti90_lb" in table and are_data
    rows, seen = [], []
    for mode, (_, row), f in zip(mode_names(run.trace), table.iterrows(), before, strict=True):
        n = max(1, decimals(row["sd"]), given_decimals(row["measured"]))
        errors = [change(value / row["measured"] - 1) for value in (f, row["mean"])]
        of_noise = max(1, decimals(row["noisy_sd"]), given_decimals(row["measured"])) if is_noisy else n
        noisy = interval(row["noisy_eti90_lb"], row["noisy_eti90_ub"], of_noise) if is_noisy else MISSING
        single = (interval(row["test_eti90_lb"], row["test_eti90_ub"], of_noise),) if has_tests else ()
        rows.append(
            (
                mode, given(row["measured"]), fixed(f, n), errors[0], fixed(row["mean"], n),
                errors[1], interval(row["eti90_lb"], row["eti90_ub"], n), noisy, *single,
            )
        )  # fmt: skip
        seen.append(f"mode {mode} {errors[0]} before, {errors[1]} after")
    header: tuple[str, ...] = (
        "mode", "measured, Hz", "before, Hz", "error before", "after, Hz", "error after",
        "90 %, without noise, Hz", "90 %, with noise, Hz",
    )  # fmt: skip
    caption = (
        "After: posterior mean of the model's frequency. 90 % intervals: without noise, of the model's "
        "frequency; with noise, of a new measurement."
    )
    if has_tests:
        header = (*header[:-1], "90 %, mean of tests, Hz", "90 %, one more test, Hz")
        caption = (
            "After: posterior mean of the model's frequency. 90 % intervals: without noise, of the model's "
            f"frequency; of a new measurement, {measurement_in_words(tests)}; and of one more test."
        )
    if not are_data:
        header, rows = header[:-1], [row[:-1] for row in rows]
        caption = "After: posterior mean of the model's frequency, and its 90 % interval."
    if np.isnan(before).all():
        caption += " The trace has no frequencies before updating."
    axes = plot_frequency_updates(run.trace)
    drawing = picture(axes, "frequencies", f"Errors of the frequencies: {'; '.join(seen)}.",
                      LOOK_AT_FREQUENCIES)  # fmt: skip
    return PageSection(
        "frequencies",
        title,
        (
            Text(f"{_mean_error(run, before)}{'' if are_data else f' {NOT_DATA}'}"),
            PageTable(caption, header, tuple(rows)),
            Pictures((drawing,)),
        ),
    )


def _mean_error(run: ReportedRun, before: FloatArray) -> str:
    """Return sentences on the mean frequency error before and after updating, and on modes that became worse.

    If a frequency before updating is unknown, only the error after updating is given. Raise ValueError if the run
    has no prediction of frequencies.
    """
    table = run.prediction
    if table is None:
        raise ValueError("run: must predict frequencies (got none)")
    measured = table["measured"].to_numpy()
    after, was = (np.abs(hz / measured - 1.0) for hz in (table["mean"].to_numpy(), before))
    said = f"Mean error of the frequencies after updating: {share(float(after.mean()))}."
    if np.isfinite(was).all():
        means = (share(float(error.mean())) for error in (was, after))
        said = "Mean error of the frequencies: {} before updating, {} after.".format(*means)
        worse = [name for name, is_worse in zip(mode_names(run.trace), after > was, strict=True) if is_worse]
        said += (
            f" Worse after updating: mode{'s' if len(worse) > 1 else ''} {names_in_words(worse)}." if worse else ""
        )
    return said


def maxima(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on the posterior maxima, which correspond to deterministic updating.

    Return `Omitted` if the trace has none.
    """
    title = "Posterior maxima: deterministic updating"
    if run.maxima is None:
        return Omitted(title, "the trace has none; fmu run searches for them before sampling")
    found = run.maxima
    n = sum(m.is_maximum for m in found)
    count = "One maximum was found." if n == 1 else f"{n} maxima were found, the highest first."
    if not n:
        count = "No maximum was found."
    if n < len(found):
        count += f" The search ended at {len(found) - n} other place{'' if len(found) - n == 1 else 's'}."
    runs = sum(m.starts for m in found)
    lead = (
        f"{count} Share: part of the posterior probability. Starts: how many of the {runs} optimiser runs ended "
        "there."
    )
    seen = visits(run.trace, found)
    several = sum(m.share > NEGLIGIBLE for m in found) > 1
    said = [*([_crossings(run, seen)] if several else []), *found.no_maxima(), *found.at_bounds()]
    if len(found) > MOST_SHOWN:
        said.append(f"The other {len(found) - MOST_SHOWN} are lower; map.csv lists them.")
    parts: tuple[Part, ...] = (Text(lead), _maxima_table(run, found, seen))
    if said:
        parts = (*parts, Items(tuple(said)))
    return PageSection("maxima", title, parts)


def _crossings(run: ReportedRun, seen: Visits) -> str:
    """Return a sentence on how often the chains crossed between maxima."""
    fewest, most = (whole(n) for n in (seen.crossings.min(), seen.crossings.max()))
    each = "ensemble" if walkers_of(run.trace) > 1 else "chain"
    often = fewest if fewest == most else f"{fewest} to {most}"
    return f"Each {each} crossed between maxima {often} {'time' if often == '1' else 'times'}."


def _maxima_table(run: ReportedRun, found: Maxima, seen: Visits) -> PageTable:
    """Return a table that compares the highest maxima with the start, the posterior mean and the measurement."""
    best = found.maxima[:MOST_SHOWN]
    names = tuple(found.title(k) for k in range(len(best)))
    nothing = (MISSING,) * 2
    rows = [
        ("log-probability", "nats", MISSING, *(round_by_sd(m.log_prob, 1.0) for m in best), *nothing),
        ("share", "", MISSING, *(share_of_mass(m.share) for m in best), *nothing),
        ("starts", "", MISSING, *(str(m.starts) for m in best), *nothing),
    ]
    if len(found) > 1:
        rows.insert(2, ("share of the draws", "", MISSING, *_shares_of_draws(seen)[: len(best)], *nothing))
    for k, (name, si) in enumerate(zip(found.names, found.units, strict=True)):
        unit = customary_unit(si)
        n = decimals(run.value(name, "sd"))
        values = [found.start[k], *(m.theta[k] for m in best), float(run.summary["mean"][name])]
        rows.append((name, unit.name, *(fixed(value / unit.factor, n) for value in values), MISSING))
    mean = [np.nan] * len(found.labels) if run.prediction is None else list(run.prediction["mean"])
    for k, label in enumerate(found.labels):
        values = [found.before[k], *(m.frequencies[k] for m in best), mean[k]]
        rows.append((f"mode {label}", "Hz", *hertz(*values, measured=found.measured[k]), given(found.measured[k])))
    header = ("quantity", "unit", "start", *names, "posterior mean", "measured")
    return PageTable(
        "Model at the start, at the maxima and at the posterior mean", header, tuple(rows), words=(1,)
    )


def _shares_of_draws(seen: Visits) -> list[str]:
    """Return each maximum's share of the draws as text, with its Monte Carlo error if the error is positive."""
    return [
        f"{share(part)} ± {share(error)}" if error > 0 else share(part)
        for part, error in zip(seen.share, seen.error, strict=True)
    ]


def evidence(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on one run's evidence, or `Omitted`; see `evidences`."""
    return evidences({run.name: run})


def evidences(runs: Mapping[str, ReportedRun]) -> PageSection | Omitted:
    """Return the section on all estimates of the log-evidence, with the method, error and reliability of each.

    Return `Omitted` if there are none.
    """
    title = "Evidence"
    first = next(iter(runs.values()))
    known = [run.maxima for run in runs.values() if run.maxima is not None]
    maxima = max(known, key=lambda found: found.log_evidence, default=None)
    found = found_evidences(
        {name: run.trace for name, run in runs.items()},
        {name: run.diagnosis for name, run in runs.items()},
        maxima,
    )
    if not found:
        nothing = "no maxima are known, and there is no run of parallel tempering"
        return Omitted(title, PSEUDO if is_pseudo(first.trace) else nothing)
    rows = tuple((f"{one.method[0].upper()}{one.method[1:]}", one.value, one.is_reliable) for one in found)
    table = PageTable(
        "Natural logarithm, ± its standard error", ("from", "log-evidence", "reliable"), rows, words=(2,)
    )
    return PageSection("evidence", title, (Text(WHAT), table))
