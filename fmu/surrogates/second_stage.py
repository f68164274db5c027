"""The second stage of delayed acceptance, in which the model accepts or rejects a surrogate's proposals."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import logsumexp

from fmu.analysis.convergence.diagnostics import summary
from fmu.analysis.convergence.remedies import fewest
from fmu.analysis.maxima.missed import nearest_maxima
from fmu.analysis.maxima.results import Maxima
from fmu.analysis.trace.provenance import canonical_json
from fmu.analysis.trace.reading import check_trace, parameter_draws, walkers_of
from fmu.numbers import significant, whole
from fmu.progress.phases import Phase
from fmu.samplers.loop.record import Draws, RunResult
from fmu.types import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem

_APART = 2.0
"""Smallest spacing of the proposals in autocorrelation times; an autoregression then has a correlation of e⁻⁴."""
_FEWEST = 4
"""Smallest number of proposals in a chain; ArviZ gives no diagnostics for fewer draws."""
_TURNS = 4
"""Number of solves per worker between two progress reports."""
_STREAM = 22


def independence_chain(log_weight: FloatArray, rng: np.random.Generator) -> tuple[IntArray, int]:
    """Return the states of an independence sampler, as indices of its proposals.

    Parameters
    ----------
    log_weight : ndarray, shape (n,)
        Values of log p − log p̂ at the proposals, where p is the density to be sampled and p̂ the density from
        which the proposals are drawn; −inf where p = 0. At least one value is finite.
    rng : Generator
        Each step takes the same random number, whatever the number of proposals.

    Returns
    -------
    path : ndarray of int, shape (n,)
        Index of the proposal that is the state after each step.
    start : int
        Index of the proposal at which the chain starts.
    """
    weight = np.exp(log_weight - np.max(log_weight))
    cumulative = np.cumsum(weight)
    start = int(np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right"))
    path, at = np.empty(len(weight), dtype=np.int64), start
    for j, u in enumerate(rng.random(len(weight))):
        if u * weight[at] < weight[j]:  # with probability min(1, w(θ′)/w(θ))
            at = j
        path[j] = at
    return path, start


class SecondStage:
    """Proposals of all chains, (chains, n, ndim), and the model's log-probabilities at those already solved.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with a surrogate.
    trace : xarray.DataTree
        Draws from the surrogate's posterior.

    Raises
    ------
    ValueError
        If the problem has no surrogate, or `trace` is not the result of a run, belongs to another problem, or has
        too few effective draws.
    """

    def __init__(self, problem: UpdatingProblem, trace: xr.DataTree) -> None:
        check_trace(trace)
        model: Any = problem.model
        if not model.is_uncertain:
            raise ValueError(f"problem: must have a surrogate, from fmu.surrogate (got {model!r})")
        configuration = json.loads(str(trace.attrs["configuration"]))["problem"]
        if canonical_json(configuration) != canonical_json(problem.configuration()):
            raise ValueError("trace: must be of the posterior by this surrogate (it is of another problem)")
        draws, walkers, ess = parameter_draws(trace), walkers_of(trace), fewest(summary(trace))
        chains, ndim = len(draws), problem.ndim
        least = 2.0 * _APART * _FEWEST * chains  # as the thinning is up to twice as large as it has to be
        if not ess >= least:
            raise ValueError(
                f"trace: must have an ESS of at least {whole(round(least))} (got {significant(ess, 3)}): sample "
                "the surrogate longer"
            )
        times = max(draws.shape[0] * draws.shape[1] / ess, 1.0 / _APART)
        # a power of two, so that the proposals of a run are among those of a longer run
        self.thinning = 2 ** int(np.ceil(np.log2(_APART * times)))
        self.theta = draws.reshape(chains, -1, walkers, ndim)[:, :: self.thinning].reshape(chains, -1, ndim)
        self.problem, self.truth, self.trace = problem, problem.with_model(model.truth), trace
        # a theta that was proposed before is not solved again
        in_order = self.theta.swapaxes(0, 1).reshape(-1, ndim)
        self._distinct, first, which = np.unique(in_order, axis=0, return_index=True, return_inverse=True)
        self._which = which.reshape(-1, chains).T
        self._is_first = np.isin(np.arange(len(in_order)), first).reshape(-1, chains).T
        self._log_p, self._log_weight = np.full((2, len(self._distinct)), np.nan)
        self._n = 0

    @property
    def log_weight(self) -> FloatArray:
        """The model's log-probability minus the surrogate's at each chain's solved proposals, (chains, n).

        The value is −inf where a solve failed.
        """
        return np.asarray(self._log_weight[self._which[:, : self._n]])

    def solve(self, n: int, workers: int, under_way: Phase) -> None:
        """Solve the model at each chain's first n proposals, except those already solved."""
        chains = len(self.theta)
        rows = -(-_TURNS * workers // chains)
        for first in range(self._n, n, rows):
            self._n = min(first + rows, n)
            part = np.unique(self._which[:, first : self._n])
            new = part[np.isnan(self._log_p[part])]
            if len(new):
                self._log_p[new] = self.truth.log_prob(self._distinct[new])
                self._log_weight[new] = self._log_p[new] - self.problem.log_prob(self._distinct[new])
            if np.isfinite(self.log_weight).any(axis=1).all():
                under_way.said["accept"] = float(np.mean(self._accept_draws(*self._paths())))
            under_way.advance(chains * (self._n - first))

    def result(self, seconds: float) -> RunResult:
        """Return the chains of the second stage as the result of a run that took `seconds` seconds.

        The time of the surrogate's run is added as warm-up. Raise ValueError if all solves of a chain failed.
        """
        path, start = self._paths()
        chain = np.arange(len(path))[:, None]
        stats = {
            "lp": self._log_p[self._which[chain, path]],
            "accepted": self._accept_draws(path, start),
            "n_solves": self._is_first[:, : self._n].astype(np.int64),
            "n_gradients": np.zeros(path.shape, dtype=np.int64),
        }
        attrs = self.trace.attrs
        return RunResult(
            warmup=Draws(self.theta[:, :0], {name: values[:, :0] for name, values in stats.items()}),
            posterior=Draws(self.theta[chain, path], stats),
            sampler=str(attrs["sampler"]),
            settings=json.loads(str(attrs["settings"])) | {"delayed_acceptance_thinning": self.thinning},
            learnt=json.loads(str(attrs["learnt"])),
            seed=int(attrs["seed"]),
            walkers=1,
            draws=self._n,
            warmup_draws=0,
            chains=len(path),
            init="proposals",
            wall_s=float(attrs["wall_s"]) + seconds,
            warmup_wall_s=float(attrs["wall_s"]),
        )

    def maxima(self, known: Maxima) -> Maxima | None:
        """Return the maxima of the surrogate's posterior, corrected with the solves, or None if none is left.

        A maximum's mass is multiplied by the mean weight of the proposals near it, which gives its mass in the
        model's posterior. A maximum moves to the proposal near it with the largest log-probability, if that
        exceeds its own. A maximum without a successful solve near it is removed.
        """
        ids = self._which[:, : self._n].ravel()
        near = nearest_maxima(self._distinct[ids], known)
        found = []
        for k, one in enumerate(known):
            mine = ids[near == k]
            if not np.isfinite(self._log_p[mine]).any():
                continue
            theta = np.vstack([one.theta, self._distinct[mine]])
            log_p = np.append(self.truth.log_prob(one.theta), self._log_p[mine])
            best = int(np.argmax(log_p))
            log_mass = one.log_mass + float(logsumexp(self._log_weight[mine])) - float(np.log(len(mine)))
            hz = self.truth.frequencies(theta[best])
            found.append(
                replace(one, theta=theta[best], log_prob=float(log_p[best]), frequencies=hz, log_mass=log_mass)
            )
        total = logsumexp([one.log_mass for one in found]) if found else 0.0
        found = [replace(one, share=float(np.exp(one.log_mass - total))) for one in found]
        return replace(known, maxima=tuple(sorted(found, key=lambda one: -one.log_prob))) if found else None

    def record(self) -> Mapping[str, int]:
        """Return the trace attributes that count proposals and solves, keyed by name."""
        return {
            "second_stage_proposals": self._which[:, : self._n].size,
            "second_stage_accepted": int(np.sum(self._accept_draws(*self._paths()))),
            "second_stage_failed": int(np.sum(np.isneginf(self.log_weight))),
            "second_stage_solves": int(np.sum(self._is_first[:, : self._n])),
        }

    def _paths(self) -> tuple[IntArray, IntArray]:
        """Return the paths (chains, n) and starting indices (chains,) of `independence_chain` for all chains.

        Raise ValueError if all solves of a chain failed.
        """
        weights, seed = self.log_weight, int(self.trace.attrs["seed"])
        failed = np.flatnonzero(~np.isfinite(weights).any(axis=1))
        if len(failed):
            raise ValueError(
                f"model: must be solved at draws of the surrogate (all {self._n} of chain {failed[0]} failed)"
            )
        seeds = (np.random.SeedSequence(seed, spawn_key=(_STREAM, chain)) for chain in range(len(weights)))
        found = [independence_chain(w, np.random.default_rng(one)) for w, one in zip(weights, seeds, strict=True)]
        return np.array([path for path, _ in found]), np.array([start for _, start in found])

    @staticmethod
    def _accept_draws(path: IntArray, start: IntArray) -> BoolArray:
        return np.diff(path, axis=1, prepend=start[:, None]) != 0
