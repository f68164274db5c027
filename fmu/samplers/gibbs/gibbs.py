"""Gibbs sampling of hierarchical posteriors, which moves the main parameters and the test scores in turn.

A test score is the standardised deviation of a parameter's value in one test from its population mean. All other
parameters are the main parameters. If tests may be outliers, each step first draws which tests are outliers, given
their scores, and then the share of outliers. The rest of the step is conditional on these draws:

1. A Hamiltonian trajectory moves the main parameters in their density with the scores marginalised, which needs no
   solve of the model (`fmu.posterior.joint.conditional.marginal.MarginalOfMain`). The scores move too: they keep
   their distances from the most probable scores, in units of their standard deviations. One solve of all tests
   gives the change in the approximation error, and the step is accepted or rejected.
2. New scores of all tests are proposed at once, from Student distributions about the most probable scores, which
   are computed to second order (`ScoresGivenMain`). This takes another solve of all tests. Each test's proposal is
   accepted or rejected separately, because the tests are independent given the main parameters.
3. If values are correlated in time, step 2 moves one group of tests after another, at one solve per group; the
   tests of a group are independent given all other tests. The approximations leave out the scores' density in
   time, so it enters the acceptance ratios of steps 1 and 2. Each correlation time then takes random walks, alone
   given the scores, and jointly with its population given the values (`fmu.posterior.joint.conditional.in_time`).
4. New population parameters are proposed given the values in the tests, which needs no solve
   (`PopulationsGivenValues`). If this cannot be done for a population, or its proposals would rarely be accepted,
   the parameters of all populations also take random walks (`fmu.posterior.joint.conditional.walks`), unless
   values are correlated in time. If a population scatters between groups of tests, this scatter also takes steps
   (`fmu.posterior.joint.conditional.group_effects`).
5. If error standard deviations are inferred, the modes are predicted with one more solve. Each standard deviation
   then takes random walks given these predictions.

If the model has a discrepancy, its errors are common to all tests. Steps 1 to 4 are then conditional on these
errors, and step 5 is part of `fmu.samplers.gibbs.errors_of_model`.

Where precise data leave curved ridges of scores, the approximations of step 2 can be far from the density, and a
test may have two maxima. Half of the proposals for such a test then start from the present scores: they are drawn
about the end of a Gauss–Newton step, with the information of the data at the present scores (Martin, Wilcox,
Burstedde & Ghattas 2012, *SIAM J. Sci. Comput.* 34, A1460–A1487). Step 2 is done twice, so that steps 1 and 2
together take three solves. Each solve also gives the derivatives from which the next step starts. This is not done
if values are correlated in time, the model has a discrepancy, gradients take extra solves, or there are frequency
response functions.

Step 1 mixes well whether or not the tests are precise (Osmundsen, Kleppe & Liesenfeld 2021, *J. Comput. Graph.
Stat.* 30, 906–919). The acceptance rate of step 2 does not depend on the number of tests. Some proposals of step
2, chosen at random, are random-walk steps of random size instead. They bring back a test whose scores are in a
tail that the Student distribution lacks, where independent proposals would almost never be accepted.

If a sudden loss has an unknown date, a new date and new losses are proposed before step 1, in their density with
the scores marginalised (`fmu.posterior.joint.conditional.dates`). As in step 1, the proposal is accepted or
rejected after a solve of all tests.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from fmu.arguments import check_arguments
from fmu.posterior.discrepancy.given_errors import with_errors_as_parameters
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.joint.conditional.both import conditionals
from fmu.posterior.joint.conditional.group_effects import GroupEffectsGivenValues, group_effect_steps
from fmu.posterior.joint.conditional.in_time import move_in_time
from fmu.posterior.joint.conditional.scores import REGULAR, Linear, Normal
from fmu.posterior.joint.varies.base import sum_by_test
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity, scaled_density
from fmu.samplers.adaptation import DualAveraging
from fmu.samplers.gibbs.errors_of_model import MovesWithErrors
from fmu.samplers.gibbs.main_parameters import Fit, fit_to, select_fit
from fmu.samplers.kernel import Info, Sampler, State, Tree
from fmu.samplers.local import accept
from fmu.samplers.settings import positive_number
from fmu.samplers.trajectory import Metric
from fmu.types import BoolArray, FloatArray, IntArray, LogDensity, Positive

_FIRST_STEP = 0.5
_ACCEPT = 0.8
_NU = 5.0
"""Degrees of freedom of the Student distributions from which scores are proposed, except for random walks."""
_WALKS = 0.35
"""Probability that a test's scores are proposed by a random-walk step."""
_LOCAL_MOVES, _LOCAL = 2, 0.5
"""Number of moves of all scores in a step where the densities of some tests have curved ridges, and the
probability that such a move proposes the scores of one of these tests by a local step."""
_CURVED = 0.05
"""Smallest curvature of a ridge that local steps follow (`ScoresGivenMain.curvature`)."""
_SMALLEST = 0.05
"""Size of the smallest random-walk step, in standard deviations; the largest is 1."""


