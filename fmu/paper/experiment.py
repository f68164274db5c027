"""Run one experiment in the paper with one mode pairing, and tabulate its results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fmu.analysis.convergence.comparison import compare_runs
from fmu.analysis.convergence.diagnostics import interval_columns, summary
from fmu.analysis.maxima.missed import missed_maxima
from fmu.analysis.maxima.search import find_map
from fmu.analysis.prediction import predict_frequencies
from fmu.analysis.trace.reading import in_solves, parameter_draws
from fmu.paper.convergence import (
    Curve,
    Needed,
    Reference,
    has_met_criterion,
    reference_posterior,
    running_error,
    solves_at_this_pace,
    solves_needed,
    starts_in_the_posterior,
)
from fmu.paper.plan import PAPER_SAMPLERS, SAMPLERS, Plan, Runs, long_settings, long_start, paper_settings
from fmu.paper.published import EXPERIMENTS
from fmu.paper.published import Experiment as Published
from fmu.paper.spectrum import paired_names, shares
from fmu.progress import Report
from fmu.tables import data_frame
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.analysis.maxima.results import Maxima
    from fmu.posterior.problem import UpdatingProblem


PAIRED_BY = {"index": "by number", "shape": "by shape"}
_LOOKED_AT = 2000


def directory_of(case: str, pairing: str) -> str:
    """Return the name of an experiment's directory, for example ``"young-index"``."""
    return f"{case.removeprefix('cantilever-')}-{pairing}"


@dataclass(frozen=True)
class Result:
    """The runs of one experiment and their comparison.

    The paper's protocol is a single chain with the paper's number of samples; the long runs are meant to converge
    (`fmu.paper.plan`).

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
        The physical modes paired with the measured modes at each maximum, for example ``"W1 W2 W3 W4 W5"``.
    paper, long : mapping of str to DataTree
        Traces of the paper's protocol and of the long runs, keyed by sampler.
    pace : mapping of str to DataTree
        Traces, keyed by sampler, of runs with the paper's settings that start from posterior draws; empty if no
        long run of a trusted sampler converged.
    one_start : DataTree
        Trace of HMC without jumps, with all chains started at the paper's starting vector.
    reference : Reference
        The best available estimate of the posterior.
    diagnoses : mapping of str to Diagnosis
        Each long run's diagnosis, from a comparison with the maxima and the other long runs.
    comparison : DataFrame
        The result of `fmu.compare` for the long runs, with these diagnoses.
    needed : mapping of str to Needed
        The length that each long run needed to converge.
    curves : mapping of str to tuple of Curve
        Running errors of each sampler's long run and, if performed, of the paper's protocol.
    places : mapping of str to mapping of str to float
        The fraction of each long run's draws at which each combination of physical modes is paired.
    """

    published: Published
    pairing: str
    problem: UpdatingProblem
    maxima: Maxima
    maxima_modes: tuple[str, ...]
    paper: Mapping[str, xr.DataTree]
    long: Mapping[str, xr.DataTree]
    pace: Mapping[str, xr.DataTree]
    one_start: xr.DataTree
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
        """Return True if the sampler's long run has converged."""
        return self.diagnoses[sampler].converged


