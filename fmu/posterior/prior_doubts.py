"""Check for priors that contradict their bounds, for example because a mean is missing or a unit is wrong."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr

from fmu.numbers import customary_unit, given, names_in_words, share, significant, with_unit
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors import prior_of

LEAST_MASS = 0.05
"""Share of a prior's probability between the bounds below which the prior is reported."""
FAR = 1.0
"""Distance of a prior's centre outside the bounds, in standard deviations, above which the prior is reported."""
NARROW = 1e-4
"""Width of a prior relative to the bounds (without bounds, to its centre) below which the prior is reported."""
_FLAT = 0.1


class Fit(NamedTuple):
    """Position of a prior relative to its bounds.

    Attributes
    ----------
    mass : float
        Prior probability between the bounds.
    centre, sd : float
        Median of the prior before truncation, and half the width of its central 68 % interval, in the parameter's
        unit.
    outside : float
        Distance of the centre outside the bounds in units of `sd`; 0 if the centre is inside.
    median, spread : float
        Median of the truncated prior, and half the width of its central 68 % interval, in the parameter's unit.
    is_flat : bool
        Whether both bounds are finite and the median of the truncated prior differs from their midpoint by less
        than a tenth of the distance between them. A prior with a small `mass` is then taken to be flat.
    """

    mass: float
    centre: float
    sd: float
    outside: float
    median: float
    spread: float
    is_flat: bool


def fit_to_bounds(parameter: Parameter) -> Fit | None:
    """Return a prior's position relative to its bounds, or None if the prior is defined only between bounds."""
    prior, lower, upper = parameter.prior, parameter.lower, parameter.upper
    if prior.needs_bounds:
        return None
    p = ndtr(np.array([-1.0, 0.0, 1.0]))
    left, centre, right = prior.quantile(p, *prior.support).tolist()
    low, median, high = prior.quantile(p, lower, upper).tolist()
    sd = 0.5 * (right - left)
    distance = max(lower - centre, centre - upper, 0.0)
    outside = distance / sd if sd > 0.0 else 0.0 if distance == 0.0 else np.inf
    mass = float(np.exp(prior.log_mass(lower, upper)))
    middle, width = 0.5 * (lower + upper), upper - lower
    is_flat = bool(np.isfinite(width) and abs(median - middle) < _FLAT * width)
    return Fit(mass, centre, sd, outside, median, 0.5 * (high - low), is_flat)


def prior_doubts(parameters: Iterable[Parameter]) -> list[str]:
    """Return messages about priors that contradict their bounds. Each message includes a remedy.

    A prior is reported if less than 5 % of its probability lies between the bounds, if its centre lies outside the
    bounds by more than one standard deviation, or if it is so narrow that the data cannot move the parameter.
    Centre and standard deviation are those of `Fit`. Parameters with equal priors and bounds share a message.
    Uniform priors are never reported.
    """
    return [said for names, one in _alike(parameters) if (said := _doubt(names, one))]


def outside_bounds(configuration: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return a sentence about each prior whose centre lies outside the bounds.

    Each sentence states the prior's probability and its median within the bounds. Parameters with equal priors and
    bounds share a sentence. Priors that `prior_of` does not know, such as distributions from ``scipy.stats``, are
    skipped.

    Parameters
    ----------
    configuration : iterable of dict
        The list ``parameters`` in the dict returned by `UpdatingProblem.configuration`.
    """
    known = []
    for p in configuration:
        prior = prior_of(p["prior"])
        if prior is not None:
            known.append(Parameter(p["name"], p["start"], p["lower"], p["upper"], prior, p["unit"]))
    said = []
    for names, one in _alike(known):
        fit = fit_to_bounds(one)
        if fit is not None and fit.outside > 0.0:
            said.append(
                f"{_priors(names)} {_centre(one, fit)}, outside the bounds, which hold {_mass(fit)} of "
                f"{'its' if len(names) == 1 else 'their'} probability; {'its' if len(names) == 1 else 'their'} "
                f"median within them is {_value(fit.median, one.unit)}."
            )
    return said


def _alike(parameters: Iterable[Parameter]) -> list[tuple[list[str], Parameter]]:
    """Group parameters that have equal priors, bounds and units.

    Return the names in each group, and its first parameter.
    """
    groups: dict[str, tuple[list[str], Parameter]] = {}
    for one in parameters:
        key = str((one.prior.as_dict(), one.lower, one.upper, one.unit))
        groups.setdefault(key, ([], one))[0].append(one.name)
    return list(groups.values())


def _doubt(names: list[str], one: Parameter) -> str:
    fit = fit_to_bounds(one)
    if fit is None:
        return ""
    its = "its" if len(names) == 1 else "their"
    bounds = f"the bounds, {_bounds(one)}, hold {_mass(fit)} of {its} probability"
    if fit.mass < LEAST_MASS and (fit.is_flat or not fit.outside):
        return (
            f"{_priors(names)} {_centre(one, fit)} and much wider than the bounds: {bounds}, so that they limit "
            f"the parameter, and not the prior. Check the unit of {its} standard deviation; if the bounds are "
            "what is known, give a uniform prior."
        )
    if fit.mass < LEAST_MASS or fit.outside > FAR:
        side, where = ("lower", "below") if fit.centre < one.lower else ("upper", "above")
        bound = one.lower if side == "lower" else one.upper
        slip = " (as it is where no mean is given)" if fit.centre == 0.0 else ""
        return (
            f"{_priors(names)} {_centre(one, fit)}{slip}, {significant(fit.outside, 2)} of {its} standard "
            f"deviations {where} the {side} bound: {bounds}, and {its} median within them is "
            f"{_value(fit.median, one.unit)}. The prior presses the parameter against the {side} bound, "
            f"{with_unit(bound, one.unit)}: centre it on the value that is expected, or move the bounds."
        )
    scale = one.upper - one.lower if np.isfinite(one.upper - one.lower) else abs(fit.centre)
    if fit.spread < NARROW * scale:
        sd = f"{significant(fit.spread, 2)} {one.unit}".rstrip()  # in the unit of the problem file
        return (
            f"{_priors(names)} {_centre(one, fit)} with a standard deviation of {sd}: so narrow that "
            "the data cannot move the parameter. Check the unit of the standard deviation; if the value is known "
            "so well, fix it in the model."
        )
    return ""


def _priors(names: list[str]) -> str:
    many = len(names) > 1
    return f"The prior{'s' if many else ''} of {names_in_words(names)} {'are' if many else 'is'}"


def _centre(one: Parameter, fit: Fit) -> str:
    return f"centred on {_value(fit.centre, one.unit)}"


def _value(x: float, unit: str) -> str:
    factor, name = customary_unit(unit)
    return f"{significant(x / factor, 4)} {name}".rstrip()


def _bounds(one: Parameter) -> str:
    factor, unit = customary_unit(one.unit)
    return f"{given(one.lower / factor)} to {given(one.upper / factor)} {unit}".rstrip()


def _mass(fit: Fit) -> str:
    return share(max(fit.mass, 1e-300))
