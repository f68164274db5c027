"""Small updating problems of shear buildings with random truth, noise, bounds, pairing and error model.

Some problems are deliberately wrong: a truth outside the bounds, a storey softer than the model allows, or noise
that differs from the stated noise. In some, the modes of two directions cross, so that pairing by shape jumps.
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
    """A problem, its description in words, and the name of its sampler."""

    problem: fmu.UpdatingProblem
    words: str
    sampler: str


def _terms(rng: np.random.Generator, n: int, is_crossing: bool) -> list[FloatArray]:
    """Return a stiffness matrix per parameter; if the modes of two directions cross, one per direction."""
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
    wrong = (", a true parameter beyond its bounds" if is_outside else "") + (", a soft storey" if is_soft else "")
    words = (
        f"{n} storeys{' in two directions' if is_crossing else ''}, {len(terms)} parameters, {n_modes} modes "
        f"paired by {'number' if pairing == 'index' else pairing}{', mode shapes in the data' * with_shapes}, "
        f"{'inferred noise' if is_inferred else f'stated noise {100 * sd:.2g} %'}, actual noise "
        f"{100 * times * sd:.2g} %{wrong}"
    )
    problem = fmu.UpdatingProblem.reduced(
        model, data, parameters, pairing=pairing, error=errors, name=f"building {seed}"
    )
    return Case(problem, words, SAMPLERS[seed % len(SAMPLERS)])
