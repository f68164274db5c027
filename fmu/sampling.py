"""Sampling a problem, from the sampler's name to the trace."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import ArrayLike

    from fmu.analysis.maxima import Maxima
    from fmu.progress import Report
    from fmu.samplers.kernel import LogDensity, Sampler

SAMPLERS = ("mh", "slice", "hmc", "emcee", "tempering")
"""The names of the samplers, without importing them."""
GROWTH_LIMIT = 32
"""How many times the draws asked for a run may come to that is to reach an effective sample size."""


def sample(
    problem: LogDensity,
    sampler: str | Sampler = "hmc",
    *,
    draws: int = 1000,
    warmup: int = 1000,
    chains: int = 4,
    seed: int = 1,
    init: str | ArrayLike = "prior",
    until_ess: float | None = None,
    max_draws: int | None = None,
    maxima: Maxima | None = None,
    progress: Report | bool | None = None,
) -> xr.DataTree:
    """Draw from the posterior of a problem, or from any log-density.

    The same problem, sampler, numbers and seed give the same draws, bit for bit.

    Parameters
    ----------
    problem : LogDensity
        An `UpdatingProblem`, or anything with ``ndim``, ``lower``, ``upper``, ``log_prob`` and
        ``log_prob_and_grad``.
    sampler : str or Sampler
        ``"mh"``, ``"slice"``, ``"hmc"``, ``"emcee"`` or ``"tempering"`` with their default settings, or a settings
        object such as ``fmu.HamiltonianMonteCarlo(gradient="central-difference")``.
    draws, warmup : int
        Steps kept, and steps before them. An ensemble draws as many vectors a step as it has walkers.
    chains : int
        Independent chains; of an ensemble sampler, independent ensembles.
    seed : int
    init : {"prior", "start"} or array_like, shape (chains, ndim) or (chains, walkers, ndim)
        Where the chains start: drawn from the prior, at ``problem.start``, or where the array says (SI units).
    until_ess : float, optional
        Go on after `draws`, with what was learnt in warm-up, until the verdict of `fmu.diagnose` is good and the
        bulk and tail ESS of every parameter are at least this. The run is looked at after `draws` steps, twice as
        many, four times as many, and so on; it is bit for bit the run of as many draws.
    max_draws : int, optional
        The most steps kept, whatever the verdict: 32 times `draws` if not given.
    maxima : Maxima, optional
        What `fmu.find_map` found. It is kept in the trace, and every verdict on it takes it into account. With
        `until_ess` the maxima of an updating problem are searched for if they are not given.
    progress : bool or callable, optional
        Whether to draw progress bars on a terminal or in a notebook: in a notebook only, if not given. A callable
        is called after every step as ``progress(phase, done, total, info)`` instead.

    Returns
    -------
    xarray.DataTree
        The trace, see `fmu.analysis.trace.to_trace`; its attributes include the certificate of the reduced model
        where there is one, see `fmu.analysis.certificate.certify`. Of an updating problem the groups ``modes``
        (`fmu.analysis.modal_states`), ``pairing`` (`fmu.analysis.pairing_changes`) and ``identifiability``
        (`fmu.analysis.identifiability`) go with it.

    Raises
    ------
    ValueError
        If the sampler's name is unknown, a number is out of range, `max_draws` comes without `until_ess`, or a
        chain would start outside the bounds or where the log-probability is not finite.
    """
    import numpy as np

    from fmu.analysis.certificate import certify
    from fmu.analysis.diagnosis import with_maxima
    from fmu.analysis.trace import to_trace
    from fmu.progress import reporting
    from fmu.samplers import Run, named
    from fmu.samplers.settings import whole_number

    settings: Any = named(sampler) if isinstance(sampler, str) else sampler
    if not (hasattr(settings, "bind") and hasattr(settings, "walkers")):
        raise ValueError(
            f"sampler: must be one of {', '.join(SAMPLERS)}, or a settings object such as fmu.Slice() "
            f"(got {sampler!r})"
        )
    draws = whole_number("draws", draws, 1)
    limit = _limit(draws, until_ess, max_draws)
    if until_ess is not None and maxima is None and hasattr(problem, "parameters"):
        from fmu.analysis.search import find_map

        maxima = find_map(problem)  # type: ignore[arg-type]
    start = None if isinstance(init, str) else np.asarray(init, dtype=float)
    full_solves = getattr(getattr(problem, "model", None), "full_solves", 0)
    with reporting(progress, settings.name) as report:
        begun = Run(
            problem,
            settings,
            warmup=warmup,
            chains=chains,
            seed=seed,
            init=init if start is None else start,
            progress=report,
        )
        result = begun.extend(draws)
        while result.draws < limit and not _is_enough(
            to_trace(result, problem, start, predictions=False), until_ess, maxima
        ):
            result = begun.extend(min(result.draws, limit - result.draws))
    trace = to_trace(result, problem, start)
    if maxima is not None:
        trace = with_maxima(trace, maxima)
    trace.attrs.update(certify(trace, problem, full_solves=full_solves))
    return _with_structure(trace, problem, maxima)


def _with_structure(trace: xr.DataTree, problem: Any, maxima: Maxima | None) -> xr.DataTree:
    """Keep in the trace of an updating problem what the model says beside the draws."""
    from fmu.analysis.identifiability import with_identifiability
    from fmu.analysis.modal_states import with_modes
    from fmu.analysis.pairing_changes import with_pairing

    if not hasattr(problem, "likelihood"):
        return trace
    trace = with_pairing(with_modes(trace, problem, maxima), problem)
    if hasattr(problem.likelihood, "sensitivity"):
        trace = with_identifiability(trace, problem, maxima)
    return trace


def _limit(draws: int, until_ess: float | None, max_draws: int | None) -> int:
    """Return the most steps to keep; ValueError unless the numbers make sense together."""
    from fmu.samplers.settings import positive_number, whole_number

    if until_ess is None:
        if max_draws is not None:
            raise ValueError(f"max_draws: needs until_ess, without which draws is the number (got {max_draws!r})")
        return draws
    positive_number("until_ess", until_ess)
    return GROWTH_LIMIT * draws if max_draws is None else whole_number("max_draws", max_draws, draws)


def _is_enough(trace: xr.DataTree, until_ess: float | None, maxima: Maxima | None) -> bool:
    """Say whether a run needs no more draws."""
    from fmu.analysis.diagnosis import is_enough, judge
    from fmu.analysis.diagnostics import summary

    if until_ess is None:
        return True
    table = summary(trace)
    return is_enough(judge(trace, [] if maxima is None else [maxima], table=table), table, until_ess)
