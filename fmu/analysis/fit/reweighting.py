"""Estimate, from a run without discrepancy, how much parameters scatter and how this widens their posterior."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import logsumexp

from fmu.analysis.convergence.pareto import GOOD_K, smoothed_weights
from fmu.analysis.trace.misfit import GROUP, has_scores
from fmu.analysis.trace.modal_states import MAXIMUM
from fmu.analysis.trace.reading import array_of, columns_of, has, parameter_draws, parameter_names
from fmu.numbers import significant
from fmu.samplers.mixture.importance import effective_size
from fmu.types import FloatArray

if TYPE_CHECKING:
    import xarray as xr

PRIOR_SD = 0.1
"""Standard deviation of the half-normal prior of τ: the default of `fmu.Discrepancy`."""
_EQUAL = 1e-6
"""Ratio of the draws' standard deviation to the linear model's below which the draws count as equal."""
_FEWEST = 100.0
"""Smallest ESS for an estimate."""
TAU = np.linspace(0.0, 5.0 * PRIOR_SD, 201)[1:]
"""Values of the scatter at which densities are computed, shape (n_tau,)."""


class Estimate(NamedTuple):
    """The scatter that a model with discrepancy would have, and its effect on the parameters.

    Attributes
    ----------
    by_tau : ndarray, shape (n_tau,)
        Posterior probability of each scatter τ in `TAU`.
    wider : ndarray, shape (ndim,) or (p,)
        Each parameter's standard deviation with scatter, divided by its standard deviation without scatter. The
        linearised model has only the p parameters of the trace group ``identifiability``.
    names : tuple of str
        The parameters of `wider`.
    """

    by_tau: FloatArray
    wider: FloatArray
    names: tuple[str, ...]

    @property
    def quantiles(self) -> tuple[float, float, float]:
        """5 %, 50 % and 95 % quantiles of τ."""
        below = np.cumsum(self.by_tau)
        low, middle, high = (float(np.interp(q, below, TAU)) for q in (0.05, 0.5, 0.95))
        return low, middle, high


def estimated_scatter(trace: xr.DataTree) -> str:
    """Return a sentence on the estimated scatter τ and how it widens the posterior; empty if it is unknown.

    The draws are reweighted (`by_draws`). If they do not cover the wider posterior with scatter, the sentence says
    so, and the estimate comes from the linearised model (`by_linearised_model`).
    """
    found, how = by_draws(trace), "By these draws, reweighted,"
    if found is None:
        found = by_linearised_model(trace)
        how = (
            "These draws cannot tell how large the scatter would be, as they do not cover the wider posterior. By "
            "the model linearised at its maximum, roughly,"
        )
    if found is None:
        return ""
    low, middle, high = (significant(100.0 * x, 2) for x in found.quantiles)
    least, most = (significant(float(x), 2) for x in (found.wider.min(), found.wider.max()))
    widest = found.names[int(np.argmax(found.wider))]
    times = f"{most} times as large" if len(found.wider) == 1 else f"{least} to {most} times as large"
    which = "" if len(found.wider) == 1 else f", that of {widest} the most"
    return (
        f"{how} it would be {middle} % (90 %: {low} to {high} %), and the standard deviations of the parameters "
        f"{times}{which}"
    )


def by_draws(trace: xr.DataTree) -> Estimate | None:
    """Estimate the scatter from the draws, importance-weighted by the ratio of densities with and without scatter.

    Let r_i be the residuals in standard deviations of the measurement, g_i = Σ_k (∂r_i/∂ln θ_k)² at the maximum,
    and p the half-normal prior of τ. The density ratio at a draw is then the integral of p(τ) Π_i (1 + τ²
    g_i)^(−1/2) exp(½ r_i² τ² g_i/(1 + τ² g_i)) over τ.

    Returns
    -------
    Estimate or None
        None if there are residuals of quantities other than frequencies, if tests were repeated, if the
        derivatives of the residuals at the maximum are unknown, or if the weights are unreliable (Pareto k, ESS).
    """
    linear = _linearise(trace)
    if linear is None:
        return None
    squares = array_of(trace, GROUP, "squares")[:, :, 0].reshape(-1, len(linear.g))
    log_w = _log_ratios(squares, linear.g)
    log_ratio = logsumexp(log_w, axis=1)
    try:
        weights, k = smoothed_weights(log_ratio)
    except ValueError:  # so many draws are equal that the weights have no tail
        return None
    if not (k <= GOOD_K and effective_size(weights) >= _FEWEST):
        return None
    by_tau = np.exp(logsumexp(log_w - log_ratio[:, None] + weights[:, None], axis=0))
    theta, w = parameter_draws(trace).reshape(len(squares), -1), np.exp(weights)
    wider = np.sqrt(w @ (theta - w @ theta) ** 2) / theta.std(axis=0)
    return Estimate(by_tau, wider, tuple(parameter_names(trace)))


def by_linearised_model(trace: xr.DataTree) -> Estimate | None:
    """Estimate the scatter from a model linearised at the maximum.

    The priors are taken as Gaussian. Let the parameters x, in prior standard deviations, have the prior N(x₀, I).
    Let the standardised residuals be r = r* + S (x − x*), where an asterisk marks values at the maximum. Then r* +
    S (x₀ − x*) ~ N(0, S Sᵀ + V) with V = diag(1 + τ² g), which gives the posterior of τ (see `by_draws` for g).
    The covariance of x is (I + Sᵀ V⁻¹ S)⁻¹ plus the spread of its means over τ. The bounds enter only through the
    moments of the prior. The standard deviations without scatter come from the draws or, if all draws are equal,
    from the linear model.

    Returns
    -------
    Estimate or None
        None if there are residuals of quantities other than frequencies, if tests were repeated, if the
        derivatives of the residuals at the maximum are unknown, or if the trace has no maxima or no prior draws.
    """
    linear = _linearise(trace)
    if linear is None or linear.expected is None:
        return None
    S, mu = linear.S, linear.expected
    log_p, spreads, means = [], [], []
    for tau in TAU:
        V = 1.0 + tau**2 * linear.g
        C = S @ S.T + np.diag(V)
        log_p.append(-0.5 * mu @ np.linalg.solve(C, mu) - 0.5 * np.linalg.slogdet(C)[1])
        covariance = np.linalg.inv(np.eye(S.shape[1]) + S.T / V @ S)
        spreads.append(np.diag(covariance))
        means.append(-covariance @ (S.T / V) @ mu)
    log_w = np.array(log_p) - 0.5 * (TAU / PRIOR_SD) ** 2
    w = np.exp(log_w - logsumexp(log_w))
    mean = w @ np.array(means)
    variance = w @ (np.array(spreads) + (np.array(means) - mean) ** 2)
    without = linear.prior_sd * np.sqrt(np.diag(np.linalg.inv(np.eye(S.shape[1]) + S.T @ S)))
    drawn = parameter_draws(trace).reshape(-1, len(parameter_names(trace))).std(axis=0)
    drawn = drawn[columns_of(trace, linear.names)]
    before = np.where(drawn > _EQUAL * without, drawn, without)
    return Estimate(w, np.sqrt(variance) * linear.prior_sd / before, linear.names)


class _Linearised(NamedTuple):
    """Model linearised at the maximum.

    Attributes
    ----------
    S : ndarray, shape (n_modes, p)
        Residual derivatives with respect to the parameters in prior standard deviations.
    prior_sd : ndarray, shape (p,)
    names : tuple of str
        The p parameters.
    g : ndarray, shape (n_modes,)
        See `by_draws`.
    expected : ndarray, shape (n_modes,), or None
        Linearised residuals at the prior mean; None if the trace stores no maxima or no prior draws.
    """

    S: FloatArray
    prior_sd: FloatArray
    names: tuple[str, ...]
    g: FloatArray
    expected: FloatArray | None


def _linearise(trace: xr.DataTree) -> _Linearised | None:
    """Linearise the model at the maximum.

    Return None if the derivatives at the maximum are unknown, if there are residuals of quantities other than
    frequencies, or if tests were repeated: the trace then stores squared normal scores, not squared residuals.
    """
    if has_scores(trace):
        return None
    if not has(trace, "identifiability") or list(trace[GROUP]["quantity"].to_numpy()) != ["frequencies"]:
        return None
    known, used = trace["identifiability"].to_dataset(), trace[GROUP]["mode"].to_numpy()
    labels = [str(label).removesuffix(", frequency") for label in known["mode"].to_numpy()]
    if MAXIMUM not in known["state"].to_numpy() or labels != used.tolist():
        return None
    at = known.sel(state=MAXIMUM)
    S, sd, theta = (at[name].to_numpy() for name in ("sensitivity", "prior_sd", "theta"))
    g = np.sum((S * theta / sd) ** 2, axis=1)
    names = tuple(str(name) for name in at["parameter"].to_numpy())
    if not has(trace, "maxima") or not has(trace, "prior"):
        return _Linearised(S, sd, names, g, None)
    maximum, measured = trace["maxima"].to_dataset(), trace["observed_data"]["frequency"].sel(mode=used).to_numpy()
    off = array_of(trace, "posterior_predictive", "model_frequency").reshape(
        -1, trace["observed_data"].sizes["mode"]
    )
    every = [str(mode) for mode in trace["observed_data"]["mode"].to_numpy()]
    off = off[:, [every.index(str(mode)) for mode in used]] - measured
    r = np.sqrt(array_of(trace, GROUP, "squares")[:, :, 0].reshape(off.shape))
    sigma = np.median(np.abs(off) / np.where(r > 0.0, r, np.nan), axis=0)
    best = maximum["frequencies"].isel(maximum=0).sel(mode=used).to_numpy()
    before = np.array([float(trace["prior"][name].mean()) for name in names])
    return _Linearised(S, sd, names, g, (best - measured) / sigma + S @ ((before - theta) / sd))


def _log_ratios(squares: FloatArray, g: FloatArray) -> FloatArray:
    """Return the log ratio of the likelihoods with and without scatter τ, plus the log prior of τ, (n, n_tau).

    The prior is the probability of the interval around τ, the density times the spacing of `TAU`. `squares` (n,
    n_modes) are squared residuals. Scatter multiplies the residuals' variances by 1 + τ² g.
    """
    inflation = TAU[:, None] ** 2 * g
    prior = -0.5 * (TAU / PRIOR_SD) ** 2 + np.log(np.sqrt(2.0 / np.pi) / PRIOR_SD * (TAU[1] - TAU[0]))
    gained = 0.5 * squares @ (inflation / (1.0 + inflation)).T
    return np.asarray(gained - 0.5 * np.log1p(inflation).sum(axis=1) + prior)
