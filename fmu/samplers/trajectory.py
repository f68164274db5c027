"""Hamiltonian trajectories within bounds: kinetic energy, gradients, reflections, and leapfrog steps."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from fmu.differences import both_sides
from fmu.samplers.kernel import Index, Info, State, Target
from fmu.samplers.local import LocalKernel, accept_or_reject
from fmu.samplers.settings import cholesky_factor, fits
from fmu.types import BoolArray, FloatArray, IntArray, LogDensity

DIVERGENCE = 1000.0
"""Energy error beyond which a trajectory counts as divergent, as in Stan."""


@dataclass(frozen=True)
class Metric:
    """Kinetic energy W(p) = pᵀ M⁻¹ p / 2, with momenta p ~ N(0, M).

    The best M⁻¹ is the target's covariance, because correlations then do not slow the sampler down.

    Parameters
    ----------
    inverse : ndarray, shape (ndim, ndim) or (chains, ndim, ndim)
        M⁻¹, shared by all chains, or one matrix per chain.
    inverse_factor : ndarray, shape of `inverse`
        L⁻¹, where M⁻¹ = L Lᵀ.
    """

    inverse: FloatArray
    inverse_factor: FloatArray

    @classmethod
    def of(cls, inverse_mass: ArrayLike | None, ndim: int) -> Metric:
        """Return the metric for an inverse mass matrix: a matrix, its diagonal, a number, or None (identity).

        Raises
        ------
        ValueError
            If `inverse_mass` has the wrong length or is not symmetric positive definite.
        """
        array = np.ones(ndim) if inverse_mass is None else fits("inverse_mass", inverse_mass, ndim)
        inverse = array if array.ndim == 2 else np.diag(np.broadcast_to(array, ndim))
        return cls(inverse, np.linalg.inv(cholesky_factor("inverse_mass", inverse)))

    def of_chains(self, chain: IntArray) -> Metric:
        """Return the metric of the chains with these indices."""
        return self if self.inverse.ndim == 2 else Metric(self.inverse[chain], self.inverse_factor[chain])

    def sample_momentum(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Return `n` momenta drawn from N(0, M), one per chain, shape (n, ndim)."""
        z = rng.standard_normal((n, self.inverse.shape[-1]))
        # M = L⁻ᵀ L⁻¹, so that p = L⁻ᵀ z has covariance M; as rows, pᵀ = zᵀ L⁻¹
        return _rows(z, self.inverse_factor)

    def velocity(self, momentum: FloatArray) -> FloatArray:
        """Return the velocities v = M⁻¹ p, shape (n, ndim)."""
        return _rows(momentum, self.inverse)

    def column(self, chain: IntArray, i: IntArray) -> FloatArray:
        """Return column i of M⁻¹ for each chain, shape (n, ndim); `chain` and `i` have shape (n,)."""
        return self.inverse[i] if self.inverse.ndim == 2 else self.inverse[chain, i]

    def kinetic(self, momentum: FloatArray) -> FloatArray:
        """Return the kinetic energies pᵀ M⁻¹ p / 2, shape (n,)."""
        return 0.5 * np.sum(momentum * self.velocity(momentum), axis=-1)


class Slope(NamedTuple):
    """A log-density and its gradient at n points, and the cost of evaluating them.

    Attributes
    ----------
    log_prob : ndarray, shape (n,)
        NaN if the log-density was not requested and would have taken extra solves.
    gradient : ndarray, shape (n, ndim)
    finite : ndarray of bool, shape (n,)
        Whether all evaluated values are finite.
    n_solves : ndarray of int, shape (n,)
    """

    log_prob: FloatArray
    gradient: FloatArray
    finite: BoolArray
    n_solves: IntArray


