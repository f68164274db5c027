"""Structural parameters that are themselves parameters of theta, or that are not inferred."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Future, InTests, Slope, Theta, Varies
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, IntArray

SHARED = "shared"


@dataclass(frozen=True)
class Taken(InTests):
    """A structural parameter whose value in each test is itself a parameter of theta.

    Attributes
    ----------
    columns : ndarray of int, shape (n_tests,)
        For each test, the index of the value in theta.
    own : Parameter or None
        The parameter if each test has its own value; the value in a further test is then drawn from its prior.
        None if tests share values.
    known : mapping of int to float
        Known values in groups (or single tests) in which no value is a parameter of theta, keyed by the index of
        the test. For these tests, the index in `columns` is arbitrary but valid.
    """

    columns: IntArray
    own: Parameter | None = None
    known: Mapping[int, float] = field(default_factory=dict)

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the value in each test, (n, n_tests), and its derivatives, at theta (n, n_parameters)."""
        return theta[:, self.columns], [Slope(self.columns, np.ones((len(theta), len(self.columns))))]

    def losses(self, theta: FloatArray, reference: int) -> FloatArray:
        """Return the relative losses (n, n_tests) compared with test `reference`; known values are included."""
        value = self(theta)[0]
        value[:, list(self.known)] = list(self.known.values())
        return np.asarray(1.0 - value / value[:, [reference]])

    def identity(self, test: int) -> Hashable:
        """Return a key. Tests with equal keys have equal parameter values at every theta."""
        return int(self.columns[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper limits of the parameter's values, (n_tests,) each, for given limits of theta."""
        return lower[self.columns], upper[self.columns]

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the parameter's values (n,) in a further test: prior draws if each test has its own value."""
        if self.own is None:
            return super().next_test(theta, like, future)
        return self.own.prior.draw(future.rng, len(theta), self.own.lower, self.own.upper)


@dataclass(frozen=True)
class Held(InTests):
    """A structural parameter that is not updated: it has its starting value in every test.

    Attributes
    ----------
    parameter : Parameter
    n_tests : int
    """

    parameter: Parameter
    n_tests: int

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the parameter's constant values, (n, n_tests), and an empty list of derivatives."""
        return np.full((len(theta), self.n_tests), self.parameter.start), []

    def identity(self, test: int) -> Hashable:
        """Return a key that is equal for all tests."""
        return None

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the limits of the prior's box (`Prior.box`), (n_tests,) each."""
        p = self.parameter
        low, high = p.prior.box(p.lower, p.upper)
        return np.full(self.n_tests, low), np.full(self.n_tests, high)


class Shared(Varies):
    """The variation ``"shared"``: one value for all tests."""

    kind: ClassVar[str] = SHARED

    def place_of(self, test: Test) -> str:
        """Return the name of the test or group for which a value holds; empty if all tests share one value."""
        return ""

    def own(self, p: Parameter) -> Parameter | None:
        """Return the parameter if each test has its own value of it, or None if tests share values."""
        return None

    def in_tests(self, p: Parameter, of: int, theta: Theta, here: Sequence[int]) -> Taken:
        """Add the parameter to theta, once or for each test or group; return the values in the tests."""
        places = [self.place_of(test) for test in theta.tests]
        number = {
            place: theta.add(replace(p, name=f"{p.name} [{place}]") if place else p, self.kind, of, place)
            for place in dict.fromkeys(places[t] for t in here)
        }
        columns = np.array([number.get(place, 0) for place in places], dtype=np.int64)
        known = {t: theta.tests[t].known[p.name] for t, place in enumerate(places) if place not in number}
        return Taken(columns, self.own(p), known)


class ByTest(Shared):
    """The variation ``"test"``: a separate value in each test."""

    kind = "test"
    by_test = True

    def place_of(self, test: Test) -> str:
        """Return the name of the test."""
        return test.name

    def own(self, p: Parameter) -> Parameter:
        """Return the parameter `p`, because every test has its own value."""
        return p


class ByGroup(Shared):
    """The variation ``"group"``: a separate value in each group of tests."""

    kind = "group"
    by_group = True

    def place_of(self, test: Test) -> str:
        """Return the name of the test's group."""
        return test.group
