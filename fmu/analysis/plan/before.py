"""The state of knowledge before a planned test: the structure, and draws of its parameters.

The parameters come from the prior, from the linearised posterior of earlier tests, or from a run. A plan's
parameters ψ are the parameters in theta that matter for the planned test or its target. If parameters form
populations, ψ also includes the planned test's scores: the deviations of its parameter values from the population
means, in units of the populations' standard deviations. If a decision about damage is planned from a single
earlier test, ψ also includes the relative losses that the parameters may have suffered since that test. The
structural parameters in the planned test are functions of ψ.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import block_diag

from fmu.analysis.identifiability import truncated_sd
from fmu.analysis.maxima.results import NEGLIGIBLE
from fmu.analysis.maxima.search import find_map
from fmu.analysis.maxima.starts import scale_maximum
from fmu.analysis.trace.reading import check_trace, parameter_draws, parameter_names
from fmu.arguments import ArgumentError
from fmu.differences import both_sides
from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.pairing.prediction import ModalPrediction
from fmu.numbers import names_in_words
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.discrepancy.likelihood import DiscrepantLikelihood
from fmu.posterior.discrepancy.model_errors import ModelErrors
from fmu.posterior.joint.conditional.both import scatter_about_typical
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr

_STEP = 1e-4  # of differences, in standard deviations
_POSTERIOR = 10_000  # draws from the linearised posterior of earlier tests, which give its covariance
_BY_RUN = "plan with a run (--run, trace)"


@dataclass(frozen=True, eq=False)
class Before:
    """The parameters and the structure before a planned test.

    Attributes
    ----------
    problem : UpdatingProblem
    test : int
        Index of the earlier test that the planned one resembles.
    every : ndarray, shape (n_every,)
        Reference values of all parameters, of which ψ is a subset: the starting point or, after several tests or
        with a run, the posterior mean. Test scores and losses have their prior medians.
    columns : ndarray of int, shape (P,)
        Indices of ψ in `every`.
    parameters : tuple of Parameter
        The P parameters ψ.
    draws : ndarray, shape (n, P), SI units
        Draws of ψ.
    scale : ndarray, shape (P, P)
        L, where LLᵀ is the covariance of ψ.
    losses : tuple of int
        For a problem with one test: index in theta of each parameter that may have decreased since this test. The
        relative losses are the last entries of `every`.
    is_prior : bool
        True if the problem has one test, all structural parameters are updated, and ψ consists of these parameters
        with their priors, without losses.
    doubts : tuple of str
        Reasons why the linearised posterior of earlier tests, or the planned test's scores, may be wrong.
    errors : ModelErrors or None
        Errors of the model in a first test, before there are data on them. None without a discrepancy, after
        earlier tests or with a run.
    """

    problem: UpdatingProblem
    test: int
    every: FloatArray
    columns: IntArray
    parameters: tuple[Parameter, ...]
    draws: FloatArray
    scale: FloatArray
    losses: tuple[int, ...]
    is_prior: bool
    doubts: tuple[str, ...] = ()
    errors: ModelErrors | None = None

    @property
    def noise(self) -> FloatArray:
        """Starting values of the inferred error parameters, shape (n_noise,)."""
        p = self.problem.n_structural
        return self.problem.start[p : p + self.problem.likelihood.n_noise]

    @property
    def model(self) -> ModalModel:
        """Model used for the earlier test that the planned one resembles."""
        return self._configuration[0]

    @property
    def data(self) -> ModalData:
        """Measured modes of the earlier test that the planned one resembles."""
        return self.problem.tests[self.test].data

    @property
    def _configuration(self) -> tuple[ModalModel, IntArray]:
        """Model of the earlier test that the planned one resembles, and indices of its structural parameters."""
        return self.problem.model.in_test(self.test)

    @property
    def reference(self) -> FloatArray:
        """Reference values of ψ, shape (P,)."""
        return self.every[self.columns]

    @property
    def start(self) -> FloatArray:
        """Reference values of the model parameters, shape (n_parameters,)."""
        return self.values(self.reference[None])[0]

    def all_at(self, psi: FloatArray) -> FloatArray:
        """Return the vector of all parameters, (n, n_every), at ψ (n, P).

        It consists of theta, the test scores and the losses, in this order. Entries outside ψ have their reference
        values.
        """
        found = np.tile(self.every, (len(psi), 1))
        found[:, self.columns] = psi
        return found

    def theta(self, psi: FloatArray) -> FloatArray:
        """Return the structural part of theta at ψ (n, P), shape (n, n_structural)."""
        return self.all_at(psi)[:, : self.problem.n_structural]

    def losses_at(self, psi: FloatArray) -> FloatArray:
        """Return the relative losses since the problem's only test, at ψ (n, P), shape (n, n_losses)."""
        return self.all_at(psi)[:, len(self.every) - len(self.losses) :]

    def values(self, psi: FloatArray) -> FloatArray:
        """Return the model parameters in the planned test at ψ (n, P), shape (n, n_parameters)."""
        theta, layout = self.theta(psi), self.problem.layout
        theta[:, list(self.losses)] *= 1.0 - self.losses_at(psi)
        z = self.all_at(psi)[:, theta.shape[1] : theta.shape[1] + len(layout.drawn)]
        scores = layout.correlate(theta, z[:, None])[:, 0]
        found = layout.of_next_test(theta, np.random.default_rng(0), scores, self.test, {})
        return found[:, self._configuration[1]]

    def slopes(self, function: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Return a function's derivatives with respect to ψ at the draws, (n, t, P).

        The function maps ψ (n, P) to (n, t). The derivatives are central differences, one-sided at bounds.
        """
        n, p = self.draws.shape
        h = _STEP * np.linalg.norm(self.scale, axis=1)
        lower, upper = (np.array([getattr(one, end) for one in self.parameters]) for end in ("lower", "upper"))
        points, distance = both_sides(self.draws, h, lower, upper)
        found = function(points.reshape(-1, p)).reshape(2, n, p, -1)
        return np.asarray(np.swapaxes((found[0] - found[1]) / distance[..., None], 1, 2))

    def chain(self, seen: ModalPrediction) -> ModalPrediction:
        """Convert modal derivatives with respect to the model parameters to derivatives with respect to ψ.

        The chain rule is applied at each draw. If ψ are the model parameters, `seen` is returned unchanged.
        """
        if not self.losses and self.problem.layout.is_identity:
            return seen
        assert seen.frequency_slopes is not None  # for the type checker: derivatives were requested
        assert seen.shape_slopes is not None
        by_psi = self.slopes(self.values)
        return replace(
            seen,
            frequency_slopes=seen.frequency_slopes @ by_psi,
            shape_slopes=np.einsum("nqmk,nkp->nqmp", seen.shape_slopes, by_psi),
        )

    def at(self, kept: BoolArray | None) -> Before:
        """Return a copy with only the draws that a mask (n,) selects, or `self` if the mask is None."""
        return self if kept is None else replace(self, draws=self.draws[kept])

    def only(self, needed: BoolArray) -> Before:
        """Return a copy with only the parameters ψ that a mask (P,) selects, or `self` if it selects all.

        The other parameters are marginalised.
        """
        if needed.all():
            return self
        covariance = (self.scale @ self.scale.T)[np.ix_(needed, needed)]
        return replace(
            self,
            columns=self.columns[needed],
            parameters=tuple(one for one, used in zip(self.parameters, needed, strict=True) if used),
            draws=self.draws[:, needed],
            scale=np.linalg.cholesky(covariance),
        )


def known_before(
    problem: UpdatingProblem,
    trace: xr.DataTree | None,
    like: str | None,
    losses: Sequence[Parameter],
    n: int,
    rng: np.random.Generator,
) -> Before:
    """Collect the structure, the parameters and their draws as they are known before a planned test.

    Parameters
    ----------
    problem : UpdatingProblem
    trace : DataTree or None
        A run whose posterior describes the parameters. Without a run, the prior is used for a problem with one
        test, and the linearised posterior for a problem with several tests.
    like : str or None
        Name of the test that the planned one resembles. Defaults to the last test.
    losses : sequence of Parameter
        For a problem with one test: relative losses since this test. The name of each is the name of a parameter
        in theta, followed by " loss".
    n : int
        Number of draws.
    rng : Generator

    Raises
    ------
    ValueError
        If the trace is not a trace or has other parameters, `like` is not the name of one of several tests, a
        parameter has a separate value in each test, or a hierarchical problem with a discrepancy or with values
        that are correlated in time has no trace.
    """
    tests, p = [test.name for test in problem.tests], problem.n_structural
    several = len(tests) > 1
    is_first = trace is None and not several
    if like is not None and (like not in tests or not several):
        rule = f"must be one of {', '.join(tests)}" if several else "must not be given for a problem of one test"
        raise ArgumentError("like", rule, repr(like))
    own = next((role for role in problem.layout.roles if role.kind == "test"), None)
    if own is not None and own.of is not None:
        name = problem.layout.structural[own.of].name
        rule = "must have no parameter with a value of its own in each test, of which earlier tests tell nothing"
        raise ArgumentError("problem", rule, name)
    doubts: tuple[str, ...] = ()
    parameters, reference = problem.parameters[:p], problem.start[:p]
    if is_first:
        draws, scale = problem.sample_prior(rng, n)[:, :p], np.diag([truncated_sd(one) for one in parameters])
    else:
        if trace is None:
            every, doubts = _linearised_posterior(problem, rng)
        else:
            check_trace(trace)
            if parameter_names(trace)[:p] != problem.names[:p]:
                rule = f"must be of the parameters {problem.names[:p]}"
                raise ArgumentError("trace", rule, parameter_names(trace))
            every = parameter_draws(trace)[..., :p].reshape(-1, p)
            doubts = _doubt_of_time(problem)
        scale = np.linalg.cholesky(np.atleast_2d(np.cov(every.T)))
        draws, reference = every[rng.choice(len(every), n, replace=len(every) < n)], every.mean(axis=0)
    scores = [
        Parameter(f"{one.name} score [planned]", 0.0, prior=Normal(1.0))
        for one in _parameters_of_populations(problem)
    ]
    added = [*scores, *losses]
    if added:
        drawn = [one.prior.draw(rng, n, one.lower, one.upper) for one in added]
        draws = np.column_stack([draws, *drawn])
        scale = block_diag(scale, *(truncated_sd(one) for one in added))
        reference = np.append(reference, [one.prior.median_within(one.lower, one.upper) for one in added])
    names, likelihood = [one.name for one in parameters], problem.likelihood
    return Before(
        problem,
        tests.index(like) if like is not None else len(tests) - 1,
        reference,
        np.arange(len(reference)),
        (*parameters, *added),
        draws,
        scale,
        tuple(names.index(one.name.removesuffix(" loss")) for one in losses),
        trace is None and not losses and problem.layout.is_identity,
        doubts,
        likelihood.errors if is_first and isinstance(likelihood, DiscrepantLikelihood) else None,
    )


def _parameters_of_populations(problem: UpdatingProblem) -> list[Parameter]:
    """Return the structural parameters that form populations over the tests, ordered as in ``layout.drawn``."""
    layout = problem.layout
    return [p for p in layout.structural if p.name in layout.populations]


def _doubt_of_time(problem: UpdatingProblem) -> tuple[str, ...]:
    """Return a doubt if values are correlated in time, because the planned scores ignore the earlier tests."""
    every = zip(_parameters_of_populations(problem), problem.layout.drawn, strict=True)
    names = [parameter.name for parameter, one in every if one.in_time is not None]
    if not names:
        return ()
    return (
        f"The values of {names_in_words(names)} are correlated in time, but the plan assumes that the new test is "
        "so late that its values are independent of the earlier ones. A test that follows soon tells less about "
        "the population.",
    )


def _linearised_posterior(
    problem: UpdatingProblem, rng: np.random.Generator
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return draws from the tests' linearised posterior, (n, n_structural), and reasons to doubt it.

    The posterior is approximated by a Gaussian at each maximum, within the bounds. If parameters form populations,
    it is approximated at the typical point instead, where an unknown date of a loss has a fixed value. Raise
    ValueError if values are correlated in time, or if parameters form populations and the model has a discrepancy.
    """
    p, layout = problem.n_structural, problem.layout
    if problem.is_hierarchical:
        if problem.likelihood.has_discrepancy:
            rule = "must be given where parameters scatter over the tests and the model has a discrepancy"
            raise ArgumentError("trace", rule, "none")
        if layout.in_time is not None:  # the typical point is of values that are independent in time
            raise ArgumentError("trace", "must be given where values are correlated in time", "none")
        doubts = [f"The date of the loss of {name} is uncertain; {_BY_RUN}." for name in layout.by_date]
        return scatter_about_typical(problem, rng, _POSTERIOR, 1.0)[:, :p], tuple(doubts)
    maxima, scaled = find_map(problem), ScaledDensity(problem)
    shares = np.array([one.share for one in maxima])
    counts = rng.multinomial(_POSTERIOR, shares / shares.sum())
    parts = [
        scale_maximum(one, scaled).proposal(scaled.lower, scaled.upper).draw(rng, int(count))
        for one, count in zip(maxima, counts, strict=True)
        if count
    ]
    several = int(np.sum(shares > NEGLIGIBLE))
    doubts = [f"The earlier tests leave {several} maxima; {_BY_RUN}."] if several > 1 else []
    at = [name for name, bound in zip(problem.names[:p], maxima[0].at_bound, strict=False) if bound]
    if at:
        doubts.append(
            f"The earlier tests put {names_in_words(at)} at a bound; check the model and the bounds (fmu check)."
        )
    return scaled.to_theta(np.concatenate(parts))[:, :p], tuple(doubts)
