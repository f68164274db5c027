"""Treat the latent model errors as parameters in theta. Given these, the tests of a structure are independent.

The likelihood of `DiscrepantLikelihood` is an integral over the latent errors z and w, which are standard normal
(`fmu.posterior.discrepancy.latent`). Here z and w are further parameters with this prior. The posterior of the
other parameters stays exactly the same. The posterior of z and w given the other parameters is Gaussian, so that
they can be drawn (data augmentation; Tanner & Wong 1987, *J. Am. Stat. Assoc.* 82, 528–540).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.density import Posterior
from fmu.posterior.discrepancy.draws import errors_from_normal
from fmu.posterior.discrepancy.latent import KnownErrors
from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood
from fmu.posterior.discrepancy.model_errors import Linearised
from fmu.posterior.joint.varies.base import sum_by_test
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.types import FloatArray, IntArray

_STEP = 1e-4
"""Step of the central differences of residuals, in units s of the parameters; their error is of order step²."""


def with_errors_as_parameters[Problem: Posterior](problem: Problem) -> Problem:
    """Return the problem with its model's latent errors as parameters.

    Return the same problem if its likelihood is not a `DiscrepantLikelihood`.
    """
    likelihood = problem.likelihood
    if not isinstance(likelihood, DiscrepantLikelihood):
        return problem
    return problem.with_likelihood(LikelihoodGivenErrors(likelihood))


class LikelihoodGivenErrors(DiscrepantLikelihood):
    """The likelihood as a function of parameters and latent errors.

    In theta, the latent errors follow the inferred standard deviations.

    Parameters
    ----------
    of : DiscrepantLikelihood
        The likelihood in which the latent errors are integrated out.
    """

    def __init__(self, of: DiscrepantLikelihood) -> None:
        vars(self).update(vars(of))
        self.of, self._alone = of, None
        groups, self._first_row, self._place = np.unique(of.group, return_index=True, return_inverse=True)
        self._first, self._n_groups = of.model.n_parameters + len(of.noise), len(groups)
        self._n_own = len(of.errors.of_mode) + sum(one.n_own for one in of.errors.modes)
        n = self._n_groups * self._n_own + of.errors.n_common
        self.noise = (*of.noise, *(Parameter(f"latent error {i + 1}", 0.0, prior=Normal(1.0)) for i in range(n)))

    def draw(self, rng: np.random.Generator, seen: ModalPrediction, theta: FloatArray) -> FloatArray:
        """Draw the latent errors, (n, n_errors), given the data. `seen` is the result of `observed` at theta."""
        given = self.of.errors_given_data(seen, theta, self._used)
        return self._join(
            *errors_from_normal(*self._split(rng.standard_normal((len(theta), self.n_errors))), given)
        )

    def likeliest(self, theta: FloatArray) -> FloatArray:
        """Return the most probable latent errors, (n, n_errors), at theta (n, ndim)."""
        mean, gain, _, w, _ = self.of.errors_given_data(self.of.observed(theta), theta, self._used)
        return self._join(mean - np.einsum("nmpc,nc->nmp", gain, w), w)

    @property
    def n_errors(self) -> int:
        """Number of latent errors."""
        return len(self.noise) - len(self.of.noise)

    def _join(self, z: FloatArray, w: FloatArray) -> FloatArray:
        return np.concatenate([z[:, self._first_row].reshape(len(z), -1), w], axis=1)

    def _split(self, errors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Split latent errors (n, n_errors) into z of all measured modes, (n, n_modes, P), and w, (n, C)."""
        k = self._n_groups * self._n_own
        return errors[:, :k].reshape(len(errors), self._n_groups, self._n_own)[:, self._place], errors[:, k:]

    def _latent(self, rows: Linearised, theta: FloatArray, by_test: bool = False) -> KnownErrors:
        found = self.of._latent(rows, theta)
        z, w = self._split(theta[:, self._first :])
        return KnownErrors(found.residuals, found.loads, found.common, found.group, z[:, self._used], w)

    def _terms_and_slopes(self, *args: Any) -> tuple[FloatArray, FloatArray]:
        terms, slopes = super()._terms_and_slopes(*args)
        latent: KnownErrors = args[-1]
        m, n, k = len(self._used), slopes.shape[2] - len(self.noise) + len(self.of.noise), self._n_own
        error, rows = latent.residuals - latent.fitted, np.arange(m)[:, None]
        columns = n + k * self._place[self._used][:, None] + np.arange(k)
        slopes[:, rows, columns] += np.einsum("nmkp,nmk->nmp", latent.loads, error)
        slopes[:, :m, n + k * self._n_groups :] += np.einsum("nmkc,nmk->nmc", latent.common, error)
        return terms, slopes

    def error_given_others(
        self, seen: ModalPrediction, theta: FloatArray, k: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return the discrepancy in mode `k`'s frequency, (n,) in Hz, and its variance, which is zero."""
        z, w = self._split(theta[:, self._first :])
        own, common = (x[:, k] for x in self._in_hz(seen, theta))
        shift = np.einsum("np,np->n", own, z[:, k]) + np.einsum("nc,nc->n", common, w)
        return -shift, np.zeros(len(theta))

    def expand(self, theta: FloatArray) -> ExpandedErrors:
        """Return the residuals, expanded about theta (1, ndim), as a function of the latent errors."""
        values, noise = self._values(theta)[0], theta[:, self.model.n_parameters :]
        p, scale = values.shape[1], self.errors.scale(values)
        points = np.repeat(values[None], 1 + 2 * p, axis=0)
        k = np.arange(p)
        points[1 + k, :, k] += _STEP * scale.T
        points[1 + p + k, :, k] -= _STEP * scale.T
        at = np.concatenate([points.reshape(len(points), -1), np.repeat(noise, len(points), axis=0)], axis=1)
        rows = self._linearise(self.observed(at, True), at)
        own, common = self.errors.units(rows, points[:, self._test])
        step = (_STEP * scale)[self._test]
        return ExpandedErrors(self, rows.residuals, own, common, step, self._test, len(values))

    def sizes(self, noise: FloatArray) -> FloatArray:
        """Return the latent errors' sds, (n, n_errors), the square roots of `ModelErrors.variances`.

        A standard deviation is zero if the variance is negative, which occurs if a correlation is out of bounds.
        """
        own, common = self.errors.variances(noise)
        return np.sqrt(np.maximum(np.concatenate([np.tile(own, self._n_groups), common], axis=1), 0.0))

    def errors_at(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the latent errors multiplied by `sizes`: z of the used modes, (n, m, P), and w, (n, C).

        `noise`, (n, n_noise), has the inferred standard deviations followed by the latent errors.
        """
        z, w = self._split(self.sizes(noise) * noise[:, len(self.of.noise) :])
        return z[:, self._used], w


@dataclass(frozen=True, eq=False)
class ExpandedErrors:
    """The residuals of m rows at b points near one theta. They are linear in the latent errors.

    There are b = 1 + 2 p points: first theta, then theta with each of the p parameters increased in turn, then
    theta with each parameter decreased in turn. A parameter is changed in all tests at once. A row has k
    residuals, which depend on P errors of its group and C common errors (`fmu.posterior.discrepancy.latent`).

    Attributes
    ----------
    likelihood : LikelihoodGivenErrors
    residuals : ndarray, shape (b, m, k)
        The residuals without latent errors.
    own, common : ndarray, shapes (b, m, k, P) and (b, m, k, C)
        The residuals due to unit errors.
    step : ndarray, shape (m, p)
        The step by which each parameter is changed.
    test : ndarray of int, shape (m,)
        Index of each row's test.
    n_tests : int
    """

    likelihood: LikelihoodGivenErrors
    residuals: FloatArray
    own: FloatArray
    common: FloatArray
    step: FloatArray
    test: IntArray
    n_tests: int

    def quadratic(self, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return each test's log-likelihood gradient (n, n_tests, p) and information (n, n_tests, p, p).

        `noise`, (n, n_noise), has the inferred standard deviations followed by the latent errors. The measurement
        standard deviations stay at the values for which the residuals were expanded.
        """
        z, w = self.likelihood.errors_at(noise)
        r = self.residuals - np.einsum("bmkp,nmp->nbmk", self.own, z) - np.einsum("bmkc,nc->nbmk", self.common, w)
        p = self.step.shape[1]
        J = (r[:, 1 : 1 + p] - r[:, 1 + p :]) / (2.0 * self.step.T[..., None])
        slope, information = -np.einsum("npmk,nmk->nmp", J, r[:, 0]), np.einsum("npmk,nqmk->nmpq", J, J)
        return sum_by_test(slope, self.test, self.n_tests), sum_by_test(information, self.test, self.n_tests)
