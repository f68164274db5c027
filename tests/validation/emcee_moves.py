"""Compare moves of plain emcee on the paper's four experiments.

    python -m tests.validation.emcee_moves OUT [--kept DIRECTORY] [--minutes M] [--quick]

Writes ``emcee-moves.md``. Exit code 1 if two moves that have both converged disagree in a
posterior mean.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import emcee
import numpy as np

import fmu
from fmu.numbers import share, significant, whole
from fmu.samplers.snooker import SnookerMove
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.validation.kept import Units, each, fields_of, study_parser

EXPERIMENTS = tuple((f"cantilever-{of}", pairing) for of in ("young", "section") for pairing in ("shape", "index"))
ENSEMBLES, WALKERS = 4, 32
USUAL, SHORT = 200, 40
"""Steps of warm-up: of most moves, and of the mixture, whose candidates do not depend on the walker's position."""
LENGTHS = (500, 1000, 2000, 4000, 8000, 16_000)
"""Numbers of steps at which a run ends if it has 50 autocorrelation times."""
ENOUGH, WANTED = 50, 400
"""Required autocorrelation times, and the effective draws whose cost is in the table."""
DISAGREEMENT = 5.0
"""Largest difference of two posterior means, in its Monte-Carlo standard errors."""

de = emcee.moves.DEMove
FROZEN = "`fmu.MixtureMove`, frozen"
MOVES: dict[str, tuple[Callable[[Any], Any], int, bool]] = {
    "stretch": (lambda problem: emcee.moves.StretchMove(), USUAL, False),
    "differential evolution (DE)": (lambda problem: de(), USUAL, False),
    "DE 80 %, snooker 20 %": (lambda problem: [(de(), 0.8), (SnookerMove(), 0.2)], USUAL, False),
    "KDE": (lambda problem: emcee.moves.KDEMove(), USUAL, False),
    "`fmu.MixtureMove`, other half": (fmu.MixtureMove, SHORT, False),
    FROZEN: (fmu.MixtureMove, SHORT, True),
    "frozen 80 %, DE 20 %": (lambda problem: [(fmu.MixtureMove(problem), 0.8), (de(), 0.2)], SHORT, True),
}
"""The moves, the steps of their warm-up, and whether the warm-up has ``tune=True``."""


@dataclass(frozen=True)
class Found:
    """Result of a move on an experiment.

    Attributes
    ----------
    accepted : float
        Acceptance fraction.
    time : float
        Autocorrelation time of the slowest parameter, in steps.
    ess : float
        Smallest bulk ESS.
    warmup, evaluations : int
        Log-probability evaluations in the warm-up and after it.
    verdict : str
    mean, error : ndarray, shape (ndim,)
        Posterior mean and its Monte-Carlo standard error.
    """

    experiment: str
    move: str
    accepted: float
    time: float
    ess: float
    warmup: int
    evaluations: int
    verdict: str
    mean: FloatArray
    error: FloatArray

    @property
    def per_evaluation(self) -> float:
        """Effective draws per evaluation after the warm-up."""
        return self.ess / self.evaluations

    @property
    def for_wanted(self) -> float:
        """Evaluations for `WANTED` effective draws, warm-up included."""
        return self.warmup + WANTED / self.per_evaluation


def tried(problem: Any, experiment: str, move: str, lengths: Iterable[int] = LENGTHS) -> Found:
    """Draw with a move until the run is long enough, or until the last of the `lengths`."""
    make, warmup, tune = MOVES[move]
    samplers = []
    for k in range(ENSEMBLES):
        sampler = emcee.EnsembleSampler(
            WALKERS, problem.ndim, problem.log_prob, vectorize=True, moves=make(problem)
        )
        sampler.random_state = np.random.RandomState(k).get_state()
        sampler.run_mcmc(problem.walkers(WALKERS, seed=k), warmup, tune=tune)
        samplers.append(sampler)
    maxima = fmu.find_map(problem)
    for steps in lengths:
        for sampler in samplers:
            sampler.run_mcmc(None, warmup + steps - sampler.iteration)
        trace = fmu.from_emcee(samplers, names=problem.names, discard=warmup, maxima=maxima)
        table = fmu.summary(trace)
        ess = float(table["ess_bulk"].min())
        time = ENSEMBLES * WALKERS * steps / ess
        if steps >= ENOUGH * time * 1.1:
            break
    fraction = float(np.mean([sampler.acceptance_fraction.mean() for sampler in samplers]))
    means = (table[name].to_numpy() for name in ("mean", "mcse_mean"))
    costs = (int(trace.attrs[name]) for name in ("warmup_n_solves", "n_solves"))
    return Found(experiment, move, fraction, time, ess, *costs, fmu.diagnose(trace).verdict, *means)


