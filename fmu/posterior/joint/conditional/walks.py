"""Random-walk steps for populations, given the parameter values in the tests.

Given the values, the likelihood has no further information on the populations, so these steps need no solve of the
model. Unlike the candidates of `fmu.posterior.joint.conditional.given_values`, they suit all populations whose
values are independent in time: near the bounds, with one standard deviation per group, with any correlation, and
with outlying tests.

Three groups of parameters are moved in turn by Metropolis steps: the centres, the logarithms of the standard
deviations, and the inverse hyperbolic tangents of the partial correlations. Given n precise values from a
population with standard deviation s, the three kinds of parameters have posterior standard deviations of about
s/√n, 1/√(2n) and 1/√n. A step in d dimensions is 2.4/√d times as large (Gelman, Roberts & Gilks 1996, *Bayesian
Statistics* 5, 599–607). Steps in standard deviations and correlations are shorter, because their densities are
skewed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from fmu.box import find_inside
from fmu.posterior.joint.layout import Layout
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.joint import JointPrior
from fmu.types import FloatArray, IntArray

_ROUNDS = 2
"""Number of steps of each group of parameters."""
_SIZE, _SHORTER = 2.4, 1.7
"""Step size of centres, and of the other parameters, times √d, in standard deviations."""


type Proposal = Callable[[np.random.Generator, FloatArray], tuple[FloatArray, FloatArray]]
"""Returns proposed theta (n, ndim), and the log-determinant (n,) of the move's Jacobian."""


class StepsGivenValues(ABC):
    """Metropolis steps in some parameters, given the parameter values in the tests.

    Parameters
    ----------
    layout : Layout
        A layout with standard normal scores.
    parameters : sequence of Parameter
        The parameters in theta.
    main : ndarray of int
        The columns of theta that the steps move, in addition to the scores.
    """

    def __init__(self, layout: Layout, parameters: Sequence[Parameter], main: IntArray) -> None:
        self._layout, self._main = layout, main
        self._lower, self._upper = np.array([[parameters[k].lower, parameters[k].upper] for k in main]).T
        self._prior = JointPrior([parameters[k] for k in main])

    def move(self, rng: np.random.Generator, theta: FloatArray) -> FloatArray:
        """Return theta (n, ndim) after the steps. The scores change, but the values in the tests stay the same."""
        values = self._values(theta)
        log_density = self._log_density(theta, values)
        for propose in _ROUNDS * self._proposals():
            with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
                candidate, log_jacobian = propose(rng, theta)
                inside = find_inside(candidate[:, self._main], self._lower, self._upper)[0]
                candidate = self._restore_values(np.where(inside[:, None], candidate, theta), values)
                new = self._log_density(candidate, values)
                ratio = new - log_density + log_jacobian
            accepted = inside & np.isfinite(candidate).all(axis=1) & (np.log(rng.random(len(theta))) < ratio)
            theta = np.where(accepted[:, None], candidate, theta)
            log_density = np.where(accepted, new, log_density)
        return theta

    def _log_density(self, theta: FloatArray, values: list[FloatArray]) -> FloatArray:
        """Return the log-density (n,) of the parameters in theta (n, ndim) and of the values in the tests."""
        found = self._prior.log_pdf(theta[:, self._main])
        for of_test in self._densities_of_values(theta, values):
            found = found + np.einsum("nt->n", of_test)
        density_of_scores = self._layout.density_of_scores
        if density_of_scores is not None:
            z = self._layout.population_scores(theta)
            found = found + np.einsum("nt->n", density_of_scores.log_density(theta, z)[0])
        return found

    @abstractmethod
    def _proposals(self) -> list[Proposal]:
        """Return the kinds of steps, in their order."""

    @abstractmethod
    def _values(self, theta: FloatArray) -> list[FloatArray]:
        """Return the values of each population that moves, (n, n_tests), at theta (n, ndim)."""

    @abstractmethod
    def _restore_values(self, theta: FloatArray, values: list[FloatArray]) -> FloatArray:
        """Set the scores in theta (n, ndim) so that the tests have the given values again, and return theta."""

    @abstractmethod
    def _densities_of_values(self, theta: FloatArray, values: list[FloatArray]) -> Iterator[FloatArray]:
        """Yield the log-densities of each population's values in the tests, (n, n_scores)."""


