"""Compare models of the same data by their evidence, and by how well they predict each mode from the others."""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from fmu.analysis.convergence.diagnosis import Diagnosis, diagnose_all, maxima_of
from fmu.analysis.evidence import PSEUDO, found_evidences
from fmu.analysis.fit.check import RESIDUALS
from fmu.analysis.frf.predictions import GROUP as FRFS
from fmu.analysis.held_out.modes import kept_table
from fmu.analysis.held_out.prediction import NEITHER
from fmu.analysis.trace.misfit import GROUP, QUANTITIES
from fmu.analysis.trace.reading import check_trace, has, is_pseudo, problem_of
from fmu.arguments import ArgumentError
from fmu.numbers import fixed, names_in_words, share, significant, whole, with_sd
from fmu.tables import data_frame, text_table, wrap_text

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

CLEAR = 2.0
"""Number of standard errors beyond which a difference is called clear."""
NO_ESTIMATE = 'no sampler with an estimate of the evidence has drawn from it: sample with "mixture" or "tempering"'
_HEADINGS = {
    "log_evidence": "log-evidence",
    "error": "±",
    "difference": "to the best",
    "probability": "probability",
    "inside": "held out, inside",
    "sum_z2": "Σ z²",
    "elpd": "elpd",
    "elpd_se": "± ",
    "p": "p of χ²",
    "verdict": "data and model",
    "wall_s": "time, s",
}


@dataclass(frozen=True, eq=False)
class ModelComparison:
    """Comparison of several models of the same data.

    Attributes
    ----------
    table : pandas.DataFrame
        One row per model, with the columns that `fmu.compare_models` describes.
    sentences : tuple of str
        Sentences that interpret the table and state its limits.
    """

    table: pd.DataFrame
    sentences: tuple[str, ...]

    def rows(self) -> list[list[str]]:
        """Return the table cells as text, one list per model, in the order of `headings`."""
        return [[str(name), *_cells(row)] for name, row in self.table.iterrows()]

    @property
    def headings(self) -> list[str]:
        """Column headings of `rows`."""
        return ["model", *_HEADINGS.values()]

    def __str__(self) -> str:
        last = len(self.headings) - 2
        table = text_table(self.headings, self.rows(), words=(0, last))
        return "\n".join([table, "", *(wrap_text(one, "- ", "  ") for one in self.sentences)])

    def _repr_html_(self) -> str:
        said = "".join(f"<li>{html.escape(one)}</li>" for one in self.sentences)
        return f"{self.table.to_html(float_format=partial(significant, digits=4))}<ul>{said}</ul>"


def compare_traces(traces: Mapping[str, xr.DataTree]) -> ModelComparison:
    """Compare models, given one trace per model; see `fmu.compare_models`.

    Raise ValueError unless there are two or more traces of updating problems, with the same data.
    """
    if len(traces) < 2:
        raise ArgumentError("models", "must be two or more", len(traces))
    for name, trace in traces.items():
        check_trace(trace, f"models.{name}")
    require_same_data(traces)
    verdicts = {name: diagnose_all({name: trace})[name] for name, trace in traces.items()}
    held_out = common_modes(traces)
    rows, doubts = [], {}
    for name, trace in traces.items():
        evidence, doubts[name] = _evidence(name, trace, verdicts[name])
        rows.append(_row(trace, verdicts[name], evidence, held_out.get(name)))
    table = data_frame(rows, "model", list(traces))
    table["difference"] = table["log_evidence"] - table["log_evidence"].max()
    weight = np.exp(table["difference"])
    table["probability"] = weight / weight.sum()
    return ModelComparison(table, tuple(_sentences(table, doubts, held_out)))


def require_same_data(traces: Mapping[str, xr.DataTree]) -> None:
    """Raise ValueError unless all traces have the same measured modes, FRFs and quantities, used in the same way.

    The errors must also have the same unit in all traces (`_data`). A trace without measured data is refused, too.
    """
    first, *others = traces
    for name in traces:
        if not has(traces[name], "observed_data"):
            rule = "must be of an updating problem with measured modes (it has no measured data)"
            raise ArgumentError(f"models.{name}", rule)
    for name in others:
        one, other = _data(traces[first]), _data(traces[name])
        different = [key for key in one if one[key] != other[key]]
        if different:
            rule = (
                f"must have the same data as {first}, or the evidences cannot be compared; different: "
                f"{names_in_words(different)}"
            )
            got = f"{_shorten(other[different[0]])}, {first} has {_shorten(one[different[0]])}"
            raise ArgumentError(f"models.{name}", rule, got)


