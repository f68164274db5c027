"""One experiment of the paper with one pairing: every run that is made of it, and what follows from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fmu.paper.convergence import Curve, Needed, running_error, solves_needed
from fmu.paper.plan import PAPER_SAMPLERS, SAMPLERS, Plan, long_settings, paper_settings
from fmu.paper.published.spectrum import paired_names, shares
from fmu.paper.published.tables import EXPERIMENTS
from fmu.paper.published.tables import Experiment as Published
from fmu.paper.reference import Reference, around_the_maxima, pooled
from fmu.paper.runs import Runs
from fmu.progress import Report
from fmu.report.plots import TITLES

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.analysis.maxima.results import Maxima
    from fmu.posterior.problem import UpdatingProblem

PAIRED_BY = {"index": "by number", "shape": "by shape"}
TRUSTED = ("hmc", "emcee")
"""Samplers whose converged long runs make the reference."""
_LOOKED_AT = 2000


def directory_of(case: str, pairing: str) -> str:
    """Return the name of the directory of an experiment, ``"young-index"`` for example."""
    return f"{case.removeprefix('cantilever-')}-{pairing}"


@dataclass(frozen=True)
class Result:
    """The runs of one experiment.

    Attributes
    ----------
    published : Published
        The paper's tables.
    pairing : str
        ``"index"`` or ``"shape"``.
    problem : UpdatingProblem
    maxima : Maxima
        Local maxima of the posterior, the highest first.
    maxima_modes : tuple of str
        The physical modes paired with the measured ones at each maximum, ``"W1 W2 W3 W4 W5"`` for example.
    paper, long : mapping of str to DataTree
        Traces under the paper's protocol and of the long runs, by sampler.
    pace : mapping of str to DataTree
        Traces with the paper's settings from draws of the posterior; none where no trusted long run converged.
    reference : Reference
    diagnoses : mapping of str to Diagnosis
        The verdicts on the long runs, which know the maxima and each other.
    comparison : DataFrame
        `fmu.compare` of the long runs, with those verdicts.
    needed : mapping of str to Needed
        Of the long runs.
    curves : mapping of str to tuple of Curve
        Running errors by sampler: of the long run, and of the paper's protocol where there is one.
    places : mapping of str to mapping of str to float
        For each long run, the share of its draws at which each combination of physical modes is paired.
    """

    published: Published
    pairing: str
    problem: UpdatingProblem
    maxima: Maxima
    maxima_modes: tuple[str, ...]
    paper: Mapping[str, xr.DataTree]
    long: Mapping[str, xr.DataTree]
    pace: Mapping[str, xr.DataTree]
    reference: Reference
    diagnoses: Mapping[str, Diagnosis]
    comparison: pd.DataFrame
    needed: Mapping[str, Needed]
    curves: Mapping[str, tuple[Curve, ...]]
    places: Mapping[str, Mapping[str, float]]

    @property
    def name(self) -> str:
        """Name of the experiment's directory."""
        return directory_of(self.published.case, self.pairing)

    def is_converged(self, sampler: str) -> bool:
        """Return whether the verdict on the long run of a sampler was good."""
        return self.diagnoses[sampler].converged


def compute(case: str, pairing: str, plan: Plan, progress: Report | None = None) -> Result:
    """Make all runs of one experiment.

    Parameters
    ----------
    case : str
        A built-in case with published tables.
    pairing : {"index", "shape"}
    plan : Plan
    progress : callable, optional
        Called after every step as ``progress(phase, done, total, info)``, the phase being the experiment's name.
    """
    from fmu import cases
    from fmu.analysis.convergence.comparison import side_by_side
    from fmu.analysis.convergence.diagnosis import diagnose_all
    from fmu.analysis.convergence.diagnostics import summary
    from fmu.analysis.maxima.search import find_map

    published = EXPERIMENTS[case]
    problem = cases.load(case, pairing)
    maxima = find_map(problem, plan.starts, plan.seed)
    runs = Runs(problem, maxima, plan.seed, directory_of(case, pairing), plan.steps, progress)
    paper = {s: runs.run(f"{s}, paper's protocol", paper_settings(s), plan.paper, "start") for s in PAPER_SAMPLERS}
    long = {s: runs.run(f"{s}, long run", long_settings(s), plan.long[s], "prior") for s in SAMPLERS}
    summaries = {s: summary(trace) for s, trace in long.items()}
    diagnoses = diagnose_all(long, summaries=summaries)
    pace = {}
    for s, length in plan.pace.items():
        starts = starts_in_the_posterior(long, diagnoses, length.chains)
        if starts is not None:
            pace[s] = runs.run(f"{s}, the paper's pace", paper_settings(s), length, starts)
    runs.finish()
    reference = _reference(long, diagnoses, maxima)

    return Result(
        published=published,
        pairing=pairing,
        problem=problem,
        maxima=maxima,
        maxima_modes=tuple(" ".join(row) for row in paired_names(problem, np.array([m.theta for m in maxima]))),
        paper=paper,
        long=long,
        pace=pace,
        reference=reference,
        diagnoses=diagnoses,
        comparison=side_by_side(long, summaries, diagnoses),
        needed={s: _needed(trace, diagnoses[s], maxima) for s, trace in long.items()},
        curves={
            s: tuple(running_error(t, reference) for t in (trace, paper.get(s)) if t is not None)
            for s, trace in long.items()
        },
        places={s: _places(problem, trace) for s, trace in long.items()},
    )


def _needed(trace: xr.DataTree, diagnosis: Diagnosis, maxima: Maxima) -> Needed:
    """Return when a run began to pass for converged; one that never did needs no search."""
    from fmu.analysis.convergence.diagnostics import convergence_failures
    from fmu.analysis.maxima.missed import missed_maxima

    if not diagnosis.converged:
        return Needed(None, None)
    return solves_needed(trace, lambda short: missed_maxima(short, maxima) + convergence_failures(short))


def starts_in_the_posterior(
    long: Mapping[str, xr.DataTree], diagnoses: Mapping[str, Diagnosis], chains: int
) -> NDArray[np.float64] | None:
    """Return draws (chains, ndim) spread over a converged run of a trusted sampler; None where none has."""
    from fmu.analysis.convergence.diagnostics import parameter_draws

    for name in TRUSTED:
        if diagnoses[name].converged:
            draws = parameter_draws(long[name])
            every = np.linspace(0, draws.shape[0] * draws.shape[1] - 1, chains).astype(int)
            return draws.reshape(-1, draws.shape[2])[every]
    return None


def _reference(long: Mapping[str, xr.DataTree], diagnoses: Mapping[str, Diagnosis], maxima: Maxima) -> Reference:
    """Pool the converged runs of the trusted samplers; without one, ask the maxima."""
    good = {s: long[s] for s in TRUSTED if diagnoses[s].converged}
    if not good:
        return around_the_maxima(maxima)
    return pooled(good, f"long runs of {' and '.join(TITLES[s] for s in good)}, pooled")


def _places(problem: UpdatingProblem, trace: xr.DataTree) -> dict[str, float]:
    """Return which physical modes are paired at some thousands of draws spread over a trace."""
    from fmu.analysis.convergence.diagnostics import parameter_draws

    draws = parameter_draws(trace)
    every = max(1, draws.shape[0] * draws.shape[1] // _LOOKED_AT)
    return shares(paired_names(problem, draws.reshape(-1, draws.shape[-1])[::every]))
