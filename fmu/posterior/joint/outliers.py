"""Model outlying tests, whose scores have a wider distribution than the scores of other tests.

With probability ε, a test is an outlier of one of m equally probable kinds c. In an outlier, the standard
deviation of the score in a single population, or of all scores, is s times as large (a contaminated normal
distribution; Tukey 1960, in *Contributions to Probability and Statistics*, Stanford University Press, 448–485).
Let the diagonal matrix D_c contain the factors on the standard deviations (1 or s), and let R be the populations'
correlation matrix. The density of a test's scores is

    p(z) = (1 − ε) N(z; 0, R) + ε/m Σ_c N(z; 0, D_c R D_c).

The sum over the possible outliers is exact. The probability that a test is an outlier of kind c, given the data,
is the posterior mean of term c's share in the sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Gt
from scipy.special import logsumexp

from fmu.arguments import ArgumentError, check_arguments
from fmu.posterior.joint.correlation import Correlation
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import settings_of
from fmu.posterior.priors.scipy_distributions import ScaledBeta
from fmu.types import BoolArray, FloatArray, IntArray, Plain

NAME = "share of outliers"
"""Name of the parameter ε."""


@check_arguments
@dataclass(frozen=True)
class Outliers:
    """The assumption that some tests may be outliers, with values from a wider distribution.

    The wider distribution applies to the values in one population, or in all populations.

    Attributes
    ----------
    share : float or ScaledBeta
        Probability ε that a test is an outlier, or its prior on [0, 1] if it is to be inferred. Default: 0.05.
    scale : float
        Standard deviation of an outlier's scores, relative to the scores of other tests. Default: 5.

    Raises
    ------
    ValueError
        If the share is not between 0 and 1, its prior is not a distribution on [0, 1], or the scale does not
        exceed 1.
    """

    share: float | ScaledBeta = 0.05
    scale: Annotated[float, Gt(1.0)] = 5.0

    def __post_init__(self) -> None:
        prior = self.prior
        if prior is None and not 0.0 < float(np.asarray(self.share)) < 1.0:
            raise ArgumentError("share", "must be between 0 and 1", self.share)
        if prior is not None and (prior.low, prior.high) != (0.0, 1.0):
            ends = f"[{prior.low}, {prior.high}]"
            raise ArgumentError("share", "must be a number, or a beta prior on [0, 1]", ends)

    @property
    def prior(self) -> ScaledBeta | None:
        """Prior of the outlier share; None if the share is known."""
        return self.share if isinstance(self.share, ScaledBeta) else None

    @property
    def parameter(self) -> Parameter | None:
        """The outlier share as a parameter of theta; None if it is known."""
        prior = self.prior
        return None if prior is None else Parameter(NAME, prior.a / (prior.a + prior.b), 0.0, 1.0, prior)

    def as_dict(self) -> dict[str, Plain]:
        """Return the settings as a dict of plain Python types."""
        return {"share": settings_of(self.share), "scale": self.scale}


class _Terms(NamedTuple):
    """Terms of each test's score density, one for regular tests and one for each kind of outlier.

    Attributes
    ----------
    log : ndarray, shape (n, n_kinds, n_tests)
        Logarithms of the terms, relative to the density of independent standard normal scores.
    by_score : ndarray, shape (n, n_kinds, n_tests, p)
        Derivatives of `log` with respect to the scores.
    """

    log: FloatArray
    by_score: FloatArray


@dataclass(frozen=True)
class ContaminatedScores:
    """Score density for tests that may be outliers.

    Attributes
    ----------
    of : Outliers
    share : int or None
        Index of the outlier share ε in theta; None if it is known.
    scored : ndarray of bool, shape (n_tests, p)
        Whether a test has a score in a population. A missing score cannot be an outlier.
    correlation : Correlation or None
        Correlation between the populations; None if they are independent.
    """

    of: Outliers
    share: int | None
    scored: BoolArray
    correlation: Correlation | None

    @property
    def columns(self) -> tuple[int, ...]:
        """Indices in theta of the partial correlations and the outlier share."""
        return (*(self.correlation.columns if self.correlation else ()), *self.of_share)

    @property
    def of_share(self) -> tuple[int, ...]:
        """Index of the outlier share in theta; empty if it is known."""
        return () if self.share is None else (self.share,)

    @cached_property
    def scales(self) -> FloatArray:
        """Factors on the score standard deviations, (n_kinds, n_tests, p): the diagonals of D_c.

        The first kind is a regular test.
        """
        p = self.scored.shape[1]
        kinds = np.ones((1 + p + (p > 1), p))
        kinds[1 : 1 + p][np.eye(p, dtype=bool)] = self.of.scale
        kinds[1 + p :] = self.of.scale
        return np.where(self.scored, kinds[:, None], 1.0)

    @cached_property
    def is_outlier(self) -> BoolArray:
        """Mask of the kinds that make a test an outlier, shape (n_kinds, n_tests)."""
        return np.asarray((self.scales > 1.0).any(axis=2))

    def log_density(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return each test's score log-density, relative to independent normal scores, and its derivatives.

        Parameters
        ----------
        theta : ndarray, shape (n, n_parameters)
        z : ndarray, shape (n, n_tests, p)
            Scores.

        Returns
        -------
        value : ndarray, shape (n, n_tests)
        by_score : ndarray, shape (n, n_tests, p)
        by_columns : ndarray, shape (n, n_columns)
            Derivatives of the sum over the tests with respect to the parameters in `columns`.
        """
        terms = self._terms(theta, z)
        value = logsumexp(terms.log, axis=1)
        share_of = np.exp(terms.log - value[:, None])
        by_score = np.einsum("nct,nctp->ntp", share_of, terms.by_score)
        by_columns = []
        if self.correlation is not None:
            y = z[:, None] / self.scales
            moments = np.einsum("nct,ncti,nctj->ntij", share_of, y, y)
            by_columns.append(self.correlation.gradient_of_moments(theta, moments))
        if self.share is not None:
            epsilon, outlying = theta[:, self.share], self._outlying(share_of)
            counted = self.is_outlier.any(axis=0)
            of_share = outlying / epsilon[:, None] - (1.0 - outlying) / (1.0 - epsilon[:, None])
            by_columns.append(np.einsum("nt->n", np.where(counted, of_share, 0.0))[:, None])
        return value, by_score, np.concatenate([np.zeros((len(theta), 0)), *by_columns], axis=1)

    def precision(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return the scores' precision matrices minus I, (n, n_tests, p, p), averaged over the kinds of tests.

        The kinds (regular, and each kind of outlier) are weighted by their probabilities given z.
        """
        share_of = self.probabilities(theta, z)
        every = [self.precision_of(theta, scales[None]) for scales in self.scales]
        eye = np.eye(z.shape[2])
        found = sum(share_of[:, c, :, None, None] * one for c, one in enumerate(every))
        return np.asarray(found - eye)

    def precision_of(self, theta: FloatArray, scales: FloatArray) -> FloatArray:
        """Return the score precision (D R D)⁻¹, (n, n_tests, p, p), with the diagonals D in `scales`.

        `scales` has the shape (n, n_tests, p).
        """
        inverse = np.eye(scales.shape[2]) + (
            0.0 if self.correlation is None else self.correlation.precision(theta)
        )
        return np.asarray(inverse / (scales[..., :, None] * scales[..., None, :]))

    def weights(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return the expected value of 1/D² given the scores z, shape (n, n_tests, p), where D is a score's scale.

        The expected value is 1 if the test is certainly regular, and smaller if the test may be an outlier.
        """
        return np.einsum("nct,ctp->ntp", self.probabilities(theta, z), self.scales**-2.0)

    def probabilities(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return each test's probability of each kind (regular or outlier), (n, n_kinds, n_tests), given z."""
        terms = self._terms(theta, z).log
        return np.exp(terms - logsumexp(terms, axis=1)[:, None])

    def outlying(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the outlier probability of each test, (n, n_tests), and of each score, (n, n_tests, p)."""
        share_of = self.probabilities(theta, z)
        return self._outlying(share_of), np.einsum("nct,ctp->ntp", share_of, (self.scales > 1.0).astype(float))

    def draw_from_prior(self, rng: np.random.Generator, theta: FloatArray) -> FloatArray:
        """Draw the score scales D, shape (n, n_tests, p), from their prior, given the outlier share at theta."""
        return self._draw(rng, self._log_weights(theta))

    def draw_scales(self, rng: np.random.Generator, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Draw the score scales D given the scores z; both have shape (n, n_tests, p)."""
        return self._draw(rng, self._terms(theta, z).log)

    def likeliest_scales(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return the most probable score scales D, shape (n, n_tests, p), given the scores z."""
        return self._select(np.argmax(self._terms(theta, z).log, axis=1))

    def draw_share(self, rng: np.random.Generator, theta: FloatArray, scales: FloatArray) -> FloatArray:
        """Return a copy of theta with the outlier share ε drawn given the score scales (n, n_tests, p).

        The conditional distribution of ε is the beta prior with the number of outliers added to its parameter a,
        and the number of regular tests added to its parameter b. Tests without scores do not count. If the share
        is known, theta itself is returned.
        """
        prior = self.of.prior
        if self.share is None or prior is None:
            return theta
        found, counted = theta.copy(), self.is_outlier.any(axis=0)
        n_outliers = np.sum((scales > 1.0).any(axis=2), axis=1)
        a, b = prior.a + n_outliers, prior.b + counted.sum() - n_outliers
        tiny = np.finfo(float).eps
        found[:, self.share] = np.clip(rng.beta(a, b), tiny, 1.0 - tiny)
        return found

    def _terms(self, theta: FloatArray, z: FloatArray) -> _Terms:
        logs, slopes = self._log_weights(theta), []
        for c, scales in enumerate(self.scales):
            y = z / scales
            logs[:, c] += 0.5 * np.einsum("ntp->nt", z**2 - y**2) - np.log(scales).sum(axis=1)
            by_y = -y
            if self.correlation is not None:
                value, by_score, _ = self.correlation.log_density(theta, y)
                logs[:, c], by_y = logs[:, c] + value, by_y + by_score
            slopes.append(z + by_y / scales)
        return _Terms(logs, np.stack(slopes, axis=1))

    def _log_weights(self, theta: FloatArray) -> FloatArray:
        """Return the log of each kind's prior probability (regular or outlier), (n, n_kinds, n_tests)."""
        epsilon = np.full(len(theta), self.of.share) if self.share is None else theta[:, self.share]
        m = self.is_outlier.sum(axis=0)
        with np.errstate(divide="ignore"):
            of_outliers = np.where(self.is_outlier, np.log(epsilon[:, None, None] / np.maximum(m, 1)), -np.inf)
            of_outliers[:, 0] = np.where(m > 0, np.log1p(-epsilon)[:, None], 0.0)
        return of_outliers

    def _outlying(self, share_of: FloatArray) -> FloatArray:
        return np.einsum("nct,ct->nt", share_of, self.is_outlier.astype(float))

    def _draw(self, rng: np.random.Generator, logs: FloatArray) -> FloatArray:
        return self._select(np.argmax(logs + rng.gumbel(size=logs.shape), axis=1))

    def _select(self, kinds: IntArray) -> FloatArray:
        return np.asarray(self.scales[kinds, np.arange(kinds.shape[1])])
