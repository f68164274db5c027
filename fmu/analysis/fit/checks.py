"""Checks of a model against data, with a common false-alarm rate.

A model is right if the data are a draw from what was stated: parameters from their priors, errors from the error
model. The checks share the level `LEVEL`: each kind that a run has gets an equal part, and of that each check of
the kind an equal part (Bonferroni), so that a right model fails any of them with a probability of at most `LEVEL`,
however they depend on each other.

- A mode predicted from the other modes, or held out: the tail probability of the measured frequency in the
  predictive distribution without it, noise included, is exactly uniform under a right model (Gelfand, Dey & Chang
  1992, *Bayesian Statistics* 4, 147–167; Marshall & Spiegelhalter 2007, *Bayesian Analysis* 2, 409–444).
- Residuals: at one posterior draw, Σ r² over the standardised residuals r is exactly chi-square with as many
  degrees of freedom as there are data, because a truth and a posterior draw have the same joint distribution with
  the data (Johnson 2004, *Ann. Statist.* 32, 2361–2384). P(χ² ≥ Σ r²) is then uniform at one draw. Its mean over
  the draws, the posterior predictive p-value, is at most α/2 with a probability of at most α (Meng 1994, *Ann.
  Statist.* 22, 1142–1160; Rüschendorf 1982, *Adv. Appl. Probab.* 14, 623–632), so it is compared with α/2. The
  bound is wide: with k parameters fitted to n data, Σ r² is about χ²(n − k) plus k, and false alarms are rarer.
  Where a few tests gave the size of an error, it has Student's distribution, and r is its normal score.
- One of several tests: the same of its own residuals.
- Inferred standard deviations: by the same argument the probability that the prior gives to larger values is
  uniform at one posterior draw, and its mean is compared with α/2. Noise that had to grow to absorb what the model
  does not explain fails, if the prior says what was expected of it; with a wide prior it cannot.
- A weighed mass or a static displacement: P(χ²₁ ≥ r²) of its own residual, as above.
- A population: `fmu.analysis.fit.populations`.
- A shape that is not the measured one: MAC below `ALIKE` after updating. This has no level, as nothing is said of
  the errors of the shapes; where their errors are in the likelihood, they are among the residuals instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc, chdtri, stdtrit

from fmu.analysis.fit.check import (
    HELD_OUT,
    LEVEL,
    NOISE,
    PREDICTED,
    QUANTITY,
    RESIDUALS,
    SHAPE,
    TEST,
    Check,
    beyond,
    probability,
)
from fmu.analysis.fit.populations import GROUP as POPULATIONS
from fmu.analysis.fit.populations import effective_parameters, population_checks
from fmu.analysis.held_out.modes import kept_table
from fmu.analysis.information import CONTRACTED
from fmu.analysis.prediction import measured_mac, measured_tests, measurement_in_words, shape_warnings
from fmu.analysis.trace.misfit import GROUP, QUANTITIES
from fmu.analysis.trace.modal_states import MEAN
from fmu.analysis.trace.reading import array_of, has, parameter_units
from fmu.fem.pairing.correlation import ALIKE
from fmu.numbers import apart, given, share, significant, with_sd
from fmu.tables import data_frame
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


_FEW = 500
"""Draws that are enough to see how much larger residuals would have failed."""
_MOST = 10.0
"""Residuals that only fail if more times as large are no check of a model with a parameter for each datum."""
NOT_PREDICTED = "no prediction by the other modes was computed (Python: fmu.leave_one_out(trace, problem))"
_TINY = 1e-300
_GAUSSIAN = 1e8  # degrees of freedom from which Student's distribution is the Gaussian


def checks_of(trace: xr.DataTree) -> list[Check]:
    """Return the checks of a run; none for the modal residual, which is no measured quantity."""
    if not has(trace, GROUP):
        return []
    kinds: list[Callable[[float], list[Check]]] = []
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
    if has(trace, QUANTITIES):
        kinds.append(partial(_quantities, trace))
    if has(trace, POPULATIONS, "score"):
        kinds.append(partial(population_checks, trace))
    found = [check for kind in kinds for check in kind(LEVEL / len(kinds))]
    return [check for check in found if np.isfinite(check.p)] + _shapes(trace)


def _predictions(trace: xr.DataTree) -> pd.DataFrame | None:
    """Return the prediction of each mode without it; NaN where it is not known, None without frequencies."""
    if not has(trace, "posterior_predictive", "frequency"):
        return None
    kept = kept_table(trace)
    if kept is not None:
        return kept
    measured = trace["observed_data"]["frequency"].to_numpy()
    columns = {"measured": measured, "p": np.full(len(measured), np.nan), "used": np.full(len(measured), True)}
    return data_frame(columns, "mode", trace["observed_data"]["mode"].to_numpy())


def _modes(trace: xr.DataTree, rows: pd.DataFrame, level: float) -> list[Check]:
    """Return a check of each mode; by its residuals where no prediction without it was made."""
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
    # as a parameter counts as informed: the prediction is narrower than by the prior, or hardly more than noise
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
    """Return the limits, Hz, at which a measured frequency has the two-sided tail probability `level`.

    On either side the tail is that of the errors, as wide as the 90 % interval is there: exact if it has their
    shape. On the side of what was measured it goes through the known probability of that as well, so that a mode
    is beyond the limit if its probability is below the level.
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
    """Return `` (the mean of 5 tests)`` of a mode that was measured by several; else nothing."""
    tests = measured_tests(trace)
    at = [str(label) == mode for label in trace["observed_data"]["mode"].to_numpy()]
    return "" if tests is None else f" ({measurement_in_words(tests[:, at])})"


