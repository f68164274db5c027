"""The page of the whole runs: python -m tests.benchmarks.peers.whole_runs.page RUN.json OUT.md FIGURE.png."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from fmu.numbers import whole, with_sd
from fmu.tables import markdown_table
from tests.benchmarks.peers.figure import short
from tests.benchmarks.peers.whole_runs.figure import draw
from tests.benchmarks.peers.whole_runs.rows import (
    FAR,
    KNOWN,
    NEAR_ENOUGH,
    WholeRow,
    by_posterior,
    deviation,
    doubts,
    reference,
)
from tests.benchmarks.peers.whole_runs.runs import COSTLY, ENOUGH, MOST_CALLS, ON_COSTLY, OTHERWISE
from tests.benchmarks.table import machine

TEXT = """# Whole runs: from nothing to {enough} effective draws

Written by `make bench`. {machine}

Each sampler by itself with its defaults, until it has {enough} effective draws. All evaluations count: the search
for maxima, warm-up, and whatever else comes before the draws. The unit is one log-probability, as the model is
asked for it; a gradient counts as what it costs. What a run has at its end counts in full: nautilus must explore
the whole prior first, and then often has more than it was asked for.

- fmu's samplers as `fmu run --until-ess {enough}` runs them: `fmu.find_map`, the warm-up and the first draws that
  it takes, then until the verdict is good and bulk and tail ESS of every parameter are enough. {seeds}; medians.
- nautilus with its four networks, and with ellipsoids alone (`n_networks=0`), in batches (`vectorized=True`), to
  `n_eff={enough}`; *warm-up* is its exploration, whose points it keeps. dynesty's dynamic sampler, which its
  documentation recommends for posteriors, to `n_effective={enough}`; it takes one point at a time. One seed each,
  at most {most} calls. They get prior transform and likelihood, and their ESS is Kish's, of the weighted
  draws: equally weighted ones would have less.
- On {costly}, whose log-probability takes some thirty times as long as the others', fmu runs {there} alone, and a
  peer has at most {least} calls.
- *Means, se*: how far the means are from those of the reference, in standard errors, the largest over the
  parameters; the reference is the peer with most effective draws. Were it wrong, all others would be far off.
  *Log-evidence*: of the mixture by importance.
- *Right*: the run has ended by itself (fmu's: its verdict is good), its means are within {far:g} standard errors,
  and its log-evidence within {far:g} of the value known, or of the reference's, or within {near:g} of it.

Everything had one processor core; seconds are processor seconds. Versions: {versions}.
"""

WANTED_AFTER = {
    "cantilever-young, pairing by shape": 0.40,
    "cantilever-young, pairing by number": 0.60,
    "cantilever-section, pairing by shape": 0.60,
    "cantilever-section, pairing by number": 0.60,
    "garteur, pairing by shape": 0.12,
}
"""ESS per evaluation after warm-up that the mixture sampler was to have."""
WANTED_WHOLE = {"cantilever-young, pairing by shape": 0.25}
GOALS = f"""Wanted of a run to {ENOUGH}: not less than the better nautilus has on the same posterior, and 0.25 on
cantilever-young by shape. nautilus ends when it has explored the prior, and shares that among more draws.
Last column: what the mixture would have per evaluation with as many, its search and warm-up as they are and its
draws in proportion.
"""
MIXTURE, NAUTILUS = "mixture", "nautilus"


def main(source: str, target: str, figure: str) -> None:
    """Write page and figure."""
    result = json.loads(Path(source).read_text())
    rows = [WholeRow.read(row) for row in result["rows"]]
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    picture = Path(figure).relative_to(Path(target).parent)
    Path(target).write_text("\n".join([*page(rows, result["versions"]), f"![Whole runs]({picture})\n"]))
    draw(by_posterior(rows), figure)


def page(rows: list[WholeRow], versions: dict[str, Any]) -> list[str]:
    """Return the parts of the page, without the figure."""
    counts = {row.label: len(row.runs) for row in rows if row.ours}
    several = max(counts.values())
    text = TEXT.format(
        machine=machine(),
        enough=ENOUGH,
        seeds=f"The mixture has {several} seeds, the others one" if several > 1 else "One seed each",
        most=whole(OTHERWISE),
        least=whole(MOST_CALLS[COSTLY]),
        costly=COSTLY,
        there=" and ".join(ON_COSTLY),
        far=FAR,
        near=NEAR_ENOUGH,
        versions=", ".join(f"{name} {version}" for name, version in versions.items()),
    )
    parts = [text, goals(rows)]
    for name, of_posterior in by_posterior(rows).items():
        parts += [f"## {name}\n", table(of_posterior)]
    return parts


def goals(rows: list[WholeRow]) -> str:
    """Return what was wanted of the mixture sampler on every posterior beside what was measured."""
    lines = []
    for name, of_posterior in by_posterior(rows).items():
        mixture = next(row for row in of_posterior if row.label == MIXTURE)
        theirs = [row for row in of_posterior if row.label.startswith(NAUTILUS) and row.ended]
        best = theirs[0] if theirs else None  # most per evaluation first
        least = max(WANTED_WHOLE.get(name, 0.0), best.per_evaluation() if best else 0.0)
        lines.append(
            [
                name,
                *_judged(mixture.after_warmup(), WANTED_AFTER.get(name, 0.0)),
                *_judged(mixture.per_evaluation(), least),
                short(best.per_evaluation()) if best else "not at an end",
                _for_ess(mixture),
                _for_ess(best) if best else "—",
                short(best.ess() / mixture.needed(best.ess())) if best else "—",
            ]
        )
    head = ["ESS per evaluation of the mixture", "after warm-up", "wanted", "met", "everything counted", "wanted"]
    head += ["met", "best nautilus", "evaluations for ESS", "of that nautilus", "mixture to its ESS"]
    return f"{markdown_table(head, lines, (0, 3, 6))}\n{GOALS}"


def _judged(value: float, least: float) -> tuple[str, str, str]:
    """Return what was measured, what was wanted, and whether that is met; 0 for nothing."""
    if least == 0.0:
        return short(value), "—", "—"
    return short(value), f"≥ {short(least)}", "yes" if value >= least else "**no**"


def _for_ess(row: WholeRow) -> str:
    return f"{whole(row.spent('cost'))} for {whole(row.ess())}"


def table(rows: list[WholeRow]) -> str:
    """Return the table of one posterior."""
    lines = []
    for row in rows:
        found, away = row.evidence(), "reference"
        if row is not reference(rows):
            away = f"{deviation(row, rows):.1f}"
        parts = [whole(row.spent(part)) for part in ("search", "warmup", "draws")]
        wrong = doubts(row, rows)
        lines.append(
            [
                f"**{row.name}**" if row.ours else row.name,
                *parts,
                whole(row.ess()),
                short(row.per_evaluation()),
                short(row.per_second()),
                "" if found is None else with_sd(*found),
                away,
                f"**no**: {', '.join(wrong)}" if wrong else "yes",
            ]
        )
    if rows[0].posterior in KNOWN:
        value, error = KNOWN[rows[0].posterior]
        lines.append(["*known*", *[""] * 6, with_sd(value, error), "", ""])
    head = ["sampler", "search", "warm-up", "draws", "ESS", "ESS per evaluation", "ESS per s", "log-evidence"]
    return markdown_table([*head, "means, se", "right"], lines, (0, 9))


if __name__ == "__main__":
    main(*sys.argv[1:])
