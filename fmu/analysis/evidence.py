"""The evidence of a model, its standard error, and how it was estimated."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence import effective
from fmu.analysis.convergence.pareto import heavy_tail_in_words, pareto_k
from fmu.analysis.evidence_estimators import by_bridge, by_importance, stepping_stone, stones, thermodynamic
from fmu.analysis.maxima.results import RELIABLE
from fmu.analysis.trace.reading import array_of, check_trace, has, is_pseudo
from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import apart, given, significant, with_sd
from fmu.samplers.mixture.kernel import CANDIDATE, LOG_WEIGHT
from fmu.samplers.tempering.tempering import rejections
from fmu.tables import data_frame
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.analysis.convergence.diagnosis import Diagnosis
    from fmu.analysis.maxima.results import Maxima


GROUP = "tempering"
"""Name of the trace group that stores log-likelihoods and swaps at the rungs of a temperature ladder."""
METHODS = ("stepping-stone", "thermodynamic")
OF_MIXTURE = ("importance", "bridge")
FEWEST_CANDIDATES = 100
"""Smallest number of candidates from which the tail of their weights is estimated."""
RHAT_LIMIT = 1.05
"""The evidence is unreliable if R-hat of the log-likelihood at any rung is at least this value."""


@dataclass(frozen=True)
class Evidence:
    """The logarithm of the evidence ∫ P(D|θ) P(θ) dθ.

    The likelihood is normalised as a density of the data, in Hz for measured frequencies, and the prior is
    normalised within the bounds. Evidences of different models of the same data can therefore be compared.

    Attributes
    ----------
    log_evidence : float
        Natural logarithm of the evidence.
    error : float
        Standard error of `log_evidence`, the larger of `within` and `between`. It does not cover modes that no
        chain has found; see `warnings`.
    method : {"stepping-stone", "thermodynamic", "importance", "bridge"}
    within : float
        Standard error from the autocorrelation along the chains, over all rungs together. For a mixture, it
        follows from the spread of the candidates' weights, since candidates are independent. With "bridge" it also
        includes the error of the draws' contributions and, as draws are accepted candidates, their covariance.
    between : float
        Standard error from the spread of the chains' separate estimates; NaN for a single chain.
    table : pandas.DataFrame
        For a mixture, one row per chain with its ``log_evidence``. For tempering, one row per rung:
        ``inverse_temperature``; ``mean`` and ``sd`` of the log-likelihood at this rung (of draws at which the
        model did not fail), its ``rhat`` and the ``ess`` of its mean (NaN if the model failed at a draw);
        ``rejection``, the rejection rate of swaps with the next rung; and ``log_ratio``, the logarithm of the
        evidence at the next rung over that at this one. The last two are NaN at the last rung.
    pareto_k : float
        Pareto shape parameter of the candidates' weights; NaN for tempering.
    doubts : tuple of str
        For a mixture, warnings about regions that the estimate may miss, because the mixture covers only what its
        chains visited. Empty for tempering.
    """

    log_evidence: float
    error: float
    method: str
    within: float
    between: float
    table: pd.DataFrame
    pareto_k: float = np.nan
    doubts: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons why the estimate is unreliable, one sentence each: missed regions, disagreement, heavy tails.

        Empty if there are none.
        """
        if self.method in OF_MIXTURE:
            tail = heavy_tail_in_words(self.pareto_k)
            return (*self.doubts, f"{tail}, and the error is underestimated") if tail else self.doubts
        rhat = self.table["rhat"].to_numpy()[1:]  # draws from the prior are independent
        if np.all(rhat < RHAT_LIMIT):
            return ()
        if not np.any(np.isfinite(rhat)):
            return ("R-hat of the log-likelihood is unknown: it needs several chains that move",)
        worst = 1 + int(np.argmax(np.nan_to_num(rhat, nan=np.inf)))
        t = self.table["inverse_temperature"][worst]
        return (
            f"R-hat {apart(rhat[worst - 1], RHAT_LIMIT, digits=3)[0]} of the log-likelihood at rung {worst}, t = "
            f"{significant(t, 2)}, is not below {given(RHAT_LIMIT)}: the chains do not agree there, and the "
            f"error is underestimated",
        )

    def __str__(self) -> str:
        within, between = (significant(error, 2) for error in (self.within, self.between))
        rows = "chains" if self.method in OF_MIXTURE else "rungs"
        of_what = " of the visited places alone" if self.doubts else ""
        line = (
            f"log-evidence {with_sd(self.log_evidence, self.error)}{of_what} "
            f"({self.method}, {len(self.table)} {rows}; standard error within chains {within}, between {between})"
        )
        return "\n".join([line, *(f"  - {warning}" for warning in self.warnings)])

    def _repr_html_(self) -> str:
        lines = "<br>".join(html.escape(line) for line in str(self).splitlines())
        return f"<p>{lines}</p>{self.table.to_html(float_format=partial(significant, digits=4))}"


