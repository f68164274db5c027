"""The places that other runs on the same posterior came to, and this one did not."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from fmu.analysis.convergence.diagnostics import parameter_draws, parameter_names, walkers_of
from fmu.analysis.convergence.effective import by_walker
from fmu.analysis.convergence.remedies import for_missed_maximum
from fmu.analysis.maxima.missed import nearest_maxima
from fmu.analysis.maxima.results import Maxima
from fmu.analysis.maxima.text import NEGLIGIBLE, in_words, mass_in_words
from fmu.numbers import apart
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr


_MOST_DRAWS = 4000
_FEWEST_DRAWS = 20
_FAR = 3.0


def missed_places(
    trace: xr.DataTree, others: Mapping[str, xr.DataTree], maxima: Maxima | None = None
) -> list[str]:
    """Name the places of more than negligible mass that other runs on the same posterior came to, alone.

    A draw of another run is away where it is three times as far from every draw of this one as the draws of its
    chains are from each other, in the metric of the covariance within its chains. What lies away is weighed by
    E[log P] + the entropy of a Gaussian, which is the logarithm of the mass of one, against the same of this run,
    or against the maxima that are known if that is more. What is near one of these is left to `missed_maxima`.

    Parameters
    ----------
    trace : xarray.DataTree
    others : mapping of str to xarray.DataTree
    maxima : Maxima, optional
        Those that are known.

    Returns
    -------
    list of str
        One sentence for each of the other runs that found such a place.

    Raises
    ------
    ValueError
        If another run has other parameters.
    """
    found = []
    names = parameter_names(trace)
    here = _Paths(trace)
    for name, other in others.items():
        if parameter_names(other) != names:
            raise ValueError(f"others.{name}: must have the parameters {names} (got {parameter_names(other)})")
        place = _missed_place(here, _Paths(other), -np.inf if maxima is None else maxima.log_evidence)
        if place is not None and not (maxima is not None and nearest_maxima(place[0][None], maxima)[0] >= 0):
            theta, log_prob, mass = place
            there, best = apart(log_prob, float(here.log_prob.max()), sd=1.0)
            where = in_words(names, theta, [trace["posterior"][n].attrs.get("units", "") for n in names])
            found.append(
                f"run {name} visited {where}, and no draw of this run is near: the log-probability there is "
                f"{there} (best draw here: {best}), and it holds {mass_in_words(mass)} of the "
                f"probability{for_missed_maximum(trace)}"
            )
    return found


class _Paths:
    """Draws of a run, thinned, a row a chain or walker: position (paths, steps, ndim), log_prob (paths, steps)."""

    def __init__(self, trace: xr.DataTree) -> None:
        walkers = walkers_of(trace)
        position = by_walker(parameter_draws(trace), walkers)
        lp = by_walker(trace["sample_stats"]["lp"].transpose("chain", "draw").to_numpy(), walkers)
        every = max(1, lp.size // _MOST_DRAWS)
        self.chains = len(lp)
        self.log_prob: FloatArray = lp[:, :, ::every].reshape(-1, len(range(0, lp.shape[2], every))).astype(float)
        self.position: FloatArray = position[:, :, ::every].reshape(*self.log_prob.shape, -1).astype(float)

    def metric(self) -> FloatArray:
        """Return W with Wᵀ Cov W = 1 for the covariance within the paths, shape (ndim, ndim)."""
        ndim = self.position.shape[2]
        within = (self.position - self.position.mean(axis=1, keepdims=True)).reshape(-1, ndim)
        covariance = within.T @ within / len(within)
        size = np.sqrt(np.diag(covariance))
        size[size == 0] = np.finfo(float).tiny ** 0.25
        values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
        return vectors / np.sqrt(np.maximum(values, 1e-8)) / size[:, None]


def _missed_place(here: _Paths, there: _Paths, log_evidence: float) -> tuple[FloatArray, float, float] | None:
    """Return the other run's best draw that is away from this one: theta, log-probability, share of the mass."""
    W = here.metric()
    ndim = here.position.shape[2]
    own = (here.position @ W).reshape(here.chains, -1, ndim)
    if here.chains == 1:  # its halves stand in for chains
        half = own.shape[1] // 2
        own = own[0, : 2 * half].reshape(2, half, ndim)
    gaps = [cKDTree(np.delete(own, i, axis=0).reshape(-1, ndim)).query(own[i])[0] for i in range(len(own))]
    reach = _FAR * float(np.quantile(gaps, 0.99))
    distance = cKDTree(own.reshape(-1, ndim)).query((there.position @ W).reshape(-1, ndim))[0]
    away = (distance > reach).reshape(there.log_prob.shape)
    log_masses = [_log_mass(x[a], lp[a]) for x, lp, a in zip(there.position, there.log_prob, away, strict=True)]
    known = [_log_mass(x, lp) for x, lp in zip(here.position, here.log_prob, strict=True)]
    mass = float(1.0 / (1.0 + np.exp(np.clip(max(*known, log_evidence) - max(log_masses), -700.0, 700.0))))
    if not (np.isfinite(max(log_masses)) and mass > NEGLIGIBLE):
        return None
    best = np.unravel_index(np.argmax(np.where(away, there.log_prob, -np.inf)), away.shape)
    return there.position[best], float(there.log_prob[best]), mass


def _log_mass(theta: FloatArray, log_prob: FloatArray) -> float:
    """Return E[log P] plus the entropy of a Gaussian with the draws' covariance; −inf for too few of them."""
    if len(theta) < _FEWEST_DRAWS:
        return -np.inf
    sd = theta.std(axis=0)
    if not np.all(sd > 0):
        return -np.inf
    correlation = np.cov((theta - theta.mean(axis=0)) / sd, rowvar=False).reshape(len(sd), len(sd))
    log_det = float(np.linalg.slogdet(correlation)[1] + 2.0 * np.sum(np.log(sd)))
    return float(np.mean(log_prob)) + 0.5 * (len(sd) * np.log(2.0 * np.pi * math.e) + log_det)
