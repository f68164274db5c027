"""Prediction of a measured mode from weighted posterior draws."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import log_ndtr, logsumexp

from fmu.posterior.data.estimated_sd import student_scores
from fmu.posterior.discrepancy.draws import distinct_rows
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    from fmu.fem.pairing.prediction import ModalPrediction
    from fmu.posterior.problem import UpdatingProblem

INTERVAL = 0.9
NEITHER = ""


class HeldOut(NamedTuple):
    """A mode's prediction from the other modes, as a row of the `leave_one_out` table.

    Unknown numbers are NaN, except `freedom`, which is then infinite.
    """

    measured: float = np.nan
    mean: float = np.nan
    sd: float = np.nan
    eti90_lb: float = np.nan
    eti90_ub: float = np.nan
    p: float = np.nan
    freedom: float = np.inf
    prior_sd: float = np.nan
    elpd: float = np.nan
    mcse_elpd: float = np.nan
    pareto_k: float = np.nan
    method: str = NEITHER
    used: bool = True


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of the parameters, with the computed frequencies.

    Attributes
    ----------
    problem : UpdatingProblem
    theta : ndarray, shape (n, ndim)
    hz : ndarray, shape (n, n_modes)
        Computed frequencies, Hz; NaN where a solve failed.
    """

    problem: UpdatingProblem
    theta: FloatArray
    hz: FloatArray

    @cached_property
    def _distinct(self) -> tuple[FloatArray, IntArray]:
        """Distinct model parameters, (n_distinct, n_parameters), and the index of each draw in them, (n,)."""
        return distinct_rows(self.problem.layout.of_model(self.theta))

    @cached_property
    def _observed(self) -> ModalPrediction:
        """Modes computed at the distinct draws, cached because a discrepancy needs them for each left-out mode."""
        return self.problem.likelihood.observed(self._distinct[0])

    def predict(self, k: int, log_weight: FloatArray) -> HeldOut:
        """Return the predictive distribution of mode `k`'s measured frequency from importance-weighted draws.

        The distribution is a mixture with one component per draw. The logarithms of the weights, which sum to 1,
        are `log_weight` (n,). The components are Gaussian, except in two cases: with `fmu.StudentErrors`, and if
        the measurement is the mean of tests whose scatter gives its error. The components are then Student's t
        distributions, with ν degrees of freedom at each draw. If all modes share one estimated scatter, the errors
        of the other modes inform it. In `sd`, the variance of Student's t, which may be
        infinite, is replaced by the variance of the Gaussian with the same central 95 % interval, and `freedom` is
        1/E[1/ν]. Draws at which a solve failed are left out. The prediction is NaN if the problem has no error
        model for frequencies.
        """
        from scipy.optimize import brentq

        problem = self.problem
        likelihood: Any = with_mode(problem, k).likelihood
        if likelihood.frequency_term is None:
            return HeldOut()
        noise = self.theta[:, problem.n_structural :]
        term = likelihood.frequency_term
        means, deviations = (x[:, k] for x in term.given_others(self.hz, noise))
        if likelihood.has_discrepancy:
            distinct, index = self._distinct
            shift, variance = (x[index] for x in likelihood.error_given_others(self._observed, distinct, k))
            means, deviations = means + shift, np.sqrt(deviations**2 + variance)
        solved = np.isfinite(self.hz).all(axis=1)
        means, deviations, log_weight = means[solved], deviations[solved], log_weight[solved]
        nu = term.freedom(noise, k)[solved]
        is_gaussian = bool(np.isinf(nu).all())
        w = np.exp(log_weight)
        mean = float(w @ means)
        sd = float(np.sqrt(w @ (deviations**2 + (means - mean) ** 2)))

        def scores(y: float) -> FloatArray:
            z = (y - means) / deviations
            return z if is_gaussian else student_scores(z, nu)

        def below(y: float) -> float:
            return float(w @ np.exp(log_ndtr(scores(y))))

        measured = float(np.asarray(problem.data.frequencies_hz)[k])
        z = scores(measured)
        log_tail = min(float(logsumexp(log_weight + log_ndtr(side))) for side in (z, -z))
        ends = [(1.0 - INTERVAL) / 2.0, (1.0 + INTERVAL) / 2.0]
        reach = (float(np.min(means - 9.0 * deviations)), float(np.max(means + 9.0 * deviations)))
        lower, upper = (brentq(lambda y, q=q: below(y) - q, *reach) for q in ends)
        p = min(1.0, 2.0 * float(np.exp(log_tail)))
        freedom = np.inf if is_gaussian else float(np.sum(w) / (w @ (1.0 / nu)))
        return HeldOut(measured, mean, sd, float(lower), float(upper), p, freedom)


def with_mode(problem: UpdatingProblem, k: int) -> UpdatingProblem:
    """Return the problem updated with mode `k` in addition to the modes already used."""
    use = zip(problem.data.labels, problem.data.use, strict=True)
    return problem.using([label for i, (label, used) in enumerate(use) if used or i == k])
