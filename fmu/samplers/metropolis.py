"""The Metropolis-Hastings sampler (Boulkaibet et al., section 4.1) and its proposals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import check_arguments
from fmu.samplers.kernel import Index, Info, State, Target, Tree
from fmu.samplers.local import LocalKernel, LocalSampler, accept_or_reject
from fmu.samplers.settings import Scale, cholesky_factor, fits, positive_scale, vector
from fmu.samplers.slice import Slice, SliceKernel, SliceTuner
from fmu.types import FloatArray, LogDensity

START_SCALE = 0.01
"""Standard deviation of the random walk before a covariance is learnt, in scaled units."""
_SETTLING = 20  # steps that the scale of a random walk takes to settle


class Proposal(Protocol):
    """A conditional density q(candidate | position), in scaled units.

    If the proposal is a dataclass whose fields can be written as JSON, they are recorded with the trace.
    """

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Return one candidate per chain; `position` and the candidates have shape ``(chains, ndim)``."""
        ...

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return log q(position | candidate) − log q(candidate | position), shape ``(chains,)``."""
        ...


@check_arguments
@dataclass(frozen=True)
class RandomWalk:
    """Symmetric Gaussian random walk: candidate = position + z with z ~ N(0, S).

    Parameters
    ----------
    scale : float, vector (ndim,) or matrix (ndim, ndim)
        One standard deviation for all coordinates, one per coordinate, or the covariance S, in scaled units.

    Raises
    ------
    ValueError
        If `scale` is not finite and positive, is a matrix that is not symmetric positive definite or, when a
        sample is drawn, does not have ndim entries or rows.
    """

    scale: Any = 0.01
    factor: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        scale: Scale = positive_scale("scale", self.scale, matrix=True)
        object.__setattr__(self, "scale", scale)
        array = np.asarray(scale)
        object.__setattr__(self, "factor", cholesky_factor("scale", array) if array.ndim == 2 else array)

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Return candidates position + L z, shape (chains, ndim), with z standard normal and L Lᵀ = S."""
        factor = fits("scale", self.factor, position.shape[-1])
        z = rng.standard_normal(position.shape)
        return position + (z @ factor.T if factor.ndim == 2 else factor * z)

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return zeros, shape (chains,), because q(a | b) = q(b | a)."""
        return np.zeros(len(position))


@dataclass(frozen=True)
class RandomWalks:
    """Gaussian random walks, one per chain, with covariances L Lᵀ; `factor` is L, shape (chains, ndim, ndim)."""

    factor: FloatArray

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Return candidates position + L z, shape (chains, ndim), with z standard normal."""
        z = rng.standard_normal(position.shape)
        return position + np.einsum("nij,nj->ni", self.factor, z)

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return zeros, shape (chains,), because the walks are symmetric."""
        return np.zeros(len(position))


@dataclass(frozen=True)
class LogNormalWalk:
    """Multiplicative random walk above `origin`: candidate − origin = (position − origin) exp(s z), z ~ N(0, 1).

    The walk is asymmetric. With the position x and the candidate x' measured from the origin,
    q(x' | x) = N(log x'; log x, s²)/x' in each coordinate, so log q(x | x') − log q(x' | x) = Σ log(x'/x).

    Parameters
    ----------
    scale : float or vector (ndim,)
        Standard deviation s of the logarithm.
    origin : float or vector (ndim,)
        Origin of the walk in scaled units, which must lie below every position. The default, 0, is the lower bound
        of a coordinate that is scaled to lie between 0 and 1.

    Raises
    ------
    ValueError
        If `scale` is not positive and finite, or `origin` is not finite. When a sample is drawn, also if a vector
        does not have length ndim, or a position is not above `origin`.
    """

    scale: ArrayLike = 0.2
    origin: ArrayLike = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "scale", positive_scale("scale", self.scale, matrix=False))
        origin = np.asarray(self.origin, dtype=float)
        if origin.ndim == 0 and not np.isfinite(origin):
            raise ValueError(f"origin: must be finite (got {self.origin!r})")
        object.__setattr__(self, "origin", vector("origin", origin) if origin.ndim else float(origin))

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Return candidates, shape (chains, ndim), by multiplying distances from the origin by log-normal factors.

        Raise ValueError if a position is not above `origin`, or if `scale` or `origin` has the wrong length.
        """
        ndim = position.shape[-1]
        scale, origin = fits("scale", self.scale, ndim), fits("origin", self.origin, ndim)
        if np.any(position <= origin):
            raise ValueError(f"origin: must be below every position (got {self.origin} and a position at it)")
        return origin + (position - origin) * np.exp(scale * rng.standard_normal(position.shape))

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return Σ log((candidate − origin)/(position − origin)), (chains,); −∞ for a candidate at the origin."""
        origin = np.asarray(self.origin)
        with np.errstate(divide="ignore"):  # if a factor underflows, the candidate at the origin is rejected
            return np.sum(np.log(candidate - origin) - np.log(position - origin), axis=-1)


@dataclass(frozen=True)
class Independence:
    """Independence proposal: draws candidates from a fixed Gaussian, regardless of the current position.

    The Gaussian may be a Laplace approximation, for example. See Tierney (1994), Ann. Statist. 22, 1701-1762,
    section 2.3.3.

    Parameters
    ----------
    mean : vector (ndim,)
    covariance : matrix (ndim, ndim)
        Mean and covariance of the Gaussian, in scaled units.

    Raises
    ------
    ValueError
        If `mean` is not a finite vector, or `covariance` is not a symmetric positive definite matrix of matching
        size. When a sample is drawn, also if `mean` does not have length ndim.
    """

    mean: ArrayLike
    covariance: ArrayLike
    _factor: FloatArray = field(init=False, repr=False, compare=False)
    _inverse_factor: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mean", vector("mean", self.mean))
        factor = cholesky_factor("covariance", np.asarray(self.covariance, dtype=float))
        fits("covariance", factor, np.size(self.mean))
        object.__setattr__(self, "covariance", positive_scale("covariance", self.covariance, matrix=True))
        object.__setattr__(self, "_factor", factor)
        object.__setattr__(self, "_inverse_factor", np.linalg.inv(factor))

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Return candidates mean + L z, shape (chains, ndim), with z standard normal and L Lᵀ = covariance."""
        mean = fits("mean", self.mean, position.shape[-1])
        return mean + rng.standard_normal(position.shape) @ self._factor.T

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return log g(position) − log g(candidate), shape (chains,), where g is the Gaussian density."""
        return self._log_density(position) - self._log_density(candidate)

    def _log_density(self, x: FloatArray) -> FloatArray:
        z = (x - np.asarray(self.mean)) @ self._inverse_factor.T
        return -0.5 * np.sum(z * z, axis=-1)


@check_arguments
@dataclass(frozen=True)
class MetropolisHastings(LocalSampler):
    """Metropolis-Hastings sampler.

    At the position E a candidate E* is drawn from the proposal q(E* | E), and accepted with probability
    min(1, P(E*) q(E | E*) / (P(E) q(E* | E))), where P is the density.

    Parameters
    ----------
    proposal : Proposal, optional
        The proposal q, with settings in scaled units. By default it is a Gaussian random walk whose covariance is
        learnt in warm-up; the first quarter of warm-up then uses slice sampling.

    Raises
    ------
    ValueError
        If `proposal` lacks one of the methods ``sample`` and ``log_ratio``.

    References
    ----------
    Boulkaibet et al. (`fmu.paper.published`), section 4.1; Hastings (1970), Biometrika 57, 97-109.
    """

    proposal: Proposal | None = None

    name: ClassVar[str] = "mh"
    title: ClassVar[str] = "Metropolis–Hastings"
    colour: ClassVar[str] = "#E69F00"
    cost: ClassVar[tuple[float, float, float]] = (1.5, 0.7, 0.3)

    def bind(self, density: LogDensity) -> MetropolisKernel:
        """Return the kernel that samples `density`. By default its random walk has the scale `START_SCALE`."""
        return MetropolisKernel(Target(density), self.proposal or RandomWalk(START_SCALE))

    def tuner(self, density: LogDensity, chains: int, steps: int) -> MetropolisTuner | None:
        """Return a tuner that learns the random walk in `steps` warm-up steps, or None if `proposal` is given."""
        if self.proposal is not None:
            return None
        return MetropolisTuner(self, density, steps)


@dataclass(frozen=True)
class MetropolisKernel(LocalKernel):
    """Metropolis-Hastings kernel bound to a density."""

    proposal: Proposal

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Propose a candidate for every chain, and accept or reject it.

        A candidate outside the bounds has zero density and is rejected without an evaluation.
        """
        candidate = self.proposal.sample(rng, state.position)
        new = self.target.evaluate(candidate)
        log_ratio = np.full(len(candidate), -np.inf)
        finite = np.isfinite(new.log_prob)
        alive: Index = slice(None) if np.count_nonzero(finite) == len(finite) else finite  # usually avoids copies
        log_ratio[alive] = (
            new.log_prob[alive]
            - state.log_prob[alive]
            + self.proposal.log_ratio(candidate[alive], state.position[alive])
        )
        end, accepted = accept_or_reject(rng, state, State(candidate, new.log_prob), log_ratio)
        extra = {"acceptance_rate": np.exp(np.minimum(0.0, log_ratio)), "n_nonfinite": new.n_nonfinite}
        return end, Info(accepted, end.log_prob, new.n_solves, np.zeros_like(new.n_solves), extra)

    def join(self, kernels: Sequence[Self], chains: int) -> Self:
        """Return one kernel for the chains of all `kernels`, each of which must propose a Gaussian random walk."""
        ndim, factors = self.target.ndim, list[FloatArray]()
        for kernel in kernels:
            proposal: Any = kernel.proposal
            factor: FloatArray = proposal.factor
            factors.append(factor if factor.ndim == 2 else np.diag(np.broadcast_to(factor, ndim)))
        return replace(self, proposal=RandomWalks(np.repeat(factors, chains, axis=0)))


