"""The same posterior in JAX (float64), for NumPyro."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
from jax.scipy.linalg import solve_triangular

from fmu.analysis.estimate import gradient_cost
from fmu.fem.pairing.rules import RankPairing
from fmu.types import FloatArray
from tests.benchmarks.peers.posteriors import Target

jax.config.update("jax_enable_x64", True)


class JaxBlock:
    """One decoupled block: the lowest eigenvalues as a function of theta, differentiable.

    Theta is divided by the width of its bounds, so that the units are in the matrices of the terms. A mass matrix
    that no parameter changes is factorised once, here.
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
    """Prior and likelihood of a target in coordinates x = (θ − lower)/width.

    Parameters
    ----------
    target : Target

    Attributes
    ----------
    prior : numpyro.distributions.Distribution
        Of x.
    """

    prior: dist.Distribution

    def __init__(self, target: Target) -> None:
        self.target = target
        self._compiled = jax.jit(self.log_prob)

    def log_likelihood(self, x: Any) -> Any:
        """Return the log-likelihood at x (ndim,), a constant apart."""
        raise NotImplementedError

    def log_prob(self, x: Any) -> Any:
        """Return the log-density at x (ndim,), a constant apart."""
        return self.prior.log_prob(x) + self.log_likelihood(x)

    def at(self, theta: FloatArray) -> float:
        """Return the log-density at θ in SI units."""
        return float(self._compiled(jnp.asarray(self.target.to_unit(theta))))

    def gradient_cost(self, n: int) -> float:
        """Return how many times as long a gradient takes as a log-density, in batches of `n`."""
        x = jnp.asarray(self.target.to_unit(self.target.starts(0, n)))
        value, gradient = (jax.jit(jax.vmap(of)) for of in (self.log_prob, jax.value_and_grad(self.log_prob)))
        compiled = SimpleNamespace(
            log_prob=lambda x: jax.block_until_ready(value(x)),
            log_prob_and_grad=lambda x: jax.block_until_ready(gradient(x)),
        )
        return gradient_cost(compiled, x)


class JaxBeam(JaxPosterior):
    """A beam of the paper, or a frame: errors of frequencies, Gaussian priors cut off at the box.

    Parameters
    ----------
    target : Target
    """

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        problem = target.problem
        loc, sd = (np.array([getattr(p.prior, name) for p in problem.parameters]) for name in ("mean", "sd"))
        loc, sd = target.to_unit(loc), sd / target.width
        self.prior = dist.TruncatedNormal(jnp.asarray(loc), jnp.asarray(sd), low=0.0, high=1.0).to_event(1)
        self.offset = problem.lower / target.width
        self.measured = jnp.asarray(problem.data.frequencies_hz)
        self.noise = jnp.asarray(problem.likelihood.error.sd)
        self.eigenvalues = _paired(target)

    def log_likelihood(self, x: Any) -> Any:
        """Return the log-likelihood at x (ndim,), a constant apart."""
        f = jnp.sqrt(self.eigenvalues(self.offset + x)) / (2.0 * jnp.pi)
        return -0.5 * jnp.sum(((f - self.measured) / self.noise) ** 2)


class JaxBuilding(JaxPosterior):
    """The ten storeys: errors of frequencies (relative) and shapes, both sizes inferred, log-normal priors."""

    def __init__(self, target: Target) -> None:
        super().__init__(target)
        problem, model = target.problem, target.structure.structure
        self.scale = jnp.asarray(target.width)
        median, sigma = (
            np.array([getattr(p.prior, name) for p in problem.parameters]) for name in ("median", "sigma")
        )
        self.prior = dist.LogNormal(jnp.asarray(np.log(median / target.width)), jnp.asarray(sigma)).to_event(1)
        self.K = jnp.asarray(np.stack([term.matrix.toarray() for term in model.K_terms]))
        (mass,) = {float(m) for term in model.M_terms for m in term.matrix.diagonal()}  # every floor's is the same
        self.K /= mass
        self.measured = jnp.asarray(problem.data.frequencies_hz)
        shapes = np.asarray(problem.data.shapes)
        self.unit = jnp.asarray(shapes / np.linalg.norm(shapes, axis=0))
        self.rows = np.array([model.dofs.index(sensor) for sensor in problem.data.sensors])

    def log_likelihood(self, x: Any) -> Any:
        """Return the log-likelihood at x (12,), a constant apart."""
        *factors, sd_frequency, sd_shape = self.scale * x
        n = len(self.measured)
        lam, phi = jnp.linalg.eigh(jnp.tensordot(jnp.stack(factors), self.K, 1), symmetrize_input=False)
        error = jnp.sqrt(lam[:n]) / (2.0 * jnp.pi) / self.measured - 1.0
        seen = phi[self.rows, :n]
        sine2 = 1.0 - jnp.sum(self.unit * seen, axis=0) ** 2 / jnp.sum(seen**2, axis=0)
        of_frequencies = -0.5 * jnp.sum(error**2) / sd_frequency**2 - n * jnp.log(sd_frequency)
        free = n * (len(self.rows) - 1)  # a direction has one dimension less than its components
        return of_frequencies - 0.5 * jnp.sum(sine2) / sd_shape**2 - free * jnp.log(sd_shape)


def in_jax(target: Target) -> JaxPosterior:
    """Return the posterior of a target on the model that fmu samples on."""
    return JaxBeam(target) if np.all(target.boxed) else JaxBuilding(target)


def _paired(target: Target) -> Callable[[Any], Any]:
    """Return the eigenvalues of the measured modes as a function of theta over the bounds' width."""
    structure, pairing = target.structure, target.structure.pairing
    width = target.width
    is_reduced = bool(structure.sizes)
    blocks = structure.cheap.blocks if is_reduced else structure.truth.blocks
    bases = [block.basis if is_reduced and hasattr(block, "basis") else None for block in blocks]
    if isinstance(pairing, RankPairing):
        (b,) = set(pairing.block)
        ranks = np.array(pairing.rank)
        block = JaxBlock(structure.truth.blocks[b], bases[b], width, int(ranks.max()) + 1)
        return lambda x: block(x)[ranks]
    picked = np.array(structure.rule.numbers) - 1
    parts = [
        JaxBlock(
            full,
            basis,
            width,
            min(block.n_trained, int(picked.max()) + 1) if is_reduced else int(picked.max()) + 1,
        )
        for full, basis, block in zip(structure.truth.blocks, bases, blocks, strict=True)
    ]
    return lambda x: jnp.sort(jnp.concatenate([part(x) for part in parts]))[picked]


def _terms(terms: Any, basis: FloatArray | None, width: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the matrices of `terms`, projected and in units of the bounds' width, and their powers."""
    powers = np.array([term.powers for term in terms])
    matrices = [term.matrix.toarray() for term in terms]
    if basis is not None:
        matrices = [basis.T @ matrix @ basis for matrix in matrices]
    return np.prod(width**powers, axis=1)[:, None, None] * np.stack(matrices), powers
