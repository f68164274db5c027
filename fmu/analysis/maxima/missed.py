"""The maxima that a run left out: what no diagnostic of its own draws can tell."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from fmu.analysis.convergence.diagnostics import parameter_draws, walkers_of
from fmu.analysis.convergence.effective import ess_mean
from fmu.analysis.convergence.remedies import for_chains_apart, for_missed_maximum
from fmu.analysis.maxima.results import Maxima
from fmu.analysis.maxima.text import NEGLIGIBLE, mass_in_words
from fmu.numbers import apart, rounded, share, whole
from fmu.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr


OUT_OF_PROPORTION = 10.0
NEARBY = 0.9999
"""A draw is near a maximum within the ellipsoid that holds this much of a Gaussian."""
_ABOVE = 0.1


class Comparison(NamedTuple):
    """How the draws of a run are divided among the maxima, beside what the maxima hold.

    Attributes
    ----------
    reasons : list of str
        Why the run has not converged: maxima left out, or visited out of proportion.
    outweighed : list of str
        Shares that importance sampling gives otherwise, but with fewer effective draws than the run has.
    """

    reasons: list[str]
    outweighed: list[str]


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
        One sentence a maximum with what to do about it, and one that says where the chains are.
    """
    return compared(trace, maxima).reasons


def compared(trace: xr.DataTree, maxima: Maxima) -> Comparison:
    """Compare the shares of a run's draws with the shares of the maxima.

    Where they differ by more than `OUT_OF_PROPORTION` times, one of them is wrong. The one that rests on the
    larger effective number of draws decides. Of the run it is that of being at the maximum or not: one a chain if
    none ever changes maxima. Of importance sampling it is that of the weights.

    Parameters
    ----------
    trace : xarray.DataTree
    maxima : Maxima
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
        remedy = for_missed_maximum(trace)
        return Comparison(
            [*(_never_visited(maxima, k, reached) + remedy for k in unseen), f"the draws were elsewhere: {where}"],
            [],
        )
    if reached >= maxima[0].log_prob + _ABOVE:  # above all that was found: the masses are not to be relied on
        return Comparison([], [])
    owner = draws_of_maxima(theta, lp.ravel(), maxima).reshape(lp.shape)
    wrong, outweighed = [], []
    for k, m in enumerate(maxima):
        visits = float(np.mean(owner == k))
        if not _is_out_of_proportion(visits, m.share):
            continue
        of_draws, of_weights = _effective_visits(owner == k, walkers), _effective_weights(maxima, k)
        what = (
            f"{_name(maxima, k)} has {share(visits)} of the draws (effective size {whole(of_draws)}), but "
            f"{mass_in_words(m.share)} of the probability by importance sampling "
            f"(effective size {whole(of_weights)})"
        )
        if of_draws > of_weights:
            outweighed.append(f"{what}: the draws are the better estimate")
        else:
            wrong.append(what + (for_chains_apart(trace) if visits > m.share else for_missed_maximum(trace)))
    if wrong:
        wrong.append(_whereabouts(owner.reshape(len(draws), -1, walkers), maxima))
    return Comparison(wrong, outweighed)


def _effective_visits(at_maximum: BoolArray, walkers: int) -> float:
    """Return how many independent draws tell the share of a maximum, from which draws (chains, draws) are at it.

    At most one a chain where none ever changes maxima: then only the starts tell.
    """
    if walkers == 1 and not np.any(at_maximum[:, 1:] != at_maximum[:, :-1]):
        return float(len(at_maximum))
    effective = ess_mean(at_maximum.astype(float), walkers)
    return effective if np.isfinite(effective) else float(len(at_maximum))


def _effective_weights(maxima: Maxima, k: int) -> float:
    """Return how many independent draws tell the mass of a maximum.

    One that has been weighed by the Laplace approximation alone is lower by e⁴⁰ at least: that it holds next to
    nothing is known as well as the mass of the others.
    """
    return maxima[k].effective_draws or max(m.effective_draws for m in maxima)


def _name(maxima: Maxima, k: int) -> str:
    return f"maximum {k + 1} at {maxima.words_of_theta(maxima[k].theta, maxima[k].sd)}"


def _never_visited(maxima: Maxima, k: int, reached: float) -> str:
    there, here = apart(maxima[k].log_prob, reached, sd=1.0)
    return (
        f"{_name(maxima, k)} was never visited: its log-probability is {there} (best draw: {here}), and it "
        f"holds {mass_in_words(maxima[k].share)} of the probability"
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
        where = "near no maximum"
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
