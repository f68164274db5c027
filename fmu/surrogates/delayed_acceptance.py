"""Delayed acceptance: draws from a surrogate's posterior become draws from the model's by a solve of each."""

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
"""Proposals that are solved first, over the effective draws that are wanted."""


@check_arguments
def delayed_acceptance(
    problem: UpdatingProblem,
    trace: xr.DataTree,
    *,
    until_ess: float = ESS_LIMIT,
    max_solves: Count | None = None,
    engine: Engine | None = None,
) -> xr.DataTree:
    """Return draws from the posterior of the model itself, made from draws of a surrogate's posterior.

    Delayed acceptance (Christen & Fox 2005, *J. Comput. Graph. Stat.* 14, 795–810): the surrogate's chain is the
    first stage, and its draws θ′ are proposals that the model accepts with the probability

    min(1, w(θ′)/w(θ)),  w = p(θ)/p̂(θ),

    p the posterior density by the model and p̂ that by the surrogate. Where a solve fails, w = 0. The proposals of
    a chain are the draws of a chain of the trace, two autocorrelation times apart or more. They are known before
    the first solve, so that all workers solve at once, and an independence sampler (Tierney 1994, *Ann. Stat.* 22,
    1701–1762) accepts or rejects them in their order. It starts at one of them, drawn with a probability in
    proportion to w, and has no burn-in.

    Its limit is p, whatever the error of the surrogate, which costs acceptances only. Two things are approximate
    in a finite run, and small beside its Monte-Carlo error: proposals are thinned draws of a Markov chain, and the
    start is one of finitely many. Where the surrogate's posterior has no mass, nothing is proposed.

    Parameters
    ----------
    problem : UpdatingProblem
        With a surrogate, from `fmu.surrogate`.
    trace : xarray.DataTree
        From `fmu.sample` of this problem. Its effective sample size bounds the number of proposals: half as many,
        or a quarter. ``until_ess=2000`` gives enough where the surrogate is good.
    until_ess : float
        Bulk and tail ESS that every parameter is to have, and no less than convergence needs. So many proposals
        are solved, and a quarter more; further ones if that is not enough.
    max_solves : int, optional
        Solves after which it ends.
    engine : Engine, optional
        Calls the user's function at several theta at once, see `fmu.engine`. The draws do not depend on it.

    Returns
    -------
    xarray.DataTree
        As `fmu.sample` of the problem without surrogate returns it; ESS and R-hat see a rejection as a repeated
        draw. ``identifiability`` is that of the surrogate. Attributes beside those of the surrogate
        (`fmu.analysis.certificate.certify`): ``second_stage_proposals``, how many were solved,
        ``second_stage_accepted`` and ``second_stage_failed`` of them, ``second_stage_solves``, and ``limit``, in
        words, if it ended before its verdict was good. ``warmup_n_solves`` are the solves of the surrogate, and
        ``warmup_wall_s`` is the time of its draws.

    Raises
    ------
    ValueError
        If the problem has no surrogate, the trace is not one of its posterior or has too few effective draws, a
        number is out of range, or all solves of a chain fail.
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
    """Return how many proposals are solved before the draws are first judged, of all chains."""
    return chains * int(np.ceil(_MARGIN * max(until_ess or 0.0, required_ess(chains)) / chains))


def _with_model(found: xr.DataTree, stage: SecondStage) -> xr.DataTree:
    """Add to a trace what `fmu.sample` adds, as far as it costs no more than a few solves."""
    trace, truth = stage.trace, stage.truth
    known = maxima_of(trace)
    maxima = None if known is None else stage.maxima(known)
    if maxima is not None:
        found = with_maxima(found, maxima)
    found = with_pairing(with_modes(found, truth, maxima), truth)
    if has(trace, IDENTIFIABILITY):
        found = with_group(found, IDENTIFIABILITY, trace[IDENTIFIABILITY].to_dataset())
    return with_left_out(found, truth, most=0.0)
