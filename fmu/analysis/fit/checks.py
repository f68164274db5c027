"""Checks of a model against data, with a common false-alarm rate.

Under a correct model, the parameters are draws from their priors and the errors are draws from the error model.
Each kind of check that applies to a run gets an equal part of the level `LEVEL`, and the checks of one kind divide
this part equally (Bonferroni). A correct model therefore fails at least one check with a probability of at most
`LEVEL`, however the checks depend on each other. With a population the level is `WITH_POPULATIONS`. Checks of
laws, which relate a parameter's values in different tests, then get `OF_POPULATIONS`, and the other kinds equal
parts of the rest. In the following list of the kinds of check, α is the level of a single check:

- A mode predicted from the other modes, and a mode that was held out. The statistic is the tail probability of the
  measured frequency in the predictive distribution that was computed without this mode, noise included. Under a
  correct model this probability is exactly uniform (Gelfand, Dey & Chang 1992, *Bayesian Statistics* 4, 147–167;
  Marshall & Spiegelhalter 2007, *Bayesian Analysis* 2, 409–444).
- Residuals. Let r be the standardised residuals at one posterior draw. Under a correct model, Σ r² has exactly the
  chi-square distribution, with as many degrees of freedom as there are data, because the true parameters and a
  posterior draw have the same joint distribution with the data (Johnson 2004, *Ann. Statist.* 32, 2361–2384). At
  one draw, P(χ² ≥ Σ r²) is therefore uniform. Its mean over the draws is the posterior predictive p-value, which
  is at most α/2 with a probability of at most α (Meng 1994, *Ann. Statist.* 22, 1142–1160; Rüschendorf 1982, *Adv.
  Appl. Probab.* 14, 623–632). It is compared with α/2. This bound is conservative: with k parameters fitted to n
  data, Σ r² is about k plus a χ²(n − k) variable, and false alarms are rarer than α. If the standard deviations
  come from the scatter of repeated tests, r are normal scores (`fmu.posterior.data.repeated`).
- One of several tests. The statistic is Σ r² over this test's residuals, and p is computed in the same way.
- Inferred standard deviations. At one posterior draw, the prior probability of a larger standard deviation is
  uniform, by the same argument, and its mean over the draws is compared with α/2. If the noise had to grow to
  absorb a misfit of the model, the check fails, provided that the prior is informative. With a wide prior it
  cannot fail.
- A weighed mass or a static displacement. The p-value is the mean of P(χ²₁ ≥ r²) over the draws, where r is the
  residual of this datum. It is compared with α/2.
- A frequency response function, and its values that were not used in updating: see `fmu.analysis.frf.check`.
- A population, and a parameter's law: see `fmu.analysis.fit.populations`.
- A mode shape that differs from the measured one: its MAC is below `ALIKE` after updating. This check has no
  level, because no error model is stated for the mode shapes. If the likelihood includes shape errors, they count
  among the residuals instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc, stdtrit

from fmu.analysis.fit.check import (
    HELD_OUT,
    LEVEL,
    NOISE,
    OF_POPULATIONS,
    PREDICTED,
    RESIDUALS,
    SHAPE,
    TEST,
    WITH_POPULATIONS,
    Check,
    beyond,
    factor_to_fail,
    probability,
)
from fmu.analysis.fit.measured_shapes import below, correlations_of, paired_mac, shape_warnings
from fmu.analysis.fit.populations import GROUP as POPULATIONS
from fmu.analysis.fit.populations import effective_parameters, population_checks
from fmu.analysis.fit.quantities import quantity_checks
from fmu.analysis.fit.residual_scores import GROUP as RESIDUAL_SCORES
from fmu.analysis.frf.check import frf_checks, has_held_out, held_out_checks
from fmu.analysis.frf.predictions import GROUP as FRFS
from fmu.analysis.held_out.modes import kept_table
from fmu.analysis.information import CONTRACTED
from fmu.analysis.prediction import measured_tests, measurement_in_words, noise_sd
from fmu.analysis.trace.misfit import GROUP, QUANTITIES, has_scores
from fmu.analysis.trace.modal_states import MEAN
from fmu.analysis.trace.reading import array_of, has, modes_are_data, parameter_units
from fmu.fem.pairing.correlation import ALIKE
from fmu.numbers import apart, given, share, significant, with_sd
from fmu.tables import data_frame
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


_MOST = 10.0
"""A check that fails only for residuals more than this many times as large does not test a model without degrees
of freedom."""
NOT_PREDICTED = "no prediction by the other modes was computed (Python: fmu.leave_one_out(trace, problem))"
_TINY = 1e-300
_GAUSSIAN = 1e8  # degrees of freedom from which Student's distribution is the Gaussian


def checks_of(trace: xr.DataTree) -> list[Check]:
    """Return all checks that have a result; none if the trace has no squared residuals (the modal residual)."""
    of_each, of_laws = _levels(trace)
    found = [check for kind in _kinds(trace) for check in kind(of_each)]
    found += population_checks(trace, of_laws) if _has_laws(trace) else []
    return [check for check in found if np.isfinite(check.p)] + (_shapes(trace) if has(trace, GROUP) else [])


def contradicted_laws(trace: xr.DataTree) -> list[str]:
    """Return a text on each dependence on order, covariate or group that contradicts a parameter's law."""
    if not _has_laws(trace):
        return []
    return [check.dependence for check in population_checks(trace, _levels(trace)[1]) if check.dependence]


