"""Search report pages of 200 random problems for statements that contradict each other.

    python -m tests.validation.contradictions OUT [--kept DIRECTORY] [--minutes M] [--n N]

The statements of a page are compared with each other and with the log-probability of the problem: shares with
gradients and draws, intervals with bounds, checks with their power, and the stated uncertainty with the verdict on
the model. The exit code is 1 if a page contradicts itself.
"""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

import fmu
from fmu.analysis.convergence.diagnosis import maxima_of
from fmu.analysis.fit.check import PREDICTED
from fmu.report.document import Page, PageTable, Verdict
from fmu.report.pages import sampler_page
from fmu.report.run import runs_of
from fmu.report.sections.verdicts import ASSUMED
from tests.pictures import without_pictures
from tests.validation.contradictions_cases import LENGTH, random_case
from tests.validation.kept import Units, each, fields_of, study_parser

PROBLEMS = 200
_NUMBER = r"[-+]?\d+(?:[  ]\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?"
_AWAY, _HIGHER, _DIRECTIONS = 0.05, 0.01, 64
"""Distance from a maximum in posterior standard deviations, largest rise there in nats, number of directions."""


@dataclass(frozen=True)
class Said:
    """A page, its run and its problem."""

    page: Page
    trace: xr.DataTree
    problem: fmu.UpdatingProblem

    def verdict(self, question: str) -> Verdict:
        """Return the verdict at the top of the page that answers the question beginning with these words."""
        return next(one for one in self.page.verdicts if one.question.startswith(question))

    def rows(self, section: str) -> Iterator[tuple[dict[str, str], bool]]:
        """Yield each row of the first table of a section as a mapping by header, and whether it is grey."""
        for found in (*self.page.leading, *self.page.sections):
            if found.id != section:
                continue
            table = next((part for part in found.parts if isinstance(part, PageTable)), None)
            for k, row in enumerate(table.rows if table else ()):
                yield dict(zip(table.header, map(str, row), strict=True)), k in table.greyed

    @property
    def words(self) -> str:
        """All sentences, reasons and notes of the verdicts."""
        return " ".join(line for one in self.page.verdicts for line in (one.said, *one.reasons, *one.notes))


def numbers(text: str) -> list[float]:
    """Return the numbers in a text."""
    return [float(re.sub(r"[  ]", "", found)) for found in re.findall(_NUMBER, text.replace("−", "-"))]


def said_of(trace: xr.DataTree, problem: fmu.UpdatingProblem) -> Said:
    """Return the page of a run, without pictures."""
    runs = runs_of({"run": trace})
    with without_pictures():
        return Said(sampler_page(runs["run"], {"run": "index.html"}, runs), trace, problem)


def shares_against_gradients(said: Said) -> Iterator[str]:
    """Check that nothing is higher next to a maximum with a share of the probability."""
    table = {row["quantity"]: row for row, _ in said.rows("maxima")}
    maxima = maxima_of(said.trace) if table else ()
    rng = np.random.default_rng(1)
    for k, m in enumerate(maxima):
        title, share = f"maximum {k + 1}", table["share"].get(f"maximum {k + 1}", "<")
        if share.startswith("<"):
            continue
        steps = rng.standard_normal((_DIRECTIONS, said.problem.ndim)) * m.sd
        steps *= _AWAY / np.linalg.norm(steps / m.sd, axis=1, keepdims=True)
        near = np.clip(m.theta + steps, said.problem.lower, said.problem.upper)
        higher = float(np.max(np.asarray(said.problem.log_prob(near))) - m.log_prob)
        if higher > _HIGHER:
            yield f"{title} has a share of {share}, but log P is {higher:.2g} higher {_AWAY} sd away"