@check_arguments
def evidence(trace: xr.DataTree, method: str | None = None) -> Evidence:
    """Estimate the evidence from a run of parallel tempering, or of a sampler with mixture candidates.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace of `fmu.sample(problem, "tempering")`, of `fmu.sample(problem, "mixture")`, or of a sampler with
        ``jumps=True``.
    method : {"stepping-stone", "thermodynamic", "importance", "bridge"}, optional
        For tempering, the default "stepping-stone" is the product of the evidence ratios from rung to rung, each
        averaged over the lower rung (Xie et al. 2011). "thermodynamic" is the integral of the mean log-likelihood
        over the inverse temperature, by the trapezium rule with its second-order correction (Friel, Hurn & Wyse
        2014); the standard error does not include the error of this rule. For a mixture, the default "importance"
        is the mean of the candidates' weights P/Q, where P is the unnormalised posterior density and Q the density
        of the candidates. "bridge" is the optimal bridge between candidates and draws (Meng & Wong 1996).

    Returns
    -------
    Evidence

    Raises
    ------
    ValueError
        If the method is unknown, if `trace` is no trace or has only a pseudo-likelihood (modal residual), or if it
        lacks the rungs or the 100 candidates with finite log-weights that the method needs.

    References
    ----------
    Xie, Lewis, Fan, Kuo & Chen (2011), Systematic Biology 60, 150-160; Friel & Pettitt (2008), JRSS B 70, 589-607;
    Friel, Hurn & Wyse (2014), Statistics and Computing 24, 709-723; Meng & Wong (1996), Statistica Sinica 6,
    831-860; Frühwirth-Schnatter (2004), Econometrics Journal 7, 143-167.
    """
    if method is not None and method not in (*METHODS, *OF_MIXTURE):
        raise ValueError(f"method: must be one of {', '.join((*METHODS, *OF_MIXTURE))} (got {method!r})")
    if is_pseudo(trace):
        raise ArgumentError("trace", "the modal residual is a pseudo-likelihood, and has no evidence")
    if has_candidates(trace) and method not in METHODS:
        return _of_mixture(trace, method or OF_MIXTURE[0])
    if not has(trace, GROUP) or method in OF_MIXTURE:
        check_trace(trace)
        n = _n_candidates(trace)
        if method not in METHODS and n is not None:
            raise ValueError(
                f"trace: must have {FEWEST_CANDIDATES} mixture candidates with finite log-weights (got {n}): draw "
                "more, or estimate the evidence with fmu.sample(problem, 'tempering')"
            )
        raise ValueError(
            "trace: must come from fmu.sample(problem, 'tempering') or fmu.sample(problem, 'mixture') (got "
            f"{trace.attrs['sampler']}, method {method!r})"
        )
    method = method or METHODS[0]
    draws = array_of(trace, GROUP, "log_likelihood")
    t = trace[GROUP]["inverse_temperature"].to_numpy()
    estimate = {"stepping-stone": stepping_stone, "thermodynamic": thermodynamic}[method]
    whole = estimate(draws, t)
    within = effective.mcse_mean(whole.influence)
    between, error = _errors(within, [estimate(chain[None], t).value for chain in draws])
    return Evidence(whole.value, error, method, within, between, _rung_table(draws, t))


