"""The protocols that every sampler shares: sampler, kernel, state and info; `fmu.types` has the density.

A sampler is a small frozen dataclass of settings. Bound to a density it is a kernel, which advances all
chains of one task in lockstep as one array, so that one batched evaluation of the density serves them all.
Nothing in this package knows of finite elements.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from fmu.types import BoolArray, FloatArray, IntArray, LogDensity


@dataclass(frozen=True)
class State:
    """What the next step of a kernel needs, as plain arrays.

    Attributes
    ----------
    position : ndarray, shape (chains, ndim), or (chains, walkers, ndim) for an ensemble
    log_prob : ndarray, shape (chains,) or (chains, walkers)
    gradient : ndarray or None
        Gradient of the log-density at `position`, for the kernels that use it.
    """

    position: FloatArray
    log_prob: FloatArray
    gradient: FloatArray | None = None


@dataclass(frozen=True)
class Info:
    """Diagnostics of one step; the four first names mean the same thing in every sampler.

    Attributes
    ----------
    accepted : ndarray of bool, shape (chains,) or (chains, walkers)
        Whether the chain left its previous position.
    log_prob : ndarray
        Log-density at the position that the step ended in.
    n_solves : ndarray of int
        Density evaluations inside the bounds (one eigenproblem each) that the step took.
    n_gradients : ndarray of int
        Gradients that the step took. An exact gradient is one solve too; a central-difference gradient is
        ``2 ndim`` solves.
    extra : mapping of str to ndarray
        What only some samplers have: ``acceptance_rate``, ``energy``, ``diverging``, ``n_steps``, ...
    """

    accepted: BoolArray
    log_prob: FloatArray
    n_solves: IntArray
    n_gradients: IntArray
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)


class Kernel(Protocol):
    """A sampler bound to a density."""

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the start; the info carries what that cost."""
        ...

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Advance every chain by one draw."""
        ...


class Sampler(Protocol):
    """Settings of one algorithm.

    Attributes
    ----------
    name : str
        Short name: ``"mh"``, ``"slice"``, ``"hmc"``, ``"emcee"`` or ``"tempering"``.
    walkers : int
        Walkers an ensemble moves together; 1 for a sampler whose chain is a single point.
    """

    name: ClassVar[str]

    @property
    def walkers(self) -> int:
        """Number of walkers a chain consists of."""
        ...

    def bind(self, density: LogDensity) -> Kernel:
        """Return the kernel that samples `density` with these settings."""
        ...

    def tuner(self, density: LogDensity, chains: int, steps: int) -> Tuner | None:
        """Return what learns better settings in `steps` steps of warm-up, None if nothing is to be learnt."""
        ...


class Tuner(Protocol):
    """Learns the settings of a sampler from its warm-up steps.

    Attributes
    ----------
    kernel : Kernel
        What the next warm-up step is to be done with.
    """

    kernel: Any

    def update(self, state: State, info: Info) -> None:
        """Learn from one step, and change `kernel` accordingly."""
        ...

    def finished(self) -> Sampler:
        """Return the settings learnt, with adaptation off."""
        ...