def disagreements(found: Iterable[Found]) -> list[str]:
    """Name the pairs of moves that have both converged on an experiment, but to different posterior means."""
    converged = [one for one in found if one.verdict == "converged"]
    return [
        f"{a.experiment}: {a.move} and {b.move}"
        for a, b in combinations(converged, 2)
        if a.experiment == b.experiment
        and np.max(np.abs(a.mean - b.mean) / np.hypot(a.error, b.error)) > DISAGREEMENT
    ]


def gain_in_words(found: Iterable[Found], first: Mapping[str, float]) -> str:
    """Return a sentence on the effective draws per evaluation of the frozen mixture; empty without a run of it."""
    of_frozen = [one for one in found if one.move == FROZEN and one.verdict == "converged"]
    ratios = [one.per_evaluation / first[one.experiment] for one in of_frozen]
    if not ratios:
        return ""
    low, high = (significant(ratio, 2) for ratio in (min(ratios), max(ratios)))
    ratio = f"{low} to {high} times as many effective draws per evaluation"
    return f" The frozen mixture gives {ratio} as the stretch move."


def page(found: list[Found]) -> str:
    """Return the page in Markdown."""
    first = {one.experiment: one.per_evaluation for one in reversed(found) if one.move == "stretch"}
    header = (
        "experiment, pairing", "move", "acceptance rate", "autocorrelation time, steps",
        "effective draws per 1000 evaluations", "relative to stretch",
        f"evaluations for {WANTED} effective draws, warm-up included", "converged",
    )  # fmt: skip
    lines = []
    for one in found:
        is_converged = one.verdict == "converged"
        about = "" if is_converged else "≈ "
        lines.append(
            (
                one.experiment,
                one.move,
                share(one.accepted),
                about + significant(one.time, 2),
                about + significant(1000 * one.per_evaluation, 2),
                about + significant(one.per_evaluation / first[one.experiment], 2),
                about + whole(round(one.for_wanted, -2)),
                "yes" if is_converged else "no",
            )
        )
    apart = disagreements(found)
    said = f"They disagree: {'; '.join(apart)}." if apart else "All moves that have converged agree in the means."
    return (
        "# Moves of emcee\n\n"
        "Do different moves of plain emcee find the same posterior, and which needs the fewest evaluations? "
        f"**{said}{gain_in_words(found, first)}**\n\n"
        f"Each move samples the paper's four experiments with {ENSEMBLES} ensembles of {WALKERS} walkers, which "
        f"start at `problem.walkers(n, seed)`. The warm-up has {USUAL} steps, or {SHORT} with the mixture. A run "
        f"ends when it has {ENOUGH} autocorrelation times, or after {whole(LENGTHS[-1])} steps. The number of "
        "effective draws is the smallest bulk ESS of `fmu.summary`. `fmu.diagnose` judges convergence; numbers of "
        "runs that have not converged are rough (≈).\n\n"
        "`fmu.MixtureMove` proposes candidates from a Gaussian mixture. The mixture is either fitted to the other "
        "half of the walkers in every step, or fitted in the warm-up (`tune=True`) and then frozen. The snooker "
        "move is the one of `fmu.samplers.snooker`, because emcee's own does not leave the posterior "
        "invariant.\n\n" + markdown_table(header, lines, words=(0, 1, 7))
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Try all moves on all experiments and write the page."""
    parser = study_parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="one experiment, and short runs")
    asked = parser.parse_args(arguments)
    experiments, lengths = (EXPERIMENTS[2:3], LENGTHS[:1]) if asked.quick else (EXPERIMENTS, LENGTHS)

    def run(job: tuple[str, str, str]) -> Found:
        case, pairing, move = job
        return tried(fmu.cases.load(case, pairing), f"{case}, by {pairing}", move, lengths)

    jobs = [(*experiment, move) for experiment in experiments for move in MOVES]
    units = Units(asked.kept, asked.minutes)
    found = units.completed("runs", each(jobs), run, fields_of(Found, np.array))
    (asked.out / "emcee-moves.md").write_text(page(found), encoding="utf-8")
    return 1 if disagreements(found) else 0


if __name__ == "__main__":
    sys.exit(main())
