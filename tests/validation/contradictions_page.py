"""The page of the study of contradictions within report pages."""

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
    """One report page: its problem in words, its verdicts, and its contradictions.

    Attributes
    ----------
    seed : int
        Number of the problem.
    words : str
        The problem in words.
    fit : str
        The verdict on the model.
    is_converged : bool
    is_green : bool
        Whether the page states that nothing is left undetermined.
    places : tuple of str
        Kinds of the points where the search for maxima ended that are not maxima: jump, edge or slope.
    against : tuple of str
        The contradictions, one sentence each, after the name of the rule.
    """

    seed: int
    words: str
    fit: str
    is_converged: bool
    is_green: bool
    places: tuple[str, ...]
    against: tuple[str, ...]

    @classmethod
    def of(cls, seed: int, words: str, said: Said, against: Sequence[str]) -> Checked:
        """Return the entries of a page that are counted."""
        fit, left, trust = (said.verdict(q) for q in ("Does the model fit", "Anything left", "Can the run"))
        header = next((list(row) for row, _ in said.rows("maxima")), [])
        places = tuple(name.split()[0] for name in header if name.split()[0] in ("jump", "edge", "slope"))
        verdict = fit.answer.split(":")[0].split(",")[0].split(" by ")[0].lower()
        return cls(seed, words, verdict, bool(trust.is_good), bool(left.is_good), places, tuple(against))


def write(found: Sequence[Checked], directory: Path, processor_s: float) -> None:
    """Write ``contradictions.md`` into the directory."""
    against = [one for one in found if one.against]
    verdict = f"**{len(against)} of {len(found)} report pages contradict themselves.**"
    lines = [
        f"- Problem {one.seed} ({one.words}): {line.partition(': ')[2]}" for one in against for line in one.against
    ]
    fits = Counter(one.fit for one in found)
    rows = []
    for fit, n in fits.most_common():
        those = [one for one in found if one.fit == fit]
        rows.append(
            [fit, str(n), str(sum(one.is_converged for one in those)), str(sum(one.is_green for one in those))]
        )
    places = Counter(place for one in found for place in one.places)
    ends = ", ".join(
        f"{'once' if n == 1 else f'{n} times'} at {'an' if place == 'edge' else 'a'} {place}"
        for place, n in places.items()
    )
    ends = f"The search for maxima ended {ends}." if ends else "The search for maxima ended at maxima only."
    table = markdown_table(["verdict on the model", "pages", "converged", "nothing left undetermined"], rows)
    text = PAGE.format(
        minutes=f"{processor_s / 60:.0f}", verdict="\n\n".join([verdict, "\n".join(lines)]).strip(),
        table=table.strip(), n=len(found), ends=ends,
    )  # fmt: skip
    (directory / "contradictions.md").write_text(text, encoding="utf-8")


PAGE = """\
# Contradictions within report pages

Does a report page of fmu contradict itself?

{verdict}

The {n} pages report on random updating problems: shear buildings of three to seven storeys, in one direction or in
two directions whose modes cross, with one to four stiffnesses as parameters. The truth, noise, bounds, priors,
pairing and error model are random. In about a quarter of the problems a true parameter lies beyond its bounds, in
about three of ten a storey is softer than the model allows, and in about half the noise is 0.3 or 3 times the
stated noise. Each problem is sampled for 250 draws in 4 chains. A program compares the statements of the page with
each other and with the log-probability. The study took {minutes} minutes of processor time. The rules are:

- If a point is called a maximum and has a share of the probability, the log-probability is not higher 0.05
  posterior standard deviations away.
- In a converged run, the shares of the draws match the shares of the probability. Points where the search ended at
  a jump, an edge or a slope have at most 1 % of the draws.
- Intervals lie within the bounds. A parameter with most of its draws at a bound is not called determined.
- If a check passes, the observed error is not among the errors that the check would have found. Only checks that
  could have failed are counted, and the counts agree with the table.
- If the data contradict the model, the statement of uncertainty begins with the assumption that the model is
  correct, and the page does not state that nothing is left undetermined.
- A converged run meets the limits of R-hat and effective draws that the page states.
- Modes that the other modes do not predict are named. The means at the top of the page and in the table agree.

{table}

{ends}

`tests/validation/test_contradictions.py` inserts each fault that pages once had into a page; the program must find
it. The rules are in `tests/validation/contradictions.py`, the problems in
`tests/validation/contradictions_cases.py`.
"""