def shares_against_draws(said: Said) -> Iterator[str]:
    """Check that draws of a converged run match the shares, and that points that are not maxima have none."""
    table = {row["quantity"]: row for row, _ in said.rows("maxima")}
    if "share of the draws" not in table or not said.verdict("Can the run").is_good:
        return
    names = [name for name in table["share"] if re.fullmatch(r"[a-z]+ \d+", name)]
    for name in names:
        share, draws = (numbers(table[row][name]) for row in ("share", "share of the draws"))
        off, error = abs(share[0] - draws[0]), draws[1] if len(draws) > 1 else 0.0
        if off > 3.0 + 5.0 * error:
            yield f"{name} has {share[0]} % of the probability but {draws[0]} % of the draws of a converged run"
        if not name.startswith("maximum") and draws[0] > 1.0:
            yield f"{name} is not a maximum, but has {draws[0]} % of the draws"


def intervals_against_bounds(said: Said) -> Iterator[str]:
    """Check that intervals lie within bounds, and that a parameter determined by a bound is named."""
    left, sure = said.verdict("Anything left"), said.verdict("How sure")
    for row, _ in said.rows("parameters"):
        interval, bounds = numbers(row["90 % interval"]), numbers(row["bounds"])
        if len(bounds) == 2 and len(interval) == 2:
            room = 0.051 * (interval[1] - interval[0]) + 1e-9
            if interval[0] < bounds[0] - room or interval[1] > bounds[1] + room:
                yield f"{row['parameter']}: the interval {row['90 % interval']} exceeds the bounds {row['bounds']}"
    for name, part in re.findall(rf"(\S+): (?:> )?({_NUMBER}) % of the draws", said.words):
        if float(part) > 51.0 and left.is_good:
            yield f"{name}: {part} % of the draws lie at a bound, but nothing is said to be left undetermined"
        if "bound" not in sure.said and sure.said:
            yield f"{name}: {part} % of the draws lie at a bound, but the uncertainty does not mention the bound"


def checks_against_power(said: Said) -> Iterator[str]:
    """Check that a passing check does not exclude its own error, and that only checks that could fail count."""
    fit, able, fails = said.verdict("Does the model fit"), 0, 0
    for row, is_grey in said.rows("checks"):
        of, result, shows = row["of"], row["result"], row["errors that would have been found"]
        able, fails = able + (not is_grey), fails + (result == "fails")
        if is_grey == (result in ("passes", "fails")):
            yield f"{of}: result {result!r}, but the row is {'not ' if is_grey else ''}counted as a check"
        if "of its frequency" in shows:
            measured, predicted, sd = numbers(row["found"])[:3]
            ends = [0.01 * x for x in numbers(shows)]
            low, high = (-np.inf, ends[0]) if len(ends) == 1 else ends
            room = (0.06 * sd + 0.011 * max(abs(low if np.isfinite(low) else 0.0), high) * predicted) / predicted
            own = measured / predicted - 1.0
            if result == "passes" and not low - room <= own <= high + room:
                yield f"{of} passes and excludes errors of {shows}, but its own error is {100 * own:.3g} %"
            if result == "fails" and low + room < own < high - room:
                yield f"{of} fails, but its own error of {100 * own:.3g} % is not among {shows}"
        elif row["check"] == PREDICTED and not is_grey and result == "passes":
            yield f"{of} passes with {shows}, but the mode was not predicted from the others"
    counted = re.search(r"contradicted by (\d+) of (\d+) checks", fit.answer, re.IGNORECASE)
    if counted and (fails, able) != tuple(map(int, counted.groups())):
        yield f"the verdict is {fit.answer!r}, but in the table {fails} of {able} checks fail"
    passed = re.search(r"(\d+) checks? could have contradicted", fit.said)
    if passed and able != int(passed.group(1)):
        yield f"the verdict states {fit.said!r}, but the table has {able} checks"
    if bool(fails) != fit.answer.lower().startswith("contradicted"):
        yield f"the verdict is {fit.answer!r}, but {fails} checks fail"


