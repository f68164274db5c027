"""Detect posterior regions that a run missed. Diagnostics of its own draws cannot reveal them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from fmu.analysis.convergence.effective import by_walker, ess_mean, mcse_mean
from fmu.analysis.convergence.remedies import for_chains_apart, for_missed_maximum
from fmu.analysis.maxima.results import NEGLIGIBLE, Maxima, mass_in_words, theta_in_words
from fmu.analysis.trace.reading import array_of, parameter_draws, parameter_names, parameter_units, walkers_of
from fmu.numbers import apart, round_by_sd, share, whole
from fmu.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr


OUT_OF_PROPORTION = 10.0
NEARBY = 0.9999
"""Fraction of a Gaussian inside the ellipsoid within which a draw counts as near a maximum."""
_ABOVE = 0.1


class Comparison(NamedTuple):
    """Messages about maxima whose shares of the draws disagree with their posterior probabilities.

    Attributes
    ----------
    reasons : list of str
        Reasons why the run has not converged: maxima that it missed, or visited out of proportion.
    outweighed : list of str
        Disagreements in which the run has the larger ESS, so that the probability from importance sampling is
        taken to be wrong.
    """

    reasons: list[str]
    outweighed: list[str]


def nearest_maxima(theta: FloatArray, maxima: Maxima) -> IntArray:
    """Return the index of the maximum nearest to each draw (n, ndim), shape (n,); −1 if none is near.

    A draw is near a maximum if it is inside the ellipsoid that would contain the fraction `NEARBY` of a Gaussian
    with the maximum's quadratic model. A draw near several maxima is assigned to the one whose model is highest
    there.
    """
    drop = maxima.drop(theta)
    height = np.where(drop <= _reach(theta), _peaks(maxima) - drop, -np.inf)
    return np.where(np.all(np.isneginf(height), axis=0), -1, np.argmax(height, axis=0))


def draws_of_maxima(theta: FloatArray, log_prob: FloatArray, maxima: Maxima) -> IntArray:
    """Assign each draw to a maximum; return the maxima's indices, shape (n,), or −1 for no maximum.

    A draw near a maximum (`nearest_maxima`) is assigned to it. If a maximum is on a curved ridge, many draws lie
    outside the maximum's ellipsoid. A draw near no maximum is therefore assigned to the one whose quadratic model
    falls least, provided that the draw's log-probability is at least the model's value on the surface of this
    ellipsoid. This only divides the draws: it does not show that a maximum was visited, since an unknown mode may
    be as high.

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
    """Return the drop in a Gaussian's log-density from its peak to the ellipsoid with probability `NEARBY`.

    The drop is half the χ² quantile with ndim degrees of freedom.
    """
    return float(gammaincinv(0.5 * theta.shape[1], NEARBY))


def missed_maxima(trace: xr.DataTree, maxima: Maxima) -> list[str]:
    """Return sentences on important maxima that a run missed, or visited out of proportion.

    Parameters
    ----------
    trace : xarray.DataTree
    maxima : Maxima

    Returns
    -------
    list of str
        One sentence per maximum with a remedy, and one sentence on where the chains are. Empty if there are no
        such maxima, if their masses are unreliable, or if the draws are the better estimate (`compare_shares`).
    """
    return compare_shares(trace, maxima).reasons


def compare_shares(trace: xr.DataTree, maxima: Maxima) -> Comparison:
    """Compare the fraction of a run's draws around each maximum with the maximum's posterior probability.

    If the two differ by more than a factor `OUT_OF_PROPORTION`, and are not both below 5 %, one of them is wrong;
    the estimate with the larger ESS counts. For the fraction this is the ESS of the indicator "at this maximum",
    or the number of chains if no chain enters or leaves the maximum. For the probability it is the ESS of the
    importance weights. Nothing is reported for a plain log-density whose maxima have no reliable masses, or for a
    density that is infinite at a bound. If no draw is near some important maximum, only such maxima are reported.
    Otherwise nothing is reported if a draw is higher than all maxima, because their masses are then unreliable.

    Parameters
    ----------
    trace : xarray.DataTree
    maxima : Maxima
    """
    if maxima.are_singular or (maxima.search and not maxima.are_weighed):  # the maxima may hold no mass
        return Comparison([], [])
    walkers = walkers_of(trace)
    draws = parameter_draws(trace)
    theta = draws.reshape(-1, draws.shape[2])
    lp = array_of(trace, "sample_stats", "lp")
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
    if reached >= maxima[0].log_prob + _ABOVE:  # above all maxima found, so the masses are not reliable
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


