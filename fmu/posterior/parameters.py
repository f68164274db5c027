"""Updating parameters: name, unit, bounds, start and prior."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.arguments import ArgumentError, Bound, check_arguments
from fmu.numbers import customary_unit, given, typed
from fmu.posterior.priors.base import Normal, Prior, Uniform
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.joint.layout import Layout

_IN_THE_UNIT = ("mean", "sd", "at", "median", "low", "high")
"""Settings of priors that are values of the parameter."""
DIMENSIONS = ("chain", "draw")
"""Dimensions of the draws in a trace."""


@check_arguments
@dataclass(frozen=True)
class Parameter:
    """One uncertain quantity of the model.

    Attributes
    ----------
    name : str
        See `require_name`.
    start : float
        Value in the model before updating, in `unit`.
    lower, upper : float
        Bounds; they truncate the prior. They are moved inwards to the ends of the support of the prior.
    prior : Prior
        `Uniform` by default, which needs finite bounds.
    unit : str
        SI unit, for labels, in printable characters; empty for a factor.
    group : str
        Parameters of one group may share their α in eq. (6), see `share_alpha`.

    Raises
    ------
    ValueError
        If the name is not allowed, or bounds, start and prior do not fit together.
    """

    name: str
    start: float
    lower: Bound = -np.inf
    upper: Bound = np.inf
    prior: Prior = field(default_factory=Uniform)
    unit: str = ""
    group: str = ""

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
        if not (np.isfinite(self.start) and self.lower <= self.start <= self.upper):
            bounds = f"[{typed(self.lower)}, {typed(self.upper)}]"
            raise ArgumentError(f"{self.name}.start", f"must be finite and within {bounds}", typed(self.start))
        if self.prior.needs_bounds and not np.isfinite(self.upper - self.lower):
            raise ArgumentError(
                f"{self.name}.prior",
                "a uniform prior needs finite bounds",
                f"[{typed(self.lower)}, {typed(self.upper)}]",
            )
        if not np.isfinite(self.prior.log_mass(self.lower, self.upper)):
            raise no_mass
        if not self._has_density(self.start):
            raise ArgumentError(f"{self.name}.start", "must be where the prior has a density", typed(self.start))

    @property
    def lowest(self) -> float:
        """Lowest value with a positive density: `lower`, or the next number above if the prior is zero there."""
        ends = not np.isfinite(self.lower) or self._has_density(self.lower)
        return self.lower if ends else float(np.nextafter(self.lower, np.inf))

    @property
    def highest(self) -> float:
        """Highest value with a positive density: `upper`, or the next number below if the prior is zero there."""
        ends = not np.isfinite(self.upper) or self._has_density(self.upper)
        return self.upper if ends else float(np.nextafter(self.upper, -np.inf))

    def _has_density(self, x: float) -> bool:
        return bool(np.isfinite(self.prior.log_pdf(np.array([x]))[0]))


def prior_in_words(settings: Mapping[str, Any], unit: str) -> str:
    """Return the name and the numbers of a prior, those in `unit` as they are shown: ``"normal, sd 200"``."""
    factor = 1.0 if str(settings["distribution"]).startswith("scipy") else customary_unit(unit).factor
    parts = [
        f"{key} {given(value / (factor if key in _IN_THE_UNIT else 1.0)) if isinstance(value, float) else value}"
        for key, value in settings.items()
    ]
    return ", ".join(parts).removeprefix("distribution ")


def require_name(name: str, key: str = "name") -> None:
    """Raise ValueError for a name that a trace could not store or nobody could read.

    Spaces, Greek letters, ``$``, ``_``, ``%``, ``|``, ``<b>`` and quotes are allowed.
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
    """Give every group of parameters its α of eq. (6).

    Parameters
    ----------
    parameters : sequence of Parameter
    alpha : mapping of group name to float
        α = 1/σ² in the parameters' units; parameters of groups not named keep their prior.

    Raises
    ------
    ValueError
        If a group has no parameter.
    """
    unused = set(alpha) - {p.group for p in parameters}
    if unused:
        raise ArgumentError("alpha", f"every group needs a parameter (none in {sorted(unused)})")
    return tuple(
        replace(p, prior=Normal.from_alpha(alpha[p.group])) if p.group in alpha else p for p in parameters
    )


