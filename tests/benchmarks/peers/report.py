"""Table and figure of the comparison: python -m tests.benchmarks.peers.report RUN.json OUT.md FIGURE.png."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fmu.tables import markdown_table
from tests.benchmarks.peers.figure import draw, short
from tests.benchmarks.peers.outcome import Cost, Figures

HEAD = """## Peers

Every sampler on the same posterior in one run (pairing by shape), {runs} seeds each, from starts drawn from the
prior, the same for all; medians over the seeds. ESS is the bulk ESS of the worst parameter, of an ensemble by its
autocorrelation time. Everything had one processor core, whatever threads a library starts, and seconds are
processor seconds. JAX computes in float64; compilation is not counted (with a first run {compiled}).
An evaluation is a gradient for HMC and NUTS and a log-probability for the others, counted inside the bounds; four
gradients take fmu {gradient} times as long as four log-probabilities (by experiment).

- fmu's own samplers have their default settings, and so has each peer; NUTS works in logit coordinates, as its
  libraries treat bounds: NumPyro's on the same reduced model in JAX, nutpie's on fmu's gradient.
- A row in italics is a product: the evaluations that the sampler needs on the fast model, times what one
  evaluation of the slow model takes by itself. SciPy's dense solver has the matrices of every term at hand.
- The log-probabilities differ from fmu's by {difference:.0e} at most at plausible points, a constant apart.
- Last column: how far a sampler's posterior means are from those of emcee with its default moves, in standard
  errors, the largest over the parameters. PINTS goes on adapting after the warm-up, as is its default.

Versions: {versions}.
"""

HMC_BUDGET = 0.06
REFERENCE = "emcee, default moves"


@dataclass(frozen=True)
class Row:
    """One sampler on one model: medians over its runs.

    Attributes
    ----------
    case, label, model, unit : str
    prepared_s : float
    runs : list of Figures
    """

    case: str
    label: str
    model: str
    unit: str
    prepared_s: float
    runs: list[Figures]

    @classmethod
    def read(cls, row: dict[str, Any]) -> Row:
        """Return the row that `__main__` wrote."""
        runs = [
            Figures(**{**run, "warmup": Cost(**run["warmup"]), "draws": Cost(**run["draws"])})
            for run in row["runs"]
        ]
        return cls(row["case"], row["label"], row["model"], row["unit"], row["prepared_s"], runs)

    @property
    def ours(self) -> bool:
        """Whether it is one of fmu's samplers."""
        return self.label in ("hmc", "mh", "slice", "emcee")

    @property
    def is_product(self) -> bool:
        """Whether its time is that of another model than its draws were made with."""
        return self.model not in ("fmu", "reduced, JAX")

    @property
    def name(self) -> str:
        """Name for readers."""
        if self.ours:
            return f"fmu {self.label}"
        return self.label if self.model == "fmu" else f"{self.label} ({self.model})"

    @property
    def rhat(self) -> float:
        """Largest R-hat of all runs."""
        return max(run.rhat for run in self.runs)

    def per_evaluation(self, warmup_in: bool = False) -> float:
        """Return ESS per evaluation."""
        return float(np.median([run.per_evaluation(warmup_in) for run in self.runs]))

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
    compiled = ", ".join(f"{row.prepared_s:.0f} s on {row.case}" for row in rows if row.model == "reduced, JAX")
    parts = [
        HEAD.format(
            runs=len(rows[0].runs),
            compiled=compiled,
            gradient=" and ".join(f"{ratio:.1f}" for ratio in result["gradient_cost"].values()),
            difference=max(max(d.values()) for d in result["differences"].values()),
            versions=", ".join(f"{name} {version}" for name, version in result["versions"].items()),
        ),
        budget([row for row in rows if row.case == "cantilever-young"]),
    ]
    for case in cases:
        of_case = [row for row in rows if row.case == case]
        parts += [f"### {case}\n", comparison(of_case), ahead(of_case)]
    parts.append(f"![ESS per evaluation and per second]({Path(figure).parent.name}/{Path(figure).name})\n")
    Path(target).parent.mkdir(parents=True, exist_ok=True)
    Path(target).write_text("\n".join(parts))
    draw({case: [row for row in rows if row.case == case] for case in cases}, figure)