class Visits(NamedTuple):
    """How a run's draws are divided among the maxima, and how often its chains changed maxima.

    Attributes
    ----------
    share, error : ndarray, shape (maxima,)
        Fraction of the draws assigned to each maximum, and its Monte-Carlo standard error. The error is NaN if no
        chain ever changed maxima, or if the fraction is 0 or 1.
    crossings : ndarray of int, shape (chains,)
        Number of moves from one maximum to another in each chain, summed over the walkers of an ensemble.
    """

    share: FloatArray
    error: FloatArray
    crossings: IntArray


def visits(trace: xr.DataTree, maxima: Maxima) -> Visits:
    """Return the fraction of a run's draws at each maximum, and how often each chain changed maxima."""
    walkers, draws = walkers_of(trace), parameter_draws(trace)
    lp = array_of(trace, "sample_stats", "lp")
    owner = draws_of_maxima(draws.reshape(-1, draws.shape[2]), lp.ravel(), maxima).reshape(len(draws), -1, walkers)
    crossed = (owner[:, 1:] != owner[:, :-1]) & (owner[:, 1:] >= 0) & (owner[:, :-1] >= 0)
    is_at = [(owner == k).reshape(lp.shape).astype(float) for k in range(len(maxima))]
    error = [mcse_mean(at, walkers) if crossed.any() else np.nan for at in is_at]
    return Visits(np.array([at.mean() for at in is_at]), np.array(error), crossed.sum(axis=(1, 2)))


def _effective_visits(at_maximum: BoolArray, walkers: int) -> float:
    """Return the ESS of the fraction of draws at a maximum, given a mask of these draws.

    If no chain enters or leaves the maximum, the starting points alone determine the fraction, and the result is
    the number of chains. If the ESS is undefined, the result is also the number of chains, or of ensembles.
    """
    if walkers == 1 and not np.any(at_maximum[:, 1:] != at_maximum[:, :-1]):
        return float(len(at_maximum))
    effective = ess_mean(at_maximum.astype(float), walkers)
    return effective if np.isfinite(effective) else float(len(at_maximum))


def _effective_weights(maxima: Maxima, k: int) -> float:
    """Return the ESS of a maximum's estimated mass.

    A maximum with only a Laplace approximation has less than e⁻²⁵ of the largest mass, or no draw of finite
    weight. Such a mass is certainly negligible if the other masses are right, so the largest ESS of any maximum is
    returned.
    """
    return maxima[k].effective_draws or max(m.effective_draws for m in maxima)


def _name(maxima: Maxima, k: int) -> str:
    return f"{maxima.title(k)} at {theta_in_words(maxima.names, maxima[k].theta, maxima.units, maxima[k].sd)}"


def _never_visited(maxima: Maxima, k: int, reached: float) -> str:
    there, here = apart(maxima[k].log_prob, reached, sd=1.0)
    return (
        f"{_name(maxima, k)} was never visited: its log-probability is {there} (best draw: {here}), and it "
        f"holds {mass_in_words(maxima[k].share)} of the probability"
    )


def _is_out_of_proportion(visits: float, mass: float) -> bool:
    """Return True if a fraction of draws and a probability, not both below 5 %, differ more than tenfold."""
    if max(visits, mass) < 5 * NEGLIGIBLE:
        return False
    return visits > OUT_OF_PROPORTION * mass or mass > OUT_OF_PROPORTION * visits


def _whereabouts(nearest: IntArray, maxima: Maxima) -> str:
    """Return a clause that says how many chains or walkers are around each maximum, or near none.

    `nearest` (chains, steps, walkers) contains the index of each draw's maximum, or −1 if the draw is near no
    maximum. A chain or walker counts where it has the most draws.
    """
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
                f"around {_name(maxima, k)} (log-probability {round_by_sd(maxima[k].log_prob, 1.0)}, "
                f"{mass_in_words(maxima[k].share)} of the probability)"
            )
        parts.append(f"{count} {kind}{'s are' if count > 1 else ' is'} {where}")
    return "; ".join(parts)


def _each_path(nearest: IntArray) -> IntArray:
    """Reshape (chains, steps, walkers) to one row per chain, or per walker of an ensemble."""
    return nearest.swapaxes(1, 2).reshape(-1, nearest.shape[1])


_MOST_DRAWS = 4000
_FEWEST_DRAWS = 20
_FAR = 3.0


def check_parameters(trace: xr.DataTree, others: Mapping[str, xr.DataTree]) -> None:
    """Raise ValueError unless all other runs have the parameters of `trace`."""
    names = parameter_names(trace)
    for name, other in others.items():
        if parameter_names(other) != names:
            raise ValueError(f"others.{name}: must have the parameters {names} (got {parameter_names(other)})")


