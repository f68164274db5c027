"""Sampling a problem, from the sampler's name to the trace."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from annotated_types import Interval

from fmu.arguments import Chains, Count, Draws, OwnRule, Seed, Workers, check_arguments, shown
from fmu.numbers import whole
from fmu.samplers.registry import SAMPLERS as SAMPLERS

if TYPE_CHECKING:
    import os

    import xarray as xr
    from numpy.typing import ArrayLike

    from fmu.analysis.maxima.results import Maxima
    from fmu.engines.base import Engine
    from fmu.runs import Checkpoint
    from fmu.runs.store import Store
    from fmu.samplers.kernel import Sampler
    from fmu.samplers.loop.record import RunResult
    from fmu.types import LogDensity, Positive

INITS = ("maxima", "prior", "start")
"""Words for where the chains start."""
DEFAULT_SAMPLER = "mixture"
"""The sampler that gave most on every density that it was compared on, with gradients and without.

Smallest bulk ESS per evaluation after a warm-up of 1000 steps, a gradient as 1.9 of them, of the mixture and of
HMC: 0.54 and 0.05 on cantilever-young, 0.77 and 0.05 on cantilever-section by number, 0.59 and 0.02 on
shear-2dof, 0.06 and 0.06 on shear-10dof, which took 20 000 and 35 000 evaluations to converge. Smallest of bulk
and tail ESS per evaluation on plain densities without known maxima, such as a banana, two modes and a funnel:
0.20 to 0.75, and 0.03 to 0.20 by HMC; on four of them with gradients hidden 0.26 to 0.76, and 0.05 to 0.14 by
Metropolis–Hastings. On a Python function of two parameters 0.35, and 0.22 by Metropolis–Hastings.
"""
GROWTH_LIMIT = 32
"""`max_draws` over `draws`, unless given."""


class StoppedRun(KeyboardInterrupt):
    """A run was stopped on request, and can be resumed from its checkpoint.

    Attributes
    ----------
    trace : xarray.DataTree or None
        The draws so far, None if the run was in warm-up.
    where : str
        Where it was stopped, in words.
    """

    def __init__(self, where: str, trace: xr.DataTree | None) -> None:
        super().__init__(f"the run was stopped {where}")
        self.trace, self.where = trace, where


@check_arguments
def sample(
    problem: LogDensity,
    sampler: Annotated[str | Sampler | None, OwnRule()] = None,
    *,
    draws: Draws = 1000,
    warmup: Annotated[int, Interval(ge=0, le=1_000_000_000)] = 1000,
    chains: Chains = 4,
    seed: Seed = 1,
    init: str | ArrayLike = "maxima",
    jumps: bool | None = None,
    groups: Count | None = None,
    until_ess: Positive | None = None,
    max_draws: Count | None = None,
    max_solves: Count | None = None,
    maxima: Maxima | None = None,
    checkpoint: str | os.PathLike[str] | Checkpoint | None = None,
    workers: Workers | str | Engine = 1,
    max_failure_rate: Annotated[float, Interval(ge=0, le=1)] = 0.5,
    progress: Callable[..., Any] | bool | None = None,
    on_draws: Callable[[xr.DataTree], None] | None = None,
) -> xr.DataTree:
    """Draw from the posterior of a problem, or from any log-density.

    The same problem, sampler, numbers and seed give the same draws, bit for bit, with any number of workers and
    however often the run was interrupted.

    Parameters
    ----------
    problem : LogDensity
        An `UpdatingProblem`, or anything with ``ndim``, ``lower``, ``upper``, ``log_prob`` and
        ``log_prob_and_grad``.
    sampler : str or Sampler, optional
        ``"mh"``, ``"slice"``, ``"hmc"``, ``"emcee"``, ``"mixture"`` or ``"tempering"`` with default settings,
        or a settings object such as ``fmu.HamiltonianMonteCarlo(gradient="central-difference")``. The default is
        the mixture, which has given the most effective draws per evaluation on all posteriors and densities that
        it was compared on; for a hierarchical posterior (`fmu.JointProblem`) it is HMC.
    draws, warmup : int
        Steps kept, and steps before them. An ensemble draws as many vectors per step as it has walkers.
    chains : int
        Number of independent chains; for an ensemble sampler, of independent ensembles.
    seed : int
        Seed of the random numbers.
    init : {"maxima", "prior", "start"} or array_like, shape (chains, ndim) or (chains, walkers, ndim)
        Where the chains start. ``"maxima"``: around the maxima of the posterior, in proportion to their
        probability (`fmu.analysis.maxima.starts`); chains on a log-density that is no `UpdatingProblem` start
        from its prior, if it has one and not several maxima. ``"prior"``: at draws from the prior. ``"start"``:
        at ``problem.start``. An array: there (SI units).
    jumps : bool, optional
        Whether every other step of ``"mh"``, ``"slice"`` or ``"hmc"`` is an independent candidate from a mixture
        that warm-up fits to the posterior, so that chains cross between separated maxima
        (`fmu.samplers.mixture.mixture.with_jumps`). By default where two maxima or more have 1 % of the
        probability each; or are known at all, if the chains do not start at them.
    groups : int, optional
        Number of groups that the chains are divided into, for several workers. The chains of a group advance and
        adapt together, so the draws depend on this number. By default all chains are one group, and every ensemble
        is a group of its own.
    until_ess : float, optional
        Continue after `draws`, with the settings learnt in warm-up, until the verdict of `fmu.diagnose` is good
        and the bulk and tail ESS of every parameter are at least this. The number of missing draws is predicted
        from those so far (`fmu.analysis.convergence.remedies.draws_to_come`). The draws are, bit for bit, those
        of a run with as many `draws`. An ensemble needs 50 autocorrelation times of steps whatever is asked for:
        four of 32 walkers then have an ESS of at least 6400.
    max_draws : int, optional
        The most steps kept, whatever the verdict. Default: 32 times `draws`, or no limit if there is `max_solves`.
    max_solves : int, optional
        No more is drawn than about so many solves allow, warm-up included; the first `draws` are always made,
        and the verdict says what took more.
    maxima : Maxima, optional
        The result of `fmu.find_map`. It is stored in the trace, and every verdict on the trace uses it. By default
        the maxima are searched for, wherever the chains start, but not in a hierarchical posterior.
    checkpoint : path-like or Checkpoint, optional
        A directory in which draws and state are saved during the run. The same call with the same directory
        resumes a run that was stopped or killed; a run that has finished is read, not repeated.
    workers : int, str or Engine
        Number of processes on this machine that advance the groups; or the address of the scheduler of a Dask
        cluster, ``"tcp://host:port"``; or an engine from `fmu.engine`.
    max_failure_rate : float
        The run stops when more than this fraction of the solves has failed; 1 for never.
    progress : bool or callable, optional
        Whether to draw progress bars on a terminal or in a notebook; by default in a notebook only. A callable is
        called after every step as ``progress(phase, done, total, info)`` instead, see `fmu.samplers.Run`; and in
        the phases before and after the draws that take long, such as ``"search"`` and ``"predictions"``, with the
        number of solves in the phase in ``info["solves"]``.
    on_draws : callable, optional
        Called with the trace once all draws are there, before what takes further solves: the certificate, the
        modes' shapes and the modes left out. Convergence can be judged by then (`fmu.diagnose`).

    Returns
    -------
    xarray.DataTree
        The trace, see `fmu.analysis.trace.conversion.to_trace`. Its attributes include ``after_n_solves``, the
        solves after the last draw (for predictions and the like); ``gradient_cost``, how many times as long as a
        log-probability its exact gradient took, if the sampler takes some; and the certificate of the reduced
        model, if there is one (`fmu.analysis.certificate.certify`); and ``limit``, at which a run with `until_ess`
        ended before its verdict was good, in words. The trace of an updating problem also has the
        groups ``modes`` (`fmu.analysis.trace.modal_states`), ``pairing`` (`fmu.analysis.pairing_changes`),
        ``identifiability`` (`fmu.analysis.identifiability`) and ``leave_one_out`` (`fmu.analysis.held_out.modes`).

    Raises
    ------
    ValueError
        If the sampler's name is unknown, `jumps` is True for a sampler without local steps, a trace cannot store a
        parameter's name, a number is out of range, `max_draws` or `max_solves` is given without `until_ess`, a
        chain would start outside the bounds or where the log-probability is not finite, or `checkpoint` holds
        another run, or one that is running.
    OSError
        If `checkpoint` cannot be written to.
    StoppedRun
        If Ctrl-C or SIGTERM stopped the draws of a run with a checkpoint: a KeyboardInterrupt with the trace so
        far, without what takes further solves. After the draws, a stop is a plain KeyboardInterrupt; the draws are
        saved.
    TooManyFailuresError
        If too large a share of the solves failed.
    """
    from fmu.analysis.convergence.diagnosis import draws_missing, with_maxima
    from fmu.analysis.convergence.effective import live_diagnostics
    from fmu.analysis.estimate import gradient_cost
    from fmu.analysis.maxima.results import NEGLIGIBLE
    from fmu.analysis.maxima.search import find_map, is_searchable, is_updating
    from fmu.analysis.maxima.starts import components, starts, worth_starting_from
    from fmu.analysis.trace.conversion import to_trace
    from fmu.analysis.trace.failure_ledger import failure_rate_exceeded
    from fmu.interruption import interruptible
    from fmu.progress import reporting
    from fmu.progress.phases import solves, told_to
    from fmu.runs import Checkpoint
    from fmu.runs.maxima import keep_maxima, kept_maxima
    from fmu.samplers.loop.run import Interrupted, Run
    from fmu.samplers.mixture.mixture import can_jump, with_jumps
    from fmu.samplers.settings import whole_number

    # 1. Whether the arguments make sense, before maxima are searched for.
    settings = _settings(default_sampler(problem) if sampler is None else sampler)
    if jumps:
        settings = with_jumps(settings)
    draws = whole_number("draws", draws, 1)
    limits = Limits.of(draws, until_ess, max_draws, max_solves)
    failure_rate_exceeded(0, 0, max_failure_rate)
    if isinstance(workers, str) and "://" not in workers:
        raise ValueError(f"workers: must be the address of a scheduler, such as tcp://host:8786 (got {workers!r})")
    arguments = _checked(problem, settings, init, warmup=warmup, chains=chains, groups=groups, seed=seed)
    saved = checkpoint if checkpoint is None or isinstance(checkpoint, Checkpoint) else Checkpoint(checkpoint)
    of_model: Any = problem if is_updating(problem) else None
    full_solves = of_model.model.full_solves if of_model is not None else 0
    getattr(problem, "take_failures", list)()  # forget those before the run

    def as_trace(result: RunResult, *, predictions: bool = True) -> xr.DataTree:
        named = replace(result, init="maxima") if isinstance(says, dict) else result
        return to_trace(named, problem, says, predictions=predictions)

    with ExitStack() as outer:
        report = outer.enter_context(reporting(progress, settings.name))
        outer.enter_context(told_to(report))

        # 2. Where the chains start.
        found = None
        if maxima is None and is_searchable(problem):
            maxima = None if saved is None else kept_maxima(saved.directory, problem)
            if maxima is None:
                maxima = found = find_map(problem)
        begin_at = maxima if of_model is not None else maxima and worth_starting_from(problem, maxima)
        start, says = starts(problem, init, begin_at, chains, settings.walkers, seed)
        if begin_at is not None:
            starts_there = isinstance(says, dict)  # otherwise a chain may be caught at any of them
            caught_at = [m for m in begin_at if m.starting_share > NEGLIGIBLE or not starts_there]
            if jumps is None and len(caught_at) > 1 and can_jump(settings):
                settings = with_jumps(settings)
        if begin_at is not None or getattr(problem, "is_hierarchical", False):
            settings = settings.starting_from(*components(problem, begin_at))

        # 3. The draws, saved in the checkpoint meanwhile.
        stack = outer.enter_context(ExitStack())  # closed before what follows the draws
        store = stop = None
        if saved is not None:
            store = stack.enter_context(_store(saved, problem, settings, arguments, says))
            if found is not None:
                keep_maxima(store.directory, found, problem)
            stop = stack.enter_context(interruptible())
        try:
            begun = Run(
                problem,
                settings,
                **arguments,
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
            result, limit = begun.extend(draws), ""
            while until_ess is not None and not limit:
                missing = draws_missing(as_trace(result, predictions=False), until_ess, maxima)
                if not missing:
                    break
                allowed, limit = limits.allow(result)
                if allowed:
                    result = begun.extend(min(missing, allowed))
            begun.report_end()
        except Interrupted as stopped:
            stack.close()
            if stopped.result is None:
                raise StoppedRun("in warm-up", None) from None
            drawn = as_trace(stopped.result, predictions=False)
            drawn.attrs["complete"] = 0
            where = f"after {stopped.result.draws} of {draws} draws"
            raise StoppedRun(where, drawn if maxima is None else with_maxima(drawn, maxima)) from None
        if stop is not None and stop():  # asked for with the last draw, which is saved
            raise KeyboardInterrupt
        stack.close()

        # 4. What is computed from the draws.
        solved_before = solves()
        trace = as_trace(result)
        if _takes_exact_gradients(trace, problem, settings):
            last = result.posterior.position[: result.chains // result.groups, -1]
            trace.attrs["gradient_cost"] = gradient_cost(problem, last)
        if maxima is not None:
            trace = with_maxima(trace, maxima)
        if limit:
            trace.attrs["limit"] = limit
            trace.attrs["beyond_limit"] = limits.describe_excess(result)
        trace.attrs["complete"] = 1
        if of_model is not None and of_model.model.is_uncertain:
            trace.attrs.update(of_model.model.record)  # no verdict before the certificate
        if on_draws is not None:
            on_draws(trace)
        if of_model is not None:
            trace = _with_structure(trace, of_model, maxima, full_solves)
        trace.attrs["after_n_solves"] = solves() - solved_before
    return trace


def default_sampler(problem: LogDensity) -> str:
    """Return the name of the sampler that is taken where none is named.

    HMC for a hierarchical posterior: it has a parameter for every test, too many for a mixture to learn.
    """
    return "hmc" if getattr(problem, "is_hierarchical", False) else DEFAULT_SAMPLER


DEFAULTS: Mapping[str, Any] = {
    name: argument.default
    for name, argument in inspect.signature(sample).parameters.items()
    if argument.kind is argument.KEYWORD_ONLY
}
"""The keyword arguments of `sample` and their default values, which ``fmu run`` has, too."""


def _settings(sampler: str | Sampler) -> Sampler:
    """Return the settings of a sampler; ValueError if it is neither a name nor a settings object."""
    from fmu.samplers.kernel import Sampler
    from fmu.samplers.registry import named

    if isinstance(sampler, str):
        return named(sampler)
    if not isinstance(sampler, Sampler):
        raise ValueError(
            f"sampler: must be one of {', '.join(SAMPLERS)}, or a settings object derived from "
            f"fmu.samplers.Sampler, such as fmu.Slice() (got {sampler!r})"
        )
    return sampler


def _checked(
    problem: LogDensity, settings: Sampler, init: Any, *, warmup: Any, chains: Any, groups: Any, seed: Any
) -> dict[str, int]:
    """Return the numbers that determine a run; ValueError if one, a name or `init` is wrong by itself."""
    import numpy as np

    from fmu.analysis.trace.conversion import names_of
    from fmu.posterior.parameters import require_name
    from fmu.samplers.loop.run import n_groups
    from fmu.samplers.settings import whole_number

    for name in names_of(problem):
        require_name(name)
    if getattr(settings, "gradient", "") == "exact" and not hasattr(problem, "log_prob_and_grad"):
        raise ValueError(
            f"sampler: {settings.name} needs a density with log_prob_and_grad; without it take 'mixture', or "
            "fmu.HamiltonianMonteCarlo(gradient='central-difference')"
        )
    if isinstance(init, str) and init not in INITS:
        raise ValueError(f"init: must be one of {', '.join(INITS)} or an array (got {init!r})")
    if not isinstance(init, str):
        shape = (chains, problem.ndim) if settings.walkers == 1 else (chains, settings.walkers, problem.ndim)
        if np.shape(init) != shape or not np.isfinite(init).all():
            raise ValueError(f"init: must be finite, of shape {shape} (got {shown(init)})")
    warmup, chains = whole_number("warmup", warmup, 0), whole_number("chains", chains, 1)
    seed, groups = whole_number("seed", seed, 0), n_groups(groups, chains, settings)
    return {"warmup": warmup, "chains": chains, "groups": groups, "seed": seed}


def _store(
    checkpoint: Checkpoint, problem: LogDensity, settings: Sampler, arguments: Mapping[str, int], says: Any
) -> Store:
    """Return the checkpoint of a run, open; `says` is where the chains start."""
    from fmu.analysis.trace.conversion import names_of, units_of
    from fmu.analysis.trace.provenance import described
    from fmu.runs.identity import Identity
    from fmu.runs.store import Store
    from fmu.samplers.settings import describe

    run = {**arguments, "walkers": settings.walkers, "init": says}
    configuration = described(problem, settings.name, describe(settings), run)
    return Store(checkpoint, Identity.of(configuration), names_of(problem), units_of(problem))


def _engine(workers: int | str | Engine, stack: ExitStack) -> Engine:
    """Return the engine that does the work; one that is created here is closed with the stack."""
    from fmu.engines import engine
    from fmu.engines.base import Engine

    if isinstance(workers, Engine):
        return workers
    return stack.enter_context(engine(cluster=workers) if isinstance(workers, str) else engine(workers))


def _takes_exact_gradients(trace: xr.DataTree, problem: Any, settings: Sampler) -> bool:
    """Return whether gradients were taken that cost more than the solves counted for them.

    Differences consist of solves that are counted, and a user's function returns value and gradient in one call.
    """
    is_function = getattr(getattr(problem, "model", None), "black_box", None) is not None
    differences = getattr(getattr(settings, "local", settings), "gradient", "exact") != "exact"
    return bool(trace.attrs["n_gradients"]) and not is_function and not differences


def _with_structure(trace: xr.DataTree, problem: Any, maxima: Maxima | None, full_solves: int) -> xr.DataTree:
    """Add to a trace what the model says at the draws, and without single modes."""
    from fmu.analysis.certificate import certify
    from fmu.analysis.held_out.modes import with_left_out
    from fmu.analysis.identifiability import with_identifiability
    from fmu.analysis.pairing_changes import with_pairing
    from fmu.analysis.trace.modal_states import with_modes

    trace.attrs.update(certify(trace, problem, full_solves=full_solves))
    trace = with_pairing(with_modes(trace, problem, maxima), problem)
    if problem.is_hierarchical or not problem.likelihood.of_modes:
        return trace
    return with_left_out(with_identifiability(trace, problem, maxima), problem)


class Limits(NamedTuple):
    """The most steps that `sample` keeps, and the solves with which it stops."""

    draws: int | None
    solves: int | None

    @classmethod
    def of(cls, draws: int, until_ess: float | None, max_draws: int | None, max_solves: int | None) -> Limits:
        """Return the limits of a run; ValueError if the numbers contradict each other."""
        from fmu.samplers.settings import positive_number, whole_number

        if until_ess is None:
            for name, given in (("max_draws", max_draws), ("max_solves", max_solves)):
                if given is not None:
                    raise ValueError(f"{name}: needs until_ess, as draws is the number without it (got {given!r})")
            return cls(None, None)
        positive_number("until_ess", until_ess)
        if max_solves is not None:
            max_solves = whole_number("max_solves", max_solves, 1)
        if max_draws is not None:
            max_draws = whole_number("max_draws", max_draws, draws)
        elif max_solves is None:
            max_draws = GROWTH_LIMIT * draws
        return cls(max_draws, max_solves)

    def allow(self, result: RunResult) -> tuple[int, str]:
        """Return how many further steps a run may take; if none, which limit it has reached, else nothing.

        A step is taken to need as many solves as those so far. Less than one in a hundred more is not worth it.
        """
        allowed = []
        if self.draws is not None:
            allowed.append((self.draws - result.draws, f"{whole(self.draws)} draws per chain"))
        if self.solves is not None:
            drawn = int(result.posterior.stats["n_solves"].sum())
            left = self.solves - drawn - int(result.warmup.stats["n_solves"].sum())
            steps = max(left, 0) * result.draws // max(drawn, 1)
            allowed.append((steps if steps > result.draws // 100 else 0, f"{whole(self.solves)} solves"))
        steps, limit = min(allowed)
        return steps, "" if steps else limit

    def describe_excess(self, result: RunResult) -> str:
        """Say how a run took more than 1 % more solves than its limit; an empty string if it did not."""
        warmed, drawn = (int(part.stats["n_solves"].sum()) for part in (result.warmup, result.posterior))
        if self.solves is None or warmed + drawn <= 1.01 * self.solves:
            return ""
        return f": the warm-up took {whole(warmed)} and {whole(result.draws)} draws {whole(drawn)}"