def _has_laws(trace: xr.DataTree) -> bool:
    """Return True if the trace stores squared residuals and test scores, which are needed to check laws."""
    return has(trace, GROUP) and (has(trace, POPULATIONS, "score") or has(trace, RESIDUAL_SCORES, "score"))


def _kinds(trace: xr.DataTree) -> list[Callable[[float], list[Check]]]:
    """Return functions, one per kind of check except laws and shapes, that map a significance level to checks."""
    kinds: list[Callable[[float], list[Check]]] = []
    if not has(trace, GROUP):
        return kinds
    if has(trace, "observed_data", "of_test") and trace[GROUP].sizes.get("quantity", 0):
        kinds.append(partial(_tests, trace))
    table = _predictions(trace)
    if table is not None:
        used = table["used"].astype(bool)
        kinds += [partial(_modes, trace, rows) for rows in (table[used], table[~used]) if len(rows)]
    if trace[GROUP].sizes.get("quantity", 0):
        kinds.append(partial(_residuals, trace))
    if has(trace, GROUP, "noise_isf"):
        kinds.append(partial(_noise, trace, table))
    if has(trace, FRFS):
        kinds.append(partial(frf_checks, trace))
        kinds += [partial(held_out_checks, trace)] if has_held_out(trace) else []
    if has(trace, QUANTITIES):
        kinds.append(partial(quantity_checks, trace))
    return kinds


def _levels(trace: xr.DataTree) -> tuple[float, float]:
    """Return two significance levels: one for each kind of check in `_kinds`, one for checks of parameter laws."""
    n = len(_kinds(trace))
    if has(trace, POPULATIONS, "score"):
        return (WITH_POPULATIONS - OF_POPULATIONS) / max(n, 1), OF_POPULATIONS
    of_each = LEVEL / max(n + _has_laws(trace), 1)
    return of_each, of_each


def _predictions(trace: xr.DataTree) -> pd.DataFrame | None:
    """Return a table with a prediction of each mode from the other modes, one row per mode.

    Unknown predictions are NaN. The result is None if the trace has no predicted measurements of frequencies, or
    if the modes are not data.
    """
    if not has(trace, "posterior_predictive", "frequency") or not modes_are_data(trace):
        return None
    kept = kept_table(trace)
    if kept is not None:
        return kept
    measured = trace["observed_data"]["frequency"].to_numpy()
    columns = {"measured": measured, "p": np.full(len(measured), np.nan), "used": np.full(len(measured), True)}
    return data_frame(columns, "mode", trace["observed_data"]["mode"].to_numpy())


