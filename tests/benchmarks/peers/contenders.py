"""Who takes part, how long, and what is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from fmu.analysis.estimate import gradient_cost
from fmu.posterior.reduction.region import plausible_points
from tests.benchmarks.peers.chains import pints_adaptive
from tests.benchmarks.peers.ensembles import emcee_default, emcee_dense
from tests.benchmarks.peers.jax_model import JaxBeam, in_jax
from tests.benchmarks.peers.nuts import numpyro_full, numpyro_nuts, nutpie_nuts
from tests.benchmarks.peers.ours import CHAINS, sampler
from tests.benchmarks.peers.outcome import Length, Outcome
from tests.benchmarks.peers.target import Target, WeakPlane, WholeBeam, disagreement

CASES = {"cantilever-young": "shape", "cantilever-section": "shape", "shear-10dof": "index"}
"""Cases and how their modes are paired."""
OURS = {
    "mixture": Length(1000, 2000),
    "hmc": Length(1000, 2000),
    "mh": Length(2000, 12000),
    "slice": Length(1000, 3000),
    "emcee": Length(1000, 1500),
}
NUTS, STRETCH, ADAPTIVE = Length(1000, 500), Length(1000, 2000), Length(3000, 9000)
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
    cost : callable
        Returns how many log-probabilities of that model an evaluation takes.
    prepare : callable
        Returns what runs it for a seed; compilation happens there.
    """

    label: str
    model: str
    unit: str
    cost: Callable[[], float]
    prepare: Callable[[], Callable[[int], Outcome]]


FMU, JAX = "fmu", "same model, JAX"
WHOLE, PLANE = "SciPy, 300 DOF", "SciPy, weak plane"
FULL_JAX = "weak plane, JAX"


def contenders(target: Target) -> Iterator[Contender]:
    """Yield who takes part on a target, all with the posterior that `check` has found to be the same."""

    def one() -> float:
        return 1.0

    def fmu_gradient(chains: int) -> float:
        return gradient_cost(target.problem, target.starts(0, chains))

    for name, steps in OURS.items():
        unit, cost = (GRADIENT, partial(fmu_gradient, CHAINS)) if name == "hmc" else (VALUE, one)
        yield Contender(name, FMU, unit, cost, partial(sampler, name, target, steps))
    posterior = in_jax(target)
    costs = cache(partial(posterior.gradient_cost, CHAINS))
    nuts = cache(lambda dense: cache(numpyro_nuts(posterior, NUTS, dense)))
    yield Contender("NumPyro NUTS", JAX, GRADIENT, costs, partial(nuts, False))
    yield Contender("NumPyro NUTS, dense mass matrix", JAX, GRADIENT, costs, partial(nuts, True))
    yield Contender("nutpie NUTS", FMU, GRADIENT, partial(fmu_gradient, 1), lambda: nutpie_nuts(target, NUTS))
    yield Contender("PINTS adaptive MH", FMU, VALUE, one, lambda: pints_adaptive(target, ADAPTIVE))
    stretch = emcee_default(target, STRETCH)
    yield Contender("emcee, default moves", FMU, VALUE, one, lambda: stretch)
    if target.is_box:
        full = JaxBeam(target, reduced=False)
        of_full = partial(full.gradient_cost, 1)
        yield Contender("NumPyro NUTS", FULL_JAX, GRADIENT, of_full, lambda: numpyro_full(full, nuts(False)))
        yield Contender("emcee, default moves", WHOLE, VALUE, one, lambda: emcee_dense(stretch, WholeBeam(target)))
        yield Contender("emcee, default moves", PLANE, VALUE, one, lambda: emcee_dense(stretch, WeakPlane(target)))


def check(target: Target, tolerance: float = 1e-2) -> dict[str, float]:
    """Return how far the other log-probabilities are from fmu's at most where it is plausible, a constant apart.

    Raises
    ------
    ValueError
        If one differs by more than `tolerance`.
    """
    theta = plausible_points(target.problem, 20, np.random.default_rng(7))
    others = {JAX: in_jax(target).at}
    if target.is_box:
        others |= {
            WHOLE: WholeBeam(target),
            PLANE: WeakPlane(target),
            FULL_JAX: JaxBeam(target, reduced=False).at,
        }
    differences = {name: disagreement(target, other, theta) for name, other in others.items()}
    wrong = {name: value for name, value in differences.items() if not value < tolerance}
    if wrong:
        raise ValueError(f"{target.title}: log-probabilities must agree within {tolerance:g} (got {wrong})")
    return differences
