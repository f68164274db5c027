"""Whether a run had enough candidates of its mixture to visit every component.

A candidate is a point that is drawn from the mixture and proposed to a chain.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fmu.analysis.maxima.results import NEGLIGIBLE
from fmu.analysis.trace.reading import array_of, has
from fmu.plain_data import mapping_in
from fmu.samplers.mixture.kernel import CANDIDATE

if TYPE_CHECKING:
    import xarray as xr


TIMES = 20
"""Expected number of candidates required of each component; the actual number scatters by about a quarter."""
_IN_DOUBT = 0.1
"""The warm-up may underestimate the share of a component by this factor."""


class Candidates(NamedTuple):
    """The candidates of a run after the warm-up.

    Attributes
    ----------
    drawn, needed : int
        Number of candidates drawn, and number needed.
    share : float
        The smallest weight of a component that is not negligible.
    """

    drawn: int
    needed: int
    share: float


def candidates_of(trace: xr.DataTree) -> Candidates | None:
    """Return the number of candidates that a run had and the number that it needs; None if it had none.

    Chains visit a separate maximum through candidates of its component, and the weight of the component gives
    their expected number. If this number is small, all chains may have missed a maximum that was found in the
    warm-up, and neither R-hat nor effective sample sizes show it. Every component needs `TIMES` candidates. The
    warm-up may have underestimated a weight: a weight below 1 % counts as 1 %. Components with a weight below 0.1
    % are ignored.

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
    """Return True if the candidates of at least one group of chains came from a curved mixture."""
    if not has(trace, "sample_stats", CANDIDATE):
        return False
    components = [mixture.get("components") for mixture in _mixtures_of(trace)]
    return any((mapping_in(one) or {}).get("type") == "CurvedMixture" for one in components)


def _mixtures_of(trace: xr.DataTree) -> list[dict[str, Any]]:
    """Return a list with the settings of each group's mixture, from which the draws were made."""
    learnt = json.loads(trace.attrs["learnt"])
    if not learnt or int(trace.attrs["groups"]) == 1:
        return [learnt or json.loads(trace.attrs["settings"])]
    return [dict(zip(learnt, each, strict=True)) for each in zip(*learnt.values(), strict=True)]


def growth_for_candidates(trace: xr.DataTree) -> float:
    """Return the factor by which the draws must grow to give enough candidates; at most 1 if there are enough."""
    found = candidates_of(trace)
    return 0.0 if found is None else found.needed / found.drawn
