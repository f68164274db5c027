"""Sampling steps for the main parameters of a hierarchical posterior, with the test scores marginalised.

The scores move with the main parameters: each keeps its distance from its most probable value, in units of its
standard deviation. One solve of all tests gives the change in the approximation error, which decides whether a
step is accepted. See `fmu.samplers.gibbs.gibbs`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.joint.conditional.both import Conditionals
from fmu.posterior.joint.conditional.marginal import MarginalOfMain
from fmu.posterior.joint.conditional.scores import REGULAR, Linear
from fmu.posterior.problem import UpdatingProblem
from fmu.samplers.kernel import Index
from fmu.samplers.local import accept
from fmu.samplers.trajectory import ExactGradient, HamiltonianKernel, Metric
from fmu.types import AnyArray, BoolArray, FloatArray

_LENGTHS, _MOST_STEPS = (1.2, 2.4), 16
"""Smallest and largest trajectory length, in standard deviations, and largest number of steps. If the fitted
normal distribution is right, a quarter period is 1.6; longer trajectories help where it is too narrow."""
_MANY = 150
"""Number of tests beyond which trajectories are shorter."""
_JITTER, _MOST_BOUNCES = 0.2, 200
_SMALLEST = 0.05
"""Smallest factor by which a trajectory is shortened."""
_SHORT = 0.1
"""Probability that a trajectory is shortened, by a factor between `_SMALLEST` and 1, which moves a chain out of a
tail."""


class _Target(ExactGradient):
    """Density of the main parameters with the test scores marginalised, for one trajectory.

    Parameters
    ----------
    marginal : MarginalOfMain
    theta : ndarray, shape (chains, ndim)
        Points that supply the error standard deviations, and the main parameters that do not move.
    scales : ndarray, shape (chains, n_tests, p)
        Prior standard deviations of the scores.

    Attributes
    ----------
    linear : Linear
        Score densities at the points evaluated last.
    """

    linear: Linear
    solves_per_gradient = 0

    def __init__(self, marginal: MarginalOfMain, theta: FloatArray, scales: FloatArray) -> None:
        self.marginal, self.theta, self.scales = marginal, theta, scales
        self.lower, self.upper, self.ndim = marginal.lower, marginal.upper, len(marginal.lower)

    def log_prob_and_grad(self, position: FloatArray, chain: Index) -> tuple[FloatArray, FloatArray]:
        """Return the log-densities (n,) and their gradients at `position`; see `Target.log_prob` for `chain`."""
        value, gradient, self.linear = self.marginal.log_prob_and_grad(
            position, self.theta[chain], REGULAR if self.scales is REGULAR else self.scales[chain]
        )
        return value, gradient


Fit = dict[str, FloatArray]
"""How well a point fits the data: log-likelihood ``"terms"`` (chains, n_terms) and, if the sampler follows ridges,
``"residuals"`` (chains, n_residuals) and ``"slopes"`` (chains, n_residuals, P), which are the derivatives of each
residual with respect to the P structural parameters of its test."""


def fit_to(likelihood: ModalLikelihood, seen: ModalPrediction, at: FloatArray) -> Fit:
    """Return the `Fit` of the predicted modes `seen` to the data.

    `seen` must contain derivatives. `at` (chains, n) are the parameters at which the modes were predicted.
    """
    return dict(zip(("terms", "residuals", "slopes"), likelihood.terms_and_residuals(seen, at), strict=True))


def select_fit(of_terms: BoolArray, of_residuals: BoolArray, new: Fit, old: Fit) -> Fit:
    """Return the `new` values where the masks `of_terms` and `of_residuals` are True, otherwise the `old` ones.

    Each mask has shape (chains, n) or (chains, 1). The mask of the residuals also applies to the slopes.
    """
    chosen = {"terms": of_terms, "residuals": of_residuals, "slopes": of_residuals[..., None]}
    return {name: np.where(chosen[name], new[name], value) for name, value in old.items()}


@dataclass(frozen=True)
class MovesOfMain:
    """Sampling steps for the main parameters of a problem with populations.

    Attributes
    ----------
    problem : UpdatingProblem
    conditionals : Conditionals
    metric : Metric
        Metric of the main parameters' trajectories.
    step_size : ndarray, shape ()
        Step size of these trajectories.
    ridges : ModalLikelihood or None
        The likelihood of `problem` if some score proposals start from the present scores, along curved ridges;
        otherwise None.
    """

    problem: UpdatingProblem
    conditionals: Conditionals
    metric: Metric
    step_size: FloatArray
    ridges: ModalLikelihood | None

    @property
    def _shrink(self) -> float:
        """Factor that shortens trajectories for many tests, because their approximation errors add up as √n."""
        return min(1.0, float(np.sqrt(_MANY / len(self.problem.tests))))

    def move_main(
        self, rng: np.random.Generator, theta: FloatArray, fit: Fit, scales: FloatArray
    ) -> tuple[FloatArray, Fit, Linear, dict[str, AnyArray]]:
        """Move the main parameters along a trajectory, and accept or reject the end point.

        Return theta, the fit and the score densities there, and statistics: the acceptance probability in the
        approximate density, which tunes the step size, and whether the chain has moved.
        """
        marginal, given = self.conditionals.marginal, self.conditionals.scores
        target = _Target(marginal, theta, scales)
        begun, _ = target.start(marginal.coordinates(theta))
        first = target.linear
        n_steps = int(
            np.clip(np.round(self._shrink * rng.uniform(*_LENGTHS) / float(self.step_size)), 1, _MOST_STEPS)
        )
        kernel = HamiltonianKernel(target, self.metric, self.step_size, n_steps, _JITTER, _MOST_BOUNCES)
        momentum = self.metric.sample_momentum(rng, len(theta))
        size = np.where(rng.random(len(theta)) < _SHORT, _SMALLEST ** rng.random(len(theta)), 1.0)
        size = size * (1.0 + _JITTER * rng.uniform(-1, 1, len(theta)))
        end = kernel.integrate(begun, momentum, self.step_size * size)
        with np.errstate(over="ignore", invalid="ignore"):
            gain = end.log_prob - self.metric.kinetic(end.momentum)
            gain = np.where(end.finished, gain - (begun.log_prob - self.metric.kinetic(momentum)), -np.inf)
        gain = np.nan_to_num(gain, nan=-np.inf, neginf=-np.inf)
        moved = marginal.theta_at(np.where(end.finished[:, None], end.position, begun.position), theta)
        last = target.linear if np.all(end.finished) else given.linearise(moved, scales)
        theta, fit, last, accepted = self._decide(rng, theta, fit, moved, (first, last), scales, gain)
        statistics: dict[str, AnyArray] = {
            "main_acceptance": np.exp(np.minimum(gain, 0.0)),
            "main_accepted": accepted,
        }
        return theta, fit, last, statistics

    def move_dates(
        self, rng: np.random.Generator, theta: FloatArray, fit: Fit, scales: FloatArray
    ) -> tuple[FloatArray, Fit, dict[str, AnyArray]]:
        """Propose new dates and losses of each sudden event, and accept or reject them after a solve of all tests.

        Return theta, the fit there, and statistics: the fraction of events whose proposal was accepted, or an
        empty dict if there are no events.
        """
        given, shares = self.conditionals.scores, []
        for event in self.conditionals.events:
            moved, gain = event.propose(rng, given, theta, scales)
            both = given.linearise(theta, scales), given.linearise(moved, scales)
            now, new = (
                given.log_evidence(one).sum(axis=1) + event.log_prior(at)
                for one, at in zip(both, (theta, moved), strict=True)
            )
            theta, fit, _, accepted = self._decide(rng, theta, fit, moved, both, scales, gain + new - now)
            shares.append(accepted)
        return theta, fit, {"dates_accepted": np.mean(shares, axis=0)} if shares else {}

    def _decide(
        self,
        rng: np.random.Generator,
        theta: FloatArray,
        fit: Fit,
        moved: FloatArray,
        linear: tuple[Linear, Linear],
        scales: FloatArray,
        gain: FloatArray,
    ) -> tuple[FloatArray, Fit, Linear, BoolArray]:
        """Accept or reject the main parameters of `moved` (chains, ndim) after a solve of all tests.

        The scores move with the main parameters.

        Parameters
        ----------
        linear : tuple of Linear
            Score densities at theta and at `moved`.
        gain : ndarray, shape (chains,)
            Logarithm of the acceptance ratio of `moved` in the approximate density.

        Returns
        -------
        theta : ndarray
        fit : dict
        last : Linear
            Score densities at the returned theta.
        accepted : ndarray of bool, shape (chains,)
        """
        given = self.conditionals.scores
        before, after = (given.normal_of(one) for one in linear)
        candidate = given.scores.put(moved, after.restore(before.standardise(given.scores.take(theta))))
        new_fit = self.fit_at(candidate)
        error = [
            given.log_prior(at, scales) - one.log_det_factor - given.log_evidence(one)
            for at, one in zip((theta, candidate), linear, strict=True)
        ]
        in_time = self.problem.layout.in_time
        if in_time is not None:
            now, new = (in_time.log_density(at, given.scores.take(at))[0] for at in (theta, candidate))
            error[1] = error[1] + new - now
        with np.errstate(invalid="ignore"):
            ratio = gain + (new_fit["terms"] - fit["terms"]).sum(axis=1) + (error[1] - error[0]).sum(axis=1)
        accepted = accept(rng, ratio)
        chosen, last = accepted[:, None], linear[1].select(accepted, linear[0])
        return np.where(chosen, candidate, theta), select_fit(chosen, chosen, new_fit, fit), last, accepted

    def fit_at(self, theta: FloatArray) -> Fit:
        """Return the fit at theta, (chains, ndim), with standardised test scores, from one solve of all tests.

        If a term is not finite, the terms are evaluated again to record the failures.
        """
        at, ridges = self.conditionals.scores.layout.of_model(theta), self.ridges
        if ridges is None:
            fit = {"terms": self.problem.likelihood.terms(at)}
        else:
            fit = fit_to(ridges, ridges.observed(at, True), at)
        if np.count_nonzero(np.isfinite(fit["terms"])) == fit["terms"].size:
            return fit
        terms = self.problem.terms_of_tests(self.problem.layout.restore_scores(theta))  # records the failures
        return {**fit, "terms": terms}
