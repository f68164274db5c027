"""Scatter between groups of tests in addition to the scatter within them, such as day within season."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Self

import numpy as np

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Future, InTests, Slope, Theta
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Prior
from fmu.types import FloatArray, IntArray

_FEWEST_GROUPS = 3


@dataclass(frozen=True)
class Nested(InTests):
    """A parameter with an effect of each group on its values: θ = θ₀ (1 + s u_g), or θ₀ exp(s u_g).

    The effects u_g are standard normal, one for each group of tests, and the standard deviation s between groups
    is inferred. θ₀ scatters within the groups (Gelman & Hill 2007, *Data Analysis Using Regression and
    Multilevel/Hierarchical Models*, ch. 12).

    Attributes
    ----------
    of : InTests
        θ₀, the values in the tests without effects of groups.
    width : int
        Index in theta of s.
    columns : ndarray of int, shape (n_tests,)
        For each test, the index in theta of the effect u_g of its group.
    of_logarithm : bool
        Whether the effect is on the logarithm of the value.
    """

    of: InTests
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
        """Add s, with the prior `between`, and the effects of groups to theta; return the values in the tests.

        The parameter with the index `number` and the `name` is not known in the tests `here`, and has the values
        `of` without effects.
        """
        median = float(between.quantile(np.array([0.5]), *between.support)[0])
        s = Parameter(f"{name} sd between groups", median, max(0.0, between.support[0]), prior=between)
        width = theta.add(s, "sd", number)
        numbers = {
            group: theta.add(
                Parameter(f"{name} effect [{group}]", 0.0, prior=Normal(1.0)), "effect", number, group
            )
            for group in dict.fromkeys(theta.tests[t].group for t in here)
        }
        first = min(numbers.values())
        return cls(of, width, np.array([numbers.get(test.group, first) for test in theta.tests]), of_logarithm)

    @property
    def base(self) -> InTests:
        """The parameter without effects of groups."""
        return self.of.base

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values (n, n_tests) in all tests at theta (n, n_parameters), and their derivatives."""
        value, slopes = self.of(theta)
        s, u = theta[:, [self.width]], theta[:, self.columns]
        factor, by_effect = self._factor(s * u)
        return value * factor, [
            *(Slope(one.columns, one.values * factor) for one in slopes),
            Slope(np.full_like(self.columns, self.width), value * by_effect * u),
            Slope(self.columns, value * by_effect * s),
        ]

    def _factor(self, effect: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the factors on the values, and their derivatives by the effect s u."""
        if self.of_logarithm:
            return np.exp(effect), np.exp(effect)
        return 1.0 + effect, np.ones_like(effect)

    def losses(self, theta: FloatArray, reference: int) -> FloatArray:
        """Return the relative losses (n, n_tests) since the test `reference`, without scatter: none."""
        return np.zeros((len(theta), len(self.columns)))

    def identity(self, test: int) -> Hashable:
        """Return a key that is equal for two tests if the value in them is equal at every theta."""
        return self.of.identity(test), int(self.columns[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper limits of the values, (n_tests,) each, for limits of theta (n_parameters,)."""
        # s and u_g are rarely both near their limits
        effects = 0.5 * upper[self.width] * np.stack([lower[self.columns], upper[self.columns]])
        ends = np.stack(self.of.box(lower, upper))
        corners = np.stack([end * factor for end, factor in product(ends, self._factor(effects)[0])])
        return corners.min(axis=0), corners.max(axis=0)

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the values (n,) in a further test of the group of test `like`."""
        effect = theta[:, self.width] * theta[:, self.columns[like]]
        return self.of.next_test(theta, like, future) * self._factor(effect)[0]

    def after(self, n: int) -> Self:
        """Return the parameter with the indices of its scores increased by `n`."""
        return replace(self, of=self.of.after(n))

    def refer_to(self, references: Mapping[int, tuple[FloatArray, tuple[float, float]]]) -> Self:
        """Return the parameter with another centring and reference of its scores."""
        return replace(self, of=self.of.refer_to(references))


def find_mistakes_of_groups(name: str, tests: Sequence[Test]) -> list[str]:
    """Return a list of messages that say what the tests lack for the parameter `name` to differ between groups."""
    rule = f"must be given, as {name} scatters between groups (got none)"
    found = [f"tests.{t}.group: {rule}" for t, test in enumerate(tests) if not test.group]
    groups = {test.group for test in tests if name not in test.known}
    if len(groups) < _FEWEST_GROUPS:
        rule = f"scatters between groups, and needs {_FEWEST_GROUPS} groups or more"
        found.append(f"varies.{name}: {rule} (got {len(groups)})")
    return found
