"""Delayed acceptance: draw from the model's posterior by solving the model at draws of a surrogate."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.convergence.diagnosis import draws_missing, maxima_of, with_maxima
from fmu.analysis.convergence.remedies import ESS_LIMIT, required_ess
from fmu.analysis.held_out.modes import with_left_out
from fmu.analysis.identifiability import GROUP as IDENTIFIABILITY
from fmu.analysis.pairing_changes import with_pairing
from fmu.analysis.trace.conversion import to_trace
from fmu.analysis.trace.modal_states import with_modes
from fmu.analysis.trace.reading import has, with_group
from fmu.arguments import Count, check_arguments
from fmu.numbers import whole
from fmu.progress.phases import phase, solves
from fmu.samplers.settings import positive_number, whole_number
from fmu.surrogates.learning import certificate_of
from fmu.surrogates.second_stage import SecondStage

if TYPE_CHECKING:
    import xarray as xr

    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem

_MARGIN = 1.25
"""Number of proposals solved at first divided by the required ESS."""


@check_arguments
def delayed_acceptance(
    problem: UpdatingProblem,
    trace: xr.DataTree,
    *,
    until_ess: float = ESS_LIMIT,
    max_solves: Count | None = None,
    engine: Engine | None = None,
) -> xr.DataTree:
    """Return draws from the model's own posterior, made from draws from the posterior of its surrogate.

    In delayed acceptance (Christen & Fox 2005, *J. Comput. Graph. Stat.* 14, 795–810), the surrogate's chain is
    the first stage. Its draws θ′ are proposals, which the second stage accepts with probability

    min(1, w(θ′)/w(θ)),  w = p(θ)/p̂(θ),

    where θ is the present state, and p and p̂ are the posterior densities with the model and with the surrogate.
    If a solve fails, w = 0. A chain's proposals are the draws from one chain in the trace, thinned to at least two
    autocorrelation times. They are known before the first solve, so all workers can solve in parallel. An
    independence sampler (Tierney 1994, *Ann. Stat.* 22, 1701–1762) accepts or rejects the proposals in order. It
    starts at a proposal drawn with probability proportional to w, and needs no burn-in.

    The limiting distribution is p. An error of the surrogate does not change this; it only lowers the acceptance
    rate. The exception is a region where the surrogate's posterior has no mass, because nothing is proposed there.
    A finite run involves two approximations, both small compared with its Monte-Carlo error: proposals are thinned
    draws of a Markov chain, and the starting point is one of finitely many proposals.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with a surrogate, from `fmu.surrogate`.
    trace : xarray.DataTree
        The result of `fmu.sample` for this problem. The number of proposals is a quarter to a half of the trace's
        effective sample size (ESS). A trace with ``until_ess=2000`` has enough draws if the surrogate is good.
    until_ess : float
        Bulk and tail ESS that every parameter must reach, in addition to convergence. Values below the ESS that
        convergence requires have no effect. The number of proposals solved at first is 1.25 times the required
        ESS; more are solved if the ESS is then too small.
    max_solves : int, optional
        Largest number of proposals to solve, at least one per chain. Defaults to all proposals.
    engine : Engine, optional
        Calls the user's function at several theta in parallel; see `fmu.engine`. The draws do not depend on it.

    Returns
    -------
    xarray.DataTree
        A trace as returned by `fmu.sample` for the problem without a surrogate. A rejection repeats the previous
        draw, which ESS and R-hat take into account. The group ``identifiability`` is copied from the surrogate's
        trace, if it is there. In addition to the attributes of the surrogate (`fmu.analysis.certificate.certify`)
        there are: ``second_stage_proposals``, the number of solved proposals; ``second_stage_accepted`` and
        ``second_stage_failed``, the numbers of accepted and of failed proposals; ``second_stage_solves``, the
        number of distinct solves; ``after_n_solves``, the number of solves after the draws; and ``limit``, a
        phrase with the number of solves or draws that were available, if the run ended before it had converged and
        reached `until_ess`. ``warmup_n_solves`` is the number of solves for the surrogate, and ``warmup_wall_s``
        the time in seconds that it took to sample the surrogate's posterior.

    Raises
    ------
    ValueError
        If the problem has no surrogate, the trace does not belong to its posterior or has too few effective draws,
        a number is out of range, or all solves of a chain fail.
    """
    until_ess = positive_number("until_ess", until_ess)
    stage = SecondStage(problem, trace)
    chains, available = stage.theta.shape[:2]
    allowed = available
    if max_solves is not None:
        allowed = min(available, whole_number("max_solves", max_solves, chains) // chains)
    n = proposals(until_ess, chains) // chains
    workers = 1 if engine is None else engine.workers
    began, limit = time.perf_counter(), ""
    with stage.truth.model.spread_over(engine):
        with phase("delayed acceptance", chains * min(n, allowed)) as under_way:
            while True:
                stage.solve(min(n, allowed), workers, under_way)
                result = stage.result(time.perf_counter() - began)
                missing = draws_missing(to_trace(result, stage.truth, predictions=False), until_ess, None)
                if not missing:
                    break
                if n >= allowed:
                    what = "nearly independent draws of the surrogate" if allowed == available else "solves"
                    limit = f"{whole(chains * allowed)} {what}"
                    break
                under_way.expect(chains * (min(n + missing, allowed) - n))
                n += missing
        solved_before = solves()
        found = _with_model(to_trace(result, stage.truth), stage)
    certificate = certificate_of(problem)
    found.attrs |= {**certificate.attributes(), **stage.record(), "complete": 1}
    found.attrs |= {"warmup_n_solves": certificate.solves}
    found.attrs |= {"after_n_solves": solves() - solved_before} | ({"limit": limit} if limit else {})
    return found


def proposals(until_ess: float | None, chains: int) -> int:
    """Return the number of proposals to solve before convergence is first checked, summed over all chains."""
    return chains * int(np.ceil(_MARGIN * max(until_ess or 0.0, required_ess(chains)) / chains))


def _with_model(found: xr.DataTree, stage: SecondStage) -> xr.DataTree:
    """Return the trace with the groups that `fmu.sample` adds, if they take at most a few solves."""
    trace, truth = stage.trace, stage.truth
    known = maxima_of(trace)
    maxima = None if known is None else stage.maxima(known)
    if maxima is not None:
        found = with_maxima(found, maxima)
    found = with_pairing(with_modes(found, truth, maxima), truth)
    if has(trace, IDENTIFIABILITY):
        found = with_group(found, IDENTIFIABILITY, trace[IDENTIFIABILITY].to_dataset())
    return with_left_out(found, truth, most=0.0)
