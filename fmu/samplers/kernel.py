"""What a sampler is made of: its settings, the kernel that moves the chains, their state, and a tuner.

A sampler is a small frozen dataclass of settings. Bound to a density it is a kernel, which advances all chains of
a group in lockstep, as one array, so that one batched evaluation of the density serves them all. A tuner learns
better settings during warm-up.
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

Index = IntArray | BoolArray | slice
"""Which chains."""
Tree = Mapping[str, Any]
"""Plain data for a file: arrays, numbers, texts, None, and lists of numbers, by name; or trees again."""


@dataclass(frozen=True)
class State:
    """What the next step of a kernel needs, as arrays only, so that it can be kept in a file.

    Attributes
    ----------
    position : ndarray, shape (chains, ndim), or (chains, walkers, ndim) for an ensemble
    log_prob : ndarray, shape (chains,) or (chains, walkers)
    gradient : ndarray or None
        Gradient of the log-density at `position`, for the kernels that use it.
    extra : mapping of str to ndarray
        Data that only some kernels need.
    """

    position: FloatArray
    log_prob: FloatArray
    gradient: FloatArray | None = None
    extra: Mapping[str, AnyArray] = field(default_factory=dict)


@dataclass(frozen=True)
class Info:
    """Diagnostics of one step; the first four names mean the same thing in every sampler.

    Attributes
    ----------
    accepted : ndarray of bool, shape (chains,) or (chains, walkers)
        Whether the chain left its previous position.
    log_prob : ndarray
        Log-density at the position where the step ended.
    n_solves : ndarray of int
        Density evaluations inside the bounds (one eigenproblem each) that the step took.
    n_gradients : ndarray of int
        Gradients that the step took. An exact gradient is one solve too; a central-difference gradient is
        ``2 ndim`` solves.
    extra : mapping of str to ndarray
        Values that only some samplers have: ``acceptance_rate``, ``energy``, ``diverging``, ``n_steps``, ... They
        are recorded for every draw.
    parts : Info, optional
        For a kernel that runs other kernels, the diagnostics of their steps. They are for its tuner, and not
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
        """Evaluate the start; the info contains what that cost."""
        ...

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Advance every chain by one draw."""
        ...


class Sampler(ABC):
    """Settings of one sampler: the base class of all dataclasses of settings.

    A sampler that `registry` lists by name also sets these class attributes.

    Attributes
    ----------
    name : str
        Short name, such as ``"mh"``.
    title, colour : str
        For figures and reports.
    cost : tuple of three float
        Means over the built-in cases, per step of a chain or walker: evaluations in warm-up, evaluations after it,
        and distinct draws.
    first : tuple of two int
        Steps of warm-up, and draws after which a run that ends when it has converged is first judged.
    is_local : bool
        Whether its steps are local ones, see `LocalSampler`: the mixture and tempering can then take them.
    learns_together : bool
        Whether all chains must be in one group.
    walkers : int
        Walkers that an ensemble moves together; 1 for a sampler whose chain is a single point.
    gradient : str
        How the steps get gradients: "exact", from the density; "central-difference"; or "" if they take none.
    takes_gradients : bool
        Whether each evaluation includes the gradient.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    colour: ClassVar[str]
    cost: ClassVar[tuple[float, float, float]] = (1.0, 1.0, 1.0)
    first: ClassVar[tuple[int, int]] = (1000, 1000)
    is_local: ClassVar[bool] = False
    learns_together: ClassVar[bool] = False

    @property
    def walkers(self) -> int:
        """A chain is a single point."""
        return 1

    @property
    def gradient(self) -> str:
        """No gradients."""
        return ""

    @property
    def takes_gradients(self) -> bool:
        """Whether each evaluation includes the gradient: if there are any, unless a sampler says otherwise."""
        return bool(self.gradient)

    def starting_from(self, components: Sequence[Quadratic], weights: FloatArray) -> Self:
        """Return the settings that use the maxima of the density, as quadratics; most samplers do not use them."""
        return self

    @abstractmethod
    def bind(self, density: LogDensity) -> Kernel:
        """Return the kernel that samples `density` with these settings; ValueError if they do not fit it."""

    def tuner(self, density: LogDensity, chains: int, steps: int) -> Tuner | None:
        """Return a tuner that learns better settings in `steps` warm-up steps; None if none is needed."""
        return None


