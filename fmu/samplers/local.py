"""Base classes of the local samplers, whose steps the mixture sampler and tempering can also use.

A local sampler is one file with settings derived from `LocalSampler`, and a kernel derived from `LocalKernel`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from fmu.samplers.kernel import Info, Sampler, State, Target, Tuner
from fmu.types import BoolArray, FloatArray, LogDensity

if TYPE_CHECKING:
    from fmu.samplers.mixture.warp import Warp


class LocalSampler(Sampler):
    """Settings of a sampler that moves one point per chain by local steps.

    The mixture sampler takes these steps between its candidates, and tempering uses them to move its replicas.
    With the jumps that `fmu.samplers.mixture.mixture.with_jumps` adds, a local sampler's chains can cross from one
    maximum to another.
    """

    is_local: ClassVar[bool] = True

    @property
    def is_bent(self) -> bool:
        """Whether the settings name coordinates that the kernel transforms."""
        return False

    @abstractmethod
    def bind(self, density: LogDensity) -> LocalKernel:
        """Return the kernel that samples `density`; raise ValueError if the settings do not fit the density."""

    def take_covariance(self, covariance: FloatArray) -> Self:
        """Return a copy whose steps are adapted to a covariance, shape (ndim, ndim).

        The base class returns `self`, as derived classes do if the settings already specify the steps.
        """
        return self

    def take_warp(self, warp: Warp) -> Self | None:
        """Return a copy that takes its steps in the coordinates of a warp, or None if this is impossible.

        A covariance for the copy must be in the same coordinates. The base class always returns None.
        """
        return None

    def rung_tuner(self, density: LogDensity, chains: int, steps: int) -> Tuner | None:
        """Return a tuner whose kernels tempering can join, or None if nothing is learnt.

        By default it is the tuner that `tuner` returns.
        """
        return self.tuner(density, chains, steps)


@dataclass(frozen=True)
class LocalKernel(ABC):
    """A local sampler bound to a density. Derived kernels must be frozen dataclasses too.

    Its state is the position, the log-density and, if the target has gradients, the gradient. Its `Info.extra`
    contains ``n_nonfinite``, each chain's number of non-finite evaluations within the bounds.
    """

    target: Target

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the starting points; return the state, and an `Info` with the cost of the evaluation.

        Raise ValueError if a log-density is finite but a gradient that the steps need is not.
        """
        return self.target.start(positions)

    @abstractmethod
    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Advance every chain by one draw; return the new state and the step's diagnostics."""

    @abstractmethod
    def join(self, kernels: Sequence[Self], chains: int) -> Self:
        """Return one kernel that moves the chains of several kernels as one array.

        Parameters
        ----------
        kernels : sequence of kernels of this kind
            The first is this kernel, whose target the joint kernel keeps. The kernels may have different settings.
        chains : int
            Number of chains per kernel. The array contains the chains of the first kernel, then those of the
            second, and so on.
        """


def accept(rng: np.random.Generator | np.random.RandomState, log_ratio: FloatArray) -> BoolArray:
    """Return a mask of accepted candidates: True with probability min(1, exp(log_ratio)), elementwise.

    A NaN is not accepted. The logarithm of a uniform random number is drawn as −x with x exponential. Metropolis
    et al. (1953), J. Chem. Phys. 21, 1087-1092.
    """
    return np.asarray(-rng.standard_exponential(log_ratio.shape) <= log_ratio)


def accept_or_reject(
    rng: np.random.Generator, state: State, candidate: State, log_ratio: FloatArray
) -> tuple[State, BoolArray]:
    """Move each chain to its candidate with probability min(1, exp(log_ratio)).

    See Hastings (1970), Biometrika 57, 97-109.

    Parameters
    ----------
    rng : Generator
    state, candidate : State
        The states of all chains, and their candidates. The new state has gradients if both have them, and has no
        `extra`.
    log_ratio : ndarray, shape (chains,)
        log P(E*) q(E | E*) − log P(E) q(E* | E), where P is the density and q(E* | E) the proposal density of a
        candidate E* at the position E.

    Returns
    -------
    state : State
    accepted : ndarray of bool, shape (chains,)
        Whether each chain moved to its candidate.
    """
    accepted = accept(rng, log_ratio)
    moved = accepted[:, None]
    gradient = None
    if state.gradient is not None and candidate.gradient is not None:
        gradient = np.where(moved, candidate.gradient, state.gradient)
    position = np.where(moved, candidate.position, state.position)
    log_prob = np.where(accepted, candidate.log_prob, state.log_prob)
    return State(position, log_prob, gradient), accepted
