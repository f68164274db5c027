"""Report sections on how well the posterior predicts the measurements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.held_out.modes import NOT_USED, REFIT, WEIGHTS, leave_one_out
from fmu.analysis.held_out.prediction import NEITHER
from fmu.analysis.held_out.weights import FEWEST
from fmu.analysis.prediction import (
    as_replicates,
    measured_tests,
    measurement_in_words,
)
from fmu.analysis.repeatability import repeatability_warnings
from fmu.analysis.trace.conversion import NEW_MEASUREMENT
from fmu.analysis.trace.reading import (
    array_of,
    has,
    is_pseudo,
    mode_names,
    modes_are_data,
    problem_of,
    used_modes,
)
from fmu.numbers import MISSING, change, decimals, fixed, given, interval, significant, with_sd
from fmu.report.document import Items, Omitted, PageSection, PageTable, Part, Pictures, Text, picture
from fmu.report.plots.frequencies import plot_left_out, plot_predictive_check
from fmu.report.run import ReportedRun
from fmu.report.sections.updating import NO_FREQUENCIES
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

HOW = {
    REFIT: "updated without it",
    WEIGHTS: "importance weights",
    NOT_USED: "not used in updating",
    NEITHER: "not done",
}
NO_NOISE = (
    "the modal residual is a pseudo-likelihood without measurement noise, so no measurement can be predicted"
)
NO_DATA = "the modes are no data, the parameters are updated with frequency response functions alone"


def predictive(run: ReportedRun) -> PageSection | Omitted:
    """Return the section that compares the measured frequencies with their posterior predictive distributions.

    Return `Omitted` if the trace has no frequencies, they are not used in updating, or no noise is modelled.
    """
    title, table = "Posterior predictive check", run.prediction
    if table is None:
        return Omitted(title, NO_FREQUENCIES)
    if "noisy_sd" not in table:
        return Omitted(title, NO_NOISE)
    if not modes_are_data(run.trace):
        return Omitted(title, NO_DATA)
    used, is_similar = used_modes(run.trace), "similar_sd" in table
    table = as_replicates(table, used)
    replicate = array_of(run.trace, "posterior_predictive", "frequency")
    if is_similar:
        replicate = np.where(used, replicate, array_of(run.trace, "posterior_predictive", NEW_MEASUREMENT))
    below = (replicate < table["measured"].to_numpy()).mean(axis=(0, 1))
    distance = (table["measured"] - table["mean"]) / table["noisy_sd"]
    inside = (table["measured"] >= table["noisy_eti90_lb"]) & (table["measured"] <= table["noisy_eti90_ub"])
    rows = tuple(
        (name, given(table.loc[mode, 'measured']), fixed(float(distance[mode]), 2), fixed(float(p), 3),
         "yes" if inside[mode] else "no")
        for name, mode, p in zip(mode_names(run.trace), table.index, below, strict=True)
    )  # fmt: skip
    header = ("mode", "measured, Hz", "distance, sd", "share predicted below", "in the 90 % interval")
    parts_of_model = _with_and_without(table, mode_names(run.trace)) if _has_discrepancy(run.trace) else ()
    tests = measured_tests(run.trace)
    new = "a new measurement" if tests is None else f"a new measurement, {measurement_in_words(tests)}"
    caption = f"Measured frequencies and the predictive distribution of {new}, noise included."
    if is_similar:
        caption += (
            " For modes used in updating it is of a similar structure, with errors of the model of its own: those "
            "of this structure are inferred from the same data."
        )
    seen = "; ".join(f"mode {mode} {fixed(float(d), 2)}" for mode, d in distance.items())
    alt = (
        f"Distance of the measured frequencies from the predicted mean in predictive standard deviations: {seen}."
    )
    look = "Measured frequencies in their predictive distributions. Look for diamonds outside the bars."
    drawing = picture(plot_predictive_check(run.trace), "check", alt, look)
    n, k = int(used.sum()), int(inside[used].sum())
    said = (
        f"{k} of {n} measured frequencies{'' if used.all() else ' used in updating'} lie in the 90 % interval of "
        "their prediction. The same data were used for updating: a mode outside speaks against the model, one "
        "inside confirms little."
    )
    if not used.all():
        said += (
            f" Of the modes not used in updating, which test the model, {int(inside[~used].sum())} of "
            f"{int((~used).sum())} lie in it."
        )
    parts: tuple[Part, ...] = (Text(said), PageTable(caption, header, rows, words=(4,)), *parts_of_model)
    parts = (*parts, Pictures((drawing,)))
    if tests is not None:
        parts = (*parts, *_single_tests(run, tests))
    return PageSection("predictive", title, parts)


def _has_discrepancy(trace: xr.DataTree) -> bool:
    return bool(problem_of(trace).get("likelihood", {}).get("discrepancy"))


def _with_and_without(table: pd.DataFrame, names: list[str]) -> tuple[Part, ...]:
    """Return a tuple with one table: the predictions of the model alone, and with model error and noise added."""
    rows = []
    for name, (_, row) in zip(names, table.iterrows(), strict=True):
        n = decimals(float(row["noisy_sd"]))
        alone = interval(row["eti90_lb"], row["eti90_ub"], n)
        rows.append(
            (name, given(row["measured"]), alone, interval(row["noisy_eti90_lb"], row["noisy_eti90_ub"], n))
        )
    caption = (
        "The same predictions by the model alone, as if it were right, and with its error. fmu.predict_modes does "
        "this for modes that were not measured, and for a structure that was changed or damaged."
    )
    header = ("mode", "measured, Hz", "model alone, 90 %, Hz", "with its error and noise, 90 %, Hz")
    return (PageTable(caption, header, tuple(rows)),)


def _single_tests(run: ReportedRun, tests: FloatArray) -> tuple[Part, ...]:
    """Return a tuple with a table that compares repeated tests with the predictive distribution of one more test.

    `tests` (n_tests, n_modes) are the frequencies in Hz, NaN where a mode was not measured. If there are warnings
    about the tests' repeatability, a list of them follows the table. Raise ValueError if the run has no prediction
    of frequencies.
    """
    table = run.prediction
    if table is None:
        raise ValueError("run: must predict frequencies (got none)")
    rows = []
    for (mode, row), made in zip(table.iterrows(), tests.T, strict=True):
        made = made[~np.isnan(made)]
        low, high = row["test_eti90_lb"], row["test_eti90_ub"]
        s = float(made.std(ddof=1))
        n = decimals(s / np.sqrt(len(made)))
        inside = int(np.sum((made >= low) & (made <= high)))
        mean = interval(row["noisy_eti90_lb"], row["noisy_eti90_ub"], n)
        rows.append(
            (str(mode), str(len(made)), fixed(s, n), mean, interval(low, high, n), f"{inside} of {len(made)}")
        )
    header = (
        "mode", "tests", "scatter s, Hz", "90 % for the mean of as many tests, Hz", "90 % for one more test, Hz",
        "tests inside that",
    )  # fmt: skip
    caption = (
        "The likelihood is of the mean of the tests, whose error is s/√n. A further test scatters by s about "
        "the structure's frequency (Student's t, because s is estimated from n tests)."
    )
    parts: tuple[Part, ...] = (PageTable(caption, header, tuple(rows)),)
    doubts = repeatability_warnings(run.trace)
    return (*parts, Items(tuple(doubts))) if doubts else parts


def left_out(run: ReportedRun) -> PageSection | Omitted:
    """Return the section on predicting each measured mode from the other modes.

    Return `Omitted` if the trace has no likelihood of single modes or only a pseudo-likelihood, if the modes are
    not used in updating, or if the draws are too few or do not move.
    """
    title = "Leave-one-mode-out check"
    if not has(run.trace, "log_likelihood"):
        return Omitted(title, "the trace has no likelihood of single modes")
    if is_pseudo(run.trace):
        return Omitted(title, NO_NOISE)
    if not modes_are_data(run.trace):
        return Omitted(title, NO_DATA)
    posterior = run.trace["posterior"]
    if posterior.sizes["chain"] * posterior.sizes["draw"] < FEWEST or run.summary["ess_bulk"].isna().all():
        return Omitted(title, "there are too few draws, or they do not move")
    table = leave_one_out(run.trace)
    names = mode_names(run.trace)
    rows = tuple(_left_out_row(name, row) for name, (_, row) in zip(names, table.iterrows(), strict=True))
    header = ("mode", "measured, Hz", "predicted, 90 %, Hz", "prior sd, Hz", "p", "elpd, nats", "how")
    caption = (
        "Each measured frequency and its prediction from the other modes used in updating, measurement noise "
        "included. Prior sd: standard deviation of the same prediction before updating. p: probability of a "
        "measurement that lies at least as far out on either side. elpd: log-density of what was measured of the "
        f"mode ({_compared_quantity(run.trace)}), given the others."
    )
    done = table["method"] != NEITHER
    parts: list[Part] = [PageTable(caption, header, rows, words=(6,))]
    if done.any() and table["mean"].notna().any():
        seen = "; ".join(
            f"mode {name} {change(float(mean) / float(measured) - 1)}"
            for name, mean, measured in zip(names, table["mean"], table["measured"], strict=True)
            if np.isfinite(mean)
        )
        look = "Errors of each frequency predicted by the other modes. Look for bars that miss zero."
        drawing = picture(plot_left_out(run.trace), "left-out", f"Errors of the predictions: {seen}.", look)
        parts.append(Pictures((drawing,)))
    unknown = [name for name, is_done in zip(names, done, strict=True) if not is_done]
    if unknown:
        few = f"modes {', '.join(unknown)}" if len(unknown) > 1 else f"mode {unknown[0]}"
        why = (
            f"Nothing is known of {few}: without the mode the posterior is so different that the draws do not "
            "cover it, and updating without it would have taken long or its weights were not reliable. "
            "fmu.leave_one_out(trace, problem) takes the time."
        )
        parts.insert(0, Items((why,)))
    return PageSection("loo", title, tuple(parts))


def _compared_quantity(trace: xr.DataTree) -> str:
    """Return a phrase that names the measured quantities in a mode's log-likelihood."""
    return "frequency" if has(trace, "log_likelihood", "frequency") else "all that is compared"


def _left_out_row(mode: str, row: pd.Series) -> tuple[str, ...]:
    sd = float(row["sd"])
    n = decimals(sd) if np.isfinite(sd) else 0
    known = np.isfinite(row["elpd"])
    elpd = with_sd(float(row["elpd"]), float(row["mcse_elpd"])) if known else MISSING
    where = interval(row["eti90_lb"], row["eti90_ub"], n) if np.isfinite(sd) else MISSING
    p = significant(float(row["p"]), 2) if np.isfinite(row["p"]) else MISSING
    prior = significant(float(row["prior_sd"]), 2) if np.isfinite(row["prior_sd"]) else MISSING
    return (mode, given(float(row["measured"])), where, prior, p, elpd, HOW[str(row["method"])])
