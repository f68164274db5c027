"""Simulated structures whose model is wrong: do intervals hold the truth, with and without a discrepancy?

    python -m tests.validation.wrong_structures OUT [--replicates N] [--seed N] [--kept FILE] [--minutes M]

Each structure is a beam on an elastic joint with four regions, whose moduli are drawn from their prior. Eight
frequencies are measured with errors of 1 to 2 %. Two of three structures differ from the model: their joint is
5 to 30 % softer, a mass of 1 to 5 % of the beam's was forgotten, or the thickness of a region is off by 3 %. The
model of the others is right. The data are made by LAPACK and NumPy alone. Each structure is sampled without a
discrepancy and with embedded scatter, common to all regions. Written to wrong-structures.md in the directory OUT.
Exit code 1 where a gate fails.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import eigh
from threadpoolctl import threadpool_limits

import fmu
from fmu.types import FloatArray
from tests.validation.kept import keep, kept_lines
from tests.validation.wrong_structures_page import INTERVAL, KINDS, Study, page

REPLICATES, SEED = 300, 20_284
REGIONS, PER_REGION, MODES = 4, 4, 8
NAMES = tuple(f"E{k + 1}" for k in range(REGIONS))
PRIOR_SD, ERRORS = 0.1, (0.01, 0.02)
LENGTH, EI, MASS = 2.0, 4.0e4, 12.0
"""Length, m; bending stiffness, N m², and mass a length, kg/m, of the beam of the model."""
JOINT = 20.0 * EI / LENGTH
"""Stiffness of the joint at the left end against rotation, N m."""
SOFT, FORGOTTEN, THICKNESS = (0.05, 0.30), (0.01, 0.05), 0.03
UNTIL_ESS = 400


@dataclass(frozen=True)
class Structure:
    """The result of one structure.

    Attributes
    ----------
    number : int
    kind : str
        Of the error of the model; see `KINDS`.
    size : float
        The error of the model: relative stiffness, mass or thickness.
    converged : list of bool
        Without and with a discrepancy; so are all lists.
    fit : list of str
        The verdicts on the model.
    parameters : list of list of bool
        Whether the interval holds the true value of each modulus.
    modes : list of list of bool
        Whether the interval of each mode, predicted by the others, holds its measurement.
    widths : list of list of float
        The widths of the intervals of the moduli.
    tau : list of float
        Mean and standard deviation of τ.
    processor_s : list of float
    """

    number: int
    kind: str
    size: float
    converged: list[bool]
    fit: list[str]
    parameters: list[list[bool]]
    modes: list[list[bool]]
    widths: list[list[float]]
    tau: list[float]
    processor_s: list[float]


def matrices(bending: FloatArray, mass: FloatArray) -> tuple[list[FloatArray], FloatArray]:
    """Return the stiffness matrix of each region, N/m, and the mass matrix, kg, of the beam without its joint.

    Bending stiffnesses, N m², and masses a length, kg/m, are those of the regions. The left end is on a bearing.
    """
    n = REGIONS * PER_REGION
    h = LENGTH / n
    k = np.array([[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2]])
    k = np.vstack([k, [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]]) / h**3
    m = np.array([[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2]])
    m = np.vstack([m, [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2]]) * h / 420.0
    K = np.zeros((REGIONS, 2 * (n + 1), 2 * (n + 1)))
    M = np.zeros((2 * (n + 1), 2 * (n + 1)))
    for e in range(n):
        region, dofs = e // PER_REGION, np.ix_(*[range(2 * e, 2 * e + 4)] * 2)
        K[region][dofs] += bending[region] * k
        M[dofs] += mass[region] * m
    return [one[1:, 1:] for one in K], M[1:, 1:]


def simulate(rng: np.random.Generator, kind: str) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the true moduli, measured frequencies and their standard deviations, Hz, and the model's error."""
    theta = 1.0 + PRIOR_SD * rng.standard_normal(REGIONS)
    bending, mass, joint, size = EI * np.ones(REGIONS), MASS * np.ones(REGIONS), JOINT, 0.0
    region, node = rng.integers(REGIONS), rng.integers(1, REGIONS * PER_REGION + 1)
    if kind == "thickness":
        size = float(rng.choice([-1.0, 1.0])) * THICKNESS
        bending[region] *= (1.0 + size) ** 3
        mass[region] *= 1.0 + size
    if kind == "joint":
        size = -float(rng.uniform(*SOFT))
        joint *= 1.0 + size
    K, M = matrices(bending, mass)
    total = np.einsum("k,kij->ij", theta, K)
    total[0, 0] += joint
    if kind == "mass":
        size = float(rng.uniform(*FORGOTTEN))
        M[2 * node - 1, 2 * node - 1] += size * MASS * LENGTH
    f = np.sqrt(eigh(total, M, eigvals_only=True)[:MODES]) / (2.0 * np.pi)
    sd = f * np.exp(rng.uniform(*np.log(ERRORS)))
    return theta, f + sd * rng.standard_normal(MODES), sd, size


