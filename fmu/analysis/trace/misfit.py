"""Squared residuals at the draws, which `fmu.analysis.fit` uses to judge whether the model fits the data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.reading import has
from fmu.types import AnyArray, FloatArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem

GROUP = "misfit"
"""Name of the trace group that stores the squared residuals."""
QUANTITIES = "quantities"
"""Name of the trace group with data other than modes, such as a weighed mass."""
TAILS = np.logspace(-6.0, 0.0, 121)
"""Upper tail probabilities at which prior quantiles of an inferred standard deviation are stored."""


def has_scores(trace: xr.DataTree) -> bool:
    """Return True if ``squares`` are squared normal scores, because repeated tests gave standard deviations."""
    known = trace[GROUP].attrs if has(trace, GROUP) else {}
    return bool(known["scores"]) if "scores" in known else has(trace, "observed_data", "tests")


def misfit_group(
    problem: UpdatingProblem, squares: FloatArray, coordinates: Mapping[str, object]
) -> dict[str, xr.Dataset]:
    """Return the trace group ``misfit`` in a dict.

    The dict is empty if the likelihood has neither error models for modes nor FRFs, or if its error is the modal
    residual.

    Parameters
    ----------
    problem : UpdatingProblem
    squares : ndarray, shape (chains, draws, n_kinds, n_modes)
        Squared residuals from `UpdatingProblem.terms_and_misfit`, for n_kinds error models and the modes that are
        used in updating.
    coordinates : mapping
        Coordinates of chain, draw and mode.

    Returns
    -------
    mapping of str to xarray.Dataset
        The group has ``squares`` (chain, draw, quantity, mode), which is Σ r² over the standardised residuals of a
        mode. If the model is correct, it is chi-square distributed with ``freedom`` (quantity) degrees of freedom.
        If standard deviations are inferred, the group also has ``noise_isf`` (noise, tail), the value that the
        prior exceeds with the probability ``tail``, and ``noise_of`` (noise), the names of the quantities whose
        errors have this standard deviation.
        Attributes: ``n_data``, the number of independent measured values; ``other``, the quantities that are not
        in ``squares``, because their residuals have another distribution; ``scores``, 1 if any r are normal scores
        of errors whose standard deviations come from the scatter of repeated tests (`has_scores`).
    """
    import xarray as xr

    likelihood = problem.likelihood
    if not (likelihood.terms_of or likelihood.responses):
        return {}
    judged = likelihood.chi_square
    variables: dict[str, tuple[object, AnyArray]] = {
        "squares": (("chain", "draw", "quantity", "mode"), squares),
        "freedom": ("quantity", np.array([term.n_data for term in judged], dtype=int)),
    }
    names = {"quantity": np.array([term.quantity for term in judged], dtype=str)}
    noise = likelihood.noise[: likelihood.n_noise]
    if noise:
        isf = [p.prior.quantile(1.0 - TAILS, p.lower, p.upper) for p in noise]
        of = [[term.quantity for term in likelihood.terms_of if k in term.spread.sizes] for k in range(len(noise))]
        variables["noise_isf"] = (("noise", "tail"), np.array(isf))
        variables["noise_of"] = ("noise", np.array([", ".join(quantities) for quantities in of]))
        names |= {"noise": np.array([p.name for p in noise]), "tail": TAILS}
    n_data = sum(term.n_data for term in likelihood.terms_of) * squares.shape[-1]
    n_data += sum(len(term.labels) for term in likelihood.quantities)
    n_data += sum(term.n_data for term in likelihood.responses)
    other = ", ".join(term.quantity for term in likelihood.terms_of if term not in judged)
    converted = [] if likelihood.has_discrepancy else likelihood.terms_of
    scores = any(term.tests is not None or term.nu is not None for term in converted)
    attributes = {"n_data": n_data, "other": other, "scores": int(scores)}
    found = xr.Dataset(variables, coords={**coordinates, **names}, attrs=attributes)
    return {GROUP: found}


def quantities_group(
    problem: UpdatingProblem, position: FloatArray, coordinates: Mapping[str, object]
) -> dict[str, xr.Dataset]:
    """Return the trace group ``quantities`` in a dict, or an empty dict if no mass or displacement was measured.

    Parameters
    ----------
    problem : UpdatingProblem
    position : ndarray, shape (chains, draws, ndim)
    coordinates : mapping
        Coordinates of chain and draw.

    Returns
    -------
    mapping of str to xarray.Dataset
        The group has ``computed`` (chain, draw, datum), ``measured``, ``sd`` and ``unit`` (datum).
    """
    import xarray as xr

    terms = problem.likelihood.quantities
    if not terms:
        return {}
    theta = problem.model_parameters(position.reshape(-1, position.shape[-1]))
    computed = np.concatenate([term.computed(theta)[0] for term in terms], axis=1)
    variables = {
        "computed": (("chain", "draw", "datum"), computed.reshape(*position.shape[:2], -1)),
        "measured": ("datum", np.concatenate([term.measured for term in terms])),
        "sd": ("datum", np.concatenate([term.sd for term in terms])),
        "unit": ("datum", np.concatenate([term.units for term in terms])),
    }
    labels = [label for term in terms for label in term.labels]
    return {QUANTITIES: xr.Dataset(variables, coords={**coordinates, "datum": labels})}
