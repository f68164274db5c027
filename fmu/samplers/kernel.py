"""The parts of a sampler: settings, a kernel that moves the chains, the state of the chains, and a tuner.

A sampler is a small frozen dataclass of settings. Binding the settings to a density gives a kernel, which advances
all chains of a group in lockstep, as one array, so each batched evaluation of the density serves all of them. A
tuner learns better settings during warm-up.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, Self

import numpy as np

from fmu.box import find_inside
from fmu.types import AnyArray, BoolArray, FloatArray, IntArray
from fmu.types import LogDensity as LogDensity

if TYPE_CHECKING:
    from fmu.samplers.mixture.quadratic import Quadratic
    from fmu.samplers.mixture.warp import Warp

Index = IntArray | BoolArray | slice
"""Index array, boolean mask or slice that selects chains."""
Tree = Mapping[str, Any]
"""Mapping of names to plain data for a file: arrays, numbers, strings, None, lists of numbers or further trees."""


@dataclass(frozen=True)
class State:
    """State of the chains before a kernel's next step. It contains only arrays, so it can be saved in a file.

    Attributes
    ----------
    position : ndarray, shape (chains, ndim), or (chains, walkers, ndim) for an ensemble
        In the coordinates of the kernel's density, which are scaled in a run.
    log_prob : ndarray, shape (chains,) or (chains, walkers)
        Log-density at `position`.
    gradient : ndarray or None
        Gradient of the log-density at `position`, for kernels that use gradients.
    extra : mapping of str to ndarray
        Data that only some kernels need.
    """

    position: FloatArray
    log_prob: FloatArray
    gradient: FloatArray | None = None
    extra: Mapping[str, AnyArray] = field(default_factory=dict)

    def require_gradient(self) -> FloatArray:
        """Return the gradient; raise ValueError if the state has none."""
        if self.gradient is None:
            raise ValueError("state: must carry the gradient at its position (got None)")
        return self.gradient


@dataclass(frozen=True)
class Info:
    """Diagnostics of one step. The first four attributes mean the same in every sampler.

    Attributes
    ----------
    accepted : ndarray of bool, shape (chains,) or (chains, walkers)
        Whether the chain or walker left its previous position.
    log_prob : ndarray, shape of `accepted`
        Log-density at the position where the step ended.
    n_solves : ndarray of int, shape of `accepted`
        Number of density evaluations within the bounds in this step, including the evaluations for gradients.
    n_gradients : ndarray of int, shape of `accepted`
        Number of gradients computed in this step. An exact gradient costs `solves_per_gradient` solves, an
        attribute of the density that defaults to 1. A central-difference gradient costs ``2 ndim`` solves.
    extra : mapping of str to ndarray
        Statistics that only some samplers have, such as ``acceptance_rate``, ``energy``, ``diverging`` and
        ``n_steps``; recorded for every draw.
    parts : Info, optional
        For a kernel that runs other kernels, the diagnostics of their steps. The tuner uses them; they are not
        recorded.
    """

    accepted: BoolArray
    log_prob: FloatArray
    n_solves: IntArray
    n_gradients: IntArray
    extra: Mapping[str, AnyArray] = field(default_factory=dict)
    parts: Info | None = None


class Kernel(Protocol):
    """A sampler bound to a density."""

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the starting points; return the state, and an `Info` with the cost of the evaluation."""
        ...

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Advance every chain by one draw; return the new state and the step's diagnostics."""
        ...


