"""A parameter that scatters between groups of tests and within them, for example by season and by day."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Factor, Future, InTests, Multiplied, Slope, Theta
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Prior
from fmu.types import FloatArray, IntArray

_FEWEST_GROUPS = 3
_FAR = 300.0
"""Largest |s u| in a factor exp(s u); larger ones are clipped, so that no factor is 0 or infinite."""


@dataclass(frozen=True)
class Nested(Multiplied):
    """A parameter whose value in a test includes an effect of the test's group g: θ = θ₀ (1 + s u_g).

    In a log-normal population, θ = θ₀ exp(s u_g). The effects u_g are standard normal, one for each group of
    tests, and the standard deviation s between groups is inferred. θ₀ scatters within the groups (Gelman & Hill
    2007, *Data Analysis Using Regression and Multilevel/Hierarchical Models*, ch. 12).

    Attributes
    ----------
    of : InTests
        θ₀, the values in the tests without group effects.
    width : int
        Index of s in theta.
    columns : ndarray of int, shape (n_tests,)
        For each test, the index in theta of its group's effect u_g.
    of_logarithm : bool
        Whether the effect is on the logarithm of the value.
    """

    width: int
    columns: IntArray
    of_logarithm: bool

    @classmethod
    def of_groups(
        cls,
        of: InTests,
        between: Prior,
        of_logarithm: bool,
        name: str,
        number: int,
        theta: Theta,
        here: Sequence[int],
    ) -> Nested:
        """Return the values in the tests, after adding s (with the prior `between`) and group effects to theta.

        `number` and `name` are the structural parameter's index and name. `of` gives its values without group
        effects, and `here` lists the tests in which its value is unknown.
        """
        of_groups, least = f"{name} sd between groups", max(0.0, between.support[0])
        s = Parameter(of_groups, between.start_of(of_groups), least, prior=between)
        width = theta.add(s, "sd", number)
        numbers = {
            group: theta.add(
                Parameter(f"{name} effect [{group}]", 0.0, prior=Normal(1.0)), "effect", number, group
            )
            for group in dict.fromkeys(theta.tests[t].group for t in here)
        }
        first = min(numbers.values())
        return cls(of, width, np.array([numbers.get(test.group, first) for test in theta.tests]), of_logarithm)

    def factor(self, theta: FloatArray) -> Factor:
        """Return the factor by which each test's group effect multiplies the value, at theta (n, n_parameters)."""
        s, u = theta[:, [self.width]], theta[:, self.columns]
        factor, by_effect = self._of_effect(s * u)
        by_width = Slope(np.full_like(self.columns, self.width), by_effect * u)
        return Factor(factor, [by_width, Slope(self.columns, by_effect * s)])

    def _of_effect(self, effect: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the factor on the value for each effect s u, and its derivative with respect to the effect.

        Both have the shape of `effect`.
        """
        if self.of_logarithm:
            factor = np.exp(np.clip(effect, -_FAR, _FAR))
            return factor, factor
        return 1.0 + effect, np.ones_like(effect)

    def losses(self, theta: FloatArray, reference: int) -> FloatArray:
        """Return zeros, (n, n_tests): a group effect is scatter, not a loss."""
        return np.zeros((len(theta), len(self.columns)))

    def identity(self, test: int) -> Hashable:
        """Return a key. Tests with equal keys have equal parameter values at every theta."""
        return self.of.identity(test), int(self.columns[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits that the parameter's values rarely exceed, (n_tests,) each, for given limits of theta."""
        # s and u_g are rarely both near their limits
        effects = 0.5 * upper[self.width] * np.stack([lower[self.columns], upper[self.columns]])
        ends = np.stack(self.of.box(lower, upper))
        corners = np.stack([end * factor for end, factor in product(ends, self._of_effect(effects)[0])])
        return corners.min(axis=0), corners.max(axis=0)

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the parameter's values (n,) in a further test that belongs to the group of test `like`."""
        effect = theta[:, self.width] * theta[:, self.columns[like]]
        return self.of.next_test(theta, like, future) * self._of_effect(effect)[0]


def find_mistakes_of_groups(name: str, tests: Sequence[Test]) -> list[str]:
    """Return error messages if the tests do not allow the parameter `name` to differ between groups."""
    rule = f"must be given, as {name} scatters between groups (got none)"
    found = [f"tests.{t}.group: {rule}" for t, test in enumerate(tests) if not test.group]
    groups = {test.group for test in tests if name not in test.known}
    if len(groups) < _FEWEST_GROUPS:
        rule = f"scatters between groups, and needs {_FEWEST_GROUPS} groups or more"
        found.append(f"varies.{name}: {rule} (got {len(groups)})")
    return found


def find_mistakes_of_sds(name: str, tests: Sequence[Test]) -> list[str]:
    """Return error messages if the tests do not allow a separate sd of the parameter `name` in each group."""
    rule = f"must be given, as the sd of {name} differs between groups (got none)"
    found = [f"tests.{t}.group: {rule}" for t, test in enumerate(tests) if not test.group]
    sizes = Counter(test.group for test in tests if name not in test.known and test.group)
    if len(sizes) == 1:
        found.append(f"varies.{name}: has an sd in each group, and needs two groups or more (got 1)")
    rule = "has an sd in each group, and needs two tests or more in it"
    return found + [f"varies.{name}: {rule} (got 1 in {group!r})" for group, n in sizes.items() if n == 1]
