"""The result of a run of a sampler, and its cost."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from fmu.analysis.convergence.effective import ess_bulk, mcse_mean, rhat
from fmu.types import FloatArray
from tests.benchmarks.peers.posteriors import Target

_VALUES = ("terms", "terms_and_misfit")
_GRADIENTS = ("terms_and_gradient", "quadratic", "residuals_and_slopes", "sensitivity_to_model")


@dataclass(frozen=True)
class Cost:
    """Processor seconds, and evaluations in log-probabilities; a gradient counts by its time."""

    cpu_s: float = 0.0
    evaluations: float = 0.0

    def __add__(self, other: Cost) -> Cost:
        """Return both together."""
        return Cost(self.cpu_s + other.cpu_s, self.evaluations + other.evaluations)

    def share(self, fraction: float) -> Cost:
        """Return a fraction of it."""
        return Cost(fraction * self.cpu_s, fraction * self.evaluations)


NOTHING = Cost()


@dataclass(frozen=True)
class Run:
    """Result and cost of one run.

    Attributes
    ----------
    ess : float
        The smallest bulk ESS of the parameters; for ensembles by the autocorrelation time, for weighted draws by
        Kish's formula. NaN if the run ended before it had draws.
    mean, mcse : list of float
        Posterior means and their standard errors, SI units.
    draws, warmup, search : Cost
    rhat : float
        The largest of the parameters; NaN of weighted draws.
    evidence : (float, float) or None
        Its logarithm and the standard error.
    ended : bool
        Whether the run has finished, instead of reaching its largest number of steps, calls or seconds.
    """

    ess: float
    mean: list[float]
    mcse: list[float]
    draws: Cost
    warmup: Cost = NOTHING
    search: Cost = NOTHING
    rhat: float = np.nan
    evidence: tuple[float, float] | None = None
    ended: bool = True

    @classmethod
    def read(cls, kept: dict[str, Any]) -> Run:
        """Return the run that was kept as a dict."""
        costs = {name: Cost(**kept[name]) for name in ("search", "warmup", "draws")}
        return cls(**{**kept, **costs})

    @classmethod
    def of_chains(cls, position: FloatArray, walkers: int = 1, **other: Any) -> Run:
        """Return the run from its draws (chains, draws, ndim); an ensemble's are steps × walkers, step-major."""
        columns = np.moveaxis(position, 2, 0)
        return cls(
            ess=float(np.min([ess_bulk(x, walkers) for x in columns])),
            mean=[float(x.mean()) for x in columns],
            mcse=[mcse_mean(x, walkers) for x in columns],
            rhat=float(np.max([rhat(x) for x in columns])),
            **other,
        )

    @classmethod
    def of_weights(cls, x: FloatArray, w: FloatArray, **other: Any) -> Run:
        """Return the run from draws x (n, ndim) of weights w (n,): Kish's effective size."""
        w = w / w.sum()
        mean = w @ x
        error = np.sqrt(w**2 @ (x - mean) ** 2)
        return cls(ess=float(1.0 / np.sum(w**2)), mean=mean.tolist(), mcse=error.tolist(), **other)

    @property
    def cost(self) -> Cost:
        """Cost of the whole run."""
        return self.search + self.warmup + self.draws


class BudgetError(Exception):
    """A run has reached its largest number of evaluations or its largest time."""


class Meter:
    """Time and evaluations since it was last read.

    Inside `counting`, all evaluations of the likelihood of a target are counted. Elsewhere the caller adds them to
    `evaluations`.

    Parameters
    ----------
    target : Target
    most_calls, most_s : float
        Limits after which a density that `limit` returns raises `BudgetError`.
    """

    def __init__(self, target: Target, most_calls: float = np.inf, most_s: float = np.inf) -> None:
        self.target = target
        self.evaluations = 0.0
        self._most_calls, self._most_s = most_calls, most_s
        self._began = self._last = time.process_time()
        self._all = 0.0

    def read(self) -> Cost:
        """Return the cost since the last reading."""
        now = time.process_time()
        cost = Cost(now - self._last, self.evaluations)
        self._last, self.evaluations = now, 0.0
        self._all += cost.evaluations
        return cost

    @property
    def is_spent(self) -> bool:
        """Whether a largest number is reached."""
        return (
            self._all + self.evaluations >= self._most_calls or time.process_time() - self._began >= self._most_s
        )

    def limit(self, density: Callable[..., Any]) -> Callable[..., Any]:
        """Return the density, which raises `BudgetError` once a largest number is reached."""

        def limited(*arguments: Any) -> Any:
            if self.is_spent:
                raise BudgetError
            return density(*arguments)

        return limited

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Count all evaluations of the target's kind of likelihood, copies of it included."""
        kind, inside = type(self.target.problem.likelihood), [False]
        costs = dict.fromkeys(_VALUES, 1.0) | dict.fromkeys(_GRADIENTS, self.target.gradient_cost)
        costs = {name: cost for name, cost in costs.items() if hasattr(kind, name)}
        own = {name: vars(kind)[name] for name in costs if name in vars(kind)}
        try:
            for name, cost in costs.items():
                setattr(kind, name, self._counted(getattr(kind, name), cost, inside))
            yield
        finally:
            for name in costs:
                delattr(kind, name)
            for name, method in own.items():
                setattr(kind, name, method)

    def _counted(self, method: Callable[..., Any], cost: float, inside: list[bool]) -> Callable[..., Any]:
        """Return the method, which counts unless another one that counts has called it."""

        @functools.wraps(method)
        def counted(likelihood: Any, theta: FloatArray, *others: Any, **options: Any) -> Any:
            if inside[0]:
                return method(likelihood, theta, *others, **options)
            inside[0] = True
            try:
                self.evaluations += cost * len(theta)
                return method(likelihood, theta, *others, **options)
            finally:
                inside[0] = False

        return counted