def _check_residual(trace: xr.DataTree, mode: str, row: pd.Series, level: float) -> Check:
    """Return the check of a mode by its residuals after updating with it."""
    group = trace[GROUP].to_dataset()
    measured = f"{given(float(row['measured']))} Hz"
    if not group.sizes["quantity"] or mode not in map(str, group["mode"].to_numpy()):
        return Check(PREDICTED, f"mode {mode}", measured, "", np.nan, False, "", "")
    freedom = int(group["freedom"].sum())
    squares = group["squares"].sel(mode=mode).sum("quantity").to_numpy().ravel()
    against = f"mode {mode}: the updated model does not reach what was measured, {measured}: "
    check, _ = _judge_squares(PREDICTED, f"mode {mode}", squares, freedom, level / 2, against, " after updating")
    return replace(check, found=f"{measured}, {check.found}", why_not=NOT_PREDICTED)


def _judge_squares(
    kind: str, of: str, squares: FloatArray, freedom: int, limit: float, against: str, parts: str = ""
) -> tuple[Check, float]:
    """Return a check of Σ r² at the draws, and the factor of all residuals with which it would fail.

    `against` begins its sentence, and `parts` says more of the sum.
    """
    p, larger = float(chdtrc(freedom, squares).mean()), _larger(squares, freedom, limit)
    found = f"Σ r² = {significant(float(squares.mean()))}{parts}, {freedom} expected"
    shows = f"residuals {significant(larger, 2)} times as large"
    sentence = f"{against}{found} ({probability(p)})"
    return Check(kind, of, found, f"p {significant(limit, 2)}", p, bool(p < limit), shows, sentence), larger


def _residuals(trace: xr.DataTree, level: float) -> list[Check]:
    """Return the check of all used data together."""
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
    check, larger = _judge_squares(RESIDUALS, "all used data", total, n, level / 2, against, of)
    return [replace(check, why_not=_follows(trace, larger))]


def _tests(trace: xr.DataTree, level: float) -> list[Check]:
    """Return a check of each of several tests: whether the others contradict it."""
    group, every = trace[GROUP].to_dataset(), trace["observed_data"].to_dataset()["of_test"]
    squares = group["squares"].sum("quantity")
    of_test, each = every.sel(mode=group["mode"]).to_numpy(), int(group["freedom"].sum())
    names, found = list(dict.fromkeys(of_test.tolist())), []
    limit = level / (2 * len(names))
    for name in names:
        here = squares.isel(mode=of_test == name)
        total, n = here.sum("mode").to_numpy().ravel(), each * here.sizes["mode"]
        against = (
            f"test {name}: what it measured is not what the tests together say of the structure: with the "
            "residuals r in standard deviations, "
        )
        check, larger = _judge_squares(TEST, f"test {name}", total, n, limit, against)
        found.append(replace(check, why_not=_follows(trace, larger)))
    return found


def _follows(trace: xr.DataTree, larger: float) -> str:
    """Say why residuals that could be `larger` times as large are no check; empty if they are one.

    With a degree of freedom left, parameters cannot fit every error, even where they fit these errors well.
    """
    if larger <= _MOST or int(trace[GROUP].attrs["n_data"]) > effective_parameters(trace):
        return ""
    return f"the model can follow these data: only residuals {significant(larger, 2)} times as large would fail"


