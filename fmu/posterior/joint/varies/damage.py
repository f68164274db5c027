"""A parameter, such as a stiffness, with relative losses between a reference state and later states."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fmu.arguments import check_arguments
from fmu.posterior.joint.modal_test import Test
from fmu.posterior.joint.varies.base import Factor, Future, InTests, Multiplied, Slope, Theta, Varies
from fmu.posterior.joint.varies.population import Population
from fmu.posterior.joint.varies.taken import Taken
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Prior
from fmu.types import BoolArray, FloatArray, IntArray, Plain

_LOWEST, _HIGHEST = -0.5, 0.95
_SD = 0.3


@check_arguments
@dataclass(frozen=True)
class Damage(Varies):
    """A parameter that is reduced by a relative loss d in every group but the reference: θ = θ_reference (1 − d).

    The reference is the group of the first test, unless the problem names another group. A negative loss is a
    gain. Negative losses are allowed because noise produces them if there is no damage; if they were excluded, the
    losses would be biased upwards. Every group needs a test in which the parameter is unknown.

    If the undamaged value itself scatters from test to test, θ_t = F⁻¹(Φ(z_t)) (1 − d). Here F is the distribution
    function of the undamaged values (`Population`), Φ the standard normal distribution function, and z_t the score
    of test t.

    Attributes
    ----------
    prior : Prior, optional
        Prior of each loss, which is truncated at −0.5 and 0.95. Default: normal with mean 0 and standard deviation
        0.3. If few parameters are expected to be damaged, use `fmu.SpikeAndSlab(share)`, where ``share`` is the
        probability that a parameter is damaged. This prior shrinks small losses to zero and hardly changes
        large losses. (With a horseshoe prior and precise tests, HMC did not converge.)
    scatter : Population, optional
        Population of the undamaged values in the tests. By default all tests in a group have the same value.
    """

    prior: Prior | None = None
    scatter: Population | None = None
    by_group: ClassVar[bool] = True

    @property
    def population(self) -> Population | None:
        """Population of the undamaged values; None if they are the same in all tests."""
        return self.scatter

    def find_mistakes(self, name: str, tests: Sequence[Test]) -> list[str]:
        """Return error messages if the tests do not allow losses in the parameter `name`."""
        found = super().find_mistakes(name, tests)
        unknown = {test.group for test in tests if name not in test.known}
        for group in dict.fromkeys(test.group for test in tests if test.group not in unknown):
            rule = f"needs a test of {group!r} in which {name} is unknown, to infer its loss"
            found.append(f'varies.{name}: {rule} (got none); with varies = "group" it may be known there')
        return found if self.scatter is None else found + self.scatter.find_mistakes(name, tests)

    def in_tests(self, p: Parameter, of: int, theta: Theta, here: Sequence[int]) -> Lost:
        """Add the undamaged value and the groups' losses to theta; return the values in the tests.

        The reference group has no loss. Raise ValueError as `Population.in_tests` and `loss_parameter` do.
        """
        groups = [test.group for test in theta.tests]
        undamaged = undamaged_in_tests(self.scatter, p, of, theta, here, "group", theta.reference)
        states = dict.fromkeys(group for group in groups if group != theta.reference)
        numbers = {
            state: theta.add(loss_parameter(f"{p.name} loss [{state}]", self.prior), "loss", of, state)
            for state in states
        }
        columns = np.array([numbers.get(group, min(numbers.values())) for group in groups])
        return Lost(undamaged, columns, np.array([group != theta.reference for group in groups]))

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        return {
            "prior": None if self.prior is None else self.prior.as_dict(),
            "scatter": None if self.scatter is None else self.scatter.as_dict(),
        }


def loss_parameter(name: str, prior: Prior | None) -> Parameter:
    """Return a relative loss as a parameter of theta; `Damage` describes its bounds and default prior.

    The loss starts at the point nearest to zero in the prior's support, or at the median if the density is zero or
    infinite there. Raise ValueError if the prior has no probability between the bounds.
    """
    prior = Normal(_SD) if prior is None else prior
    return Parameter(name, prior.start_near(0.0, _LOWEST, _HIGHEST), _LOWEST, _HIGHEST, prior)


def undamaged_in_tests(
    scatter: Population | None,
    p: Parameter,
    of: int,
    theta: Theta,
    here: Sequence[int],
    kind: str,
    where: str = "",
) -> InTests:
    """Add the undamaged value, or its population, to theta; return the undamaged values in the tests.

    `kind` and `where` are the undamaged value's role in theta if all tests have the same value.
    """
    if scatter is not None:
        return scatter.in_tests(p, of, theta, here)
    return Taken(np.full(len(theta.tests), theta.add(p, kind, of, where)))


@dataclass(frozen=True)
class Lost(Multiplied):
    """A structural parameter with relative losses: θ = θ₀ in the reference, otherwise θ = θ₀ (1 − d).

    Attributes
    ----------
    of : InTests
        θ₀, the undamaged value in each test.
    columns : ndarray of int, shape (n_tests,)
        Index in theta of the loss d in each test. For a test in the reference the index is arbitrary but valid.
    is_lost : ndarray of bool, shape (n_tests,)
        Whether the test has a loss; False in the reference.
    """

    columns: IntArray
    is_lost: BoolArray

    def factor(self, theta: FloatArray) -> Factor:
        """Return the share of the undamaged value that remains in each test, 1 − d."""
        loss = np.where(self.is_lost, theta[:, self.columns], 0.0)
        by_loss = np.broadcast_to(np.where(self.is_lost, -1.0, 0.0), loss.shape)
        return Factor(1.0 - loss, [Slope(self.columns, by_loss)])

    def losses(self, theta: FloatArray, reference: int) -> FloatArray:
        """Return the relative losses (n, n_tests) compared with a test in the reference group."""
        return np.where(self.is_lost, theta[:, self.columns], 0.0)

    def identity(self, test: int) -> Hashable:
        """Return a key. Tests with equal keys have equal parameter values at every theta."""
        return self.of.identity(test), int(self.columns[test]), bool(self.is_lost[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return limits that the values exceed rarely or never, (n_tests,) each, for given limits of theta."""
        kept = np.where(self.is_lost, 1.0 - np.stack([lower[self.columns], upper[self.columns]]), 1.0)
        corners = np.stack(self.of.box(lower, upper))[:, None] * kept
        return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))

    def next_test(self, theta: FloatArray, like: int, future: Future) -> FloatArray:
        """Return the parameter's values (n,) in a further test with the same loss as the group of test `like`."""
        undamaged = self.of.next_test(theta, like, future)
        return undamaged * (1.0 - theta[:, self.columns[like]]) if self.is_lost[like] else undamaged
