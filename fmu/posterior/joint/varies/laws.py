"""Laws by which a parameter depends on a covariate x: polynomials and piecewise linear functions.

A law gives the relative effect g(x) on the parameter. It is zero at x₀, the covariate's mean over the tests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import given
from fmu.posterior.joint.varies.covariates import Covariate
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior, prior_in
from fmu.types import FloatArray, Plain

Add = Callable[[Parameter, str], int]
"""Adds a parameter with a kind (see `fmu.posterior.joint.varies.base.Role`) to theta, and returns its index."""


class Evaluated(NamedTuple):
    """A covariate's effects in the tests, and their derivatives.

    Attributes
    ----------
    effect : ndarray, shape (n, n_tests)
    by_parameters : ndarray, shape (n, n_columns, n_tests)
        Derivatives with respect to the law's parameters.
    by_x : ndarray, shape (n, n_tests)
        Derivatives with respect to the covariate.
    """

    effect: FloatArray
    by_parameters: FloatArray
    by_x: FloatArray


class Effect:
    """Relative effect g(x) of a covariate on a structural parameter, as a function of parameters in theta.

    Attributes
    ----------
    columns : tuple of int
        Indices in theta of the law's parameters.
    """

    columns: tuple[int, ...]

    def evaluate(self, parameters: FloatArray, x: FloatArray, x0: float) -> Evaluated:
        """Return the covariate's effects at x, and their derivatives.

        Parameters
        ----------
        parameters : ndarray, shape (n, n_columns)
            Values of the law's parameters.
        x : ndarray, shape (n, n_tests) or (1, n_tests)
            Values of the covariate.
        x0 : float
            The covariate value at which the effect is zero.
        """
        raise NotImplementedError


class Law:
    """A law by which a parameter depends on a covariate."""

    def bind(self, of: str, covariate: Covariate, add: Add) -> Effect:
        """Add the law's parameters to theta with `add`; return the effect.

        The names of the parameters begin with `of`.
        """
        raise NotImplementedError

    def find_mistakes(self, of: str, name: str, low: float, high: float) -> list[str]:
        """Return error messages if the law does not fit the range of the covariate `name` in the tests.

        The covariate's known values and medians range from `low` to `high`.
        """
        return []

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        raise NotImplementedError


@check_arguments
@dataclass(frozen=True)
class Polynomial(Law):
    """A polynomial in a covariate: g(x) = b₁ (x − x₀) + b₂ (x − x₀)² + ….

    Attributes
    ----------
    priors : sequence of Prior
        Priors of the coefficients b₁, b₂, …; their number is the degree of the polynomial. The unit of b_p is the
        unit of 1/x^p. A single prior gives a straight line, exactly as if that prior were given instead of a law.

    Raises
    ------
    ValueError
        If there is no prior.
    """

    priors: Sequence[Prior]

    def __post_init__(self) -> None:
        if not self.priors:
            raise ArgumentError("priors", "must have a prior for each coefficient", "none")
        object.__setattr__(self, "priors", tuple(self.priors))

    def bind(self, of: str, covariate: Covariate, add: Add) -> PolynomialEffect:
        """Add one coefficient per power to theta; return the effect."""
        powers = ("", *(f"^{p}" for p in range(2, len(self.priors) + 1)))
        names = (f"{of} per {covariate.name}{power}" for power in powers)
        return PolynomialEffect(
            tuple(add(slope(name, prior), "slope") for name, prior in zip(names, self.priors, strict=True))
        )

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        return {"law": "polynomial", "priors": [prior.as_dict() for prior in self.priors]}


@dataclass(frozen=True)
class PolynomialEffect(Effect):
    """Effect of a polynomial. `columns` are the indices in theta of its coefficients."""

    columns: tuple[int, ...]

    def evaluate(self, parameters: FloatArray, x: FloatArray, x0: float) -> Evaluated:
        """Return the covariate's effects at x, with their derivatives; see `Effect.evaluate`."""
        powers = np.arange(1, len(self.columns) + 1)[:, None]
        away = (x - x0)[:, None]
        terms, b = away**powers, parameters[:, :, None]
        return Evaluated(
            np.sum(b * terms, axis=1),
            np.broadcast_to(terms, (len(parameters), *terms.shape[1:])),
            np.sum(b * powers * away ** (powers - 1), axis=1),
        )