def _larger(squares: FloatArray, freedom: int, limit: float) -> float:
    """Return the factor of all residuals at which the mean tail probability of their squares is `limit`."""
    few = squares[:: -(-len(squares) // _FEW)]
    low, high = -12.0, 12.0  # of its natural logarithm
    for _ in range(40):
        middle = 0.5 * (low + high)
        enough = float(chdtrc(freedom, np.exp(2.0 * middle) * few).mean()) < limit
        low, high = (low, middle) if enough else (middle, high)
    return float(np.exp(high))


def _noise(trace: xr.DataTree, table: pd.DataFrame | None, level: float) -> list[Check]:
    """Return a check of each inferred standard deviation: whether it agrees with its prior."""
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
    """Return `factor` times the noise of the draws, in Hz and in per cent of the lowest mode; "" of shapes."""
    if of != "frequencies" or not has(trace, "posterior_predictive", "frequency"):
        return ""
    mode = trace["posterior_predictive"]["mode"].to_numpy()[0]
    hertz = factor * noise_sd(trace, str(mode))
    measured = float(trace["observed_data"]["frequency"].to_numpy()[0])
    return f" ({significant(hertz, 2)} Hz in mode {mode}, {share(hertz / measured)})"


def _free(trace: xr.DataTree, table: pd.DataFrame | None, of: str, beyond: float, factor: float) -> str:
    """Return a sentence on noise that was free to grow and may hide a misfit; empty if it cannot."""
    if of == "shapes":
        freedom = float(trace[GROUP].to_dataset()["freedom"].sel(quantity=of))
        hides = freedom * beyond**2 > 1.0 - ALIKE
    elif of == "frequencies" and table is not None and "prior_sd" in table:
        noise = np.array([noise_sd(trace, str(mode)) for mode in table.index])
        hides = bool(np.mean(factor * noise > table["prior_sd"].to_numpy()) > 0.5)
    else:
        return ""
    return "the noise was free to grow" if hides else ""


def noise_sd(trace: xr.DataTree, mode: str) -> float:
    """Return the standard deviation of the errors of a measured frequency over the draws, Hz; 0 if not known."""
    if not has(trace, "posterior_predictive", "frequency"):
        return 0.0
    predicted = trace["posterior_predictive"].to_dataset().sel(mode=mode)
    return float((predicted["frequency"] - predicted["model_frequency"]).std())


def _quantities(trace: xr.DataTree, level: float) -> list[Check]:
    """Return a check of each datum that is not of modes: whether the updated model reproduces it."""
    group = trace[QUANTITIES].to_dataset()
    found, limit = [], level / (2 * group.sizes["datum"])
    for label in map(str, group["datum"].to_numpy()):
        datum = group.sel(datum=label)
        measured, sd, unit = float(datum["measured"]), float(datum["sd"]), str(datum["unit"].to_numpy())
        computed = datum["computed"].to_numpy().ravel()
        p = float(chdtrc(1.0, ((computed - measured) / sd) ** 2).mean())
        most = sd * float(np.sqrt(chdtri(1.0, limit)))
        given_by_model = with_sd(float(computed.mean()), float(computed.std()))
        values = f"{with_sd(measured, sd)} {unit}, computed {given_by_model} {unit}"
        found.append(
            Check(
                QUANTITY,
                label,
                values,
                f"p {significant(limit, 2)}",
                p,
                bool(p < limit),
                f"{significant(most, 2)} {unit}",
                f"{label}: the updated model does not give what was measured, {values} ({probability(p)})",
            )
        )
    return found


def _shapes(trace: xr.DataTree) -> list[Check]:
    """Return a check of each measured shape, where their errors are not among the residuals."""
    alike = measured_mac(trace)
    if alike is None or "shapes" in trace[GROUP]["quantity"].to_numpy():
        return []
    values, sentences = np.diag(alike.sel(state=MEAN)), iter(shape_warnings(trace))
    return [
        Check(
            SHAPE,
            f"mode {mode}",
            f"MAC {apart(float(value), ALIKE, sd=0.1)[0]}",
            f"{ALIKE}",
            np.nan,
            bool(value < ALIKE),
            f"MAC below {ALIKE}",
            next(sentences) if value < ALIKE else "",
        )
        for mode, value in zip(alike["mode"].to_numpy(), values, strict=True)
    ]
