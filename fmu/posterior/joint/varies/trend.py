"""Trends of a structural parameter with covariates of the tests, in addition to any other variation."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Factor, Future, InTests, Multiplied, Slope, Theta
from fmu.posterior.joint.varies.covariates import Covariate, find_mistakes_of_covariate, known_values
from fmu.posterior.joint.varies.laws import Effect, Law, law_of
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Prior
from fmu.types import FloatArray, Plain

_FEW = 3
"""Largest number of parameters listed in the name of a common slope."""

Slopes = Mapping[str, Mapping[str, Prior | Law | str]]
"""How parameters depend on covariates, keyed by parameter name and covariate name; see `fmu.JointProblem`."""


class OnCovariate(NamedTuple):
    """The effect of one covariate on a parameter."""

    effect: Effect
    covariate: Covariate


@dataclass(frozen=True)
class Trend(Multiplied):
    """A structural parameter that also depends on covariates x_k: θ = θ₀ (1 + Σ_k g_k(x_k)).

    Attributes
    ----------
    of : InTests
        θ₀, the value if every covariate equals its mean over the tests.
    effects : tuple of OnCovariate
        The effects g_k, each of which is zero at its covariate's mean.
    """

    effects: tuple[OnCovariate, ...]

    def factor(self, theta: FloatArray) -> Factor:
        """Return each test's factor 1 + Σ_k g_k(x_k) on the value, at theta (n, n_parameters)."""
        n_tests = len(self.effects[0].covariate.values)
        factor, found = np.ones((len(theta), n_tests)), []
        for effect, covariate in self.effects:
            g, by_parameters, by_x = effect.evaluate(theta[:, effect.columns], covariate.at(theta), covariate.mean)
            factor = factor + g
            for k, column in enumerate(effect.columns):
                found.append(Slope(np.full(n_tests, column), by_parameters[:, k]))
            if covariate.is_inferred.any():
                found.append(Slope(covariate.columns, np.where(covariate.is_inferred, by_x, 0.0)))
        return Factor(factor, found)

    def losses(self, theta: FloatArray, reference: int) -> FloatArray:
        """Return the relative losses (n, n_tests) compared with test `reference`, without trends and scatter."""
        return self.of.losses(theta, reference)

    def identity(self, test: int) -> Hashable:
        """Return a key. Tests with equal keys have equal parameter values at every theta."""
        return self.of.identity(test), *(covariate.identity(test) for _, covariate in self.effects)

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits that the parameter's values rarely exceed, (n_tests,) each, for given limits of theta."""
        low, high = self.of.box(lower, upper)
        factors = np.ones((2, len(low)))
        for effect, covariate in self.effects:
            ends = lower[list(effect.columns)], upper[list(effect.columns)]
            corners = np.array(list(product(*zip(*ends, strict=True))))
            x = np.stack([covariate.at(end[None])[0] for end in (lower, upper)])
            middle, near = x.mean(axis=0), 0.5 * (x + x.mean(axis=0))
            # the product of two standard normal variables rarely exceeds 8: for example 4 times 2
            points = [(corners, near[0]), (corners, near[1]), (corners, middle)]
            points += [(np.mean(ends, axis=0)[None], one) for one in x]
            found = np.concatenate([effect.evaluate(b, at[None], covariate.mean).effect for b, at in points])
            factors = factors + np.stack([found.min(axis=0), found.max(axis=0)])
        corners = np.stack([end * factor for end in (low, high) for factor in factors])
        return corners.min(axis=0), corners.max(axis=0)

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the parameter's values (n,) in a further test. They include the effects of its covariates."""
        factor = np.ones(len(theta))
        for effect, covariate in self.effects:
            x = np.full((1, 1), future.covariates.get(covariate.name, covariate.mean))
            factor = factor + effect.evaluate(theta[:, effect.columns], x, covariate.mean).effect[:, 0]
        return self.of.next_test(theta, like, future) * factor


class Trends:
    """Collects the trends of the structural parameters while a layout is built.

    Parameters
    ----------
    structural : sequence of Parameter
        The structural parameters.
    slopes : mapping of str to mapping of str to Prior, Law or str
        As in `fmu.JointProblem`, which has checked them.
    theta : Theta
        Collects the laws' parameters.
    """

    def __init__(self, structural: Sequence[Parameter], slopes: Slopes, theta: Theta) -> None:
        self._names = [p.name for p in structural]
        self._slopes, self._theta = slopes, theta
        self._laws = {
            (name, covariate): law
            for name, by in slopes.items()
            for covariate, how in by.items()
            if (law := law_of(how)) is not None
        }
        self._effects: dict[tuple[str, str], OnCovariate] = {}

    def add_to(self, of: InTests, name: str) -> InTests:
        """Return the parameter `name` with its trends, or `of` itself if the parameter has no trends.

        `of` gives the values without trends. The parameters of the laws are added to theta, unless another
        parameter with the same law has added them.
        """
        by = self._slopes.get(name, {})
        effects = tuple(
            self._effect(name if (name, key) in self._laws else str(how), key) for key, how in by.items()
        )
        return Trend(of, effects) if effects else of

    def _effect(self, owner: str, covariate: str) -> OnCovariate:
        """Return a covariate's effect on the parameter `owner`. Other parameters may share this effect.

        The first call for an owner and covariate adds the law's parameters to theta.
        """
        found = self._effects.get((owner, covariate))
        if found is None:
            number, x = self._names.index(owner), self._theta.covariate(covariate)
            both = [name for name in self._names if owner in (name, self._slopes.get(name, {}).get(covariate))]
            effect = self._laws[owner, covariate].bind(
                in_common(both), x, lambda p, kind: self._theta.add(p, kind, number, covariate)
            )
            found = self._effects[owner, covariate] = OnCovariate(effect, x)
        return found


def in_common(names: Sequence[str]) -> str:
    """Join parameter names in words, such as ``"k1 and k2"``, or ``"k1 and 11 others"`` if there are many."""
    if len(names) == 1:
        return names[0]
    shown, last = (names[:-1], names[-1]) if len(names) <= _FEW else (names[:1], f"{len(names) - 1} others")
    return f"{', '.join(shown)} and {last}"


def find_mistakes_of_slopes(slopes: Slopes, names: Sequence[str], tests: Sequence[Test]) -> list[str]:
    """Return error messages about `slopes` that do not fit the parameters `names` or the tests."""
    found = []
    for name, by in slopes.items():
        if name not in names:
            found.append(f"slopes: must name parameters among {', '.join(names)} (got {name!r})")
        for covariate, how in by.items():
            law = law_of(how)
            if law is None:
                own = [n for n in names if law_of(slopes.get(n, {}).get(covariate, "")) is not None]
                if how not in own:
                    among = f", of {', '.join(own)}" if own else ""
                    rule = f"must name a parameter with a law of {covariate} of its own{among}"
                    found.append(f"slopes.{name}: {rule} (got {how!r})")
                continue
            wrong = find_mistakes_of_covariate(covariate, name, tests)
            if not wrong:
                known = known_values(covariate, tests)
                wrong = law.find_mistakes(name, covariate, float(known.min()), float(known.max()))
            found += wrong
    return found


def as_dicts(slopes: Slopes) -> dict[str, Plain]:
    """Return the slopes as dicts of plain Python types."""
    return {
        name: {key: str(how) if (law := law_of(how)) is None else law.as_dict() for key, how in by.items()}
        for name, by in slopes.items()
    }
