"""The mixture sampler's tuner, which fits the mixture several times during warm-up."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.random import default_rng

from fmu.samplers.kernel import Info, Sampler, State, Target, Tree, Tuner
from fmu.samplers.mixture.curved import CurvedMixture
from fmu.samplers.mixture.importance import sum_densities
from fmu.samplers.mixture.kernel import MixtureKernel
from fmu.samplers.mixture.proposal import GOOD, LESS_WIDE, WIDE, Mixture, Points, refit_mixture
from fmu.samplers.mixture.quadratic import n_coefficients
from fmu.samplers.mixture.warmup import local_draws
from fmu.samplers.mixture.warmup.local_draws import Evaluated, fit_to_draws
from fmu.samplers.mixture.warmup.rounds import ENOUGH, learn_in_rounds
from fmu.samplers.mixture.warmup.unknown_maxima import Seen, add_maxima, find_unknown_maxima
from fmu.samplers.slice import Slice
from fmu.types import FloatArray, IntArray, LogDensity

_LOCAL_PART = 0.5
"""Largest fraction of the warm-up that consists of local steps if no components are given."""
_FITS = (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Fractions of the rest of the warm-up after which the mixture is fitted again."""
_SAMPLE = 1000  # draws of a mixture that give its covariance
_POOR, _JUDGED = 1, 3
"""Index of the fit after which a poor component gives way to local steps, and of the first fit after which the
acceptance rate of candidates decides whether local steps prevail."""
_RARE, _OFTEN, _FAIR = 0.1, 0.3, 0.65
"""Acceptance rate of candidates in the worst chain below which most steps become local, and above which most steps
are candidates again; and below which a single given component is poor. A local step gives an ESS of about 0.05 per
evaluation."""
_LOCAL_STEPS = 3
"""Local steps per candidate if candidates are rarely accepted."""
_ENOUGH_JUMPS, _ENOUGH_STEPS = 20, 100
"""Number of candidates per chain needed to estimate an acceptance rate, and number of local steps needed to learn
a metric from them."""
_LEAST_WALK, _WALK_SOLVES = 50, 1000
"""Numbers of local steps and of evaluations per chain that are needed to show the density roughly."""
_CANDIDATES = 5
"""Largest number of candidates for fitting a curved mixture, per warm-up step and chain."""
_WORTH = 0.02
"""Efficiency (ESS per candidate) of a curved mixture below which local steps are more efficient."""
_CURVED_CYCLE = 1, 79
"""Numbers of local steps and of candidates in each cycle, for a curved mixture."""
_NO_STAGE = -1  # of local steps that are adapted to no mixture, while none is in use


