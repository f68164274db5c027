"""Gibbs sampling of hierarchical posteriors: the scores of all tests, and the parameters of the populations, in turn.

One step consists of

1. a Hamiltonian trajectory of the main parameters given the values in all tests, which needs no solve of the model
   (`fmu.posterior.joint.conditional.MainGivenValues`);
2. proposals for the scores of all tests at once from normal distributions (`ScoresGivenMain`), one solve of all
   tests; the proposal of each test is accepted or rejected by itself, as the tests are independent given the main
   parameters;
3. where some main parameters act otherwise, or the tests say little about their own values, a proposal for the main
   parameters given the scores, the end of a trajectory in an approximate density (`MainGivenScores`), another
   solve of all tests.

The acceptance rate of the second part does not depend on the number of tests. The first part holds the values, the
third part the scores: alternating between them mixes well whether the tests are precise or not (Yu & Meng 2011,
*J. Comput. Graph. Stat.* 20, 531–570). The proposals keep a share of the distance from the mean, as in a
preconditioned Crank–Nicolson step (Cotter, Roberts, Stuart & White 2013, *Stat. Sci.* 28, 424–446), in every other
step, so that a test whose scores are far out in their tails is moved too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from fmu.arguments import check_arguments
from fmu.posterior.joint.by_test import sum_by_test
from fmu.posterior.joint.conditional import Conditionals, conditionals
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.adaptation import DualAveraging
from fmu.samplers.kernel import Index, Info, Sampler, State, Tree
from fmu.samplers.local import accept
from fmu.samplers.mixture.quadratic import definite
from fmu.samplers.settings import positive_number
from fmu.samplers.trajectory import ExactGradient, HamiltonianKernel, Metric
from fmu.types import BoolArray, FloatArray, IntArray, LogDensity, Positive

_FIRST_STEP = 0.5
_LENGTH, _MOST_STEPS = 2.0, 16
_JITTER, _MOST_BOUNCES = 0.2, 200
_ACCEPT = 0.8
_SHARES = (0.0, 0.0, 0.0, 0.8)
"""Shares of the distance from the mean that the proposals of consecutive steps keep."""


@check_arguments
@dataclass(frozen=True)
class Gibbs(Sampler):
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
    colour: ClassVar[str] = "#CC79A7"
    cost: ClassVar[tuple[float, float, float]] = (1.0, 1.0, 0.9)
    first: ClassVar[tuple[int, int]] = (300, 500)

    def __post_init__(self) -> None:
        if self.step_size is not None:
            object.__setattr__(self, "step_size", positive_number("step_size", self.step_size))

    def bind(self, density: LogDensity) -> GibbsKernel:
        """Return the kernel that samples `density`; ValueError unless it is a problem with populations."""
        problem = density.density if isinstance(density, ScaledDensity) else density
        if not isinstance(problem, UpdatingProblem) or not problem.is_hierarchical:
            raise ValueError("problem: must have a population over several tests for Gibbs sampling (got none)")
        scaled = density if isinstance(density, ScaledDensity) else ScaledDensity(density)
        found = conditionals(problem)
        main, shift = (Metric.of(np.linalg.inv(definite(one)), len(one)) for one in found.curvatures)
        step_size = np.asarray(_FIRST_STEP if self.step_size is None else self.step_size)
        return GibbsKernel(scaled, problem, found, main, shift, step_size)

    def tuner(self, density: LogDensity, chains: int, steps: int) -> GibbsTuner | None:
        """Return a tuner that learns the settings in `steps` warm-up steps; None if `step_size` is given."""
        return GibbsTuner(self, density) if self.step_size is None else None


class _Target(ExactGradient):
    """A density of main parameters, which differs from chain to chain by the other parameters of theta.

    Parameters
    ----------
    scaled : ScaledDensity
    columns : ndarray of int
        Indices of the main parameters in theta.
    theta : ndarray, shape (chains, ndim)
        Supplies the other parameters.
    density : callable
        Returns log-densities and gradients by the `columns` at theta (n, ndim) of the chains of an index.
    """

    solves_per_gradient = 0

    def __init__(
        self,
        scaled: ScaledDensity,
        columns: IntArray,
        theta: FloatArray,
        density: Callable[[FloatArray, Index], tuple[FloatArray, FloatArray]],
    ) -> None:
        self.scaled, self.columns, self.theta, self.of_chains = scaled, columns, theta, density
        self.ndim, self.lower, self.upper = len(columns), scaled.lower[columns], scaled.upper[columns]

    @property
    def begin(self) -> FloatArray:
        """The main parameters of theta, in scaled units."""
        return self.scaled.to_scaled(self.theta)[:, self.columns]

    def put(self, position: FloatArray, chain: Index = slice(None)) -> FloatArray:
        """Return theta of the chains with other main parameters, scaled, (n, n_columns)."""
        u = self.scaled.to_scaled(self.theta[chain])
        u[:, self.columns] = position
        theta = self.theta[chain].copy()
        theta[:, self.columns] = self.scaled.to_theta(u)[:, self.columns]
        return theta

    def log_prob_and_grad(self, position: FloatArray, chain: Index) -> tuple[FloatArray, FloatArray]:
        """Return the log-densities and their gradients; `chain` is as in `Target.log_prob`."""
        log_prob, gradient = self.of_chains(self.put(position, chain), chain)
        return log_prob, gradient * self.scaled.scale[self.columns]


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
        extra = {"terms": terms, "turn": none}
        return State(positions, log_prob, extra=extra), Info(none > 0, log_prob, ones, none)

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Move the main parameters, then the scores, then all parameters together if this is needed."""
        theta = self.scaled.to_theta(state.position)
        theta, main = self._move_main(rng, theta)
        share = _SHARES[int(state.extra["turn"][0]) % len(_SHARES)]
        theta, terms, moved = self._move_scores(rng, theta, state.extra["terms"], share)
        solves = np.ones(len(theta), dtype=np.int64)
        extra = {"acceptance_rate": moved, "main_acceptance": main}
        if not self.conditionals.is_enough:
            theta, terms, extra["shift_accepted"] = self._shift(rng, theta, terms)
            solves += 1
        log_prob = terms.sum(axis=1) + self.problem.log_prior(theta)
        info = Info(moved > 0.0, log_prob, solves, np.zeros_like(solves), extra)
        position = self.scaled.to_scaled(theta)
        return State(position, log_prob, extra={"terms": terms, "turn": state.extra["turn"] + 1}), info

    def _move_main(self, rng: np.random.Generator, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta after a trajectory of the main parameters, and the acceptance rates (chains,)."""
        main = self.conditionals.main
        values = main.values(theta)
        target = _Target(
            self.scaled, main.columns, theta, lambda at, chain: main.log_prob_and_grad(at, values[chain])
        )
        begun, _ = target.start(target.begin)
        moved, info = self._trajectory(target, self.metric).step(rng, begun)
        after = main.with_values(target.put(moved.position), values)
        usable = info.accepted & np.all(np.isfinite(after), axis=1)
        return np.where(usable[:, None], after, theta), info.extra["acceptance_rate"]

    def _trajectory(self, target: _Target, metric: Metric) -> HamiltonianKernel:
        n_steps = int(np.clip(np.round(_LENGTH / float(self.step_size)), 1, _MOST_STEPS))
        return HamiltonianKernel(target, metric, self.step_size, n_steps, _JITTER, _MOST_BOUNCES)

    def _move_scores(
        self, rng: np.random.Generator, theta: FloatArray, terms: FloatArray, share: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return theta and terms with new scores, and the shares of tests that moved, (chains,)."""
        of, test = self.conditionals.scores, self.problem.likelihood.test_of_terms
        z, normal = of.scores.take(theta), of.approximate(theta)
        noise = rng.standard_normal(z.shape)
        candidate = of.scores.put(theta, normal.draw(z, share, noise))
        new_terms = self.problem.terms_of_tests(candidate)
        n_tests = z.shape[1]
        with np.errstate(invalid="ignore"):
            gain = sum_by_test(new_terms - terms, test, n_tests) + of.log_prior(candidate) - of.log_prior(theta)
            ratio = gain + normal.log_density(z) - normal.log_density(of.scores.take(candidate))
        accepted = accept(rng, ratio)
        chosen = np.where(accepted[..., None], of.scores.take(candidate), z)
        terms = np.where(accepted[:, test], new_terms, terms)
        return of.scores.put(theta, chosen), terms, accepted.mean(axis=1)

    def _shift(
        self, rng: np.random.Generator, theta: FloatArray, terms: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return theta and terms with new main parameters and the same scores, and a mask of the chains moved.

        The candidates are the ends of trajectories in the approximate density, whose error decides on them (Liu
        2001, *Monte Carlo Strategies in Scientific Computing*, section 9.4.3).
        """
        of = self.conditionals.shift
        target = _Target(self.scaled, of.columns, of.hold(theta), lambda at, chain: of.log_prob_and_grad(at))
        begun, _ = target.start(target.begin)
        moved, info = self._trajectory(target, self.shift_metric).step(rng, begun)
        candidate = of.release(target.put(moved.position))
        new_terms = self.problem.terms_of_tests(candidate)
        with np.errstate(invalid="ignore"):
            gain = (new_terms - terms).sum(axis=1)
            gain += of.prior.log_pdf(candidate[:, of.columns]) - of.prior.log_pdf(theta[:, of.columns])
            ratio = gain + begun.log_prob - moved.log_prob
        accepted = info.accepted & accept(rng, ratio)
        chosen = accepted[:, None]
        return np.where(chosen, candidate, theta), np.where(chosen, new_terms, terms), accepted


class GibbsTuner:
    """Tuner of the step size of the main parameters' trajectories.

    Parameters
    ----------
    sampler : Gibbs
    density : LogDensity
    """

    def __init__(self, sampler: Gibbs, density: LogDensity) -> None:
        self.sampler, self.kernel = sampler, sampler.bind(density)
        self.averaging = DualAveraging(np.log(_FIRST_STEP), _ACCEPT)
        self._take()

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        self.averaging.update(np.mean(info.extra["main_acceptance"]))
        self._take()

    def finish_learning(self) -> Gibbs:
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
