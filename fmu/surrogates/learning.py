"""`fmu.surrogate`, which replaces a problem's slow model by Gaussian processes and certifies their error."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.arguments import ArgumentError, Seed, check_arguments
from fmu.fem.approximation import Approximation
from fmu.fem.black_box import solves_of_a_surrogate
from fmu.fem.certificates import SurrogateCertificate
from fmu.fem.pairing.paired_structure import structure_of
from fmu.fem.surrogate.coordinates import Coordinates
from fmu.fem.surrogate.feasibility import EDGE, failed_region
from fmu.fem.surrogate.surrogate_model import Design, SurrogateModel, orient_shapes, solve_design
from fmu.numbers import significant
from fmu.posterior.parameters import box
from fmu.progress.phases import Phase, phase
from fmu.surrogates.error_limits import ErrorLimits, draws_needed
from fmu.surrogates.selection import choose_draws, error_variances, stratify
from fmu.types import FloatArray, IntArray

if TYPE_CHECKING:
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem

TOLERANCE = 0.05
BATCH, CHECKS = 4, 12
_STARTS, _CHAINS, _WARMUP, _DRAWS = 32, 8, 250, 150
_CANDIDATES = 300
_UNDECIDED = 0.05
"""Largest fraction of posterior draws allowed between points that were solved and points that failed."""
_MAY_BE_SWAPPED = 0.6
"""MAC with the measured shape below which the paired mode may be the wrong one."""


class SurrogateWarning(UserWarning):
    """Warns that a surrogate has not reached its tolerance."""


@check_arguments
def surrogate(
    problem: UpdatingProblem,
    *,
    seed: Seed = 1,
    tolerance: float = TOLERANCE,
    batch: int | None = None,
    checks: int = CHECKS,
    max_solves: int | None = None,
    engine: Engine | None = None,
) -> UpdatingProblem:
    """Return the same problem with Gaussian processes in place of its slow model.

    The processes are first fitted to solves at points that fill the space within the bounds. Batches of solves are
    then added at those posterior draws that reduce the error of the posterior most. When the surrogate predicts a
    small error, the slow model is solved at fresh posterior draws, and the errors there give the certificate. If
    the certificate shows that the error of the posterior may exceed the tolerance, these solves are added to the
    design, and the procedure continues. The solves of the final certificate are never part of the design.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with a `BlackBoxModel`, or with any `ModalModel` without matrices.
    seed : int
        Seed of the random numbers.
    tolerance : float
        Largest error allowed, with 95 % confidence, both for the error of any posterior mean, divided by the
        posterior standard deviation, and for the relative error of any posterior standard deviation. Above 0 and
        at most 1.
    batch : int, optional
        Number of solves between two rounds of sampling; they can run in parallel. The default is the number of
        structural parameters, but at least four. The design depends on this number, but not on the number of
        workers.
    checks : int
        Number of draws at which the model is solved for a certificate, at least 8. More are used if that costs
        less than a better surrogate.
    max_solves : int, optional
        Number of solves after which the procedure ends, even if the tolerance is not reached. The default is 100,
        plus 50 for each structural parameter.
    engine : Engine, optional
        Calls the user's function at several theta in parallel; see `fmu.engine`.

    Returns
    -------
    UpdatingProblem
        The problem with the surrogate. ``model.certificate`` contains the limits on its error and the number of
        solves (`fmu.fem.certificates.SurrogateCertificate`).

    Raises
    ------
    ValueError
        If the model has matrices or is a surrogate already; if the problem has several tests or populations, or
        its likelihood has no residuals of modes; if a number is out of range, such as `max_solves` too small for
        the first design and the checks; or if nearly all solves fail.

    Warns
    -----
    SurrogateWarning
        If the procedure ended before the tolerance was reached.
    """
    batch = max(BATCH, problem.n_structural) if batch is None else batch
    max_solves = most_solves(problem) if max_solves is None else max_solves
    _check(problem, tolerance, batch, checks, max_solves)
    learner = _Learner(problem, seed, max_solves)
    with problem.model.spread_over(engine), phase("surrogate", expected_solves(problem)) as under_way:
        learner.begin(under_way)
        if learner.left < checks:
            rule = f"must leave {checks} solves for the checks after the first design, which took {learner.solves}"
            raise ArgumentError("max_solves", rule, max_solves)
        limits = _learnt(learner, tolerance, batch, checks, under_way)
    _tell(learner, limits, tolerance, checks)
    certificate = learner.certificate(limits, tolerance)
    return problem.with_model(Approximation(problem.model, learner.model, certificate))


def _learnt(learner: _Learner, tolerance: float, batch: int, checks: int, under_way: Phase) -> ErrorLimits:
    """Extend the design until the certificate meets the tolerance; return the certificate's error limits.

    The extension also ends if too few solves are left for another certificate, or if the scatter of the solver
    prevents a better one.
    """
    optimism, at_floor = 1.0, 0
    while True:
        draws, expected, floor = learner.posterior()
        edge = learner.find_undecided(draws)
        under_way.said["expected_error"] = optimism * expected
        # beyond two batches more checks are not cheaper than a better surrogate
        most = checks + 2 * batch
        n_checks = draws_needed(optimism * expected, learner.drawn, tolerance, checks, most)
        is_rough = (n_checks == 0 and optimism * expected > 0.5 * floor) or len(edge) > _UNDECIDED * len(draws)
        if is_rough and learner.left - checks >= batch:
            tested = learner.rng.permutation(edge)[: batch // 2]
            rows = choose_draws(learner.likelihood, learner.model, draws, batch - len(tested))
            learner.extend(draws[np.unique([*tested, *rows])], under_way)
            continue
        n_checks = min(n_checks or checks, learner.left)
        variance, _ = error_variances(learner.likelihood, learner.model, draws)
        theta = draws[stratify(variance, n_checks, learner.rng)]
        errors, answers = learner.check_draws(theta, under_way)
        limits = ErrorLimits.of(errors, learner.drawn, expected)
        under_way.said["certificate"] = limits.shift
        # more solves do not reduce the scatter of the checks; a single estimate of the scatter may be wrong
        is_limiting = not draws_needed(floor, learner.drawn, tolerance, checks, most)
        at_floor += is_limiting and limits.sd <= 2.0 * np.hypot(floor, expected)
        if limits.shift <= tolerance or learner.left < checks or at_floor > 1:
            return limits
        if np.isfinite(limits.sd) and expected > 0.0:
            optimism = max(1.0, np.sqrt(limits.sd / expected))  # the checks join the design and reduce the error
        learner.learn(answers)


class _Learner:
    """The growing design, the surrogate fitted to it, and the problem with this surrogate."""

    def __init__(self, problem: UpdatingProblem, seed: int, max_solves: int) -> None:
        self.given, self.truth = problem, problem.model
        self.rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(20,)))
        self.seed, self.most = seed, max_solves
        self.n = problem.n_structural
        self.n_first = 2 * self.n + 6
        lower, upper = box(problem.parameters[: self.n])
        positive = np.array([p.lower >= 0.0 for p in problem.parameters[: self.n]])
        self.coordinates = Coordinates.of_box(lower, upper, positive)
        needs = problem.likelihood.needs_shapes
        self.reference = np.asarray(problem.data.shapes) if needs else None
        self.solves = self.rounds = 0
        self.frequency_error, self.most_scatter = 0.0, np.inf
        self.previous: FloatArray | None = None

    @property
    def likelihood(self) -> Any:
        return self.problem.likelihood

    @property
    def left(self) -> int:
        return self.most - self.solves

    def begin(self, under_way: Phase) -> None:
        """Solve at the starting point and at points that fill the parameter space, and fit a first surrogate.

        More points are added if too few solves succeed. Raise ValueError if too few succeed even then.
        """
        from scipy.stats import qmc

        design: Design | None = None
        theta = self.given.start[None, : self.n]
        while True:
            power = int(np.ceil(np.log2(self.n_first)))
            x = 2.0 * qmc.Sobol(self.n, rng=self.rng).random_base2(power)[: self.n_first - len(theta)] - 1.0
            theta = np.concatenate([theta, self.coordinates.to_theta(x)])
            found = self._solve(theta, under_way)
            design = found if design is None else design.join(found)
            if np.sum(~design.failed) > self.n + 1:
                break
            if self.left < self.n_first or self.solves > 10 * self.n_first:
                reasons = self.truth.reasons
                first = f", first with: {reasons[0].reason}" if reasons else ""
                raise ValueError(
                    "model: must be solved at more points within the bounds "
                    f"({int(np.sum(design.failed))} of {self.solves} failed{first})"
                )
            theta = np.empty((0, self.n))
        self.design = design
        self._fit(None)

    def posterior(self) -> tuple[FloatArray, float, float]:
        """Return up to 300 distinct draws from the surrogate's posterior, (n, ndim), and two expected errors.

        Both are errors of the log-probability, as root mean squares over the posterior. The first is due to the
        surrogate's own uncertainty, the second to the scatter of the solver. All draws are stored in `drawn`.
        """
        from fmu.analysis.maxima.search import find_map
        from fmu.analysis.maxima.starts import choose_starts, components
        from fmu.samplers.loop.run import Run
        from fmu.samplers.registry import make_sampler

        self.rounds += 1
        seed = int(np.random.SeedSequence(self.seed, spawn_key=(21, self.rounds)).generate_state(1)[0])
        maxima = find_map(self.problem, _STARTS)
        settings = make_sampler("mixture").starting_from(*components(self.problem, maxima))
        start = choose_starts(self.problem, "maxima", maxima, _CHAINS, 1, seed).position
        run = Run(self.problem, settings, warmup=_WARMUP, chains=_CHAINS, seed=seed, init=start)
        self.drawn = run.extend(_DRAWS).posterior.position.reshape(-1, self.problem.ndim)
        drawn = np.unique(self.drawn, axis=0)
        draws = drawn[np.sort(self.rng.permutation(len(drawn))[:_CANDIDATES])]
        self.previous = draws[:, : self.n]
        of_both = error_variances(self.likelihood, self.model, drawn)
        expected, floor = (float(np.sqrt(np.mean(variance))) for variance in of_both)
        return draws, expected, floor

    def find_undecided(self, draws: FloatArray) -> IntArray:
        """Return the indices of the draws (n, ndim) at which it is uncertain whether a solve would fail.

        These draws lie close to the boundary between points with successful solves and points with failed ones.
        """
        margin = self.model.feasibility.margin(self.coordinates.to_x(draws[:, : self.n]))
        return np.flatnonzero(np.abs(margin) < EDGE)

    def extend(self, draws: FloatArray, under_way: Phase) -> None:
        """Solve at draws (n, ndim), add these solves to the design, and refit the surrogate."""
        self.learn(self._solve(draws[:, : self.n], under_way))

    def check_draws(self, draws: FloatArray, under_way: Phase) -> tuple[FloatArray, Design]:
        """Solve at draws (n, ndim); return the surrogate's log-probability errors, (n,), and the solves.

        An error is NaN where the solve failed. The frequency errors are stored for the certificate.
        """
        answers = self._solve(draws[:, : self.n], under_way)
        self.checks = answers.theta
        expected = self.model.frequencies(draws[:, : self.n])
        with np.errstate(invalid="ignore"):
            errors = np.sum(self.given.likelihood.terms(draws) - self.likelihood.terms(draws), axis=1)
        good = ~answers.failed
        off = np.abs(expected[good] / answers.frequencies[good] - 1.0)
        self.frequency_error = float(np.max(off, initial=0.0))
        self.most_scatter = float(np.sqrt(np.max(np.mean(off**2, axis=0)))) if good.any() else np.inf
        return np.where(good, errors, np.nan), answers

    def learn(self, answers: Design) -> None:
        """Add solves to the design, and refit the surrogate."""
        self.design = self.design.join(answers)
        self._fit(self.model)

    def certificate(self, limits: ErrorLimits, tolerance: float) -> SurrogateCertificate:
        """Return the surrogate's certificate, which states the limits on its errors."""
        failed = self.design.failed
        estimated = 0.5 * float(np.max(self.model.pairs.of_eigenvalues(self.model.scatter)))
        where = failed_region(self.design.theta, failed, self.problem.names) if failed.any() else ""
        return SurrogateCertificate(
            solves=self.solves,
            design=len(self.design.theta),
            failed=int(np.sum(failed)) + limits.n_failed,
            failed_where=where,
            doubts=self._doubts(),
            scatter=min(estimated, self.most_scatter),  # the errors of the checks contain the scatter
            draws=limits.n,
            frequency_error=self.frequency_error,
            log_prob_error=limits.largest,
            share=limits.share,
            log_prob_sd=limits.sd,
            shift=limits.shift,
            shift_tolerance=tolerance,
        )

    def _doubts(self) -> str:
        """Return sentences, one per line, on modes that may have been paired wrongly near the posterior.

        The text is empty if there are no such modes, if the modes are not paired by shape, or if no mode shapes
        are known.
        """
        shapes = self.given.data.shapes
        if not (self.truth.by_shape and self.truth.gives_shapes) or shapes is None:
            return ""
        theta = np.concatenate([self.design.theta[self.n_first :], self.checks])
        seen = orient_shapes(
            self.truth.observed(theta).shapes, np.asarray(shapes)
        )  # these solves are in memory: nothing is solved again
        unit = np.asarray(shapes) / np.linalg.norm(shapes, axis=0)
        unlike = np.sum(np.sum(seen * unit, axis=1) ** 2 < _MAY_BE_SWAPPED, axis=0)
        labels = self.given.data.labels
        return "\n".join(
            f"Mode {labels[i]} has a MAC below {_MAY_BE_SWAPPED} with the measured shape at {unlike[i]} of "
            f"{len(theta)} solves near the posterior: another mode may have been paired there."
            for i in np.flatnonzero(unlike)
        )

    def _solve(self, theta: FloatArray, under_way: Phase) -> Design:
        found = solve_design(self.truth, theta, self.reference is not None)
        self.solves += len(theta)
        under_way.advance(len(theta))
        return found

    def _fit(self, before: SurrogateModel | None) -> None:
        model = SurrogateModel(self.truth, self.design, self.coordinates, self.reference, before)
        if self.previous is not None:
            model.limit_variance(self.previous)
        self.model, self.problem = model, self.given.with_model(Approximation(self.truth, model))


