"""The page that compares the samplers of fmu with other libraries on one posterior."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fmu.numbers import names_in_words, significant, whole, with_sd
from fmu.tables import markdown_table
from tests.benchmarks.peers.contenders import COSTLY, ENOUGH, OURS, SEEDS
from tests.benchmarks.peers.nested import MOST_CALLS, MOST_S
from tests.benchmarks.peers.posteriors import Target
from tests.benchmarks.peers.rows import FAR, GOOD, NEAR_ENOUGH, Row, deviation, doubts, reference

UNITS = (("evaluations", "evaluation"), ("cpu_s", "second"))
WANTED = {"shear-10dof": 2.0, "garteur": 2.0, "frame-50": 2.0}
"""Wanted ratio of the better of fmu's mixture and HMC to the best other sampler, whole runs counted."""
MOST_OVERHEAD = 1.05
"""Wanted largest time of a step of fmu's sampler "emcee", relative to emcee with the same moves."""

TEXT = """How many effective draws per log-probability and per second do the samplers of fmu give, compared with
other libraries (peers)? {verdict}

The posterior is of {title}, with {parameters} parameters. Chains and ensembles of peers start at draws from the
prior, the same for all; fmu's samplers start at the maxima of their search. There are up to {seeds} seeds, and one
for PINTS and the nested samplers. Tables show medians ({done}).

- *ESS* is the bulk ESS of the worst parameter. Ensembles use their autocorrelation time, and weighted draws Kish's
  formula.
- An *evaluation* is a log-probability inside the bounds. A gradient counts as its time, in log-probabilities of
  the same model in batches of four. Seconds are processor seconds on one core, without compilation.
- *In all* is a run to {enough} effective draws, including search for maxima and warm-up. The draws are counted in
  proportion. A nested sampler cannot stop earlier, so its whole run counts.
- *Means, se* is the largest difference between the posterior means and those of the reference, in standard
  errors. The reference is the peer whose means agree with most other peers; ties are decided by a log-evidence
  and then by the number of effective draws.
- *Right*: the run has finished (for fmu: with a good verdict), its chains agree (R-hat below {good}), its means
  are within {far} standard errors of the reference, and its log-evidence is within {far} standard errors of the
  best peer's, or within {near}.

{comparison}
{overhead}
The columns *search*, *warm-up* and *draws* are numbers of evaluations.

{table}
Settings:

- fmu: each sampler runs as with `fmu run --until-ess {asked:g}`, including the search for maxima.
- emcee: four ensembles of 32 walkers (2 n + 2 if there are more parameters n), 16 000 evaluations of warm-up and
  24 000 of draws each. The moves are the default ones, differential evolution with snooker moves, the moves of
  fmu's sampler, and `fmu.MixtureMove` with differential evolution. The snooker move of emcee (up to version
  3.1.6) uses another acceptance factor than its authors, ter Braak & Vrugt (2008).
- NUTS: four chains, 1000 steps of warm-up and 500 draws, in unbounded coordinates. NumPyro uses the same model
  in JAX (float64), where there is one; nutpie uses the gradient of fmu.
- PINTS: its default sampler, four chains with 3000 steps of warm-up and 9000 draws.
- nautilus, dynesty, UltraNest, nessai, pocoMC: their defaults, with prior and likelihood on the unit cube, on
  four of the posteriors; at most {calls} likelihoods and {minutes} minutes of one core.
- Some posteriors take about ten times as long. There, chains of peers have a share of these steps, and fmu's
  samplers run to the same share of the effective draws: {costly}.

Versions: {versions}.
"""


def page(target: Target, rows: list[Row], wrapping: float, done: str, versions: Mapping[str, str]) -> str:
    """Return the page of a posterior, without its picture.

    `wrapping` is the time of a step of fmu's sampler "emcee" relative to emcee with the same moves. `done` says
    how many runs are done.
    """
    rows = sorted(rows, key=lambda row: -np.nan_to_num(row.per("evaluations", True)))
    text = TEXT.format(
        verdict=first_line(rows), comparison=comparison(target, rows), overhead=overhead(wrapping),
        table=table(rows), parameters=target.problem.ndim, title=target.title, done=done,
        seeds=len(SEEDS), asked=ENOUGH, enough=whole(ENOUGH), calls=whole(MOST_CALLS),
        minutes=whole(MOST_S / 60.0),
        costly=names_in_words([f"{key} {significant(share)}" for key, share in COSTLY.items()]),
        good=significant(GOOD, 3), far=whole(FAR), near=significant(NEAR_ENOUGH),
        versions=", ".join(f"{name} {version}" for name, version in versions.items()),
    )  # fmt: skip
    return f"# Samplers of fmu and of other libraries: {target.title}\n\n{text}"


