"""Relative losses of a parameter, such as a stiffness, between a reference state and later states."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fmu.arguments import check_arguments
from fmu.posterior.joint.varies.base import InTests, Slope, Theta, Varies
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
    gain. Negative losses are allowed because noise produces them where there is no damage; without them the losses
    would be biased upwards.

    Attributes
    ----------
    prior : Prior, optional
        Prior of each loss, between −0.5 and 0.95. Default: normal with mean 0 and standard deviation 0.3. If few
        parameters are expected to be damaged, use `fmu.SpikeAndSlab(share)`, where ``share`` is the probability
        that a parameter is damaged: this prior shrinks small losses to zero and hardly changes large losses. (A
        horseshoe prior also does this, with inferred scales. With precise tests the scales depend so strongly on
        the losses that HMC did not converge.)
    """

    prior: Prior | None = None
    by_group: ClassVar[bool] = True

    def in_tests(self, p: Parameter, of: int, theta: Theta, here: Sequence[int]) -> Lost:
        """Add the reference value and one loss per other group to theta; return the values in the tests."""
        column = theta.add(p, "group", of, theta.reference)
        groups = [test.group for test in theta.tests]
        states = dict.fromkeys(group for group in groups if group != theta.reference)
        numbers = {state: theta.add(self.loss(p, state), "loss", of, state) for state in states}
        losses = np.array([numbers.get(group, column) for group in groups])
        return Lost(column, losses, np.array([group != theta.reference for group in groups]))

    def loss(self, of: Parameter, state: str) -> Parameter:
        """Return the parameter of theta that is the loss of the parameter `of` in a state."""
        prior = Normal(_SD) if self.prior is None else self.prior
        start = float(np.clip(0.0, max(_LOWEST, prior.support[0]), min(_HIGHEST, prior.support[1])))
        return Parameter(f"{of.name} loss [{state}]", start, _LOWEST, _HIGHEST, prior)

    def as_dict(self) -> dict[str, Plain]:
        """Return a dict of the settings, in plain Python types."""
        return {"prior": None if self.prior is None else self.prior.as_dict()}


@dataclass(frozen=True)
class Lost(InTests):
    """A structural parameter with relative losses: θ = θ₀ in the reference, otherwise θ = θ₀ (1 − d).

    Attributes
    ----------
    column : int
        Index in theta of θ₀, the reference value.
    losses : ndarray of int, shape (n_tests,)
        Index in theta of the loss d in each test; `column` for a test in the reference.
    is_lost : ndarray of bool, shape (n_tests,)
        Whether the test has a loss; False in the reference.
    """

    column: int
    losses: IntArray
    is_lost: BoolArray

    def __call__(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the values (n, n_tests) in all tests at theta (n, n_parameters), and their derivatives."""
        loss = np.where(self.is_lost, theta[:, self.losses], 0.0)
        columns = np.full_like(self.losses, self.column)
        base = theta[:, columns]
        by_loss = np.where(self.is_lost, -base, 0.0)
        return base * (1.0 - loss), [Slope(columns, 1.0 - loss), Slope(self.losses, by_loss)]

    def identity(self, test: int) -> Hashable:
        """Return a key that is equal for two tests if the value in them is equal at every theta."""
        return int(self.losses[test])

    def box(self, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper limits of the values, (n_tests,) each, for limits of theta (n_parameters,)."""
        ends = np.array([lower[self.column], upper[self.column]])
        kept = np.where(self.is_lost, 1.0 - np.stack([lower[self.losses], upper[self.losses]]), 1.0)
        corners = ends[:, None, None] * kept
        return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