class WithGradient(Target):
    """Evaluates a density and its gradient for the kernels that need it."""

    @abstractmethod
    def slope(self, position: FloatArray, *, with_log_prob: bool, chain: Index = slice(None)) -> Slope:
        """Return log-densities and gradients at `position` (n, ndim), for the chains with indices `chain`."""

    def start(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate density and gradient; raise ValueError if a log-density is finite but its gradient is not."""
        n, slope = len(positions), self.slope(positions, with_log_prob=True)
        require_finite_gradient(slope.log_prob, slope.finite)
        info = Info(np.zeros(n, dtype=bool), slope.log_prob, slope.n_solves, np.ones(n, dtype=np.int64))
        return State(positions, slope.log_prob, slope.gradient), info

    def complete(self, state: State) -> tuple[State, Info | None]:
        """Add the gradient if the state lacks it; return the state and the cost of the evaluation.

        The cost is None if the state had a gradient. Raise ValueError as `start` does.
        """
        if state.gradient is not None:
            return state, None
        begun, cost = self.start(state.position)
        return replace(begun, log_prob=state.log_prob), cost


def require_finite_gradient(log_prob: FloatArray, finite: BoolArray) -> None:
    """Raise ValueError, naming the first chain, if a log-density is finite but its gradient is not."""
    bad = np.isfinite(log_prob) & ~finite
    if bad.any():
        raise ValueError(f"init: the gradient must be finite at the start (chain {np.flatnonzero(bad)[0]})")


class ExactGradient(WithGradient):
    """Evaluates a density that computes its own gradient, at `solves_per_gradient` solves per point."""

    def slope(self, position: FloatArray, *, with_log_prob: bool, chain: Index = slice(None)) -> Slope:
        """Return log-densities and gradients at `position` (n, ndim), for the chains with indices `chain`."""
        log_prob, gradient = self.log_prob_and_grad(position, chain)
        finite = np.isfinite(log_prob) & np.all(np.isfinite(gradient), axis=1)
        return Slope(log_prob, gradient, finite, np.full(len(position), self.solves_per_gradient, dtype=np.int64))

    def log_prob_and_grad(self, position: FloatArray, chain: Index) -> tuple[FloatArray, FloatArray]:
        """Return log-densities (n,) and gradients (n, ndim); `chain` is explained in `Target.log_prob`."""
        found: tuple[FloatArray, FloatArray] = self.density.log_prob_and_grad(position)
        return found


class CentralDifference(WithGradient):
    """Evaluates a density P and its gradients by central differences.

    ∂ log P/∂E_i ≈ (log P(E + h Δ_i e_i) − log P(E − h Δ_i e_i)) / (2 h Δ_i) at the point E, with the unit vector
    e_i. Eq. (15) of Boulkaibet et al. (`fmu.paper.published`), with V = −log P, prints the whole vector Δ instead
    of Δ_i e_i. A perturbed point outside the bounds is moved to the bound, and the difference is divided by the
    remaining distance. A gradient always takes 2 ndim solves, and the log-density takes one more solve.

    Parameters
    ----------
    density : LogDensity
    delta : ndarray, shape (ndim,)
        Perturbation vector Δ, in scaled units.
    h : float
        Scalar that multiplies Δ.
    """

    def __init__(self, density: LogDensity, delta: FloatArray, h: float) -> None:
        super().__init__(density)
        self.delta, self.h = delta, h

    def slope(self, position: FloatArray, *, with_log_prob: bool, chain: Index = slice(None)) -> Slope:
        """Return gradients and log-densities (NaN unless requested) at `position` (n, ndim); ignore `chain`."""
        n, ndim = position.shape
        ends, distance = both_sides(position, self.h * self.delta, self.lower, self.upper)
        points = [ends.reshape(-1, ndim)]
        if with_log_prob:
            points.append(position)
        found = self.evaluate(np.concatenate(points))
        values = found.log_prob[: 2 * n * ndim].reshape(2, n, ndim)
        with np.errstate(invalid="ignore"):  # −inf on both sides, where the density has failed: not finite
            gradient = (values[0] - values[1]) / distance
        finite = np.all(np.isfinite(gradient), axis=1)
        log_prob = np.full(n, np.nan)
        if with_log_prob:
            log_prob = found.log_prob[2 * n * ndim :]
            finite &= np.isfinite(log_prob)
        return Slope(log_prob, gradient, finite, np.full(n, 2 * ndim + int(with_log_prob), dtype=np.int64))


class Drift(NamedTuple):
    """State of n points at the end of a drift.

    Attributes
    ----------
    position, momentum : ndarray, shape (n, ndim)
    n_bounces : ndarray of int, shape (n,)
    arrived : ndarray of bool, shape (n,)
        False if the point needs more than its limit of bounces, or is not finite. Such a point must not be used.
    """

    position: FloatArray
    momentum: FloatArray
    n_bounces: IntArray
    arrived: BoolArray


def drift(
    position: FloatArray,
    momentum: FloatArray,
    duration: FloatArray,
    metric: Metric,
    lower: FloatArray,
    upper: FloatArray,
    max_bounces: IntArray,
) -> Drift:
    """Move each point with velocity v = M⁻¹ p for its duration, reflecting it at the bounds.

    A bound with unit normal n changes the momentum to p − 2 (n·v)/(n·M⁻¹n) n. This reverses the normal velocity
    and conserves the kinetic energy; the map is reversible and preserves volume. With a dense metric, a reflection
    changes the other velocities too. Bounds are therefore treated in the order in which the path meets them.

    Parameters
    ----------
    position, momentum : ndarray, shape (n, ndim)
    duration : ndarray, shape (n,)
    metric : Metric
    lower, upper : ndarray, shape (ndim,)
        Bounds; infinite where there is none.
    max_bounces : ndarray of int, shape (n,)
        Largest number of reflections of each point. A point that needs more does not arrive.

    References
    ----------
    Neal (2011), Handbook of MCMC, section 5.5.1.5; Afshar & Domke (2015), NeurIPS 28, algorithm 1.
    """
    q, p, v = position.copy(), momentum.copy(), metric.velocity(momentum)
    remaining = duration.copy()
    n_bounces = np.zeros(len(q), dtype=np.int64)
    arrived = np.zeros(len(q), dtype=bool)
    moving = np.flatnonzero(np.all(np.isfinite(v), axis=1))
    while moving.size:  # each pass moves every point that is still moving to its next bound, or to its end
        time, wall = _next_wall(q[moving], v[moving], lower, upper)
        free = time >= remaining[moving]
        end = moving[free]
        # no bound is met before the end, so the clip only undoes rounding
        q[end] = _clip_to_box(q[end] + remaining[end, None] * v[end], lower, upper)
        arrived[end] = True
        if len(end) == len(moving):
            break
        under_cap = n_bounces[moving] < max_bounces[moving]
        bounce = ~free & under_cap
        moving, time, wall = moving[bounce], time[bounce], wall[bounce]
        q[moving] = _clip_to_box(q[moving] + time[:, None] * v[moving], lower, upper)
        normal_velocity = v[moving, wall]
        q[moving, wall] = np.where(normal_velocity > 0, upper[wall], lower[wall])  # exactly on the bound
        # n = e_i, so n·v = v_i and n·M⁻¹n = (M⁻¹)_ii: Δp = −2 v_i/(M⁻¹)_ii e_i and Δv = M⁻¹ Δp, a multiple of the
        # i-th column of M⁻¹
        column = metric.column(moving, wall)
        impulse = -2.0 * normal_velocity / column[np.arange(len(wall)), wall]
        p[moving, wall] += impulse
        v[moving] += impulse[:, None] * column
        v[moving, wall] = -normal_velocity  # exactly, or rounding could leave the point moving out of the bounds
        remaining[moving] -= time
        n_bounces[moving] += 1
    arrived &= np.all(np.isfinite(q), axis=1)
    return Drift(q, p, n_bounces, arrived)


class Trajectory(NamedTuple):
    """End points of leapfrog trajectories, one per chain.

    Position, momentum and gradient have shape (chains, ndim), the other arrays (chains,). Where `finished` is
    False, the trajectory was abandoned and its end point is meaningless. `n_steps` and `n_solves` count the steps
    and solves actually taken. `nonfinite` is True where density, gradient, position or momentum became non-finite;
    other abandoned trajectories exceeded the limit on bounces.
    """

    position: FloatArray
    momentum: FloatArray
    log_prob: FloatArray
    gradient: FloatArray
    finished: BoolArray
    nonfinite: BoolArray
    n_steps: IntArray
    n_solves: IntArray
    n_bounces: IntArray


@dataclass(frozen=True)
class HamiltonianKernel(LocalKernel):
    """HMC kernel bound to a density with gradients.

    `step_size` has shape () if all chains share one step size, otherwise (chains,); `metric` may also hold one
    matrix per chain. `n_steps`, `jitter` and `max_bounces` are as in `HamiltonianMonteCarlo`.
    """

    target: WithGradient
    metric: Metric
    step_size: FloatArray
    n_steps: int
    jitter: float
    max_bounces: int

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Draw momenta, follow one trajectory per chain, and accept or reject its end."""
        state.require_gradient()
        chains = len(state.position)
        momentum = self.metric.sample_momentum(rng, chains)
        step_size = self.step_size * (1 + self.jitter * rng.uniform(-1, 1, chains))
        end = self.integrate(state, momentum, step_size)

        energy = self.metric.kinetic(momentum) - state.log_prob
        new_energy = np.where(end.finished, self._energy(end), np.inf)
        error = new_energy - energy
        new, accepted = accept_or_reject(rng, state, State(end.position, end.log_prob, end.gradient), -error)
        extra = {
            "acceptance_rate": np.exp(-np.maximum(0.0, error)),
            "energy": np.where(accepted, new_energy, energy),
            "diverging": error > DIVERGENCE,
            "n_nonfinite": end.nonfinite.astype(np.int64),
            "n_steps": end.n_steps,
            "step_size": step_size,
            "n_bounces": end.n_bounces,
        }
        return new, Info(accepted, new.log_prob, end.n_solves, end.n_steps, extra)

    def join(self, kernels: Sequence[Self], chains: int) -> Self:
        """Return one kernel for all chains, with their metrics and step sizes, but the median number of steps."""
        inverse, factor = [k.metric.inverse for k in kernels], [k.metric.inverse_factor for k in kernels]
        return replace(
            self,
            metric=Metric(np.repeat(inverse, chains, axis=0), np.repeat(factor, chains, axis=0)),
            step_size=np.concatenate([np.broadcast_to(kernel.step_size, chains) for kernel in kernels]),
            n_steps=int(np.median([kernel.n_steps for kernel in kernels])),
        )

    def _energy(self, end: Trajectory) -> FloatArray:
        """Return the energy H at the end of each trajectory, shape (chains,); inf if it overflows or is NaN."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.nan_to_num(self.metric.kinetic(end.momentum) - end.log_prob, nan=np.inf, posinf=np.inf)

    def integrate(self, state: State, momentum: FloatArray, step_size: FloatArray) -> Trajectory:
        """Take `n_steps` leapfrog steps from `state`, all chains in lockstep, with reflection at the bounds.

        A step is eq. (12)-(14) of Boulkaibet et al. (`fmu.paper.published`), with V = −log P.

        A trajectory is abandoned if it exceeds the limit on bounces, or if its density, gradient, position or
        momentum is not finite. Its chain then waits for the other chains and is not evaluated again. `momentum`
        has shape (chains, ndim), and `step_size` (chains,).
        """
        chains = len(momentum)
        q, p = state.position.copy(), momentum.copy()
        log_prob, slope = state.log_prob.copy(), np.array(state.gradient)
        n_taken, n_solves, n_bounces = (np.zeros(chains, dtype=np.int64) for _ in range(3))
        nonfinite = np.zeros(chains, dtype=bool)
        going: IntArray = np.arange(chains)
        # a diverging trajectory overflows before the tests for finite numbers below catch it
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self.n_steps):
                half = 0.5 * step_size[going, None]
                p[going] += half * slope[going]  # eq. (12), with −∇V = ∇ log P
                moved = drift(
                    q[going],
                    p[going],
                    step_size[going],
                    self.metric.of_chains(going),
                    self.target.lower,
                    self.target.upper,
                    self.max_bounces - n_bounces[going],
                )  # eq. (13)
                n_bounces[going] += moved.n_bounces
                nonfinite[going] = ~np.all(np.isfinite(moved.position) & np.isfinite(moved.momentum), axis=1)
                arrived = moved.arrived & ~nonfinite[going]
                going, half = going[arrived], half[arrived]
                if not going.size:
                    break
                q[going], p[going] = moved.position[arrived], moved.momentum[arrived]
                last = k == self.n_steps - 1
                found = self.target.slope(q[going], with_log_prob=last, chain=going)
                n_taken[going] += 1
                n_solves[going] += found.n_solves
                log_prob[going], slope[going] = found.log_prob, found.gradient
                p[going] += half * slope[going]  # eq. (14)
                nonfinite[going[~found.finite]] = True
                going = going[found.finite]
        finished = np.zeros(chains, dtype=bool)
        finished[going] = True
        return Trajectory(q, p, log_prob, slope, finished, nonfinite, n_taken, n_solves, n_bounces)


def _next_wall(q: FloatArray, v: FloatArray, lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the time at which each point meets its next bound (infinite if none), and the coordinate."""
    # coordinates move independently between bounds: t_i = (bound ahead − q_i)/v_i, and the first is the smallest
    ahead = np.where(v > 0, upper, lower)
    still = v == 0
    time = np.where(still, np.inf, (ahead - q) / np.where(still, 1.0, v))
    wall = np.argmin(time, axis=1)
    return np.maximum(time[np.arange(len(q)), wall], 0.0), wall


def _rows(x: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return xᵀ A for each row x. A is one matrix (m, m) for all rows, or one matrix per row, (n, m, m)."""
    return x @ matrix if matrix.ndim == 2 else np.einsum("ni,nij->nj", x, matrix)


def _clip_to_box(q: FloatArray, lower: FloatArray, upper: FloatArray) -> FloatArray:
    """Clip `q` to the bounds; for a few points this is three times as fast as `np.clip`."""
    return np.minimum(np.maximum(q, lower), upper)
