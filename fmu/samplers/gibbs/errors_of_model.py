"""Gibbs steps for a model with discrepancy: the main parameters and the sizes of the model errors.

The model errors (`fmu.Discrepancy`) are common to all tests. They are drawn at the end of each Gibbs step, from
their Gaussian distribution given all other parameters (`fmu.posterior.discrepancy.given_errors`). Given the
errors, the tests are independent. But errors and main parameters explain the same residuals, so the main
parameters hardly move while the errors are fixed. Three kinds of steps move them further:

1. Each inferred error sd is scaled, while the model errors stay the same in units of their standard deviations.
   The main parameters move to compensate. This step follows the funnel that forms where the errors become small.
2. The main parameters take random walks at fixed scores, in the density with the errors marginalised (a partially
   collapsed Gibbs sampler: van Dyk & Park 2008, *J. Am. Stat. Assoc.* 103, 790–796). A step is the change in the
   main parameters that would compensate for random errors.
3. The standard deviations take random walks in the density with the errors marginalised, given the predicted
   modes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmu.box import find_inside
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.discrepancy.given_errors import LikelihoodGivenErrors
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.problem import UpdatingProblem
from fmu.samplers.gibbs.main_parameters import MovesOfMain
from fmu.samplers.local import accept
from fmu.types import FloatArray

_NOISE_STEPS, _NOISE_SIZE = 4, 2.0
"""Number of random-walk steps for each error standard deviation, and their size in standard deviations of its
logarithm at the typical point."""
_SHIFTS = 4
"""Number of random-walk steps of the main parameters with the model errors marginalised."""
_SMALLEST = 0.05
"""Ratio of the smallest random-walk step to the largest."""


@dataclass(frozen=True)
class MovesWithErrors(MovesOfMain):
    """Gibbs steps that also move the model errors. All steps of `MovesOfMain` are conditional on these errors.

    Attributes
    ----------
    collapsed : UpdatingProblem
        The problem with standardised scores and with the model errors marginalised. If the model has a
        discrepancy, the model errors are the last parameters of `problem`.
    """

    collapsed: UpdatingProblem

    @property
    def has_errors(self) -> bool:
        """Whether the model has discrepancy, so that model errors are parameters of `problem`."""
        return self.problem.ndim > self.collapsed.ndim

    @property
    def given_errors(self) -> LikelihoodGivenErrors:
        """The likelihood conditional on the model errors; only for a model with discrepancy."""
        assert isinstance(self.problem.likelihood, LikelihoodGivenErrors)
        return self.problem.likelihood

    @property
    def modal(self) -> ModalLikelihood:
        """The likelihood with the model errors marginalised."""
        assert isinstance(self.collapsed.likelihood, ModalLikelihood)  # of several tests
        return self.collapsed.likelihood

    @property
    def solves_with_errors(self) -> int:
        """Number of solves that `move_with_errors` takes per chain."""
        return 2 + _SHIFTS + len(self.conditionals.noise)

    def likeliest_errors(self, theta: FloatArray) -> dict[str, FloatArray]:
        """Return the most probable model errors at theta (chains, ndim), and the log-likelihood terms given them.

        The keys are ``"errors"`` and ``"terms"``.
        """
        given, at = self.given_errors, self.problem.layout.of_model(theta)
        errors = given.likeliest(at)
        return {"terms": given.terms(np.concatenate([at, errors], axis=1)), "errors": errors}

    def move_with_errors(
        self, rng: np.random.Generator, theta: FloatArray, terms: FloatArray
    ) -> tuple[FloatArray, FloatArray, dict[str, FloatArray], FloatArray]:
        """Move the main parameters and the inferred error sds, and draw the model errors.

        The module docstring describes the steps. The given `theta` (chains, ndim) includes the model errors, and
        `terms` are the log-likelihood terms given these errors.

        Returns
        -------
        theta : ndarray, shape (chains, n)
            Parameters without the model errors.
        terms : ndarray, shape (chains, n_terms)
            Log-likelihood terms with the model errors marginalised.
        kept : dict
            The drawn model errors, ``"errors"``, and the log-likelihood terms given them, ``"terms"``.
        shifted : ndarray, shape (chains,)
            Fraction of the main parameters' random-walk steps that were accepted.
        """
        problem, columns = self.collapsed, self.conditionals.marginal.columns
        theta = self._move_sizes(rng, theta, terms)[:, : problem.ndim]
        shifted = np.zeros(len(theta))
        log_prob = problem.log_prob(theta)
        sizes = self.given_errors.sizes(theta[:, problem.n_structural :])
        for _ in range(_SHIFTS):
            size = _SMALLEST ** rng.random((len(theta), 1))
            candidate = theta.copy()
            step = size * sizes * rng.standard_normal(sizes.shape)
            candidate[:, columns] += step @ self.conditionals.by_errors.T
            new = problem.log_prob(candidate)
            moved = accept(rng, new - log_prob)
            theta, log_prob = np.where(moved[:, None], candidate, theta), np.where(moved, new, log_prob)
            shifted += moved / _SHIFTS
        at, of = problem.layout.of_model(theta), self.given_errors
        seen = of.observed(at)
        theta, terms = self.move_noise(rng, theta, at, seen, self.modal.terms_of_observed(seen, at))
        at = problem.layout.of_model(theta)
        errors = of.draw(rng, seen, at)
        given = of.terms_of_observed(seen, np.concatenate([at, errors], axis=1))
        return theta, terms, {"terms": given, "errors": errors}, shifted

    def _move_sizes(self, rng: np.random.Generator, theta: FloatArray, terms: FloatArray) -> FloatArray:
        """Move each inferred error sd in turn, and the main parameters to compensate; return theta (chains, ndim).

        The model errors stay the same in units of their standard deviations. Each inferred error sd takes one
        solve.
        """
        problem, columns, given = self.collapsed, self.conditionals.marginal.columns, self.given_errors
        first, n = problem.n_structural, problem.ndim
        prior = problem.log_prior(theta[:, :n])
        for k, width in enumerate(self.conditionals.noise):
            step = _NOISE_SIZE * width * _SMALLEST ** rng.random(len(theta)) * rng.standard_normal(len(theta))
            noise, candidate = theta[:, first:].copy(), theta.copy()
            noise[:, k] *= np.exp(step)
            inside = find_inside(noise[:, : n - first], problem.lower[first:], problem.upper[first:])[0]
            candidate[:, first:] = noise = np.where(inside[:, None], noise, theta[:, first:])
            growth = given.sizes(noise) - given.sizes(theta[:, first:])
            candidate[:, columns] += (growth * theta[:, n:]) @ self.conditionals.by_errors.T
            new_prior = np.where(inside, problem.log_prior(candidate[:, :n]), -np.inf)
            candidate = np.where(np.isfinite(new_prior)[:, None], candidate, theta)
            new_terms = given.terms(problem.layout.of_model(candidate))
            with np.errstate(invalid="ignore"):
                moved = accept(rng, (new_terms - terms).sum(axis=1) + new_prior - prior + step)
            theta, terms = (np.where(moved[:, None], *x) for x in ((candidate, theta), (new_terms, terms)))
            prior = np.where(moved, new_prior, prior)
        return theta

    def move_noise(
        self, rng: np.random.Generator, theta: FloatArray, at: FloatArray, seen: ModalPrediction, terms: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Move each inferred error parameter in turn, by random walks on its logarithm.

        Return theta and the log-likelihood terms (chains, n_terms). The predicted modes `seen` do not change. `at`
        (chains, n) contains the parameters of the model and of its likelihood.
        """
        problem, likelihood, first = self.collapsed, self.modal, self.collapsed.n_structural
        begin = at.shape[1] - len(self.conditionals.noise)
        prior = self.conditionals.noise_prior
        for k in np.tile(np.arange(len(self.conditionals.noise)), _NOISE_STEPS):
            step = _NOISE_SIZE * self.conditionals.noise[k] * rng.standard_normal(len(theta))
            candidate = at.copy()
            candidate[:, begin + k] *= np.exp(step)
            s, new = at[:, begin:], candidate[:, begin:]
            new_terms = likelihood.terms_of_observed(seen, candidate)
            with np.errstate(invalid="ignore"):
                ratio = (new_terms - terms).sum(axis=1) + prior.log_pdf(new) - prior.log_pdf(s) + step
            inside = find_inside(new, problem.lower[first:], problem.upper[first:])[0]
            moved = (inside & accept(rng, ratio))[:, None]
            at, terms = np.where(moved, candidate, at), np.where(moved, new_terms, terms)
        return np.concatenate([theta[:, :first], at[:, begin:]], axis=1), terms
