"""Importance sampling with several proposals combined into one mixture q, and weights P/q."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy.special import logsumexp

from fmu.types import FloatArray


class Proposal(Protocol):
    """A probability density that can be sampled and evaluated."""

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` draws, shape (n, ndim)."""
        ...

    def log_density(self, u: FloatArray) -> FloatArray:
        """Return the log-density, shape (n,), at points u (n, ndim)."""
        ...


def draw_mixture(
    proposals: Sequence[Proposal], counts: Sequence[int], rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Make `counts[k]` draws from each proposal k; return them, (n, ndim), and the mixture's log-density, (n,).

    The weight P/q of a draw uses the density q of the whole mixture, not just of the proposal that made the draw.
    This is the balance heuristic (Veach & Guibas 1995, SIGGRAPH; Owen & Zhou 2000, JASA 95, 135-143).
    """
    u = np.concatenate([proposal.draw(rng, count) for proposal, count in zip(proposals, counts, strict=True)])
    shares = np.asarray(counts) / max(counts)
    log_q = sum_densities([proposal.log_density(u) for proposal in proposals], shares)
    return u, log_q - np.log(np.sum(shares))


def sum_densities(log_q: Sequence[FloatArray] | FloatArray, counts: Sequence[float] | FloatArray) -> FloatArray:
    """Return log Σ_k n_k q_k, shape (n,), from the log-densities log q_k, (k, n), and the counts n_k, (k,)."""
    return np.asarray(logsumexp(np.asarray(log_q) + np.log(counts)[:, None], axis=0))


def cut_largest(log_w: FloatArray) -> FloatArray:
    """Truncate importance weights at √n times their mean; return the log-weights, shape (n,).

    Ionides (2008), J. Comput. Graph. Stat. 17, 295-311.
    """
    return np.minimum(log_w, logsumexp(log_w) - 0.5 * np.log(max(len(log_w), 1)))


def even_out(log_w: FloatArray, least: float, power: float) -> FloatArray:
    """Return log-weights (n,), multiplied by `power` repeatedly until their ESS is at least `least`.

    `power` must be below 1, and `least` below n. If the ESS is already large enough, the log-weights are returned
    unchanged.
    """
    while 2.0 * logsumexp(log_w) - logsumexp(2.0 * log_w) < np.log(least):
        log_w = power * log_w
    return log_w


def effective_size(log_w: FloatArray) -> float:
    """Return Kish's effective sample size of draws with log-weights (n,)."""
    return float(np.exp(2.0 * logsumexp(log_w) - logsumexp(2.0 * log_w)))


def resample(rng: np.random.Generator, u: FloatArray, log_w: FloatArray, n: int) -> FloatArray:
    """Draw `n` of the points u with replacement, with probabilities proportional to their weights; (n, ndim)."""
    return np.asarray(u[rng.choice(len(u), n, p=np.exp(log_w - logsumexp(log_w)))])