def _modes(trace: xr.DataTree, rows: pd.DataFrame, level: float) -> list[Check]:
    """Return a `Check` of each mode by its prediction from the other modes or, without one, by its residuals."""
    return [_mode(trace, str(mode), row, level / len(rows)) for mode, row in rows.iterrows()]


def _mode(trace: xr.DataTree, mode: str, row: pd.Series, level: float) -> Check:
    if not np.isfinite(row["p"]):
        return _check_residual(trace, mode, row, level)
    kind = PREDICTED if row["used"] else HELD_OUT
    measured, mean, sd = float(row["measured"]), float(row["mean"]), float(row["sd"])
    low, high = _limits(row, level)
    low_hz, high_hz, _ = apart(low, high, measured, sd=sd)
    p, below, above = float(row["p"]), low / mean - 1.0, high / mean - 1.0
    by = "the other modes predict" if row["used"] else "the modes used in updating predict"
    sentence = (
        f"mode {mode}{'' if row['used'] else ', not used in updating'}: {given(measured)} Hz was measured"
        f"{_how(trace, mode)}, and "
        f"{by} {with_sd(mean, sd)} Hz, noise included ({probability(p)})"
    )
    before = np.nan_to_num(float(row["prior_sd"]), nan=np.inf)
    # as for informed parameters: the prediction is narrower than the prior's, or little wider than noise
    says = sd < max(np.sqrt(1.0 - CONTRACTED) * before, 2.0 * noise_sd(trace, mode))
    return Check(
        kind,
        f"mode {mode}",
        f"{given(measured)} Hz, predicted {with_sd(mean, sd)} Hz",
        f"{low_hz} to {high_hz} Hz",
        p,
        p < level,
        f"errors {beyond(below, above)} of its frequency",
        sentence,
        ""
        if says
        else f"the {'other' if row['used'] else 'used'} modes do not predict it any better than the prior",
        below,
        above,
    )


def _limits(row: pd.Series, level: float) -> tuple[float, float]:
    """Return the lower and upper frequencies, Hz, at which the two-sided tail probability is `level`.

    Each tail is assumed to have the shape of the error distribution, scaled to the 90 % interval end on its side.
    This is exact if the predictive distribution has that shape. If the measured frequency lies outside the
    interval, the tail on its side also passes through the measured frequency's known tail probability. A mode is
    then beyond its limit whenever its probability is below the level.
    """
    freedom = min(float(row["freedom"]), _GAUSSIAN)
    end, wanted, here = (-float(stdtrit(freedom, 0.5 * p)) for p in (0.1, level, max(float(row["p"]), _TINY)))
    mean, measured, limits = float(row["mean"]), float(row["measured"]), []
    for name, sign in (("eti90_lb", -1.0), ("eti90_ub", 1.0)):
        width, away = sign * (float(row[name]) - mean), sign * (measured - mean)
        if away > width and here > end:
            reach = width + (away - width) * (wanted - end) / (here - end)
        else:
            reach = width * wanted / end
        limits.append(mean + sign * reach)
    return limits[0], limits[1]


def _how(trace: xr.DataTree, mode: str) -> str:
    """Return how a mode was measured, such as ``(the mean of 5 tests)`` after a space; "" for a single test."""
    tests = measured_tests(trace)
    at = [str(label) == mode for label in trace["observed_data"]["mode"].to_numpy()]
    return "" if tests is None else f" ({measurement_in_words(tests[:, at])})"


def _check_residual(trace: xr.DataTree, mode: str, row: pd.Series, level: float) -> Check:
    """Check the residuals of a mode that has no prediction; the p-value is NaN if it has no residuals either."""
    group = trace[GROUP].to_dataset()
    measured = f"{given(float(row['measured']))} Hz"
    if not group.sizes["quantity"] or mode not in map(str, group["mode"].to_numpy()):
        return Check(PREDICTED, f"mode {mode}", measured, "", np.nan, False, "", "")
    freedom = int(group["freedom"].sum())
    squares = group["squares"].sel(mode=mode).sum("quantity").to_numpy().ravel()
    against = f"mode {mode}: the updated model does not reach what was measured, {measured}: "
    check, _ = _judge_squares(
        PREDICTED, f"mode {mode}", squares, freedom, level / 2, against, has_scores(trace), " after updating"
    )
    return replace(check, found=f"{measured}, {check.found}", why_not=NOT_PREDICTED)


