"""Summarise a trace, and test whether a run has converged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence import effective
from fmu.analysis.convergence.candidates import candidates_of, has_curved_mixture
from fmu.analysis.convergence.effective import energy_fraction, longest_stands
from fmu.analysis.convergence.pareto import heavy_tail_in_words, pareto_k
from fmu.analysis.convergence.remedies import ESS_LIMIT as ESS_LIMIT
from fmu.analysis.convergence.remedies import (
    MCSE_LIMIT,
    MCSE_LIMIT_OF_ENDS,
    MCSE_OF_ENDS,
    MIN_AUTOCORRELATION_TIMES,
    RATIOS,
    RELIABLE_TIMES,
    RHAT_LIMIT_OF_SCORES,
    WALKER_RHAT_LIMIT,
    Places,
    for_chains_apart,
    for_divergences,
    for_too_few_draws,
    required_ess,
    without_scores,
)
from fmu.analysis.convergence.remedies import RHAT_LIMIT as RHAT_LIMIT
from fmu.analysis.trace.reading import (
    array_of,
    check_trace,
    has,
    is_imported,
    parameter_draws,
    parameter_names,
    parameter_units,
    score_names,
    walkers_of,
)
from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import apart, given, share, significant, whole
from fmu.samplers.mixture.kernel import CANDIDATE
from fmu.tables import data_frame
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


MIN_CHAINS = 2
MIN_ENSEMBLES = 4
DIVERGING_LIMIT = 1e-3
ENERGY_LIMIT = 0.3
_MOSTLY = 0.5
STANDING_LIMIT, STANDING_DRAWS = 0.2, 20
LEAST_GROWTH = 1.1


@check_arguments
def summary(trace: xr.DataTree, ci_prob: float = 0.9) -> pd.DataFrame:
    """Summarise the posterior and the accuracy of the estimates.

    Parameters
    ----------
    trace : xarray.DataTree
    ci_prob : float
        Probability inside the equal-tailed interval.

    Returns
    -------
    pandas.DataFrame
        One row per parameter, in SI units: ``mean``, ``sd``, the ends of the interval, named after its probability
        (``eti90_lb``, ``eti90_ub``), ``rhat`` (over ensembles for an ensemble sampler), ``ess_bulk``,
        ``ess_tail``, and the Monte-Carlo standard errors ``mcse_mean``, ``mcse_eti90_lb`` and ``mcse_eti90_ub``.
        R-hat is NaN for a single chain. R-hat, ESS and standard errors are NaN for a constant, a draw that is not
        finite, or fewer than four draws. Tail ESS and the standard error of an end are also NaN if no draw exceeds
        the quantile. Plain emcee (`fmu.from_emcee`) adds ``ess_emcee``, the number of draws divided by emcee's own
        autocorrelation time τ. In a run of N steps, τ is too short by about 10 τ²/N
        (`fmu.analysis.convergence.effective.autocorrelation_times`), and by far more if walkers stay in separate
        modes. ``attrs["units"]`` maps parameters to units; ``attrs["scores"]`` lists populations' test scores.

    Raises
    ------
    ValueError
        If `ci_prob` does not lie between 0 and 1, or `trace` is not a trace.
    """
    check_trace(trace)
    interval_columns(ci_prob)  # raises if the probability is invalid
    walkers = walkers_of(trace)
    names, draws = parameter_names(trace), parameter_draws(trace)
    rows = [_row(x, walkers, ci_prob) for x in np.moveaxis(draws, -1, 0)]
    table = data_frame(rows, "parameter", names)
    if has(trace, "emcee"):
        times = trace["emcee"]["autocorrelation_time"].to_numpy()
        table["ess_emcee"] = np.sum(draws.shape[1] / times, axis=0)
    table.attrs["units"] = dict(zip(names, parameter_units(trace), strict=True))
    table.attrs["scores"] = score_names(trace)
    return table


def summary_for_verdict(trace: xr.DataTree) -> pd.DataFrame:
    """Return the part of ``summary(trace)`` that the verdict needs.

    A population may have many test scores (each test's standardised deviation from the population mean). Only
    R-hat is computed for them; their other columns are NaN.
    """
    walkers, names, scores = walkers_of(trace), parameter_names(trace), score_names(trace)
    draws = np.moveaxis(parameter_draws(trace), -1, 0)
    are_scores = np.isin(names, scores)
    rows = [
        {"rhat": effective.rhat(x)} if is_score else _row(x, walkers, 0.9)
        for x, is_score in zip(draws, are_scores, strict=True)
    ]
    table = data_frame(rows, "parameter", names)
    table.attrs["scores"] = scores
    return table


def _row(x: FloatArray, walkers: int, ci_prob: float) -> dict[str, float]:
    """Return the `summary` row of one parameter, given its draws x of shape (chains, draws)."""
    lower, upper = interval_columns(ci_prob)
    of_ends = (1 - ci_prob) / 2, (1 + ci_prob) / 2
    ends = np.quantile(x, of_ends)
    errors = [effective.mcse_quantile(x, probability, walkers) for probability in of_ends]
    return {
        "mean": x.mean(),
        "sd": x.std(ddof=1),
        lower: ends[0],
        upper: ends[1],
        "rhat": effective.rhat(x),
        "ess_bulk": effective.ess_bulk(x, walkers),
        "ess_tail": effective.ess_tail(x, walkers),
        "mcse_mean": effective.mcse_mean(x, walkers),
        f"mcse_{lower}": errors[0],
        f"mcse_{upper}": errors[1],
    }


def interval_columns(ci_prob: float) -> tuple[str, str]:
    """Return the column names of an equal-tailed interval, such as ``eti90_lb`` and ``eti90_ub`` for 0.9.

    Raise ValueError unless `ci_prob` lies between 0 and 1.
    """
    if not 0 < ci_prob < 1:
        raise ArgumentError("ci_prob", "must lie between 0 and 1", repr(ci_prob))
    return f"eti{100 * ci_prob:g}_lb", f"eti{100 * ci_prob:g}_ub"


def rhat_over_walkers(trace: xr.DataTree) -> FloatArray:
    """Return R-hat over the walkers of the worst ensemble, for each parameter, shape (ndim,).

    This R-hat reveals walkers that stay in separate regions. R-hat over ensembles does not reveal them if all
    ensembles are divided in the same way. Ensembles are judged separately, because a single trapped walker would
    have too little weight among all walkers.

    For walkers that mix, R-hat depends only on the run's length: R-hat² − 1 is about 2.7/m for a run of m
    autocorrelation times. R-hat is therefore 1.07 for m = 20 and 1.03 for m = 50, and falls below 1.01, the limit
    for independent chains, only beyond m = 130. (Measured with 4 ensembles of 32 walkers and stretch moves, on
    Gaussian and bounded targets with 2 and 5 parameters.)
    """
    walkers = walkers_of(trace)
    draws = np.moveaxis(parameter_draws(trace), -1, 0)
    return np.array([np.max([effective.rhat(w) for w in effective.by_walker(x, walkers)]) for x in draws])


def autocorrelation_times_run(trace: xr.DataTree, part: float = 1.0) -> FloatArray:
    """Return the number of autocorrelation times that the first `part` of a run spans, shape (ndim,).

    `part` is a fraction. The slowest ensemble determines a parameter's time; NaN if an ensemble does not move.
    """
    walkers = walkers_of(trace)
    draws = np.moveaxis(parameter_draws(trace), -1, 0)
    steps = int(part * (draws.shape[2] // walkers))
    return np.array(
        [steps / np.max(effective.autocorrelation_times(x[:, : steps * walkers], walkers)) for x in draws]
    )


def walkers_stay_apart(trace: xr.DataTree, lengths: FloatArray) -> bool:
    """Return True if walkers stay in separate regions, so that more steps would not help.

    If walkers mix, a run spans about twice as many autocorrelation times as its first half (1.1 to 2.5 times as
    many in 140 runs). If they stay apart, the autocorrelation time grows with the run, and the slowest parameter's
    ratio is below 1.1. In runs shorter than 3 autocorrelation times the two cases cannot be distinguished.

    Parameters
    ----------
    trace : xarray.DataTree
    lengths : ndarray, shape (ndim,)
        `autocorrelation_times_run` of the whole run.
    """
    slowest = int(np.argmin(lengths))
    return bool(lengths[slowest] < LEAST_GROWTH * autocorrelation_times_run(trace, 0.5)[slowest])


def convergence_failures(
    trace: xr.DataTree, table: pd.DataFrame | None = None, places: Places = "unknown"
) -> list[str]:
    """Return the reasons why a run has not converged; an empty list if all tests pass.

    A run passes if:

    - it has at least two chains, and no chain stays at one point for a fifth of its draws and at least 20 draws;
    - R-hat of every parameter is below 1.01, and R-hat of the test scores in a population is below 1.05;
    - bulk and tail ESS of every parameter are at least 400, and at least 100 per chain (Vehtari et al. 2021);
    - the standard errors of the means are below 0.1 posterior sd, and those of the 90 % interval ends below 0.12;
    - every Hamiltonian chain's E-BFMI is at least 0.3, and at most one trajectory in a thousand diverges; the
      trajectories are not tested if most steps are candidates of a mixture;
    - a mixture had enough candidates for each of its components (`fmu.analysis.convergence.candidates`), and the
      weights of a curved mixture have no heavy tail.

    ESS and standard errors of test scores are not tested. For an ensemble sampler, each ensemble counts as a
    chain, and a run needs at least four ensembles, a length of at least 50 autocorrelation times, and an R-hat
    over walkers below 1.05. In a shorter run, R-hat over walkers is reported only if walkers stay in separate
    regions (`rhat_over_walkers`). Plain emcee (`fmu.from_emcee`) may have fewer ensembles. A single ensemble has
    no R-hat; the verdict then depends on the other tests, and `few_ensembles` states what they cannot exclude. A
    quantity that is NaN fails its test. Draws cannot show a mode that no chain visited; see `fmu.diagnose`.

    Parameters
    ----------
    trace : xarray.DataTree
    table : pandas.DataFrame, optional
        ``summary(trace)``, if already computed.
    places : {"unknown", "one", "missed"}
        What is known about the posterior's maxima: "unknown" if they are not known or several are important; "one"
        if a single maximum is important and was visited; "missed" if the run missed one, so that more draws would
        not help.

    Returns
    -------
    list of str
        One sentence for each failed test, on the worst parameter, the most serious first. If more draws would
        help, the first sentence on R-hat, ESS, standard errors, candidates or length also estimates how many are
        needed, or says how to make the chains agree (`fmu.analysis.convergence.remedies`).
    """
    check_trace(trace)
    if table is None:
        table = summary_for_verdict(trace)
    is_ensemble = walkers_of(trace) > 1
    chains = trace["posterior"].sizes["chain"]
    failures = []
    kind, needed = ("ensemble", MIN_ENSEMBLES) if is_ensemble else ("chain", MIN_CHAINS)
    if chains < needed and not few_ensembles(trace):
        failures.append(f"{chains} {kind}{'s' if chains > 1 else ''}; at least {needed} are needed: --chains 4")
    standing = _standing(trace)
    failures += standing
    every, table = table, without_scores(table)
    required, names = required_ess(chains), table.index
    short = []
    if chains > 1 or not few_ensembles(trace):
        why = "R-hat is {}; it must be below {}"
        short += _above(table["rhat"].to_numpy(), RHAT_LIMIT, names, why)
        if not short:
            short += _above(every["rhat"].to_numpy(), RHAT_LIMIT_OF_SCORES, every.index, why)
    for column, label in (("ess_bulk", "bulk ESS"), ("ess_tail", "tail ESS")):
        short += _below(table[column].to_numpy(), required, names, label + " is {}; at least {} are needed")
    mcse = (table["mcse_mean"] / table["sd"]).to_numpy()
    short += _above(mcse, MCSE_LIMIT, names, "MCSE over sd is {}; it must be below {}")
    for column, end in zip(MCSE_OF_ENDS, ("5", "95"), strict=True):
        of_end = (table[column] / table["sd"]).to_numpy()
        why = f"MCSE of the {end} % quantile over sd is {{}}; it must be below {{}}"
        short += _above(of_end, MCSE_LIMIT_OF_ENDS, names, why)
    short += _seldom_proposed(trace)
    lengths, are_apart = None, False
    if is_ensemble:
        lengths = autocorrelation_times_run(trace)
        too_short = _below(
            lengths,
            MIN_AUTOCORRELATION_TIMES,
            every.index,
            "the run is {} autocorrelation times long; {} are needed",
        )
        can_tell = places != "one" or float(np.min(lengths)) >= RELIABLE_TIMES
        are_apart = bool(too_short) and can_tell and walkers_stay_apart(trace, lengths)
        short = too_short + short
        if are_apart or not too_short:  # if walkers mix, R-hat would only repeat that the run is too short
            why = "R-hat over walkers is {}; it must be below {}: walkers stay in separate places"
            unmixed = _above(rhat_over_walkers(trace), WALKER_RHAT_LIMIT, every.index, why)
            are_apart |= bool(unmixed)
            short = unmixed + short
    if short and not standing and places != "missed" and not is_beyond_draws(trace):
        short[0] += for_too_few_draws(trace, every, required, lengths, are_apart, places)
    return failures + short + _heavy_weights(trace) + _trajectories(trace)


def few_ensembles(trace: xr.DataTree) -> str:
    """Return a warning if an imported emcee run has fewer than four ensembles, otherwise an empty string."""
    n = trace["posterior"].sizes["chain"]
    if not is_imported(trace) or n >= MIN_ENSEMBLES:
        return ""
    return (
        f"{'one ensemble' if n == 1 else f'{n} ensembles'}: separate modes cannot be excluded; run "
        f"{MIN_ENSEMBLES} ensembles from spread starts, such as problem.walkers(n, seed), and give fmu.from_emcee "
        "the list of them"
    )


def _seldom_proposed(trace: xr.DataTree) -> list[str]:
    """Return a list with a sentence if some mixture component had too few candidates, otherwise an empty list."""
    found = candidates_of(trace)
    if found is None or found.drawn >= found.needed:
        return []
    return [
        f"of {whole(found.drawn)} candidates, {significant(found.share * found.drawn, 2)} are expected at the "
        f"component with {share(found.share)} of the mixture, and all chains may have missed it; at least "
        f"{whole(found.needed)} candidates are needed"
    ]


def _standing(trace: xr.DataTree) -> list[str]:
    """Return a list with a sentence if a chain or walker stays put for a fifth of its steps and at least 20."""
    walkers = walkers_of(trace)
    stands = longest_stands(parameter_draws(trace), walkers)
    steps = trace["posterior"].sizes["draw"] // walkers
    chain, walker = (int(k) for k in np.unravel_index(np.argmax(stands), stands.shape))
    if stands[chain, walker] < max(STANDING_LIMIT * steps, STANDING_DRAWS):
        return []
    who = f"chain {chain}" if walkers == 1 else f"walker {walker} of ensemble {chain}"
    return [f"{who} does not move for {stands[chain, walker]} of its {steps} draws{for_chains_apart(trace)}"]


def _trajectories(trace: xr.DataTree) -> list[str]:
    """Return a sentence for each failed test of Hamiltonian trajectories: divergences, and E-BFMI."""
    failures = []
    diverging = _trajectories_that_diverged(trace)
    if not np.mean(diverging) <= DIVERGING_LIMIT:
        useless = ", and more draws do not help" if _diverges_for_good(trace) else ""
        said = f"{int(diverging.sum())} of {diverging.size} trajectories diverged{useless}"
        failures.append(said + for_divergences(trace))
    if has(trace, "sample_stats", "energy"):
        fraction = energy_fraction(array_of(trace, "sample_stats", "energy"))
        chains = [f"chain {k}" for k in range(len(fraction))]
        failures += _below(fraction, ENERGY_LIMIT, chains, "E-BFMI is {}; at least {} is needed")
    return failures


def _trajectories_that_diverged(trace: xr.DataTree) -> FloatArray:
    """Return a mask of the Hamiltonian trajectories that diverged, or a single 0 if no trajectories are tested.

    None are tested if the sampler has no trajectories, or if most steps are mixture candidates. Candidates are not
    in the mask: a diverged trajectory stays at its starting point, but a candidate does not depend on that point,
    and the candidates' weights show how well the mixture fits the posterior.
    """
    if not has(trace, "sample_stats", "diverging"):
        return np.zeros(1)
    diverging = array_of(trace, "sample_stats", "diverging")
    if not has(trace, "sample_stats", CANDIDATE):
        return diverging
    is_local = np.isnan(array_of(trace, "sample_stats", CANDIDATE))
    return diverging[is_local] if np.mean(is_local) >= _MOSTLY else np.zeros(1)


def _diverges_for_good(trace: xr.DataTree) -> bool:
    """Return True if more trajectories diverge than the limit allows, by more than two standard errors."""
    diverging = _trajectories_that_diverged(trace)
    n = float(diverging.sum())
    return n - 2.0 * np.sqrt(n) > DIVERGING_LIMIT * diverging.size


def _heavy_weights(trace: xr.DataTree) -> list[str]:
    """Return a list with a sentence if a curved mixture's candidate weights have a heavy tail, else an empty list.

    A curved mixture may be wrong in regions beyond the draws to which it was fitted. Chains then hardly reach
    these regions, and R-hat does not show it.
    """
    if not has_curved_mixture(trace):
        return []
    log_w = array_of(trace, "sample_stats", CANDIDATE)
    tail = heavy_tail_in_words(pareto_k(log_w[np.isfinite(log_w)]))
    return [f"{tail}, and more draws do not help{for_chains_apart(trace)}; or {RATIOS}"] if tail else []


def is_beyond_draws(trace: xr.DataTree) -> bool:
    """Return True if more draws cannot make a run converge, because of divergences or heavy-tailed weights."""
    return _diverges_for_good(trace) or bool(_heavy_weights(trace))


def _above(values: FloatArray, limit: float, names: Sequence[str] | pd.Index, sentence: str) -> list[str]:
    """Return a list with a sentence on the largest value unless all are below `limit`; NaN counts as above."""
    if np.all(values < limit):
        return []
    worst = int(np.argmax(values))  # the first NaN, if there is one
    return [f"{names[worst]}: {sentence.format(_beside(values[worst], limit), given(limit))}"]


def _below(values: FloatArray, limit: float, names: Sequence[str] | pd.Index, sentence: str) -> list[str]:
    """Return a list with a sentence on the smallest value if it is below `limit`; NaN counts as below."""
    if np.all(values >= limit):
        return []
    worst = int(np.argmin(values))
    return [f"{names[worst]}: {sentence.format(_beside(values[worst], limit), given(limit))}"]


def _beside(value: float, limit: float) -> str:
    """Format a value to three digits of the larger of it and `limit`, or more to tell them apart; NaN as "nan"."""
    return apart(value, limit, digits=3)[0] if np.isfinite(value) else str(value)
