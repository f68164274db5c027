"""Gibbs sampling of hierarchical posteriors: the scores of all tests and the parameters of populations in turn.

One step consists of

1. a Hamiltonian trajectory of the main parameters given the values in all tests, which needs no solve of the model
   (`fmu.posterior.joint.conditional.MainGivenValues`);
2. proposals for the scores of all tests at once from Student distributions about their most probable values, which
   are computed to second order (`ScoresGivenMain`), one solve of all tests; the proposal of each test is accepted
   or rejected by itself, as the tests are independent given the main parameters;
3. where some main parameters act otherwise, or the tests say little about their own values, a proposal for the
   main parameters given the scores, the end of a trajectory in an approximate density (`MainGivenScores`), another
   solve of all tests;
4. where standard deviations of errors are inferred, a random walk of each of them given the predicted modes, which
   are solved for once more.

The acceptance rate of the second part does not depend on the number of tests. The first part holds the values, the
third part the scores: alternating between them mixes well whether the tests are precise or not (Yu & Meng 2011,
*J. Comput. Graph. Stat.* 20, 531–570). Some proposals of the second part, chosen at random, are steps of a random
walk of random size instead: they bring back a test whose scores are in a tail that the Student distribution lacks,
where proposals that do not depend on the present scores would almost never be accepted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from fmu.arguments import check_arguments
from fmu.box import find_inside
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.joint.conditional.both import Conditionals, conditionals
from fmu.posterior.joint.layout import sum_by_test
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.adaptation import DualAveraging
from fmu.samplers.kernel import Index, Info, Sampler, State, Tree
from fmu.samplers.local import accept
from fmu.samplers.settings import positive_number
from fmu.samplers.trajectory import ExactGradient, HamiltonianKernel, Metric
from fmu.types import AnyArray, BoolArray, FloatArray, LogDensity, Positive

_FIRST_STEP = 0.5
_LENGTH, _MOST_STEPS = 1.6, 16
_JITTER, _MOST_BOUNCES = 0.2, 200
_ACCEPT = 0.8
_NOISE_STEPS, _NOISE_SIZE = 4, 2.0
"""Number of steps of the standard deviations of errors, and their size in deviations at the typical point."""
_NU = 5.0
"""Degrees of freedom of the Student distributions from which the scores of a test are proposed otherwise."""
_WALKS = 0.35
"""Probability that the scores of a test are proposed by a step of a random walk."""
_SMALLEST = 0.05
"""Size of the smallest step of a random walk, in standard deviations; the largest is one."""


@check_arguments
@dataclass(frozen=True)
class GibbsSampler(Sampler):
    """Gibbs sampling of a posterior with populations over several tests (`fmu.JointProblem`).

    Parameters
    ----------
    step_size : float, optional
        Step size of the trajectories of main parameters, in standard deviations. Learnt in warm-up if not given.

    Raises
    ------
    ValueError
        If a setting is out of range.
    """

    step_size: Positive | None = None

    name: ClassVar[str] = "gibbs"
    title: ClassVar[str] = "Gibbs sampling by tests"
    colour: ClassVar[str] = "#117733"
    cost: ClassVar[tuple[float, float, float]] = (1.0, 1.0, 0.9)
    first: ClassVar[tuple[int, int]] = (300, 500)
    takes_maxima: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.step_size is not None:
            object.__setattr__(self, "step_size", positive_number("step_size", self.step_size))

    def bind(self, density: LogDensity) -> GibbsKernel:
        """Return the kernel that samples `density`; ValueError unless it is a problem with populations."""
        problem = density.density if isinstance(density, ScaledDensity) else density
        if not isinstance(problem, UpdatingProblem) or not problem.is_hierarchical:
            raise ValueError("problem: must have a population over several tests for Gibbs sampling (got none)")
        if problem.likelihood.has_discrepancy:
            raise ValueError(
                "problem: must have no discrepancy for Gibbs sampling, as it couples the tests; use hmc (got one)"
            )
        scaled = density if isinstance(density, ScaledDensity) else ScaledDensity(density)
        found = conditionals(problem)
        main, shift = (Metric.of(np.linalg.inv(one), len(one)) for one in found.curvatures)
        step_size = np.asarray(_FIRST_STEP if self.step_size is None else self.step_size)
        return GibbsKernel(scaled, problem, found, main, shift, step_size)

    def tuner(self, density: LogDensity, chains: int, steps: int) -> GibbsTuner | None:
        """Return a tuner that learns the settings in `steps` warm-up steps; None if `step_size` is given."""
        return GibbsTuner(self, density) if self.step_size is None else None


class _Target(ExactGradient):
    """A density of coordinates of the main parameters, which differs from chain to chain.

    Parameters
    ----------
    lower, upper : ndarray, shape (n_coordinates,)
    density : callable
        Returns log-densities and gradients at coordinates (n, n_coordinates) for the chains of an index.
    """

    solves_per_gradient = 0

    def __init__(
        self,
        lower: FloatArray,
        upper: FloatArray,
        density: Callable[[FloatArray, Index], tuple[FloatArray, FloatArray]],
    ) -> None:
        self.lower, self.upper, self.ndim, self.of_chains = lower, upper, len(lower), density

    def log_prob_and_grad(self, position: FloatArray, chain: Index) -> tuple[FloatArray, FloatArray]:
        """Return the log-densities and their gradients; `chain` is as in `Target.log_prob`."""
        return self.of_chains(position, chain)


@dataclass(frozen=True)
class GibbsKernel:
    """Gibbs sampler bound to a problem with populations; see the description of the module.

    Attributes
    ----------
    scaled : ScaledDensity
    problem : UpdatingProblem
    conditionals : Conditionals
    metric, shift_metric : Metric
        Metrics of the trajectories of main parameters given the values, and given the scores.
    step_size : ndarray, shape ()
        Step size of these trajectories.
    """

    scaled: ScaledDensity
    problem: UpdatingProblem
    conditionals: Conditionals
    metric: Metric
    shift_metric: Metric
    step_size: FloatArray

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the starting positions; return the state, and an `Info` with the cost."""
        theta = self.scaled.to_theta(positions)
        terms = self.problem.terms_of_tests(theta)
        log_prob = terms.sum(axis=1) + self.problem.log_prior(theta)
        ones, none = np.ones(len(positions), dtype=np.int64), np.zeros(len(positions), dtype=np.int64)
        return State(positions, log_prob, extra={"terms": terms}), Info(none > 0, log_prob, ones, none)

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Move the main parameters, then the scores, then all parameters together if this is needed."""
        theta = self.problem.layout.standardise_scores(self.scaled.to_theta(state.position))
        theta, main = self._move_main(rng, theta)
        theta, terms, moved = self._move_scores(rng, theta, state.extra["terms"])
        solves = np.ones(len(theta), dtype=np.int64)
        extra: dict[str, AnyArray] = {"acceptance_rate": moved, "main_acceptance": main}
        if not self.conditionals.is_enough:
            theta, terms, extra["shift_accepted"] = self._shift(rng, theta, terms)
            solves += 1
        if len(self.conditionals.noise):
            theta, terms = self._move_noise(rng, theta, terms)
            solves += 1
        theta = self.problem.layout.restore_scores(theta)
        log_prob = terms.sum(axis=1) + self.problem.log_prior(theta)
        info = Info(moved > 0.0, log_prob, solves, np.zeros_like(solves), extra)
        position = self.scaled.to_scaled(theta)
        return State(position, log_prob, extra={"terms": terms}), info

    def _move_main(self, rng: np.random.Generator, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta after a trajectory of the main parameters, and the acceptance rates (chains,)."""
        main = self.conditionals.main
        values = main.values(theta)
        target = _Target(
            main.lower,
            main.upper,
            lambda w, chain: main.log_prob_and_grad(w, theta[chain], values[chain]),
        )
        begun, _ = target.start(main.coordinates(theta, values))
        moved, info = self._trajectory(target, self.metric).step(rng, begun)
        after = main.with_values(main.theta_at(moved.position, theta, values), values)
        usable = info.accepted & np.all(np.isfinite(after), axis=1)
        return np.where(usable[:, None], after, theta), info.extra["acceptance_rate"]

    def _trajectory(self, target: _Target, metric: Metric) -> HamiltonianKernel:
        n_steps = int(np.clip(np.round(_LENGTH / float(self.step_size)), 1, _MOST_STEPS))
        return HamiltonianKernel(target, metric, self.step_size, n_steps, _JITTER, _MOST_BOUNCES)

    def _move_scores(
        self, rng: np.random.Generator, theta: FloatArray, terms: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return theta and terms with new scores, and the shares of tests that moved, (chains,)."""
        of, test = self.conditionals.scores, self.problem.likelihood.test_of_terms
        z, normal = of.scores.take(theta), of.approximate(theta)
        walks = rng.random(z.shape[:2]) < _WALKS
        heavy = np.sqrt(_NU / rng.chisquare(_NU, z.shape[:2]))
        size = np.where(walks, _SMALLEST ** rng.random(z.shape[:2]), heavy)
        step = normal.scatter(size[..., None] * rng.standard_normal(z.shape))
        now = normal.straighten(z)
        new = np.where(walks[..., None], now, normal.mean) + step
        candidate = of.scores.put(theta, normal.bend(new))
        new_terms = self._terms(candidate)
        n_tests = z.shape[1]
        with np.errstate(invalid="ignore"):
            gain = sum_by_test(new_terms - terms, test, n_tests) + of.log_prior(candidate) - of.log_prior(theta)
            ratio = gain + np.where(walks, 0.0, normal.log_density(now, _NU) - normal.log_density(new, _NU))
        accepted = accept(rng, ratio)
        chosen = np.where(accepted[..., None], of.scores.take(candidate), z)
        terms = np.where(accepted[:, test], new_terms, terms)
        return of.scores.put(theta, chosen), terms, accepted.mean(axis=1)

    def _terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each datum, (chains, n_terms), at theta with standard normal scores."""
        layout = self.conditionals.scores.layout
        terms = self.problem.likelihood.terms(layout.of_model(theta))
        if np.count_nonzero(np.isfinite(terms)) == terms.size:
            return terms
        return self.problem.terms_of_tests(self.problem.layout.restore_scores(theta))  # records the failures

    def _shift(
        self, rng: np.random.Generator, theta: FloatArray, terms: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return theta and terms with new main parameters and the same scores, and a mask of the chains moved.

        The candidates are the ends of trajectories in the approximate density, whose error decides on them (Liu
        2001, *Monte Carlo Strategies in Scientific Computing*, section 9.4.3).
        """
        of = self.conditionals.shift
        target = _Target(of.lower, of.upper, lambda w, chain: of.log_prob_and_grad(w, theta[chain]))
        begun, _ = target.start(of.coordinates(theta))
        moved, info = self._trajectory(target, self.shift_metric).step(rng, begun)
        candidate = of.theta_at(moved.position, theta)
        new_terms = self._terms(candidate)
        with np.errstate(invalid="ignore"):
            gain = (new_terms - terms).sum(axis=1)
            gain += of.prior.log_pdf(candidate[:, of.columns]) - of.prior.log_pdf(theta[:, of.columns])
            ratio = gain + begun.log_prob - moved.log_prob
        accepted = info.accepted & accept(rng, ratio)
        chosen = accepted[:, None]
        return np.where(chosen, candidate, theta), np.where(chosen, new_terms, terms), accepted

    def _move_noise(
        self, rng: np.random.Generator, theta: FloatArray, terms: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return theta and terms with new standard deviations of errors.

        One after the other walks on the logarithmic scale. The predicted modes do not change.
        """
        problem = self.problem
        likelihood, first = problem.likelihood, problem.n_structural
        assert isinstance(likelihood, ModalLikelihood)  # of several tests
        at = self.conditionals.scores.layout.of_model(theta)
        seen, begin = likelihood.observed(at), at.shape[1] - len(self.conditionals.noise)
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


class GibbsTuner:
    """Tuner of the step size of the main parameters' trajectories.

    Parameters
    ----------
    sampler : GibbsSampler
    density : LogDensity
    """

    def __init__(self, sampler: GibbsSampler, density: LogDensity) -> None:
        self.sampler, self.kernel = sampler, sampler.bind(density)
        self.averaging = DualAveraging(np.log(_FIRST_STEP), _ACCEPT)
        self._take()

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        self.averaging.update(np.asarray(np.mean(info.extra["main_acceptance"])))
        self._take()

    def finish_learning(self) -> GibbsSampler:
        """Return the settings learnt."""
        return replace(self.sampler, step_size=float(np.exp(self.averaging.averaged)))

    def state(self) -> Tree:
        """Return the state of the tuner as plain data."""
        return {"averaging": vars(self.averaging)}

    def restore(self, state: Tree) -> None:
        """Restore the state that another tuner returned."""
        self.averaging = DualAveraging(**state["averaging"])
        self._take()

    def _take(self) -> None:
        self.kernel = replace(self.kernel, step_size=np.exp(self.averaging.log_value))