def box(parameters: Sequence[Parameter]) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper limits of the box in which a reduced model must be accurate, shape (n,) each."""
    lower, upper = np.array([p.prior.box(p.lower, p.upper) for p in parameters]).T
    return lower, upper


class JointPrior:
    """The product of the parameters' priors, truncated to the bounds and normalised over them.

    Normal, half-normal and log-normal priors, the common ones, are evaluated together as one array.

    Parameters
    ----------
    parameters : sequence of Parameter
    layout : Layout, optional
        Of several tests with populations, to which scores refer (`fmu.posterior.joint.layout.Layout.log_prior`).
    """

    def __init__(self, parameters: Sequence[Parameter], layout: Layout | None = None) -> None:
        self.parameters = tuple(parameters)
        self._layout = layout
        forms = [(j, form) for j, p in enumerate(parameters) if (form := p.prior.gaussian_form) is not None]
        forms.sort(key=lambda one: (one[1].of_logarithm, one[1].log_factor))
        self._gaussian = np.array([j for j, _ in forms], dtype=int)
        self._n_logs = sum(form.of_logarithm for _, form in forms)
        self._n_direct = len(forms) - self._n_logs
        # a row, like one theta, which spares it NumPy's broadcasting
        self._mean = np.array([form.mean for _, form in forms])[None]
        self._precision = np.array([form.sd for _, form in forms]) ** -2.0
        self._others = [(j, p.prior) for j, p in enumerate(parameters) if p.prior.gaussian_form is None]
        log_mass = sum(p.prior.log_mass(p.lower, p.upper) for p in parameters)
        log_mass -= math.fsum(form.log_factor for _, form in forms)
        self._weight = -0.5 * self._precision
        self._constant = 0.5 * float(np.sum(np.log(self._precision / (2.0 * np.pi)))) - log_mass

    def log_pdf(self, theta: FloatArray) -> FloatArray:
        """Return the log-density, shape (n,), at theta (n, ndim) where every prior has a density."""
        # `take` gives C order, in which a row is summed in the same order whatever the batch; einsum does not warn
        # where it overflows
        x = theta.take(self._gaussian, axis=1)
        constant: float | FloatArray = self._constant
        if self._n_logs:
            x[:, self._n_direct :] = np.log(x[:, self._n_direct :])
            constant = constant - np.einsum("nj->n", x[:, self._n_direct :])
        z = x - self._mean
        value = constant + np.einsum("nj,nj,j->n", z, z, self._weight)
        for j, prior in self._others:
            value = value + prior.log_pdf(theta[:, j])
        return value if self._layout is None else self._layout.log_prior(theta, value)

    def log_pdf_gradient(self, theta: FloatArray) -> FloatArray:
        """Return its gradient, shape (n, ndim)."""
        gradient = np.empty_like(theta)
        x = theta.take(self._gaussian, axis=1)
        with np.errstate(over="ignore"):
            if self._n_logs:
                x_of_logs = x[:, self._n_direct :].copy()
                x[:, self._n_direct :] = np.log(x_of_logs)
            slope = -self._precision * (x - self._mean)
            if self._n_logs:
                slope[:, self._n_direct :] = (slope[:, self._n_direct :] - 1.0) / x_of_logs
        gradient[:, self._gaussian] = slope
        for j, prior in self._others:
            gradient[:, j] = prior.log_pdf_gradient(theta[:, j])
        return gradient if self._layout is None else self._layout.log_prior_gradient(theta, gradient)

    def quadratic(self, theta: FloatArray, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return slope (n, ndim) and curvature −∇² (n, ndim, ndim) of the log-density, in units of `scale`.

        The curvature by each parameter is a difference of slopes over 1e-4, and not negative; by scores it is the
        curvature without bounds.
        """
        slope, curvature = np.empty_like(theta), np.zeros((*theta.shape, theta.shape[1]))
        for k, parameter in enumerate(self.parameters):
            h = 1e-4 * scale[k]
            low, high = parameter.prior.support
            near = np.clip(theta[:, k], low + 2.0 * h, high - 2.0 * h)
            ahead, behind = (parameter.prior.log_pdf_gradient(near + step) for step in (h, -h))
            curvature[:, k, k] = np.maximum(0.0, (behind - ahead) / (2.0 * h)) * scale[k] ** 2
            slope[:, k] = parameter.prior.log_pdf_gradient(theta[:, k]) * scale[k]
        if self._layout is None:
            return slope, curvature
        curvature = self._layout.log_prior_curvature(theta, curvature, scale)
        return self.log_pdf_gradient(theta) * scale, curvature

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw `n` parameter vectors, shape (n, ndim)."""
        theta = np.stack([p.prior.draw(rng, n, p.lower, p.upper) for p in self.parameters], axis=1)
        return theta if self._layout is None else self._layout.draw_from_prior(theta, rng)
