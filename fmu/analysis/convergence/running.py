"""How estimates settle while a run grows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence import effective
from fmu.analysis.convergence.diagnostics import parameter_draws, walkers_of
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr


LENGTHS = 20
_FEWEST = 20
_RANKED = 1500


def lengths(steps: int, n: int = LENGTHS) -> IntArray:
    """Return at most `n` growing numbers of steps, evenly apart on a logarithmic scale, the last one `steps`."""
    return np.unique(np.geomspace(min(_FEWEST, steps), steps, n).round().astype(np.int64))


def running_means(trace: xr.DataTree, at: IntArray | None = None) -> tuple[IntArray, FloatArray]:
    """Return the mean of every chain's first draws.

    Parameters
    ----------
    trace : xarray.DataTree
    at : ndarray of int, shape (n,), optional
        Numbers of steps: `lengths` of the run if not given.

    Returns
    -------
    at : ndarray, shape (n,)
    means : ndarray, shape (n, chains, ndim), SI units
        Over all walkers of an ensemble.
    """
    walkers = walkers_of(trace)
    draws = parameter_draws(trace)
    at = lengths(draws.shape[1] // walkers) if at is None else np.asarray(at)
    sums = np.cumsum(draws, axis=1)[:, at * walkers - 1]
    return at, np.moveaxis(sums / (at * walkers)[None, :, None], 1, 0)


def running_rhat(trace: xr.DataTree) -> tuple[IntArray, FloatArray]:
    """Return the R-hat that a run would have had if it had been shorter.

    Of long runs every k-th draw is ranked, at most 1500 a chain, which moves R-hat by less than it is known to.

    Parameters
    ----------
    trace : xarray.DataTree

    Returns
    -------
    at : ndarray, shape (n,)
        Numbers of steps.
    rhat : ndarray, shape (n, ndim)
        Between ensembles for an ensemble sampler; NaN of one chain.
    """
    walkers = walkers_of(trace)
    draws = parameter_draws(trace)
    at = lengths(draws.shape[1] // walkers)
    values = np.empty((len(at), draws.shape[2]))
    for row, steps in zip(values, at, strict=True):
        distance = effective.apart(steps * walkers, _RANKED, walkers)
        first = draws[:, : steps * walkers : distance]
        row[:] = [effective.rhat(x) for x in np.moveaxis(first, -1, 0)]
    return at, values