def compute(case: str, pairing: str, plan: Plan, progress: Report | None = None) -> Result:
    """Perform all runs of one experiment and return them with their comparison.

    Parameters
    ----------
    case : str
        Name of a built-in case with published tables.
    pairing : {"index", "shape"}
    plan : Plan
    progress : callable, optional
        Called after every step as ``progress(phase, done, total, info)``, where the phase is the name of the
        experiment's directory.
    """
    from fmu import cases

    published = EXPERIMENTS[case]
    problem = cases.load(case, pairing)
    maxima = find_map(problem, plan.starts, plan.seed)
    runs = Runs(problem, maxima, plan.seed, directory_of(case, pairing), plan.steps, progress)
    paper = {
        s: runs.run(f"{s}, paper's protocol", paper_settings(s), plan.paper, "start", jumps=False)
        for s in PAPER_SAMPLERS
    }
    # no jumps: with them every second step of the paper's samplers would be another algorithm's
    long = {
        s: runs.run(f"{s}, long run", long_settings(s), plan.long[s], long_start(s, len(maxima)), jumps=False)
        for s in SAMPLERS
    }
    one_start = runs.run("hmc, from one start", long_settings("hmc"), plan.one_start, "start", jumps=False)
    _, diagnoses, comparison = compare_runs(long)
    pace = {}
    for s, length in plan.pace.items():
        starts = starts_in_the_posterior(long, diagnoses, length.chains)
        if starts is not None:
            pace[s] = runs.run(f"{s}, the paper's pace", paper_settings(s), length, starts, jumps=False)
    runs.finish()
    reference = reference_posterior(long, diagnoses, maxima)

    return Result(
        published=published,
        pairing=pairing,
        problem=problem,
        maxima=maxima,
        maxima_modes=tuple(" ".join(row) for row in paired_names(problem, np.array([m.theta for m in maxima]))),
        paper=paper,
        long=long,
        pace=pace,
        one_start=one_start,
        reference=reference,
        diagnoses=diagnoses,
        comparison=comparison,
        needed={s: _length_needed(trace, diagnoses[s], maxima) for s, trace in long.items()},
        curves={
            s: tuple(running_error(t, reference) for t in (trace, paper.get(s)) if t is not None)
            for s, trace in long.items()
        },
        places={s: _places(problem, trace) for s, trace in long.items()},
    )


def _length_needed(trace: xr.DataTree, diagnosis: Diagnosis, maxima: Maxima) -> Needed:
    """Return the length that a run needed to converge. All its attributes are None if the run did not converge."""
    if not diagnosis.converged:
        return Needed()
    return solves_needed(trace, lambda short: not missed_maxima(short, maxima) and has_met_criterion(short))