def _judge_squares(
    kind: str,
    of: str,
    squares: FloatArray,
    freedom: int,
    limit: float,
    against: str,
    is_of_scores: bool,
    parts: str = "",
) -> tuple[Check, float]:
    """Check Σ r² at the draws; return the `Check` and the factor on all residuals at which it would fail.

    If r are normal scores, this factor is not known from Σ r², and is infinite. `against` is the beginning of the
    check's sentence, and `parts` is appended to the description of Σ r².
    """
    p = float(chdtrc(freedom, squares).mean())
    larger = np.inf if is_of_scores else factor_to_fail(squares, freedom, limit)
    found = f"Σ r² = {significant(float(squares.mean()))}{parts}, {freedom} expected"
    how = f"with p below {significant(limit, 2)}" if is_of_scores else f"{significant(larger, 2)} times as large"
    sentence = f"{against}{found} ({probability(p)})"
    return Check(
        kind, of, found, f"p {significant(limit, 2)}", p, bool(p < limit), f"residuals {how}", sentence
    ), larger


def _residuals(trace: xr.DataTree, level: float) -> list[Check]:
    """Check the residuals of all used data together; return a list with this one check."""
    group = trace[GROUP].to_dataset()
    squares, n_modes = group["squares"], group.sizes["mode"]
    freedom = group["freedom"].to_numpy() * n_modes
    total, n = squares.sum(("quantity", "mode")).to_numpy().ravel(), int(freedom.sum())
    parts = [
        f"{quantity} {significant(float(squares.sel(quantity=quantity).sum('mode').mean()))} of {k}"
        for quantity, k in zip(group["quantity"].to_numpy().tolist(), freedom.tolist(), strict=True)
    ]
    of = f" ({', '.join(parts)})" if len(parts) > 1 else ""
    against = "all used data together: with the residuals r in standard deviations, "
    check, larger = _judge_squares(RESIDUALS, "all used data", total, n, level / 2, against, has_scores(trace), of)
    return [replace(check, why_not=_follows(trace, larger))]


def _tests(trace: xr.DataTree, level: float) -> list[Check]:
    """Check that no test's residuals are larger than its errors explain; return one `Check` per test."""
    group, every = trace[GROUP].to_dataset(), trace["observed_data"].to_dataset()["of_test"]
    squares = group["squares"].sum("quantity")
    of_test, each = every.sel(mode=group["mode"]).to_numpy(), int(group["freedom"].sum())
    names, found = list(dict.fromkeys(of_test.tolist())), []
    correlations = correlations_of(trace, MEAN)
    limit = level / (2 * len(names))
    for name in names:
        here = squares.isel(mode=of_test == name)
        total, n = here.sum("mode").to_numpy().ravel(), each * here.sizes["mode"]
        against = (
            f"test {name}: what it measured is not what the tests together say of the structure: with the "
            "residuals r in standard deviations, "
        )
        check, larger = _judge_squares(TEST, f"test {name}", total, n, limit, against, has_scores(trace))
        wrong = correlations[name].sensors_in_doubt() if name in correlations else ""
        sentence = f"{check.sentence}; look at {wrong}" if wrong else check.sentence
        found.append(replace(check, sentence=sentence, why_not=_follows(trace, larger)))
    return found


def _follows(trace: xr.DataTree, larger: float) -> str:
    """Return why the check of residuals tests nothing, or an empty string if it tests the model.

    It tests nothing if no degree of freedom is left and it fails only for residuals more than ten times as large
    (`larger`). With a degree of freedom left, the parameters cannot fit arbitrary errors.
    """
    if larger <= _MOST or int(trace[GROUP].attrs["n_data"]) > effective_parameters(trace):
        return ""
    only = f": only residuals {significant(larger, 2)} times as large would fail" if np.isfinite(larger) else ""
    return f"the model can follow these data{only}"


