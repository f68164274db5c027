"""Who takes part, how long, and what is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from fmu.posterior.train_reduced import plausible_points
from tests.benchmarks.peers.chains import pints_adaptive
from tests.benchmarks.peers.ensembles import emcee_default, emcee_dense
from tests.benchmarks.peers.jax_model import JaxPosterior
from tests.benchmarks.peers.nuts import numpyro_full, numpyro_nuts, nutpie_nuts
from tests.benchmarks.peers.ours import sampler
from tests.benchmarks.peers.outcome import Length, Outcome
from tests.benchmarks.peers.target import Target, WeakPlane, WholeBeam, disagreement
from tests.benchmarks.ratio import paired_ratios

CASES = ("cantilever-young", "cantilever-section")
OURS = {
    "hmc": Length(1000, 2000),
    "mh": Length(2000, 12000),
    "slice": Length(1000, 3000),
    "emcee": Length(1000, 1500),
}
NUTS, STRETCH, ADAPTIVE = Length(300, 300), Length(1000, 2000), Length(3000, 9000)
SEEDS = (1, 2, 3)

GRADIENT, VALUE = "gradient", "log-probability"


@dataclass(frozen=True)
class Contender:
    """One sampler on one model.

    Attributes
    ----------
    label : str
    model : str
        What it evaluates.
    unit : str
        What an evaluation of it is.
    prepare : callable
        Returns what runs it for a seed; compilation happens there.
    """

    label: str
    model: str
    unit: str
    prepare: Callable[[], Callable[[int], Outcome]]


FMU, JAX = "fmu", "reduced, JAX"
WHOLE, PLANE = "SciPy, 300 DOF", "SciPy, weak plane"
FULL_JAX = "weak plane, JAX"


def contenders(target: Target, short: bool = False) -> Iterator[Contender]:
    """Yield who takes part on a target, all with the posterior that `check` has found to be the same."""

    def length(full: Length) -> Length:
        return full.quick() if short else full

    for name, steps in OURS.items():
        unit = GRADIENT if name == "hmc" else VALUE
        yield Contender(name, FMU, unit, partial(sampler, name, target, length(steps)))
    reduced = JaxPosterior(target)
    on_reduced: list[Callable[[int], Outcome]] = []

    def numpyro() -> Callable[[int], Outcome]:
        on_reduced.append(cache(numpyro_nuts(reduced, length(NUTS))))
        return on_reduced[0]

    yield Contender("NumPyro NUTS", JAX, GRADIENT, numpyro)
    yield Contender(
        "NumPyro NUTS",
        FULL_JAX,
        GRADIENT,
        lambda: numpyro_full(target, JaxPosterior(target, reduced=False), on_reduced[0]),
    )
    yield Contender("nutpie NUTS", FMU, GRADIENT, lambda: nutpie_nuts(target, length(NUTS)))
    yield Contender("PINTS adaptive MH", FMU, VALUE, lambda: pints_adaptive(target, length(ADAPTIVE)))
    stretch = emcee_default(target, length(STRETCH))
    yield Contender("emcee, default moves", FMU, VALUE, lambda: stretch)
    yield Contender("emcee, default moves", WHOLE, VALUE, lambda: emcee_dense(stretch, WholeBeam(target)))
    yield Contender("emcee, default moves", PLANE, VALUE, lambda: emcee_dense(stretch, WeakPlane(target)))


def check(target: Target, tolerance: float = 1e-2) -> dict[str, float]:
    """Return how far the other log-probabilities are from fmu's at most where it is plausible, a constant apart.

    Raises
    ------
    ValueError
        If one differs by more than `tolerance`.
    """
    theta = plausible_points(target.problem, 20, np.random.default_rng(7))
    others = {
        WHOLE: WholeBeam(target),
        PLANE: WeakPlane(target),
        JAX: JaxPosterior(target).at,
        FULL_JAX: JaxPosterior(target, reduced=False).at,
    }
    differences = {name: disagreement(target, other, theta) for name, other in others.items()}
    wrong = {name: value for name, value in differences.items() if not value < tolerance}
    if wrong:
        raise ValueError(f"{target.title}: log-probabilities must agree within {tolerance:g} (got {wrong})")
    return differences


def gradient_cost(target: Target, n: int = 4) -> float:
    """Return how many times as long a gradient takes fmu as a log-probability, in batches of `n`."""
    problem, theta = target.problem, target.starts(0, n)
    return float(
        np.median(paired_ratios(partial(problem.log_prob_and_grad, theta), partial(problem.log_prob, theta)))
    )
