"""Gibbs sampling of hierarchical posteriors: the scores of all tests, and the parameters of the populations, in turn.

One step consists of

1. a Hamiltonian trajectory of the main parameters given the values in all tests, which needs no solve of the model
   (`fmu.posterior.joint.conditional.MainGivenValues`);
2. proposals for the scores of all tests at once from normal distributions (`ScoresGivenMain`), one solve of all
   tests; the proposal of each test is accepted or rejected by itself, as the tests are independent given the main
   parameters;
3. where some main parameters act otherwise, or the tests say little about their own values, a Hamiltonian trajectory
   of all parameters.

The acceptance rate of the second part does not depend on the number of tests. The first part holds the values, the
third part the scores: alternating between them mixes well whether the tests are precise or not (Yu & Meng 2011,
*J. Comput. Graph. Stat.* 20, 531–570). The proposals keep a share of the distance from the mean, as in a
preconditioned Crank–Nicolson step (Cotter, Roberts, Stuart & White 2013, *Stat. Sci.* 28, 424–446), in every other
step, so that a test whose scores are far out in their tails is moved too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from fmu.arguments import check_arguments
from fmu.posterior.joint.by_test import sum_by_test
from fmu.posterior.joint.conditional import Conditionals, MainGivenValues, conditionals
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.samplers.adaptation import DualAveraging
from fmu.samplers.hmc import HamiltonianMonteCarlo
from fmu.samplers.kernel import Index, Info, Sampler, State, Tree
from fmu.samplers.mixture.quadratic import Quadratic, definite
from fmu.samplers.settings import positive_number
from fmu.samplers.trajectory import ExactGradient, HamiltonianKernel, Metric
from fmu.types import FloatArray, LogDensity, Positive

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
    joint : HamiltonianMonteCarlo, optional
        Settings of the trajectories of all parameters, where these are needed.

    Raises
    ------
    ValueError
        If a setting is out of range.
    """

    step_size: Positive | None = None
    joint: HamiltonianMonteCarlo = field(default_factory=HamiltonianMonteCarlo)

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
        joint = None if found.is_enough else self.joint.bind(scaled)
        metric = Metric.of(np.linalg.inv(definite(found.curvature)), len(found.curvature))
        step_size = np.asarray(_FIRST_STEP if self.step_size is None else self.step_size)
        return GibbsKernel(scaled, problem, found, metric, step_size, joint)

    def starting_from(self, components: Sequence[Quadratic], weights: FloatArray) -> Gibbs:
        """Return the settings with the metric of the joint trajectories from the curvature at the typical point."""
        return replace(self, joint=self.joint.starting_from(components, weights))

    def tuner(self, density: LogDensity, chains: int, steps: int) -> GibbsTuner | None:
        """Return a tuner that learns the settings in `steps` warm-up steps; None if `step_size` is given."""
        return GibbsTuner(self, density, chains, steps) if self.step_size is None else None


class _Target(ExactGradient):
    """The density of the main parameters given the values in the tests, which differ from chain to chain."""

    def __init__(self, scaled: ScaledDensity, main: MainGivenValues, theta: FloatArray) -> None:
        super().__init__(scaled)
        self.main, self.scaled, self.theta, self.values = main, scaled, theta, main.values(theta)
        self.ndim = len(main.columns)
        self.lower, self.upper = scaled.lower[main.columns], scaled.upper[main.columns]
        self.solves_per_gradient = 0

    def put(self, position: FloatArray, chain: Index) -> FloatArray:
        """Return theta of the chains with other main parameters, scaled, (n, ndim)."""
        u = self.scaled.to_scaled(self.theta[chain])
        u[:, self.main.columns] = position
        return self.scaled.to_theta(u)

    def log_prob_and_grad(self, position: FloatArray, chain: Index) -> tuple[FloatArray, FloatArray]:
        """Return the log-densities and their gradients; `chain` is as in `Target.log_prob`."""
        theta = self.put(position, chain)
        log_prob, gradient = self.main.log_prob_and_grad(theta, self.values[chain])
        return log_prob, gradient * self.scaled.scale[self.main.columns]


