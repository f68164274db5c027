"""The page of the peers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fmu.numbers import names_in_words, significant, whole, with_sd
from fmu.tables import markdown_table
from tests.benchmarks.peers.contenders import COSTLY, ENOUGH, OURS, SEEDS
from tests.benchmarks.peers.nested import MOST_CALLS, MOST_S
from tests.benchmarks.peers.posteriors import Target
from tests.benchmarks.peers.rows import FAR, GOOD, NEAR_ENOUGH, Row, deviation, doubts, reference
from tests.benchmarks.table import machine

UNITS = (("evaluations", "evaluation"), ("cpu_s", "second"))
WANTED = {"shear-10dof": 2.0, "garteur": 2.0, "frame-50": 2.0}
"""How many times the best peer the better of mixture and HMC should be, all counted."""
MOST_OVERHEAD = 1.05
"""Time of a step of fmu's sampler "emcee" over that of emcee alone, with the same moves."""

TEXT = """Written by `python -m tests.benchmarks.peers --posterior {key} results`. {machine} {done}.

Every sampler on the posterior of {title}, with {parameters} parameters, from starts drawn from the prior, the
same for all; {seeds} seeds each, of PINTS and the nested samplers one; medians. Everything has one processor
core, and seconds are processor seconds. ESS is the bulk ESS of the worst parameter, of an ensemble by its
autocorrelation time, of weighted draws Kish's. An *evaluation* is a log-probability inside the bounds; a
gradient counts as the time that it takes, of the same model and in batches of four. *In all* is a run to
{enough} effective draws with its search for maxima and its warm-up as they are, and its draws in proportion; a
nested sampler cannot stop earlier, so that its run counts as it is. Compilation is not counted.

- **fmu**: as `fmu run --until-ess {enough}` runs each sampler, the search for maxima included.
- **emcee**: four ensembles of 32 walkers (of 2 n + 2 with more parameters), 16 000 + 24 000 evaluations each;
  its default moves, differential evolution with snooker, the moves of fmu's sampler, and `fmu.MixtureMove` with
  differential evolution.
- **NUTS**: four chains, 1000 + 500 steps, in coordinates without bounds, as the libraries treat bounds: NumPyro's
  on the same model in JAX (float64), where there is one, nutpie's on fmu's gradient.
- **PINTS**: its default, four chains of 3000 + 9000 steps.
- **nautilus, dynesty, UltraNest, nessai, pocoMC**: their defaults on four of the posteriors, on prior and
  likelihood over the unit cube, at most {calls} likelihoods and {minutes} minutes of one core.
- Where runs take ten times as long, chains of peers have a share of these steps, and fmu's samplers run to the
  same share of the effective draws: {costly}.
- *Means, se*: how far the means are from those of the reference, in standard errors, the largest over the
  parameters; the reference is the peer with whose means most others agree, of several one with a log-evidence,
  and then the one with most effective draws. emcee's snooker move (up to version 3.1.6) accepts by another
  factor than that of its authors, ter Braak & Vrugt (2008).
- *Right*: the run has ended by itself (fmu's: its verdict is good), its chains agree (R-hat below {good}), its
  means are within {far} standard errors, and its log-evidence within {far} of the best peer's, or within {near}.

Versions: {versions}.
"""


def page(target: Target, rows: list[Row], wrapping: float, done: str, versions: Mapping[str, str]) -> str:
    """Return the page of a posterior, without its picture.

    `wrapping` is the time of a step of fmu's sampler "emcee" over that of emcee with the same moves.
    """
    rows = sorted(rows, key=lambda row: -np.nan_to_num(row.per("evaluations", True)))
    text = TEXT.format(
        key=target.key, parameters=target.problem.ndim, title=target.title, done=done, machine=machine(),
        seeds=len(SEEDS), enough=whole(ENOUGH), calls=whole(MOST_CALLS), minutes=whole(MOST_S / 60.0),
        costly=names_in_words([f"{key} {significant(share)}" for key, share in COSTLY.items()]),
        good=significant(GOOD, 3), far=whole(FAR), near=significant(NEAR_ENOUGH),
        versions=", ".join(f"{name} {version}" for name, version in versions.items()),
    )  # fmt: skip
    parts = [f"# Samplers and their peers: {target.title}\n", first_line(rows), text, comparison(target, rows)]
    return "\n".join([*parts, overhead(wrapping), table(rows)])


def best(rows: list[Row], unit: str, whole_run: bool) -> tuple[Row, Row] | None:
    """Return the better of fmu's mixture and HMC, and the best peer, of those that are right."""
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
    """Say where a peer is ahead, and what would be needed to pass it."""
    behind = []
    for unit, word in UNITS:
        pair = best(rows, unit, True)
        if pair is None:
            return (
                "**There is no run of fmu's mixture or HMC and of a peer that is right: nothing is compared.**\n"
            )
        ours, theirs = pair
        by = theirs.per(unit, True) / ours.per(unit, True)
        if by > 1.0:
            needed = f"{ours.name} would need {significant(by, 2)} times as many effective draws"
            behind.append(f"{theirs.name} per {word} ({needed})")
    if behind:
        return f"**A peer is ahead, all counted: {'; '.join(behind)}.**\n"
    return "**No peer that is right is ahead of the better of fmu's mixture and HMC, all counted.**\n"


def comparison(target: Target, rows: list[Row]) -> str:
    """Return the table of the better of mixture and HMC over the best peer."""
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
        ["", "the better of mixture and HMC", "the best peer", "ratio", "wanted", "met"], lines, (0, 1, 2)
    )


def overhead(wrapping: float) -> str:
    """Return a sentence on the cost of fmu's wrapping of emcee."""
    met = "met" if wrapping <= MOST_OVERHEAD else "**missed**"
    return (
        f"A step of fmu's sampler *emcee* takes {significant(wrapping, 3)} times as long as a step of emcee with "
        f"the same moves, from the same walkers (at most {significant(MOST_OVERHEAD, 3)} wanted: {met}).\n"
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
    head = ["sampler", "search", "warm-up", "draws", "ESS", "ESS per evaluation", "in all", "ESS per s", "in all"]
    return markdown_table([*head, "log-evidence", "means, se", "right"], lines, (0, 11))