class Sampler(ABC):
    """Base class of the samplers' settings, which are dataclasses.

    Every sampler must set `name`. A sampler that is listed in `registry` must also set `title` and `colour`. The
    other attributes have defaults.

    Attributes
    ----------
    name : str
        Short name, such as ``"mh"``.
    title, colour : str
        Title and colour of the sampler in figures and reports.
    cost : tuple of three float
        Means over the built-in cases, per step of a chain or walker: evaluations in warm-up, evaluations after
        warm-up, and distinct draws.
    first : tuple of two int
        For a run that ends at convergence: the number of warm-up steps, and the number of draws after which
        convergence is first checked.
    is_local : bool
        Whether the sampler takes local steps (see `LocalSampler`), which the mixture and tempering can then use.
    takes_maxima : bool
        Whether `fmu.sample` passes the maxima of the density to `starting_from`.
    learns_together : bool
        Whether all chains must be in one group, because they are tuned together.
    walkers : int
        Number of walkers that an ensemble moves together; 1 for a sampler with ordinary chains.
    gradient : str
        How gradients are computed: "exact", by the density; "central-difference"; or "" if none are used.
    takes_gradients : bool
        Whether each evaluation includes the gradient.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    colour: ClassVar[str]
    cost: ClassVar[tuple[float, float, float]] = (1.0, 1.0, 1.0)
    first: ClassVar[tuple[int, int]] = (1000, 1000)
    is_local: ClassVar[bool] = False
    takes_maxima: ClassVar[bool] = True
    learns_together: ClassVar[bool] = False

    @property
    def walkers(self) -> int:
        """Number of walkers per chain; 1 by default."""
        return 1

    @property
    def gradient(self) -> str:
        """How gradients are computed; by default an empty string, because none are used."""
        return ""

    @property
    def takes_gradients(self) -> bool:
        """Whether each evaluation includes the gradient; by default True if the sampler uses gradients."""
        return bool(self.gradient)

    def starting_from(
        self, components: Sequence[Quadratic], weights: FloatArray, warp: Warp | None = None, *, near: bool = True
    ) -> Self:
        """Return a copy adapted to the density's maxima, or `self` by default.

        The `components` are quadratic approximations of the log-density, in scaled units, with the `weights` (n,).
        They are at its maxima or, for a hierarchical posterior, at its typical point. If `warp` is given, they
        approximate the log-density better once they are transformed to the coordinates of the warp. `near` is
        whether the chains start around these points.
        """
        return self

    @abstractmethod
    def bind(self, density: LogDensity) -> Kernel:
        """Return the kernel that samples `density`; raise ValueError if the settings do not fit the density."""

    def tuner(self, density: LogDensity, chains: int, steps: int) -> Tuner | None:
        """Return a tuner that learns better settings in `steps` warm-up steps, or None if nothing is learnt."""
        return None


class Tuner(Protocol):
    """Tuner that learns a sampler's settings from its warm-up steps.

    Attributes
    ----------
    kernel : Kernel
        Kernel that takes the next warm-up step.
    """

    kernel: Any

    def update(self, state: State, info: Info) -> IntArray | None:
        """Adapt the settings to one more warm-up step, and update `kernel`.

        Return the number of evaluations that the learning itself took, shape (chains,), or None if it took none.
        """
        ...

    def finish_learning(self) -> Sampler:
        """Return the learnt settings, with adaptation turned off."""
        ...

    def state(self) -> Tree:
        """Return the tuner's state as plain data."""
        ...

    def restore(self, state: Tree) -> None:
        """Restore a state that `Tuner.state` returned for a tuner with the same arguments."""
        ...


class Evaluation(NamedTuple):
    """Log-densities at a batch of points, and the cost of evaluating them.

    Attributes
    ----------
    log_prob : ndarray, shape (...)
        ``-inf`` outside the bounds, and where the log-density is not finite.
    n_solves : ndarray of int, shape (...)
        1 within the bounds, 0 outside.
    n_nonfinite : ndarray of int, shape (...)
        1 at points within the bounds where the log-density is not finite; 0 elsewhere.
    """

    log_prob: FloatArray
    n_solves: IntArray
    n_nonfinite: IntArray


class Target:
    """Evaluates a density in batches for the kernels, only at points within the bounds, and counts the solves.

    Parameters
    ----------
    density : LogDensity
    """

    def __init__(self, density: LogDensity) -> None:
        self.density = density
        self.ndim, self.lower, self.upper = density.ndim, density.lower, density.upper
        self.solves_per_gradient = int(getattr(density, "solves_per_gradient", 1))

    def log_prob(self, position: FloatArray, chain: Index) -> FloatArray:
        """Return the log-densities, shape (n,), at points `position` (n, ndim) within the bounds.

        `chain` selects the chains that the points belong to; a subclass may use a different density for each
        chain.
        """
        values: FloatArray = self.density.log_prob(position)
        return values

    def evaluate(self, position: FloatArray, chain: IntArray | None = None) -> Evaluation:
        """Evaluate the density in one batch at all points of `position` (..., ndim) that are within the bounds.

        `chain`, shape (...), is the index of each point's chain. A subclass with a different density for each
        chain needs it, unless there is exactly one point per chain, in the order of the chains.

        Points outside the bounds are never evaluated. A point with a NaN coordinate counts as outside. A value
        that is not finite (a failed eigensolve) becomes ``-inf``, so only that point is rejected.
        """
        inside, all_inside = find_inside(position, self.lower, self.upper)
        log_prob = np.full(inside.shape, -np.inf)
        if all_inside and inside.ndim == 1:  # avoids copies
            log_prob[:] = self.log_prob(position, slice(None) if chain is None else chain)
        elif inside.any():
            log_prob[inside] = self.log_prob(position[inside], inside if chain is None else chain[inside])
        failed = inside & ~np.isfinite(log_prob)
        log_prob[failed] = -np.inf
        return Evaluation(log_prob, inside.astype(np.int64), failed.astype(np.int64))

    def start(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the starting points within the bounds, at one solve each; return the state and its `Info`.

        The state has no gradients.
        """
        first = self.evaluate(positions)
        none = np.zeros(first.log_prob.shape, dtype=np.int64)
        return State(positions, first.log_prob), Info(none.astype(bool), first.log_prob, first.n_solves, none)

    def complete(self, state: State) -> tuple[State, Info | None]:
        """Add the gradient if a step needs it and the state lacks it; return the state and the evaluation's cost.

        The cost is None if nothing was evaluated. This class has no gradients and returns the state unchanged.
        """
        return state, None
