"""Verdicts on runs on plain log-densities with exact moments.

    python -m tests.validation.densities OUT [--kept DIRECTORY] [--minutes M]

Writes ``densities.md``. Each run draws until the verdict is good or its evaluations are spent. Exit code 1 if a
run is called converged, without "locally", whose means, standard deviations or evidence are off by more than five
standard errors; or if fewer than 90 % of the runs on densities with one maximum and light tails are called
converged without it.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import fmu
from fmu.analysis.convergence.effective import mcse_mean, mcse_sd
from fmu.analysis.evidence import has_candidates
from fmu.analysis.trace.reading import parameter_draws, walkers_of
from fmu.numbers import MISSING, share, significant, whole
from fmu.tables import markdown_table
from tests import densities, plain_densities
from tests.validation.kept import Units, fields_of, study_parser

SEEDS = {"mixture": 9, "hmc": 7, "mh": 7, "slice": 6, "emcee": 4}
"""Runs of each sampler on each density."""
MOST_SOLVES = dict.fromkeys(SEEDS, 50_000) | {"emcee": 260_000}
"""Evaluations at the end of a run. An ensemble needs 50 autocorrelation times of all of its walkers."""
UNTIL_ESS, FAR, ENOUGH = 400, 5.0, 0.9
"""Effective draws, standard errors that count as wrong, share that is enough."""
CONVERGED, LOCALLY, NOT = "converged", "converged locally", "not converged"


@dataclass(frozen=True)
class Row:
    """One run: its verdict, its evaluations, and its largest error in standard errors.

    `z_skew` is the largest of Johnson's modified t (see `modified`).
    """

    density: str
    sampler: str
    seed: int
    state: str
    solves: int
    z: float
    z_skew: float
    z_evidence: float

    @property
    def is_wrong(self) -> bool:
        """Whether it is called converged, without "locally", and is wrong."""
        return self.state == CONVERGED and max(self.z, np.nan_to_num(self.z_evidence)) > FAR


def ran(density: Any, sampler: str, seed: int) -> Row:
    """Sample a density, and compare the draws with its exact moments."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trace = fmu.sample(density, sampler, seed=seed, until_ess=UNTIL_ESS, max_solves=MOST_SOLVES[sampler])
    draws, walkers = parameter_draws(trace), walkers_of(trace)
    z, z_skew, z_evidence = 0.0, 0.0, np.nan
    for k in range(density.ndim):
        x = draws[:, :, k]
        of_mean, of_sd = mcse_mean(x, walkers), mcse_sd(x, walkers)
        errors = ((x.mean() - density.mean[k]) / of_mean, (x.std() - density.sd[k]) / of_sd)
        z = max(z, *map(abs, errors))
        squares = (x - x.mean()) ** 2
        skewed = (modified(errors[0], x, of_mean), modified(errors[1], squares, 2.0 * x.std() * of_sd))
        z_skew = max(z_skew, *map(abs, skewed))
    if has_candidates(trace):
        found = fmu.evidence(trace)
        if not found.warnings:  # otherwise it says itself that its error is not reliable
            z_evidence = abs(found.log_evidence - density.log_evidence) / found.error
    solves = sum(int(trace.attrs[name]) for name in ("n_solves", "warmup_n_solves"))
    state = fmu.diagnose(trace).state
    return Row(density.name, sampler, seed, state, solves, float(z), float(z_skew), float(z_evidence))


def modified(t: float, y: Any, error: float) -> float:
    """Return Johnson's modified t of a mean of `y` with a standard error (J. Am. Stat. Assoc. 73, 1978, eq. 2.5).

    The standard error of a skewed quantity is small where draws have missed its tail, so that t itself is skewed.
    """
    skewness = float(np.mean(((y - y.mean()) / y.std()) ** 3))
    return t + skewness * error / y.std() * (1.0 / 6.0 + t**2 / 3.0)


def cases() -> Iterator[tuple[Any, str, int]]:
    """Yield every density, sampler and seed, one seed of all after the other."""
    for seed in range(1, max(SEEDS.values()) + 1):
        for make in (*densities.ALL, *plain_densities.ALL):
            for sampler, seeds in SEEDS.items():
                if seed <= seeds:
                    yield make(), sampler, seed