class Tuner(Protocol):
    """Learns the settings of a sampler from its warm-up steps.

    Attributes
    ----------
    kernel : Kernel
        Does the next warm-up step.
    """

    kernel: Any

    def update(self, state: State, info: Info) -> IntArray | None:
        """Learn from one step, and change `kernel` accordingly.

        Return the evaluations of each chain that learning itself took, shape (chains,); None if it took none.
        """
        ...

    def finish_learning(self) -> Sampler:
        """Return the settings learnt, with adaptation off."""
        ...

    def state(self) -> Tree:
        """Return the state of the tuner as plain data."""
        ...

    def restore(self, state: Tree) -> None:
        """Take over what another tuner, made with the same arguments, had learnt when it returned `state`."""
        ...


class Evaluation(NamedTuple):
    """Log-densities of a batch and their cost.

    Attributes
    ----------
    log_prob : ndarray, shape (...)
        ``-inf`` outside the box, and where the density is not finite inside it.
    n_solves : ndarray of int, shape (...)
        1 inside the box, 0 outside.
    n_nonfinite : ndarray of int, shape (...)
        1 where the density inside the box is not finite.
    """

    log_prob: FloatArray
    n_solves: IntArray
    n_nonfinite: IntArray


class Target:
    """A density as kernels evaluate it: inside its box, in batches, with the cost counted.

    Parameters
    ----------
    density : LogDensity
    """

    def __init__(self, density: LogDensity) -> None:
        self.density = density
        self.ndim, self.lower, self.upper = density.ndim, density.lower, density.upper
        self.solves_per_gradient = int(getattr(density, "solves_per_gradient", 1))

    def log_prob(self, position: FloatArray, chain: Index) -> FloatArray:
        """Return the log-densities at `position`, shape (n, ndim), inside the box.

        `chain` is an index that picks the chains whose points they are; a subclass may have another density for
        each.
        """
        values: FloatArray = self.density.log_prob(position)
        return values

    def evaluate(self, position: FloatArray, chain: IntArray | None = None) -> Evaluation:
        """Evaluate the density where `position`, shape (..., ndim), is inside the box, in one batch.

        `chain`, shape (...), says whose points they are; if not given, there is one point per chain.

        Points outside are never evaluated; a NaN coordinate is outside. A value that is not finite (a failed
        eigensolve) counts as ``-inf``, so that only this point is rejected.
        """
        inside, all_inside = find_inside(position, self.lower, self.upper)
        log_prob = np.full(inside.shape, -np.inf)
        if all_inside and inside.ndim == 1:  # it saves the copies
            log_prob[:] = self.log_prob(position, slice(None) if chain is None else chain)
        elif inside.any():
            log_prob[inside] = self.log_prob(position[inside], inside if chain is None else chain[inside])
        failed = inside & ~np.isfinite(log_prob)
        log_prob[failed] = -np.inf
        return Evaluation(log_prob, inside.astype(np.int64), failed.astype(np.int64))

    def start(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate where the chains start, one solve for each: what `Kernel.init` returns without gradients."""
        first = self.evaluate(positions)
        none = np.zeros(first.log_prob.shape, dtype=np.int64)
        return State(positions, first.log_prob), Info(none.astype(bool), first.log_prob, first.n_solves, none)

    def complete(self, state: State) -> tuple[State, Info | None]:
        """Return another kernel's state with what a step needs, and what that cost; None if it had all."""
        return state, None