class WalksGivenValues(StepsGivenValues):
    """Random-walk steps for all populations of a layout, given the parameter values in the tests.

    Parameters
    ----------
    layout : Layout
        A layout with standard normal scores that are independent in time.
    parameters : sequence of Parameter
        The parameters in theta.
    """

    def __init__(self, layout: Layout, parameters: Sequence[Parameter]) -> None:
        self._drawn, correlation = layout.drawn, layout.correlation
        self._of_logarithm = np.array([one.family.of_logarithm for one in self._drawn])
        scored = np.stack([one.scored for one in self._drawn], axis=1)
        widths, n_scores = np.unique(
            np.concatenate([one.widths[one.scored] for one in self._drawn]), return_counts=True
        )
        self._centres = np.array([one.centre for one in self._drawn])
        self._widths, self._partial = widths, np.array(correlation.columns if correlation else (), dtype=np.int64)
        self._of_widths = _SHORTER / np.sqrt(2.0 * n_scores * len(widths))
        self._of_partial = _SHORTER / np.sqrt(scored.sum(axis=0).min() * max(1, len(self._partial)))
        super().__init__(layout, parameters, np.concatenate([self._centres, self._widths, self._partial]))

    def _proposals(self) -> list[Proposal]:
        steps: list[Proposal] = [self._move_centres, self._move_widths]
        return [*steps, self._move_correlations] if len(self._partial) else steps

    def _values(self, theta: FloatArray) -> list[FloatArray]:
        return [one(theta)[0] for one in self._drawn]

    def _restore_values(self, theta: FloatArray, values: list[FloatArray]) -> FloatArray:
        for one, z in zip(self._drawn, self._layout.batch.scores(values, theta), strict=True):
            theta[:, one.columns[one.scored]] = z[:, one.scored]
        return theta

    def _densities_of_values(self, theta: FloatArray, values: list[FloatArray]) -> Iterator[FloatArray]:
        for one, of_tests in zip(self._drawn, self._layout.batch.log_pdf(values, theta), strict=True):
            yield of_tests[:, one.scored]

    def _move_centres(self, rng: np.random.Generator, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta (n, ndim) with proposed centres, and the log-determinant (n,) of the move's Jacobian."""
        weights = np.stack([np.sum(one.scored / theta[:, one.widths] ** 2, axis=1) for one in self._drawn], axis=1)
        noise = rng.standard_normal(weights.shape)
        if self._layout.correlation is not None:
            noise = np.einsum("nij,nj->ni", self._layout.correlation.factor(theta), noise)
        step, now = _SIZE * noise / np.sqrt(weights * len(self._centres)), theta[:, self._centres]
        new = np.where(self._of_logarithm, now * np.exp(step), now + step)
        return _replace(theta, self._centres, new), np.einsum("ni,i->n", step, self._of_logarithm)

    def _move_widths(self, rng: np.random.Generator, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta (n, ndim) with proposed sds, and the log-determinant (n,) of the move's Jacobian."""
        step = self._of_widths * rng.standard_normal((len(theta), len(self._widths)))
        return _replace(theta, self._widths, theta[:, self._widths] * np.exp(step)), np.einsum("ni->n", step)

    def _move_correlations(self, rng: np.random.Generator, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta (n, ndim) with proposed partial correlations, and the Jacobian's log-determinant, (n,)."""
        now = theta[:, self._partial]
        new = np.tanh(np.arctanh(now) + self._of_partial * rng.standard_normal(now.shape))
        log_jacobian = np.einsum("ni->n", np.log1p(-(new**2)) - np.log1p(-(now**2)))
        return _replace(theta, self._partial, new), log_jacobian


def _replace(theta: FloatArray, columns: IntArray, values: FloatArray) -> FloatArray:
    """Return a copy of theta (n, ndim) with `values`, (n, n_columns), in `columns`."""
    theta = theta.copy()
    theta[:, columns] = values
    return theta
