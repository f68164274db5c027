"""The conditional densities of a hierarchical posterior: scores given the main parameters, and the reverse.

Given the main parameters, which are all parameters of theta but the scores, the scores of the tests are independent
of each other. Given the values of the structural parameters in all tests, the likelihood is constant: the means,
standard deviations and correlations of the populations, and all other main parameters that act through values that
scatter, then have a density that needs no solve of the model. Gibbs steps alternate between the two densities.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.joint.by_test import Expansion, Scores, expand, score_precision, slopes_by_score
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.typical import typical_point
from fmu.posterior.joint.varies.base import InTests, Slope
from fmu.posterior.joint.varies.population import Drawn
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.joint import JointPrior
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray, IntArray

_FAR = 6.0
"""Largest absolute score of an expansion, in standard deviations of the population."""
_INSIDE = 1e-9
"""Smallest distance of an expansion from the bounds of a value, relative to their distance."""
_STEP = 1e-4
_INFORMED = 0.5
_SCORES = 400
"""Number of draws of the scores of a test over which second derivatives are averaged."""


class Normal(NamedTuple):
    """Normal distributions of the scores of each test.

    Attributes
    ----------
    mean : ndarray, shape (n, n_tests, p)
    factor : ndarray, shape (n, n_tests, p, p)
        The Cholesky factor of the precision matrix.
    """

    mean: FloatArray
    factor: FloatArray

    def draw(self, z: FloatArray, share: float, noise: FloatArray) -> FloatArray:
        """Return draws that keep a share of the distance of z from the mean; `noise` is standard normal."""
        fresh = np.linalg.solve(np.swapaxes(self.factor, 2, 3), noise[..., None])[..., 0]
        return np.asarray(self.mean + share * (z - self.mean) + np.sqrt(1.0 - share**2) * fresh)

    def log_density(self, z: FloatArray) -> FloatArray:
        """Return the log-densities of z, (n, n_tests, p), up to a constant of each test, shape (n, n_tests)."""
        turned = np.einsum("ntji,ntj->nti", self.factor, z - self.mean)
        return -0.5 * np.einsum("nti,nti->nt", turned, turned)


class ScoresGivenMain:
    """The density of the scores given the main parameters, and a normal approximation of it.

    Parameters
    ----------
    layout : Layout
        A layout with populations, in which the scores of different tests are independent.
    expansion : Expansion
        The log-likelihoods of the tests about one theta (`fmu.posterior.joint.by_test.expand`, n = 1).
    prior : JointPrior
    """

    def __init__(self, layout: Layout, expansion: Expansion, prior: JointPrior) -> None:
        self.layout, self.prior, self.scores = layout, prior, Scores.of(layout)
        self.expansion = Expansion(*(part[0] for part in expansion))

    def log_prior(self, theta: FloatArray) -> FloatArray:
        """Return the log-density of the scores of each test, given the main parameters, shape (n, n_tests)."""
        layout, z = self.layout, self.scores.take(theta)
        found = -0.5 * np.einsum("ntp,ntp->nt", z, z)
        for one in layout.drawn:
            found += one.log_prior(theta)[0]
        if layout.correlation is not None:
            of = np.stack([one.population_scores(theta)[0] for one in layout.drawn], axis=2)
            found += layout.correlation.log_density(theta, of)[0]
        return found

    def approximate(self, theta: FloatArray) -> Normal:
        """Return the normal approximation of the scores' density at the main parameters of theta (n, ndim).

        The likelihood of each test is a normal distribution of the values in it (the expansion), and so is the
        prior about the score of the expansion's value.
        """
        layout, known, numbers = self.layout, self.expansion, self.scores.parameters
        n_parameters = len(layout.parameters)
        structural = theta[:, :n_parameters]
        z = np.stack(
            [
                _nearest_scores(
                    layout.values_of[j],
                    structural,
                    np.broadcast_to(known.values[:, j], (len(theta), len(layout.tests))),
                )
                for j in numbers
            ],
            axis=2,
        )
        z = np.where(self.scores.scored, np.clip(z, -_FAR, _FAR), 0.0)
        at = self.scores.put(theta, z)
        slopes = np.where(self.scores.scored, slopes_by_score(layout, at[:, :n_parameters]), 0.0)
        away = layout.values(at[:, :n_parameters]) - known.values
        gradient = known.slope - np.einsum("tij,ntj->nti", known.information, away)
        precision = known.information[:, numbers[:, None], numbers] * slopes[..., :, None] * slopes[..., None, :]
        precision = precision + score_precision(layout, structural)
        of_prior = np.where(self.scores.scored, self.prior.log_pdf_gradient(at)[:, self.scores.columns], 0.0)
        total = slopes * gradient[:, :, numbers] + of_prior
        mean = z + np.linalg.solve(precision, total[..., None])[..., 0]
        return Normal(mean, np.linalg.cholesky(precision))


class MainGivenValues:
    """The density of main parameters given the values of the structural parameters in all tests.

    It includes the parameters that act only through values that scatter, `columns` in theta: means, standard
    deviations and correlations of populations, and laws of covariates of parameters that scatter. The value of the
    likelihood depends on the values only and is left out.

    Parameters
    ----------
    layout : Layout
    parameters : sequence of Parameter
        All parameters of theta.
    """

    def __init__(self, layout: Layout, parameters: Sequence[Parameter]) -> None:
        self.layout, self.scores = layout, Scores.of(layout)
        at = np.array([[p.start for p in parameters]])
        main = set(range(len(layout.parameters))) - set(self.scores.columns[self.scores.scored].tolist())
        for one in layout.values_of:
            if not isinstance(one.base, Drawn):
                main -= {int(k) for slope in one(at[:, : len(layout.parameters)])[1] for k in slope.columns}
        self.columns: IntArray = np.array(sorted(main))
        self.others = len(parameters) - len(self.columns) - int(self.scores.scored.sum())
        self.prior = JointPrior([parameters[k] for k in self.columns])

    def values(self, theta: FloatArray) -> FloatArray:
        """Return the values that scatter, shape (n, n_tests, p), at theta (n, ndim)."""
        values: FloatArray = self.layout.values(theta[:, : len(self.layout.parameters)])
        return values[:, :, self.scores.parameters]

    def with_values(self, theta: FloatArray, values: FloatArray) -> FloatArray:
        """Return a copy of theta in which the scores are those of the values, (n, n_tests, p)."""
        of = theta[:, : len(self.layout.parameters)]
        z = [one.base.scores_at(values[:, :, k] / _factor(one, of)[0], of) for k, one in enumerate(self._drawn)]
        return self.scores.put(theta, np.stack(z, axis=2))

    def log_prob_and_grad(self, theta: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density (n,) and its gradient by the `columns`, (n, n_columns).

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)
            The scores in theta have no influence.
        values : ndarray, shape (n, n_tests, p)
            A value that the bounds of its parameter exclude gives the log-density −inf.
        """
        of = theta[:, : len(self.layout.parameters)]
        total = self.prior.log_pdf(theta[:, self.columns])
        gradient = np.zeros_like(theta)
        gradient[:, self.columns] = self.prior.log_pdf_gradient(theta[:, self.columns])
        inside = np.ones(len(theta), dtype=bool)
        copula = self.layout.correlation
        z, chains = np.zeros_like(values), []
        for k, one in enumerate(self._drawn):
            drawn, scored = one.base, self.scores.scored[:, k]
            factor, by_factor = _factor(one, of)
            value = np.where(scored, values[:, :, k] / factor, drawn.reference[0])
            within = ((value > drawn.lower) & (value < drawn.upper) & (factor > 0.0)).all(axis=1)
            inside &= within
            value = np.where(within[:, None], value, drawn.reference[0])
            ends = of[:, [drawn.centre]], of[:, [drawn.width]]
            p, slopes = drawn.population.log_pdf(value, *ends, drawn.lower, drawn.upper)
            total = total + np.einsum("nt->n", np.where(scored, p - np.log(np.abs(factor)), 0.0))
            chains.append((one, scored, value, by_factor))
            self._add(gradient, *chains[-1], slopes, -1.0)
            if copula is not None:
                z[:, :, k] = np.where(scored, drawn.population.scores(value, *ends, drawn.lower, drawn.upper), 0.0)
        if copula is not None:
            by_test, by_score, by_correlation = copula.log_density(theta, z)
            total = total + np.einsum("nt->n", by_test)
            gradient[:, copula.columns] += by_correlation
            for k, chain in enumerate(chains):
                drawn = chain[0].base
                ends = of[:, [drawn.centre]], of[:, [drawn.width]]
                by_z, by_centre, by_width = drawn.population.values(z[:, :, k], *ends, drawn.lower, drawn.upper)[1]
                per = by_score[:, :, k] / by_z
                self._add(gradient, *chain, (per, -per * by_centre, -per * by_width), 0.0)
        return np.where(inside, total, -np.inf), gradient[:, self.columns]

    @cached_property
    def _drawn(self) -> list[InTests]:
        return [self.layout.values_of[j] for j in self.scores.parameters]

    def _add(self, gradient, one, scored, value, by_factor, slopes, of_jacobian) -> None:
        """Add derivatives by value, centre and width to the gradient, by the chain rule for the factor too."""
        by_value, *of_both = (np.where(scored, part, 0.0) for part in slopes)
        for column, part in zip((one.base.centre, one.base.width), of_both, strict=True):
            gradient[:, column] += np.einsum("nt->n", part)
        for slope in by_factor:
            terms = np.where(scored, (of_jacobian - by_value * value) * slope.values, 0.0)
            for column in np.unique(slope.columns):
                gradient[:, column] += terms[:, slope.columns == column].sum(axis=1)


