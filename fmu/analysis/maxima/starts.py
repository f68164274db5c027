"""Where chains start that begin at the maxima of a posterior: in proportion to their shares, and overdispersed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import gammaincinv

from fmu.analysis.maxima.missed import NEARBY, OUT_OF_PROPORTION
from fmu.analysis.maxima.mode_weights import LocalQuadratic
from fmu.analysis.maxima.results import NEGLIGIBLE
from fmu.analysis.trace.conversion import START_STREAM, generator
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    from fmu.analysis.maxima.results import Maxima
    from fmu.types import LogDensity


DISPERSION = 2.0
"""Standard deviation of the starts around a maximum, over that of the posterior there.

Chains that start wider than the posterior must contract to it before they agree, so that R-hat shows a chain which
has not (Gelman & Rubin 1992, Statistical Science 7, 457-472, section 2.1). Twice the width is what one proposal of
the importance sampling has too, and far less than the distance to another maximum. It cannot show a maximum that
the search did not find; nor can starts from the prior, unless one of them happens to fall into its basin.
"""
_HALVINGS = 30


def starts(
    density: LogDensity, init: Any, maxima: Maxima | None, chains: int, walkers: int, seed: int
) -> tuple[Any, Any]:
    """Return where chains start, as `fmu.samplers.Run` takes it, and what a configuration is to say of it.

    Parameters
    ----------
    density : LogDensity
    init : "maxima", "prior", "start" or array_like
        "maxima" is the prior where no maxima are known.
    maxima : Maxima or None
    chains, walkers, seed : int
        See `starts_at_maxima`.
    """
    if not isinstance(init, str):
        positions = np.asarray(init, dtype=float)
        return positions, positions
    if init != "maxima":
        return init, init
    if maxima is None:
        return "prior", "prior"
    return starts_at_maxima(density, maxima, chains, walkers, seed), {"maxima": maxima.hash}


def starts_at_maxima(density: LogDensity, maxima: Maxima, chains: int, walkers: int, seed: int) -> FloatArray:
    """Draw the starts of all chains around the maxima, in proportion to the maxima's shares of the probability.

    Around each maximum they come from its quadratic model of the log-probability, `DISPERSION` times as wide as
    the posterior and cut off at the bounds. The model may be wrong so far out: a start where the log-probability
    is lower than on the model's rim, or not finite, is moved halfway towards the maximum until it no longer is.

    Parameters
    ----------
    density : LogDensity
    maxima : Maxima
        What `fmu.find_map` found.
    chains : int
        Chains, or ensembles.
    walkers : int
        Walkers of an ensemble, 1 for samplers whose chain is a single point. The walkers of every ensemble are in
        proportion to the shares.
    seed : int
        Of the run.

    Returns
    -------
    ndarray, shape (chains, ndim) or (chains, walkers, ndim)
        SI units.
    """
    scaled, rng = ScaledDensity(density), generator(seed, START_STREAM)
    share = np.array([m.share for m in maxima])
    home = allotted(share, chains) if walkers == 1 else np.tile(allotted(share, walkers), chains)
    u = np.empty((len(home), scaled.ndim))
    for k in np.unique(home):
        m = maxima[int(k)]
        model = LocalQuadratic(
            scaled.to_scaled(m.theta),
            m.log_prob,
            m.gradient * scaled.scale,
            m.hessian * np.outer(scaled.scale, scaled.scale),
        )
        u[home == k] = _around(model, scaled, rng, int(np.sum(home == k)))
    theta: FloatArray = scaled.to_theta(u)
    return theta if walkers == 1 else theta.reshape(chains, walkers, -1)


def allotted(share: FloatArray, n: int) -> IntArray:
    """Return the maximum (from 0) at which each of `n` chains starts, shape (n,), in ascending order.

    The highest averages method of Webster and Sainte-Laguë, which comes as close to the shares as whole numbers
    can; but every maximum gets one chain first, those of the greatest shares where there are too few chains. A
    maximum takes part if its share is at least 1 % and no less than a tenth of what one chain is worth: with more
    than that, a chain that never leaves it would be out of all proportion (`fmu.analysis.maxima.missed`).

    Parameters
    ----------
    share : ndarray, shape (maxima,)
    n : int
    """
    least = max(NEGLIGIBLE, 1.0 / (OUT_OF_PROPORTION * n))
    order = np.argsort(-share, kind="stable")
    taking_part = order[: max(1, int(np.sum(share >= least)))][:n]
    count = np.zeros(len(share), dtype=np.int64)
    count[taking_part] = 1
    while count.sum() < n:
        count[taking_part[np.argmax((share / (2 * count + 1))[taking_part])]] += 1
    return np.repeat(np.arange(len(share)), count)


def _around(model: LocalQuadratic, scaled: ScaledDensity, rng: np.random.Generator, n: int) -> FloatArray:
    """Return `n` starts around one maximum, shape (n, ndim), scaled."""
    temperature = DISPERSION**2
    u = model.proposal(scaled.lower, scaled.upper, temperature).draw(rng, n)
    rim = model.log_prob - temperature * float(gammaincinv(0.5 * scaled.ndim, NEARBY))
    for _ in range(_HALVINGS):
        log_prob = np.asarray(scaled.log_prob(u))
        too_low = ~(log_prob >= rim)  # NaN is too low
        if not too_low.any():
            break
        u[too_low] = 0.5 * (u[too_low] + model.position)
    return u
