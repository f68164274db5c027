"""Collect the findings on one experiment as tables, and use them to judge the paper's statements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan
from typing import TYPE_CHECKING, NamedTuple

from fmu.analysis.convergence.diagnosis import CONVERGED
from fmu.analysis.maxima.missed import nearest_maxima
from fmu.analysis.maxima.results import Maxima
from fmu.analysis.trace.reading import parameter_draws
from fmu.numbers import MISSING, fixed, significant, whole
from fmu.paper.experiment import (
    PAIRED_BY,
    OneStart,
    Result,
    agreement,
    comparison_table,
    directory_of,
    frequency_table,
    one_start,
    parameter_table,
)
from fmu.paper.plan import PAPER_SAMPLERS
from fmu.paper.published import EXPERIMENTS
from fmu.paper.studies.vector_beta import VectorBeta
from fmu.paper.studies.wrong_model import WrongModel
from fmu.report.plots import TITLES

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.paper.published import Experiment as Published


_CERTIFICATE = "certificate_"
DEEP = 1e3
"""A maximum is ignored if its log-probability is lower than the highest maximum's by this difference or more."""


@dataclass(frozen=True)
class Findings:
    """The results of one experiment as tables, small enough to pass between processes.

    Attributes
    ----------
    case, pairing : str
    parameters, frequencies, comparison : DataFrame
        The tables from `fmu.paper.experiment`: `parameter_table`, `frequency_table` and `comparison_table`.
    maxima : DataFrame
        Local maxima of the posterior, the highest first (`fmu.analysis.maxima.results.Maxima.table`), with a
        column ``modes`` for the physical modes paired at each maximum.
    reasons, warnings : mapping of str to tuple of str
        The reasons why the long run has not converged, and the warnings about the model, keyed by sampler.
    never_near : tuple of str
        Samplers whose long run has no draw near the highest maximum.
    places : mapping of str to mapping of str to float
        The fraction of each long run's draws at which each combination of physical modes is paired.
    one_start : OneStart
        Results of the run whose chains all have the same starting vector.
    agreement : tuple
        How well the converged long runs agree (`fmu.paper.experiment.agreement`).
    origin : str
        The source of the reference posterior, in words.
    settings : mapping of str to str
        Each saved run's settings, as JSON, keyed by sampler and kind (``"mh, paper"``, ``"mh, long"``, ``"hmc,
        one start"``).
    learnt : mapping of str to str
        Settings tuned in each run's warm-up, as JSON, with the same keys.
    lengths : mapping of str to tuple of int
        Each run's numbers of chains, warm-up steps and draws, with the same keys.
    certificates : mapping of str to mapping of str to float
        Errors of the reduced model at some of each run's draws (`fmu.analysis.certificate`), with the same keys.
    weighted : VectorBeta, optional
        Results with a separate β for every mode, if that run was performed.
    wrong : WrongModel, optional
        Results with a model that may be wrong.
    """

    case: str
    pairing: str
    parameters: pd.DataFrame
    frequencies: pd.DataFrame
    comparison: pd.DataFrame
    maxima: pd.DataFrame
    reasons: Mapping[str, tuple[str, ...]]
    warnings: Mapping[str, tuple[str, ...]]
    never_near: tuple[str, ...]
    places: Mapping[str, Mapping[str, float]]
    one_start: OneStart
    agreement: tuple[float, float, tuple[str, ...]]
    origin: str
    settings: Mapping[str, str]
    learnt: Mapping[str, str]
    lengths: Mapping[str, tuple[int, int, int]]
    certificates: Mapping[str, Mapping[str, float]]
    weighted: VectorBeta | None = None
    wrong: WrongModel | None = None

    @classmethod
    def of(cls, result: Result, weighted: VectorBeta | None = None, wrong: WrongModel | None = None) -> Findings:
        """Collect the findings from an experiment's runs and, if performed, the studies `weighted` and `wrong`."""
        traces = {f"{name}, paper": trace for name, trace in result.paper.items()}
        traces |= {f"{name}, long": trace for name, trace in result.long.items()}
        traces["hmc, one start"] = result.one_start
        maxima = result.maxima.table()
        maxima["modes"] = result.maxima_modes
        return cls(
            case=result.published.case,
            pairing=result.pairing,
            parameters=parameter_table(result),
            frequencies=frequency_table(result),
            comparison=comparison_table(result),
            maxima=maxima,
            reasons={name: diagnosis.reasons for name, diagnosis in result.diagnoses.items()},
            warnings={name: diagnosis.warnings for name, diagnosis in result.diagnoses.items()},
            never_near=tuple(name for name, trace in result.long.items() if not _is_near(trace, result.maxima)),
            places=result.places,
            one_start=one_start(result),
            agreement=agreement(result),
            origin=result.reference.origin,
            settings={key: str(trace.attrs["settings"]) for key, trace in traces.items()},
            learnt={key: str(trace.attrs.get("learnt", "{}")) for key, trace in traces.items()},
            lengths={
                key: (int(trace.attrs["chains"]), int(trace.attrs["warmup"]), int(trace.attrs["draws"]))
                for key, trace in traces.items()
            },
            certificates={
                key: {
                    str(name).removeprefix(_CERTIFICATE): float(value)
                    for name, value in trace.attrs.items()
                    if str(name).startswith(_CERTIFICATE)
                }
                for key, trace in traces.items()
            },
            weighted=weighted,
            wrong=wrong,
        )

    @property
    def published(self) -> Published:
        """The paper's tables."""
        return EXPERIMENTS[self.case]

    @property
    def name(self) -> str:
        """Name of the experiment's directory."""
        return directory_of(self.case, self.pairing)

    @property
    def ndim(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    def is_converged(self, sampler: str) -> bool:
        """Return True if the sampler's long run has converged."""
        return bool(self.comparison.loc[sampler, "verdict"] == CONVERGED)

    def value(self, sampler: str, column: str) -> float:
        """Return an entry in the comparison table, or NaN if it is missing."""
        cell = self.comparison[column][sampler]
        return float("nan") if str(cell) == "<NA>" else float(cell)

    def in_paper_units(self, parameter: str, *columns: str) -> list[float]:
        """Return entries in the parameter table, divided by the paper's power of ten for that parameter."""
        factor, _ = self.unit_of_paper(parameter)
        return [float(self.parameters[column][parameter]) / factor for column in columns]

    @property
    def central_difference_rate(self) -> float:
        """Effective draws of HMC per solve after warm-up if each gradient cost 2·ndim solves.

        The central differences in eq. (15) of the paper cost as much. Only the solves for gradients are counted.
        """
        return self.value("hmc", "ess_bulk_min") / (2 * self.ndim * self.value("hmc", "sampling_gradients"))

    @property
    def separate_maxima(self) -> pd.DataFrame:
        """Table rows of the maxima whose log-probability is less than `DEEP` below the highest maximum."""
        return self.maxima[self.maxima["log_prob"] > self.maxima["log_prob"].iloc[0] - DEEP]

    def unit_of_paper(self, parameter: str) -> tuple[float, str]:
        """Return the power of ten by which the paper scales a parameter, and the unit label: ``"1e-9 m⁴"``."""
        position = self.published.parameter_names.index(parameter)
        exponent = self.published.columns["initial"].parameters[position].exponent
        return float(f"1e{exponent}"), f"1e{exponent} {self.parameters['unit'][parameter]}"


def _is_near(trace: xr.DataTree, maxima: Maxima) -> bool:
    """Return True if a draw is near the highest maximum."""
    draws = parameter_draws(trace)
    return 0 in nearest_maxima(draws.reshape(-1, draws.shape[2]), maxima)


SHORT = {"hmc": "HMC", "mh": "MH", "slice": "slice sampling"}
"""Short names of the paper's samplers."""
FASTER, BETTER = "converges faster than", "gives better results than"
CLAIMS = {
    "cantilever-young": (
        *(("hmc", FASTER, "mh"), ("hmc", FASTER, "slice"), ("mh", FASTER, "slice")),
        *(("mh", BETTER, "slice"), ("hmc", BETTER, "slice")),
    ),
    "cantilever-section": (
        *(("hmc", FASTER, "mh"), ("hmc", FASTER, "slice")),
        *(("mh", BETTER, "slice"), ("hmc", BETTER, "mh"), ("hmc", BETTER, "slice")),
    ),
}
"""The paper's comparisons of two samplers, from the abstract and sections 5.1, 5.2 and 6."""
CRITERIA: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    FASTER: {
        "samples to converge": ("needed_samples", "needed_sampling_samples"),
        "solves to converge": ("needed_solves", "needed_sampling_solves"),
        "seconds to converge": ("needed_s", "needed_sampling_s"),
    },
    BETTER: {
        "mean error of the published frequencies, %": ("published_percent",),
        "rms error of the published frequencies, Hz": ("published_rms_hz",),
        "worst of the published means, sd off": ("published_error",),
    },
}
"""The criteria for each kind of statement, with their columns in the comparison table; smaller values are better.
The second column of a criterion is without the warm-up. The paper does not state the settings of its runs, so its
tables decide which results are better, not our runs with its protocol."""


