"""Hamiltonian (hybrid) Monte Carlo with reflection at the bounds (Boulkaibet et al., section 4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import check_arguments
from fmu.samplers.adaptation import DualAveraging, Learner, Schedule
from fmu.samplers.kernel import Info, State, Tree
from fmu.samplers.local import LocalKernel, LocalSampler
from fmu.samplers.mixture.quadratic import Quadratic, inverse
from fmu.samplers.mixture.warp import Warp, WarpedDensity
from fmu.samplers.settings import fits, one_of, positive_number, positive_scale, whole_number
from fmu.samplers.trajectory import CentralDifference, ExactGradient, HamiltonianKernel, Metric, WithGradient
from fmu.types import FloatArray, LogDensity, Positive

GRADIENTS = ("exact", "central-difference")
START_STEP_SIZE, START_STEPS = 0.001, 10
"""Initial step size, in scaled units, and number of steps: short enough for posteriors 1000 times narrower than
the prior."""
LEARNABLE = 50
"""Largest number of parameters whose covariance warm-up can learn; this needs ten draws per parameter."""
# Steps of a trajectory: 2 to 8 are enough with a good metric; with a poor metric the cost must be bounded.
_MOST_STEPS = 32
SHORT_STEPS = 0.95
"""Acceptance rate that gives short steps, for densities on which longer steps diverge."""
_TRIALS = 20
_STEP_SIZE = 0.5  # with which learning begins under a new metric
# Longer steps are unstable on any curved density, and on a flat density they only meet the bounds more often.
_LONGEST = 10.0


@check_arguments
@dataclass(frozen=True)
class HamiltonianMonteCarlo(LocalSampler):
    """Hamiltonian Monte Carlo (HMC) in scaled or logarithmic coordinates, with reflection at the bounds.

    A point E with momentum p has the energy H = V(E) + pᵀM⁻¹p/2, where V = −log P and P is the density. `n_steps`
    leapfrog steps lead to a point with energy H*, which is accepted with probability min(1, exp(H − H*)).

    Where the density is skewed, as it is for a stiffness that may be small, steps in scaled coordinates must be
    short. Warm-up chooses the coordinates that are made logarithmic; V includes their Jacobian.

    Parameters
    ----------
    step_size : float, optional
        Step size δt, in scaled units. If it is given, nothing is learnt. Otherwise warm-up learns it, and also
        `n_steps` and `inverse_mass` unless these are given.
    n_steps : int, optional
        Number of leapfrog steps per trajectory; required if `step_size` is given.
    jitter : float
        Each trajectory's step size is drawn uniformly within ± this fraction of the step size, to avoid resonance.
    inverse_mass : float, vector (ndim,) or matrix (ndim, ndim), optional
        Inverse mass matrix M⁻¹, its diagonal, or one value for the diagonal; the identity if neither given nor
        learnt. With more than 50 parameters, `fmu.sample` may compute it from the curvature at a maximum.
    first_mass : float, vector (ndim,) or matrix (ndim, ndim), optional
        M with which warm-up begins, until it has learnt its own; not used if `inverse_mass` or `step_size` is
        given. With at most 50 parameters, `fmu.sample` may compute it from the curvature (`starting_from`).
    target_accept : float
        Acceptance rate for which the step size is tuned; raised to at least 0.95 if trajectories still diverge at
        the end of warm-up.
    length : float
        Trajectory length for which the number of steps is tuned, in standard deviations of the target. With a
        length of 2, the effective sample size per gradient is at least three quarters of the largest possible, for
        curved posteriors and for posteriors whose mass lies at a bound (where 1.5 is best). For a Gaussian without
        bounds, 3 would be better.
    gradient : {"exact", "central-difference"}
        Gradients from the density, or by central differences (`fmu.samplers.trajectory.CentralDifference`).
    delta : float or vector (ndim,)
        Perturbation vector Δ of the central differences, in scaled units.
    h : float
        Scalar h of the central differences, which multiplies Δ.
    max_bounces : int
        A trajectory with more reflections than this is rejected, never cut short.
    bent : vector of bool (ndim,), optional
        Mask of the coordinates that are transformed to log(1 + 10 (u − lower)); see
        `fmu.samplers.mixture.warp.Warp`. The matrices are then in the transformed coordinates. By default warm-up
        chooses the mask, unless `step_size` or `inverse_mass` is given. `Tempering` transforms no coordinate and
        refuses a mask. In `MixtureSampler` the default is the mask of the fitted mixture, unless warm-up
        tunes the local steps to their own draws.

    Raises
    ------
    ValueError
        If a setting is out of range, or `step_size` is given without `n_steps`.

    References
    ----------
    Boulkaibet et al. (`fmu.paper.published`), section 4.3, eq. (12)-(15); Neal (2011), Handbook of MCMC,
    chapter 5; Afshar & Domke (2015), NeurIPS 28.
    """

    step_size: Positive | None = None
    n_steps: int | None = None
    jitter: float = 0.2
    inverse_mass: ArrayLike | None = None
    gradient: str = "exact"
    delta: ArrayLike = 1.0
    h: float = 1e-5
    max_bounces: int = 200
    target_accept: float = 0.8
    length: float = 2.0
    bent: Sequence[bool] | None = None
    first_mass: ArrayLike | None = None

    name: ClassVar[str] = "hmc"
    title: ClassVar[str] = "Hamiltonian Monte Carlo"
    colour: ClassVar[str] = "#0072B2"
    cost: ClassVar[tuple[float, float, float]] = (7.0, 4.0, 0.9)
    first: ClassVar[tuple[int, int]] = (500, 250)

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
        for name in ("inverse_mass", "first_mass"):
            if (mass := getattr(self, name)) is not None:
                object.__setattr__(self, name, positive_scale(name, mass, matrix=True))
        one_of("gradient", self.gradient, GRADIENTS)
        object.__setattr__(self, "delta", positive_scale("delta", self.delta, matrix=False))
        object.__setattr__(self, "h", positive_number("h", self.h))
        whole_number("max_bounces", self.max_bounces, 0)
        if self.bent is not None:
            object.__setattr__(self, "bent", tuple(bool(one) for one in self.bent))

    @property
    def is_bent(self) -> bool:
        """Whether `bent` is given."""
        return self.bent is not None

    def bind(self, density: LogDensity) -> HamiltonianKernel | WarpedKernel:
        """Return the kernel that samples `density`.

        Raise ValueError if a setting has the wrong size, or `bent` marks a coordinate without a lower bound.
        """
        own = self.in_coordinates(density)
        if self.bent is None:
            return own
        warp = Warp.of_density(density, self.bent)
        return WarpedKernel(own.target, self.in_coordinates(WarpedDensity(density, warp)), warp)

    def in_coordinates(self, density: LogDensity) -> HamiltonianKernel:
        """Return the kernel that follows trajectories in the coordinates of `density`, whatever `bent` is."""
        target: WithGradient = ExactGradient(density)
        if self.gradient == "central-difference":
            delta = np.broadcast_to(fits("delta", self.delta, density.ndim), density.ndim)
            target = CentralDifference(density, delta, self.h)
        metric = Metric.of(_with_first_mass(self, density.ndim).inverse_mass, density.ndim)
        step_size, n_steps = np.asarray(self.step_size or START_STEP_SIZE), self.n_steps or START_STEPS
        return HamiltonianKernel(target, metric, step_size, n_steps, self.jitter, self.max_bounces)

    def starting_from(
        self, components: Sequence[Quadratic], weights: FloatArray, warp: Warp | None = None, *, near: bool = True
    ) -> HamiltonianMonteCarlo:
        """Return a copy with M from the curvature, and the slope at a bound, at the maximum of largest weight.

        With more than 50 parameters, its inverse is `inverse_mass`, after small or negative eigenvalues have been
        raised. With at most 50, it is `first_mass`, because warm-up can learn a better one, but only if it is
        positive definite and the chains start `near` the maximum: from far away, trajectories in its metric are
        too short. Return `self` if `step_size`, a matrix or `warp` is given, or if `bent` marks a coordinate.
        """
        given = self.inverse_mass, self.first_mass, self.step_size, warp
        if any(one is not None for one in given) or any(self.bent or ()):
            return self
        at = components[int(np.argmax(weights))]
        # at an active bound the density is nearly exponential, with the standard deviation 1/slope
        mass = at.hessian + np.diag(at.gradient**2)
        if not np.all(np.isfinite(mass)):
            return self
        if len(mass) > LEARNABLE:
            return replace(self, inverse_mass=inverse(mass))
        return replace(self, first_mass=mass) if near and np.linalg.eigvalsh(mass)[0] > 0.0 else self

    def take_covariance(self, covariance: FloatArray) -> HamiltonianMonteCarlo:
        """Return a copy with the covariance as M⁻¹, or `self` if `inverse_mass` is given."""
        return self if self.inverse_mass is not None else replace(self, inverse_mass=covariance)

    def take_warp(self, warp: Warp) -> HamiltonianMonteCarlo | None:
        """Return a copy that transforms the same coordinates as a warp.

        Return None if the warp transforms no coordinate, or if `bent` or `inverse_mass` is given.
        """
        if not warp.bent.any() or self.bent is not None or self.inverse_mass is not None:
            return None
        return replace(self, bent=tuple(warp.bent.tolist()))

    def tuner(self, density: LogDensity, chains: int, steps: int) -> HamiltonianTuner | None:
        """Return a tuner that learns the settings in `steps` warm-up steps, or None if `step_size` is given."""
        is_bending = self.inverse_mass is None or self.bent is not None
        return HamiltonianTuner(self, density, chains, steps, is_bending) if self.step_size is None else None

    def rung_tuner(self, density: LogDensity, chains: int, steps: int) -> HamiltonianTuner | None:
        """Return a tuner for a rung of `Tempering` that transforms no coordinate; None if `step_size` is given."""
        return HamiltonianTuner(self, density, chains, steps, False) if self.step_size is None else None


@dataclass(frozen=True)
class WarpedKernel(LocalKernel):
    """HMC kernel that follows trajectories in the coordinates of a warp; its state is in scaled coordinates.

    Attributes
    ----------
    target : WithGradient
        The density in scaled coordinates.
    inner : HamiltonianKernel
        The kernel in the coordinates x of the warp; its target includes the Jacobian.
    warp : Warp
    """

    target: WithGradient
    inner: HamiltonianKernel
    warp: Warp

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Take a step of the inner kernel; return the new state, in scaled coordinates, and the diagnostics.

        The statistic ``energy`` is the energy in the coordinates of the warp.
        """
        before = state.require_gradient()
        begin = State(
            self.warp.to_x(state.position),
            state.log_prob + self.warp.log_stretch(state.position),
            before * self.warp.stretch(state.position) + self.warp.bent,
        )
        end, info = self.inner.step(rng, begin)
        moved = info.accepted[:, None]
        position = np.where(moved, self.warp.to_u(end.position), state.position)
        log_prob = np.where(info.accepted, end.log_prob - self.warp.log_stretch(position), state.log_prob)
        after = (end.require_gradient() - self.warp.bent) / self.warp.stretch(position)
        gradient = np.where(moved, after, before)
        return State(position, log_prob, gradient), replace(info, log_prob=log_prob)

    def join(self, kernels: Sequence[Self], chains: int) -> Self:
        """Return one kernel for all chains; raise ValueError if the kernels have different warps."""
        if any(not np.array_equal(kernel.warp.bent, self.warp.bent) for kernel in kernels):
            raise ValueError("bent: must be the same at all temperatures")
        return replace(self, inner=self.inner.join([kernel.inner for kernel in kernels], chains))