def problem(f: FloatArray, sd: FloatArray, discrepancy: Sequence[fmu.Discrepancy]) -> fmu.UpdatingProblem:
    """Return the problem of updating the moduli of the model."""
    K, M = matrices(EI * np.ones(REGIONS), MASS * np.ones(REGIONS))
    joint = np.zeros_like(M)
    joint[0, 0] = JOINT
    model = fmu.SeparableModel.from_terms(NAMES, [*zip(K, NAMES, strict=True), joint], [M])
    parameters = [fmu.Parameter(k, 1.0, 0.3, 2.0, prior=fmu.Normal(PRIOR_SD, mean=1.0)) for k in NAMES]
    data = fmu.ModalData(f, numbers=tuple(range(1, MODES + 1)), sd_hz=sd)
    errors = fmu.FrequencyErrors("absolute")
    return fmu.UpdatingProblem.reduced(
        model, data, parameters, pairing="index", error=errors, discrepancy=discrepancy
    )


def one_structure(seed: int, number: int) -> Structure:
    """Simulate a structure and update it without and with a discrepancy."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    kind = KINDS[number % len(KINDS)]
    theta, f, sd, size = simulate(rng, kind)
    found = Structure(number, kind, size, [], [], [], [], [], [], [])
    for discrepancy in ([], [fmu.Discrepancy()]):
        began = time.process_time()
        of = problem(f, sd, discrepancy)
        trace = fmu.sample(of, until_ess=UNTIL_ESS, seed=number + 1, progress=False)
        verdict, table = fmu.diagnose(trace), fmu.leave_one_out(trace, of)
        found.processor_s.append(time.process_time() - began)
        found.converged.append(bool(verdict.converged))
        found.fit.append(verdict.fit.answer)
        draws = np.stack([trace["posterior"][name].to_numpy().ravel() for name in NAMES], axis=1)
        low, high = np.quantile(draws, (0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2), axis=0)
        found.parameters.append(((low <= theta) & (theta <= high)).tolist())
        found.widths.append((high - low).tolist())
        held = (table["eti90_lb"] <= table["measured"]) & (table["measured"] <= table["eti90_ub"])
        found.modes.append([bool(one) for one in held])
        if discrepancy:
            tau = trace["posterior"]["tau"].to_numpy()
            found.tau.extend([float(tau.mean()), float(tau.std())])
    return found


def main() -> int:
    """Update the structures that are missing, write the page, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--kept", type=Path, help="file in which structures are kept, to continue from")
    parser.add_argument("--minutes", type=float, default=np.inf, help="after which no further structure is begun")
    asked = parser.parse_args()
    structures = [Structure(**line) for line in kept_lines(asked.kept, list)][: asked.replicates]
    began = time.monotonic()
    with threadpool_limits(1):
        for number in range(len(structures), asked.replicates):
            if time.monotonic() - began > 60.0 * asked.minutes:
                break
            structures.append(one_structure(asked.seed, number))
            keep(asked.kept, structures[-1])
    study = Study(structures)
    (asked.out / "wrong-structures.md").write_text(page(study, REPLICATES), encoding="utf-8")
    return 1 if study.failures else 0


if __name__ == "__main__":
    sys.exit(main())