CLOSE = 1.25
"""Efficiencies with a smaller ratio are not distinguished: an estimated ESS scatters by about a tenth."""
CLOSE_LENGTHS = 2.0
"""Lengths and errors with a smaller ratio are not distinguished, because each comes from a single run."""
DEPENDS = "depends on the warm-up"
SEPARATED = (
    "The posterior has separated modes, and a run that has not converged reports the ones it fell into: that its "
    "results differ says nothing about the sampler. "
)


class Judgement(NamedTuple):
    """A statement in the paper, judged by one criterion, with the outcome and the figures behind it.

    The `outcome` is ``"agrees"``, ``"disagrees"``, ``"too close to call"``, ``"depends on the warm-up"`` or
    ``"cannot be judged"``.
    """

    statement: str
    criterion: str
    outcome: str
    evidence: str


def judge(findings: Findings) -> list[Judgement]:
    """Judge the paper's statements on one experiment by every criterion that the paper may have meant.

    Two entries in the comparison table decide, but a ratio below `CLOSE_LENGTHS` is too close to call. Entries on
    convergence are compared with and without the warm-up, whose length was chosen beforehand; if the outcomes
    differ, the statement depends on the warm-up. If only one of the two samplers' long runs converged, that
    sampler converges faster; if neither did, the statement cannot be judged.
    """
    decide = {FASTER: _decide_speed, BETTER: _decide}
    return [
        Judgement(f"{SHORT[a]} {verb} {SHORT[b]}", criterion, *decide[verb](findings, a, b, columns))
        for a, verb, b in CLAIMS[findings.case]
        for criterion, columns in CRITERIA[verb].items()
    ]