class MixtureTuner:
    """Tuner that repeatedly refits the mixture to all candidates drawn so far.

    The candidates are importance-weighted by the combined density of all mixtures that proposed them (AMIS,
    Cornuet et al. 2012). If no components are given, up to half of the warm-up consists of local steps, and the
    first mixture is fitted to their draws. If a chain or a candidate has found a maximum that the mixture misses,
    a component is added there. Local steps are adapted to the covariance and the coordinates of the first fit, and
    again if a later fit transforms other coordinates.

    If a single given component is still poor after the second fit, and gradients are exact, local steps follow,
    which begin with its curvature as their metric.

    If some chain still rarely accepts candidates after the first fits, most steps become local. Local steps are
    then tuned to their own draws if enough steps remain. Later fits also use these draws. Candidates take over
    again once they are often accepted.

    If most chains rarely accept candidates, or the density is infinite at a bound or has heavy tails, a
    `CurvedMixture` is fitted in rounds, once there are enough local draws. It is used if it is efficient enough.
    If at least half of all steps are local by choice, neither local steps nor a curved mixture take over.

    Parameters
    ----------
    sampler : MixtureSampler
        Settings to complete.
    density : LogDensity
    chains, steps : int
        Numbers of chains and of warm-up steps.
    """

    def __init__(self, sampler: Any, density: LogDensity, chains: int, steps: int) -> None:
        self.sampler, self.density, self.chains, self.steps = sampler, density, chains, steps
        self.done = 0
        self.first = 0 if sampler.components is not None else max(int(_LOCAL_PART * steps), 1)
        self.target = Target(density)
        self.stages: list[Mixture | CurvedMixture] = []  # mixture of each fit; the last one is in use, if any is
        self.counts: list[int] = []  # evaluated candidates of each mixture
        self.drawn = self.visited = self.walked = Evaluated.none(density.ndim)  # walked: if local steps prevail
        self.accepted, self.jumped = np.zeros(chains), 0  # sums over candidates since the last fit
        self.switched = -1  # step at which local steps began to prevail; -1 if they do not
        self.walk = 0, 0.0  # local steps without a mixture or while they prevail, and their solves per chain
        self.is_bent = self.has_tried = False  # a curved mixture is needed; a fit of one was tried
        self.local: Tuner | None = None
        given = sampler.mixture(density)
        if given is None:
            self._adapt_local(_NO_STAGE, self.first)
        else:
            self._begin_with(given)
        self._take_kernel()

    @property
    def mixture(self) -> Mixture | CurvedMixture | None:
        """The mixture in use; None before the first fit, and while local steps replace a poor component."""
        return None if self.adapted[0] == _NO_STAGE else self.stages[-1]

    @property
    def gaussians(self) -> Mixture | None:
        """The current mixture if further fits can refine it. None if it is curved, or before the first fit."""
        return None if self.mixture is None else self.mixture.gaussians

    @property
    def fit_at(self) -> list[int]:
        """Step counts at which the mixture is refitted."""
        return [self.first + int(part * (self.steps - self.first)) for part in _FITS]

    def update(self, state: State, info: Info) -> IntArray | None:
        """Learn from one more warm-up step.

        Return the number of evaluations that the learning took, shape (chains,), or None if it took none.
        """
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
            if self.done == self.fit_at[_POOR] and self._fits_poorly:
                self.first, self.walk = self.done + int(_LOCAL_PART * (self.steps - self.done)), (0, 0.0)
                self._adapt_local(_NO_STAGE, self.first - self.done)
            elif self.done >= self.fit_at[_JUDGED]:
                more = self._choose_steps(state)
                spent = more if spent is None else spent if more is None else spent + more
            self.accepted, self.jumped = np.zeros(self.chains), 0
        elif self.switched >= 0 and self.is_bent and self._has_walked and self._can_learn:
            spent = self._learn_curved(state)
        self._take_kernel()
        return spent

    def finish_learning(self) -> Sampler:
        """Return the sampler settings with the fitted mixture and the tuned local steps."""
        if self.mixture is None:
            self._fit_to_draws()
        assert self.mixture is not None
        local = self.local_settings if self.local is None else self.local.finish_learning()
        steps, jumps = self._cycle(self.mixture.wide)
        learnt = self.mixture.settings()
        return replace(self.sampler, **learnt, local_steps=steps, jumps=jumps, local=local, adapt=False)

    def state(self) -> Tree:
        """Return the tuner's state as plain data."""
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
            "adapted": list(self.adapted),
            "local": None if self.local is None else self.local.state(),
        }

    def restore(self, state: Tree) -> None:
        """Restore the state that another tuner's `state` returned."""
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
        self._adapt_local(*map(int, state["adapted"]))
        if self.switched >= 0:
            self._prefer_local()
        if self.local is not None:
            self.local.restore(state["local"])
        self._take_kernel()

    def _begin_with(self, mixture: Mixture | CurvedMixture) -> None:
        """Make `mixture` the current mixture and adapt the local steps to its covariance."""
        self._take(mixture)
        self._adapt_local(len(self.stages) - 1, self.steps - self.first)

    def _fit_to_draws(self) -> None:
        """Fit the first mixture to the draws of local steps and make it the current mixture."""
        self._begin_with(fit_to_draws(self.visited, self.chains, self.density, self.sampler.wide or WIDE))

    def _fit(self, state: State) -> IntArray | None:
        """Fit the mixture to all candidates so far, importance-weighted by the combined density of all mixtures.

        Missed maxima are searched for before the fit, because candidates near them would spoil it, and again after
        it, because a fit may lose a maximum. Return the number of evaluations that this took, shape (chains,), or
        None if the mixture is curved or no candidate has a finite log-density. See Cornuet et al. 2012.
        """
        u, log_prob, _ = self.drawn
        known = np.isfinite(log_prob)
        u, log_prob = u[known], log_prob[known]
        n, mixture = len(u), self.gaussians
        if mixture is None or not n:
            return None
        bent = mixture.warp.bent
        seen_u = np.concatenate([u, state.position, self.visited.position])
        seen_log_prob = np.concatenate([log_prob, state.log_prob, self.visited.log_prob])
        seen = Seen(seen_u, seen_log_prob, self._log_density_so_far(seen_u), n, self.chains)
        new, spent = find_unknown_maxima(mixture, seen, self.target)
        old = add_maxima(mixture, new).responsibilities(u)[: len(mixture.quadratics)].sum(axis=0) > 0.5
        if np.count_nonzero(old) > n_coefficients(self.density.ndim):
            with suppress(np.linalg.LinAlgError):  # continue with the present mixture
                points = Points.weigh_draws(u[old], log_prob[old], seen.log_q[:n][old])
                mixture = refit_mixture(points, mixture, is_known=self.sampler.bent is not None)
        mixture = add_maxima(mixture, new)
        if len(self.walked.log_prob) > _ENOUGH_JUMPS * self.chains:
            with suppress(np.linalg.LinAlgError):
                walked = fit_to_draws(self.walked, self.chains, self.density, self.sampler.wide or WIDE)
                mixture = local_draws.better_of(walked, mixture, self.walked)
        if mixture is not self.mixture:
            lost, more = find_unknown_maxima(mixture, seen, self.target)
            mixture = add_maxima(mixture, lost)
            spent += more
        if self.done == self.steps:
            mixture = self._at_last(mixture, Points.weigh_draws(u, log_prob, seen.log_q[:n]))
        if mixture is not self.mixture:
            self._take(mixture)
            if self.switched < 0 and not np.array_equal(mixture.warp.bent, bent):
                self._adapt_local(len(self.stages) - 1, self.steps - self.done)
        return spent

    @property
    def _fits_poorly(self) -> bool:
        """Whether a single given component without `bent` is clearly poor, and local gradients are exact."""
        mixture, is_first = self.gaussians, not len(self.visited.log_prob)
        if mixture is None or len(mixture.quadratics) > 1 or self.sampler.bent is not None or not is_first:
            return False
        is_exact = self.local_settings.gradient == "exact" and self.target.solves_per_gradient == 1
        return is_exact and not self._is_unclear and bool((self.accepted / self.jumped).min() < _FAIR)

    @property
    def _is_unclear(self) -> bool:
        """Whether there were too few candidates since the last fit, or half of the steps are local by choice."""
        return self.jumped < _ENOUGH_JUMPS or self.sampler.local_steps >= self.sampler.jumps_with(WIDE)

    @property
    def _has_walked(self) -> bool:
        """Whether there were enough local steps and evaluations to show roughly where the density is high."""
        return self.walk[0] >= _LEAST_WALK and self.walk[1] >= _WALK_SOLVES

    def _choose_steps(self, state: State) -> IntArray | None:
        """Make most steps local if some chain rarely accepts candidates, until all chains often accept them.

        Fit a curved mixture instead if most chains rarely accept candidates, or if the density is infinite at a
        bound or has heavy tails. If it cannot be fitted, most steps also become local if the density is infinite
        at a bound. Do nothing if there were too few candidates since the last fit, or at least half of the steps
        are local by choice. Return the number of evaluations, shape (chains,), or None if there were none.
        """
        if self._is_unclear:
            return None
        rates = self.accepted / self.jumped
        points = self._weighted_candidates()
        self.is_bent = bool(np.median(rates) < _RARE) or local_draws.is_infinite(points, self.density)
        if (
            self.switched < 0
            and self._can_learn
            and (self.is_bent or local_draws.has_heavy_tails(points, self.gaussians, self.visited, self.chains))
        ):
            return self._learn_curved(state)
        if self.switched < 0 and (rates.min() < _RARE or self.is_bent):
            self._switch()
        elif self.switched >= 0 and rates.min() > _OFTEN:
            self.switched = -1
        return None

    def _switch(self) -> None:
        """Make most steps local from now on."""
        self.switched, self.walk = self.done, (0, 0.0)
        self._prefer_local()

    @property
    def _can_learn(self) -> bool:
        """Whether there are enough local draws to fit a curved mixture, and no such fit has been tried yet."""
        draws = self.walked if self.switched >= 0 else self.visited
        return not self.has_tried and len(draws.log_prob) >= _LEAST_WALK * self.chains

    def _weighted_candidates(self) -> Points | None:
        """Return the weighted candidates, or None if there are none, the mixture is curved or `bent` is given."""
        u, log_prob, _ = self.drawn
        known = np.isfinite(log_prob)
        if self.gaussians is None or self.sampler.bent is not None or not known.any():
            return None
        return Points.weigh_draws(u[known], log_prob[known], self._log_density_so_far(u[known]))

    def _learn_curved(self, state: State) -> IntArray:
        """Fit a curved mixture in rounds, starting from the draws of local steps, and use it if it is efficient.

        Otherwise make most steps local if the density needs a curved mixture. Return the number of evaluations
        that this took, shape (chains,).
        """
        self.has_tried = True
        draws = self.walked if self.switched >= 0 else self.visited
        later = draws.position[len(draws.position) // 3 :]
        rng = default_rng(state.position.view(np.uint64).ravel())  # depends on the seed of the run
        most = _CANDIDATES * self.steps * self.chains
        mixture, efficiency, n_solves = learn_in_rounds(self.target, later, rng, most)
        if mixture is not None and efficiency >= (_WORTH if self.is_bent else ENOUGH):
            self.switched = -1
            self._begin_with(mixture)
        elif self.switched < 0 and self.is_bent:
            self._switch()
        spent = np.full(self.chains, n_solves // self.chains)
        spent[: n_solves % self.chains] += 1
        return spent

    def _prefer_local(self) -> None:
        """Tune local steps to their own draws, or leave them adapted to the mixture if too few steps remain."""
        steps = (self.steps - self.switched) * _LOCAL_STEPS // (_LOCAL_STEPS + 1)
        if steps >= _ENOUGH_STEPS:
            self.local_settings = self.sampler.local_alone(self.density)
            self.local = self.local_settings.tuner(self.density, self.chains, steps)

    def _cycle(self, wide: float) -> tuple[int, int]:
        """Return the numbers of local steps and of candidates per cycle."""
        if self.switched >= 0:
            return _LOCAL_STEPS, 1
        if self.gaussians is None:
            return _CURVED_CYCLE
        return self.sampler.local_steps, self.sampler.jumps_with(wide)

    def _at_last(self, mixture: Mixture, points: Points) -> Mixture:
        """Return the mixture with the final fraction of the weight for its wider copies.

        The fraction becomes `LESS_WIDE`, unless the setting `wide` is given or the fit would not be good with it.
        """
        if self.sampler.wide is not None:
            return mixture
        less = mixture.with_wide(LESS_WIDE)
        return less if points.effective_share(less.log_density(points.position)) >= GOOD else mixture

    def _log_density_so_far(self, u: FloatArray) -> FloatArray:
        """Return the combined log-density of all mixtures at points (n, ndim), shape (n,), up to a constant."""
        of_stages = [stage.log_density(u) for stage, n in zip(self.stages, self.counts, strict=True) if n]
        return sum_densities(of_stages, [n for n in self.counts if n])

    def _take(self, mixture: Mixture | CurvedMixture) -> None:
        self.stages.append(mixture)
        self.counts.append(0)

    def _adapt_local(self, stage: int, steps: int) -> None:
        """Start tuning local steps, adapted to the mixture of a stage, with `steps` remaining steps of warm-up.

        For `_NO_STAGE`, they are adapted to no mixture, and all of these steps are local.
        """
        self.adapted = stage, steps
        if stage == _NO_STAGE:
            self.local_settings = self.sampler.local_alone(self.density)
            self.local = self.local_settings.tuner(self.density, self.chains, steps)
            return
        mixture, local = self.stages[stage], self.sampler.local_of(self.density)
        if mixture.gaussians is None and self.sampler.local is None:
            local = Slice()  # gradients of such a density are not informative at a standard deviation's distance
        warp = None if mixture.gaussians is None else mixture.gaussians.warp
        bent = None if warp is None else local.take_warp(warp)
        covariance = mixture.covariance_within(default_rng(0), _SAMPLE, warp if bent else None)
        self.local_settings = (bent or local).take_covariance(covariance)
        cycle = self.sampler.local_steps + self.sampler.jumps_with(WIDE)
        of_local = max(steps * self.sampler.local_steps // cycle, 1)
        self.local = self.local_settings.tuner(self.density, self.chains, of_local)

    def _take_kernel(self) -> None:
        local = self.local_settings.bind(self.density) if self.local is None else self.local.kernel
        steps, jumps = self._cycle(WIDE)
        self.kernel = MixtureKernel(self.target, self.mixture, local, steps, jumps, len(self.stages), gathers=True)