def _data(trace: xr.DataTree) -> dict[str, object]:
    """Return the properties on which the compared models must agree, keyed by description.

    These are the measured frequencies and mode shapes, FRFs, masses and displacements, which of them are used
    in updating, the kinds of quantities that are compared with the model, and the unit of the errors.
    """
    observed, configured = trace["observed_data"].to_dataset(), problem_of(trace)
    modes = map(str, observed["mode"].to_numpy().tolist())
    used = observed["used"].to_numpy().tolist() if "used" in observed else []
    found: dict[str, object] = {
        "modes": list(modes),
        "frequencies": observed["frequency"].to_numpy().tolist(),
        "modes used in updating": used if not all(used) else [],
        "measured shapes": json.dumps(configured.get("data", {}).get("shapes")),
        "masses and displacements": [],
        "FRFs": [],
        "values of FRFs used in updating": [],
        "quantities compared": [],
    }
    if has(trace, QUANTITIES):
        found["masses and displacements"] = trace[QUANTITIES]["measured"].to_numpy().tolist()
    if has(trace, FRFS):
        frfs = trace[FRFS]
        found["FRFs"] = list(map(str, frfs["frf"].to_numpy().tolist()))
        of_frf, at_line = np.nonzero(frfs["used"].to_numpy())
        hz, values = frfs["line"].to_numpy()[at_line], frfs["measured"].to_numpy()[of_frf, at_line]
        found["values of FRFs used in updating"] = np.column_stack([hz, values]).tolist()
    if has(trace, GROUP):
        group = trace[GROUP]
        compared = [*map(str, group["quantity"].to_numpy().tolist()), *str(group.attrs["other"]).split(", ")]
        found["quantities compared"] = sorted(filter(None, compared))
    errors = configured.get("likelihood", {}).get("errors", ())
    of_eigenvalues = any(one.get("error") == "eigenvalue frequency" for one in errors)
    found["unit of the errors"] = "relative eigenvalues" if of_eigenvalues else "Hz"
    return found