def certificate_of(problem: UpdatingProblem) -> SurrogateCertificate:
    """Return the certificate of the surrogate in a problem, which must have one."""
    found = problem.model.certificate
    assert isinstance(found, SurrogateCertificate)
    return found


def can_learn(problem: UpdatingProblem) -> str:
    """Return the reason why a surrogate cannot be built for a problem, or an empty string if it can."""
    if problem.model.is_uncertain:
        return "the model is a surrogate already"
    if any(map(structure_of, problem.model.parts)):
        return "a surrogate is for a function or a command; a model with matrices has a reduced model"
    if problem.model.n_tests > 1 or problem.is_hierarchical or not problem.likelihood.of_modes:
        return "a surrogate is for a problem of one test with errors of modes"
    return ""


def expected_solves(problem: UpdatingProblem) -> int:
    """Return the approximate number of solves that a surrogate needs, quadratic in the number of parameters."""
    return problem.n_structural * (6 + problem.n_structural) + CHECKS


def most_solves(problem: UpdatingProblem) -> int:
    """Return the default `max_solves` of `surrogate` for a problem."""
    return solves_of_a_surrogate(problem.n_structural)


def _check(problem: UpdatingProblem, tolerance: float, batch: int, checks: int, max_solves: int) -> None:
    why_not = can_learn(problem)
    if why_not:
        raise ValueError(f"problem: {why_not} (got {problem.model!r})")
    least = 2 * problem.n_structural + 6 + checks
    for holds, name, rule, value in (
        (0.0 < tolerance <= 1.0, "tolerance", "above 0 and at most 1", tolerance),
        (batch >= 1, "batch", "at least 1", batch),
        (checks >= 8, "checks", "at least 8", checks),
        (max_solves >= least, "max_solves", f"at least {least}, the first design and the checks", max_solves),
    ):
        if not holds:
            raise ArgumentError(name, f"must be {rule}", value)


def _tell(learner: _Learner, limits: ErrorLimits, tolerance: float, checks: int) -> None:
    if not limits.shift <= tolerance:
        remedy = "allow more solves"
        if learner.left >= checks:
            remedy = "the solver's answers scatter, so that more solves would not help: tighten its tolerance"
        warnings.warn(
            f"the surrogate misses its tolerance after {learner.solves} solves: by {limits.n} draws posterior "
            f"means may be off by {significant(limits.shift, 2)} posterior standard deviations (asked for: "
            f"{significant(tolerance, 2)}); {remedy}",
            SurrogateWarning,
            stacklevel=3,
        )