def missed_places(
    trace: xr.DataTree, others: Mapping[str, xr.DataTree], maxima: Maxima | None = None
) -> list[str]:
    """Return a sentence for each other run that visited a region with over 1 % of the mass, if this run missed it.

    A draw of another run is far if its distance to every draw of this run exceeds three times the gap between this
    run's chains, in the metric of the covariance within those chains. The gap is the 99 % quantile of the
    distances from a draw to the nearest draw of another chain, or of the other half of a single chain. The mass of
    the far draws is estimated as exp(E[log P] + S), where S is the entropy of a Gaussian; this is exact if P is
    Gaussian. It is compared with the same estimate for this run, or with the total mass of the known maxima if
    that is larger. Regions near a known maximum are left to `missed_maxima`.

    Parameters
    ----------
    trace : xarray.DataTree
    others : mapping of str to xarray.DataTree
    maxima : Maxima, optional
        The known maxima.

    Returns
    -------
    list of str
        One sentence for each other run that visited a missed region.

    Raises
    ------
    ValueError
        If another run has different parameters.
    """
    check_parameters(trace, others)
    found = []
    names = parameter_names(trace)
    here = _Paths(trace)
    for name, other in others.items():
        place = _missed_place(here, _Paths(other), -np.inf if maxima is None else maxima.log_evidence)
        if place is not None and not (maxima is not None and nearest_maxima(place[0][None], maxima)[0] >= 0):
            theta, log_prob, mass = place
            there, best = apart(log_prob, float(here.log_prob.max()), sd=1.0)
            where = theta_in_words(names, theta, parameter_units(trace))
            found.append(
                f"run {name} visited {where}, and no draw of this run is near: the log-probability there is "
                f"{there} (best draw here: {best}), and it holds {mass_in_words(mass)} of the "
                f"probability{for_missed_maximum(trace)}"
            )
    return found


class _Paths:
    """Thinned draws, with one path per chain or walker.

    Attributes
    ----------
    chains : int
        Number of chains or ensembles.
    position : ndarray, shape (paths, steps, ndim)
    log_prob : ndarray, shape (paths, steps)
    """

    def __init__(self, trace: xr.DataTree) -> None:
        walkers = walkers_of(trace)
        position = by_walker(parameter_draws(trace), walkers)
        lp = by_walker(array_of(trace, "sample_stats", "lp"), walkers)
        every = max(1, lp.size // _MOST_DRAWS)
        self.chains = len(lp)
        self.log_prob: FloatArray = lp[:, :, ::every].reshape(-1, len(range(0, lp.shape[2], every))).astype(float)
        self.position: FloatArray = position[:, :, ::every].reshape(*self.log_prob.shape, -1).astype(float)

    def metric(self) -> FloatArray:
        """Return W with Wᵀ C W = I, where C is the covariance within the paths, shape (ndim, ndim).

        Eigenvalues of the correlation matrix below 1e-8 are raised to this value.
        """
        ndim = self.position.shape[2]
        within = (self.position - self.position.mean(axis=1, keepdims=True)).reshape(-1, ndim)
        covariance = within.T @ within / len(within)
        size = np.sqrt(np.diag(covariance))
        size[size == 0] = np.finfo(float).tiny ** 0.25
        values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
        return vectors / np.sqrt(np.maximum(values, 1e-8)) / size[:, None]


def _missed_place(here: _Paths, there: _Paths, log_evidence: float) -> tuple[FloatArray, float, float] | None:
    """Return the other run's best draw in a missed region, its log-probability, and the region's probability.

    Return None if the probability is negligible.
    """
    W = here.metric()
    ndim = here.position.shape[2]
    own = (here.position @ W).reshape(here.chains, -1, ndim)
    if here.chains == 1:  # the halves of the chain replace the chains
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
    """Estimate log ∫ P over a region from the draws in it.

    The estimate is E[log P] plus the entropy of a Gaussian with the draws' covariance. It is −inf for fewer than
    20 draws, or if a parameter is constant.
    """
    if len(theta) < _FEWEST_DRAWS:
        return -np.inf
    sd = theta.std(axis=0)
    if not np.all(sd > 0):
        return -np.inf
    correlation = np.cov((theta - theta.mean(axis=0)) / sd, rowvar=False).reshape(len(sd), len(sd))
    log_det = float(np.linalg.slogdet(correlation)[1] + 2.0 * np.sum(np.log(sd)))
    return float(np.mean(log_prob)) + 0.5 * (len(sd) * np.log(2.0 * np.pi * math.e) + log_det)