def page(rows: list[Row]) -> str:
    """Return the page on all runs."""
    made = {d.name: d for d in (make() for make in (*densities.ALL, *plain_densities.ALL))}
    wrong = [row for row in rows if row.is_wrong]
    called = [row for row in rows if row.state == CONVERGED]
    of = usual(rows, made)
    lines = [
        "# Verdicts on plain log-densities",
        f"{len(rows)} runs on {len(made)} densities with exact moments (tests/densities.py, "
        f"tests/plain_densities.py), each until R-hat < 1.01 and an ESS of {UNTIL_ESS}, or "
        f"{whole(MOST_SOLVES['mixture'])} evaluations, warm-up among them; for emcee "
        f"{whole(MOST_SOLVES['emcee'])}. Nothing was tuned for a density. By `python -m "
        "tests.validation.densities results`.",
        f"**{len(called)} runs are called converged, without “locally”. Off by more than {significant(FAR)} "
        f"standard errors in a mean, a standard deviation or an evidence: {len(wrong)}"
        f"{''.join(f' ({row.density}, {row.sampler}, seed {row.seed})' for row in wrong)}.** By Johnson's "
        f"modified t, which allows for skewness, {sum(row.z_skew > FAR for row in called)} are. Of "
        f"{sum(row.state == LOCALLY for row in rows)} runs that are called converged locally "
        f"{sum(row.state == LOCALLY and row.z > FAR for row in rows)} are off: that is what the word is for.",
        f"Of the {len(of)} runs on densities with one maximum and light tails that the points searched are dense "
        f"enough for (all but {', '.join(BENT)}), {share(share_converged(of))} are called converged without it: "
        + ", ".join(f"{name} {share(share_converged([r for r in of if r.sampler == name]))}" for name in SEEDS)
        + f". {share(ENOUGH)} are wanted. The others did not converge within their evaluations.",
        "“Locally”: the search found a maximum from one start alone, or none of its points fell where the draws "
        "are, so that another mode as narrow as theirs would not have been found either. three-widths shows "
        "why: its modes of width 0.02 and 0.1 attract 1e-8 and 1e-5 of the box, so that no search finds them.",
        "Numbers: runs converged / converged locally / not converged within the evaluations; then the median "
        "evaluations, search left out; then the largest error of those called converged, in standard errors.",
    ]
    table = []
    for name, density in made.items():
        cells = [name, str(density.ndim), "one" if density.has_one_maximum else "several"]
        for sampler in SEEDS:
            mine = [row for row in rows if (row.density, row.sampler) == (name, sampler)]
            cells.append(_cell(mine))
        table.append(tuple(cells))
    header = ("density", "coordinates", "maxima", *SEEDS)
    return "\n\n".join([*lines, markdown_table(header, table, words=(0, 2, 3, 4, 5, 6, 7))]) + "\n"


def _cell(rows: list[Row]) -> str:
    if not rows:
        return MISSING
    states = [row.state for row in rows]
    counts = " / ".join(str(states.count(state)) for state in (CONVERGED, LOCALLY, NOT))
    good = [row.z for row in rows if row.state in (CONVERGED, LOCALLY)]
    z = significant(max(good), 2) if good else MISSING
    return f"{counts}; {whole(float(np.median([row.solves for row in rows])))}; {z}"


BENT = ("banana", "helix", "shell")
"""They have one maximum and light tails, but are so thin in their boxes that points do not meet them."""


def usual(rows: list[Row], made: dict[str, Any]) -> list[Row]:
    """Return the runs on densities with one maximum and light tails, but bent or hollow ones."""
    return [
        row for row in rows
        if made[row.density].has_one_maximum and made[row.density].has_light_tails and row.density not in BENT
    ]  # fmt: skip


def share_converged(rows: list[Row]) -> float:
    """Return the share of the runs called converged, without "locally"."""
    return float(np.mean([row.state == CONVERGED for row in rows])) if rows else np.nan


def main() -> int:
    """Run the study and write the page."""
    asked = study_parser(__doc__).parse_args()
    keyed = (((density.name, sampler, seed), (density, sampler, seed)) for density, sampler, seed in cases())
    rows = Units(asked.kept, asked.minutes).completed("runs", keyed, lambda job: ran(*job), fields_of(Row))
    (asked.out / "densities.md").write_text(page(rows), encoding="utf-8")
    made = {d.name: d for d in (make() for make in (*densities.ALL, *plain_densities.ALL))}
    return int(any(row.is_wrong for row in rows) or not share_converged(usual(rows, made)) >= ENOUGH)


if __name__ == "__main__":
    sys.exit(main())