def _shorten(value: object) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _evidence(name: str, trace: xr.DataTree, verdict: Diagnosis) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Return a model's most reliable log-evidence with its standard error, and the reasons to doubt it.

    Both numbers are NaN if the evidence is unknown; the reason then says why.
    """
    if is_pseudo(trace):
        return (np.nan, np.nan), (PSEUDO,)
    found = found_evidences({name: trace}, {name: verdict}, maxima_of(trace))
    known = [one for one in found if np.isfinite(one.log_evidence)]
    if not known:
        return (np.nan, np.nan), (NO_ESTIMATE,)
    best = min(known, key=lambda one: (len(one.doubts), one.error))
    return (best.log_evidence, best.error), best.doubts


def common_modes(traces: Mapping[str, xr.DataTree]) -> dict[str, pd.DataFrame]:
    """Return each model's `fmu.leave_one_out` rows of the modes that all models predict, keyed by model name.

    Models without this table are left out.
    """
    tables = {name: kept_table(trace) for name, trace in traces.items()}
    known = {name: table for name, table in tables.items() if table is not None}
    if not known:
        return {}
    predicted = [
        set(table.index[(table["method"] != NEITHER) & np.isfinite(table["sd"])]) for table in known.values()
    ]
    common = set.intersection(*predicted)
    return {name: table.loc[[mode for mode in table.index if mode in common]] for name, table in known.items()}


def _row(
    trace: xr.DataTree, verdict: Diagnosis, evidence: tuple[float, float], held_out: pd.DataFrame | None
) -> dict[str, object]:
    residuals = [check.p for check in verdict.fit.checks if check.kind == RESIDUALS]
    n = 0 if held_out is None else len(held_out)
    row: dict[str, object] = {
        "log_evidence": evidence[0],
        "error": evidence[1],
        "difference": np.nan,
        "probability": np.nan,
        "n_parameters": verdict.fit.n_parameters,
        "held_out": n,
        "inside": 0,
        "sum_z2": np.nan,
        "elpd": np.nan,
        "elpd_se": np.nan,
        "p": residuals[0] if residuals else np.nan,
        "verdict": verdict.fit.answer,
        "converged": verdict.converged,
        "wall_s": float(trace.attrs["wall_s"]),
    }
    if held_out is not None and n:
        z = (held_out["measured"] - held_out["mean"]) / held_out["sd"]
        inside = (held_out["measured"] >= held_out["eti90_lb"]) & (held_out["measured"] <= held_out["eti90_ub"])
        elpd = held_out["elpd"].to_numpy()
        row |= {"inside": int(inside.sum()), "sum_z2": float((z**2).sum())}
        row |= {"elpd": float(elpd.sum()), "elpd_se": standard_error(elpd)}
    return row


def standard_error(parts: ArrayLike) -> float:
    """Return the standard error √(n var) of a sum over n modes (Vehtari, Gelman & Gabry 2017, eq. 23).

    The result is NaN for fewer than two modes.
    """
    values = np.asarray(parts, dtype=float)
    return float(np.sqrt(len(values) * np.var(values, ddof=1))) if len(values) > 1 else np.nan


def _cells(row: pd.Series) -> list[str]:
    n = int(row["held_out"])
    return [
        fixed(row["log_evidence"], 2),
        significant(row["error"], 2),
        fixed(row["difference"], 2),
        share(row["probability"]) if np.isfinite(row["probability"]) else fixed(np.nan, 0),
        f"{int(row['inside'])} of {n}" if n else fixed(np.nan, 0),
        significant(row["sum_z2"]),
        fixed(row["elpd"], 1),
        significant(row["elpd_se"], 2),
        significant(row["p"], 2),
        str(row["verdict"]),
        fixed(row["wall_s"], 1),
    ]


def _sentences(
    table: pd.DataFrame, doubts: Mapping[str, Sequence[str]], held_out: Mapping[str, pd.DataFrame]
) -> list[str]:
    """Return sentences on the evidences, the left-out modes, missing values, and doubts about the evidences."""
    said = [*_of_evidences(table), *_of_held_out(table, held_out)]
    for name, reasons in doubts.items():
        if not np.isfinite(table["log_evidence"][name]):
            said.append(f"{name} has no evidence: {reasons[0]}.")
        elif reasons:
            said.append(f"The evidence of {name} is not reliable: {'; '.join(reasons)}.")
    wrong = [str(name) for name in table.index if not table["converged"][name]]
    if wrong:
        said.append(f"Not converged: {names_in_words(wrong)}. The numbers of such a model are provisional.")
    return said


def _of_evidences(table: pd.DataFrame) -> list[str]:
    known = table[np.isfinite(table["log_evidence"])].sort_values("log_evidence", ascending=False)
    if len(known) < 2:
        return []
    first, second = map(str, known.index[:2])
    lead = float(known["log_evidence"].iloc[0] - known["log_evidence"].iloc[1])
    error = float(np.hypot(*known["error"].iloc[:2]))
    if lead <= CLEAR * error:
        which = f"The evidences of {first} and {second} do not differ by more than their errors"
    else:
        which = (
            f"The data are {_times(lead)} as probable under {first} as under {second}, the next best "
            f"(log-evidences {with_sd(known['log_evidence'].iloc[0], known['error'].iloc[0])} and "
            f"{with_sd(known['log_evidence'].iloc[1], known['error'].iloc[1])})"
        )
    some = "" if len(known) == len(table) else ", of the models with an evidence"
    chances = ", ".join(f"{name} {share(table['probability'][name])}" for name in known.index)
    return [
        f"{which}. Probabilities, if all were equally probable before the test{some}: {chances}. They depend on "
        "the priors of all parameters, and none of the models need be right."
    ]


def _times(log_ratio: float) -> str:
    """Format a probability ratio, given its logarithm, as ``"16 000 times"`` or as a power of ten."""
    if log_ratio < np.log(1e6):
        ratio = np.exp(log_ratio)
        rounded = round(ratio, 1 - int(np.floor(np.log10(ratio))))
        return f"{significant(ratio, 2) if rounded < 100 else whole(rounded)} times"
    return f"about 10^{whole(round(log_ratio / np.log(10.0)))} times"


def _of_held_out(table: pd.DataFrame, held_out: Mapping[str, pd.DataFrame]) -> list[str]:
    if len(held_out) < 2:
        return []
    names = list(held_out)
    n = len(held_out[names[0]])
    if n == 0:
        return ["No mode was predicted from the others by all models."]
    counts = ", ".join(f"{name} {int(table['inside'][name])}" for name in names)
    said = [
        f"Each of {n} modes predicted from the others: measured frequencies inside their 90 % intervals, of {n}: "
        f"{counts}; {significant(0.9 * n, 2)} are expected."
    ]
    order = table.loc[names, "elpd"].dropna().sort_values(ascending=False)
    if len(order) > 1 and n > 1:
        first, second = map(str, order.index[:2])
        parts = held_out[first]["elpd"].to_numpy() - held_out[second]["elpd"].to_numpy()
        lead, error = float(parts.sum()), standard_error(parts)
        clear = "clearly " if lead > CLEAR * error else "not clearly "
        said.append(
            f"{first} predicts the modes best, {clear}better than {second}: the expected log predictive "
            f"densities (elpd) differ by {with_sd(lead, error)}."
        )
    return said