class Search(SliceKernel):
    """Slice-sampling kernel for the first part of warm-up, with the Metropolis-Hastings kernel's statistics."""

    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Draw a point from the slice for every chain. The acceptance rate is 1, or 0 for a chain that stayed."""
        state, info = super().step(rng, state)
        extra = {"acceptance_rate": info.accepted.astype(float), "n_nonfinite": info.extra["n_nonfinite"]}
        return state, replace(info, extra=extra)


class MetropolisTuner:
    """Tuner of a Gaussian random walk, which learns its covariance from the draws and its scale from acceptance.

    A random walk with an unsuitable covariance takes long to reach the bulk of the distribution, and the draws on
    the way there may have a different covariance from the bulk. The first part of warm-up therefore uses slice
    sampling, which finds its own scale in every step. The random walk starts with the covariance of these draws,
    and each window improves it (Haario, Saksman & Tamminen 2001).

    The random walk has the covariance s²·S, where S is the latest covariance learnt from a window. Before the
    first window closes, S is `START_SCALE`² times the identity. The scale s is adapted until the acceptance rate,
    averaged over the chains that have reached the bulk, is at its optimum: 0.44 in one dimension and 0.234 in many
    (Gelman, Roberts & Gilks 1996). The adaptation is a Robbins–Monro recursion (Andrieu & Thoms 2008, algorithm
    4).
    """

    def __init__(self, sampler: MetropolisHastings, density: LogDensity, steps: int) -> None:
        self.sampler, self.density = sampler, density
        self.search = SliceTuner(Slice(), density, steps)
        self.target = 0.234 + (0.44 - 0.234) / density.ndim
        self.kernel: Search | MetropolisKernel = Search(**vars(self.search.kernel))
        self._restart(0.0)

    def update(self, state: State, info: Info) -> None:
        """Adapt the settings to one more warm-up step."""
        learner = self.search.learner
        searching = learner.searching
        self.search.update(state, info)
        if not searching:
            # log s ← log s + γ_t (α_t − α*), with γ_t ~ t^−0.6: Σ γ_t is infinite, and Σ γ_t² is finite
            self.count += 1
            rate = float(learner.average_arrived(info.extra["acceptance_rate"]))
            self.log_scale += 3.0 / (self.count + 10) ** 0.6 * (rate - self.target)
            if self.count > _SETTLING:
                self.sum += self.log_scale
        if self.search.window_closed:
            self._restart(float(np.log(2.38 / np.sqrt(self.density.ndim))))  # best for a Gaussian of covariance S
        self._take_settings()

    def finish_learning(self) -> MetropolisHastings:
        """Return the learnt settings, with the scale averaged over the steps since the last window closed.

        The first 20 of these steps are left out of the mean. If there were at most 40, the last scale is returned.
        """
        averaged = self.sum / (self.count - _SETTLING) if self.count > 2 * _SETTLING else self.log_scale
        return self._settings(averaged)

    def state(self) -> Tree:
        """Return the tuner's state as plain data."""
        return {"search": self.search.state(), "log_scale": self.log_scale, "count": self.count, "sum": self.sum}

    def restore(self, state: Tree) -> None:
        """Restore the state that another tuner's `state` returned."""
        self.search.restore(state["search"])
        self.log_scale, self.count, self.sum = state["log_scale"], state["count"], state["sum"]
        if self.search.learner.step:
            self._take_settings()

    def _restart(self, log_scale: float) -> None:
        self.log_scale, self.count, self.sum = log_scale, 0, 0.0

    def _take_settings(self) -> None:
        if self.search.learner.searching:
            self.kernel = Search(**vars(self.search.kernel))
        else:
            self.kernel = self._settings(self.log_scale).bind(self.density)

    def _settings(self, log_scale: float) -> MetropolisHastings:
        covariance = self.search.learner.covariance
        shape = START_SCALE**2 * np.eye(self.density.ndim) if covariance is None else covariance
        return replace(self.sampler, proposal=RandomWalk(np.exp(2.0 * log_scale) * shape))
