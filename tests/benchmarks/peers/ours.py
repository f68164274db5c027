"""fmu's four samplers with their default settings."""

from __future__ import annotations

from collections.abc import Callable

from fmu.samplers import named, run
from tests.benchmarks.peers.outcome import Cost, Length, Outcome, Stopwatch
from tests.benchmarks.peers.target import Target

CHAINS = 4


def sampler(name: str, target: Target, length: Length) -> Callable[[int], Outcome]:
    """Return what runs one of fmu's samplers for a seed, from starts drawn from the prior."""
    settings = named(name)
    unit = "n_gradients" if name == "hmc" else "n_solves"

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
            warmup=_booked(warmed[0], result.warmup.stats[unit].sum()),
            draws=_booked(drawn, kept[unit].sum()),
            walkers=settings.walkers,
            divergences=int(kept["diverging"].sum()) if "diverging" in kept else None,
        )

    return once


def _booked(time: Cost, evaluations: int) -> Cost:
    return Cost(time.cpu_s, time.wall_s, int(evaluations))