class HamiltonianTuner:
    """Tuner of the step size, the inverse mass matrix and the number of steps per trajectory.

    Dual averaging gives the step size. The covariance of each window's draws gives the inverse mass matrix, unless
    it is given. The number of steps, unless given, is `START_STEPS` until a metric is known, and then `length`
    divided by the step size, at most `_MOST_STEPS`. If `is_bending`, the draws of each window also decide which
    coordinates are transformed, unless `bent` is given.

    In the first part of warm-up each chain has its own step size: a chain far from the bulk of the distribution
    needs a small one, which must not slow down the other chains. Afterwards all chains share one step size, which
    is not affected by chains that lag behind.
    """

    def __init__(
        self, sampler: HamiltonianMonteCarlo, density: LogDensity, chains: int, steps: int, is_bending: bool
    ) -> None:
        self.sampler, self.density = sampler, density
        self.learner = Learner(Schedule.doubling(steps), density.ndim, self._choose_warp if is_bending else None)
        self.kernel: HamiltonianKernel | WarpedKernel = sampler.bind(density)
        step_size = _STEP_SIZE if self._has_metric else START_STEP_SIZE
        self._change(step_size=np.full(chains, step_size), n_steps=self._n_steps(step_size))
        self.averaging = DualAveraging(np.log(self._inner.step_size), sampler.target_accept)

    def update(self, state: State, info: Info) -> None:
        """Adapt the settings to one more warm-up step."""
        window_closed = self.learner.learn(state, info)
        acceptance = info.extra["acceptance_rate"]
        pooling = self.averaging.log_value.ndim == 0
        self.averaging.update(self.learner.average_arrived(acceptance) if pooling else acceptance)
        if not pooling and not self.learner.searching:
            # from here on all chains share one step size: the mean over the chains that have reached the bulk
            self.averaging = self._restart_averaging(self.learner.average_arrived(self.averaging.averaged))
        if window_closed and self.sampler.inverse_mass is None:
            # the new metric makes the target's standard deviations 1, so that a step size of order one fits
            self._take_coordinates()
            self.averaging = self._restart_averaging(np.log(_STEP_SIZE))
        elif self._has_settled and self.averaging.target < SHORT_STEPS and info.extra["diverging"].any():
            # the step size may be right on average and too long somewhere
            settled = self.averaging.averaged
            self.averaging = DualAveraging(settled, SHORT_STEPS, centre=settled)
        self._take_step_size()

    def finish_learning(self) -> HamiltonianMonteCarlo:
        """Return the settings with the learnt step size, inverse mass matrix and number of steps."""
        step_size = float(self._limit_step(np.mean(self.averaging.averaged)))
        return replace(
            self._settings,
            step_size=step_size,
            n_steps=self._n_steps(step_size),
            target_accept=self.averaging.target,
        )

    def state(self) -> Tree:
        """Return the tuner's state as plain data."""
        bent = None if self.learner.warp is None else self.learner.warp.bent
        return {"learner": self.learner.state(), "averaging": vars(self.averaging), "bent": bent}

    def restore(self, state: Tree) -> None:
        """Restore the state that another tuner's `state` returned."""
        self.learner.restore(state["learner"])
        self.averaging = DualAveraging(**state["averaging"])
        if state["bent"] is not None:
            self.learner.warp = Warp(self.density.lower, self.density.upper, state["bent"])
        if self.learner.covariance is not None and self.sampler.inverse_mass is None:
            self._take_coordinates()
        if self.learner.step:  # before the first step exp(log ε₀) could differ from ε₀ in the last bit
            self._take_step_size()

    @property
    def _settings(self) -> HamiltonianMonteCarlo:
        """The sampler with the coordinates and the inverse mass matrix that were learnt."""
        if self.sampler.inverse_mass is not None:
            return self.sampler
        if self.learner.covariance is None:
            return _with_first_mass(self.sampler, self.density.ndim)
        warp = self.learner.warp
        bent = self.sampler.bent if warp is None else tuple(warp.bent.tolist())
        return replace(self.sampler, inverse_mass=self.learner.covariance, first_mass=None, bent=bent)

    @property
    def _inner(self) -> HamiltonianKernel:
        """The kernel that follows trajectories, perhaps in the coordinates of a warp."""
        return self.kernel.inner if isinstance(self.kernel, WarpedKernel) else self.kernel

    def _change(self, **fields: Any) -> None:
        """Change fields of the kernel that follows trajectories."""
        inner = replace(self._inner, **fields)
        self.kernel = replace(self.kernel, inner=inner) if isinstance(self.kernel, WarpedKernel) else inner

    def _choose_warp(self, draws: FloatArray) -> Warp:
        """Return the warp that `bent` specifies or, if it is None, the warp that suits draws (n, ndim)."""
        lower, upper = self.density.lower, self.density.upper
        given = self.sampler.bent
        return Warp.fitting(draws, lower, upper) if given is None else Warp(lower, upper, np.array(given))

    def _take_coordinates(self) -> None:
        before = self._inner
        self.kernel = self._settings.bind(self.density)
        self._change(step_size=before.step_size, n_steps=before.n_steps)

    def _take_step_size(self) -> None:
        step_size = self._limit_step(self.averaging.log_value)
        self._change(step_size=step_size, n_steps=self._n_steps(step_size))

    def _restart_averaging(self, log_step_size: ArrayLike) -> DualAveraging:
        return DualAveraging(np.asarray(log_step_size, dtype=float), self.sampler.target_accept)

    @property
    def _has_settled(self) -> bool:
        """Whether the last window has closed, and dual averaging has tried at least `_TRIALS` step sizes.

        The first step sizes after a restart are too long.
        """
        windows = self.learner.schedule.windows
        return bool(windows) and self.learner.step > windows[-1][1] and self.averaging.count >= _TRIALS

    @property
    def _has_metric(self) -> bool:
        """Whether a metric is known; trajectory lengths are then in standard deviations of the target."""
        known = self.learner.covariance, self.sampler.inverse_mass, self.sampler.first_mass
        return any(one is not None for one in known)

    def _limit_step(self, log_step_size: ArrayLike) -> FloatArray:
        """Return exp(`log_step_size`), limited to `_LONGEST` trajectory lengths if a metric is known.

        Without the limit, a flat density would accept ever longer steps.
        """
        step_size: FloatArray = np.exp(log_step_size)
        return np.minimum(step_size, _LONGEST * self.sampler.length) if self._has_metric else step_size

    def _n_steps(self, step_size: FloatArray | float) -> int:
        """Return the number of steps that gives the intended trajectory length, at most `_MOST_STEPS`.

        If there are several step sizes, the largest one counts. The present number is kept if `n_steps` is given
        or no metric is known.
        """
        if self.sampler.n_steps is not None or not self._has_metric:
            return self._inner.n_steps
        return int(np.clip(np.round(self.sampler.length / float(np.max(step_size))), 1, _MOST_STEPS))


def _with_first_mass(sampler: HamiltonianMonteCarlo, ndim: int) -> HamiltonianMonteCarlo:
    """Return a copy with the inverse of `first_mass` as `inverse_mass`; raise ValueError for a wrong length."""
    if sampler.first_mass is None:
        return sampler
    mass = fits("first_mass", sampler.first_mass, ndim)
    if sampler.inverse_mass is not None or sampler.step_size is not None:
        return sampler
    return replace(sampler, inverse_mass=inverse(mass) if mass.ndim == 2 else 1.0 / mass, first_mass=None)