def certainty_against_fit(said: Said) -> Iterator[str]:
    """Check that the uncertainty begins with its assumption if the model is contradicted, and nothing is green."""
    fit, sure, left = (said.verdict(words) for words in ("Does the model fit", "How sure", "Anything left"))
    is_rejected = fit.answer.lower().startswith("contradicted")
    if sure.said and sure.said.startswith(ASSUMED) != is_rejected:
        yield f"the verdict on the model is {fit.answer!r}, but the uncertainty begins with {sure.said[:60]!r}"
    if is_rejected and left.is_good:
        yield f"the verdict on the model is {fit.answer!r}, but nothing is said to be left undetermined"
    if left.is_good and any(is_grey for _, is_grey in said.rows("parameters")):
        yield "nothing is said to be left undetermined, but the data do not inform some parameters (grey)"


def convergence_against_numbers(said: Said) -> Iterator[str]:
    """Check that a converged run meets its limits, and that results of any other run are called provisional."""
    trust, sure = said.verdict("Can the run"), said.verdict("How sure")
    rhat, below, ess, needed = numbers(trust.said.replace("R-hat", ""))[:4]
    if trust.is_good and not (rhat < below and ess >= needed):
        yield f"the run is called converged, but with {trust.said}"
    if sure.said and ("Provisional" in sure.said) != (trust.is_good is False):
        yield f"the verdict on the run is {trust.answer!r}, but the uncertainty is given as {sure.said!r}"


def modes_without_a_word(said: Said) -> Iterator[str]:
    """Check that the verdict on the model names modes that the other modes do not predict."""
    fit = said.verdict("Does the model fit")
    silent = [row for row, _ in said.rows("loo") if "not" in row["how"] and "used" not in row["how"]]
    if silent and not fit.answer.lower().startswith("contradicted") and "No check of" not in said.words:
        yield f"{len(silent)} modes are not predicted by the others, but the verdict on the model does not say so"


def table_against_screen(said: Said) -> Iterator[str]:
    """Check that the means at the top of the page are those of the table."""
    sure = said.verdict("How sure")
    table = {row["parameter"]: row for row, _ in said.rows("parameters")}
    for name, mean in re.findall(rf"(\S+) ({_NUMBER}) ±", sure.answer):
        if name in table:
            listed, sd = numbers(table[name]["mean"])[0], numbers(table[name]["sd"])[0]
            if abs(float(mean) - listed) > 0.06 * sd + 1e-12:
                yield f"{name} is {mean} at the top of the page, but {listed} in the table"


RULES: tuple[Callable[[Said], Iterator[str]], ...] = (
    shares_against_gradients, shares_against_draws, intervals_against_bounds, checks_against_power,
    certainty_against_fit, convergence_against_numbers, modes_without_a_word, table_against_screen,
)  # fmt: skip


def contradictions(said: Said) -> list[str]:
    """Return the contradictions of a page, one sentence each, after the name of the rule."""
    return [f"{rule.__name__}: {found}" for rule in RULES for found in rule(said)]


def page_of(seed: int) -> tuple[Said, str]:
    """Return the page of random problem number `seed`, and the problem in words."""
    case = random_case(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trace = fmu.sample(case.problem, case.sampler, seed=seed, **LENGTH)
        return said_of(trace, case.problem), f"{case.words}; {case.sampler}"


def checked(seed: int) -> Any:
    """Return the counted entries and the contradictions of the page of a problem."""
    from tests.validation.contradictions_page import Checked

    said, words = page_of(seed)
    return Checked.of(seed, words, said, contradictions(said))


def main() -> int:
    """Check the pages, write ``contradictions.md``, and return the exit code."""
    from tests.validation.contradictions_page import Checked, write

    parser = study_parser(__doc__)
    parser.add_argument("--n", type=int, default=PROBLEMS)
    asked = parser.parse_args()
    units = Units(asked.kept, asked.minutes)
    found = units.completed("pages", each(range(asked.n)), checked, fields_of(Checked))
    write(found, asked.out, units.processor_s)
    return 1 if any(one.against for one in found) else 0


if __name__ == "__main__":
    sys.exit(main())