def has_candidates(trace: xr.DataTree) -> bool:
    """Return True if a trace has at least `FEWEST_CANDIDATES` mixture candidates with finite log-weights."""
    return (_n_candidates(trace) or 0) >= FEWEST_CANDIDATES


def _n_candidates(trace: xr.DataTree) -> int | None:
    """Return the number of mixture candidates with finite log-weights, or None if the sampler proposed none."""
    if not has(trace, "sample_stats") or CANDIDATE not in trace["sample_stats"]:
        return None
    return int(np.sum(np.isfinite(array_of(trace, "sample_stats", CANDIDATE))))


def _of_mixture(trace: xr.DataTree, method: str) -> Evidence:
    """Estimate the evidence from the log-weights log P − log q of the candidates and of the draws.

    Candidates whose log-weight is not finite count with weight zero.
    """
    of_candidates, of_draws = (array_of(trace, "sample_stats", name) for name in (CANDIDATE, LOG_WEIGHT))
    jumped = ~np.isnan(of_candidates[0])  # all chains jump at the same steps
    candidates = np.where(jumped, np.where(np.isfinite(of_candidates), of_candidates, -np.inf), np.nan)
    ratio = min(1.0, effective.ess_bulk(of_draws) / of_draws.size)

    def estimate(q: FloatArray, p: FloatArray) -> tuple[float, float]:
        return by_importance(q[:, jumped].ravel()) if method == "importance" else by_bridge(q, p, ratio)

    value, within = estimate(candidates, of_draws)
    alone = [estimate(q[None], p[None])[0] for q, p in zip(candidates, of_draws, strict=True)]
    between, error = _errors(within, alone)
    table = data_frame({"log_evidence": alone}, "chain", range(len(alone)))
    shape = pareto_k(candidates[np.isfinite(candidates)])
    return Evidence(value, error, method, within, between, table, shape, _places_left_out(trace))


def _places_left_out(trace: xr.DataTree) -> tuple[str, ...]:
    """Return warnings about regions that the candidates may miss, judged by any maxima stored in the trace."""
    from fmu.analysis.convergence.diagnosis import doubts_of_search, maxima_of
    from fmu.analysis.maxima.missed import compare_shares

    known = maxima_of(trace)
    missed = [] if known is None else compare_shares(trace, known).reasons
    return (*missed[:1], *doubts_of_search(trace, known))


def _errors(within: float, alone: Sequence[float]) -> tuple[float, float]:
    """Return the standard error from the spread of the chains' estimates, and the larger of it and `within`.

    The first value is NaN for a single chain; the second is then `within`.
    """
    between = float(np.std(alone, ddof=1) / np.sqrt(len(alone))) if len(alone) > 1 else np.nan
    return between, float(np.fmax(within, between))


def _rung_table(draws: FloatArray, t: FloatArray) -> pd.DataFrame:
    """Return the table of `Evidence` for tempering, one row per rung.

    The last rung has no next one, so its rejection rate and evidence ratio are NaN.
    """
    finite = np.where(np.isfinite(draws), draws, np.nan)
    return data_frame(
        {
            "inverse_temperature": t,
            "mean": np.nanmean(finite, axis=(0, 1)),
            "sd": np.nanstd(finite, axis=(0, 1)),
            "rhat": [effective.rhat(x) for x in np.moveaxis(draws, 2, 0)],
            "ess": [effective.ess_mean(x) for x in np.moveaxis(draws, 2, 0)],
            "rejection": np.append(rejections(draws, t).mean(axis=0), np.nan),
            "log_ratio": np.append(stones(draws, t)[1], np.nan),
        },
        "rung",
        range(len(t)),
    )


_APART = 4.0
PSEUDO = "the modal residual is a pseudo-likelihood and has no evidence"
WHAT = (
    "The evidence is the probability density of the data under the model and its prior. Of several models "
    "with the same measured data and errors of the same kind, the one with the largest evidence is the most "
    "probable."
)


