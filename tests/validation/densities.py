"""Test the verdict of `fmu.diagnose` with plain log-densities whose moments are known exactly.

    python -m tests.validation.densities OUT [--kept DIRECTORY] [--minutes M]

Writes ``densities.md``. Each run draws until it has converged or has used up its evaluations. Exit code 1 if a
mean, a standard deviation or the evidence of a run called converged (not only locally) is off by more than five
standard errors, or if fewer than 90 % of the runs on densities with one maximum and light tails are called so.
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
from fmu.numbers import MISSING, names_in_words, share, significant, whole
from fmu.tables import markdown_table
from tests import densities, plain_densities
from tests.validation.kept import Units, fields_of, study_parser

SEEDS = {"mixture": 9, "hmc": 7, "mh": 7, "slice": 6, "emcee": 4}
"""Runs of each sampler on each density."""
MOST_SOLVES = dict.fromkeys(SEEDS, 50_000) | {"emcee": 260_000}
"""Evaluations at which a run ends. An ensemble needs more: 50 autocorrelation times of all walkers."""
UNTIL_ESS, FAR, ENOUGH = 400, 5.0, 0.9
"""ESS at which a run ends, standard errors beyond which it is wrong, and required share of converged runs."""
CONVERGED, LOCALLY, NOT = "converged", "converged locally", "not converged"


@dataclass(frozen=True)
class Row:
    """One run: its verdict, its evaluations, and its largest errors in standard errors.

    `z` is of the means and standard deviations, and `z_evidence` of the log-evidence (NaN if it is not estimated
    reliably). `z_skew` is the largest of Johnson's modified t statistics (`modified`) of means and variances.
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
        """Whether the run is called converged, not only locally, and is wrong."""
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
        if not found.warnings:  # otherwise fmu warns that the standard error is not reliable
            z_evidence = abs(found.log_evidence - density.log_evidence) / found.error
    solves = sum(int(trace.attrs[name]) for name in ("n_solves", "warmup_n_solves"))
    state = fmu.diagnose(trace).state
    return Row(density.name, sampler, seed, state, solves, float(z), float(z_skew), float(z_evidence))


def modified(t: float, y: Any, error: float) -> float:
    """Return Johnson's modified t of a mean of `y` with a standard error (J. Am. Stat. Assoc. 73, 1978, eq. 2.5).

    If draws miss the tail of a skewed quantity, its mean and its standard error are both too small, so that t is
    skewed too.
    """
    skewness = float(np.mean(((y - y.mean()) / y.std()) ** 3))
    return t + skewness * error / y.std() * (1.0 / 6.0 + t**2 / 3.0)


def cases() -> Iterator[tuple[Any, str, int]]:
    """Yield every density, sampler and seed: all with the first seed, then all with the second, and so on."""
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
    simple, local = usual(rows, made), [row for row in rows if row.state == LOCALLY]
    by_sampler = {name: share_converged([row for row in simple if row.sampler == name]) for name in SEEDS}
    table = []
    for name, density in made.items():
        cells = [name, str(density.ndim), "one" if density.has_one_maximum else "several"]
        for sampler in SEEDS:
            mine = [row for row in rows if (row.density, row.sampler) == (name, sampler)]
            cells.append(_cell(mine))
        table.append(tuple(cells))
    header = ("density", "coordinates", "maxima", *SEEDS)
    return PAGE.format(
        called=len(called),
        far=significant(FAR),
        wrong=len(wrong),
        names="".join(f" ({row.density}, {row.sampler}, seed {row.seed})" for row in wrong),
        converged=share(share_converged(simple)),
        enough=share(ENOUGH),
        runs=len(rows),
        densities=len(made),
        ess=UNTIL_ESS,
        most=whole(MOST_SOLVES["mixture"]),
        most_emcee=whole(MOST_SOLVES["emcee"]),
        skewed=sum(row.z_skew > FAR for row in called),
        bent=names_in_words(BENT),
        simple=len(simple),
        by_sampler=", ".join(f"{name} {share(part)}" for name, part in by_sampler.items()),
        not_converged=sum(row.state == NOT for row in simple),
        local=len(local),
        off=sum(row.z > FAR for row in local),
        table=markdown_table(header, table, words=(0, 2, 3, 4, 5, 6, 7)),
    )


def _cell(rows: list[Row]) -> str:
    if not rows:
        return MISSING
    states = [row.state for row in rows]
    counts = " / ".join(str(states.count(state)) for state in (CONVERGED, LOCALLY, NOT))
    good = [row.z for row in rows if row.state in (CONVERGED, LOCALLY)]
    z = significant(max(good), 2) if good else MISSING
    return f"{counts}; {whole(float(np.median([row.solves for row in rows])))}; {z}"


BENT = ("banana", "helix", "shell")
"""Densities with one maximum and light tails that fill so little of their boxes that the search misses them."""


def usual(rows: list[Row], made: dict[str, Any]) -> list[Row]:
    """Return the runs on densities with one maximum and light tails, except those in `BENT`."""
    return [
        row for row in rows
        if made[row.density].has_one_maximum and made[row.density].has_light_tails and row.density not in BENT
    ]  # fmt: skip


def share_converged(rows: list[Row]) -> float:
    """Return the share of the runs called converged, not only locally."""
    return float(np.mean([row.state == CONVERGED for row in rows])) if rows else np.nan


def main() -> int:
    """Run the study and write the page."""
    asked = study_parser(__doc__).parse_args()
    keyed = (((density.name, sampler, seed), (density, sampler, seed)) for density, sampler, seed in cases())
    rows = Units(asked.kept, asked.minutes).completed("runs", keyed, lambda job: ran(*job), fields_of(Row))
    (asked.out / "densities.md").write_text(page(rows), encoding="utf-8")
    made = {d.name: d for d in (make() for make in (*densities.ALL, *plain_densities.ALL))}
    return int(any(row.is_wrong for row in rows) or not share_converged(usual(rows, made)) >= ENOUGH)


PAGE = """# Verdicts on plain log-densities

Are the runs correct that `fmu.diagnose` calls converged, and do most runs on simple densities converge?
**{called} runs are called converged, not only locally. Runs off by more than {far} Monte-Carlo standard errors in
a mean, a standard deviation or the evidence: {wrong}{names}. On simple densities, {converged} of the runs
converge; {enough} are required.**

The study has {runs} runs on {densities} densities with exact moments (`tests/densities.py`,
`tests/plain_densities.py`). A run ends when R-hat is below 1.01 and the ESS is {ess}, or after about {most}
evaluations ({most_emcee} with emcee), warm-up included. No setting was tuned for a density.

- **Skewness.** By Johnson's modified t statistic of means and variances, which allows for skewness, {skewed} of
  the {called} runs are off.
- **Simple densities** have one maximum and light tails. {bent} are excluded: they fill so little of their boxes
  that no point of the search falls on them. Of {simple} runs, the shares called converged are {by_sampler}.
  {not_converged} runs did not converge within their evaluations.
- **Converged locally.** A run has converged only locally if the search found the maximum from a single start, or
  if none of its points fell where the draws are. The search could then have missed another mode as narrow as this
  one. Of {local} runs that converged locally, {off} are off. In three-widths, for example, no search finds the
  modes of width 0.02 and 0.1: starts in only 1e-8 and 1e-5 of the box lead to them.

Each cell has the numbers of runs that converged / converged locally / did not converge; the median number of
evaluations, without the search for maxima; and the largest error of a mean or a standard deviation in the runs
that converged, locally or not, in Monte-Carlo standard errors.

{table}"""


if __name__ == "__main__":
    sys.exit(main())
