"""What one run of one sampler gave, and the figures that are drawn from it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fmu.analysis.convergence.effective import ess_bulk, mcse_mean, rhat
from fmu.types import FloatArray


@dataclass(frozen=True)
class Length:
    """Steps of warm-up and steps kept."""

    warmup: int
    draws: int


@dataclass(frozen=True)
class Cost:
    """Processor seconds, seconds on the wall, and evaluations inside the bounds."""

    cpu_s: float
    wall_s: float
    evaluations: int

    def __add__(self, other: Cost) -> Cost:
        """Return both together."""
        return Cost(self.cpu_s + other.cpu_s, self.wall_s + other.wall_s, self.evaluations + other.evaluations)

    def share(self, fraction: float) -> Cost:
        """Return a fraction of it."""
        return Cost(fraction * self.cpu_s, fraction * self.wall_s, round(fraction * self.evaluations))


@dataclass(frozen=True)
class Outcome:
    """Draws of one run and their cost.

    Attributes
    ----------
    position : ndarray, shape (chains, draws, ndim), SI units
        Of an ensemble the draws are steps × walkers, step-major.
    warmup, draws : Cost
    walkers : int
    divergences : int or None
    """

    position: FloatArray
    warmup: Cost
    draws: Cost
    walkers: int = 1
    divergences: int | None = None

    def at(self, seconds: float) -> Outcome:
        """Return the same draws had an evaluation taken so many seconds, and nothing else any time."""
        warmup, draws = (
            Cost(cost.evaluations * seconds, cost.evaluations * seconds, cost.evaluations)
            for cost in (self.warmup, self.draws)
        )
        return replace(self, warmup=warmup, draws=draws)

    def figures(self) -> Figures:
        """Return the figures of this run."""
        columns = np.moveaxis(self.position, 2, 0)
        return Figures(
            ess=float(np.min([ess_bulk(x, self.walkers) for x in columns])),
            rhat=float(np.max([rhat(x) for x in columns])),
            warmup=self.warmup,
            draws=self.draws,
            divergences=self.divergences,
            mean=[float(x.mean()) for x in columns],
            mcse=[mcse_mean(x, self.walkers) for x in columns],
        )


@dataclass(frozen=True)
class Figures:
    """Smallest bulk ESS and largest R-hat over the parameters, costs, and posterior means with their MCSE."""

    ess: float
    rhat: float
    warmup: Cost
    draws: Cost
    divergences: int | None = None
    mean: list[float] = field(default_factory=list)
    mcse: list[float] = field(default_factory=list)

    def per_evaluation(self, warmup_in: bool) -> float:
        """Return ESS per gradient or log-probability."""
        return self.ess / self._cost(warmup_in).evaluations

    def per_second(self, warmup_in: bool) -> float:
        """Return ESS per processor second."""
        return self.ess / self._cost(warmup_in).cpu_s

    def _cost(self, warmup_in: bool) -> Cost:
        return self.warmup + self.draws if warmup_in else self.draws


class Stopwatch:
    """Processor and wall time since it was last read."""

    def __init__(self) -> None:
        self._last = self._now()

    def read(self, evaluations: int = 0) -> Cost:
        """Return the time since the last reading."""
        now = self._now()
        cpu, wall = (after - before for after, before in zip(now, self._last, strict=True))
        self._last = now
        return Cost(cpu, wall, evaluations)

    @staticmethod
    def _now() -> tuple[float, float]:
        return time.process_time(), time.perf_counter()


class Counted:
    """A function that counts its calls."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.calls = 0

    def __call__(self, *arguments: Any) -> Any:
        """Count, and pass on."""
        self.calls += 1
        return self.function(*arguments)


def per_call(run: Callable[[], object], repeats: int = 5) -> float:
    """Return processor seconds a call of `run`, the median of a few."""
    run()
    times = []
    for _ in range(repeats):
        stopwatch = Stopwatch()
        run()
        times.append(stopwatch.read().cpu_s)
    return float(np.median(times))
