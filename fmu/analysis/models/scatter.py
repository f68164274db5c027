"""Scatter of a wrong model's parameters: which of them cause the misfit, and how scatter widens the posterior."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmu.analysis.convergence.diagnostics import summary
from fmu.analysis.convergence.effective import ess_bulk
from fmu.analysis.trace.reading import array_of, parameter_names, problem_of
from fmu.numbers import names_in_words, share, significant
from fmu.tables import data_frame
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

NEEDED, NOT_NEEDED = 0.95, 0.25
"""A group needs a scatter if the probability of τ > 0 is at least the first value, and does not need it if it is
at most the second. If the data favour τ = 0, this probability is about the ratio of posterior to prior width."""


class Scatter(NamedTuple):
    """Inferred mode-to-mode scatter τ of a group of parameters.

    τ is a fraction of the parameter's current value. If the parameter can be zero, τ is a fraction of its absolute
    starting value or, if this is zero, of the scale of its prior.

    Attributes
    ----------
    name : str
        Name of τ.
    parameters : tuple of str
        The parameters that scatter.
    low, median, high : float
        5 %, 50 % and 95 % posterior quantiles of τ.
    prior_median : float
    needed : float
        Probability that τ > 0, if τ = 0 and τ > 0 were equally probable before the test (`needed_probability`);
        NaN if the ESS of τ is undefined.
    largest : float
        Probability that this τ is the largest when every τ is divided by its prior standard deviation; NaN if
        there is only one τ.
    """

    name: str
    parameters: tuple[str, ...]
    low: float
    median: float
    high: float
    prior_median: float
    needed: float
    largest: float


def scatters(trace: xr.DataTree) -> tuple[Scatter, ...]:
    """Return the inferred scatters of a trace, in the order of theta; empty if none is inferred."""
    problem = problem_of(trace)
    likelihood = problem.get("likelihood", {})
    noise = list(likelihood.get("noise", ()))
    of: dict[str, list[str]] = {}
    for one in likelihood.get("discrepancy", ()):
        for name, k in zip(one.get("names", ()), one.get("inferred", ()), strict=True):
            if k >= 0:
                of.setdefault(noise[k], []).append(name)
    draws = {tau: array_of(trace, "posterior", tau) for tau in of}
    sds = [float(p["prior"]["sd"]) for tau in of for p in problem["parameters"] if p["name"] == tau]
    together = np.array([x.ravel() / sd for x, sd in zip(draws.values(), sds, strict=True)])
    first = np.argmax(together, axis=0) if len(of) > 1 else np.array([])
    found = []
    for k, ((tau, members), prior_sd) in enumerate(zip(of.items(), sds, strict=True)):
        low, median, high = map(float, np.quantile(draws[tau], [0.05, 0.5, 0.95]))
        largest = float(np.mean(first == k)) if len(of) > 1 else np.nan
        needed = needed_probability(draws[tau], prior_sd)
        found.append(Scatter(tau, tuple(members), low, median, high, 0.6745 * prior_sd, needed, largest))
    return tuple(found)


def needed_probability(draws: FloatArray, prior_sd: float) -> float:
    """Return the probability of τ > 0 rather than τ = 0, if both were equally probable before the test.

    The Bayes factor is the Savage–Dickey ratio (Dickey 1971, *Ann. Math. Stat.* 42, 204–223) of posterior to prior
    density at τ = 0. The likelihood depends on τ², so both densities are even functions of τ; the posterior
    density is a Gaussian kernel estimate from the draws and their mirror images. If no draw is near 0, one more
    effective draw is assumed between 0 and the smallest draw, so that the probability is not overstated. The
    result is NaN if the ESS is undefined.

    Parameters
    ----------
    draws : ndarray, shape (chains, draws)
        Draws of τ.
    prior_sd : float
        Standard deviation of its half-normal prior.
    """
    tau = draws.ravel()
    n = min(ess_bulk(draws), float(tau.size))
    if not n > 1.0:
        return np.nan
    width = 1.06 * float(np.std(tau)) * n**-0.2
    kernel = np.exp(-0.5 * (tau / width) ** 2) / (np.sqrt(2.0 * np.pi) * width)
    posterior = max(2.0 * float(kernel.mean()), 1.0 / (n * max(width, float(tau.min()))))
    return float(1.0 / (1.0 + posterior * prior_sd / np.sqrt(2.0 / np.pi)))


def scatter_table(found: tuple[Scatter, ...]) -> pd.DataFrame:
    """Return a table with one row per τ; `Scatter` describes the columns."""
    rows = [one._asdict() | {"parameters": ", ".join(one.parameters)} for one in found]
    table = data_frame(rows, "tau", [one.name for one in found])
    return table.drop(columns="name")


def scatter_words(found: tuple[Scatter, ...]) -> list[str]:
    """Return sentences that say which groups of parameters need scatter, and which of them cause the misfit.

    The list is empty if no scatter is inferred.
    """
    if not found:
        return []
    said = [_of_one(one) for one in found]
    if len(found) == 1:
        return said
    order = sorted(found, key=lambda one: -one.largest)
    first = order[0]
    if first.largest >= 0.9:
        said.append(f"The misfit lives in {names_in_words(first.parameters)}: {_largest(first)}.")
    else:
        chances = ", ".join(f"{names_in_words(one.parameters)} {share(one.largest)}" for one in order[:4])
        said.append(f"Where the misfit lives is not sure. Probability of the largest scatter: {chances}.")
    return said


def _largest(one: Scatter) -> str:
    return f"its scatter is the largest with a probability of {share(one.largest)}"


def _of_one(one: Scatter) -> str:
    who = f"{names_in_words(one.parameters)}{'' if len(one.parameters) == 1 else ' together'}"
    if one.needed >= NEEDED:
        need = "needs a scatter"
    elif one.needed <= NOT_NEEDED:
        need = "needs no scatter, as far as the data tell"
    else:
        need = "the data do not tell whether it needs a scatter"
    low, middle, high, before = (
        significant(100 * x, 2) for x in (one.low, one.median, one.high, one.prior_median)
    )
    return (
        f"{who}: {need} (probability {share(one.needed)}, if it was 50 % before the test). {one.name} is "
        f"{middle} % (90 %: {low} to {high} %); the median of its prior is {before} %."
    )


def interval_ratios(traces: Mapping[str, xr.DataTree], reference: str) -> pd.DataFrame:
    """Return the width of each parameter's 90 % interval, divided by its width in a reference model.

    Returns
    -------
    pandas.DataFrame
        One row per parameter of the reference, one column per other model; NaN where a model lacks the parameter.
    """
    widths = {}
    for name, trace in traces.items():
        table = summary(trace)
        widths[name] = (table["eti90_ub"] - table["eti90_lb"]).to_dict()
    names = parameter_names(traces[reference])
    others = {
        other: [width.get(name, np.nan) / widths[reference][name] for name in names]
        for other, width in widths.items()
        if other != reference
    }
    return data_frame(others, "parameter", list(names))


def ratio_words(ratios: pd.DataFrame, reference: str) -> list[str]:
    """Return a sentence per model on how much wider its intervals are than those in the reference model.

    Models that share no parameter with the reference are left out.
    """
    said = []
    for name in map(str, ratios.columns):
        known = ratios[name].dropna()
        if len(known):
            low, high, at = known.min(), known.max(), known.idxmax()
            between = significant(float(low), 2), significant(float(high), 2)
            said.append(
                f"{name}: the 90 % intervals of the parameters are {between[0]} to {between[1]} times as wide as "
                f"with {reference}, {at} the most."
            )
    return said
