"""Check that a run drew enough candidates from its mixture to visit every component.

A candidate is a point drawn from the mixture and proposed to a chain.
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
"""Expected number of candidates that each component needs; the actual number scatters by about a quarter."""
_IN_DOUBT = 0.1
"""Factor by which the warm-up may underestimate a component's weight."""


class Candidates(NamedTuple):
    """Number of mixture candidates that a run drew, and the number that it needs.

    Attributes
    ----------
    drawn : int
        Number of candidates drawn after warm-up.
    needed : int
        Number needed to visit every component often enough.
    share : float
        Smallest weight of any component; weights below 0.1 % are ignored.
    """

    drawn: int
    needed: int
    share: float


def candidates_of(trace: xr.DataTree) -> Candidates | None:
    """Return the number of mixture candidates that a run drew and the number it needs, or None if it drew none.

    Chains reach a separate maximum through candidates from the mixture component at this maximum. The weight of
    the component determines how many such candidates are expected. If few are expected, every chain may have
    missed a maximum that warm-up found, and neither R-hat nor ESS would show it. Every component therefore needs
    `TIMES` candidates. Since warm-up may have underestimated a weight, weights below 1 % count as 1 %. Components
    with weights below 0.1 % are ignored.

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
    """Return True if any group of chains drew its candidates from a curved mixture."""
    if not has(trace, "sample_stats", CANDIDATE):
        return False
    components = [mixture.get("components") for mixture in _mixtures_of(trace)]
    return any((mapping_in(one) or {}).get("type") == "CurvedMixture" for one in components)


def _mixtures_of(trace: xr.DataTree) -> list[dict[str, Any]]:
    """Return a list of mixture settings as dicts: one for each group of chains, or a single one for all groups."""
    learnt = json.loads(trace.attrs["learnt"])
    if not learnt or int(trace.attrs["groups"]) == 1:
        return [learnt or json.loads(trace.attrs["settings"])]
    return [dict(zip(learnt, each, strict=True)) for each in zip(*learnt.values(), strict=True)]


def growth_for_candidates(trace: xr.DataTree) -> float:
    """Return the factor by which the number of draws must grow to give enough mixture candidates.

    The factor is at most 1 if there are enough already, and 0 if the run drew no candidates.
    """
    found = candidates_of(trace)
    return 0.0 if found is None else found.needed / found.drawn
