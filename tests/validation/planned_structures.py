"""Structures for the study of plans of modal tests."""

from __future__ import annotations

import numpy as np

import fmu
from fmu.fem.frame.components import DIRECTIONS
from fmu.posterior.data.expected import expected_modes
from tests.validation.scale_model import Size, frame_model


def problem_of(model: fmu.SeparableModel, sd: float, start: float = 1.0, n_modes: int = 4) -> fmu.UpdatingProblem:
    """Return the problem of a planned test, with Gaussian priors truncated at three standard deviations."""
    parameters = [
        fmu.Parameter(
            f"p{k + 1}", start, start * (1 - 3 * sd), start * (1 + 3 * sd), fmu.Normal(sd * start, mean=start)
        )
        for k in range(model.n_parameters)
    ]
    model.names = None
    return fmu.UpdatingProblem(model, expected_modes(model, parameters, n_modes), parameters)


def frame_problem(size: Size, n_parameters: int, n_modes: int) -> fmu.UpdatingProblem:
    """Return the problem of a regular frame whose moduli have a prior standard deviation of 7 %."""
    return problem_of(frame_model(size, n_parameters), 0.07, 3.3e10, n_modes)


def translations(problem: fmu.UpdatingProblem, most: int = 10**9) -> list[tuple[object, str]]:
    """Return the translations of a structure, at most `most` of them, in even steps."""
    assert problem.model.structure is not None
    every = [dof for dof in problem.model.structure.dofs if dof[1] in "xyz"]
    return every[:: max(1, len(every) // most)][:most]


def beam() -> fmu.SeparableModel:
    """Return a cantilever of ten elements with four moduli."""
    steel, section = fmu.Material(E=2.1e11, nu=0.3, rho=7850.0), fmu.Section.rectangle(0.04, 0.08)
    cuts = np.array_split(np.arange(10), 4)
    groups = [
        fmu.ElementGroup(f"part {k}", np.stack([one, one + 1], axis=1), section, steel)
        for k, one in enumerate(cuts)
    ]
    nodes = np.stack([np.linspace(0.0, 3.0, 11), np.zeros(11), np.zeros(11)], axis=1)
    plane = dict.fromkeys(range(1, 11), ("x", "y", "rx", "rz"))
    frame = fmu.Frame(nodes=nodes, groups=groups, supports={0: DIRECTIONS, **plane})
    return frame.separable({f"E{k}": fmu.Factor([("E", f"part {k}")]) for k in range(4)})


def grid(seed: int, n: int = 12, p: int = 3) -> fmu.SeparableModel:
    """Return `n` masses on a random net of springs in `p` groups; two masses are tied to the ground."""
    rng = np.random.default_rng(seed)
    pairs = [(i, i + 1) for i in range(n - 1)]
    pairs += [tuple(sorted(rng.choice(n, 2, replace=False))) for _ in range(n)]
    K = np.zeros((p, n, n))
    for i, j in pairs:
        k = rng.integers(p)
        d = np.zeros(n)
        d[i], d[j] = 1.0, -1.0
        K[k] += 1e5 * rng.uniform(0.5, 2.0) * np.outer(d, d)
    ground = np.zeros((n, n))
    ground[0, 0] = ground[n // 2, n // 2] = 1e5
    M = np.diag(rng.uniform(5.0, 20.0, n))
    names = [f"p{k + 1}" for k in range(p)]
    return fmu.SeparableModel.from_terms(names, [ground, *zip(K, names, strict=True)], [M])
