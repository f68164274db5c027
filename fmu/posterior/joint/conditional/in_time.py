"""Metropolis steps for populations and correlation times, given parameter values that are correlated in time.

A population has the centre μ, the standard deviation s and the correlation time T. Given the values x_t in m
tests (their logarithms in log-normal populations), the likelihood has no further information on μ, s and T. With
the precision matrix Q of the scores, and if the values are not bounded,

    p(x | μ, s, T) = |Q|^½ s^(−m) exp(−½ (x − μ)ᵀ Q (x − μ) / s²) / (2π)^(m/2).

Let μ̂ be the generalised least-squares estimate, and let S = (x − μ̂)ᵀ Q (x − μ̂). With the prior density 1/s for
μ and s,

    S/s² ~ χ²(m − 1),    μ | s ~ N(μ̂, s²/1ᵀQ1)

(Gelman et al. 2013, *Bayesian Data Analysis*, section 14.7). For a candidate, T comes from a random walk in log T,
and μ and s are then drawn given T. The Metropolis–Hastings ratio accounts for the bounds and for the priors of μ,
s and T. So T, μ and s move together along the ridge of the posterior on which a longer T makes up for a larger s.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.autocorrelation import N_STEPS, InTime
from fmu.posterior.joint.varies.drawn import Drawn
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray

_FEWEST = 3
"""Fewest tests for which s can be drawn."""


class _Fit(NamedTuple):
    """Generalised least-squares fit that defines the distribution of μ and s given the values and T.

    Attributes
    ----------
    mean, weight, squares : ndarray, shape (n,)
        μ̂, 1ᵀQ1 and S.
    """

    mean: FloatArray
    weight: FloatArray
    squares: FloatArray

    @classmethod
    def of(cls, x: FloatArray, theta: FloatArray, in_time: InTime) -> _Fit:
        """Fit the values x (n, m) with the correlation time at theta (n, ndim)."""
        ones, e = in_time.innovations(theta, np.ones_like(x)), in_time.innovations(theta, x)
        weight = np.einsum("nt,nt->n", ones, ones)
        mean = np.einsum("nt,nt->n", ones, e) / weight
        left = e - ones * mean[:, None]
        return cls(mean, weight, np.einsum("nt,nt->n", left, left))

    def log_density(self, mean: FloatArray, s: FloatArray, m: int) -> FloatArray:
        """Return the log-density of μ and s, shape (n,), up to a constant."""
        of_mean = -0.5 * self.weight * ((mean - self.mean) / s) ** 2 + 0.5 * np.log(self.weight) - np.log(s)
        return of_mean - 0.5 * self.squares / s**2 + 0.5 * (m - 1) * np.log(self.squares) - m * np.log(s)


def move_in_time(
    rng: np.random.Generator, theta: FloatArray, layout: Layout, parameters: Sequence[Parameter]
) -> FloatArray:
    """Return theta (n, ndim) after `N_STEPS` steps in μ, s and T for each population that is correlated in time.

    Populations with a standard deviation in each group, or with fewer than three tests, are skipped.

    Parameters
    ----------
    rng : Generator
    theta : ndarray, shape (n, ndim)
        Points with standard normal scores. The steps also change the scores, so that the parameter values in the
        tests stay the same.
    layout : Layout
        A layout with standard normal scores.
    parameters : sequence of Parameter
        The parameters in theta.
    """
    for one in layout.drawn:
        if one.in_time is not None and one.has_one_width and len(one.in_time.order) >= _FEWEST:
            for _ in range(N_STEPS):
                theta = _move(rng, theta, one, one.in_time, parameters)
    return theta


def _move(
    rng: np.random.Generator, theta: FloatArray, one: Drawn, in_time: InTime, parameters: Sequence[Parameter]
) -> FloatArray:
    columns, width = one.columns[in_time.order], int(one.widths[0])
    m, of_logarithm = len(columns), one.family.of_logarithm
    value = one.family.values(theta[:, columns], theta[:, [one.centre]], theta[:, [width]])[0]
    x = np.log(value) if of_logarithm else value

    def log_target(theta: FloatArray) -> FloatArray:
        """Return the joint log-density (n,) of the values, μ and s at theta. The prior of T is left out."""
        c, s = theta[:, one.centre], theta[:, width]
        found = np.einsum("nt->n", one.family.log_pdf(value, c[:, None], s[:, None])[0])
        found = found + np.einsum("nt->n", in_time.log_density(theta, theta[:, columns])[0])
        found = found + parameters[one.centre].prior.log_pdf(c) + parameters[width].prior.log_pdf(s)
        return found + np.log(c) if of_logarithm else found

    candidate, ratio = in_time.propose_time(rng, theta, parameters)
    candidate = candidate.copy()
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        now, new = _Fit.of(x, theta, in_time), _Fit.of(x, candidate, in_time)
        s = np.sqrt(new.squares / rng.chisquare(m - 1, len(x)))
        mean = new.mean + s * rng.standard_normal(len(x)) / np.sqrt(new.weight)
        c = np.exp(mean) if of_logarithm else mean
        ends = [(parameters[k].lower, parameters[k].upper) for k in (one.centre, width)]
        inside = (c > ends[0][0]) & (c < ends[0][1]) & (s > ends[1][0]) & (s < ends[1][1])
        candidate[:, one.centre] = np.where(inside, c, theta[:, one.centre])
        candidate[:, width] = np.where(inside, s, theta[:, width])
        candidate[:, columns] = one.family.scores(value, candidate[:, [one.centre]], candidate[:, [width]])
        before = np.log(theta[:, one.centre]) if of_logarithm else theta[:, one.centre]
        ratio = ratio + log_target(candidate) - log_target(theta)
        ratio = ratio + now.log_density(before, theta[:, width], m) - new.log_density(mean, s, m)
        accepted = inside & np.isfinite(candidate).all(axis=1) & (np.log(rng.random(len(x))) < ratio)
    return np.where(accepted[:, None], candidate, theta)