@check_arguments
@dataclass(frozen=True)
class GibbsSampler(Sampler):
    """Gibbs sampler for a posterior with populations over several tests (`fmu.JointProblem`).

    Each step moves the main parameters, then the test scores, then the populations; see
    `fmu.samplers.gibbs.gibbs`.

    Parameters
    ----------
    step_size : float, optional
        Step size of the main parameters' trajectories, in standard deviations; learnt in warm-up by default.

    Raises
    ------
    ValueError
        If a setting is out of range.

    References
    ----------
    Osmundsen, Kleppe & Liesenfeld (2021), J. Comput. Graph. Stat. 30, 906-919 (main parameters); Martin, Wilcox,
    Burstedde & Ghattas (2012), SIAM J. Sci. Comput. 34, A1460-A1487 (test scores).
    """

    step_size: Positive | None = None

    name: ClassVar[str] = "gibbs"
    title: ClassVar[str] = "Gibbs sampling by tests"
    colour: ClassVar[str] = "#117733"
    cost: ClassVar[tuple[float, float, float]] = (2.0, 2.0, 0.9)
    first: ClassVar[tuple[int, int]] = (100, 250)
    takes_maxima: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.step_size is not None:
            object.__setattr__(self, "step_size", positive_number("step_size", self.step_size))

    def bind(self, density: LogDensity) -> GibbsKernel:
        """Return the kernel that samples `density`; raise ValueError if it has no populations over tests."""
        scaled = scaled_density(density)
        problem = scaled.density
        if not isinstance(problem, UpdatingProblem) or not problem.is_hierarchical:
            raise ValueError("problem: must have a population over several tests for Gibbs sampling (got none)")
        found = conditionals(problem)
        metric = Metric.of(found.normal.covariance, len(found.normal.mean))
        step_size = np.asarray(_FIRST_STEP if self.step_size is None else self.step_size)
        collapsed = problem.with_layout(problem.layout.remove_centring())
        given = with_errors_as_parameters(problem)
        likelihood, ridges = problem.likelihood, None
        if (
            np.max(found.scores.curvature) > _CURVED
            and isinstance(likelihood, ModalLikelihood)
            and not likelihood.has_discrepancy
            and problem.layout.in_time is None
            and problem.solves_per_gradient == 1
        ):
            ridges = likelihood
        effects = group_effect_steps(collapsed.layout, problem.parameters)
        return GibbsKernel(given, found, metric, step_size, ridges, collapsed, scaled, problem, effects)

    def tuner(self, density: LogDensity, chains: int, steps: int) -> GibbsTuner | None:
        """Return a tuner that learns the step size during warm-up, or None if `step_size` is given."""
        return GibbsTuner(self, density) if self.step_size is None else None


