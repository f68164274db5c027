"""fmu's samplers with their default settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fmu.analysis.estimate import gradient_cost
from fmu.samplers import make_sampler, run
from tests.benchmarks.peers.outcome import Cost, Length, Outcome, Stopwatch
from tests.benchmarks.peers.target import Target

CHAINS = 4


def sampler(name: str, target: Target, length: Length) -> Callable[[int], Outcome]:
    """Return what runs one of fmu's samplers for a seed, from starts drawn from the prior.

    Evaluations are gradients for HMC, else log-probabilities; the few gradients of the mixture's local steps count
    as what they cost.
    """
    settings = make_sampler(name)
    cost = gradient_cost(target.problem, target.starts(0, CHAINS))

    def booked(time: Cost, stats: Any) -> Cost:
        gradients = int(stats["n_gradients"].sum())
        evaluations = gradients if name == "hmc" else stats["n_solves"].sum() + (cost - 1.0) * gradients
        return Cost(time.cpu_s, time.wall_s, round(evaluations))

    def once(seed: int) -> Outcome:
        starts = target.starts(seed, CHAINS * settings.walkers)
        if settings.walkers > 1:
            starts = starts.reshape(CHAINS, settings.walkers, -1)
        stopwatch, warmed = Stopwatch(), []

        def progress(phase: str, done: int, total: int, words: dict[str, str]) -> None:
            if phase == "warmup" and done == total:
                warmed.append(stopwatch.read())

        result = run(
            target.problem,
            settings,
            draws=length.draws,
            warmup=length.warmup,
            chains=CHAINS,
            seed=seed,
            init=starts,
            progress=progress,
        )
        drawn = stopwatch.read()
        kept = result.posterior.stats
        return Outcome(
            result.posterior.position,
            warmup=booked(warmed[0], result.warmup.stats),
            draws=booked(drawn, kept),
            walkers=settings.walkers,
            divergences=int(kept["diverging"].sum()) if "diverging" in kept else None,
        )

    return once
