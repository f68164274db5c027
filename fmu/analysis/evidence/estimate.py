"""The evidence of a problem, from what parallel tempering meets between prior and posterior."""

from __future__ import annotations

import html
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fmu.analysis.convergence import effective
from fmu.numbers import apart, given, significant, with_sd
from fmu.samplers.tempering.kernel import LOG_LIKELIHOOD
from fmu.samplers.tempering.ladder import first_ladder, rejections
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.samplers.loop.draws import RunResult


GROUP = "tempering"
"""Group of a trace that keeps what the rungs of a ladder saw."""
METHODS = ("stepping-stone", "thermodynamic")
RHAT_LIMIT = 1.05
"""R-hat of the log-likelihood at a rung, above which its chains disagree too much for an evidence."""


@dataclass(frozen=True)
class Evidence:
    """The logarithm of the evidence ∫ P(D|θ) P(θ) dθ.

    The likelihood is normalised as a density of the data, in Hz for measured frequencies, and the prior over the
    bounds: evidences of different models of the same data may be compared.

    Attributes
    ----------
    log_evidence : float
        Natural logarithm.
    error : float
        Its standard error, the larger of `within` and `between`. Nothing that the replicas have yet to find is in
        it: mind the `warnings`.
    method : {"stepping-stone", "thermodynamic"}
    within : float
        Standard error from the autocorrelation along the chains, all rungs together.
    between : float
        Standard error from the chains' own estimates, NaN for a single chain.
    table : pandas.DataFrame
        One row a rung: ``inverse_temperature``, ``mean`` and ``sd`` of the log-likelihood there (where the model
        did not fail), ``rhat`` of it and ``ess`` of its mean, ``rejection`` of swaps with the next rung, and
        ``log_ratio``, the logarithm of the evidence at the next rung over that at this one.
    """

    log_evidence: float
    error: float
    method: str
    within: float
    between: float
    table: pd.DataFrame

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the error is not to be relied on, one sentence each: rungs at which the chains do not agree."""
        rhat = self.table["rhat"].to_numpy()[1:]  # the prior is drawn from independently
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
        line = (
            f"log-evidence {with_sd(self.log_evidence, self.error)} "
            f"({self.method}, {len(self.table)} rungs; standard error within chains {within}, between {between})"
        )
        return "\n".join([line, *(f"  - {warning}" for warning in self.warnings)])

    def _repr_html_(self) -> str:
        lines = "<br>".join(html.escape(line) for line in str(self).splitlines())
        return f"<p>{lines}</p>{self.table.to_html(float_format=partial(significant, digits=4))}"


class _Estimate(NamedTuple):
    """An estimate from draws (chains, draws, rungs), and by how much each draw (chains, draws) moves it."""

    value: float
    influence: FloatArray


def evidence(trace: xr.DataTree, method: str = "stepping-stone") -> Evidence:
    """Estimate the evidence from a run of parallel tempering.

    Parameters
    ----------
    trace : xarray.DataTree
        Of `fmu.sample(problem, "tempering")` or with settings of `fmu.Tempering`.
    method : {"stepping-stone", "thermodynamic"}
        The product of the ratios of evidences from rung to rung, each an average over the lower one (Xie et al.
        2011); or the integral of the mean log-likelihood over the inverse temperature, by the trapezium rule with
        its second-order correction (Friel, Hurn & Wyse 2014), whose own error is not in the standard error.

    Returns
    -------
    Evidence

    Raises
    ------
    ValueError
        If the method is unknown, or the trace is not one of parallel tempering.

    References
    ----------
    Xie, Lewis, Fan, Kuo & Chen (2011), Systematic Biology 60, 150-160; Friel & Pettitt (2008), JRSS B 70, 589-607;
    Friel, Hurn & Wyse (2014), Statistics and Computing 24, 709-723.
    """
    if method not in METHODS:
        raise ValueError(f"method: must be one of {', '.join(METHODS)} (got {method!r})")
    if GROUP not in getattr(trace, "children", {}):
        raise ValueError("trace: must come from parallel tempering, fmu.sample(problem, 'tempering')")
    draws = trace[GROUP]["log_likelihood"].transpose("chain", "draw", "rung").to_numpy()
    t = trace[GROUP]["inverse_temperature"].to_numpy()
    estimate = {"stepping-stone": _stepping_stone, "thermodynamic": _thermodynamic}[method]
    whole = estimate(draws, t)
    alone = np.array([estimate(chain[None], t).value for chain in draws])
    within = effective.mcse_mean(whole.influence)
    between = float(np.std(alone, ddof=1) / np.sqrt(len(alone))) if len(alone) > 1 else np.nan
    error = float(np.fmax(within, between))
    return Evidence(whole.value, error, method, within, between, _table(draws, t))


def tempering_group(result: RunResult) -> xr.Dataset:
    """Return what the rungs saw in a run of parallel tempering.

    Returns
    -------
    xarray.Dataset
        ``log_likelihood`` (chain, draw, rung) from the prior to the posterior, and ``inverse_temperature`` and
        ``rejection`` (of swaps with the next rung) along ``rung``. Attributes: ``barrier``, Λ; ``round_trips`` of
        replicas from the posterior to the prior and back, and ``round_trip_rate``, a draw and chain;
        ``round_trip_limit``, (2 + 2Λ)⁻¹, which it has where replicas forget where they were in every step
        (Syed et al. 2022, section 3.4).
    """
    import xarray as xr

    draws = result.posterior.stats[LOG_LIKELIHOOD]
    given = result.learnt.get("temperatures") or result.settings["temperatures"]
    t = first_ladder(result.settings["rungs"]) if given is None else np.asarray(given)
    rejection = rejections(draws, t).mean(axis=0)
    barrier, trips = float(rejection.sum()), int(result.posterior.stats["round_trips"].sum())
    chains, steps, rungs = draws.shape
    return xr.Dataset(
        {
            "log_likelihood": (("chain", "draw", "rung"), draws),
            "inverse_temperature": ("rung", t),
            "rejection": ("rung", np.append(rejection, np.nan)),
        },
        coords={"chain": np.arange(chains), "draw": np.arange(steps), "rung": np.arange(rungs)},
        attrs={
            "barrier": barrier,
            "round_trips": trips,
            "round_trip_rate": trips / (chains * steps),
            "round_trip_limit": 1.0 / (2.0 + 2.0 * barrier),
        },
    )


def _stepping_stone(draws: FloatArray, t: FloatArray) -> _Estimate:
    """Return Σ_k log E_k[exp((t_{k+1} − t_k) l)]."""
    log_weight, log_ratio = _stones(draws, t)
    return _Estimate(float(log_ratio.sum()), np.sum(np.exp(log_weight - log_ratio) - 1.0, axis=2))


def _stones(draws: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (t_{k+1} − t_k) l and the logarithm of the mean of its exponential, (..., rungs − 1) each."""
    log_weight = np.diff(t) * draws[..., :-1]
    highest = log_weight.max(axis=(0, 1))
    return log_weight, highest + np.log(np.mean(np.exp(log_weight - highest), axis=(0, 1)))


