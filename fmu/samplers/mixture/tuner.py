"""How warm-up fits the mixture: to what it has evaluated, again and again."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import logsumexp

from fmu.samplers.hmc import HamiltonianMonteCarlo
from fmu.samplers.kernel import Info, State, Target, Tree, Tuner
from fmu.samplers.metropolis import MetropolisHastings
from fmu.samplers.mixture.curve import infinite_margins
from fmu.samplers.mixture.curved import CurvedMixture
from fmu.samplers.mixture.kernel import MixtureKernel
from fmu.samplers.mixture.proposal import (
    GOOD,
    LESS_WIDE,
    MOST,
    WIDE,
    Mixture,
    Points,
    Warp,
    fitted_mixture,
    refitted_mixture,
)
from fmu.samplers.mixture.quadratic import Quadratic, climbed, fitted, n_coefficients
from fmu.samplers.mixture.rounds import learnt_in_rounds
from fmu.samplers.slice import Slice
from fmu.types import BoolArray, FloatArray, IntArray, LogDensity

_LOCAL_PART = 0.5
"""Part of the warm-up that local steps take where no component is known."""
_FITS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Parts of the rest of the warm-up after which the mixture is fitted again."""
_SAMPLE = 1000  # draws of a mixture that give its covariance
_FAR = 10.0  # points with a log-density further below the median, plus one per coordinate, are on the way
_APART = 3.0
_LEAST_MOVE = 1e-8  # in scaled units
_UNKNOWN, _VALLEY = 1.0, 3.0
"""A point where log w exceeds its median by the first is where the mixture has too little. It is near a maximum
that the mixture does not know if the log-density between it and its component drops by the second: more than what
local steps cross by themselves."""
_LOWEST = -5.0  # of the logarithm of a new component's share
_CHECKED = 5  # points per fit
_BETWEEN = np.arange(6) / 6.0  # from the component to the point
_JUDGED = 3
"""Fits after which a mixture has had its chance: from this one on, rarely accepted candidates give way."""
_RARE, _OFTEN = 0.1, 0.3
"""Acceptance rate of candidates, in the chain with the lowest, below which most steps are local ones, and above
which most are candidates again. A local step gives some 0.05 effective draws per evaluation."""
_LOCAL_STEPS = 3
"""Local steps per candidate where those are rarely accepted."""
_ENOUGH_JUMPS, _ENOUGH_STEPS = 20, 100
"""Candidates per chain that tell their acceptance rate, and local steps that tell their own metric."""
_LEAST_WALK, _WALK_SOLVES = 50, 1000
"""Local steps that give a first idea of a density, and evaluations of a chain after which they are enough."""
_CANDIDATES = 5
"""Most candidates of the rounds in which a curved mixture is learnt, per step of the warm-up and chain."""
_WORTH = 0.02
"""Effective draws per candidate of a curved mixture below which local steps give more."""
_CURVED_CYCLE = 1, 79
"""Local steps, then candidates, of a curved mixture."""