def _decide_speed(findings: Findings, better: str, worse: str, columns: Sequence[str]) -> tuple[str, str]:
    """Return the outcome of a statement on convergence, and the figures behind it."""
    done = {s: findings.is_converged(s) for s in (better, worse)}
    if not any(done.values()):
        return "cannot be judged", "neither long run is converged"
    if not all(done.values()):
        winner = better if done[better] else worse
        loser = worse if done[better] else better
        spent = whole(findings.value(loser, "n_solves"))
        words = f"{TITLES[winner]} converged, {TITLES[loser]} did not in {spent} solves"
        return ("agrees" if winner == better else "disagrees"), words
    return _decide(findings, better, worse, columns)


def _decide(findings: Findings, better: str, worse: str, columns: Sequence[str]) -> tuple[str, str]:
    """Return the outcome of a statement by entries in the comparison table, and these entries."""
    outcomes, figures = [], []
    for column in columns:
        mine, other = (findings.value(s, column) for s in (better, worse))
        if isnan(mine) or isnan(other):
            outcomes.append("cannot be judged")
        elif max(mine, other) < CLOSE_LENGTHS * min(mine, other):
            outcomes.append("too close to call")
        else:
            outcomes.append("agrees" if mine < other else "disagrees")
        figures.append(f"{figure(mine, column)} against {figure(other, column)}")
    if len(set(outcomes)) > 1:
        return DEPENDS, f"{figures[0]}: {outcomes[0]}; without the warm-up {figures[1]}: {outcomes[1]}"
    return outcomes[0], "; without the warm-up ".join(figures)


