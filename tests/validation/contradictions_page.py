"""The page of the study of pages that contradict themselves."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fmu.tables import markdown_table

if TYPE_CHECKING:
    from tests.validation.contradictions import Said


@dataclass(frozen=True)
class Checked:
    """One page: its problem in words, its verdicts, what is no maximum on it, and what it says against itself."""

    seed: int
    words: str
    fit: str
    is_converged: bool
    is_green: bool
    places: tuple[str, ...]
    against: tuple[str, ...]

    @classmethod
    def of(cls, seed: int, words: str, said: Said, against: Sequence[str]) -> Checked:
        """Return what is counted of a page."""
        fit, left, trust = (said.verdict(q) for q in ("Does the model fit", "Anything left", "Can the run"))
        header = next((list(row) for row, _ in said.rows("maxima")), [])
        places = tuple(name.split()[0] for name in header if name.split()[0] in ("jump", "edge", "slope"))
        verdict = fit.answer.split(":")[0].split(",")[0].split(" by ")[0].lower()
        return cls(seed, words, verdict, bool(trust.is_good), bool(left.is_good), places, tuple(against))


def write(found: Sequence[Checked], directory: Path, processor_s: float) -> None:
    """Write ``contradictions.md`` into the directory."""
    against = [one for one in found if one.against]
    verdict = f"**{len(against)} of {len(found)} pages contradict themselves.**"
    lines = [f"- problem {one.seed} ({one.words}): {line}" for one in against for line in one.against]
    fits = Counter(one.fit for one in found)
    rows = []
    for fit, n in fits.most_common():
        those = [one for one in found if one.fit == fit]
        rows.append(
            [fit, str(n), str(sum(one.is_converged for one in those)), str(sum(one.is_green for one in those))]
        )
    places = Counter(place for one in found for place in one.places)
    ends = "; ".join(f"{n} times at {'an' if place == 'edge' else 'a'} {place}" for place, n in places.items())
    ends = f"The search for maxima ended {ends}." if ends else "The search ended at maxima only."
    table = markdown_table(["the model", "pages", "converged", "nothing left undetermined"], rows)
    text = PAGE.format(
        minutes=f"{processor_s / 60:.0f}", verdict="\n\n".join([verdict, "\n".join(lines)]).strip(),
        table=table.strip(), n=len(found), ends=ends,
    )  # fmt: skip
    (directory / "contradictions.md").write_text(text, encoding="utf-8")


PAGE = """\
# Pages that contradict themselves

Written by `make validate` in {minutes} minutes of processor time.

{verdict}

{n} random problems: shear buildings of three to seven storeys, in one direction or in two whose modes cross,
with one to four stiffnesses as parameters. Truths, noise, bounds, priors, pairing and error models are random
too. A quarter of the truths lie beyond a bound, three in ten buildings have a storey that is softer than the
model can say, and the noise may be 0.3 or 3 times what is stated. Each is sampled for 250 draws in 4 chains,
and the words of its page are held against each other and against the log-probability of the problem:

- what is called a maximum and holds probability has nothing higher 0.05 posterior standard deviations away
- in a converged run the draws are divided among the maxima as the probability is; a jump, an edge or a slope
  has none
- intervals lie within the bounds; where most draws of a parameter are at a bound, it is not called determined
- a check that passes excludes no error that it saw; what could not fail is not counted; the counts are those
  of the table
- where the model is contradicted, the certainty first says that it assumes the model, and nothing is green
  beside it
- a converged run has the R-hat and the effective draws that it says are needed
- a mode that the others do not predict is named; means are the same on the first screen and in the table

{table}

{ends}

`tests/validation/test_contradictions.py` puts each fault that pages once had into a page: the checker turns.
The rules are in `tests/validation/contradictions.py`, the problems in
`tests/validation/contradictions_cases.py`.
"""
