"""Compare the posterior means and standard deviations of several samplers, relative to their standard errors."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmu.analysis.convergence.effective import mcse_sd
from fmu.analysis.convergence.remedies import fewest, meets_criterion, rhat_excess, without_scores
from fmu.analysis.trace.reading import array_of, walkers_of
from fmu.numbers import fixed, names_in_words, significant
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

CLOSE = 4.0
"""Largest difference, in standard errors, that is attributed to chance; 1 in 16 000 exceeds it by chance."""


class Agreement(NamedTuple):
    """Agreement between several samplers of one posterior.

    Attributes
    ----------
    agrees : bool or None
        Whether the samplers agree; None if fewer than two can be compared.
    z : float
        Largest difference between two runs in any mean or standard deviation, divided by its Monte-Carlo standard
        error; NaN if nothing was compared.
    sentence : str
        The result and the largest difference in words, followed by the names of runs that were left out.
    left_out : tuple of str
        Names of runs that do not meet the convergence criterion. Their standard errors are unreliable, so they
        were not compared.
    """

    agrees: bool | None
    z: float
    sentence: str
    left_out: tuple[str, ...]


def agreement(traces: Mapping[str, xr.DataTree], summaries: Mapping[str, pd.DataFrame]) -> Agreement:
    """Compare the posterior means and standard deviations of all pairs of sufficiently accurate runs.

    Runs agree if no difference reaches `CLOSE` standard errors. A run is compared if its R-hat and ESS meet the
    convergence criterion, whatever its verdict: if two runs each seem to have converged but differ, at least one
    of them is wrong. Test scores are not compared, because their standard errors are not tested.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces of one posterior, keyed by the names to use in the sentence.
    summaries : mapping of str to pandas.DataFrame
        ``summary(trace)`` of each trace, under the same names.
    """
    sufficient = [name for name, table in summaries.items() if _suffices(traces[name], table)]
    left_out = tuple(name for name in traces if name not in sufficient)
    also = (
        f" Left out: {names_in_words(left_out)}, whose R-hat or effective draws miss the criterion."
        if left_out
        else ""
    )
    if len(sufficient) < 2:
        return Agreement(None, np.nan, f"Fewer than two samplers can be compared.{also}", left_out)
    compared = {name: without_scores(summaries[name]) for name in sufficient}
    estimates = {name: _estimates(traces[name], table) for name, table in compared.items()}
    z, kind, k, (one, other) = 0.0, 0, 0, sufficient[:2]
    for pair in combinations(sufficient, 2):
        (first, error), (second, error_too) = (estimates[name] for name in pair)
        ratio = np.abs(first - second) / np.hypot(error, error_too)
        if ratio.max() > z:
            z, (one, other) = float(ratio.max()), pair
            kind, k = (int(i) for i in np.unravel_index(np.argmax(ratio), ratio.shape))
    sd = float(compared[one]["sd"].iloc[k])
    apart = significant(abs(estimates[one][0][kind, k] - estimates[other][0][kind, k]) / sd, 2)
    what = f"{('mean', 'sd')[kind]} of {compared[one].index[k]}, {one} and {other}: {apart} posterior sd"
    n = len(sufficient) * (len(sufficient) - 1) * len(compared[one])
    if z < CLOSE:
        said = f"The {len(sufficient)} samplers agree: of {n} differences of their means and sds the largest is "
        return Agreement(True, z, f"{said}{fixed(z, 1)} Monte Carlo standard errors ({what}).{also}", left_out)
    said = f"The samplers disagree: {what}, {fixed(z, 1)} Monte Carlo standard errors, which is not chance; "
    return Agreement(False, z, f"{said}at least one of the two is wrong.{also}", left_out)


def _suffices(trace: xr.DataTree, table: pd.DataFrame) -> bool:
    """Return True if a run's R-hat and ESS meet the convergence criterion."""
    return meets_criterion(rhat_excess(table), fewest(table), trace["posterior"].sizes["chain"])


def _estimates(trace: xr.DataTree, table: pd.DataFrame) -> tuple[FloatArray, FloatArray]:
    """Return the posterior means and standard deviations in a summary, and their Monte-Carlo standard errors.

    Both arrays have shape (2, n), where n is the number of rows.
    """
    errors = [mcse_sd(array_of(trace, "posterior", name), walkers_of(trace)) for name in table.index]
    return table[["mean", "sd"]].to_numpy().T, np.array([table["mcse_mean"].to_numpy(), errors])
