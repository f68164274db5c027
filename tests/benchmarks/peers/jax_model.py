"""The same posterior in JAX, float64, for the samplers that live there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from fmu.fem.pairing.rules import RankPairing
from fmu.types import FloatArray
from tests.benchmarks.peers.target import Target

jax.config.update("jax_enable_x64", True)


class JaxBlock:
    """One decoupled block: the lowest eigenvalues as a function of theta, differentiable.

    Theta comes divided by the width of its bounds, so that the matrices of the terms carry the units. A mass
    matrix that no parameter changes is factorised here once.
    """

    def __init__(self, full: Any, basis: FloatArray | None, width: FloatArray, count: int) -> None:
        K, self.K_powers = _terms(full.K_terms, basis, width)
        M, self.M_powers = _terms(full.M_terms, basis, width)
        self.constant_mass = not np.any(self.M_powers)
        self.count = count
        if self.constant_mass:
            inverse = np.linalg.inv(np.linalg.cholesky(M.sum(axis=0)))
            K = inverse @ K @ inverse.T
        self.K, self.M = jnp.asarray(K), jnp.asarray(M)

    def __call__(self, x: Any) -> Any:
        """Return the lowest eigenvalues, shape (count,)."""
        A = jnp.tensordot(jnp.prod(x**self.K_powers, axis=1), self.K, 1)
        if not self.constant_mass:
            L = jnp.linalg.cholesky(jnp.tensordot(jnp.prod(x**self.M_powers, axis=1), self.M, 1))
            A = solve_triangular(L, solve_triangular(L, A, lower=True).T, lower=True)
        return jnp.linalg.eigh(A, symmetrize_input=False)[0][: self.count]


class JaxPosterior:
    """Prior and likelihood of a target in u = (θ − lower)/(upper − lower).

    Parameters
    ----------
    target : Target
    reduced : bool
        Whether the eigenproblems are fmu's reduced ones, or those of the full blocks.
    """

    def __init__(self, target: Target, reduced: bool = True) -> None:
        problem = target.problem
        self.target, self.ndim = target, problem.ndim
        self.offset = problem.lower / problem.scale
        self.loc = jnp.asarray(
            (np.array([p.prior.mean for p in problem.parameters]) - problem.lower) / problem.scale
        )
        self.sd = jnp.asarray(np.array([p.prior.sd for p in problem.parameters]) / problem.scale)
        self.measured = jnp.asarray(problem.data.frequencies_hz)
        self.noise = jnp.asarray(problem.likelihood.error.sd)
        self.eigenvalues = _paired(target, reduced)
        self._compiled = jax.jit(self.log_prob)

    def frequencies(self, u: Any) -> Any:
        """Return the paired frequencies in Hz."""
        return jnp.sqrt(self.eigenvalues(self.offset + u)) / (2.0 * jnp.pi)

    def log_prob(self, u: Any) -> Any:
        """Return the log-density at u, a constant apart; bounds are the caller's."""
        error = (self.frequencies(u) - self.measured) / self.noise
        return -0.5 * jnp.sum(error**2) - 0.5 * jnp.sum(((u - self.loc) / self.sd) ** 2)

    def at(self, theta: FloatArray) -> float:
        """Return the log-density at θ in SI units."""
        return float(self._compiled(jnp.asarray(self.target.to_unit(theta))))


def _paired(target: Target, reduced: bool) -> Callable[[Any], Any]:
    """Return the eigenvalues of the measured modes as a function of theta over the bounds' width."""
    structure, pairing = target.structure, target.structure.pairing
    width = target.problem.scale
    blocks = structure.reduced.blocks if reduced else structure.full.blocks
    bases = [block.basis if reduced and hasattr(block, "basis") else None for block in blocks]
    if isinstance(pairing, RankPairing):
        (b,) = set(pairing.block)
        ranks = np.array(pairing.rank)
        block = JaxBlock(structure.full.blocks[b], bases[b], width, int(ranks.max()) + 1)
        return lambda x: block(x)[ranks]
    picked = np.array(structure.rule.numbers) - 1
    parts = [
        JaxBlock(full, basis, width, min(block.n_trained, int(picked.max()) + 1))
        for full, basis, block in zip(structure.full.blocks, bases, blocks, strict=True)
    ]
    return lambda x: jnp.sort(jnp.concatenate([part(x) for part in parts]))[picked]


def _terms(terms: Any, basis: FloatArray | None, width: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the matrices of `terms`, projected and in units of the bounds' width, and their powers."""
    powers = np.array([term.powers for term in terms])
    matrices = [term.matrix.toarray() for term in terms]
    if basis is not None:
        matrices = [basis.T @ matrix @ basis for matrix in matrices]
    return np.prod(width**powers, axis=1)[:, None, None] * np.stack(matrices), powers