def best(rows: list[Row], unit: str, whole_run: bool) -> tuple[Row, Row] | None:
    """Return the better of fmu's mixture and HMC, and the best peer, among the rows that are right."""
    right = [row for row in rows if not doubts(row, rows)]
    ours = [row for row in right if row.ours and row.label in OURS]
    theirs = [row for row in right if not row.ours]
    if not (ours and theirs):
        return None
    return (
        max(ours, key=lambda row: row.per(unit, whole_run)),
        max(theirs, key=lambda row: row.per(unit, whole_run)),
    )


def first_line(rows: list[Row]) -> str:
    """Return the verdict: whether a peer is ahead of fmu, and by how much."""
    behind = []
    for unit, word in UNITS:
        pair = best(rows, unit, True)
        if pair is None:
            return "**Nothing can be compared: fmu's mixture and HMC, or all peers, have no run that is right.**"
        ours, theirs = pair
        by = theirs.per(unit, True) / ours.per(unit, True)
        if by > 1.0:
            times = f"{significant(by, 2)} times as many effective draws per {word}"
            behind.append(f"{theirs.name} gives {times} as {ours.name}")
    if behind:
        return f"**A peer is ahead over a whole run: {'; '.join(behind)}.**"
    return "**No peer with a right result is ahead of the better of fmu's mixture and HMC over a whole run.**"


def comparison(target: Target, rows: list[Row]) -> str:
    """Return the table that compares the better of mixture and HMC with the best peer."""
    wanted, lines = WANTED.get(target.case), []
    for unit, word in UNITS:
        for in_all in (False, True):
            pair = best(rows, unit, in_all)
            if pair is None:
                continue
            ours, theirs = (row.per(unit, in_all) for row in pair)
            goal = ["—", "—"]
            if in_all and wanted is not None:
                goal = [f"{significant(wanted)} ×", "yes" if ours >= wanted * theirs else "**no**"]
            cells = [f"{row.name}: {significant(row.per(unit, in_all), 2)}" for row in pair]
            when = "in all" if in_all else "after warm-up"
            lines.append([f"ESS per {word}, {when}", *cells, f"{significant(ours / theirs, 2)} ×", *goal])
    return markdown_table(
        ["quantity", "the better of mixture and HMC", "the best peer", "ratio", "wanted", "met"], lines, (0, 1, 2)
    )


def overhead(wrapping: float) -> str:
    """Return a sentence on the time that fmu adds to a step of emcee."""
    met = "met" if wrapping <= MOST_OVERHEAD else "**missed**"
    return (
        f"A step of fmu's sampler *emcee* takes {significant(wrapping, 4)} times as long as a step of emcee with "
        f"the same moves from the same walkers (wanted: at most {significant(MOST_OVERHEAD, 3)}; {met}).\n"
    )


def table(rows: list[Row]) -> str:
    """Return the table of all samplers."""
    lines = []
    for row in rows:
        evidence, wrong = row.evidence(), doubts(row, rows)
        away = "reference" if row is reference(rows) else significant(deviation(row, rows), 2)
        lines.append(
            [
                f"**{row.name}**" if row.ours else row.name,
                *(whole(row.spent(part)) for part in ("search", "warmup", "draws")),
                whole(row.ess()),
                *(significant(row.per(unit, in_all), 2) for unit, _ in UNITS for in_all in (False, True)),
                "" if evidence is None else with_sd(*evidence),
                away,
                f"**no**: {', '.join(wrong)}" if wrong else "yes",
            ]
        )
    head = ["sampler", "search", "warm-up", "draws", "ESS"]
    head += [f"ESS per {unit}{part}" for unit in ("evaluation", "s") for part in ("", ", in all")]
    return markdown_table([*head, "log-evidence", "means, se", "right"], lines, (0, 11))