def _noise(trace: xr.DataTree, table: pd.DataFrame | None, level: float) -> list[Check]:
    """Check that no inferred standard deviation is far larger than its prior suggests; return a `Check` for each.

    Only the prior's upper tail counts: a standard deviation that is unexpectedly small passes.
    """
    group, found = trace[GROUP].to_dataset(), []
    names = [str(name) for name in group["noise"].to_numpy()]
    units = dict(zip(map(str, trace["posterior"].data_vars), parameter_units(trace), strict=True))
    tails, limit = np.log(group["tail"].to_numpy()), level / (2 * len(names))
    for name in names:
        isf = group["noise_isf"].sel(noise=name).to_numpy()
        sigma = array_of(trace, "posterior", name).ravel()
        p = float(np.exp(np.interp(sigma, isf[::-1], tails[::-1])).mean())
        beyond, median = (float(np.interp(np.log(tail), tails, isf)) for tail in (limit, 0.5))
        of = str(group["noise_of"].sel(noise=name).to_numpy())
        unit = f" {units[name]}".rstrip()
        kind = f" of {of}" if of else ""
        values = (
            f"{with_sd(float(sigma.mean()), float(sigma.std()))}{unit}{_in_hertz(trace, of, 1.0)}, "
            f"prior median {significant(median)}{unit}"
        )
        found.append(
            Check(
                NOISE,
                f"{name}{kind}",
                values,
                f"{significant(beyond)}{unit}",
                p,
                bool(p < limit),
                f"noise of {significant(beyond, 2)}{unit}{_in_hertz(trace, of, beyond / float(sigma.mean()))}",
                f"{name}, the inferred noise{kind}: {values}; its prior puts {share(limit)} beyond "
                f"{significant(beyond)}{unit}: the noise absorbs what the model does not explain "
                f"({probability(p)})",
                _free(trace, table, of, beyond, beyond / float(sigma.mean())),
            )
        )
    return found


def _in_hertz(trace: xr.DataTree, of: str, factor: float) -> str:
    """Format `factor` times the noise of the first mode's frequency, in Hz and in %; return "" for other noise."""
    if of != "frequencies" or not has(trace, "posterior_predictive", "frequency"):
        return ""
    mode = trace["posterior_predictive"]["mode"].to_numpy()[0]
    hertz = factor * noise_sd(trace, str(mode))
    measured = float(trace["observed_data"]["frequency"].to_numpy()[0])
    return f" ({significant(hertz, 2)} Hz in mode {mode}, {share(hertz / measured)})"


def _free(trace: xr.DataTree, table: pd.DataFrame | None, of: str, beyond: float, factor: float) -> str:
    """Return a clause if the prior lets the noise `of` frequencies or shapes hide a misfit, otherwise "".

    At the limit `beyond`, which is `factor` times its posterior mean, the noise then exceeds the prior sd of most
    predicted frequencies, or it makes 1 − MAC of a shape larger than 1 − `ALIKE` on average.
    """
    if of == "shapes":
        freedom = float(trace[GROUP].to_dataset()["freedom"].sel(quantity=of))
        hides = freedom * beyond**2 > 1.0 - ALIKE
    elif of == "frequencies" and table is not None and "prior_sd" in table:
        noise = np.array([noise_sd(trace, str(mode)) for mode in table.index])
        hides = bool(np.mean(factor * noise > table["prior_sd"].to_numpy()) > 0.5)
    else:
        return ""
    return "the noise was free to grow" if hides else ""


def _shapes(trace: xr.DataTree) -> list[Check]:
    """Check the MAC of each measured mode shape; return no check if the residuals include the shape errors."""
    if "shapes" in trace[GROUP]["quantity"].to_numpy():
        return []
    sentences = iter(shape_warnings(trace))
    return [
        Check(
            SHAPE,
            f"mode {mode}",
            f"MAC {below(value)}",
            f"{ALIKE}",
            np.nan,
            value < ALIKE,
            f"MAC below {ALIKE}",
            next(sentences) if value < ALIKE else "",
        )
        for mode, _, value in paired_mac(trace)
    ]