def _thermodynamic(draws: FloatArray, t: FloatArray) -> _Estimate:
    """Return ∫ m dt, m and v being mean and variance of l at t.

    The rule Σ_k h_k (g_k + g_{k+1})/2 − h_k² (g'_{k+1} − g'_k)/12 is applied in s = log(t + a) instead of t, for m
    falls towards the prior as d/(2 (t + a)) where the likelihood is Gaussian in d dimensions: then g = m (t + a)
    is a straight line, with g' = v (t + a)² + m (t + a) because dm/dt = v. The a that fits is told by the first
    three rungs, which are equidistant in s. Where the model fails in a share of the prior, the logarithm of the
    other share adds to the integral, whose lower end is the mean over that.
    """
    known = np.isfinite(draws)
    share = known.mean(axis=(0, 1))
    curved = len(t) > 2 and t[2] > 2.0 * t[1]
    w = t + (min(1.0, t[1] ** 2 / (t[2] - 2.0 * t[1])) if curved else 1.0)
    h = np.diff(np.log(w))
    of_g = 0.5 * (np.append(h, 0.0) + np.append(0.0, h))
    of_slope = (np.append(h**2, 0.0) - np.append(0.0, h**2)) / 12.0
    of_mean, of_variance = w * (of_g + of_slope), w**2 * of_slope
    finite = np.where(known, draws, 0.0)
    mean = finite.mean(axis=(0, 1)) / share
    away = np.where(known, finite - mean, 0.0)
    variance = np.mean(away**2, axis=(0, 1)) / share
    value = mean @ of_mean + variance @ of_variance + np.sum(np.log(share))
    moved = away * of_mean + np.where(known, away**2 - variance, 0.0) * of_variance + known - share
    return _Estimate(float(value), moved @ (1.0 / share))


def _table(draws: FloatArray, t: FloatArray) -> pd.DataFrame:
    """Return the table of `Evidence`."""
    import pandas as pd

    finite = np.where(np.isfinite(draws), draws, np.nan)
    return pd.DataFrame(
        {
            "inverse_temperature": t,
            "mean": np.nanmean(finite, axis=(0, 1)),
            "sd": np.nanstd(finite, axis=(0, 1)),
            "rhat": [effective.rhat(x) for x in np.moveaxis(draws, 2, 0)],
            "ess": [effective.ess_mean(x) for x in np.moveaxis(draws, 2, 0)],
            "rejection": np.append(rejections(draws, t).mean(axis=0), np.nan),
            "log_ratio": np.append(_stones(draws, t)[1], np.nan),
        },
        index=pd.RangeIndex(len(t), name="rung"),
    )