@dataclass(frozen=True)
class GibbsKernel(MovesWithErrors):
    """Kernel of the Gibbs sampler; the module docstring describes its steps.

    Attributes
    ----------
    scaled : ScaledDensity
    whole : UpdatingProblem
        The problem that is sampled. Its parameters never include the model errors. The parameters of `problem`
        include them if the model has a discrepancy.
    between_groups : tuple of GroupEffectsGivenValues
        Steps of the populations that scatter between groups of tests.
    """

    scaled: ScaledDensity
    whole: UpdatingProblem
    between_groups: tuple[GroupEffectsGivenValues, ...]

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the starting points; return the state, and an `Info` with the cost of the evaluation.

        `State.extra` is the `Fit` of the points and, if the model has a discrepancy, the most probable model
        errors.
        """
        theta = self.scaled.to_theta(positions)
        ones, none = np.ones(len(positions), dtype=np.int64), np.zeros(len(positions), dtype=np.int64)
        if self.has_errors:
            log_prob, extra = np.asarray(self.whole.log_prob(theta)), self.likeliest_errors(theta)
            return State(positions, log_prob, extra=extra), Info(none > 0, log_prob, 3 * ones, none)
        if self.ridges is None:
            fit = {"terms": self.problem.terms_of_tests(theta)}
        else:
            fit = self.fit_at(self.problem.layout.standardise_scores(theta))
        log_prob = fit["terms"].sum(axis=1) + self.problem.log_prior(theta)
        return State(positions, log_prob, extra=fit), Info(none > 0, log_prob, ones, none)

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Move the main parameters together with the scores, then the scores alone, then the populations.

        The module docstring describes all steps.
        """
        theta = self.problem.layout.standardise_scores(self.scaled.to_theta(state.position))
        if self.has_errors:
            theta = np.concatenate([theta, state.extra["errors"]], axis=1)
        theta, scales = self._draw_scales(rng, theta)
        fit = {name: value for name, value in state.extra.items() if name != "errors"}
        theta, fit, of_dates = self.move_dates(rng, theta, fit, scales)
        theta, fit, linear, extra = self.move_main(rng, theta, fit, scales)
        theta, fit, moved, solves = self._move_all_scores(rng, theta, fit, linear, scales)
        solves += len(self.conditionals.events)
        populations = self.conditionals.populations
        if populations.n_blocks:
            found = populations.propose(rng, theta)
            theta = populations.move(theta, found, accept(rng, found.log_ratio))
        if self.conditionals.walks is not None:
            theta = self.conditionals.walks.move(rng, theta)
        for one in self.between_groups:
            theta = one.move(rng, theta)
        terms = fit["terms"]
        if self.has_errors:
            theta, terms, fit, shifted = self.move_with_errors(rng, theta, terms)
            extra, solves = {**extra, "main_shifted": shifted}, solves + self.solves_with_errors
        elif len(self.conditionals.noise):
            at = self.collapsed.layout.of_model(theta)
            seen = self.modal.observed(at, self.ridges is not None)
            theta, terms = self.move_noise(rng, theta, at, seen, terms)
            fit, solves = {"terms": terms}, solves + 1
            if self.ridges is not None:
                fit = fit_to(self.ridges, seen, self.collapsed.layout.of_model(theta))
        theta = self.problem.layout.restore_scores(theta)
        log_prob = terms.sum(axis=1) + self.whole.log_prior(theta)
        info = Info(
            moved > 0.0, log_prob, solves, np.zeros_like(solves), {"acceptance_rate": moved, **extra, **of_dates}
        )
        return State(self.scaled.to_scaled(theta), log_prob, extra=fit), info

    def _draw_scales(self, rng: np.random.Generator, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Draw which tests are outliers, given the scores, and then the fraction of outliers.

        Return theta and the prior standard deviations of the scores, shape (chains, n_tests, p) with p scores per
        test. If the problem has no outliers, return theta unchanged and `REGULAR`.
        """
        outliers = self.problem.layout.outliers
        if outliers is None:
            return theta, REGULAR
        scales = outliers.draw_scales(rng, theta, self.conditionals.scores.scores.take(theta))
        return outliers.draw_share(rng, theta, scales), scales

    def _move_all_scores(
        self, rng: np.random.Generator, theta: FloatArray, fit: Fit, linear: Linear, scales: FloatArray
    ) -> tuple[FloatArray, Fit, FloatArray, IntArray]:
        """Move all test scores; return theta, the fit there, fractions of moved tests, and solve counts.

        Fractions and counts have shape (chains,). The counts include the solve for the main parameters' step. If
        values are correlated in time, their populations' parameters move too, including the correlation times.
        """
        in_time, ones = self.problem.layout.in_time, np.ones(len(theta), dtype=np.int64)
        if self.ridges is not None:
            of_ridges = self._move_along_ridges(rng, theta, fit, linear, scales, self.ridges)
            return *of_ridges, (1 + _LOCAL_MOVES) * ones
        terms = fit["terms"]
        if in_time is None:
            theta, terms, moved = self._move_scores(rng, theta, terms, linear, scales)
            return theta, {"terms": terms}, moved, 2 * ones
        moved = np.zeros(len(theta))
        for part in in_time.parts:
            theta, terms, of_part = self._move_scores(rng, theta, terms, linear, scales, part)
            moved += of_part
        z = self.conditionals.scores.scores.take(theta)
        theta = in_time.draw_times(rng, theta, z, self.problem.parameters)
        theta = move_in_time(rng, theta, self.conditionals.scores.layout, self.problem.parameters)
        return theta, {"terms": terms}, moved, (1 + len(in_time.parts)) * ones

    def _move_scores(
        self,
        rng: np.random.Generator,
        theta: FloatArray,
        terms: FloatArray,
        linear: Linear,
        scales: FloatArray = REGULAR,
        part: BoolArray | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Propose new scores for the tests in `part` (all tests if None), and accept or reject them test by test.

        Return theta, the log-likelihood terms, shape (chains, n_terms), and the fraction of all tests whose scores
        were accepted, shape (chains,).
        """
        of, test = self.conditionals.scores, self.problem.likelihood.test_of_terms
        z = of.scores.take(theta)
        new, log_ratio = self._propose(rng, z, of.normal_of(linear))
        bent = new if part is None else np.where(part[:, None], new, z)
        candidate = of.scores.put(theta, bent)
        new_terms = self.fit_at(candidate)["terms"]
        with np.errstate(invalid="ignore"):
            gain = self._gain_of_tests((theta, candidate), (terms, new_terms), scales)
            if part is not None:
                gain = gain + self._in_time_of_each(candidate) - self._in_time_of_each(theta)
            ratio = gain + log_ratio
        accepted = accept(rng, ratio) if part is None else accept(rng, ratio) & part
        chosen = np.where(accepted[..., None], of.scores.take(candidate), z)
        terms = np.where(accepted[:, test], new_terms, terms)
        return of.scores.put(theta, chosen), terms, accepted.mean(axis=1)

    def _propose(self, rng: np.random.Generator, z: FloatArray, normal: Normal) -> tuple[FloatArray, FloatArray]:
        """Return scores z* proposed for all tests, (chains, n_tests, p), and log q(z | z*)/q(z* | z).

        z are the present scores, and q is the density of the proposal.
        """
        walks = rng.random(z.shape[:2]) < _WALKS
        heavy = np.sqrt(_NU / rng.chisquare(_NU, z.shape[:2]))
        size = np.where(walks, _SMALLEST ** rng.random(z.shape[:2]), heavy)
        step = normal.scatter(size[..., None] * rng.standard_normal(z.shape) * normal.scored)
        now = normal.straighten(z)
        new = np.where(walks[..., None], now, normal.mean) + step
        ratio = np.where(walks, 0.0, normal.log_density(now, _NU) - normal.log_density(new, _NU))
        return normal.bend(new), ratio

    def _move_along_ridges(
        self,
        rng: np.random.Generator,
        theta: FloatArray,
        fit: Fit,
        linear: Linear,
        scales: FloatArray,
        likelihood: ModalLikelihood,
    ) -> tuple[FloatArray, Fit, FloatArray]:
        """Move the scores of all tests; return theta, the fit there, and the fractions of moved tests.

        In tests with curved ridges, some proposals start from the present scores; see the module docstring.
        """
        of, test = self.conditionals.scores, likelihood.test_of_residuals
        normal = of.normal_of(linear)
        moved, by_local = np.zeros(len(theta)), np.where(of.curvature > _CURVED, _LOCAL, 0.0)
        here = of.approximate_here(theta, fit["residuals"], fit["slopes"], test, scales)
        for _ in range(_LOCAL_MOVES):
            z = of.scores.take(theta)
            other, log_ratio = self._propose(rng, z, normal)
            local = rng.random(z.shape[:2]) < by_local
            new = np.where(local[..., None], here.draw(rng, _NU), other)
            candidate = of.scores.put(theta, new)
            new_fit = self.fit_at(candidate)
            there = of.approximate_here(candidate, new_fit["residuals"], new_fit["slopes"], test, scales)
            with np.errstate(invalid="ignore"):
                gain = self._gain_of_tests((theta, candidate), (fit["terms"], new_fit["terms"]), scales)
                back = there.log_density(z, _NU) + there.log_det_factor
                forth = here.log_density(new, _NU) + here.log_det_factor
                ratio = gain + np.where(local, back - forth, log_ratio)
            accepted = accept(rng, ratio)
            theta = of.scores.put(theta, np.where(accepted[..., None], new, z))
            fit = select_fit(accepted[:, likelihood.test_of_terms], accepted[:, test], new_fit, fit)
            here, moved = there.select(accepted, here), moved + accepted.mean(axis=1) / _LOCAL_MOVES
        return theta, fit, moved

    def _gain_of_tests(
        self, theta: tuple[FloatArray, FloatArray], terms: tuple[FloatArray, FloatArray], scales: FloatArray
    ) -> FloatArray:
        """Return the increase in each test's log-density from the first theta to the second, (chains, n_tests)."""
        of, test = self.conditionals.scores, self.problem.likelihood.test_of_terms
        (now, new), (terms_now, terms_new) = theta, terms
        gain = sum_by_test(terms_new - terms_now, test, len(self.problem.tests))
        return gain + of.log_prior(new, scales) - of.log_prior(now, scales)

    def _in_time_of_each(self, theta: FloatArray) -> FloatArray:
        """Return the log-density that correlation in time adds to each test's scores, (chains, n_tests)."""
        in_time = self.problem.layout.in_time
        assert in_time is not None
        return in_time.of_each(theta, self.conditionals.scores.scores.take(theta))


class GibbsTuner:
    """Tuner of the step size for the main parameters' trajectories.

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
        """Adapt the settings to one more warm-up step."""
        self.averaging.update(np.asarray(np.mean(info.extra["main_acceptance"])))
        self._take()

    def finish_learning(self) -> GibbsSampler:
        """Return the settings with the learnt step size."""
        return replace(self.sampler, step_size=float(np.exp(self.averaging.averaged)))

    def state(self) -> Tree:
        """Return the tuner's state as plain data."""
        return {"averaging": vars(self.averaging)}

    def restore(self, state: Tree) -> None:
        """Restore the state that another tuner's `state` returned."""
        self.averaging = DualAveraging(**state["averaging"])
        self._take()

    def _take(self) -> None:
        self.kernel = replace(self.kernel, step_size=np.exp(self.averaging.log_value))
