"""Predict each measured mode from the other modes, by importance weighting or by updating without the mode."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from scipy.special import logsumexp

from fmu.analysis.convergence.effective import mcse_mean
from fmu.analysis.convergence.pareto import GOOD_K, pareto_k
from fmu.analysis.held_out.own_run import draws_without, is_in_funnel, seconds_of_a_solve
from fmu.analysis.held_out.prediction import NEITHER, Draws, HeldOut, with_mode
from fmu.analysis.held_out.refit import (
    ACCEPTED,
    MOST_SOLVES,
    SOLVES,
    Approximation,
    LeftOut,
    approximation,
    left_out,
    log_prob_of_all,
)
from fmu.analysis.held_out.together import left_out_together
from fmu.analysis.held_out.weights import SMOOTHED_K, Smoothed, smooth_weights
from fmu.analysis.held_out.without_scores import leave_out_by_tests
from fmu.analysis.start.prior_prediction import DRAWS, prior_prediction
from fmu.analysis.trace.provenance import check_problem
from fmu.analysis.trace.reading import (
    array_of,
    check_trace,
    has,
    is_pseudo,
    parameter_draws,
    walkers_of,
    with_group,
)
from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import names_in_words
from fmu.posterior.discrepancy.draws import at_distinct_rows
from fmu.progress.phases import phase
from fmu.tables import data_frame
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem

GROUP = "leave_one_out"
"""Name of the trace group that stores the table."""
REFIT, WEIGHTS, NOT_USED = "refit", "importance weights", "not used in updating"
_ENOUGH, _SHARE, _FREE_S = 400, 0.5, 5.0
_A_REFIT, _REFITS = 0.5, 3.0
"""Longest time to refit one mode with unreliable weights, and all of these modes, as multiples of `_FREE_S`."""
_SEED = 1
_BEFORE_A_RUN = 24_000
"""Largest number of solves of a refit that a separate run can replace if it is unreliable."""


@check_arguments
def leave_one_out(trace: xr.DataTree, problem: UpdatingProblem | None = None) -> pd.DataFrame:
    """Compare each measured mode with its prediction from the other modes.

    A mode used in updating is predicted by the posterior without this mode, and any other mode by the posterior
    itself. The posterior without mode k comes from updating without it (`fmu.analysis.held_out.refit`). Its elpd
    is log p(y_k | y_-k) = log Z - log Z_-k, with the evidences Z with the mode and Z_-k without it. `fmu.sample`
    stores the table in the trace, unless the posterior is hierarchical. It updates without modes if there are 400
    or more draws, the model has derivatives, and half the solves of the draws or about five seconds suffice.
    Otherwise it reweights the draws (PSIS, Vehtari, Gelman & Gabry 2017), if the Pareto k of the weights is low.

    Parameters
    ----------
    trace : xarray.DataTree
    problem : UpdatingProblem, optional
        The problem that was sampled. If given, the table is computed again, however long this takes, and a mode
        without a reliable prediction from importance sampling is predicted by a separate run. Without a problem,
        the stored table is returned; for a trace without a table, only ``elpd``, its error and ``pareto_k`` are
        computed. A hierarchical posterior, which has parameters for every test, is never refitted: its draws are
        reweighted, with the scores of the mode's test integrated out (`fmu.analysis.held_out.without_scores`).

    Returns
    -------
    pandas.DataFrame
        One row per measured mode:

        - ``measured``: the measured frequency, Hz;
        - ``mean``, ``sd``, ``eti90_lb``, ``eti90_ub``: mean, standard deviation and 90 % interval ends of the
          measurement predicted from the other modes, noise included, Hz. For ``sd``, a Student's t error, whose
          variance may be infinite, is replaced by a Gaussian error with the same central 95 % interval;
        - ``p``: two-sided tail probability of the measured frequency in this prediction;
        - ``freedom``: degrees of freedom of `fmu.StudentErrors`, or of the error of a mean of repeated tests (if
          inferred, their harmonic mean over the draws); infinite for Gaussian errors, or if not computed;
        - ``prior_sd``: standard deviation of the measurement predicted from the prior, Hz; NaN if not computed;
        - ``elpd``, ``mcse_elpd``: log-density of the measured mode given the other modes, and its standard error;
        - ``pareto_k``: Pareto shape parameter of the weights;
        - ``method``: ``"refit"``, ``"importance weights"``, ``"not used in updating"``, or empty. It is empty,
          and the predictions are NaN, if the draws do not cover the posterior without the mode and there was no
          reliable refit;
        - ``used``: whether the mode was used in updating.

    Raises
    ------
    ValueError
        If `trace` is no trace, or has no log-likelihood of modes or only a pseudo-likelihood (modal residual); or
        if `problem` is not the posterior that was sampled.
    """
    check_trace(trace)
    if not has(trace, "log_likelihood"):
        raise ArgumentError("trace", "must have the log-likelihood of the modes (it has no group log_likelihood)")
    if is_pseudo(trace):
        raise ArgumentError("trace", "the modal residual is a pseudo-likelihood, and predicts no measurement")
    check_problem(problem, trace)
    if problem is not None:
        trace = with_left_out(trace, problem, most=np.inf)
    table = kept_table(trace)
    return _by_draws_alone(trace) if table is None else table


def kept_table(trace: xr.DataTree) -> pd.DataFrame | None:
    """Return the `leave_one_out` table stored in a trace, or None if the trace has no table."""
    if not has(trace, GROUP):
        return None
    kept = trace[GROUP]
    return data_frame({name: kept[name].to_numpy() for name in HeldOut._fields}, "mode", kept["mode"].to_numpy())


def with_left_out(trace: xr.DataTree, problem: UpdatingProblem, most: float | None = None) -> xr.DataTree:
    """Return the trace with the `leave_one_out` table added, or unchanged if no mode can be left out.

    Parameters
    ----------
    trace : xarray.DataTree
    problem : UpdatingProblem
        The problem that was sampled.
    most : float, optional
        Approximate limit on the solves for updating without modes. For 400 or more draws of a model with
        derivatives, it defaults to half the solves of the draws or the number that takes five seconds, whichever
        is larger. If a refit takes at most 2.5 seconds, this default also allows 15 more seconds of refits of
        modes with unreliable weights. In other cases the default is 0. With ``inf``, every mode whose refit is
        unreliable gets a separate run. A hierarchical posterior has too many parameters for refits. Instead, the
        scores are integrated out, and `most`, by default half the solves of the draws, limits the solves for this.
    """
    import xarray as xr

    if not problem.likelihood.of_modes or problem.data.n_modes < 2 or not any(problem.data.use):
        return trace
    theta = parameter_draws(trace).reshape(-1, problem.ndim)
    hz = array_of(trace, "posterior_predictive", "model_frequency").reshape(len(theta), -1)
    draws = Draws(problem, theta, hz)
    a_solve, by_tests = 0.0, dict[int, HeldOut]()
    if problem.is_hierarchical:
        most = _SHARE * int(trace.attrs["n_solves"]) if most is None else most
        weighted = leave_out_by_tests(problem, parameter_draws(trace), walkers_of(trace), _generator(0), most)
        by_tests, most = {k: _predict_weighted(k, *one) for k, one in weighted.items()}, 0.0
    if most is None:
        enough = int(trace.attrs["draws"]) * trace["posterior"].sizes["chain"] >= _ENOUGH
        is_cheap = enough and problem.solves_per_gradient == 1
        share = _SHARE * int(trace.attrs["n_solves"])
        a_solve = seconds_of_a_solve(problem, theta) if is_cheap else np.inf
        most = max(_FREE_S / a_solve, share) if is_cheap else 0.0
    prior_sd = np.full(problem.data.n_modes, np.nan)
    if most >= DRAWS:
        prior_sd = prior_prediction(problem).sd

    use, measured = problem.data.use, np.asarray(problem.data.frequencies_hz)
    found = {k: _not_used(trace, problem, k, draws) for k, used in enumerate(use) if not used}
    doubtful = [k for k, row in found.items() if not row.mcse_elpd <= ACCEPTED]
    if sum(use) > 1:  # without the only used mode there are no data
        doubtful = sorted(doubtful + [k for k, used in enumerate(use) if used])
    found |= by_tests | _left_out_all(problem, doubtful, most / (len(doubtful) + 1))
    if most == np.inf:
        found |= _by_runs_of_their_own(problem, [k for k in doubtful if use[k] and k not in found], theta)
    # weights with a Pareto k of 0.4 were wrong by 0.4 nats: used only if a refit takes too long
    smoothed = smooth_weights(trace) if len(found) < len(use) else {}
    good = {label for label, one in smoothed.items() if one.is_good}
    poor = [k for k in doubtful if k not in found and problem.data.labels[k] not in good]
    if SOLVES * a_solve <= _A_REFIT * _FREE_S and a_solve > 0.0:
        found |= _left_out_all(problem, poor[: int(_REFITS * _FREE_S / (SOLVES * a_solve))], SOLVES)
    rows = []
    for k, label in enumerate(problem.data.labels):
        row = found[k] if k in found else _predict_weighted(k, draws, smoothed.get(label))
        rows.append(row._replace(measured=float(measured[k]), prior_sd=float(prior_sd[k]), used=use[k]))
    columns = {
        name: ("mode", np.array(x)) for name, x in zip(HeldOut._fields, zip(*rows, strict=True), strict=True)
    }
    return with_group(trace, GROUP, xr.Dataset(columns, coords={"mode": list(problem.data.labels)}))


@dataclass
class _Known:
    """Cached leave-one-out results for a problem.

    Attributes
    ----------
    rows : dict of int to (int, HeldOut)
        The limit on solves and the prediction obtained with it, keyed by mode index.
    approximation : Approximation or None
        Gaussians that approximate the posterior with all modes; None until they are first needed.
    is_gaussian : bool
        False if the common candidates did not cover the posterior with all modes. Separate Gaussian candidates for
        each mode are then not tried if a run can replace them.
    """

    rows: dict[int, tuple[int, HeldOut]] = field(default_factory=dict)
    approximation: Approximation | None = None
    is_gaussian: bool = True


_KNOWN: WeakKeyDictionary[UpdatingProblem, _Known] = WeakKeyDictionary()


def _known_of(problem: UpdatingProblem) -> _Known:
    return _KNOWN.setdefault(problem, _Known())


def _left_out_all(problem: UpdatingProblem, modes: Sequence[int], most: float) -> dict[int, HeldOut]:
    """Predict each mode from its leave-one-out posterior; return the reliable predictions, keyed by mode index.

    One set of candidates is first used for all modes, whatever `most` is. Each mode that these candidates do not
    cover well then gets up to `most` candidates of its own. The dict is empty if `most` is less than `SOLVES`, or
    if the posterior is a funnel, because Gaussians are poor candidates there. Results are cached with the problem
    and do not depend on the draws, so one computation serves all samplers.
    """
    found: dict[int, HeldOut] = {}
    if modes and most >= SOLVES and not is_in_funnel(problem):
        known = _known_of(problem).rows
        with phase("leaving modes out", len(modes)) as under_way:
            with suppress(np.linalg.LinAlgError):  # a missing number must not stop the run
                known |= _left_out_together(problem, [k for k in modes if problem.data.use[k] and k not in known])
            under_way.advance(sum(k in known for k in modes))
            own = MOST_SOLVES if most < np.inf else _BEFORE_A_RUN if _known_of(problem).is_gaussian else 0
            for k in modes:
                is_new = k not in known
                if is_new and own == 0:
                    continue
                with suppress(np.linalg.LinAlgError):
                    row = _left_out(problem, k, int(min(most, own)))
                    if row.method:
                        found[k] = row
                under_way.advance(int(is_new))
    return found


def _by_runs_of_their_own(problem: UpdatingProblem, modes: Sequence[int], near: FloatArray) -> dict[int, HeldOut]:
    """Predict each mode from separate draws of its leave-one-out posterior; return a dict keyed by mode index.

    Unreliable predictions are left out. `near` (n, ndim), SI units, contains draws from the posterior with all
    modes, from which walkers start (`draws_without`).
    """
    found = {}
    with phase("runs without a mode", len(modes)) as under_way:
        for k in modes:
            row = _by_own_run(problem, k, near)
            if row is not None:
                found[k] = row
            under_way.advance()
    return found


def _by_own_run(problem: UpdatingProblem, k: int, near: FloatArray) -> HeldOut | None:
    """Predict mode `k` from separate draws of its leave-one-out posterior; return None if they are unreliable."""
    other = _without(problem, k)
    found = draws_without(other, near, _SEED)
    if found is None:
        return None
    theta = found.reshape(-1, problem.ndim)
    solved = at_distinct_rows(lambda rows: (log_prob_of_all((other, problem), rows),), theta)[0]
    draws = Draws(problem, theta, solved[:, 2:])
    return _by_posterior(k, draws, solved[:, 1] - solved[:, 0], len(found))._replace(method=REFIT)


def left_out_warnings(trace: xr.DataTree) -> list[str]:
    """Return a list with a warning if some used modes have neither reliable weights nor a reliable refit."""
    table = kept_table(trace)
    if table is None:
        return []
    missing = list(map(str, table.index[(table["method"] == NEITHER) & table["used"].astype(bool)]))
    if not missing:
        return []
    few, are = (f"mode {missing[0]}", "is") if len(missing) == 1 else (f"modes {names_in_words(missing)}", "are")
    return [
        f"{few} of {len(table)} {are} not predicted by the others: the weights of the draws are not reliable, and "
        "updating without them takes long (Python: fmu.leave_one_out(trace, problem))"
    ]


def _predict_weighted(k: int, draws: Draws, smoothed: Smoothed | None) -> HeldOut:
    """Return the prediction of mode `k` from the importance-weighted draws.

    If the weights are unreliable, only `pareto_k` is known. If `smoothed` is None, nothing is known.
    """
    if smoothed is None:
        return HeldOut()
    if not smoothed.is_good:
        return HeldOut(pareto_k=smoothed.pareto_k)
    row = draws.predict(k, smoothed.log_weight)
    return row._replace(elpd=smoothed.elpd, mcse_elpd=smoothed.mcse, pareto_k=smoothed.pareto_k, method=WEIGHTS)


def _not_used(trace: xr.DataTree, problem: UpdatingProblem, k: int, draws: Draws) -> HeldOut:
    """Return the prediction of mode `k`, which was not used in updating, from the posterior draws."""
    log_p = _log_likelihood(with_mode(problem, k), draws) - _log_likelihood(problem, draws)
    row = _by_posterior(k, draws, log_p, trace["posterior"].sizes["chain"], walkers_of(trace))
    return row._replace(method=NOT_USED)


def _by_posterior(k: int, draws: Draws, log_p: FloatArray, chains: int, walkers: int = 1) -> HeldOut:
    """Predict mode `k` from unweighted draws of a posterior that does not use it.

    `log_p` (n,) is the mode's log-density at the draws. The elpd is NaN if the Pareto k of these densities is too
    large.
    """
    row = draws.predict(k, np.full(len(log_p), -np.log(len(log_p))))
    shape = pareto_k(log_p)
    if not shape <= SMOOTHED_K:
        return row._replace(pareto_k=shape)
    elpd = float(logsumexp(log_p)) - float(np.log(len(log_p)))
    mcse = mcse_mean(np.exp(log_p - elpd).reshape(chains, -1), walkers)
    return row._replace(elpd=elpd, mcse_elpd=mcse, pareto_k=shape)


def _left_out_together(problem: UpdatingProblem, modes: Sequence[int]) -> dict[int, tuple[int, HeldOut]]:
    """Predict several modes from their leave-one-out posteriors, using the same candidates for all of them.

    Return the limit on solves and the prediction, keyed by mode index. The dict lacks modes whose prediction or
    elpd is unreliable. It is empty if there are fewer than two modes or the pairing is soft.
    """
    if len(modes) < 2 or problem.model.is_soft:  # with a soft pairing every log-probability is a solve
        return {}
    found = left_out_together([_without(problem, k) for k in modes], problem, _generator(0))
    shared = {id(one.theta): Draws(problem, one.theta, one.hz) for one in found}  # many modes have the same draws
    rows = zip(modes, found, strict=True)
    _known_of(problem).is_gaussian = min(one.pareto_k[1] for one in found) <= GOOD_K
    return {
        k: (MOST_SOLVES, _row(shared[id(one.theta)], k, one)) for k, one in rows if one.predicts and one.is_known
    }


def _left_out(problem: UpdatingProblem, k: int, most: int) -> HeldOut:
    """Predict mode `k` by importance sampling with at most `most` draws; reuse a cached row if it suffices."""
    known = _known_of(problem)
    if k in known.rows and (known.rows[k][1].mcse_elpd <= ACCEPTED or known.rows[k][0] >= most):
        return known.rows[k][1]
    if known.approximation is None:
        known.approximation = approximation(problem, problem.start[None], _generator(0))
    of_problem = known.approximation
    used = problem.data.use[k]
    other = _without(problem, k) if used else with_mode(problem, k)
    near = problem.offset + problem.scale * np.array([model.position for model in of_problem.quadratics])
    rng = _generator(k + 1)
    without, whole = (other, problem) if used else (problem, other)
    of_both = [approximation(other, near, rng), of_problem]
    found = left_out(without, whole, of_both if used else of_both[::-1], rng, most)
    known.rows[k] = (most, _row(Draws(problem, found.theta, found.hz), k, found))
    return known.rows[k][1]


def _row(draws: Draws, k: int, found: LeftOut) -> HeldOut:
    """Return the table row of mode `k` from its leave-one-out posterior, with NaN for unreliable numbers."""
    used = draws.problem.data.use[k]
    row = HeldOut(pareto_k=float(found.pareto_k.max()), used=used)
    if found.predicts:
        method = REFIT if used else NOT_USED
        row = draws.predict(k, found.log_weights[0])._replace(pareto_k=row.pareto_k, method=method, used=used)
        if found.is_known:
            row = row._replace(elpd=found.elpd, mcse_elpd=found.error)
    return row


def _without(problem: UpdatingProblem, k: int) -> UpdatingProblem:
    use = zip(problem.data.labels, problem.data.use, strict=True)
    return problem.using([label for i, (label, used) in enumerate(use) if used and i != k])


def _log_likelihood(problem: UpdatingProblem, draws: Draws) -> FloatArray:
    """Return the log-likelihood at the draws, (n,), without new solves if it depends on the frequencies alone."""
    return np.asarray(problem.terms_of_frequencies(draws.theta, draws.hz).sum(axis=1))


def _generator(stream: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(_SEED, spawn_key=(stream,)))


def _by_draws_alone(trace: xr.DataTree) -> pd.DataFrame:
    """Return the `leave_one_out` table computed only from the log-likelihoods stored in a trace."""
    smoothed = smooth_weights(trace)
    measured = trace["observed_data"]["frequency"].to_numpy()
    rows = []
    for k, label in enumerate(trace["observed_data"]["mode"].to_numpy()):
        row, found = HeldOut(float(measured[k])), smoothed.get(str(label))
        if found is not None:
            row = row._replace(pareto_k=found.pareto_k)
            if found.is_good:
                row = row._replace(elpd=found.elpd, mcse_elpd=found.mcse, method=WEIGHTS)
        rows.append(row._replace(used=label in trace["log_likelihood"]["mode"].to_numpy()))
    columns = dict(zip(HeldOut._fields, zip(*rows, strict=True), strict=True))
    return data_frame(columns, "mode", trace["observed_data"]["mode"].to_numpy())
