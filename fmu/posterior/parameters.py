"""Parameters to be updated, each with its name, unit, bounds, starting value and prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fmu.arguments import ArgumentError, Bound, check_arguments
from fmu.numbers import customary_unit, given, typed
from fmu.posterior.priors.base import Normal, Prior, Uniform
from fmu.types import FloatArray, Plain

_IN_THE_UNIT = ("mean", "sd", "at", "median", "low", "high", "spike")
"""Prior arguments that are in the parameter's unit."""
DIMENSIONS = ("chain", "draw")
"""Dimensions of the draws in a trace."""


@check_arguments
@dataclass(frozen=True)
class Parameter:
    """An uncertain quantity of the model or of its errors.

    Attributes
    ----------
    name : str
        See `require_name` for the names that are allowed.
    start : float
        Value in the model before updating, in `unit`.
    lower, upper : float
        Bounds in `unit`, which truncate the prior. A bound outside the prior's support is moved to its end.
    prior : Prior
        Defaults to `Uniform`, which needs finite bounds.
    unit : str
        SI unit, for labels, in printable characters; empty for a dimensionless factor.
    group : str
        Name of a group whose parameters may share one α in eq. (6) of Boulkaibet et al. (`fmu.paper.published`);
        see `share_alpha`.
    updated : bool
        Whether the parameter is inferred. If False, it keeps the value `start`, but it may still scatter over the
        modes (`fmu.Discrepancy`). Its bounds and prior then only define where a reduced model must be accurate.

    Raises
    ------
    ValueError
        If the name or the unit is not allowed, or the bounds, the starting value and the prior are inconsistent.
    """

    name: str
    start: float
    lower: Bound = -np.inf
    upper: Bound = np.inf
    prior: Prior = field(default_factory=Uniform)
    unit: str = ""
    group: str = ""
    updated: bool = True

    def __post_init__(self) -> None:
        require_name(self.name)
        if not self.unit.isprintable():
            raise ArgumentError(f"{self.name}.unit", "must have only printable characters", repr(self.unit))
        if not self.lower < self.upper:
            raise ArgumentError(f"{self.name}.upper", f"must exceed lower {typed(self.lower)}", typed(self.upper))
        low, high = self.prior.support
        object.__setattr__(self, "lower", max(self.lower, low))
        object.__setattr__(self, "upper", min(self.upper, high))
        no_mass = ArgumentError(f"{self.name}.prior", "must have probability between the bounds", "none")
        if not self.lower < self.upper:
            raise no_mass
        bounds = f"[{typed(self.lower)}, {typed(self.upper)}]"
        if self.prior.needs_bounds and not np.isfinite(self.upper - self.lower):
            raise ArgumentError(f"{self.name}.prior", "a uniform prior needs finite bounds", bounds)
        if not (np.isfinite(self.start) and self.lower <= self.start <= self.upper):
            raise ArgumentError(f"{self.name}.start", f"must be finite and within {bounds}", typed(self.start))
        if not np.isfinite(self.prior.log_mass(self.lower, self.upper)):
            raise no_mass
        if not self._has_density(self.start):
            raise ArgumentError(f"{self.name}.start", "must be where the prior has a density", typed(self.start))

    @property
    def lowest(self) -> float:
        """Smallest value with a finite log-prior.

        This is `lower`, or the next float above `lower` if the log-prior is not finite at `lower`. An infinite
        bound is returned unchanged.
        """
        ends = not np.isfinite(self.lower) or self._has_density(self.lower)
        return self.lower if ends else float(np.nextafter(self.lower, np.inf))

    @property
    def highest(self) -> float:
        """Largest value with a finite log-prior.

        This is `upper`, or the next float below `upper` if the log-prior is not finite at `upper`. An infinite
        bound is returned unchanged.
        """
        ends = not np.isfinite(self.upper) or self._has_density(self.upper)
        return self.upper if ends else float(np.nextafter(self.upper, -np.inf))

    def _has_density(self, x: float) -> bool:
        return bool(np.isfinite(self.prior.log_pdf(np.array([x]))[0]))


def parameter_in(given: object) -> Parameter | None:
    """Return the setting if it is a parameter to be inferred, or None if it is a known value."""
    return given if isinstance(given, Parameter) else None


def value_and_parameter(given: float | Parameter) -> tuple[float, Parameter | None]:
    """Return (value, None) for a known setting, or (starting value, parameter) for an inferred setting."""
    return (given.start, given) if isinstance(given, Parameter) else (float(given), None)


def value_or_name(given: Any) -> Plain:
    """Return a known setting unchanged, or the parameter name of an inferred setting."""
    inferred = parameter_in(given)
    return given if inferred is None else inferred.name


def prior_in_words(settings: Mapping[str, Any], unit: str) -> str:
    """Return a prior's name and arguments as text, such as ``"normal, mean 0, sd 200"``.

    Arguments in the parameter's `unit` are converted to the customary unit. The arguments of a distribution from
    ``scipy.stats`` stay in SI units.
    """
    factor = 1.0 if str(settings["distribution"]).startswith("scipy") else customary_unit(unit).factor

    def format_value(key: str, value: Any) -> str:
        if isinstance(value, list):
            return f"[{', '.join(map(given, value))}]"
        is_number = isinstance(value, float | int)
        return given(value / (factor if key in _IN_THE_UNIT else 1.0)) if is_number else str(value)

    parts = [f"{key} {format_value(key, value)}" for key, value in settings.items()]
    return ", ".join(parts).removeprefix("distribution ")


def require_name(name: str, key: str = "name") -> None:
    """Raise ValueError if a name cannot be stored in a trace or is not legible.

    Spaces inside the name, Greek letters, ``$``, ``_``, ``%``, ``|``, ``<b>`` and quotes are allowed.
    """
    if not name or "/" in name:
        rule = "must not be empty or contain '/'"
    elif name in DIMENSIONS or name in (".", ".."):
        rule = f"must not be {', '.join(map(repr, DIMENSIONS))}, '.' or '..', which mean something else in a trace"
    elif not name.isprintable() or name != name.strip():
        rule = "must have only printable characters, and no space at its ends"
    else:
        return
    raise ArgumentError(key, rule, repr(name))


def share_alpha(parameters: Sequence[Parameter], alpha: Mapping[str, float]) -> tuple[Parameter, ...]:
    """Return the parameters, with a Gaussian prior of mean 0 and a common α for each group named in `alpha`.

    This is the prior in eq. (6) of Boulkaibet et al. (`fmu.paper.published`).

    Parameters
    ----------
    parameters : sequence of Parameter
    alpha : mapping of group name to float
        α = 1/σ² in the parameters' units. Parameters in other groups keep their prior.

    Raises
    ------
    ValueError
        If a named group has no parameter, or an α is not positive and finite.
    """
    unused = set(alpha) - {p.group for p in parameters}
    if unused:
        raise ArgumentError("alpha", f"every group needs a parameter (none in {sorted(unused)})")
    return tuple(
        replace(p, prior=Normal.from_alpha(alpha[p.group])) if p.group in alpha else p for p in parameters
    )


def box(parameters: Sequence[Parameter]) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper limits, (n,) each, of the box in which a reduced model must be accurate."""
    lower, upper = np.array([p.prior.box(p.lower, p.upper) for p in parameters]).T
    return lower, upper
