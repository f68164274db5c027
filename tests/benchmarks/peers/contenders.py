"""The samplers that run on each posterior, with their lengths and seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from tests.benchmarks.peers import ensembles, nested
from tests.benchmarks.peers.ours import fmu_run
from tests.benchmarks.peers.posteriors import FRAME, Target
from tests.benchmarks.peers.run import Run

ENOUGH = 1000.0
"""Effective draws of the worst parameter that a run must reach; its mean is then known to 3 % of its sd."""
POSTERIORS = (
    ("cantilever-young", "shape"),
    ("cantilever-young", "index"),
    ("cantilever-section", "shape"),
    ("cantilever-section", "index"),
    ("shear-10dof", "index"),
    ("garteur", "shape"),
    (FRAME, "index"),
    ("cantilever-frf", "shape"),
)
"""Cases and the pairing of their modes."""
IN_JAX = ("cantilever-young", "cantilever-section", "shear-10dof", FRAME)
WITH_NESTED = ("cantilever-young-shape", "cantilever-section-index", "shear-10dof-index", "garteur-shape")
SEEDS = (1, 2, 3)
OURS, OURS_LATER = ("mixture", "hmc"), ("mh", "slice", "emcee")
COSTLY = {
    "garteur-shape": 0.25, "cantilever-frf-shape": 0.25, "cantilever-section-index": 0.25, f"{FRAME}-index": 0.5,
}  # fmt: skip
"""Posteriors whose runs take about ten times as long: the share of the steps of the peers' chains, and of the
effective draws of fmu's samplers."""
FMU, PEER = "fmu", "peer"


@dataclass(frozen=True)
class Contender:
    """One sampler: its name in the tables, its owner (`FMU` or `PEER`), its seeds, and a function of a seed."""

    label: str
    whose: str
    seeds: tuple[int, ...]
    run: Callable[[int], Run]


def contenders(target: Target) -> Iterator[Contender]:
    """Yield the samplers for a target, the most important ones first, in case the time is short."""
    # these need packages of the extra "bench"
    from tests.benchmarks.peers.chains import pints_adaptive
    from tests.benchmarks.peers.nuts import numpyro_nuts, nutpie_nuts

    share = COSTLY.get(target.key, 1.0)

    def ours(name: str) -> Contender:
        return Contender(name, FMU, SEEDS, lambda seed: fmu_run(target, name, seed, share * ENOUGH))

    yield from map(ours, OURS)
    warmup, draws = int(1000 * share), int(500 * share)
    for label, adaptation in (("nutpie NUTS", "diag"), ("nutpie NUTS, low-rank metric", "low_rank")):
        yield Contender(label, PEER, SEEDS, partial(nutpie_nuts, target, adaptation, warmup, draws))
    if target.case in IN_JAX:
        for label, dense in (("NumPyro NUTS", False), ("NumPyro NUTS, dense mass matrix", True)):
            yield Contender(label, PEER, SEEDS, partial(numpyro_nuts, target, dense, warmup, draws))
    of_walkers = share * ensembles.LEAST_WALKERS / ensembles.walkers_for(target.problem.ndim)
    for label, moves in (
        ("emcee, default moves", ensembles.stretch),
        ("emcee, DE and snooker", ensembles.differential),
        ("emcee, moves of fmu's", ensembles.as_fmu),
        ("emcee, fmu.MixtureMove", ensembles.mixture),
    ):
        run = partial(ensembles.emcee_run, target, moves, int(500 * of_walkers), int(750 * of_walkers))
        yield Contender(label, PEER, SEEDS, run)
    run = partial(pints_adaptive, target, int(3000 * share), int(9000 * share))
    yield Contender("PINTS adaptive MH", PEER, SEEDS[:1], run)
    yield from map(ours, OURS_LATER)
    if target.key in WITH_NESTED:
        for label, sampler in (
            ("nautilus", nested.nautilus),
            ("dynesty, dynamic", nested.dynesty),
            ("UltraNest", nested.ultranest),
            ("nessai, importance nested", nested.nessai),
            ("pocoMC", nested.pocomc),
        ):
            yield Contender(
                label, PEER, SEEDS[:1],
                lambda seed, sampler=sampler: nested.nested_run(target, sampler, seed, ENOUGH),
            )  # fmt: skip
