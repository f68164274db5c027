"""Table and figure of the comparison: python -m tests.benchmarks.peers.report RUN.json OUT.md FIGURE.png."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fmu.samplers.registry import SAMPLERS
from fmu.tables import markdown_table
from tests.benchmarks.peers.figure import draw, short
from tests.benchmarks.peers.outcome import Cost, Figures

HEAD = """## Peers

Every sampler on the same posterior in one run, {runs} each, from starts drawn from the prior, the same
for all; the samplers take turns, a seed each; medians over the seeds. ESS is the bulk ESS of the worst parameter,
of an ensemble by its autocorrelation time. Everything had one processor core, whatever threads a library starts,
and seconds are processor seconds. JAX computes in float64; compilation is not counted ({compiled} s a sampler and
posterior, with a first run). Modes are paired by shape; by number, which is the same there, on shear-10dof.

An evaluation is a gradient for HMC and NUTS and a log-probability for the others, counted inside the bounds; the
few gradients of the mixture's local steps count as what they cost, and it begins without maxima here, as all do. A
*solve* is one log-probability; a gradient counts as many solves as it takes the time of, of the same model and in
batches of as many chains, measured in this run: for fmu's HMC {costs}.

- fmu's own samplers have their default settings, and so has each peer, but that all NUTS have the warm-up of
  fmu's HMC, 1000 steps, and one has a dense mass matrix, as that HMC. NUTS works in coordinates without bounds
  (logit, or log where there is a lower bound alone), as its libraries treat bounds: NumPyro's on the same model in
  JAX, nutpie's on fmu's gradient.
- A row in italics is a product: the evaluations that the sampler needs on the fast model, times what one
  evaluation of the slow model takes by itself. SciPy's dense solver has the matrices of every term at hand.
- The log-probabilities differ from fmu's by {difference:.0e} at most at plausible points, a constant apart.
- Last column: how far a sampler's posterior means are from those of the reference, in standard errors, the largest
  over the parameters. The reference is the peer with most effective draws of those with R-hat < {good:g}. PINTS
  goes on adapting after the warm-up, as is its default.

Versions: {versions}. With everything counted, the search for maxima too, and beside nautilus and
dynesty: [whole runs](whole-runs.md).
"""

AGAINST_NUTS = """### HMC against NUTS

By how much fmu's HMC exceeds the best of the {count} NUTS in effective draws, after warm-up, and in brackets with
the warm-up counted; ratios of medians. *Near a bound*: share of the draws within 0.1 posterior sd of a bound, of
the parameter with most. HMC reflects at bounds; to NUTS, in coordinates without bounds, they are infinitely far.
"""

HMC_BUDGET, MIXTURE_BUDGET = 0.06, 0.40
YOUNG = "cantilever-young"
ACTIVE = 0.01
"""Share of the draws near a bound from which on it counts as active: exponential at a bound has 10 %, flat 3 %."""
GOOD = 1.02
NUTS_AND_HMC = tuple((f"NumPyro NUTS{kind}", "hmc") for kind in ("", ", dense mass matrix"))
SAME_IN_JAX = "same model, JAX"


@dataclass(frozen=True)
class Row:
    """One sampler on one model: medians over its runs.

    Attributes
    ----------
    case, label, model, unit : str
    cost : float
        How many log-probabilities an evaluation takes.
    prepared_s : float
    runs : list of Figures
    """

    case: str
    label: str
    model: str
    unit: str
    cost: float
    prepared_s: float
    runs: list[Figures]

    @classmethod
    def read(cls, row: dict[str, Any]) -> Row:
        """Return the row that `__main__` wrote."""
        runs = [
            Figures(**{**run, "warmup": Cost(**run["warmup"]), "draws": Cost(**run["draws"])})
            for run in row["runs"]
        ]
        return cls(**{**row, "runs": runs})

    @property
    def ours(self) -> bool:
        """Whether it is one of fmu's samplers."""
        return self.label in SAMPLERS

    @property
    def is_product(self) -> bool:
        """Whether its time is that of another model than its draws were made with."""
        return self.model not in ("fmu", SAME_IN_JAX)

    @property
    def name(self) -> str:
        """Name for readers."""
        if self.ours:
            return f"fmu {self.label}"
        return self.label if self.model in ("fmu", SAME_IN_JAX) else f"{self.label} ({self.model})"

    @property
    def rhat(self) -> float:
        """Largest R-hat of all runs."""
        return max(run.rhat for run in self.runs)

    def ess(self) -> float:
        """Return the effective draws of a run."""
        return float(np.median([run.ess for run in self.runs]))

    def per_evaluation(self, warmup_in: bool = False) -> float:
        """Return ESS per evaluation."""
        return float(np.median([run.per_evaluation(warmup_in) for run in self.runs]))

    def per_solve(self, warmup_in: bool = False) -> float:
        """Return ESS per log-probability, or per time that one takes."""
        return self.per_evaluation(warmup_in) / self.cost

    def per_second(self, warmup_in: bool = False) -> float:
        """Return ESS per processor second."""
        return float(np.median([run.per_second(warmup_in) for run in self.runs]))

    def mean(self) -> tuple[Any, Any]:
        """Return the posterior means over all runs and their standard errors, shape (ndim,)."""
        errors = np.array([run.mcse for run in self.runs])
        return np.mean([run.mean for run in self.runs], axis=0), np.sqrt(np.sum(errors**2, axis=0)) / len(errors)