def budget(rows: list[Row]) -> str:
    """Return what was promised for HMC on cantilever-young beside what was measured."""
    hmc = next(row for row in rows if row.label == "hmc")
    nuts = [row for row in rows if "NUTS" in row.label and not row.is_product]
    best = max(nuts, key=Row.per_evaluation)

    def line(what: str, limit: float, ratio: Any, suffix: str = " ×") -> list[str]:
        out, both = ratio(False), ratio(True)
        return [
            what,
            f"≥ {limit:g}{suffix}",
            f"{out:.3g}{suffix}",
            f"{both:.3g}{suffix}",
            "yes" if out >= limit else "**no**",
        ]

    def faster(label: str, model: str) -> Any:
        peer = next(row for row in rows if (row.label, row.model) == (label, model))
        return lambda warmup_in: hmc.per_second(warmup_in) / peer.per_second(warmup_in)

    lines = [
        line("fmu HMC, ESS per gradient", HMC_BUDGET, hmc.per_evaluation, ""),
        line(
            f"over NUTS in logit coordinates per gradient ({best.name}, the best of them)",
            10,
            lambda warmup_in: hmc.per_evaluation(warmup_in) / max(row.per_evaluation(warmup_in) for row in nuts),
        ),
        line("over NumPyro NUTS per second, same reduced model", 10, faster("NumPyro NUTS", "reduced, JAX")),
        line(
            "over emcee per second, SciPy on the whole beam",
            200,
            faster("emcee, default moves", "SciPy, 300 DOF"),
        ),
        line(
            "over emcee per second, SciPy on the weak plane",
            40,
            faster("emcee, default moves", "SciPy, weak plane"),
        ),
    ]
    return markdown_table(
        ["HMC on cantilever-young", "budget", "after warm-up", "warm-up counted", "met"], lines, (0, 4)
    )


def comparison(rows: list[Row]) -> str:
    """Return the table of one experiment, most ESS per second first."""
    lines = []
    for row in sorted(rows, key=Row.per_second, reverse=True):
        name = f"*{row.name}*" if row.is_product else f"**{row.name}**" if row.ours else row.name
        figures = [
            short(value)
            for value in (
                row.per_evaluation(),
                row.per_evaluation(True),
                row.per_second(),
                row.per_second(True),
            )
        ]
        away = "reference" if row.label == REFERENCE else f"{deviation(row, rows):.1f}"
        checks = ["", ""] if row.is_product else [f"{row.rhat:.3f}", away]
        lines.append([name, row.unit, *figures, *checks])
    head = ["sampler", "evaluation", "ESS per evaluation", "warm-up counted", "ESS per s", "warm-up counted"]
    return markdown_table([*head, "largest R-hat", "means, se"], lines, (0, 1))


def deviation(row: Row, rows: list[Row]) -> float:
    """Return how far a row's means are from those of emcee with its default moves, in standard errors, at most."""
    reference, error = next(other for other in rows if other.label == REFERENCE).mean()
    mean, own = row.mean()
    return float(np.max(np.abs(mean - reference) / np.sqrt(own**2 + error**2)))


def trusted(row: Row, rows: list[Row]) -> bool:
    """Return whether its chains agree with one another and its means with the reference."""
    return not row.is_product and row.rhat < 1.05 and deviation(row, rows) < 4.0


def ahead(rows: list[Row]) -> str:
    """Say who is first, and by how much where it is a peer."""
    hmc = next(row for row in rows if row.label == "hmc")
    sentences = ["First of those with R-hat < 1.05 and means within 4 standard errors of the reference:\n"]
    for what, figure in (("evaluation", Row.per_evaluation), ("second", Row.per_second)):
        for warmup_in, when in ((False, "after warm-up"), (True, "warm-up counted")):
            best = max((row for row in rows if trusted(row, rows)), key=lambda row: figure(row, warmup_in))
            sentence = f"per {what}, {when}: {best.name}"
            if best is not hmc:
                sentence += f", {figure(best, warmup_in) / figure(hmc, warmup_in):.2g} times fmu hmc"
            sentences.append(f"- {sentence if best.ours else f'**{sentence}**'}")
    return "\n".join([*sentences, *kin(rows)]) + "\n"


def kin(rows: list[Row]) -> Iterator[str]:
    """Say where a peer is ahead of the sampler of fmu that works like it, whatever its checks say."""
    by_label = {row.label: row for row in rows if not row.is_product}
    for theirs, ours in (("PINTS adaptive MH", "mh"), ("emcee, default moves", "emcee"), ("NumPyro NUTS", "hmc")):
        peer, own = by_label[theirs], by_label[ours]
        ratios = {
            "evaluation": peer.per_evaluation() / own.per_evaluation(),
            "second": peer.per_second() / own.per_second(),
        }
        won = " and ".join(f"{ratio:.2g} times per {what}" for what, ratio in ratios.items() if ratio > 1.0)
        if won:
            yield f"- **{peer.name} is ahead of {own.name}**: after warm-up {won}"


if __name__ == "__main__":
    main(*sys.argv[1:])
