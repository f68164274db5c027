"""Whether a run had enough candidates of its mixture to visit each of the components."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fmu.analysis.maxima.results import NEGLIGIBLE
from fmu.analysis.trace.reading import array_of, has
from fmu.samplers.mixture.kernel import CANDIDATE

if TYPE_CHECKING:
    import xarray as xr


TIMES = 20
"""Candidates that are to be expected of each component: their number then scatters by about a quarter."""
_IN_DOUBT = 0.1
"""Warm-up may underestimate the share of a component by this factor."""


class Candidates(NamedTuple):
    """The candidates of a run, after the warm-up.

    Attributes
    ----------
    drawn, needed : int
        How many there were, and how many are needed.
    share : float
        The smallest weight of a component that counts.
    """

    drawn: int
    needed: int
    share: float


def candidates_of(trace: xr.DataTree) -> Candidates | None:
    """Return how many candidates a run had and how many it needs; None if it had none.

    Chains visit a separated maximum by candidates of its component, whose weight says how many are expected. If
    those are few, all chains may have missed what warm-up found, and neither R-hat nor effective sample sizes
    show it. `TIMES` are needed of each component. Warm-up may have underestimated a weight: one below 1 % counts
    as 1 %. One below 0.1 % does not matter.

    Parameters
    ----------
    trace : xarray.DataTree
    """
    if not has(trace, "sample_stats", CANDIDATE):
        return None
    drawn = int(np.sum(~np.isnan(array_of(trace, "sample_stats", CANDIDATE))))
    if not drawn:
        return None
    weights = [mixture["weights"] for mixture in _mixtures_of(trace)]
    shares = np.concatenate([np.array(one) / np.sum(one) for one in weights])
    share = float(np.min(shares[shares >= _IN_DOUBT * NEGLIGIBLE]))
    return Candidates(drawn, math.ceil(TIMES / max(share, NEGLIGIBLE)), share)


def has_curved_mixture(trace: xr.DataTree) -> bool:
    """Say whether the candidates of a run came from a curved mixture, of one group of chains at least."""
    if not has(trace, "sample_stats", CANDIDATE):
        return False
    components = [mixture.get("components") for mixture in _mixtures_of(trace)]
    return any(isinstance(one, dict) and one.get("type") == "CurvedMixture" for one in components)


def _mixtures_of(trace: xr.DataTree) -> list[dict[str, Any]]:
    """Return the settings of the mixture of each group of chains, with which the draws were made."""
    learnt = json.loads(trace.attrs["learnt"])
    if not learnt or int(trace.attrs["groups"]) == 1:
        return [learnt or json.loads(trace.attrs["settings"])]
    return [dict(zip(learnt, each, strict=True)) for each in zip(*learnt.values(), strict=True)]


def growth_for_candidates(trace: xr.DataTree) -> float:
    """Return the factor by which the draws must grow until candidates suffice; at most 1 if they do."""
    found = candidates_of(trace)
    return 0.0 if found is None else found.needed / found.drawn
