"""The maxima that a run left out: what no diagnostic of its own draws can tell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from fmu.analysis.diagnostics import parameter_draws, walkers_of
from fmu.analysis.effective import ess_mean
from fmu.analysis.maxima import Maxima
from fmu.analysis.maxima_text import NEGLIGIBLE, RELIABLE, mass_in_words
from fmu.numbers import apart, fixed, rounded, share

if TYPE_CHECKING:
    import xarray as xr

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

OUT_OF_PROPORTION = 10.0
NEARBY = 0.9999
"""A draw is near a maximum within the ellipsoid that holds this much of a Gaussian."""
_ABOVE = 0.1


def nearest_maxima(theta: FloatArray, maxima: Maxima) -> IntArray:
    """Return the maximum (from 0) that each draw (n, ndim) is near to, −1 where there is none.

    A draw is near a maximum where the quadratic model of log P has fallen by no more than in the ellipsoid that
    holds `NEARBY` of a Gaussian; near several, it belongs to the one whose model is highest there.
    """
    drop = maxima.drop(theta)
    height = np.where(drop <= _reach(theta), _peaks(maxima) - drop, -np.inf)
    return np.where(np.all(np.isneginf(height), axis=0), -1, np.argmax(height, axis=0))


def draws_of_maxima(theta: FloatArray, log_prob: FloatArray, maxima: Maxima) -> IntArray:
    """Return the maximum (from 0) that each draw belongs to, −1 where there is none.

    Those near a maximum belong to it. A bent valley leaves the ellipsoid: a draw near none belongs to the maximum
    whose quadratic model falls least, if its own log-probability is no lower than on the rim of that ellipsoid.
    This tells how draws are divided, not whether a maximum was visited: a mode that was not found may be as high.

    Parameters
    ----------
    theta : ndarray, shape (n, ndim)
    log_prob : ndarray, shape (n,)
    maxima : Maxima
    """
    near = nearest_maxima(theta, maxima)
    least = np.argmin(maxima.drop(theta), axis=0)
    is_high = log_prob >= _peaks(maxima)[least, 0] - _reach(theta)
    return np.where((near < 0) & is_high, least, near)


def _peaks(maxima: Maxima) -> FloatArray:
    return np.array([[m.log_prob] for m in maxima])


def _reach(theta: FloatArray) -> float:
    """Return by how much log P of a Gaussian falls to the rim: half of the χ² quantile."""
    return float(gammaincinv(0.5 * theta.shape[1], NEARBY))


def missed_maxima(trace: xr.DataTree, maxima: Maxima) -> list[str]:
    """Name the maxima of more than negligible mass that a run never came near, or visited out of proportion.

    Parameters
    ----------
    trace : xarray.DataTree
    maxima : Maxima

    Returns
    -------
    list of str
        One sentence a maximum, and one that says where the chains are.
    """
    walkers = walkers_of(trace)
    draws = parameter_draws(trace)
    theta = draws.reshape(-1, draws.shape[2])
    lp = trace["sample_stats"]["lp"].transpose("chain", "draw").to_numpy()
    reached = float(lp.max())
    nearest = nearest_maxima(theta, maxima)
    unseen = [k for k, m in enumerate(maxima) if m.share > NEGLIGIBLE and k not in nearest]
    if unseen:
        where = _whereabouts(nearest.reshape(len(draws), -1, walkers), maxima)
        return [*(_never_visited(maxima, k, reached) for k in unseen), f"instead {where}"]
    owner = draws_of_maxima(theta, lp.ravel(), maxima)
    visits = np.bincount(owner[owner >= 0], minlength=len(maxima)) / len(owner)
    # where a draw is above all that was found, or importance sampling failed, the masses are not to be relied on
    if reached >= maxima[0].log_prob + _ABOVE or any(
        m.effective_draws < RELIABLE for m in maxima if m.share > NEGLIGIBLE
    ):
        return []
    wrong = [
        f"{_name(maxima, k)} has {share(v)} of the draws, but {mass_in_words(m.share)} of the probability; "
        f"{_which_is_worth_more((owner == k).reshape(lp.shape), walkers, maxima)}"
        for k, (m, v) in enumerate(zip(maxima, visits.tolist(), strict=True))
        if _is_out_of_proportion(v, m.share)
    ]
    return wrong and [*wrong, _whereabouts(owner.reshape(len(draws), -1, walkers), maxima)]


def _name(maxima: Maxima, k: int) -> str:
    return f"maximum {k + 1} at {maxima.words_of_theta(maxima[k].theta, maxima[k].sd)}"


def _never_visited(maxima: Maxima, k: int, reached: float) -> str:
    there, here = apart(maxima[k].log_prob, reached, sd=1.0)
    return (
        f"{_name(maxima, k)}, with log-probability {there} where the best draw has {here}, was never visited; it "
        f"holds {mass_in_words(maxima[k].share)} of the probability"
    )


def _which_is_worth_more(is_there: NDArray[np.bool_], walkers: int, maxima: Maxima) -> str:
    """Say whether draws (chains, draws) or weights tell better how much of the probability a maximum has."""
    # a chain that never leaves the place it is in is one draw of such places
    draws = float(np.fmax(ess_mean(is_there.astype(float), walkers), len(is_there) * walkers))
    weights = maxima.log_evidence_error**-2
    better = "draws" if draws > weights else "weights"
    return (
        f"the draws are worth {fixed(draws, 0)} independent ones for that, the weights of importance sampling "
        f"{fixed(weights, 0)}: trust the {better}"
    )


def _is_out_of_proportion(visits: float, mass: float) -> bool:
    """Say whether a share of draws and one of mass, of which one matters, differ by more than estimates do."""
    if max(visits, mass) < 5 * NEGLIGIBLE:
        return False
    return visits > OUT_OF_PROPORTION * mass or mass > OUT_OF_PROPORTION * visits


def _whereabouts(nearest: IntArray, maxima: Maxima) -> str:
    """Say which chains (walkers) are where, from the maxima nearest to their draws (chains, steps, walkers)."""
    kind = "chain" if nearest.shape[2] == 1 else "walker"
    homes = np.array(
        [np.bincount(path + 1, minlength=len(maxima) + 1).argmax() - 1 for path in _each_path(nearest)]
    )
    parts = []
    for k in np.unique(homes).tolist():
        count = int(np.sum(homes == k))
        where = "near none of the maxima"
        if k >= 0:
            where = (
                f"around {_name(maxima, k)} (log-probability {rounded(maxima[k].log_prob, 1.0)}, "
                f"{mass_in_words(maxima[k].share)} of the probability)"
            )
        parts.append(f"{count} {kind}{'s are' if count > 1 else ' is'} {where}")
    return "; ".join(parts)


def _each_path(nearest: IntArray) -> IntArray:
    """Return one row a chain, or a walker of an ensemble."""
    return nearest.swapaxes(1, 2).reshape(-1, nearest.shape[1])