def main(source: str, target: str, figure: str) -> None:
    """Write both."""
    result = json.loads(Path(source).read_text())
    rows = [Row.read(row) for row in result["rows"]]
    cases = list(dict.fromkeys(row.case for row in rows))
    compiled = [row.prepared_s for row in rows if row.model == SAME_IN_JAX]
    costs = [f"{row.cost:.1f} ({row.case})" for row in rows if row.label == "hmc"]
    parts = [
        HEAD.format(
            runs=f"{len(rows[0].runs)} seed{'s' if len(rows[0].runs) > 1 else ''}",
            good=GOOD,
            compiled=f"{min(compiled):.0f} to {max(compiled):.0f}",
            costs=", ".join(costs),
            difference=max(max(d.values()) for d in result["differences"].values()),
            versions=", ".join(f"{name} {version}" for name, version in result["versions"].items()),
        ),
        *([budget([row for row in rows if row.case == YOUNG])] if YOUNG in cases else []),
        against_nuts(rows, result["near_a_bound"]),
    ]
    for case in cases:
        of_case = [row for row in rows if row.case == case]
        parts += [f"### {case}\n", comparison(of_case), ahead(of_case)]
    parts.append(f"![ESS per solve and per second]({Path(figure).parent.name}/{Path(figure).name})\n")
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    Path(target).write_text("\n".join(parts))
    draw({case: [row for row in rows if row.case == case] for case in cases}, figure)


def every_nuts(rows: list[Row]) -> list[Row]:
    """Return the rows of NUTS on the model that fmu samples on."""
    return [row for row in rows if "NUTS" in row.label and not row.is_product]


def over_nuts(rows: list[Row], figure: Callable[[Row, bool], float], warmup_in: bool) -> float:
    """Return by how much fmu's HMC exceeds the best NUTS of one posterior."""
    hmc = next(row for row in rows if row.label == "hmc")
    return figure(hmc, warmup_in) / max(figure(row, warmup_in) for row in every_nuts(rows))


def against_nuts(rows: list[Row], near: dict[str, float]) -> str:
    """Return the ratios of HMC to NUTS on every posterior; the guide quotes this table."""
    lines = []
    for case, share in near.items():
        of_case = [row for row in rows if row.case == case]
        cells = [
            "{} × ({} ×)".format(*(short(over_nuts(of_case, figure, warmup_in)) for warmup_in in (False, True)))
            for figure in (Row.per_evaluation, Row.per_second)
        ]
        lines.append([case, f"{100 * share:.0f} %", *cells])
    head = ["posterior", "near a bound", "per gradient", "per second"]
    text = AGAINST_NUTS.format(count=len({row.label for row in every_nuts(rows)}))
    return f"{text}\n{markdown_table(head, lines)}\nThe guide says so: {quoted(rows, near)}\n"


def quoted(rows: list[Row], near: dict[str, float]) -> str:
    """Return what the guide says of it, in bold: which ratio holds for which posterior."""
    parts: dict[bool, list[str]] = {True: [], False: []}
    for case, share in near.items():
        of_case = [row for row in rows if row.case == case]
        ratios = [
            f"{short(over_nuts(of_case, figure, False))} ×" for figure in (Row.per_evaluation, Row.per_second)
        ]
        parts[share > ACTIVE].append(f"{' and '.join(ratios)} on {case}")
    kinds = {True: "whose posteriors lie at bounds", False: "whose posterior has no active bounds"}
    listed = "; ".join(f"{', '.join(parts[kind])}, {words}" for kind, words in kinds.items() if parts[kind])
    return (
        "**After warm-up, fmu's HMC gives these multiples of the effective draws of the best of three NUTS, per "
        f"gradient and per second: {listed}.**"
    )