def figure(value: float, column: str) -> str:
    """Format an entry of the comparison table that the statements are judged by."""
    if column.endswith(("_samples", "_solves")):
        return whole(value)
    return fixed(value, 2 if column == "published_percent" else 1)


def statement(findings: Findings) -> str:
    """Return a paragraph on the most efficient samplers and on how well the converged samplers agree.

    If no sampler converged, the paragraph says so, and whether the posterior has separated modes.
    """
    heading = f"**Section {findings.published.section}, paired {PAIRED_BY[findings.pairing]}.** "
    samplers = list(findings.comparison.index)
    after, all_in = "ess_per_sampling_solve", "ess_per_solve"
    ranked = sorted(filter(findings.is_converged, samplers), key=lambda s: -findings.value(s, after))
    if not ranked:
        words = heading + "No sampler converged; nothing here says which one is better. "
        return words + (SEPARATED if len(findings.separate_maxima) > 1 else "")
    rates = ", ".join(f"{TITLES[s]} {both_rates(findings, s)}" for s in ranked)
    first, with_warmup = (_first(findings, ranked, column) for column in (after, all_in))
    words = (
        heading + f"Most: {first}. " + ("" if with_warmup == first else f"If the warm-up counts: {with_warmup}. ")
    )
    words += f"Effective draws per solve of the converged (in brackets without the warm-up): {rates}. "
    if len(ranked) < len(samplers):
        words += f"Not converged: {', '.join(TITLES[s] for s in samplers if s not in ranked)}. "
    if "hmc" in ranked:
        words += _at_the_papers_price(findings, [s for s in PAPER_SAMPLERS if s in ranked and s != "hmc"])
    in_sd, in_mcse, names = findings.agreement
    if len(names) > 1:
        words += (
            f"The converged samplers give one answer: their means differ by at most {fixed(in_sd, 2)} posterior "
            f"sd, {fixed(in_mcse, 1)} standard errors of the difference. "
        )
    return words


def both_rates(findings: Findings, sampler: str) -> str:
    """Return effective draws per solve, and in brackets without the warm-up; a dash if it has not converged."""
    if not findings.is_converged(sampler):
        return MISSING
    with_warmup, without = (findings.value(sampler, of) for of in ("ess_per_solve", "ess_per_sampling_solve"))
    return f"{significant(with_warmup, 2)} ({significant(without, 2)})"


def to_converge(findings: Findings, sampler: str) -> list[str]:
    """Return texts on the samples, solves and seconds to converge, each in brackets without the warm-up.

    The texts are dashes if the run has not converged.
    """
    if not findings.is_converged(sampler):
        return [MISSING] * len(CRITERIA[FASTER])
    both = ([figure(findings.value(sampler, of), of) for of in columns] for columns in CRITERIA[FASTER].values())
    return [f"{with_warmup} ({without})" for with_warmup, without in both]


def _first(findings: Findings, samplers: Sequence[str], column: str) -> str:
    """Return the names of the samplers with the largest entries in a column of the comparison table."""
    most = max(findings.value(s, column) for s in samplers)
    first = [TITLES[s] for s in samplers if findings.value(s, column) * CLOSE > most]
    return ", ".join(first) + (" (too close to call)" if first[1:] else "")


def _at_the_papers_price(findings: Findings, rivals: list[str]) -> str:
    """Return a sentence on how efficient HMC would be if every gradient were a central difference."""
    rate = findings.central_difference_rate
    words = (
        f"With the paper's central differences, {2 * findings.ndim} solves a gradient, HMC would have "
        f"{significant(rate, 2)} without the warm-up"
    )
    if rivals:
        leads = all(rate > findings.value(s, "ess_per_sampling_solve") for s in rivals)
        words += ", still the most" if leads else ", no longer the most"
        words += " of the paper's samplers"
    return words + ". "