@check_arguments
@dataclass(frozen=True)
class PiecewiseLinear(Law):
    """A piecewise linear law, such as a stiffness that changes faster with temperature below the freezing point.

    g(x) = Σ b_i (clip(x, c_i, c_{i+1}) − clip(x₀, c_i, c_{i+1})), where piece i with the slope b_i lies between
    the kinks c_i and c_{i+1}, and the first and last piece have no outer limit (Peeters & De Roeck 2001, *Earthq.
    Eng. Struct. Dyn.* 30, 149–171, find two such pieces at the Z24 bridge).

    Attributes
    ----------
    prior : Prior
        Prior of each piece's relative slope.
    kinks : sequence of float or Prior
        The covariate values at the kinks, in ascending order. They must lie between the smallest and the largest
        covariate value in the tests. If a prior is given instead, there is one kink, and its position is inferred
        within this range. The log-density is then continuous, but its gradient jumps where this position passes a
        test's covariate value.

    Raises
    ------
    ValueError
        If there is no kink, or the kinks do not ascend.
    """

    prior: Prior
    kinks: Sequence[float] | Prior

    def __post_init__(self) -> None:
        if self._prior_of_kink is not None:
            return
        object.__setattr__(self, "kinks", self._known_kinks)
        if not self._known_kinks or any(b <= a for a, b in pairwise(self._known_kinks)):
            rule = "must be one value or several in ascending order"
            raise ArgumentError("kinks", rule, list(self._known_kinks))

    @property
    def _prior_of_kink(self) -> Prior | None:
        return prior_in(self.kinks)

    @property
    def _known_kinks(self) -> tuple[float, ...]:
        return () if isinstance(self.kinks, Prior) else tuple(map(float, self.kinks))

    def find_mistakes(self, of: str, name: str, low: float, high: float) -> list[str]:
        """Return error messages about kinks outside the range of the covariate in the tests, `low` to `high`.

        The prior of an inferred kink must have some of its probability in this range.
        """
        rule = f"the kinks in {name} must be between its values in the tests, {given(low)} and {given(high)}"
        if self._prior_of_kink is not None:
            without = not np.isfinite(self._prior_of_kink.log_mass(low, high))
            return [f"slopes.{of}: {rule} (got a prior without probability there)"] if without else []
        return [f"slopes.{of}: {rule} (got {given(at)})" for at in self._known_kinks if not low < at < high]

    def bind(self, of: str, covariate: Covariate, add: Add) -> PiecewiseEffect:
        """Add each piece's slope, and the kink if it is inferred, to theta; return the effect."""
        prior = self._prior_of_kink
        ends = ["kink"] if prior is not None else [f"{given(at)}" for at in self._known_kinks]
        pieces = [f"below {ends[0]}", *(f"from {a} to {b}" for a, b in pairwise(ends)), f"above {ends[-1]}"]
        names = (f"{of} per {covariate.name} {piece}" for piece in pieces)
        columns = [add(slope(name, self.prior), "slope") for name in names]
        if prior is None:
            return PiecewiseEffect(tuple(columns), self._known_kinks)
        low, high = float(covariate.values.min()), float(covariate.values.max())
        kink = Parameter(f"{of} kink in {covariate.name}", prior.median_within(low, high), low, high, prior)
        columns.append(add(kink, "kink"))
        return PiecewiseEffect(tuple(columns), None)

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        prior = self._prior_of_kink
        kinks: Plain = list(self._known_kinks) if prior is None else prior.as_dict()
        return {"law": "piecewise-linear", "prior": self.prior.as_dict(), "kinks": kinks}


@dataclass(frozen=True)
class PiecewiseEffect(Effect):
    """Effect of a piecewise linear law.

    The `columns` are the indices in theta of the pieces' slopes, followed by the index of the kink if `kinks` is
    None.
    """

    columns: tuple[int, ...]
    kinks: tuple[float, ...] | None

    def evaluate(self, parameters: FloatArray, x: FloatArray, x0: float) -> Evaluated:
        """Return the covariate's effects at x, with their derivatives; see `Effect.evaluate`."""
        if self.kinks is None:
            b, kinks = parameters[:, :-1, None], parameters[:, -1:, None]
        else:
            b, kinks = parameters[:, :, None], np.array(self.kinks)[None, :, None]
        end = np.full_like(kinks[:, :1], np.inf)
        lower, upper = np.concatenate([-end, kinks], axis=1), np.concatenate([kinks, end], axis=1)
        at = x[:, None]
        terms = np.clip(at, lower, upper) - np.clip(x0, lower, upper)
        by_slopes = np.broadcast_to(terms, (len(parameters), b.shape[1], x.shape[1]))
        by_x = np.sum(b * ((at > lower) & (at <= upper)), axis=1)
        if self.kinks is not None:
            return Evaluated(np.sum(b * terms, axis=1), by_slopes, by_x)
        beyond = (at > kinks).astype(float) - (x0 > kinks)
        by_kink = (b[:, :1] - b[:, 1:]) * beyond
        return Evaluated(np.sum(b * terms, axis=1), np.concatenate([by_slopes, by_kink], axis=1), by_x)


def slope(name: str, prior: Prior) -> Parameter:
    """Return a relative slope as a parameter of theta.

    It starts at the point nearest to zero in the prior's support, or at the median if the density is zero or
    infinite there. Raise ValueError if the prior needs bounds, as `fmu.Uniform` does.
    """
    return Parameter(name, prior.start_near(0.0, *prior.support), prior=prior)


def law_of(how: Prior | Law | str) -> Law | None:
    """Return `how` if it is a law, a straight line if it is a prior for the slope, or None if it is a name."""
    if isinstance(how, str):
        return None
    return Polynomial([how]) if isinstance(how, Prior) else how