@dataclass(frozen=True)
class GibbsKernel:
    """Gibbs sampler bound to a problem with populations; see the description of the module.

    Attributes
    ----------
    scaled : ScaledDensity
    problem : UpdatingProblem
    conditionals : Conditionals
    metric : Metric
        Metric of the trajectories of main parameters.
    step_size : ndarray, shape ()
        Step size of these trajectories.
    joint : HamiltonianKernel or None
        Kernel of the trajectories of all parameters; None if these are not needed.
    """

    scaled: ScaledDensity
    problem: UpdatingProblem
    conditionals: Conditionals
    metric: Metric
    step_size: FloatArray
    joint: HamiltonianKernel | None

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
        turn = int(state.extra["turn"][0])
        theta, terms, share = self._move_scores(rng, theta, state.extra["terms"], _SHARES[turn % len(_SHARES)])
        solves = np.ones(len(theta), dtype=np.int64)
        gradients, joint, accepted = np.zeros_like(solves), None, share > 0.0
        if self.joint is not None:
            begun, cost = self.joint.target.start(self.scaled.to_scaled(theta))
            moved, joint = self.joint.step(rng, begun)
            theta = np.where(joint.accepted[:, None], self.scaled.to_theta(moved.position), theta)
            terms = self.problem.terms_of_tests(theta)
            solves += cost.n_solves + joint.n_solves + 1
            gradients += cost.n_gradients + joint.n_gradients
        log_prob = terms.sum(axis=1) + self.problem.log_prior(theta)
        extra = {"acceptance_rate": share, "main_acceptance": main, "n_nonfinite": np.zeros_like(solves)}
        if joint is not None:
            extra |= {name: joint.extra[name] for name in ("diverging", "n_nonfinite")}
        info = Info(accepted, log_prob, solves, gradients, extra, joint)
        position = self.scaled.to_scaled(theta)
        return State(position, log_prob, extra={"terms": terms, "turn": state.extra["turn"] + 1}), info

    def _move_main(self, rng: np.random.Generator, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta after a trajectory of the main parameters, and the acceptance rates (chains,)."""
        target = _Target(self.scaled, self.conditionals.main, theta)
        n_steps = int(np.clip(np.round(_LENGTH / float(self.step_size)), 1, _MOST_STEPS))
        kernel = HamiltonianKernel(target, self.metric, self.step_size, n_steps, _JITTER, _MOST_BOUNCES)
        begun, _ = target.start(self.scaled.to_scaled(theta)[:, self.conditionals.main.columns])
        moved, info = kernel.step(rng, begun)
        after = self.conditionals.main.with_values(target.put(moved.position, slice(None)), target.values)
        usable = info.accepted & np.all(np.isfinite(after), axis=1)
        return np.where(usable[:, None], after, theta), info.extra["acceptance_rate"]

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
        accepted = np.log(rng.uniform(size=ratio.shape)) < np.where(np.isnan(ratio), -np.inf, ratio)
        chosen = np.where(accepted[..., None], of.scores.take(candidate), z)
        terms = np.where(accepted[:, test], new_terms, terms)
        return of.scores.put(theta, chosen), terms, accepted.mean(axis=1)


class GibbsTuner:
    """Tuner of the step size of the main parameters' trajectories, and of the joint trajectories.

    Parameters
    ----------
    sampler : Gibbs
    density : LogDensity
    chains, steps : int
    """

    def __init__(self, sampler: Gibbs, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler, self.kernel = sampler, sampler.bind(density)
        self.averaging = DualAveraging(np.log(_FIRST_STEP), _ACCEPT)
        self.joint = None if self.kernel.joint is None else sampler.joint.tuner(density, chains, steps)
        self._take()

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        self.averaging.update(np.mean(info.extra["main_acceptance"]))
        if self.joint is not None and info.parts is not None:
            self.joint.update(state, info.parts)
        self._take()

    def finish_learning(self) -> Gibbs:
        """Return the settings learnt."""
        joint = self.sampler.joint if self.joint is None else self.joint.finish_learning()
        return replace(self.sampler, step_size=float(np.exp(self.averaging.averaged)), joint=joint)

    def state(self) -> Tree:
        """Return the state of the tuner as plain data."""
        return {"averaging": vars(self.averaging), "joint": None if self.joint is None else self.joint.state()}

    def restore(self, state: Tree) -> None:
        """Restore the state that another tuner returned."""
        self.averaging = DualAveraging(**state["averaging"])
        if self.joint is not None:
            self.joint.restore(state["joint"])
        self._take()

    def _take(self) -> None:
        joint = None if self.joint is None else self.joint.kernel
        self.kernel = replace(self.kernel, step_size=np.exp(self.averaging.log_value), joint=joint)
