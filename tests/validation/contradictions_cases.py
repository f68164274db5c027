"""Random small updating problems: shear buildings whose truth, noise, bounds, pairing and errors are drawn.

A part of them is wrong on purpose: a truth outside the bounds, a storey softer than the model can say, noise that
is not what is stated, or two directions whose modes cross, so that a pairing by shape jumps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

import fmu
from fmu.posterior.priors.base import Prior
from fmu.types import FloatArray
from tests.shear_building import storey

STIFFNESS, MASS = 1e8, 1e5  # N/m, kg
LENGTH = {"draws": 250, "warmup": 250, "chains": 4}
SAMPLERS = ("mixture", "mixture", "mixture", "hmc", "mh")


@dataclass(frozen=True)
class Case:
    """A problem, how it was drawn in words, and the sampler to take."""

    problem: fmu.UpdatingProblem
    words: str
    sampler: str


def _terms(rng: np.random.Generator, n: int, is_crossing: bool) -> list[FloatArray]:
    """Return a stiffness matrix for each parameter; with two directions that cross, one for each of these."""
    if is_crossing:
        one = STIFFNESS * sum(storey(j, n) for j in range(n))
        tilt = np.kron([[0.0, 1.0], [1.0, 0.0]], 0.002 * one)
        first, second = (np.kron(np.diag(side), one) for side in ([1.0, 0.0], [0.0, 1.0]))
        return [first + tilt, second]
    groups = int(rng.integers(1, min(4, n) + 1))
    return [STIFFNESS * sum(storey(j, n) for j in part) for part in np.array_split(rng.permutation(n), groups)]


def _prior(rng: np.random.Generator) -> Prior:
    kind = int(rng.integers(3))
    return (fmu.Uniform(), fmu.Normal(0.3, mean=1.0), fmu.LogNormal(1.0, 0.25))[kind]


def random_case(seed: int) -> Case:
    """Return the problem number `seed`."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(37,)))
    n, is_crossing = int(rng.integers(3, 8)), bool(rng.random() < 0.25)
    terms = _terms(rng, n, is_crossing)
    size = len(terms[0])
    lower, upper = rng.uniform(0.3, 0.85), rng.uniform(1.15, 2.5)
    is_outside, is_soft, pairing = rng.random() < 0.25, rng.random() < 0.3, str(rng.choice(["index", "shape"]))
    truth = rng.uniform(lower, upper, len(terms))
    if is_outside:
        truth[0] = upper * rng.uniform(1.02, 1.4)
    K = sum(x * term for x, term in zip(truth, terms, strict=True))
    if is_soft:
        K = K - rng.uniform(0.1, 0.4) * min(truth) * np.pad(STIFFNESS * storey(n // 2, n), (0, size - n))
    lam, modes = eigh(K, MASS * np.eye(size))
    n_modes = int(rng.integers(2, min(6, size) + 1))
    sd, times = 10.0 ** rng.uniform(-3.0, -1.5), float(rng.choice([0.3, 1.0, 1.0, 3.0]))
    hz = np.sqrt(lam[:n_modes]) / (2.0 * np.pi) * (1.0 + times * sd * rng.standard_normal(n_modes))
    shapes = modes[:, :n_modes] / np.linalg.norm(modes[:, :n_modes], axis=0)
    shapes = shapes + 0.02 * rng.standard_normal(shapes.shape)
    use = [True] * n_modes if n_modes < 4 or rng.random() < 0.6 else [True] * (n_modes - 1) + [False]
    dofs = tuple((k % n + 1, "xy"[k // n]) for k in range(size))
    names = [f"k{i + 1}" for i in range(len(terms))]
    parameters = [fmu.Parameter(name, 1.0, lower, upper, prior=_prior(rng)) for name in names]
    noise = fmu.Parameter("sd", 0.01, 1e-4, 0.2, prior=fmu.LogNormal(0.01, 1.0))
    is_inferred, with_shapes = rng.random() < 0.25, rng.random() < 0.4
    errors = [fmu.FrequencyErrors("relative", sd=noise if is_inferred else sd)]
    if with_shapes:
        errors.append(fmu.ShapeErrors(sd=0.03))
    data = fmu.ModalData(hz, tuple(range(1, n_modes + 1)), dofs, shapes=shapes, use=tuple(use))
    model = fmu.SeparableModel.from_terms(
        names, stiffness=list(zip(terms, names, strict=True)), mass=[MASS * np.eye(size)], dofs=dofs
    )
    wrong = (", truth beyond a bound" if is_outside else "") + (", a soft storey" if is_soft else "")
    words = (
        f"{n} storeys{' in two directions' if is_crossing else ''}, {len(terms)} parameters, {n_modes} modes by "
        f"{pairing}{', shapes' if with_shapes else ''}, noise {sd:.1e}{' inferred' if is_inferred else ''} "
        f"x {times}{wrong}"
    )
    problem = fmu.UpdatingProblem.reduced(
        model, data, parameters, pairing=pairing, error=errors, name=f"building {seed}"
    )
    return Case(problem, words, SAMPLERS[seed % len(SAMPLERS)])
