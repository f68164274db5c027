"""Hamiltonian (hybrid) Monte Carlo with reflection at the bounds (section 4.3 of the paper)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fmu.samplers.adaptation.learner import Learner
from fmu.samplers.adaptation.schedule import DualAveraging, Schedule
from fmu.samplers.hmc.gradient import CentralDifference, ExactGradient, Gradient
from fmu.samplers.hmc.metric import Metric
from fmu.samplers.hmc.reflection import drift
from fmu.samplers.kernel import Info, State
from fmu.samplers.loop.settings import fits, one_of, positive_number, positive_scale, whole_number
from fmu.types import BoolArray, FloatArray, IntArray, LogDensity

GRADIENTS = ("exact", "central-difference")
DIVERGENCE = 1000.0
_MOST_STEPS = 32  # of a trajectory: a metric that fits needs 2 to 8; one that does not must not cost without end
"""Energy error beyond which a trajectory is called diverging, as in Stan."""
START_STEP_SIZE, START_STEPS = 0.001, 10
"""Where learning begins, in scaled units: short enough for posteriors 1000 times narrower than priors."""


@dataclass(frozen=True)
class HamiltonianMonteCarlo:
    """Hamiltonian Monte Carlo in the original (affinely scaled) coordinates, with trajectories that reflect.

    H(E, p) = V(E) + pᵀM⁻¹p/2 with V = −log P. A trajectory is `n_steps` leapfrog steps, eq. (12)-(14) of the
    paper; its end is accepted with probability min(1, exp(H − H*)).

    Parameters
    ----------
    step_size : float, optional
        δt, in scaled units. Without it, warm-up learns it, and beside it whichever of `n_steps` and `inverse_mass`
        are not given; with it, all settings are what they are.
    n_steps : int, optional
        Leapfrog steps a trajectory.
    jitter : float
        Each trajectory's step size is drawn uniformly within ± this fraction, so that no period is resonant.
    inverse_mass : None, vector (ndim,) or matrix (ndim, ndim)
        M⁻¹; if not given and not learnt, the identity.
    target_accept : float
        Acceptance rate that the step size is adapted to.
    length : float
        Length of a trajectory that adaptation aims at, in standard deviations of the target. With
        2 the effective sample size per gradient is within a quarter of the best on posteriors that lean on their
        bounds, where that is near 1.5, and on curved ones; a Gaussian without bounds would rather have 3.
    gradient : {"exact", "central-difference"}
    delta : float or vector (ndim,)
        The perturbation vector Δ of eq. (15), in scaled units.
    h : float
        The scalar of eq. (15).
    max_bounces : int
        A trajectory that meets more walls than this is rejected, never cut short.

    Raises
    ------
    ValueError
        If a setting is out of range.

    References
    ----------
    Section 4.3 of the paper; Neal (2011), Handbook of MCMC, chapter 5; Afshar & Domke (2015), NeurIPS 28.
    """

    step_size: float | None = None
    n_steps: int | None = None
    jitter: float = 0.2
    inverse_mass: Any = None
    gradient: str = "exact"
    delta: Any = 1.0
    h: float = 1e-5
    max_bounces: int = 200
    target_accept: float = 0.8
    length: float = 2.0

    name: ClassVar[str] = "hmc"

    def __post_init__(self) -> None:
        if self.step_size is not None:
            object.__setattr__(self, "step_size", positive_number("step_size", self.step_size))
            if self.n_steps is None:
                raise ValueError(f"n_steps: must be given with a fixed step_size (got step_size={self.step_size})")
        if self.n_steps is not None:
            whole_number("n_steps", self.n_steps, 1)
        if not 0 < self.target_accept < 1:
            raise ValueError(f"target_accept: must lie between 0 and 1 (got {self.target_accept!r})")
        object.__setattr__(self, "length", positive_number("length", self.length))
        if not 0 <= self.jitter < 1:
            raise ValueError(f"jitter: must be at least 0 and below 1 (got {self.jitter!r})")
        if self.inverse_mass is not None:
            mass = positive_scale("inverse_mass", self.inverse_mass, matrix=True)
            object.__setattr__(self, "inverse_mass", mass)
        one_of("gradient", self.gradient, GRADIENTS)
        object.__setattr__(self, "delta", positive_scale("delta", self.delta, matrix=False))
        object.__setattr__(self, "h", positive_number("h", self.h))
        whole_number("max_bounces", self.max_bounces, 0)

    @property
    def walkers(self) -> int:
        """A chain is a single point."""
        return 1

    def bind(self, density: LogDensity) -> HamiltonianKernel:
        """Return the kernel that samples `density`; ValueError if a vector or matrix does not fit it."""
        gradient: Gradient = ExactGradient(density)
        if self.gradient == "central-difference":
            delta = np.broadcast_to(fits("delta", self.delta, density.ndim), density.ndim)
            gradient = CentralDifference(density, delta, self.h)
        metric = Metric(self.inverse_mass, density.ndim)
        step_size = np.asarray(self.step_size or START_STEP_SIZE)
        return HamiltonianKernel(density, self, metric, gradient, step_size, self.n_steps or START_STEPS)

    def tuner(self, density: LogDensity, chains: int, steps: int) -> HamiltonianTuner | None:
        """Return what learns these settings in `steps` steps of warm-up, None if nothing is to be learnt."""
        return HamiltonianTuner(self, density, chains, steps) if self.step_size is None else None


class Trajectory(NamedTuple):
    """End of a leapfrog trajectory; `finished` is False where it was abandoned, and the end then meaningless.

    Shapes are (chains, ndim) for position, momentum and gradient and (chains,) for the others. `n_steps` and
    `n_solves` count what was really done. `nonfinite` tells an abandoned trajectory apart from one at the cap on
    bounces.
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
class HamiltonianKernel:
    """Hamiltonian Monte Carlo bound to a density, a metric and a way to get gradients.

    `step_size` is one for all chains, shape (), or one a chain, shape (chains,); `metric` too may be one a chain.
    """

    density: LogDensity
    settings: HamiltonianMonteCarlo
    metric: Metric
    gradient: Gradient
    step_size: FloatArray
    n_steps: int

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate log-density and gradient at the start; ValueError where the gradient is not finite."""
        slope = self.gradient(positions, with_log_prob=True)
        bad = np.isfinite(slope.log_prob) & ~slope.finite
        if bad.any():
            raise ValueError(f"init: the gradient must be finite at the start (chain {np.flatnonzero(bad)[0]})")
        chains = len(positions)
        one = np.ones(chains, dtype=np.int64)
        info = Info(np.zeros(chains, dtype=bool), slope.log_prob, slope.n_solves, one)
        return State(positions, slope.log_prob, slope.gradient), info

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Draw momenta, follow one trajectory a chain, accept or reject its end."""
        if state.gradient is None:
            raise ValueError("state: must carry the gradient at its position (got None)")
        chains = len(state.position)
        momentum = self.metric.sample_momentum(rng, chains)
        step_size = self.step_size * (1 + self.settings.jitter * rng.uniform(-1, 1, chains))
        log_u = -rng.standard_exponential(chains)
        end = self.integrate(state, momentum, step_size)

        energy = self.metric.kinetic(momentum) - state.log_prob
        new_energy = np.where(end.finished, self._energy(end), np.inf)
        error = new_energy - energy
        accepted = log_u <= -error
        moved = accepted[:, None]
        position = np.where(moved, end.position, state.position)
        log_prob = np.where(accepted, end.log_prob, state.log_prob)
        gradient = np.where(moved, end.gradient, state.gradient)
        extra = {
            "acceptance_rate": np.exp(-np.maximum(0.0, error)),
            "energy": np.where(accepted, new_energy, energy),
            "diverging": error > DIVERGENCE,
            "n_nonfinite": end.nonfinite.astype(np.int64),
            "n_steps": end.n_steps,
            "step_size": step_size,
            "n_bounces": end.n_bounces,
        }
        return State(position, log_prob, gradient), Info(accepted, log_prob, end.n_solves, end.n_steps, extra)

    def _energy(self, end: Trajectory) -> FloatArray:
        """Return H at the end of the trajectories; infinite where the momentum has overflown."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.nan_to_num(self.metric.kinetic(end.momentum) - end.log_prob, nan=np.inf, posinf=np.inf)

    def integrate(self, state: State, momentum: FloatArray, step_size: FloatArray) -> Trajectory:
        """Follow `n_steps` leapfrog steps from `state`, all chains in lockstep, reflecting at the bounds.

        A chain whose trajectory is abandoned, at the cap on bounces or where density or gradient are not finite,
        waits and is not evaluated again.

        Parameters
        ----------
        state : State
            With the gradient of log P.
        momentum : ndarray, shape (chains, ndim)
        step_size : ndarray, shape (chains,)
        """
        chains = len(momentum)
        q, p = state.position.copy(), momentum.copy()
        log_prob, slope = state.log_prob.copy(), np.array(state.gradient)
        n_taken, n_solves, n_bounces = (np.zeros(chains, dtype=np.int64) for _ in range(3))
        nonfinite = np.zeros(chains, dtype=bool)
        going: IntArray = np.arange(chains)
        # A diverging trajectory overflows before it is caught; the finiteness tests below are what catches it.
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(self.n_steps):
                half = 0.5 * step_size[going, None]
                p[going] += half * slope[going]  # eq. (12), with −∇V = ∇ log P
                moved = drift(
                    q[going],
                    p[going],
                    step_size[going],
                    self.metric.of_chains(going),
                    self.density.lower,
                    self.density.upper,
                    self.settings.max_bounces - n_bounces[going],
                )  # eq. (13)
                n_bounces[going] += moved.n_bounces
                nonfinite[going] = ~np.all(np.isfinite(moved.position) & np.isfinite(moved.momentum), axis=1)
                arrived = moved.arrived & ~nonfinite[going]
                going, half = going[arrived], half[arrived]
                if not going.size:
                    break
                q[going], p[going] = moved.position[arrived], moved.momentum[arrived]
                last = k == self.n_steps - 1
                found = self.gradient(q[going], with_log_prob=last, chain=going)
                n_taken[going] += 1
                n_solves[going] += found.n_solves
                log_prob[going], slope[going] = found.log_prob, found.gradient
                p[going] += half * slope[going]  # eq. (14)
                nonfinite[going[~found.finite]] = True
                going = going[found.finite]
        finished = np.zeros(chains, dtype=bool)
        finished[going] = True
        return Trajectory(q, p, log_prob, slope, finished, nonfinite, n_taken, n_solves, n_bounces)


class HamiltonianTuner:
    """Step size by dual averaging, inverse mass by the covariance of the windows, trajectory length from both.

    In the first part every chain has a step size of its own: a chain that is far out needs a small one, and must
    not impose it on the others. Then one step size serves all; chains that lag behind have no say in it.
    """

    def __init__(self, sampler: HamiltonianMonteCarlo, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler = sampler
        self.learner = Learner(Schedule.doubling(steps), density.ndim)
        self.kernel: HamiltonianKernel = sampler.bind(density)
        self.kernel = replace(self.kernel, step_size=np.full(chains, float(self.kernel.step_size)))
        self.averaging = DualAveraging(np.log(self.kernel.step_size), sampler.target_accept)

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        window_closed = self.learner.learn(state, info)
        acceptance = info.extra["acceptance_rate"]
        pooling = self.averaging.log_value.ndim == 0
        self.averaging.update(self.learner.pooled(acceptance) if pooling else acceptance)
        if not pooling and not self.learner.searching:
            # from here on one step size for all: the smallest that a chain in the bulk came to
            self.averaging = self._restarted(self.learner.pooled(self.averaging.averaged))
        if window_closed and self.sampler.inverse_mass is None:
            self.kernel = replace(self.kernel, metric=Metric(self.learner.covariance, state.position.shape[1]))
            self.averaging = self._restarted(np.log(0.5))
        step_size = np.exp(self.averaging.log_value)
        self.kernel = replace(self.kernel, step_size=step_size, n_steps=self._n_steps(step_size))

    def finished(self) -> HamiltonianMonteCarlo:
        """Return the settings learnt."""
        step_size = float(np.exp(np.mean(self.averaging.averaged)))
        inverse_mass = self.sampler.inverse_mass
        if inverse_mass is None and self.learner.covariance is not None:
            inverse_mass = self.learner.covariance
        return replace(
            self.sampler, step_size=step_size, n_steps=self._n_steps(step_size), inverse_mass=inverse_mass
        )

    def _restarted(self, log_step_size: Any) -> DualAveraging:
        return DualAveraging(np.asarray(log_step_size, dtype=float), self.sampler.target_accept)

    def _n_steps(self, step_size: Any) -> int:
        """Return the steps that make a trajectory as long as wanted, once the metric tells what that is."""
        if self.sampler.n_steps is not None or (
            self.learner.covariance is None and self.sampler.inverse_mass is None
        ):
            return self.kernel.n_steps
        return int(np.clip(np.round(self.sampler.length / float(np.max(step_size))), 1, _MOST_STEPS))
