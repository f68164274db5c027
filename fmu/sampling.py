"""Sampling a problem, from the sampler's name to the trace."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import os

    import xarray as xr
    from numpy.typing import ArrayLike

    from fmu.analysis.maxima.results import Maxima
    from fmu.engines.base import Engine
    from fmu.progress import Report
    from fmu.runs import Checkpoint
    from fmu.runs.store import Store
    from fmu.samplers.kernel import Sampler
    from fmu.samplers.loop.draws import RunResult
    from fmu.types import LogDensity

SAMPLERS = ("mh", "slice", "hmc", "emcee", "tempering")
"""The names of the samplers, without importing them."""
INITS = ("maxima", "prior", "start")
"""Words for where the chains start."""
GROWTH_LIMIT = 32
"""How many times the draws asked for a run may come to that is to reach an effective sample size."""
MAX_FAILURE_RATE = 0.5
"""Share of the solves that may fail."""


class StoppedRun(KeyboardInterrupt):
    """A run was asked to stop, and can go on from its checkpoint.

    Attributes
    ----------
    trace : xarray.DataTree or None
        What had been drawn by then, None if that was nothing but warm-up.
    where : str
        In words.
    """

    def __init__(self, where: str, trace: xr.DataTree | None) -> None:
        super().__init__(f"the run was stopped {where}")
        self.trace, self.where = trace, where


def sample(
    problem: LogDensity,
    sampler: str | Sampler | None = None,
    *,
    draws: int = 1000,
    warmup: int = 1000,
    chains: int = 4,
    seed: int = 1,
    init: str | ArrayLike = "maxima",
    groups: int | None = None,
    until_ess: float | None = None,
    max_draws: int | None = None,
    maxima: Maxima | None = None,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
    workers: int | str | Engine = 1,
    max_failure_rate: float = MAX_FAILURE_RATE,
    progress: Report | bool | None = None,
) -> xr.DataTree:
    """Draw from the posterior of a problem, or from any log-density.

    The same problem, sampler, numbers and seed give the same draws, bit for bit, whoever computes them and however
    often the run was broken off.

    Parameters
    ----------
    problem : LogDensity
        An `UpdatingProblem`, or anything with ``ndim``, ``lower``, ``upper``, ``log_prob`` and
        ``log_prob_and_grad``.
    sampler : str or Sampler, optional
        ``"mh"``, ``"slice"``, ``"hmc"``, ``"emcee"`` or ``"tempering"`` with their default settings, or a settings
        object such as ``fmu.HamiltonianMonteCarlo(gradient="central-difference")``. If not given, what the model
        offers decides: see `default_sampler`.
    draws, warmup : int
        Steps kept, and steps before them. An ensemble draws as many vectors a step as it has walkers.
    chains : int
        Independent chains; of an ensemble sampler, independent ensembles.
    seed : int
    init : {"maxima", "prior", "start"} or array_like, shape (chains, ndim) or (chains, walkers, ndim)
        Where the chains start. ``"maxima"``: around the maxima of the posterior, in proportion to their shares
        (`fmu.analysis.maxima.starts`); those of an updating problem are searched for if they are not given, and a
        plain log-density without maxima is started from the prior. ``"prior"``: draws from the prior. ``"start"``:
        at ``problem.start``. Or where the array says (SI units).
    groups : int, optional
        Groups that the chains are divided into, for several workers: the chains of a group advance together and
        learn together, so that another number gives other draws. If not given, all chains are one group, but each
        ensemble is its own.
    until_ess : float, optional
        Go on after `draws`, with what was learnt in warm-up, until the verdict of `fmu.diagnose` is good and the
        bulk and tail ESS of every parameter are at least this. How many draws are missing is predicted from those
        so far (`fmu.analysis.convergence.remedies.draws_to_come`). The run is bit for bit that of as many draws.
    max_draws : int, optional
        The most steps kept, whatever the verdict: 32 times `draws` if not given.
    maxima : Maxima, optional
        What `fmu.find_map` found. It is kept in the trace, and every verdict on it takes it into account. With
        `until_ess` or ``init="maxima"`` those of an updating problem are searched for if they are not given.
    checkpoint : path-like or Checkpoint, optional
        A directory to keep draws and state in while the run goes on. The same call with the same directory goes on
        where the last one ended or was killed; a run that has ended is read, not repeated.
    workers : int, str or Engine
        Number of processes on this machine that advance the groups; or the address of the scheduler of a Dask
        cluster, ``"tcp://host:port"``; or an engine from `fmu.engine`.
    max_failure_rate : float
        The run stops when a larger share of the solves has failed; 1 for never.
    progress : bool or callable, optional
        Whether to draw progress bars on a terminal or in a notebook: in a notebook only, if not given. A callable
        is called after every step as ``progress(phase, done, total, info)`` instead, see `fmu.samplers.Run`; and
        for the phases before and after the draws that take long, such as ``"search"`` and ``"predictions"``, with
        the solves of the phase so far in ``info["solves"]``.

    Returns
    -------
    xarray.DataTree
        The trace, see `fmu.analysis.trace.conversion.to_trace`; its attributes include ``after_n_solves``, the
        solves after the last draw, for predictions and what follows, and the certificate of the reduced model
        where there is one, see `fmu.analysis.certificate.certify`. Of an updating problem the groups ``modes``
        (`fmu.analysis.trace.modal_states`), ``pairing`` (`fmu.analysis.pairing_changes`) and
        ``identifiability`` (`fmu.analysis.identifiability`) go with it.

    Raises
    ------
    ValueError
        If the sampler's name is unknown, a parameter's name is none that a trace can keep, a number is
        out of range, `max_draws` comes without `until_ess`, a chain would start outside the bounds or where the
        log-probability is not finite, or `checkpoint` holds another run, or one that another process is at.
    OSError
        If `checkpoint` cannot be written to.
    StoppedRun
        If Ctrl-C or SIGTERM stopped the draws of a run with a checkpoint: a KeyboardInterrupt with the trace so
        far, without what takes further solves. A stop after them is a KeyboardInterrupt; the draws are kept.
    TooManyFailuresError
        If too large a share of the solves failed.
    """
    from fmu.analysis.convergence.diagnosis import draws_missing, with_maxima
    from fmu.analysis.convergence.effective import live_diagnostics
    from fmu.analysis.maxima.starts import starts
    from fmu.analysis.trace.conversion import names_of, to_trace
    from fmu.analysis.trace.failure_ledger import failure_rate_exceeded
    from fmu.interruption import interruptible
    from fmu.posterior.parameters import require_name
    from fmu.progress import reporting
    from fmu.progress.phases import solves, told_to
    from fmu.runs.maxima import keep_maxima, searched
    from fmu.samplers import Run, named
    from fmu.samplers.loop.run import Interrupted
    from fmu.samplers.loop.settings import whole_number

    if sampler is None:
        sampler = default_sampler(problem)
    settings: Any = named(sampler) if isinstance(sampler, str) else sampler
    if not (hasattr(settings, "bind") and hasattr(settings, "walkers")):
        raise ValueError(
            f"sampler: must be one of {', '.join(SAMPLERS)}, or a settings object such as fmu.Slice() "
            f"(got {sampler!r})"
        )
    for name in names_of(problem):
        require_name(name)
    draws = whole_number("draws", draws, 1)
    limit = most_draws(draws, until_ess, max_draws)
    failure_rate_exceeded(0, 0, max_failure_rate)  # whether it is a rate
    arguments = {"warmup": warmup, "chains": chains, "groups": groups, "seed": seed}
    _check(init, arguments, settings)
    full_solves = getattr(getattr(problem, "model", None), "full_solves", 0)
    getattr(problem, "take_failures", list)()  # those of the run are to come

    def as_trace(result: RunResult, *, predictions: bool = True) -> xr.DataTree:
        named = replace(result, init="maxima") if isinstance(says, dict) else result
        return to_trace(named, problem, says, predictions=predictions)

    with ExitStack() as outer:
        report = outer.enter_context(reporting(progress, settings.name))
        outer.enter_context(told_to(report))
        found = None
        if maxima is None and (until_ess is not None or (isinstance(init, str) and init == "maxima")):
            kept_in: Any = getattr(checkpoint, "directory", checkpoint)
            maxima = found = searched(problem, kept_in)
        start, says = starts(problem, init, maxima, chains, settings.walkers, seed)
        stack = outer.enter_context(ExitStack())  # closed before what follows the draws
        store = stop = None
        if checkpoint is not None:
            store = stack.enter_context(_store(checkpoint, problem, settings, arguments, says))
            if found is not None:
                keep_maxima(store.directory, found, problem)
            stop = stack.enter_context(interruptible())
        try:
            begun = Run(
                problem,
                settings,
                **arguments,  # type: ignore[arg-type]
                init=start,
                progress=report,
                engine=_engine(workers, stack),
                checkpointer=store,
                stop=stop,
                too_many_failed=lambda failed, solves, why: failure_rate_exceeded(
                    failed, solves, max_failure_rate, failures=why
                ),
                live=live_diagnostics,
            )
            result = begun.extend(draws)
            while result.draws < limit:
                missing = draws_missing(as_trace(result, predictions=False), until_ess, maxima)
                if not missing:
                    break
                result = begun.extend(min(missing, limit - result.draws))
        except Interrupted as stopped:
            stack.close()
            so_far = stopped.result
            if so_far is None:
                raise StoppedRun("in warm-up", None) from None
            where = f"after {so_far.draws} of {draws} draws"
            drawn = as_trace(so_far, predictions=False)
            drawn.attrs["complete"] = 0
            raise StoppedRun(where, drawn if maxima is None else with_maxima(drawn, maxima)) from None
        if stop is not None and stop():  # asked for with the last draw: it is kept
            raise KeyboardInterrupt
        stack.close()
        solved_before = solves()
        trace = _with_structure(as_trace(result), problem, maxima, full_solves)
        trace.attrs["after_n_solves"] = solves() - solved_before
    return trace


DEFAULTS: Mapping[str, Any] = sample.__kwdefaults__ or {}
"""The keyword arguments of `sample` and their default values, which are those of ``fmu run``, too."""


def _check(init: Any, arguments: dict[str, Any], settings: Any) -> None:
    """Raise ValueError, before maxima are searched for, if an argument of the run is wrong by itself."""
    from fmu.samplers.loop.run import n_groups
    from fmu.samplers.loop.settings import whole_number

    for name, least in (("warmup", 0), ("chains", 1), ("seed", 0)):
        whole_number(name, arguments[name], least)
    n_groups(arguments["groups"], arguments["chains"], settings)
    if isinstance(init, str) and init not in INITS:
        raise ValueError(f"init: must be one of {', '.join(INITS)} or an array (got {init!r})")


def _store(checkpoint: Any, problem: LogDensity, settings: Any, arguments: dict[str, Any], says: Any) -> Store:
    """Return where the run is kept."""
    from fmu.analysis.trace.conversion import names_of
    from fmu.analysis.trace.provenance import described
    from fmu.runs import Checkpoint
    from fmu.runs.identity import Identity
    from fmu.runs.store import Store
    from fmu.samplers.loop.run import n_groups
    from fmu.samplers.loop.settings import describe, whole_number

    chains = whole_number("chains", arguments["chains"], 1)
    run = {
        **arguments,
        "groups": n_groups(arguments["groups"], chains, settings),
        "walkers": settings.walkers,
        "init": says,
    }
    configuration = described(problem, settings.name, describe(settings), run)
    where = checkpoint if isinstance(checkpoint, Checkpoint) else Checkpoint(checkpoint)
    names = names_of(problem)
    units = tuple(getattr(problem, "units", ("",) * len(names)))
    return Store(where, Identity.of(configuration), names, units)


def _engine(workers: int | str | Engine, stack: ExitStack) -> Engine:
    """Return the engine that does the work; one that is created here is closed with the stack."""
    from fmu.engines import engine
    from fmu.engines.base import Engine

    if isinstance(workers, Engine):
        return workers
    return stack.enter_context(engine(cluster=workers) if isinstance(workers, str) else engine(workers))


def default_sampler(problem: LogDensity) -> str:
    """Return the sampler for what a problem offers: ``"hmc"`` with exact gradients, ``"mh"`` without.

    Without them a gradient takes 2 ndim + 1 solves, and a step of HMC several gradients. Of the samplers that need
    none, Metropolis–Hastings gives the most effective draws a solve, warm-up counted: on four functions of two and
    three parameters 0.018 to 0.12, slice sampling 0.018 to 0.085, emcee 0.013 to 0.027; HMC by differences 0.002
    to 0.11.
    """
    has_gradient = hasattr(problem, "log_prob_and_grad") and getattr(problem, "solves_per_gradient", 1) == 1
    return "hmc" if has_gradient else "mh"


def _with_structure(trace: xr.DataTree, problem: Any, maxima: Maxima | None, full_solves: int) -> xr.DataTree:
    """Keep in a trace what the problem says beside the draws."""
    from fmu.analysis.certificate import certify
    from fmu.analysis.convergence.diagnosis import with_maxima
    from fmu.analysis.identifiability import with_identifiability
    from fmu.analysis.pairing_changes import with_pairing
    from fmu.analysis.trace.modal_states import with_modes

    if maxima is not None:
        trace = with_maxima(trace, maxima)
    trace.attrs["complete"] = 1
    trace.attrs.update(certify(trace, problem, full_solves=full_solves))
    if not hasattr(problem, "likelihood"):
        return trace
    trace = with_pairing(with_modes(trace, problem, maxima), problem)
    if problem.likelihood.of_modes:
        trace = with_identifiability(trace, problem, maxima)
    return trace


def most_draws(draws: int, until_ess: float | None, max_draws: int | None) -> int:
    """Return the most steps that `sample` keeps; ValueError unless the numbers make sense together."""
    from fmu.samplers.loop.settings import positive_number, whole_number

    if until_ess is None:
        if max_draws is not None:
            raise ValueError(f"max_draws: needs until_ess, without which draws is the number (got {max_draws!r})")
        return draws
    positive_number("until_ess", until_ess)
    return GROWTH_LIMIT * draws if max_draws is None else whole_number("max_draws", max_draws, draws)
