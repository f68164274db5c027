"""Simulated structures whose model is wrong: do intervals hold the truth, with and without a discrepancy?

    python -m tests.validation.wrong_structures OUT [--kept DIRECTORY] [--minutes M] [--replicates N]
        [--seed N] [--correlation R]

Each structure is a beam of two parts with a joint (`tests.validation.wrong_beam`), whose two moduli are drawn from
their prior, 1 ± 0.05. Its 18 frequencies are measured with errors of 1 to 2 %. Two of three structures differ from
the model: their joint is 5 to 30 % softer, a mass of 2 to 6 % of the beam's was forgotten at the joint, or the
thickness is off by 3 %. The model of the others is right. The data are made by LAPACK and NumPy alone. Each
structure is sampled without a discrepancy, and with a scatter of the joint, the thickness and the mass over the
modes, which are not updated. The prior of each τ has the root mean square of these errors. The scatter in two
modes is independent, or has the correlation R: it is 1 if all modes see the same joint. Written to
wrong-structures.md in the directory OUT. Exit code 1 where a gate fails.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis.models.scatter import scatters
from tests.validation.kept import Units, each, fields_of, study_parser
from tests.validation.wrong_beam import HELD, MODULI, problem, simulate
from tests.validation.wrong_structures_page import INTERVAL, KINDS, Study, page

REPLICATES, SEED = 300, 20_285
WARMUP, DRAWS, UNTIL_ESS, STARTS = 200, 300, 400, 8


@dataclass(frozen=True)
class Structure:
    """The result of one structure.

    Attributes
    ----------
    number : int
    kind : str
        Of the error of the model; see `KINDS`.
    size : float
        The relative error of the model.
    signal, cosine : float
        Whether the group of the error can be told, before any draw; see `wrong_beam.told`.
    converged : list of bool
        Without and with a discrepancy; so are the lists that follow.
    fit : list of str
        The verdicts on the model.
    parameters : list of list of bool
        Whether the interval holds the true value of each modulus.
    modes : list of list of bool
        Whether the interval of each mode, predicted by the others, holds its measurement; only of modes that have
        a prediction.
    widths : list of list of float
        The widths of the intervals of the moduli.
    processor_s : list of float
    tau : list of float
        Posterior mean of τ of each of `HELD`.
    largest, needed : list of float
        Of each of them, the probability that its τ is the largest in units of its prior, and that it is needed.
    """

    number: int
    kind: str
    size: float
    signal: float
    cosine: float
    converged: list[bool]
    fit: list[str]
    parameters: list[list[bool]]
    modes: list[list[bool]]
    widths: list[list[float]]
    processor_s: list[float]
    tau: list[float]
    largest: list[float]
    needed: list[float]


def one_structure(seed: int, number: int, correlation: float = 0.0) -> Structure:
    """Simulate a structure and update it without and with a discrepancy."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    kind = KINDS[number % len(KINDS)]
    made = simulate(rng, kind)
    found = Structure(number, kind, made.size, made.signal, made.cosine, *([] for _ in range(9)))
    for discrepancy in (False, True):
        began = time.process_time()
        of = problem(made.measured, made.sd, discrepancy, correlation)
        trace = fmu.sample(
            of, draws=DRAWS, warmup=WARMUP, until_ess=UNTIL_ESS, seed=number + 1,
            maxima=fmu.find_map(of, starts=STARTS), progress=False,
        )  # fmt: skip
        verdict, table = fmu.diagnose(trace), fmu.leave_one_out(trace).dropna(subset=["sd"])
        found.processor_s.append(time.process_time() - began)
        found.converged.append(bool(verdict.converged))
        found.fit.append(verdict.fit.answer)
        draws = np.stack([trace["posterior"][name].to_numpy().ravel() for name in MODULI], axis=1)
        low, high = np.quantile(draws, (0.5 - INTERVAL / 2, 0.5 + INTERVAL / 2), axis=0)
        found.parameters.append(((low <= made.moduli) & (made.moduli <= high)).tolist())
        found.widths.append((high - low).tolist())
        held = (table["eti90_lb"] <= table["measured"]) & (table["measured"] <= table["eti90_ub"])
        found.modes.append([bool(one) for one in held])
    for group, scatter in zip(HELD, scatters(trace), strict=True):
        found.tau.append(float(trace["posterior"][f"tau {group}"].mean()))
        found.largest.append(scatter.largest)
        found.needed.append(scatter.needed)
    return found


def main() -> int:
    """Update the structures that are missing, write the page, and return the exit code."""
    parser = study_parser(__doc__)
    parser.add_argument("--replicates", type=int, default=REPLICATES)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--correlation", type=float, default=0.0)
    asked = parser.parse_args()
    units, numbers = Units(asked.kept, asked.minutes), each(range(asked.replicates))
    with threadpool_limits(1):
        structures = units.completed(
            "structures",
            numbers,
            lambda n: one_structure(asked.seed, n, asked.correlation),
            fields_of(Structure, list),
        )
    study = Study(structures)
    (asked.out / "wrong-structures.md").write_text(page(study, REPLICATES, asked.correlation), encoding="utf-8")
    return 1 if study.failures else 0


if __name__ == "__main__":
    sys.exit(main())
