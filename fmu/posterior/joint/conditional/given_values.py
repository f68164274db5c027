"""Propose populations given the parameter values in the tests, if the values' bounds have no influence.

A block of p populations has the centres μ, the standard deviations s and the correlation matrix R. Given the
values x_t in n tests (their logarithms in log-normal populations), the likelihood has no further information on μ,
s and R. Let Σ = D R D, where D has s on its diagonal. With the prior density |Σ|^(−(p+1)/2), μ and Σ have a normal
and an inverse Wishart distribution,

    Σ ~ IW(n − 1, Σ_t (x_t − x̄)(x_t − x̄)ᵀ),    μ | Σ ~ N(x̄, Σ/n),

where x̄ is the mean of x_t (Gelman et al. 2013, *Bayesian Data Analysis*, section 3.6). Draws from these
distributions are Metropolis–Hastings candidates. The acceptance ratio contains the true prior divided by the prior
above, both as densities of (μ, s, R):

    w = p(μ) p(s) p(R) |Σ|^((p+1)/2) Π s_k^(−p).

If the tests are precise, these candidates move the populations much further than steps at fixed scores. Combining
the two kinds of step is the interweaving strategy of Yu & Meng (2011, *J. Comput. Graph. Stat.* 20, 531–570).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmu.posterior.joint.correlation import partial_correlations
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.drawn import Drawn
from fmu.posterior.joint.varies.truncated_normal import are_bounds_distant
from fmu.posterior.parameters import Parameter
from fmu.types import BoolArray, FloatArray

_FEWEST = 2
"""Largest number of tests with which a population is too small for candidates."""
_TESTS = 4
"""Tests needed per correlated population: with fewer, the prior rejects nearly all candidates."""


class Candidates(NamedTuple):
    """Proposed populations for n chains, at the current parameter values in the tests.

    Attributes
    ----------
    main : ndarray, shape (n, n_blocks, m)
        Centres, standard deviations and partial correlations in each block of populations; the current values
        where `log_ratio` is −∞.
    z : ndarray, shape (n, n_tests, n_blocks, p)
        Scores; meaningless where a test has no score.
    log_ratio : ndarray, shape (n, n_blocks)
        Log acceptance ratio of each block; −∞ where the bounds of the values have an influence, or a proposed
        parameter is outside its own bounds.
    """

    main: FloatArray
    z: FloatArray
    log_ratio: FloatArray


class PopulationsGivenValues:
    """Proposal distribution for populations given the parameter values in the tests.

    Each independent population is a block and is accepted separately. Correlated populations form one block.

    Parameters
    ----------
    layout : Layout
        A layout with standard normal scores.
    parameters : sequence of Parameter
        The parameters in theta.

    Attributes
    ----------
    n_blocks, n_populations : int
        Numbers of blocks and of populations in them; zero if no population is suitable.
    """

    def __init__(self, layout: Layout, parameters: Sequence[Parameter]) -> None:
        blocks = _blocks(layout)
        self.n_blocks, self.n_populations = len(blocks), sum(map(len, blocks))
        if not blocks:
            return
        p, drawn = len(blocks[0]), [one for block in blocks for one in block]
        self._centres = np.array([one.centre for one in drawn]).reshape(-1, p)
        self._widths = np.array([one.widths[0] for one in drawn]).reshape(-1, p)
        self._partial = np.array(layout.correlation.columns if layout.correlation else (), dtype=np.int64)
        partial = np.broadcast_to(self._partial, (len(blocks), len(self._partial)))
        self._main = np.concatenate([self._centres, self._widths, partial], axis=1)
        self._priors = [[parameters[k].prior for k in block] for block in self._main.tolist()]
        ends = np.array([[parameters[k].lower, parameters[k].upper] for k in self._main.ravel()])
        self._box = ends.T.reshape(2, *self._main.shape)
        self._scores = np.stack([one.columns for one in drawn], axis=1).reshape(-1, len(blocks), p)
        self._scored = np.stack([one.scored for one in drawn], axis=1).reshape(self._scores.shape)
        self._count = self._scored.sum(axis=0)[:, 0].astype(float)
        self._of_logarithm = np.array([one.family.of_logarithm for one in drawn]).reshape(-1, p)
        bounds = np.array([[one.family.lower, one.family.upper] for one in drawn]).T.reshape(2, -1, p)
        with np.errstate(divide="ignore", invalid="ignore"):
            self._low, self._high = np.where(self._of_logarithm, np.log(np.maximum(bounds, 0.0)), bounds)
        before = np.array([i for j in range(p) for i in range(j)], dtype=float)
        self._of_partial = 0.5 * (p + 1) - 0.5 * (p - 2 - before)

    def propose(self, rng: np.random.Generator, theta: FloatArray) -> Candidates:
        """Draw candidate populations for the chains at theta, shape (n, ndim)."""
        c, s = theta[:, self._centres], theta[:, self._widths]
        z = np.where(self._scored, theta[:, self._scores], 0.0)
        n, p, count = len(theta), c.shape[2], self._count[:, None]
        mu = np.where(self._of_logarithm, np.log(np.where(self._of_logarithm, c, 1.0)), c)
        away = s[:, None] * z  # the values minus μ
        middle = away.sum(axis=1) / count
        y = np.where(self._scored, away - middle[:, None], 0.0)
        factor = inverse_wishart_factors(rng, np.einsum("ntbi,ntbj->nbij", y, y), self._count - 1.0)
        new_s = np.sqrt(np.einsum("nbij,nbij->nbi", factor, factor))
        moved = middle + np.einsum("nbij,nbj->nbi", factor, rng.standard_normal(c.shape)) / np.sqrt(count)
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            new_z = (away - moved[:, None]) / new_s[:, None]
            new_c = np.where(self._of_logarithm, np.exp(mu + moved), mu + moved)
            rho = np.broadcast_to(theta[:, None, self._partial], (n, self.n_blocks, len(self._partial)))
            new_rho = partial_correlations(factor / new_s[..., None]) if p > 1 else rho
            main = np.concatenate([new_c, new_s, new_rho], axis=2)
            inside = np.all((main >= self._box[0]) & (main <= self._box[1]), axis=2)
            inside &= self._are_distant(mu, s, z) & self._are_distant(mu + moved, new_s, new_z)
            main = np.where(inside[..., None], main, theta[:, self._main])
            ratio = self._log_weight(main) - self._log_weight(theta[:, self._main])
        return Candidates(main, new_z, np.where(inside, ratio, -np.inf))

    def move(self, theta: FloatArray, found: Candidates, accepted: BoolArray) -> FloatArray:
        """Return a copy of theta (n, ndim) with the candidates of the `accepted` blocks, shape (n, n_blocks)."""
        theta, scored = theta.copy(), self._scored
        theta[:, self._main] = np.where(accepted[..., None], found.main, theta[:, self._main])
        z = np.where(accepted[:, None, :, None], found.z, theta[:, self._scores])
        theta[:, self._scores[scored]] = z[:, scored]
        return theta

    def _are_distant(self, mu: FloatArray, s: FloatArray, z: FloatArray) -> BoolArray:
        """Return a mask (n, n_blocks) of the blocks in which no value is influenced by the bounds."""
        distant = are_bounds_distant(z, mu[:, None], s[:, None], self._low, self._high) | ~self._scored
        return np.asarray(distant.all(axis=(1, 3)))

    def _log_weight(self, main: FloatArray) -> FloatArray:
        """Return the log acceptance weight log w, defined in the module docstring, shape (n, n_blocks)."""
        p = self._centres.shape[1]
        c, s, rho = main[..., :p], main[..., p : 2 * p], main[..., 2 * p :]
        found = np.log(s).sum(axis=2) + np.where(self._of_logarithm, np.log(c), 0.0).sum(axis=2)
        # the prior is for partial correlations: with i from 1, det R = Π (1 − ρ_ij²), and the Jacobian
        # determinant of ρ by R is Π (1 − ρ_ij²)^(−(p−1−i)/2)
        found += (self._of_partial * np.log1p(-(rho**2))).sum(axis=2) if p > 1 else 0.0
        return found + np.stack(
            [
                np.sum([prior.log_pdf(main[:, b, k]) for k, prior in enumerate(priors)], axis=0)
                for b, priors in enumerate(self._priors)
            ],
            axis=1,
        )


def inverse_wishart_factors(rng: np.random.Generator, scatter: FloatArray, nu: FloatArray) -> FloatArray:
    """Draw matrices G Gᵀ from inverse Wishart distributions; return the factors G, shape (n, n_blocks, p, p).

    With the Bartlett decomposition B Bᵀ of a Wishart matrix with unit scale and scatter = L Lᵀ, G = L B^(−T).

    Parameters
    ----------
    rng : Generator
    scatter : ndarray, shape (n, n_blocks, p, p)
        Scale matrices.
    nu : ndarray, shape (n_blocks,)
        Degrees of freedom, at least p.
    """
    p = scatter.shape[-1]
    B = np.tril(rng.standard_normal(scatter.shape), -1)
    diagonal = np.arange(p)
    B[..., diagonal, diagonal] = np.sqrt(rng.chisquare(nu[:, None] - diagonal, scatter.shape[:-1]))
    if p == 1:
        return np.asarray(np.sqrt(scatter) / B)
    return np.asarray(np.linalg.cholesky(scatter) @ np.swapaxes(np.linalg.inv(B), -1, -2))


def _blocks(layout: Layout) -> list[list[Drawn]]:
    """Return the populations for which candidates can be drawn, in blocks of equal size.

    A suitable population has one standard deviation, values that are independent in time, and more than `_FEWEST`
    scores. Correlated populations also need scores in all tests, and at least `_TESTS` tests per population. If
    one correlated population is unsuitable, or if tests may be outliers, the result is empty.
    """
    drawn, correlated = layout.drawn, layout.correlation is not None
    if layout.outliers is not None:
        return []
    is_possible = [
        one.has_one_width
        and one.in_time is None
        and one.scored.sum() > _FEWEST
        and (one.scored.all() or not correlated)
        for one in drawn
    ]
    if correlated:
        return [drawn] if all(is_possible) and len(layout.tests) >= _TESTS * len(drawn) else []
    return [[one] for one, is_one in zip(drawn, is_possible, strict=True) if is_one]