def _places(problem: UpdatingProblem, trace: xr.DataTree) -> dict[str, float]:
    """Return the fraction of draws at which each combination of physical modes is paired.

    The examined draws are evenly spaced. Their number is at least 2000, unless the run has fewer draws.
    """
    draws = parameter_draws(trace)
    every = max(1, draws.shape[0] * draws.shape[1] // _LOOKED_AT)
    return shares(paired_names(problem, draws.reshape(-1, draws.shape[-1])[::every]))


CI_PROB = 0.9


def posterior_mean(trace: xr.DataTree) -> FloatArray:
    """Return the mean of all draws after warm-up, shape (ndim,), SI units."""
    return parameter_draws(trace).mean(axis=(0, 1))


def parameter_table(result: Result) -> pd.DataFrame:
    """Return a table of the published parameters (Table 1 or 3) and our results, one row per parameter, SI units.

    The columns are ``unit``; ``published_*``, as printed; ``maximum``, the highest posterior maximum; ``paper_*``,
    the posterior means with the paper's protocol; ``long_*_mean``, ``long_*_sd``, ``long_*_mcse`` and the ends of
    the interval, for the long runs; and ``reference_mean``, ``reference_sd`` and ``reference_mcse``.
    """
    columns: dict[str, object] = {"unit": result.problem.units}
    for name, column in result.published.columns.items():
        columns[f"published_{name}"] = column.printed_theta
    columns["maximum"] = result.maxima[0].theta
    for name, trace in result.paper.items():
        columns[f"paper_{name}"] = posterior_mean(trace)
    lower, upper = interval_columns(CI_PROB)
    for name, trace in result.long.items():
        table = summary(trace, CI_PROB)
        for statistic in ("mean", "sd", "mcse_mean", lower, upper):
            columns[f"long_{name}_{statistic.removesuffix('_mean')}"] = table[statistic].to_numpy()
    reference = result.reference
    columns |= {"reference_mean": reference.mean, "reference_sd": reference.sd, "reference_mcse": reference.mcse}
    return data_frame(columns, "parameter", result.problem.names)


def frequency_table(result: Result) -> pd.DataFrame:
    """Return a table of the published frequencies (Table 2 or 4) and our frequencies, one row per measured mode.

    Columns ``*_hz`` are frequencies in Hz, and columns ``*_error`` are errors |f − f_m|/f_m in %. The columns are
    ``measured_hz``; ``published_*``, as printed; ``recomputed_*``, the model at the published parameters, with
    misprints corrected and this experiment's pairing; ``maximum_*``, the model at the highest posterior maximum;
    and ``paper_*`` and ``long_*``, the model at our posterior mean. ``long_*_predictive`` and its interval are the
    mean and the interval in Hz of the posterior predictive distribution for a new measurement, eq. (10) of the
    paper.
    """
    error, frequencies = result.published.error_percent, result.problem.frequencies
    columns: dict[str, object] = {"measured_hz": result.published.measured_hz}
    for name, column in result.published.columns.items():
        columns[f"published_{name}_hz"] = column.printed_hz
        columns[f"published_{name}_error"] = column.printed_errors
        recomputed = frequencies(column.theta)
        columns[f"recomputed_{name}_hz"] = recomputed
        columns[f"recomputed_{name}_error"] = error(recomputed)
    columns["maximum_hz"] = result.maxima[0].frequencies
    columns["maximum_error"] = error(result.maxima[0].frequencies)
    lower, upper = interval_columns(CI_PROB)
    for kind, traces in (("paper", result.paper), ("long", result.long)):
        for name, trace in traces.items():
            at_mean = frequencies(posterior_mean(trace))
            columns[f"{kind}_{name}_hz"] = at_mean
            columns[f"{kind}_{name}_error"] = error(at_mean)
            if kind == "long":
                predicted = predict_frequencies(trace, CI_PROB)
                columns[f"long_{name}_predictive"] = predicted["mean"].to_numpy()
                columns[f"long_{name}_predictive_{lower}"] = predicted[f"noisy_{lower}"].to_numpy()
                columns[f"long_{name}_predictive_{upper}"] = predicted[f"noisy_{upper}"].to_numpy()
    return data_frame(columns, "mode", result.problem.data.labels)


def comparison_table(result: Result) -> pd.DataFrame:
    """Return the result of `fmu.compare` for the long runs with more columns on cost and error.

    A solve is one evaluation of the log-probability, and an exact gradient counts as ``gradient_cost`` solves. The
    columns added to `fmu.compare` are:

    ``sampling_solves``, ``sampling_gradients`` and ``ess_per_sampling_solve``: the long run's solves, gradients
    and efficiency without the warm-up.

    ``needed_draws``, ``needed_samples``, ``needed_solves`` and ``needed_s``: the length from which on the long run
    met the criterion of `fmu.paper.convergence.has_met_criterion` and missed no maximum. The first counts steps
    per chain after warm-up. The others are steps, solves and time in s of all chains, warm-up included;
    ``needed_sampling_samples`` and so on leave it out. All are missing if the long run did not converge.

    ``paper_solves``: solves with the paper's protocol.

    ``paper_needed_solves``: estimated solves for the effective sample size that convergence requires, with the
    paper's settings and chains that start in the posterior; missing if no long run of a trusted sampler converged,
    because that run provides the starting points. ``paper_pace_ess``: the ESS that this is estimated from.

    ``paper_error``: largest distance between a posterior mean with the paper's protocol and the reference, in
    posterior sd.

    ``published_error``: largest distance between a published parameter and the reference mean, in posterior sd.

    ``published_percent`` and ``published_rms_hz``: mean of the printed errors of the frequencies, and the root
    mean square difference of the published from the measured frequencies.

    The columns from ``paper_solves`` on are missing for samplers that the paper does not use.
    """
    table = result.comparison.copy()
    off = {s: _distance(result, posterior_mean(trace)) for s, trace in result.paper.items()}
    published = {s: _distance(result, result.published.columns[s].theta) for s in PAPER_SAMPLERS}
    cost = {s: int(trace.attrs["n_solves"]) for s, trace in result.paper.items()}
    table["sampling_solves"] = [
        round(in_solves(trace, *(int(trace.attrs[n]) for n in ("n_solves", "n_gradients"))))
        for trace in result.long.values()
    ]
    table["sampling_gradients"] = [int(trace.attrs["n_gradients"]) for trace in result.long.values()]
    table["ess_per_sampling_solve"] = table["ess_bulk_min"] / table["sampling_solves"]
    counts: dict[str, list[float | None]] = {}
    needed = [result.needed[s] for s in table.index]
    for part in ("", "sampling_"):
        counts[f"needed_{part}solves"] = [getattr(n, f"{part}solves") for n in needed]
        counts[f"needed_{part}samples"] = [getattr(n, f"{part}samples") for n in needed]
        table[f"needed_{part}s"] = np.array([getattr(n, f"{part}seconds") for n in needed], dtype=float)
    counts["needed_draws"] = [n.draws for n in needed]
    counts["paper_solves"] = [cost.get(s) for s in table.index]
    pace = {s: solves_at_this_pace(trace) for s, trace in result.pace.items()}
    paces = [pace.get(s) for s in table.index]
    counts["paper_needed_solves"] = [p and p.solves for p in paces]
    for column, values in counts.items():
        table[column] = [None if x is None else round(x) for x in values]
        table[column] = table[column].astype("Int64")
    table["paper_pace_ess"] = [np.nan if p is None else p.ess for p in paces]
    of_paper = {
        "paper_error": off,
        "published_error": published,
        "published_percent": {s: result.published.mean_error(s) for s in PAPER_SAMPLERS},
        "published_rms_hz": {
            s: np.sqrt(result.published.misfit(s) / len(result.published.measured)) for s in PAPER_SAMPLERS
        },
    }
    for column, known in of_paper.items():
        table[column] = [known.get(s, np.nan) for s in table.index]
    return table


class OneStart(NamedTuple):
    """The length, convergence and error of a run in which all chains start from the same vector.

    Attributes
    ----------
    chains, draws : int
        Number of chains, and of draws per chain.
    rhat, ess : float
        The largest R-hat and the smallest bulk ESS over the parameters.
    off : float
        The largest distance between a posterior mean and the reference, in posterior standard deviations.
    reasons : tuple of str
        Why the run has not converged; empty if it has.
    """

    chains: int
    draws: int
    rhat: float
    ess: float
    off: float
    reasons: tuple[str, ...]


def one_start(result: Result) -> OneStart:
    """Return the length, convergence and error of the run in which all chains start from the same vector."""
    trace = result.one_start
    of_run = compare_runs({"hmc": trace})
    table = of_run.summaries["hmc"]
    return OneStart(
        int(trace.attrs["chains"]),
        int(trace.attrs["draws"]),
        float(table["rhat"].max()),
        float(table["ess_bulk"].min()),
        _distance(result, posterior_mean(trace)),
        of_run.verdicts["hmc"].reasons,
    )


def agreement(result: Result) -> tuple[float, float, tuple[str, ...]]:
    """Return the largest differences between the posterior means of the converged long runs, and their samplers.

    Returns
    -------
    in_sd, in_mcse : float
        Largest difference between two posterior means over all parameters, in posterior sd and in standard errors
        of the difference. NaN if fewer than two runs converged.
    samplers : tuple of str
        The samplers whose long runs converged.
    """
    names = tuple(s for s in result.long if result.is_converged(s))
    tables = [summary(result.long[s]) for s in names]
    in_sd = in_mcse = np.nan
    for i, one in enumerate(tables):
        for other in tables[:i]:
            difference = np.abs(one["mean"].to_numpy() - other["mean"].to_numpy())
            error = np.hypot(one["mcse_mean"].to_numpy(), other["mcse_mean"].to_numpy())
            in_sd = float(np.fmax(in_sd, np.max(difference / result.reference.sd)))
            in_mcse = float(np.fmax(in_mcse, np.max(difference / error)))
    return in_sd, in_mcse, names


def _distance(result: Result, theta: FloatArray) -> float:
    return float(np.max(np.abs(theta - result.reference.mean) / result.reference.sd))


def rows_of(frame: pd.DataFrame) -> list[tuple[str, dict[str, Any]]]:
    """Return the name and the cells of each table row. The cells are a dict keyed by column."""
    rows = frame.itertuples(name=None)
    return [(str(name), dict(zip(frame.columns, cells, strict=True))) for name, *cells in rows]