def _factor(one: InTests, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
    """Return the factor of the population's values, (n, n_tests), and the derivatives of its logarithm."""
    if one is one.base:
        return np.ones((1, 1)), []
    drawn = one.base
    value, slopes = one(theta)
    own = {drawn.centre, drawn.width}
    others = [s for s in slopes if s.columns is not drawn.columns and not own & set(s.columns.tolist())]
    return value / drawn(theta)[0], [Slope(s.columns, s.values / value) for s in others]


def _nearest_scores(one: InTests, theta: FloatArray, values: FloatArray) -> FloatArray:
    """Return the scores of values (n, n_tests), or of the nearest values within the bounds."""
    drawn = one.base
    margin = _INSIDE * (drawn.upper - drawn.lower) if np.isfinite(drawn.upper - drawn.lower) else 0.0
    base = np.clip(values / _factor(one, theta)[0], drawn.lower + margin, drawn.upper - margin)
    return drawn.scores_at(base, theta)


class MainGivenScores:
    """An approximate density of the main parameters given the scores relative to the populations.

    It includes all main parameters but the correlations of populations, whose density given the scores contains no
    data. In place of the likelihood of each test it has the expansion, a quadratic in the values of the structural
    parameters, and needs no solve of the model.

    Parameters
    ----------
    problem : UpdatingProblem
    expansion : Expansion
        The log-likelihoods of the tests about `theta`.
    theta : ndarray, shape (1, ndim)
        The typical point, about which the density of inferred standard deviations of errors is normal.
    """

    def __init__(self, problem: UpdatingProblem, expansion: Expansion, theta: FloatArray) -> None:
        self.layout, self.scores = problem.layout, Scores.of(problem.layout)
        self.plain = self.layout.remove_centring()
        self.expansion = Expansion(*(part[0] for part in expansion))
        correlated = [] if self.layout.correlation is None else list(self.layout.correlation.columns)
        held = np.concatenate([self.scores.columns[self.scores.scored], np.array(correlated, dtype=np.int64)])
        self.columns: IntArray = np.setdiff1d(np.arange(problem.ndim), held)
        self.prior = JointPrior([problem.parameters[k] for k in self.columns])
        self._noise = theta[:, problem.n_structural :]
        self._information = sum(
            (term.information(self._noise)[0] for term in problem.likelihood.terms_of),
            np.zeros((self._noise.shape[1], self._noise.shape[1])),
        )

    def hold(self, theta: FloatArray) -> FloatArray:
        """Return theta (n, ndim) with scores relative to the populations in place of its own."""
        z = np.stack([one.population_scores(theta)[0] for one in self.layout.drawn], axis=2)
        return self.scores.put(theta, z)

    def release(self, held: FloatArray) -> FloatArray:
        """Return theta (n, ndim) with its own scores in place of those relative to the populations."""
        for one in self.layout.drawn:
            if np.any(one.centring > 0.0):
                held = one.drawn(held)
        return held

    def log_prob_and_grad(self, held: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density (n,) and its gradient by the `columns`, (n, n_columns), at `held` (n, ndim)."""
        known, n = self.expansion, len(self.layout.parameters)
        away = self.plain.values(held[:, :n]) - known.values
        turned = np.einsum("tij,ntj->nti", known.information, away)
        value = np.einsum("nti,nti->n", away, known.slope - 0.5 * turned)
        noise = np.zeros((*away.shape[:2], self._noise.shape[1]))
        slopes = np.concatenate([known.slope - turned, noise], axis=2)
        gradient = self.plain.gradient(held, slopes, np.arange(away.shape[1]))
        by_noise = (held[:, n:] - self._noise) @ self._information
        gradient[:, n:] -= by_noise
        value -= 0.5 * np.einsum("nk,nk->n", by_noise, held[:, n:] - self._noise)
        main = held[:, self.columns]
        return value + self.prior.log_pdf(main), gradient[:, self.columns] + self.prior.log_pdf_gradient(main)


class Conditionals(NamedTuple):
    """The conditional densities of a hierarchical problem.

    Attributes
    ----------
    scores : ScoresGivenMain
    main : MainGivenValues
    shift : MainGivenScores
    curvatures : tuple of two ndarray
        Minus the second derivatives of the densities `main` and `shift` at the typical point, in scaled units.
    informed : float
        The smallest mean over the tests, of all populations, of the share of a value's precision that comes from
        the test itself rather than from the population; between 0 and 1.
    """

    scores: ScoresGivenMain
    main: MainGivenValues
    shift: MainGivenScores
    curvatures: tuple[FloatArray, FloatArray]
    informed: float

    @property
    def is_enough(self) -> bool:
        """Whether Gibbs steps by `scores` and `main` alone reach all parameters, and mix well."""
        return self.main.others == 0 and self.informed > _INFORMED


_KNOWN: WeakKeyDictionary[UpdatingProblem, Conditionals] = WeakKeyDictionary()


def conditionals(problem: UpdatingProblem) -> Conditionals:
    """Return the conditional densities of a problem with populations; they are computed once per problem."""
    if problem not in _KNOWN:
        scaled, layout = ScaledDensity(problem), problem.layout
        theta = scaled.to_theta(typical_point(problem)[0])[None]
        assert isinstance(problem.likelihood, ModalLikelihood)  # of several tests
        expansion = expand(layout, problem.likelihood, theta)
        scores, shift = (
            ScoresGivenMain(layout, expansion, problem.prior),
            MainGivenScores(problem, expansion, theta),
        )
        main, n = MainGivenValues(layout, problem.parameters), int(np.ceil(_SCORES / len(layout.tests)))
        normal, rng = scores.approximate(theta), np.random.default_rng(0)
        noise = rng.standard_normal((n, *normal.mean.shape[1:]))
        typical = scores.scores.put(np.repeat(theta, n, axis=0), normal.draw(normal.mean, 0.0, noise))
        values, held = main.values(typical), shift.hold(typical)
        curvatures = (
            _curvature(lambda at, k: main.log_prob_and_grad(at, values[k]), main.columns, scaled, typical),
            _curvature(lambda at, k: shift.log_prob_and_grad(at), shift.columns, scaled, held),
        )
        _KNOWN[problem] = Conditionals(scores, main, shift, curvatures, _informed(scores, theta))
    return _KNOWN[problem]


def _informed(scores: ScoresGivenMain, theta: FloatArray) -> float:
    """Return the smallest mean share of a value's precision that comes from its test; see `Conditionals`."""
    factor = scores.approximate(theta).factor
    variance = np.linalg.inv(factor @ np.swapaxes(factor, 2, 3))
    of_population = np.linalg.inv(score_precision(scores.layout, theta[:, : len(scores.layout.parameters)]))
    left = np.einsum("ntii->nti", variance)[0] / np.einsum("ntii->nti", of_population)[0]
    scored = scores.scores.scored
    return float(np.min(np.sum(np.where(scored, 1.0 - left, 0.0), axis=0) / np.sum(scored, axis=0)))


def _curvature(
    density: Callable[[FloatArray, IntArray], tuple[FloatArray, FloatArray]],
    columns: IntArray,
    scaled: ScaledDensity,
    theta: FloatArray,
) -> FloatArray:
    """Return minus the second derivatives of a density by differences of its gradient; their mean over theta (n, ndim)."""
    k, d = np.arange(len(theta)), len(columns)
    u = scaled.to_scaled(theta)
    room = np.minimum(u[0] - scaled.lower, scaled.upper - u[0])
    hessian = np.empty((d, d))
    for i, column in enumerate(columns):
        h = np.zeros(scaled.ndim)
        h[column] = _STEP * min(1.0, room[column])
        behind, ahead = (density(scaled.to_theta(u + side * h), k)[1].mean(axis=0) for side in (-1.0, 1.0))
        hessian[i] = (behind - ahead) * scaled.scale[columns] / (2.0 * h[column])
    return 0.5 * (hessian + hessian.T)
