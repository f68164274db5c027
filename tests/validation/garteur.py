"""Update GARTEUR SM-AG19, the case ``garteur``.

    python -m tests.validation.garteur OUT [--kept DIRECTORY] [--minutes M]

Writes ``garteur.md`` and its figures. Exit code 1 where a gate fails.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

import fmu
from fmu import cases
from fmu.analysis.maxima.results import Maxima
from fmu.analysis.trace.modal_states import MEAN
from fmu.numbers import MISSING, fixed, names_in_words, significant, with_sd
from fmu.report.plots.frequencies import plot_frequency_updates
from fmu.report.plots.modes import plot_mac, plot_mode_shapes
from fmu.report.plots.style import DPI
from fmu.tables import markdown_table
from fmu.types import FloatArray
from tests.validation.kept import Units, each, study_parser

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


DRAWS = 1000
LEAST_ESS = 400.0
"""Sampling goes on until every effective sample size is that large and the verdict good."""
SEED = 1
MOST_ERROR = 2.0
"""Of a frequency after updating, at the maximum and on average over the posterior, %."""
MOST_RHAT = 1.01
LEAST_MAC = 0.8
"""Of a mode after updating with the one before it that it is paired with."""
HELD_OUT = ("in-plane sym", "bending 5n", "tail torsion")
"""The three highest measured modes, of kinds that the lower seven are not: predicted from an update with these."""
_PICTURES = {"modes": plot_mode_shapes, "mac": plot_mac, "errors": plot_frequency_updates}


@dataclass(frozen=True)
class Update:
    """A run: the problem, its maxima, the trace of Hamiltonian Monte Carlo, and what it took.

    `without` is the trace of an update without the modes `HELD_OUT`.
    """

    problem: fmu.UpdatingProblem
    maxima: Maxima
    trace: xr.DataTree
    summary: pd.DataFrame
    without: xr.DataTree
    processor_s: float

    @property
    def errors(self) -> FloatArray:
        """Of the start, the maximum and the posterior mean of the frequencies, shape (3, n_modes), %."""
        measured = np.asarray(self.problem.data.frequencies_hz)
        mean = self.trace["posterior_predictive"]["frequency"].mean(("chain", "draw")).to_numpy()
        found = np.stack([self.problem.frequencies(self.problem.start), self.maxima[0].frequencies, mean])
        return 100.0 * (found / measured - 1.0)

    @property
    def mac(self) -> FloatArray:
        """Of modes at the posterior mean with those before updating, shape (n_modes, n_modes)."""
        return np.asarray(self.trace["modes"]["mac"].sel(state=MEAN).transpose("reference_mode", "mode"))

    @property
    def failures(self) -> list[str]:
        """What is wrong, a sentence each."""
        worst, rhat = float(np.abs(self.errors[1:]).max()), float(self.summary["rhat"].max())
        alike = self.mac
        found = []
        if not worst < MOST_ERROR:
            found.append(f"a frequency is {worst:.2f} % off after updating")
        if not rhat < MOST_RHAT:
            found.append(f"R-hat is {rhat:.4f}")
        if (
            not np.array_equal(np.argmax(alike, axis=1), np.arange(len(alike)))
            or not alike.diagonal().min() > LEAST_MAC
        ):
            found.append(f"a mode is not like the one it is paired with (MAC {alike.diagonal().min():.2f})")
        return found


def update(units: Units, folder: Path, draws: int = DRAWS) -> Update:
    """Search and sample; the traces are written into the folder."""
    problem = cases.load("garteur")
    maxima = fmu.find_map(problem)
    used = problem.using([label for label in problem.data.labels if label not in HELD_OUT])

    def run(name: str) -> str:
        of, its_maxima = (problem, maxima) if name == "all modes" else (used, fmu.find_map(used))
        file = folder / f"{name}.nc"
        fmu.save_trace(_sampled(of, its_maxima, draws), file)
        return str(file)

    trace, without = map(
        fmu.load_trace, units.completed("runs", each(("all modes", "some held out")), run, least=2)
    )
    return Update(problem, maxima, trace, fmu.summary(trace), without, units.processor_s)


def _sampled(problem: fmu.UpdatingProblem, maxima: Maxima, draws: int) -> xr.DataTree:
    return fmu.sample(
        problem,
        "hmc",
        draws=draws,
        warmup=draws,
        chains=4,
        seed=SEED,
        maxima=maxima,
        until_ess=LEAST_ESS,
        max_draws=8 * draws,
    )


def write(done: Update, directory: Path) -> None:
    """Write ``garteur.md`` and ``garteur/*.png`` into the directory."""
    (directory / "garteur").mkdir(parents=True, exist_ok=True)
    for name, plot in _PICTURES.items():
        axes: Any = plot(done.trace)  # type: ignore[operator]
        figure = (axes.ravel()[0] if isinstance(axes, np.ndarray) else axes).figure
        figure.savefig(directory / "garteur" / f"{name}.png", dpi=DPI)
    (directory / "garteur.md").write_text(page(done), encoding="utf-8")


def page(done: Update) -> str:
    """Return the page."""
    verdict = "**All gates pass.**"
    if done.failures:
        verdict = "**Gates that fail:**\n\n" + "\n".join(f"- {failure}" for failure in done.failures)
    worst = np.abs(done.errors).max(axis=1)
    diagonal = done.mac.diagonal()
    others = done.mac[~np.eye(len(diagonal), dtype=bool)]
    found = fmu.identifiability(done.problem, done.maxima[0].theta)
    informed = int(np.sum(found.singular_values > 1.0))
    before = np.argsort(done.problem.frequencies(done.problem.start)).argsort() + 1
    return PAGE.format(
        verdict=verdict,
        worst=worst,
        frequencies=_frequencies(done, before.tolist()),
        parameters=_parameters(done),
        least=diagonal.min(),
        most=others.max(),
        rhat=done.summary["rhat"].max(),
        ess=done.summary["ess_bulk"].min(),
        draws=done.trace["posterior"].sizes["draw"],
        warmup=DRAWS,
        pairing=_bullets(fmu.pairing_changes(done.trace).sentences()),
        ndim=done.problem.ndim,
        modes=done.problem.data.n_modes,
        informed=informed,
        said=_bullets(found.sentences()),
        verdict_on_model=fmu.diagnose(done.trace).fit.answer,
        left_out=_predicted(done, done.trace),
        held_out=_predicted(done, done.without),
        verdict_on_held_out=fmu.diagnose(done.without).fit.answer,
        against=_bullets(fmu.diagnose(done.without).fit.against),
        names=names_in_words(HELD_OUT),
        gates=f"{MOST_ERROR:g} %, R-hat below {MOST_RHAT:g}, MAC above {LEAST_MAC:g}",
        minutes=done.processor_s / 60.0,
    )


def _frequencies(done: Update, before: Sequence[int]) -> str:
    data, start = done.problem.data, done.problem.frequencies(done.problem.start)
    measured, maximum = np.asarray(data.frequencies_hz), done.maxima[0].frequencies
    rows = [
        (
            str(k + 1),
            str(label),
            fixed(measured[k], 2),
            str(before[k]),
            fixed(start[k], 2),
            fixed(done.errors[0, k], 2),
            fixed(maximum[k], 2),
            *(fixed(error, 2) for error in done.errors[1:, k]),
            fixed(done.mac[k, k], 2),
        )
        for k, label in enumerate(data.labels)
    ]
    header = ("", "kind", "measured, Hz", "number before", "before, Hz", "error, %", "maximum, Hz", "error, %",
              "error of the mean, %", "MAC with before")  # fmt: skip
    return markdown_table(header, rows, words=(0, 1))


def _parameters(done: Update) -> str:
    shrunk = fmu.information(done.trace).table()["contraction"]
    rows = [
        (
            parameter.name,
            parameter.unit,
            significant(parameter.start, 4),
            significant(done.maxima[0].theta[k], 4),
            significant(done.summary["mean"][parameter.name], 4),
            " to ".join(significant(done.summary[f"eti90_{end}"][parameter.name], 3) for end in ("lb", "ub")),
            fixed(shrunk[parameter.name], 2),
            fixed(done.summary["rhat"][parameter.name], 4),
        )
        for k, parameter in enumerate(done.problem.parameters)
    ]
    header = ("parameter", "unit", "before", "maximum", "mean", "90 % interval", "contraction", "R-hat")
    return markdown_table(header, rows, words=(0, 1))


def _predicted(done: Update, trace: xr.DataTree) -> str:
    """Return how each mode is predicted without it, and the check that comes of it."""
    table, start = fmu.leave_one_out(trace), done.problem.frequencies(done.problem.start)
    checks = {check.of: check for check in fmu.diagnose(trace).fit.checks}
    rows = []
    for k, (mode, row) in enumerate(table.iterrows()):
        check = checks[f"mode {mode}"]
        is_known = np.isfinite(row["p"])
        rows.append(
            (
                str(mode),
                "yes" if row["used"] else "no",
                fixed(row["measured"], 2),
                fixed(start[k], 2),
                with_sd(row["mean"], row["sd"]) if is_known else MISSING,
                fixed(row["prior_sd"], 2),
                check.limit if is_known else MISSING,
                significant(row["p"], 2) if is_known else MISSING,
                "contradicts" if check.failed else check.why_not or ("agrees" if is_known else "not predicted"),
            )
        )
    header = ("mode", "used", "measured, Hz", "before, Hz", "predicted, Hz", "sd by the prior, Hz",
              "contradicts beyond, Hz", "p", "check")  # fmt: skip
    return markdown_table(header, rows, words=(0, 1, 4, 6, 8))


def _bullets(sentences: Sequence[str]) -> str:
    return "\n".join(f"- {sentence}" for sentence in sentences)


def main() -> int:
    """Run, write the page, and return the exit code."""
    asked = study_parser(__doc__).parse_args()
    with threadpool_limits(1), tempfile.TemporaryDirectory() as cache:
        os.environ["FMU_CACHE_DIR"] = cache  # a reduced model of an earlier version must not answer for this one
        done = update(Units(asked.kept, asked.minutes), asked.kept or Path(cache))
        write(done, asked.out)
    for failure in done.failures:
        print(failure)
    return 1 if done.failures else 0


PAGE = """# GARTEUR SM-AG19: ten frequencies of a laboratory aeroplane

Written by `python -m tests.validation.garteur results` ({minutes:.1f} min of one processor); every number is
computed. The problem is [fmu/cases/garteur.toml](../fmu/cases/garteur.toml), which says where each dimension
and frequency comes from; `fmu run garteur` gives the full report.

{verdict}

Gates: after updating no frequency is further from the measured one than {gates}.

The worst frequency is {worst[0]:.1f} % off before updating, {worst[1]:.2f} % at the maximum of the posterior,
and {worst[2]:.2f} % on average over it.

## Frequencies

{frequencies}
Kinds: n is the number of nodes of the wing; anti and sym are antisymmetric and symmetric about the fuselage.
The number before is the place of the mode among the elastic ones of the model before updating; six modes as a
rigid body come before them. It is not everywhere the measured one's place, and the case says which mode is
which (`counterparts`), by kind: no shapes are published with the frequencies.

![Errors of the frequencies before updating and after it](garteur/errors.png)

## Modes

Paired by MAC with the shapes before updating: at least {least:.2f} for what is paired, at most {most:.2f} for
what is not.

![The ten modes before updating and at the posterior mean](garteur/modes.png)

![MAC between modes before updating and at the posterior mean](garteur/mac.png)

Over the draws:

{pairing}

Bending with four nodes is symmetric and the in-plane mode antisymmetric: such modes pass each other without
mixing, and the log-probability, which follows the shape, goes on smoothly there.

## Parameters

Hamiltonian Monte Carlo, 4 chains of {draws} draws after {warmup} of warm-up: R-hat at most {rhat:.4f},
effective sample size at least {ess:.0f}. Stiffnesses without a unit are factors of their values in the file.
Contraction is 1 less the ratio of posterior and prior variance: near 1 the frequencies determine a parameter,
near 0 the prior does.

{parameters}
## Does the model fit?

The verdict on the update with all ten frequencies is: **{verdict_on_model}**. Each mode below is predicted by an
update with the other nine; the measurement noise of 0.5 % is part of the prediction.

{left_out}
The test that the updating has not seen: {names}, the three highest, are held out (`use = false`), and the other
seven modes are used. The verdict is then: **{verdict_on_held_out}**.

{held_out}
{against}

The tests of the aeroplane with added masses (Link & Friswell 2003) would be the better validation. Their
frequencies are not in any source at hand, so they are not used here.

## What is left to the prior

{modes} frequencies cannot determine {ndim} parameters. Linearised at the maximum, they say more than the prior
along {informed} directions:

{said}

The errors after updating are therefore small by construction where a parameter can be bent for each
frequency; what the update does show is that one set of values near the drawing, within what was thought
possible of each, gives all ten in the right kinds and the right order. The bending stiffness of the wing
comes down towards that of the wing without its constraining layer, in the outer half more than in the inner
one, as a layer on a tape that shears would have it. The joint in roll goes to the softer side of its prior; it
stands for whatever makes antisymmetric bending softer there, bolts, the plate and the tape alike. How stiff
the joint is in pitch, and the weights on the drums, stay what they were thought to be.
"""


if __name__ == "__main__":
    sys.exit(main())
