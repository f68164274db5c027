"""The mixture sampler: its settings, and how warm-up fits the mixture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from scipy.special import logsumexp

from fmu.samplers.hmc import HamiltonianMonteCarlo
from fmu.samplers.kernel import Info, Sampler, State, Target, Tree, Tuner
from fmu.samplers.metropolis import MetropolisHastings
from fmu.samplers.mixture.kernel import MixtureKernel
from fmu.samplers.mixture.proposal import Mixture, Points, Warp, fitted_mixture
from fmu.samplers.mixture.quadratic import Quadratic, fitted, n_coefficients
from fmu.samplers.settings import positive_scale, vector, whole_number
from fmu.samplers.slice import Slice
from fmu.types import FloatArray, IntArray, LogDensity

_LOCAL_PART = 0.5
"""Part of the warm-up that local steps take where no component is known."""
_FITS = (0.05, 0.1, 0.2, 0.4, 0.7)
"""Parts of the rest of the warm-up after which the mixture is fitted again."""
_SAMPLE = 1000  # draws of a mixture that give its covariance
_FAR = 10.0  # draws with a log-density further below the median, plus one per coordinate, are on the way
_APART = 3.0
_LEAST_MOVE = 1e-8  # in scaled units
_UNKNOWN = 5.0
"""A chain where log(w/E[w]) exceeds this is where the mixture has nothing: at a maximum that it does not know."""


@dataclass(frozen=True)
class MixtureSampler(Sampler):
    """Independence Metropolis-Hastings with a mixture of truncated Gaussians, and local steps between.

    The log-density of a well-measured structure is nearly quadratic within its bounds. Each component is a
    quadratic fitted to the log-density, truncated by the bounds and drawn from with its exact density; a candidate
    is accepted with probability min(1, w*/w), where w = P/q. Candidates do not depend on the position, so that
    chains cross between separated maxima in one step. A share of local steps visits what the mixture misses. The
    mixture is fitted in warm-up and then frozen.

    Parameters
    ----------
    components : sequence of Quadratic, optional
        Where the fit begins, in scaled units, such as the maxima of the posterior with their curvature, which
        `fmu.sample` gives. Without them, local steps find them in the first half of the warm-up.
    weights : vector, optional
        Their weights; equal if not given.
    bent : vector of bool, optional
        The coordinates of which the components take log(1 + 10 (u − lower)) instead of u, see `Warp`; learnt if
        not given.
    local : HamiltonianMonteCarlo, MetropolisHastings or Slice, optional
        The local steps: HMC if the density has exact gradients, otherwise slice sampling.
    local_steps, jumps : int
        So many local steps, then so many candidates of the mixture. Where at least every other step is one of
        `local`, it is that sampler with jumps, and has its name: `with_jumps`.
    adapt : bool
        Whether warm-up fits the mixture.

    Raises
    ------
    ValueError
        If a setting is out of range, or without components nothing is to be learnt.

    References
    ----------
    Tierney (1994), Ann. Statist. 22, 1701-1762, section 2.3.3; Botev (2017), JRSS B 79, 125-148; Cornuet, Marin,
    Mira & Robert (2012), Scand. J. Stat. 39, 798-812.
    """

    components: tuple[Quadratic, ...] | None = None
    weights: Any = None
    bent: Any = None
    local: HamiltonianMonteCarlo | MetropolisHastings | Slice | None = None
    local_steps: int = 1
    jumps: int = 39
    adapt: bool = True

    name: ClassVar[str] = "mixture"
    title: ClassVar[str] = "Mixture sampler"
    colour: ClassVar[str] = "#882255"
    cost: ClassVar[tuple[float, float, float]] = (1.5, 1.3, 0.8)
    first: ClassVar[tuple[int, int]] = (500, 250)

    def __post_init__(self) -> None:
        whole_number("local_steps", self.local_steps, 1)
        whole_number("jumps", self.jumps, 1)
        if self.local is not None and self.local_steps >= self.jumps:
            object.__setattr__(self, "name", self.local.name)
        if self.components is None:
            if not self.adapt:
                raise ValueError("components: must be given if adapt is False (got None)")
            return
        components = tuple(self.components)
        weights = np.ones(len(components)) if self.weights is None else self.weights
        object.__setattr__(self, "components", components)
        object.__setattr__(self, "weights", vector("weights", positive_scale("weights", weights, matrix=False)))
        if len(self.weights) != len(components):
            raise ValueError(f"weights: must be {len(components)}, one per component (got {len(self.weights)})")
        if self.bent is not None:
            object.__setattr__(self, "bent", tuple(bool(one) for one in self.bent))

    def starting_from(self, components: Sequence[Quadratic], weights: FloatArray) -> Self:
        """Return these settings with components to begin with, unless they have some."""
        if self.components is not None:
            return self
        return replace(self, components=tuple(components), weights=tuple(np.asarray(weights).tolist()))

    def bind(self, density: LogDensity) -> MixtureKernel:
        """Return the kernel that samples `density`."""
        local = self.local_of(density).bind(density)
        return MixtureKernel(Target(density), self.mixture(density), local, self.local_steps, self.jumps)

    def tuner(self, density: LogDensity, chains: int, steps: int) -> MixtureTuner | None:
        """Return a tuner that fits the mixture in `steps` warm-up steps; None if it is not to be fitted."""
        return MixtureTuner(self, density, chains, steps) if self.adapt else None

    def mixture(self, density: LogDensity) -> Mixture | None:
        """Return the mixture that the components make; None if there are none."""
        if self.components is None:
            return None
        warp = first_warp(density)
        if self.bent is not None:  # components that were fitted are in the coordinates of the warp
            warp = replace(warp, bent=np.array(self.bent))
            return Mixture(self.components, np.asarray(self.weights), warp)
        return Mixture([warp.quadratic(one) for one in self.components], np.asarray(self.weights), warp)

    def local_of(self, density: LogDensity) -> HamiltonianMonteCarlo | MetropolisHastings | Slice:
        """Return the settings of the local steps."""
        if self.local is not None:
            return self.local
        exact = getattr(density, "solves_per_gradient", 1) == 1
        return HamiltonianMonteCarlo() if exact else Slice()


def can_jump(sampler: Sampler) -> bool:
    """Say whether a sampler can have jumps: whether its steps are local ones, of a single point."""
    return isinstance(sampler, HamiltonianMonteCarlo | MetropolisHastings | Slice)


def with_jumps(sampler: Any) -> MixtureSampler:
    """Return a sampler whose every other step is a candidate of a mixture: its chains cross between maxima.

    ValueError if its steps are not local ones. With a candidate in every tenth step of Metropolis-Hastings, 4000
    draws of cantilever-section by number are worth 400 independent ones, and R-hat is 1.011 to 1.021; with one in
    every other step they are worth 1600, and R-hat is below 1.005.

    Moves between modes and local ones in turn: Tjelmeland & Hegstad (2001), Scand. J. Stat. 28, 205-223; Ahn, Chen
    & Welling (2013), AISTATS 31, 108-116; Pompe, Holmes & Łatuszyński (2020), Ann. Statist. 48, 2930-2952.
    """
    if not can_jump(sampler):
        raise ValueError(f"jumps: are for mh, slice and hmc only (got True with {sampler.name})")
    return MixtureSampler(local=sampler, local_steps=1, jumps=1)


def first_warp(density: LogDensity) -> Warp:
    """Return the warp before anything is learnt: coordinates with a lower bound alone are bent."""
    bent = np.isfinite(density.lower) & ~np.isfinite(density.upper)
    return Warp(density.lower, density.upper, bent)


class MixtureTuner:
    """Fits the mixture again and again, to all candidates so far, weighted by the mixtures that they came from.

    Where no component is known, local steps take the first half of the warm-up, and the first fit is to their
    draws, with the gradients if those were evaluated. A chain that has found what the mixture does not know gives
    it a component. The local steps after the first fit have a metric from the covariance of the mixture.
    """

    def __init__(self, sampler: MixtureSampler, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler, self.density, self.chains, self.steps = sampler, density, chains, steps
        self.done = 0
        self.first = 0 if sampler.components is not None else max(int(_LOCAL_PART * steps), 1)
        self.fit_at = [self.first + int(part * (steps - self.first)) for part in _FITS]
        self.target = Target(density)
        self.stages: list[Mixture] = []  # of each fit, the last one in use
        self.counts: list[int] = []  # of the candidates of each that were evaluated
        self.drawn = Evaluated.none(density.ndim)
        self.covariance: FloatArray | None = None
        self.local_settings = sampler.local_of(density)
        self.local: Tuner | None = None
        given = sampler.mixture(density)
        if given is None:
            self.local = self.local_settings.tuner(density, chains, self.first)
        else:
            self._begin_with(given)
        self._take_kernel()

    @property
    def mixture(self) -> Mixture | None:
        """The mixture in use; None before the first fit."""
        return self.stages[-1] if self.stages else None

    def update(self, state: State, info: Info) -> None:
        """Learn from one step."""
        self.done += 1
        if info.parts is not None and self.local is not None:
            self.local.update(State(state.position, state.log_prob, state.gradient), info.parts)
        if self.mixture is None:
            self.drawn = self.drawn.with_more(state.position, state.log_prob, state.gradient)
            if self.done == self.first:
                self._fit_to_draws()
        elif info.parts is None and int(state.extra["next"]) == 1:  # a new block
            u, log_prob = state.extra["block_position"], state.extra["block_log_prob"]
            self.drawn = self.drawn.with_more(u.reshape(-1, self.density.ndim), log_prob.ravel())
            self.counts[-1] += log_prob.size
        if self.done in self.fit_at and self.drawn.log_prob.size:
            self._fit(state)
        self._take_kernel()

    def finished(self) -> MixtureSampler:
        """Return the settings learnt."""
        if self.mixture is None:
            self._fit_to_draws()
        assert self.mixture is not None
        local: Any = self.local_settings if self.local is None else self.local.finished()
        return replace(
            self.sampler,
            components=self.mixture.quadratics,
            weights=tuple(self.mixture.weights.tolist()),
            bent=tuple(self.mixture.warp.bent.tolist()),
            local=local,
            adapt=False,
        )

    def state(self) -> Tree:
        """Return the state of the tuner as plain data."""
        return {
            "done": self.done,
            "drawn": self.drawn._asdict(),
            "stages": {str(k): stage.arrays() for k, stage in enumerate(self.stages)},
            "counts": list(self.counts),
            "covariance": self.covariance,
            "local": None if self.local is None else self.local.state(),
        }

    def restore(self, state: Tree) -> None:
        """Take over what another tuner had learnt."""
        self.done = state["done"]
        self.drawn, self.counts = Evaluated(**state["drawn"]), [int(n) for n in state["counts"]]
        lower, upper = self.density.lower, self.density.upper
        stages = state["stages"]
        self.stages = [Mixture.of_arrays(stages[str(k)], lower, upper) for k in range(len(stages))]
        if self.stages:
            self._take_covariance(state["covariance"])
        if self.local is not None:
            self.local.restore(state["local"])
        self._take_kernel()

    def _begin_with(self, mixture: Mixture) -> None:
        """Take the first mixture, and local steps of its shape."""
        self._take(mixture)
        self._take_covariance(mixture.covariance_within(np.random.default_rng(0), _SAMPLE))

    def _fit_to_draws(self) -> None:
        """Fit the first mixture to the later half of the local steps' draws, each group of chains by itself."""
        u, log_prob, slope = (one.reshape(-1, self.chains, *one.shape[1:]) for one in self.drawn)
        u, log_prob, slope = (one[len(one) // 2 :] for one in (u, log_prob, slope))
        near = log_prob >= np.median(log_prob, axis=0) - _FAR - self.density.ndim
        moved = np.array([_has_moved(u[near[:, k], k]) for k in range(self.chains)])
        near &= moved | ~moved.any()
        group = np.broadcast_to(groups_of_chains(u) if moved.any() else 0, near.shape)[near]
        slopes = None if np.isnan(slope).any() else slope[near]
        points = Points(u[near], log_prob[near], np.ones(int(near.sum())), slopes)
        warp = first_warp(self.density)
        x, value, of_x = points.under(warp)
        members = [(group == k).astype(float) for k in np.unique(group)]
        each = [fitted(x, value, member, of_x) for member in members]
        self.drawn = Evaluated.none(self.density.ndim)
        self._begin_with(fitted_mixture(points, Mixture(each, np.sum(members, axis=1), warp)))

    def _fit(self, state: State) -> None:
        """Fit the mixture to all candidates so far, weighted over all mixtures so far (Cornuet et al. 2012)."""
        assert self.mixture is not None
        u, log_prob, _ = self.drawn
        known = np.isfinite(log_prob)
        u, log_prob = u[known], log_prob[known]
        if len(u) <= n_coefficients(self.density.ndim):
            return
        of_stages = [
            np.log(n) + stage.log_density(u) for stage, n in zip(self.stages, self.counts, strict=True) if n
        ]
        log_q = np.asarray(logsumexp(of_stages, axis=0)) - np.log(len(self.drawn.log_prob))
        try:
            mixture = fitted_mixture(Points.weighted(u, log_prob, log_q), self.mixture)
        except np.linalg.LinAlgError:  # go on with the mixture that there is
            return
        log_mean = float(logsumexp(log_prob - log_q)) - np.log(len(self.drawn.log_prob))
        self._take(_with_found(mixture, state, log_mean))

    def _take(self, mixture: Mixture) -> None:
        self.stages.append(mixture)
        self.counts.append(0)

    def _take_covariance(self, covariance: FloatArray) -> None:
        self.covariance = covariance
        cycle = self.sampler.local_steps + self.sampler.jumps
        remaining = max((self.steps - self.first) * self.sampler.local_steps // cycle, 1)
        self.local_settings = shaped(self.sampler.local_of(self.density), covariance)
        self.local = self.local_settings.tuner(self.density, self.chains, remaining)

    def _take_kernel(self) -> None:
        local = self.local_settings.bind(self.density) if self.local is None else self.local.kernel
        steps, jumps = self.sampler.local_steps, self.sampler.jumps
        self.kernel = MixtureKernel(self.target, self.mixture, local, steps, jumps, len(self.stages))


def groups_of_chains(u: FloatArray) -> IntArray:
    """Return the group of each chain of u (steps, chains, ndim): apart where chains are at separated maxima.

    Two chains are together if their means are within `_APART` standard deviations along the line between them.
    """
    mean = u.mean(axis=0)
    group = np.arange(len(mean))
    for i in range(1, len(mean)):
        for j in range(i):
            line = mean[i] - mean[j]
            spread = np.sum([((u[:, k] - mean[k]) @ line).var() for k in (i, j)])
            if line @ line <= _APART * np.sqrt(spread):
                group[i] = group[j]
                break
    return group


def _has_moved(u: FloatArray) -> bool:
    """Say whether draws (n, ndim) have been at enough points to have a covariance."""
    return len(np.unique(u, axis=0)) > u.shape[1] and bool(np.all(np.ptp(u, axis=0) > _LEAST_MOVE))


class Evaluated(NamedTuple):
    """Points (n, ndim) at which the density was evaluated, its logarithm there (n,), and gradients or NaN."""

    position: FloatArray
    log_prob: FloatArray
    gradient: FloatArray

    @classmethod
    def none(cls, ndim: int) -> Evaluated:
        """Return no points."""
        return cls(np.empty((0, ndim)), np.empty(0), np.empty((0, ndim)))

    def with_more(self, position: FloatArray, log_prob: FloatArray, slope: FloatArray | None = None) -> Evaluated:
        """Return these points and others."""
        more = position, log_prob, np.full_like(position, np.nan) if slope is None else slope
        return Evaluated(*(np.concatenate(both) for both in zip(self, more, strict=True)))


def _with_found(mixture: Mixture, state: State, log_mean: float) -> Mixture:
    """Return the mixture with a component at the highest chain, if any, that is where the mixture has nothing.

    The component has the curvature of the heaviest one, which later fits correct.
    """
    beyond = state.log_prob - mixture.log_density(state.position) - log_mean
    if not np.any(beyond > _UNKNOWN):
        return mixture
    chain = int(np.argmax(np.where(beyond > _UNKNOWN, state.log_prob, -np.inf)))
    x = mixture.warp.to_x(state.position[chain])
    like = mixture.quadratics[int(np.argmax(mixture.weights))]
    new = Quadratic(x, float(state.log_prob[chain]), np.zeros_like(x), like.hessian)
    weights = np.append(mixture.weights, np.max(mixture.weights))
    return Mixture([*mixture.quadratics, new], weights, mixture.warp)


def shaped(
    local: HamiltonianMonteCarlo | MetropolisHastings | Slice, covariance: FloatArray
) -> HamiltonianMonteCarlo | MetropolisHastings | Slice:
    """Return local settings that fit a covariance, where they do not give a shape of their own."""
    if isinstance(local, HamiltonianMonteCarlo):
        return local if local.inverse_mass is not None else replace(local, inverse_mass=covariance)
    if isinstance(local, MetropolisHastings) or local.width is not None or local.axes is not None:
        return local
    variances, axes = np.linalg.eigh(covariance)
    return replace(local, axes=axes, width=local.spread * np.sqrt(np.maximum(variances, 1e-24)))
