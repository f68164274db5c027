"""Posterior expectations, predictions, and warnings on draws at bounds.

Expectations are eq. (11) and predictions are eq. (10) of Boulkaibet et al. (`fmu.paper.published`).
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import NormalDist
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmu.analysis.convergence.diagnostics import interval_columns
from fmu.analysis.convergence.effective import mcse_mean
from fmu.analysis.trace.conversion import NEW_MEASUREMENT, ONE_MORE_TEST
from fmu.analysis.trace.misfit import has_scores
from fmu.analysis.trace.reading import (
    array_of,
    check_trace,
    has,
    is_relative_loss,
    parameter_draws,
    parameter_names,
    parameter_units,
    walkers_of,
)
from fmu.arguments import check_arguments
from fmu.numbers import apart, share, with_unit
from fmu.tables import data_frame
from fmu.types import BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


class Expectation(NamedTuple):
    """A posterior mean and its Monte-Carlo standard error.

    Attributes
    ----------
    value : float, or ndarray of shape (k,)
        Mean over the retained draws of the function G given to `expectation`.
    mcse : float, or ndarray of shape (k,)
        Monte-Carlo standard error of `value`; NaN if G is the same at every draw, if a stored value is not finite,
        or if the chains have fewer than four draws each.
    """

    value: float | FloatArray
    mcse: float | FloatArray


@check_arguments
def expectation(trace: xr.DataTree, G: Callable[[FloatArray], FloatArray] | str) -> Expectation:
    """Estimate the posterior expectation of a function G of the parameters by its mean over the draws.

    This is eq. (11) of Boulkaibet et al. (`fmu.paper.published`), (1/N_s) Σ_i G(E_i) over N_s draws E_i of theta.

    Parameters
    ----------
    trace : xarray.DataTree
    G : callable or str
        A function of the draws, (n, ndim) in SI units and in the order of the problem's parameters, that returns
        (n,) or (n, k); or the name of a parameter, or of a variable of the posterior predictive
        (``"model_frequency"``, ``"frequency"``, with a discrepancy ``"new_measurement"``, and for repeated tests
        ``"one_more_test"``). For repeated tests whose scatter has one degree of freedom, ``"model_frequency"`` is
        the only one of these variables that has a mean.

    Returns
    -------
    Expectation
        Floats if G returns (n,), arrays of shape (k,) if it returns (n, k).

    Raises
    ------
    ValueError
        If `trace` is not a trace, no variable has the name `G`, or the callable returns another shape or values
        that are not finite.
    """
    check_trace(trace)
    values = _read_draws(trace, G) if isinstance(G, str) else _evaluate(trace, G)
    walkers = walkers_of(trace)
    columns = values.reshape(*values.shape[:2], -1)
    mean = columns.mean(axis=(0, 1))
    mcse = np.array([mcse_mean(x, walkers) for x in np.moveaxis(columns, -1, 0)])
    if values.ndim == 2:
        return Expectation(float(mean[0]), float(mcse[0]))
    return Expectation(mean, mcse)


def predict_frequencies(trace: xr.DataTree, ci_prob: float = 0.9) -> pd.DataFrame:
    """Compare the measured frequencies with the posterior predictive distribution.

    The distribution is eq. (10) of Boulkaibet et al. (`fmu.paper.published`).

    Parameters
    ----------
    trace : xarray.DataTree
        A trace of an `UpdatingProblem`.
    ci_prob : float
        Probability inside the equal-tailed intervals.

    Returns
    -------
    pandas.DataFrame
        One row per mode, in Hz. The names of the columns are given for `ci_prob` 0.9; another value in % replaces
        the 90 in them:

        - ``measured``: the measured frequency;
        - ``mean``, its standard error ``mcse_mean``, ``sd``, ``eti90_lb`` and ``eti90_ub``: mean, standard
          deviation and interval of the computed frequency, without measurement noise;
        - ``noisy_sd``, ``noisy_eti90_lb``, ``noisy_eti90_ub``: standard deviation and interval of a new
          measurement of this structure, with noise and any model discrepancy, given the data. The columns are
          missing without an error model of frequencies, as for the modal residual. If the measured frequency is
          the mean of repeated tests, the new measurement is the mean of the same number of tests, and
          ``noisy_sd`` is `central_sd`;
        - ``similar_sd``, ``similar_eti90_lb``, ``similar_eti90_ub``: the same for a similar structure, on whose
          discrepancy the data carry no information. The columns exist only with a discrepancy;
        - ``test_eti90_lb``, ``test_eti90_ub``: interval of one more test. The columns exist only for repeated
          tests.

    Raises
    ------
    ValueError
        If `trace` is not a trace or holds no frequencies, or `ci_prob` does not lie between 0 and 1.
    """
    lower, upper = interval_columns(ci_prob)
    model = expectation(trace, "model_frequency")
    predictive = trace["posterior_predictive"]
    ends = [(1 - ci_prob) / 2, (1 + ci_prob) / 2]
    columns = {
        "measured": trace["observed_data"]["frequency"].to_numpy(),
        "mean": model.value,
        "mcse_mean": model.mcse,
    }
    noisy = {"noisy_": "frequency"}
    if NEW_MEASUREMENT in predictive:
        noisy = {"noisy_": NEW_MEASUREMENT, "similar_": "frequency"}
    for prefix, name in {"": "model_frequency", **noisy}.items():
        if name not in predictive:
            continue
        values = array_of(trace, "posterior_predictive", name)
        low, high = np.quantile(values, ends, axis=(0, 1))
        is_student = bool(prefix) and has_scores(trace)
        columns |= {
            f"{prefix}sd": central_sd(values) if is_student else values.std(axis=(0, 1), ddof=1),
            f"{prefix}{lower}": low,
            f"{prefix}{upper}": high,
        }
    if ONE_MORE_TEST in predictive:
        values = array_of(trace, "posterior_predictive", ONE_MORE_TEST)
        columns[f"test_{lower}"], columns[f"test_{upper}"] = np.quantile(values, ends, axis=(0, 1))
    return data_frame(columns, "mode", predictive["mode"].to_numpy())


def as_replicates(table: pd.DataFrame, used: BoolArray) -> pd.DataFrame:
    """Return the table of `predict_frequencies` for a predictive check of the data.

    `used` (n_modes,) marks the modes used in updating. The discrepancy of such a mode follows its measurement, so
    that the measurement could hardly contradict the model. For these modes, the columns ``similar_…`` therefore
    replace the columns ``noisy_…``.
    """
    similar = [name for name in map(str, table.columns) if name.startswith("similar_")]
    noisy = {name.replace("similar", "noisy", 1): name for name in similar}
    columns = {own: np.where(used, table[name], table[own]) for own, name in noisy.items()}
    return table.drop(columns=similar).assign(**columns)


def noise_sd(trace: xr.DataTree, mode: str) -> float:
    """Return the standard deviation of a mode's simulated errors at the draws, Hz, or 0 if none were simulated.

    The errors are measurement errors and any model discrepancy. For repeated tests, return `central_sd`.
    """
    if not has(trace, "posterior_predictive", "frequency"):
        return 0.0
    predicted = trace["posterior_predictive"].to_dataset().sel(mode=mode)
    error = predicted["frequency"] - predicted["model_frequency"]
    return float(central_sd(error.to_numpy()) if has_scores(trace) else error.std())


def central_sd(values: FloatArray) -> FloatArray:
    """Return a standard deviation: the width of the central 95 % interval of values (chains, draws, …) over 3.92.

    Student's t, the distribution of errors whose scatter is an estimate, has no variance for ν ≤ 2.
    """
    low, high = np.quantile(values, [0.025, 0.975], axis=(0, 1))
    return np.asarray((high - low) / (2.0 * NormalDist().inv_cdf(0.975)))


def measured_tests(trace: xr.DataTree) -> FloatArray | None:
    """Return the frequencies of the single tests, (n_tests, n_modes), Hz, or None if tests were not repeated.

    They are NaN where a test missed a mode.
    """
    if not has(trace, "observed_data", "tests"):
        return None
    return np.asarray(trace["observed_data"]["tests"].transpose("test", "mode").to_numpy())


def measurement_in_words(tests: FloatArray | None) -> str:
    """Describe a measured frequency: ``"a measurement"``, or ``"the mean of 5 tests"``."""
    if tests is None:
        return "a measurement"
    counts = np.sum(~np.isnan(tests), axis=0)
    least, most = int(counts.min()), int(counts.max())
    return f"the mean of {most} tests" if least == most else f"the mean of {least} to {most} tests"


def _read_draws(trace: xr.DataTree, name: str) -> FloatArray:
    """Return the draws of a stored variable, shape (chains, draws) or (chains, draws, k).

    Raise ValueError if no variable has this name.
    """
    known = []
    for group in ("posterior", "posterior_predictive"):
        if has(trace, group):
            known += list(trace[group].data_vars)
            if name in trace[group].data_vars:
                return array_of(trace, group, name)
    raise ValueError(f"G: must be a callable or one of {', '.join(map(str, known))} (got {name!r})")


def _evaluate(trace: xr.DataTree, G: Callable[[FloatArray], FloatArray]) -> FloatArray:
    """Return G at every draw, shape (chains, draws) or (chains, draws, k).

    Raise ValueError if G returns another shape or values that are not finite.
    """
    draws = parameter_draws(trace)
    n = draws.shape[0] * draws.shape[1]
    values = np.asarray(G(draws.reshape(n, -1)), dtype=float)
    if values.ndim not in (1, 2) or len(values) != n:
        raise ValueError(f"G: must map ({n}, {draws.shape[2]}) to ({n},) or ({n}, k) (got shape {values.shape})")
    if not np.all(np.isfinite(values)):
        at = int(np.argmax(~np.isfinite(values.reshape(n, -1)).all(axis=1)))
        raise ValueError(f"G: must be finite at every draw (got {values[at]} at {draws.reshape(n, -1)[at]})")
    return values.reshape(*draws.shape[:2], *values.shape[1:])


NEAR_A_BOUND = 0.02
"""A draw is next to a bound if it is closer to it than this fraction of the range between the bounds."""
MORE_THAN_THE_PRIOR, LEAST_SHARE = 3.0, 0.05
_WITHIN = 2.0


class AtBound(NamedTuple):
    """A parameter whose draws accumulate at a bound, with the posterior and prior probability near this bound."""

    name: str
    side: str
    bound: str
    near: float
    before: float


def at_bounds(trace: xr.DataTree) -> list[AtBound]:
    """Return the parameters whose draws accumulate at a bound, which suggests values beyond the bound.

    A parameter is listed if three conditions hold: at least 5 % of the draws are closer to the bound than 2 % of
    the distance between the two bounds; this is more than three times the prior's fraction there; and the
    posterior mean is within two standard deviations of the bound. Parameters without two finite bounds are never
    listed.
    """
    constants, names, found = trace["constant_data"], parameter_names(trace), []
    lower, upper = (constants[side].to_numpy() for side in ("lower", "upper"))
    draws = parameter_draws(trace).reshape(-1, len(names))
    for k, (name, unit) in enumerate(zip(names, parameter_units(trace), strict=True)):
        x, margin = draws[:, k], NEAR_A_BOUND * (upper[k] - lower[k])
        if not np.isfinite(margin):
            continue
        for side, bound, sign in (("lower", lower[k], 1.0), ("upper", upper[k], -1.0)):
            near = float(np.mean(sign * (x - bound) < margin))
            before = _prior_share(trace, name, bound, sign, margin)
            is_close = sign * (x.mean() - bound) < _WITHIN * x.std()
            if near >= LEAST_SHARE and near > MORE_THAN_THE_PRIOR * before and is_close:
                found.append(AtBound(name, side, with_unit(float(bound), unit), near, before))
    return found


GAIN = (
    '; if the parameter gained more, give it varies = "group", with a group of tests for each state: its values '
    "then have only its own bounds"
)
"""Text added to a warning if a relative loss is at its lower bound."""
PINNED = 0.5
"""Fraction of the draws next to a bound above which the bound helps to determine the parameter."""


def pinned_parameters(trace: xr.DataTree) -> list[str]:
    """Return the names of the parameters that have most of their draws next to a bound.

    The upper bound of a loss is excluded, because it is physical: nearly all of the stiffness is lost.
    """
    pinned = [one for one in at_bounds(trace) if one.near > PINNED]
    return [one.name for one in pinned if one.side == "lower" or not is_relative_loss(trace, one.name)]


def bound_warnings(trace: xr.DataTree) -> list[str]:
    """Return a sentence for each parameter whose draws accumulate at a bound, with the remedy for a gain."""
    return [
        f"{one.name}: {share(one.near)} of the draws (prior: {share(one.before)}) lie within "
        f"{share(NEAR_A_BOUND)} of the range from the {one.side} bound, {one.bound}"
        + (GAIN if one.side == "lower" and is_relative_loss(trace, one.name) else "")
        for one in at_bounds(trace)
    ]


def _prior_share(trace: xr.DataTree, name: str, bound: float, sign: float, margin: float) -> float:
    """Return the fraction of the prior draws near a bound, or of a uniform prior if there are no prior draws."""
    if not has(trace, "prior"):
        return NEAR_A_BOUND
    return float(np.mean(sign * (trace["prior"].variables[name].to_numpy() - bound) < margin))


def search_warnings(trace: xr.DataTree, highest: float) -> list[str]:
    """Return a list with a warning if a draw has a higher log-probability than any maximum found."""
    reached = float(array_of(trace, "sample_stats", "lp").max())
    if reached <= highest + 1e-3:
        return []
    draw, known = apart(reached, highest, sd=1.0)
    return [
        f"a draw has log-probability {draw}, above the highest maximum found, {known}: the search missed a "
        "maximum; use more starts"
    ]
