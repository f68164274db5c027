"""A parameter of the structure that theta has itself: one value for all tests, or one for each test or group."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Future, InTests, Slope, Theta, Varies
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, IntArray

SHARED = "shared"


@dataclass(frozen=True)
class Taken(InTests):
    """A parameter of the structure that is one of theta in each test.

    Attributes
    ----------
    columns : ndarray of int, shape (n_tests,)
    own : Parameter or None
        Where each test has a value of its own: the parameter, whose prior a further test draws from.
    """

    columns: IntArray
    own: Parameter | None = None

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values in every test, shape (n, n_tests), and their derivatives."""
        return theta[:, self.columns], [Slope(self.columns, np.ones((len(theta), len(self.columns))))]

    def identity(self, test: int) -> Hashable:
        """Return an object that is equal in two tests if the value always is."""
        return int(self.columns[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits of the values in every test, for limits of theta (n_parameters,)."""
        return lower[self.columns], upper[self.columns]

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the values (n,) in one more test."""
        if self.own is None:
            return super().next_test(theta, like, future)
        return self.own.prior.draw(future.rng, len(theta), self.own.lower, self.own.upper)


class Shared(Varies):
    """One value for all tests."""

    kind: ClassVar[str] = SHARED

    def place_of(self, test: Test) -> str:
        """Return the test or group that has a value of its own; empty where all share it."""
        return ""

    def own(self, p: Parameter) -> Parameter | None:
        """Return the parameter, whose prior a further test draws from, if every test has a value of its own."""
        return None

    def in_tests(self, p: Parameter, of: int, theta: Theta, here: Sequence[int]) -> Taken:
        """Add one parameter for each place with a value of its own."""
        places = [self.place_of(test) for test in theta.tests]
        number = {
            place: theta.add(replace(p, name=f"{p.name} [{place}]") if place else p, self.kind, of, place)
            for place in dict.fromkeys(places[t] for t in here)
        }
        columns = np.zeros(len(theta.tests), dtype=np.int64)
        columns[here] = [number[places[t]] for t in here]
        return Taken(columns, self.own(p))


class ByTest(Shared):
    """A value of its own in each test."""

    kind = "test"
    by_test = True

    def place_of(self, test: Test) -> str:
        """Return the test."""
        return test.name

    def own(self, p: Parameter) -> Parameter:
        """Return the parameter."""
        return p


class ByGroup(Shared):
    """A value of its own in each group of tests."""

    kind = "group"
    by_group = True

    def place_of(self, test: Test) -> str:
        """Return the group."""
        return test.group
