"""Steps in the scatter between groups of tests, given the values in the tests and the mean of each group.

In a group g, a population has the centre μ F_g with the factor F_g = 1 + s u_g, or F_g = exp(s u_g) if it is
log-normal. Precise tests determine the centres μ F_g of the groups, and leave μ, s and the effects u_g on a narrow
curved ridge of equal centres. Two Metropolis steps follow it. Neither changes the values in the tests, so no step
needs a solve of the model.

1. μ → μ e^δ and F_g → F_g e^(−δ) in all G groups, so that u_g → (F_g e^(−δ) − 1)/s, or u_g − δ/s if the population
   is log-normal. The m standard deviations within groups of a normal population, which are multiplied by F_g too,
   become e^δ times as large. With respect to μ, these standard deviations and u_g, the Jacobian is triangular. Its
   determinant is e^((1 + m − G) δ) or, if the population is log-normal, e^δ. δ is normal with a standard deviation
   proportional to s/√G, which the step does not change.
2. s → s e^ε and u_g → u_g e^(−ε), so that F_g stays. The determinant is e^((1 − G) ε). ε is normal with a standard
   deviation proportional to 1/√(2G).

The acceptance ratio has the prior densities of μ, s, u_g and the standard deviations, and the density of the
values in the tests. In step 1 this density changes only near the bounds of the values. The steps move along orbits
of groups of transformations (Liu & Sabatti 2000, *Biometrika* 87, 353–369). They are combined with steps at fixed
scores as in Yu & Meng (2011, *J. Comput. Graph. Stat.* 20, 531–570).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fmu.posterior.joint.conditional.walks import Proposal, StepsGivenValues
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.base import InTests, Multiplied
from fmu.posterior.joint.varies.drawn import Drawn
from fmu.posterior.joint.varies.nested import Nested
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray

_SIZE = 2.0
"""Size of steps in standard deviations."""


class GroupEffectsGivenValues(StepsGivenValues):
    """Steps in one population's centre, its standard deviations and its group effects, given the values in tests.

    Parameters
    ----------
    layout : Layout
        A layout with standard normal scores.
    nested : Nested
        The population's values with the group effects.
    parameters : sequence of Parameter
        The parameters in theta.
    """

    def __init__(self, layout: Layout, nested: Nested, parameters: Sequence[Parameter]) -> None:
        drawn = nested.of
        assert isinstance(drawn, Drawn)  # narrowed for the type checker: group effects multiply a population
        self._nested, self._drawn = nested, drawn
        self._effects, self._within = np.unique(nested.columns), np.unique(drawn.widths)
        super().__init__(layout, parameters, np.array([drawn.centre, nested.width, *self._within, *self._effects]))

    def _proposals(self) -> list[Proposal]:
        return [self._shift, self._scale]

    def _values(self, theta: FloatArray) -> list[FloatArray]:
        return [self._nested(theta)[0]]

    def _restore_values(self, theta: FloatArray, values: list[FloatArray]) -> FloatArray:
        one = self._drawn
        scores = one.scores_at(values[0] / self._nested.factor(theta).values, theta)
        theta[:, one.columns[one.scored]] = scores[:, one.scored]
        return theta

    def _densities_of_values(self, theta: FloatArray, values: list[FloatArray]) -> Iterator[FloatArray]:
        one, factor = self._drawn, self._nested.factor(theta).values
        of_test = one.family.log_pdf(values[0] / factor, theta[:, [one.centre]], theta[:, one.widths])[0]
        yield (of_test if self._nested.of_logarithm else of_test - np.log(np.abs(factor)))[:, one.scored]

    def _shift(self, rng: np.random.Generator, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta (n, ndim) after a proposed step 1, and the log-determinant (n,) of its Jacobian."""
        s, u, n_groups = theta[:, [self._nested.width]], theta[:, self._effects], len(self._effects)
        theta = theta.copy()
        delta = _SIZE / np.sqrt(n_groups) * s[:, 0] * rng.standard_normal(len(theta))
        theta[:, self._drawn.centre] *= np.exp(delta)
        if self._nested.of_logarithm:
            theta[:, self._effects] = u - delta[:, None] / s
            return theta, delta
        theta[:, self._effects] = ((1.0 + s * u) * np.exp(-delta[:, None]) - 1.0) / s
        theta[:, self._within] *= np.exp(delta[:, None])
        return theta, (1.0 + len(self._within) - n_groups) * delta

    def _scale(self, rng: np.random.Generator, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta (n, ndim) after a proposed step 2, and the log-determinant (n,) of its Jacobian."""
        n_groups, theta = len(self._effects), theta.copy()
        epsilon = _SIZE / np.sqrt(2.0 * n_groups) * rng.standard_normal(len(theta))
        theta[:, self._nested.width] *= np.exp(epsilon)
        theta[:, self._effects] *= np.exp(-epsilon[:, None])
        return theta, (1.0 - n_groups) * epsilon


def group_effect_steps(layout: Layout, parameters: Sequence[Parameter]) -> tuple[GroupEffectsGivenValues, ...]:
    """Return a `GroupEffectsGivenValues` for each population that scatters between groups of tests."""
    found = map(_with_effects, layout.values_of)
    return tuple(GroupEffectsGivenValues(layout, one, parameters) for one in found if one is not None)


def _with_effects(value_of: InTests) -> Nested | None:
    """Return a parameter's values with its group effects but without trends and losses; None without effects."""
    while isinstance(value_of, Multiplied) and not isinstance(value_of, Nested):
        value_of = value_of.of
    return value_of if isinstance(value_of, Nested) else None