def budget(rows: list[Row]) -> str:
    """Return what was promised for HMC and the mixture on cantilever-young beside what was measured."""
    hmc, mixture = (next(row for row in rows if row.label == label) for label in ("hmc", "mixture"))

    def line(what: str, limit: float, ratio: Any, suffix: str = " ×") -> list[str]:
        out, both = ratio(False), ratio(True)
        return [
            what,
            f"≥ {limit:g}{suffix}",
            f"{out:.3g}{suffix}",
            f"{both:.3g}{suffix}",
            "yes" if out >= limit else "**no**",
        ]

    def faster(label: str, model: str, own: Row = hmc) -> Any:
        other = next(row for row in rows if (row.label, row.model) == (label, model))
        return lambda warmup_in: own.per_second(warmup_in) / other.per_second(warmup_in)

    lines = [
        line("fmu HMC, ESS per gradient", HMC_BUDGET, hmc.per_evaluation, ""),
        line("HMC over the best NUTS per gradient", 10, partial(over_nuts, rows, Row.per_evaluation)),
        line("HMC over the best NUTS per second, same model", 10, partial(over_nuts, rows, Row.per_second)),
        line(
            "HMC over emcee per second, SciPy on the whole beam",
            200,
            faster("emcee, default moves", "SciPy, 300 DOF"),
        ),
        line(
            "HMC over emcee per second, SciPy on the weak plane",
            40,
            faster("emcee, default moves", "SciPy, weak plane"),
        ),
        line("fmu mixture, ESS per log-probability", MIXTURE_BUDGET, mixture.per_evaluation, ""),
        line("mixture over fmu HMC per second", 5, faster("hmc", "fmu", mixture)),
        line("mixture over NumPyro NUTS per second, same model", 50, faster("NumPyro NUTS", SAME_IN_JAX, mixture)),
    ]
    return markdown_table([f"on {YOUNG}", "budget", "after warm-up", "warm-up counted", "met"], lines, (0, 4))


def comparison(rows: list[Row]) -> str:
    """Return the table of one experiment, most ESS per second first."""
    lines = []
    for row in sorted(rows, key=Row.per_second, reverse=True):
        name = f"*{row.name}*" if row.is_product else f"**{row.name}**" if row.ours else row.name
        figures = [
            short(value)
            for value in (
                row.per_evaluation(),
                row.per_solve(),
                row.per_solve(True),
                row.per_second(),
                row.per_second(True),
            )
        ]
        away = "reference" if row is reference(rows) else f"{deviation(row, rows):.1f}"
        checks = ["", ""] if row.is_product else [f"{row.rhat:.3f}", away]
        lines.append([name, row.unit, f"{row.cost:.2g}", *figures, *checks])
    head = ["sampler", "evaluation", "its cost, solves", "ESS per evaluation", "ESS per solve", "warm-up counted"]
    head += ["ESS per s", "warm-up counted"]
    return markdown_table([*head, "largest R-hat", "means, se"], lines, (0, 1))


def reference(rows: list[Row]) -> Row:
    """Return the peer with most effective draws of those whose chains agree; without one, the nearest to that."""
    peers = [row for row in rows if not row.ours and not row.is_product]
    good = [row for row in peers if row.rhat < GOOD]
    return max(good, key=Row.ess) if good else min(peers, key=lambda row: row.rhat)


def deviation(row: Row, rows: list[Row]) -> float:
    """Return how far a row's means are from those of the reference, in standard errors, at most."""
    (other, error), (mean, own) = reference(rows).mean(), row.mean()
    return float(np.max(np.abs(mean - other) / np.sqrt(own**2 + error**2)))


def trusted(row: Row, rows: list[Row]) -> bool:
    """Return whether its chains agree with one another and its means with the reference."""
    return not row.is_product and row.rhat < 1.05 and deviation(row, rows) < 4.0


def ahead(rows: list[Row]) -> str:
    """Say who is first, and by how much where it is a peer."""
    hmc = next(row for row in rows if row.label == "hmc")
    among = [row for row in rows if trusted(row, rows)]
    if not among:
        return "No sampler's chains agree with one another and with the reference.\n"
    sentences = ["First of those with R-hat < 1.05 and means within 4 standard errors of the reference:\n"]
    for what, figure in (("solve", Row.per_solve), ("second", Row.per_second)):
        for warmup_in, when in ((False, "after warm-up"), (True, "warm-up counted")):
            best = max(among, key=lambda row: figure(row, warmup_in))
            sentence = f"per {what}, {when}: {best.name}"
            if best is not hmc:
                sentence += f", {figure(best, warmup_in) / figure(hmc, warmup_in):.2g} times fmu hmc"
            sentences.append(f"- {sentence if best.ours else f'**{sentence}**'}")
    return "\n".join([*sentences, *kin(rows)]) + "\n"


def kin(rows: list[Row]) -> Iterator[str]:
    """Say where a peer is ahead of the sampler of fmu that works like it, whatever its checks say."""
    by_label = {row.label: row for row in rows if not row.is_product}
    for theirs, ours in (("PINTS adaptive MH", "mh"), ("emcee, default moves", "emcee"), *NUTS_AND_HMC):
        peer, own = by_label[theirs], by_label[ours]
        ratios = {
            "solve": peer.per_solve() / own.per_solve(),
            "second": peer.per_second() / own.per_second(),
        }
        won = " and ".join(f"{ratio:.2g} times per {what}" for what, ratio in ratios.items() if ratio > 1.05)
        if won:
            yield f"- **{peer.name} is ahead of {own.name}**: after warm-up {won}"


if __name__ == "__main__":
    main(*sys.argv[1:])
