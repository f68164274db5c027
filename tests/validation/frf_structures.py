"""Structures with simulated frequency response functions, for the study `tests.validation.frfs`."""

from __future__ import annotations

import time

import numpy as np

import fmu
from fmu.engines.blas import single_thread
from fmu.fem.frf.model import Damping, FRFModel
from fmu.fem.frf.proportional import Source
from fmu.fem.frf.training import Lines
from fmu.fem.modes.eigensolver import eigen
from fmu.fem.modes.modal import frequency_hz
from fmu.posterior.problem import UpdatingProblem
from fmu.types import FloatArray
from tests.validation.scale_model import SD, E, Size, frame_model

_NOISE, _LINES = 0.05, 400


def frame_problem(size: tuple[int, int, int], n_parameters: int) -> tuple[UpdatingProblem, FloatArray]:
    """Return the problem of a regular frame with ten accelerances of 400 lines, and the true parameters.

    The true FRFs are computed with a separate basis, trained in a narrow box around the true parameters.
    """
    structure = frame_model(Size(*size), n_parameters)
    rng = np.random.default_rng(1)
    truth = E * (1.0 + SD * np.clip(rng.standard_normal(n_parameters), -2.0, 2.0))
    ratios = np.array([0.01, 0.012, 0.015, 0.02, 0.018])
    f = frequency_hz(eigen(structure.K(truth), structure.M(truth), 10)[0])
    lines = np.linspace(0.6 * f[0], 1.02 * f[9], _LINES)
    omega = 2 * np.pi * lines
    nodes = sorted({node for node, _ in structure.dofs})
    at = [nodes[int(share * (len(nodes) - 1))] for share in (1.0, 0.5, 0.25, 0.75, 0.9)]
    responses = tuple((int(node), d) for node in at for d in ("x", "y"))
    drives = ((int(nodes[-1]), "x"),) * len(responses)
    box = truth * 0.999, truth * 1.001
    damping = Damping(5, ratios=tuple(Source(0.0, i) for i in range(5)))
    unit = Lines(omega, np.full((len(responses), _LINES), 1e-13))
    model = FRFModel(structure, responses, drives, damping, truth, *box, ratios, unit)
    H = model.at(truth[None], ratios[None]).frfs(omega)[0] * (1j * omega) ** 2
    sd = _NOISE * np.abs(H) / np.sqrt(2.0)
    values = H + sd * (rng.standard_normal(H.shape) + 1j * rng.standard_normal(H.shape))
    data = fmu.FRFData(lines, values, drives, responses, "accelerance", sd)
    parameters = [
        fmu.Parameter(f"E{i + 1}", E, E * (1 - 3 * SD), E * (1 + 3 * SD), fmu.Normal(mean=E, sd=SD * E), "Pa")
        for i in range(n_parameters)
    ]
    own = [fmu.Parameter(f"zeta{i + 1}", 0.015, 0.001, 0.1, fmu.LogNormal(0.015, 0.5)) for i in range(5)]
    modes = fmu.ModalData(f, sd_hz=0.01 * f, numbers=tuple(range(1, 11)))
    problem = fmu.UpdatingProblem.reduced(
        structure,
        modes,
        parameters,
        pairing="index",
        error=fmu.FRFErrors(data, fmu.ModalDamping(own)),
        reduction=1e-3,
    )
    return problem, np.concatenate([truth, ratios])


def many_lines() -> tuple[UpdatingProblem, FloatArray]:
    """Return the cantilever with 20 FRFs of 10 000 lines, and 64 points around its start."""
    case = fmu.cases.load("cantilever-young")
    structure, rng = case.model.structure, np.random.default_rng(0)
    lines = np.linspace(20.0, 2000.0, 10_000)
    responses = tuple((int(node), d) for node in range(5, 55, 5) for d in ("y", "z"))
    drives = tuple((50, d) for node in range(10) for d in ("y", "z"))
    values = 1e-6 * (rng.standard_normal((20, 10_000)) + 1j * rng.standard_normal((20, 10_000)))
    data = fmu.FRFData(lines, values, drives, responses, "receptance", 1e-8)
    ratios = [fmu.Parameter(f"zeta{i}", 0.01, 0.001, 0.1) for i in range(5)]
    own = fmu.FRFErrors(data, fmu.ModalDamping(ratios))
    problem = fmu.UpdatingProblem(structure, case.data, case.parameters, error=own)
    return problem, problem.sample_prior(rng, 64)


def ratio_to_eigh(n: int = 64, rounds: int = 300) -> tuple[int, float, float, float, float, float]:
    """Return the size of the basis and five times in microseconds per theta.

    The times are of eigh of a matrix as large as the basis, of the FRFs, of the FRFs with all derivatives of a
    scalar function of them, of the log-probability, and of the log-probability with its gradient. The five
    computations take turns, and each time is the shortest of all rounds.
    """
    problem = fmu.cases.load("cantilever-frf")
    (term,) = problem.likelihood.responses
    rng, size = np.random.default_rng(0), term.model.block.size
    theta = problem.sample_prior(rng, n)
    matrices = rng.standard_normal((n, size, size))
    matrices = matrices + np.swapaxes(matrices, 1, 2)
    parts = [term.split(theta[i : i + 8]) for i in range(0, n, 8)]
    weights = rng.standard_normal((8, 3, len(term.omega))) + 0j

    def solve(with_derivatives: bool) -> None:
        for part in parts:
            solved = term.model.at(*part)
            solved.frfs(term.omega)
            if with_derivatives:
                solved.add(weights)
                solved.gradient()

    calls = (
        lambda: np.linalg.eigh(matrices),
        lambda: solve(False),
        lambda: solve(True),
        lambda: problem.log_prob(theta),
        lambda: problem.log_prob_and_grad(theta),
    )
    best = np.full(len(calls), np.inf)
    with single_thread():
        for _ in range(rounds):
            for k, call in enumerate(calls):
                began = time.perf_counter()
                call()
                best[k] = min(best[k], time.perf_counter() - began)
    return size, *(1e6 * best / n).tolist()