@dataclass(frozen=True)
class FoundEvidence:
    """A log-evidence and how it was estimated.

    Attributes
    ----------
    log_evidence, error : float
        Natural logarithm of the evidence, and its standard error; NaN if unknown.
    method : str
        The method in words: ``"importance sampling at the maximum"``.
    doubts : tuple of str
        Reasons why the estimate is unreliable, each a clause; empty if it is reliable.
    """

    log_evidence: float
    error: float
    method: str
    doubts: tuple[str, ...]

    @property
    def value(self) -> str:
        """The log-evidence with its standard error, as text."""
        return with_sd(self.log_evidence, self.error)

    @property
    def is_reliable(self) -> str:
        """``"reliable"``, or ``"not reliable: "`` followed by the reasons."""
        return f"not reliable: {'; '.join(self.doubts)}" if self.doubts else "reliable"

    def __str__(self) -> str:
        return f"log evidence {self.value} ({self.method}, {self.is_reliable})"


def found_evidences(
    traces: Mapping[str, xr.DataTree], verdicts: Mapping[str, Diagnosis], maxima: Maxima | None
) -> list[FoundEvidence]:
    """Return the evidence estimates from parallel tempering, from mixture candidates and from the maxima's masses.

    Parameters
    ----------
    traces : mapping of str to xarray.DataTree
        Traces of one problem, keyed by sampler.
    verdicts : mapping of str to Diagnosis
        Verdict on each trace, keyed by sampler.
    maxima : Maxima or None

    Returns
    -------
    list of FoundEvidence
        Empty if the likelihood is a pseudo-likelihood or no estimate is available. An estimate that disagrees with
        a reliable one is marked as unreliable.
    """
    if any(is_pseudo(trace) for trace in traces.values()):
        return []
    found = [
        _of_run(name, trace, verdicts[name], METHODS[0]) for name, trace in traces.items() if has(trace, GROUP)
    ]
    for name, trace in traces.items():
        if has_candidates(trace):
            found += [_of_run(name, trace, verdicts[name], method) for method in OF_MIXTURE]
    if maxima is not None:
        reached = max(float(array_of(trace, "sample_stats", "lp").max()) for trace in traces.values())
        found.append(_of_maxima(maxima, reached))
    return _compare_evidences(found)


def _of_run(name: str, trace: xr.DataTree, verdict: Diagnosis, method: str) -> FoundEvidence:
    found = evidence(trace, method)
    words = {
        "stepping-stone": f"parallel tempering over {len(found.table)} rungs"
        + ("" if name == "tempering" else f" of {name}"),
        "importance": f"importance sampling with the proposal of {name}",
        "bridge": f"bridge sampling with the proposal of {name}",
    }
    unfinished = method != "importance" and not verdict.converged
    doubts = (*found.warnings, *["the run has not converged"] * unfinished)
    return FoundEvidence(found.log_evidence, found.error, words[method], doubts)


def _of_maxima(maxima: Maxima, reached: float) -> FoundEvidence:
    """Estimate the evidence as the total mass of the maxima, with reasons why it may be unreliable.

    `reached` is the largest log-probability of any draw.
    """
    fewest = maxima.effective_draws
    at = "at the maximum" if len(maxima) == 1 else f"at {len(maxima)} maxima"
    doubts = []
    if fewest == 0.0:
        method = f"Laplace approximation {at}"
        doubts.append("the posterior may not be Gaussian around them, and no draws have checked it")
    else:
        method = f"importance sampling {at}"
        if fewest < RELIABLE:
            doubts.append(
                f"at one of them it has {significant(fewest, 2)} effective draws; {significant(RELIABLE)} are "
                f"needed"
            )
    if reached > max(m.log_prob for m in maxima) + 1e-3:
        doubts.append("a draw lies above all maxima, so one was missed")
    return FoundEvidence(maxima.log_evidence, maxima.log_evidence_error, method, tuple(doubts))


def _compare_evidences(found: list[FoundEvidence]) -> list[FoundEvidence]:
    """Return the estimates, each with a doubt for every reliable one that is over four standard errors away."""
    reliable = [one for one in found if not one.doubts]
    compared = []
    for one in found:
        doubts = [
            f"it disagrees with {other.value} from {other.method}"
            for other in reliable
            if other is not one
            and not abs(one.log_evidence - other.log_evidence) <= _APART * np.hypot(one.error, other.error)
        ]
        compared.append(replace(one, doubts=(*one.doubts, *doubts)))
    return compared