class MixtureTuner:
    """Fits the mixture again and again, to all candidates so far, weighted by the mixtures that they came from.

    Where no component is known, local steps take the first half of the warm-up, and the first fit is to their
    draws, with the gradients if those were evaluated. Where a chain or a candidate has found a maximum that the
    mixture does not know, it is given a component. The local steps after the first fit have a metric from the
    covariance of the mixture.

    Where candidates are still rarely accepted in some chain after the first fits, the steps go to local ones,
    which learn a metric of their own from their draws. Further fits are to these draws. Candidates come back when
    they are accepted often. Once the draws show the density roughly, a `CurvedMixture` is learnt from rounds of
    candidates; it stays if its candidates are accepted. It is also learnt where the density is infinite at a wall.

    Parameters
    ----------
    sampler : MixtureSampler
        The settings to complete.
    density : LogDensity
    chains, steps : int
        Of the warm-up.
    """

    def __init__(self, sampler: Any, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler, self.density, self.chains, self.steps = sampler, density, chains, steps
        self.done = 0
        self.first = 0 if sampler.components is not None else max(int(_LOCAL_PART * steps), 1)
        self.target = Target(density)
        self.stages: list[Mixture | CurvedMixture] = []  # of each fit, the last one in use
        self.counts: list[int] = []  # of the candidates of each that were evaluated
        self.drawn = self.visited = self.walked = Evaluated.none(density.ndim)  # `walked` as local steps prevail
        self.accepted, self.jumped = np.zeros(chains), 0  # of the candidates since the last fit
        self.switched = -1  # step at which local steps began to prevail; -1 where they do not
        self.walk = 0, 0.0  # local steps before there was a mixture, or as they prevail, and evaluations per chain
        self.is_bent = self.has_tried = False  # what a curved mixture is for, and whether one was learnt
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
    def mixture(self) -> Mixture | CurvedMixture | None:
        """The mixture in use; None before the first fit."""
        return self.stages[-1] if self.stages else None

    @property
    def fit_at(self) -> list[int]:
        """Steps after which the mixture is fitted again."""
        return [self.first + int(part * (self.steps - self.first)) for part in _FITS]

    def update(self, state: State, info: Info) -> IntArray | None:
        """Learn from one step; return the evaluations of each chain that this took, shape (chains,)."""
        self.done += 1
        if info.parts is not None:
            if self.local is not None:
                self.local.update(State(state.position, state.log_prob, state.gradient), info.parts)
            if self.switched >= 0:
                self.walked = self.walked.with_more(state.position, state.log_prob, state.gradient)
            if self.switched >= 0 or self.mixture is None:
                self.walk = self.walk[0] + 1, self.walk[1] + float(np.mean(info.n_solves))
        else:
            self.accepted = self.accepted + info.extra["acceptance_rate"]
            self.jumped += 1
        if self.mixture is None:
            self.visited = self.visited.with_more(state.position, state.log_prob, state.gradient)
            if self.done == self.first or self._has_walked:
                self.first = self.done
                self._fit_to_draws()
        elif info.parts is None and int(state.extra["next"]) == 1:  # a new block
            u, log_prob = state.extra["block_position"], state.extra["block_log_prob"]
            self.drawn = self.drawn.with_more(u.reshape(-1, self.density.ndim), log_prob.ravel())
            self.counts[-1] += log_prob.size
        spent = None
        if self.done in self.fit_at and self.drawn.log_prob.size:
            spent = self._fit(state)
            if self.done >= self.fit_at[_JUDGED]:
                spent = _sum(spent, self._choose_steps(state))
            self.accepted, self.jumped = np.zeros(self.chains), 0
        elif self.switched >= 0 and self.is_bent and self._has_walked and self._can_learn:
            spent = self._learn_curved(state)
        self._take_kernel()
        return spent

    def finished(self) -> Any:
        """Return the settings learnt."""
        if self.mixture is None:
            self._fit_to_draws()
        assert self.mixture is not None
        local: Any = self.local_settings if self.local is None else self.local.finished()
        if isinstance(self.mixture, CurvedMixture):
            steps, jumps = self._cycle(WIDE)
            return replace(
                self.sampler, components=self.mixture, local_steps=steps, jumps=jumps, local=local, adapt=False
            )
        steps, jumps = self._cycle(self.mixture.wide)
        return replace(
            self.sampler,
            components=self.mixture.quadratics,
            weights=tuple(self.mixture.weights.tolist()),
            bent=tuple(self.mixture.warp.bent.tolist()),
            wide=self.mixture.wide,
            local_steps=steps,
            jumps=jumps,
            local=local,
            adapt=False,
        )

    def state(self) -> Tree:
        """Return the state of the tuner as plain data."""
        return {
            "done": self.done,
            "drawn": self.drawn._asdict(),
            "visited": self.visited._asdict(),
            "walked": self.walked._asdict(),
            "accepted": self.accepted,
            "jumped": self.jumped,
            "switched": self.switched,
            "first": self.first,
            "walk": list(self.walk),
            "is_bent": int(self.is_bent),
            "has_tried": int(self.has_tried),
            "stages": {str(k): stage.arrays() for k, stage in enumerate(self.stages)},
            "counts": list(self.counts),
            "covariance": self.covariance,
            "local": None if self.local is None else self.local.state(),
        }

    def restore(self, state: Tree) -> None:
        """Take over what another tuner had learnt."""
        self.done, self.first = state["done"], int(state["first"])
        self.walk = int(state["walk"][0]), float(state["walk"][1])
        self.is_bent, self.has_tried = bool(state["is_bent"]), bool(state["has_tried"])
        self.drawn, self.visited = Evaluated(**state["drawn"]), Evaluated(**state["visited"])
        self.walked, self.switched = Evaluated(**state["walked"]), int(state["switched"])
        self.accepted, self.jumped = np.array(state["accepted"]), int(state["jumped"])
        self.counts = [int(n) for n in state["counts"]]
        lower, upper = self.density.lower, self.density.upper
        stages = state["stages"]
        self.stages = [
            CurvedMixture.of_arrays(one) if "bends" in one else Mixture.of_arrays(one, lower, upper)
            for one in (stages[str(k)] for k in range(len(stages)))
        ]
        if self.stages:
            self._take_covariance(state["covariance"])
            if self.switched >= 0:
                self._prefer_local()
        if self.local is not None:
            self.local.restore(state["local"])
        self._take_kernel()

    def _begin_with(self, mixture: Mixture | CurvedMixture) -> None:
        """Take the first mixture, and local steps of its shape."""
        self._take(mixture)
        self._take_covariance(mixture.covariance_within(np.random.default_rng(0), _SAMPLE))

    def _fit_to_draws(self) -> None:
        """Take the first mixture, fitted to the local steps' draws."""
        self._begin_with(self._fitted_to(self.visited))

    def _fitted_to(self, draws: Evaluated) -> Mixture:
        """Return a mixture fitted to the later half of the local steps' draws, each group of chains by itself."""
        u, log_prob, slope = (one.reshape(-1, self.chains, *one.shape[1:]) for one in draws)
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
        return fitted_mixture(points, Mixture(each, np.sum(members, axis=1), warp))

    def _fit(self, state: State) -> IntArray | None:
        """Fit the mixture to all candidates so far, weighted over all mixtures so far (Cornuet et al. 2012).

        Maxima that it does not know are looked for before, since their candidates would spoil the fit, and after,
        since a fit may lose one. Return the evaluations of each chain that this took.
        """
        assert self.mixture is not None
        if isinstance(self.mixture, CurvedMixture):
            return None
        u, log_prob, _ = self.drawn
        known = np.isfinite(log_prob)
        u, log_prob = u[known], log_prob[known]
        if not len(u):
            return None
        n = len(u)
        seen_u = np.concatenate([u, state.position, self.visited.position])
        seen_log_prob = np.concatenate([log_prob, state.log_prob, self.visited.log_prob])
        seen = Seen(seen_u, seen_log_prob, self._log_density_so_far(seen_u), n, self.chains)
        new, spent = self._unknown_maxima(self.mixture, seen)
        old = _with_found(self.mixture, new).responsibilities(u)[: len(self.mixture.quadratics)].sum(axis=0) > 0.5
        mixture = self.mixture
        if np.count_nonzero(old) > n_coefficients(self.density.ndim):
            with suppress(np.linalg.LinAlgError):  # go on with the mixture that there is
                mixture = refitted_mixture(Points.weighted(u[old], log_prob[old], seen.log_q[:n][old]), mixture)
        mixture = _with_found(mixture, new)
        if len(self.walked.log_prob) > _ENOUGH_JUMPS * self.chains:
            with suppress(np.linalg.LinAlgError):
                mixture = self._better_of(self._fitted_to(self.walked), mixture)
        if mixture is not self.mixture:
            lost, more = self._unknown_maxima(mixture, seen)
            mixture = _with_found(mixture, lost)
            spent += more
        if self.done == self.steps:
            mixture = self._at_last(mixture, Points.weighted(u, log_prob, seen.log_q[:n]))
        if mixture is not self.mixture:
            self._take(mixture)
        return spent

    def _better_of(self, one: Mixture, other: Mixture) -> Mixture:
        """Return the mixture from which the draws of local steps would come with the larger effective share."""
        u, log_prob, _ = self.walked
        points = Points(u, log_prob, np.ones(len(u)))
        shares = [np.nan_to_num(points.effective_share(mixture.log_density(u))) for mixture in (one, other)]
        return one if shares[0] > shares[1] else other

    @property
    def _has_walked(self) -> bool:
        """Whether local steps have shown a density on which they are long; on others they may go on."""
        return self.walk[0] >= _LEAST_WALK and self.walk[1] >= _WALK_SOLVES

    def _choose_steps(self, state: State) -> IntArray | None:
        """Let local steps prevail where some chain rarely accepts a candidate, until all accept them often.

        Where most chains rarely do, learn a curved mixture, if their draws are there already. Return the
        evaluations that this took.
        """
        if self.jumped < _ENOUGH_JUMPS or self.sampler.local_steps >= self.sampler.jumps_with(WIDE):
            return None
        rates = self.accepted / self.jumped
        self.is_bent = bool(np.median(rates) < _RARE) or self._is_infinite()
        if self.switched < 0 and self.is_bent and self._can_learn:
            return self._learn_curved(state)
        if self.switched < 0 and (rates.min() < _RARE or self.is_bent):
            self._switch()
        elif self.switched >= 0 and rates.min() > _OFTEN:
            self.switched = -1
        return None

    def _switch(self) -> None:
        """Let local steps prevail from now on."""
        self.switched, self.walk = self.done, (0, 0.0)
        self._prefer_local()

    @property
    def _can_learn(self) -> bool:
        """Whether there are local draws enough from which to learn a curved mixture, for the first time."""
        draws = self.walked if self.switched >= 0 else self.visited
        return not self.has_tried and len(draws.log_prob) >= _LEAST_WALK * self.chains

    def _is_infinite(self) -> bool:
        """Say whether the density is infinite at a wall, by the candidates so far; no Gaussian is."""
        if isinstance(self.mixture, CurvedMixture):
            return False
        u, log_prob, _ = self.drawn
        known = np.isfinite(log_prob)
        if not known.any():
            return False
        points = Points.weighted(u[known], log_prob[known], self._log_density_so_far(u[known]))
        shapes = infinite_margins(points.position, points.weight, self.density.lower, self.density.upper)
        return bool(np.isfinite(shapes).any())

    def _learn_curved(self, state: State) -> IntArray:
        """Learn a curved mixture from where local steps were; return the evaluations that this took.

        If its candidates are rarely accepted as well, local steps prevail.
        """
        self.has_tried = True
        draws = self.walked if self.switched >= 0 else self.visited
        later = draws.position[len(draws.position) // 3 :]
        rng = np.random.default_rng(state.position.view(np.uint64).ravel())  # another one for another seed
        most = _CANDIDATES * self.steps * self.chains
        mixture, efficiency, n_solves = learnt_in_rounds(self.target, later, rng, most)
        if mixture is not None and efficiency >= _WORTH:
            self.switched = -1
            self._begin_with(mixture)
        elif self.switched < 0:
            self._switch()
        spent = np.full(self.chains, n_solves // self.chains)
        spent[: n_solves % self.chains] += 1
        return spent

    def _prefer_local(self) -> None:
        """Begin local steps that learn their metric from their draws; from the mixture where they are too few."""
        steps = (self.steps - self.switched) * _LOCAL_STEPS // (_LOCAL_STEPS + 1)
        if steps >= _ENOUGH_STEPS:
            self.local_settings = self.sampler.local_of(self.density)
            self.local = self.local_settings.tuner(self.density, self.chains, steps)

    def _cycle(self, wide: float) -> tuple[int, int]:
        """Return so many local steps, then so many candidates."""
        if self.switched >= 0:
            return _LOCAL_STEPS, 1
        if isinstance(self.mixture, CurvedMixture):
            return _CURVED_CYCLE
        return self.sampler.local_steps, self.sampler.jumps_with(wide)

    def _at_last(self, mixture: Mixture, points: Points) -> Mixture:
        """Return the mixture with the share of wider copies that was asked for; if none, less where it is good."""
        if self.sampler.wide is not None:
            return mixture.with_wide(self.sampler.wide)
        less = mixture.with_wide(LESS_WIDE)
        return less if points.effective_share(less.log_density(points.position)) >= GOOD else mixture

    def _unknown_maxima(self, mixture: Mixture, seen: Seen) -> tuple[list[Found], IntArray]:
        """Return the maxima that a mixture does not know, and evaluations of each chain.

        They are climbed to from where chains are, candidates, or where chains were before the first fit, if log w
        is above its median there, and a valley lies between the point and the component that accounts for it. A
        chain at a low maximum without a component would hardly leave it. The others must be as high as the draws,
        and log w above its median for the candidates of all mixtures so far, too: a maximum that those showed to
        be slight is not climbed to again.
        """
        u, log_prob, log_q, n, _ = seen
        is_chain = seen.is_chain
        log_w, of_all = log_prob - mixture.log_density(u), log_prob - log_q
        usual = float(np.median(log_w[:n]))
        is_low = log_prob < np.median(log_prob[is_chain]) - _FAR - self.density.ndim
        known = ~is_chain & (is_low | (of_all <= np.median(of_all[:n]) + _UNKNOWN))
        found = list[Found]()
        spent = np.zeros(self.chains, dtype=np.int64)
        for check in range(_CHECKED):
            unknown = ~known & (log_w > usual + _UNKNOWN)
            if not unknown.any() or len(mixture.quadratics) >= MOST:
                break
            first = unknown & is_chain if np.any(unknown & is_chain) else unknown
            at = int(np.argmax(np.where(first, log_w, -np.inf)))
            owner = mixture.quadratics[int(np.argmax(mixture.responsibilities(u[at : at + 1])[:, 0]))]
            begin, end = owner.position, mixture.warp.to_x(u[at])
            evaluate = _Counted(self.target)
            between = evaluate(mixture.warp.to_u(begin + _BETWEEN[:, None] * (end - begin)))
            known[at] = True
            if np.min(between) < min(between[0], log_prob[at]) - _VALLEY:
                away = mixture.warp.stretch(u[at])
                summit = climbed(evaluate, u[at], owner.hessian / np.outer(away, away))
                if summit.log_prob - mixture.log_density(summit.position[None])[0] > usual + _UNKNOWN:
                    log_mass = summit.log_prob - 0.5 * np.linalg.slogdet(summit.hessian / (2.0 * np.pi))[1]
                    found.append(Found(summit, float(np.exp(np.clip(log_mass - usual, _LOWEST, 0.0)))))
                    mixture = _with_found(mixture, found[-1:])
                    log_w = log_prob - mixture.log_density(u)
            spent[check % self.chains] += evaluate.n_solves
        return found, spent

    def _log_density_so_far(self, u: FloatArray) -> FloatArray:
        """Return the logarithm of the density of all candidates so far at points u (n, ndim), up to a constant."""
        of_stages = [
            np.log(n) + stage.log_density(u) for stage, n in zip(self.stages, self.counts, strict=True) if n
        ]
        return np.asarray(logsumexp(of_stages, axis=0))

    def _take(self, mixture: Mixture | CurvedMixture) -> None:
        self.stages.append(mixture)
        self.counts.append(0)

    def _take_covariance(self, covariance: FloatArray) -> None:
        self.covariance = covariance
        cycle = self.sampler.local_steps + self.sampler.jumps_with(WIDE)
        remaining = max((self.steps - self.first) * self.sampler.local_steps // cycle, 1)
        local = self.sampler.local_of(self.density)
        if isinstance(self.mixture, CurvedMixture) and self.sampler.local is None:
            local = Slice()  # the gradients of such a density say little of what is a standard deviation away
        self.local_settings = shaped(local, covariance)
        self.local = self.local_settings.tuner(self.density, self.chains, remaining)

    def _take_kernel(self) -> None:
        local = self.local_settings.bind(self.density) if self.local is None else self.local.kernel
        steps, jumps = self._cycle(WIDE)
        self.kernel = MixtureKernel(self.target, self.mixture, local, steps, jumps, len(self.stages), gathers=True)


def _sum(one: IntArray | None, other: IntArray | None) -> IntArray | None:
    """Return the sum of two numbers of evaluations, either of which may be none."""
    if one is None or other is None:
        return other if one is None else one
    return one + other


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


class Seen(NamedTuple):
    """Points at which a fit looks: candidates, where the chains are, and where they were before the first fit.

    Attributes
    ----------
    position : ndarray, shape (n, ndim)
    log_prob : ndarray, shape (n,)
    log_q : ndarray, shape (n,)
        Logarithm of the density of all candidates so far, up to a constant.
    candidates, chains : int
    """

    position: FloatArray
    log_prob: FloatArray
    log_q: FloatArray
    candidates: int
    chains: int

    @property
    def is_chain(self) -> BoolArray:
        """Which points are those of the chains, shape (n,)."""
        k = np.arange(len(self.position)) - self.candidates
        return np.asarray((k >= 0) & (k < self.chains))


class _Counted:
    """A target's log-density, with the solves counted."""

    def __init__(self, target: Target) -> None:
        self.target, self.n_solves = target, 0

    def __call__(self, u: FloatArray) -> FloatArray:
        """Return the log-density at points u (n, ndim), -inf outside the box."""
        found = self.target.evaluate(u)
        self.n_solves += int(found.n_solves.sum())
        return found.log_prob


class Found(NamedTuple):
    """A maximum: the log-density around it, not warped, and its mass over that of the mixture."""

    quadratic: Quadratic
    mass: float


def _with_found(mixture: Mixture, found: Sequence[Found]) -> Mixture:
    """Return the mixture with a component at each maximum; later fits correct its weight and shape."""
    if not found:
        return mixture
    new = [mixture.warp.quadratic(one.quadratic) for one in found]
    return Mixture(
        [*mixture.quadratics, *new], np.append(mixture.weights, [one.mass for one in found]), mixture.warp
    )


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


def first_warp(density: LogDensity) -> Warp:
    """Return the warp before anything is learnt: coordinates with a lower bound alone are bent."""
    bent = np.isfinite(density.lower) & ~np.isfinite(density.upper)
    return Warp(density.lower, density.upper, bent)
