"""Steps of `fmu.sample`: choose starting points, draw, convert to a trace, and analyse the draws."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import ArrayLike

    from fmu.analysis.maxima.results import Maxima
    from fmu.analysis.maxima.starts import Starts
    from fmu.engines.base import Engine
    from fmu.progress import Report
    from fmu.runs import Checkpoint
    from fmu.runs.store import Store
    from fmu.samplers.kernel import Sampler
    from fmu.samplers.loop.record import RunResult
    from fmu.sampling.limits import Limits
    from fmu.types import LogDensity

_SHORTENED = "warmup_shortened_to"


class StoppedRun(KeyboardInterrupt):
    """Raised when a run is stopped on request and can be resumed from its checkpoint.

    Attributes
    ----------
    trace : xarray.DataTree or None
        The trace of the draws so far; None if the run was still in warm-up.
    where : str
        The point at which the run was stopped, in words.
    """

    def __init__(self, where: str, trace: xr.DataTree | None) -> None:
        super().__init__(f"the run was stopped {where}")
        self.trace, self.where = trace, where


class Task(NamedTuple):
    """The problem to be sampled and the settings of the run.

    Attributes
    ----------
    problem : LogDensity
    numbers : dict
        The numbers that determine the draws: requested warm-up steps, chains, groups and seed.
    limits : Limits
    saved : Checkpoint or None
    max_failure_rate : float
    full_solves : int
        Number of points at which the full model was solved before the run; 0 without a reduced model.
    warmup : int
        Number of warm-up steps that the limits allow.
    costs : tuple of two float
        Usual number of solves for one step of all chains, during and after warm-up.
    """

    problem: Any
    numbers: dict[str, int]
    limits: Limits
    saved: Checkpoint | None
    max_failure_rate: float
    full_solves: int
    warmup: int
    costs: tuple[float, float]

    @classmethod
    def of(
        cls,
        problem: LogDensity,
        settings: Sampler,
        numbers: dict[str, int],
        limits: Limits,
        checkpoint: Any,
        max_failure_rate: float,
    ) -> Task:
        """Return the task, and discard the failures that the problem has recorded so far.

        Warm-up and the first draws are shortened to fit within the limits. A resumed run keeps its warm-up. Raise
        ValueError unless `max_failure_rate` lies between 0 and 1.
        """
        from fmu.analysis.trace.densities import is_updating
        from fmu.analysis.trace.failure_ledger import failure_rate_exceeded
        from fmu.runs import Checkpoint
        from fmu.samplers.kernel import Target
        from fmu.samplers.settings import usual_costs

        failure_rate_exceeded(0, 0, max_failure_rate)  # raises if the rate is invalid
        getattr(problem, "take_failures", list)()
        saved = checkpoint if checkpoint is None or isinstance(checkpoint, Checkpoint) else Checkpoint(checkpoint)
        full_solves = problem.model.full_solves if is_updating(problem) else 0
        costs = usual_costs(settings, numbers["chains"], Target(problem).solves_per_gradient)
        warmup, limits = limits.shorten(numbers["warmup"], costs)
        if saved is not None:
            warmup = _saved_warmup(saved, numbers["warmup"], warmup)
        return cls(problem, numbers, limits, saved, max_failure_rate, full_solves, warmup, costs)


class Beginning(NamedTuple):
    """Starting points and settings of a run.

    `is_new` is True if the run began with a search for the maxima, and False if they were known or not searched
    for. `n_solves` is the number of solves that it took to adapt the settings to the maxima.
    """

    settings: Sampler
    starts: Starts
    maxima: Maxima | None
    is_new: bool
    n_solves: int


def begin(
    task: Task, settings: Sampler, init: str | ArrayLike, jumps: bool | None, maxima: Maxima | None
) -> Beginning:
    """Choose the starting points and settings of the chains, after a search for maxima if one is needed.

    Maxima that were passed in or are stored with the checkpoint are not searched for again. A hierarchical problem
    is not searched.
    """
    from fmu.analysis.maxima.results import NEGLIGIBLE
    from fmu.analysis.maxima.search import find_map, is_searchable
    from fmu.analysis.maxima.starts import choose_starts, components, worth_starting_from
    from fmu.analysis.trace.densities import is_updating
    from fmu.progress.phases import solves
    from fmu.runs.maxima import kept_maxima
    from fmu.samplers.mixture.mixture import with_jumps

    problem, is_new = task.problem, False
    if maxima is None and is_searchable(problem):
        maxima = None if task.saved is None else kept_maxima(task.saved.directory, problem)
        is_new = maxima is None
        maxima = maxima or find_map(problem)
    begin_at = maxima if is_updating(problem) else maxima and worth_starting_from(problem, maxima)
    chains, seed = task.numbers["chains"], task.numbers["seed"]
    starts = choose_starts(problem, init, begin_at, chains, settings.walkers, seed)
    if begin_at is not None:  # chains that start elsewhere may be caught at any maximum
        caught_at = [m for m in begin_at if m.starting_share > NEGLIGIBLE or starts.word != "maxima"]
        if jumps is None and len(caught_at) > 1 and settings.is_local:
            settings = with_jumps(settings)
    before = solves()
    if settings.takes_maxima and (begin_at is not None or not is_searchable(problem)):
        settings = settings.starting_from(*components(problem, begin_at), near=starts.word == "maxima")
    return Beginning(settings, starts, maxima, is_new, solves() - before)


def draw(task: Task, beginning: Beginning, report: Report | None, engine: Engine) -> tuple[RunResult, str]:
    """Draw until the requested number of steps is reached, the run has converged, or a limit ends it.

    The run also ends if more draws cannot make it converge (`fmu.analysis.convergence.diagnosis.draws_missing`).
    The draws are saved if there is a checkpoint.

    Returns
    -------
    result : RunResult
    limit : str
        The limit that ended the run, in words; empty if there was none.

    Raises
    ------
    ValueError
        If a starting point is outside the bounds, or the log-probability or a gradient that the sampler needs is
        not finite there; if a setting does not fit the problem; or if the checkpoint contains another run, or one
        that is still running.
    OSError
        If the checkpoint cannot be written to.
    StoppedRun
        If the run was stopped; the exception has the trace so far.
    KeyboardInterrupt
        If the stop was requested during the last draw, or if Ctrl-C is pressed in a run without a checkpoint.
    TooManyFailuresError
        If the fraction of failed solves exceeds the limit.
    RunFailedError
        If workers die repeatedly, or the connection to a cluster is lost.
    """
    from fmu.analysis.convergence.diagnosis import draws_missing, with_maxima
    from fmu.analysis.convergence.effective import live_diagnostics
    from fmu.analysis.trace.failure_ledger import failure_rate_exceeded
    from fmu.interruption import interruptible
    from fmu.runs.maxima import keep_maxima
    from fmu.samplers.loop.run import Run
    from fmu.samplers.loop.saving import Interrupted

    problem, settings, maxima, limits = task.problem, beginning.settings, beginning.maxima, task.limits
    with ExitStack() as stack:  # closed before the analyses that follow the draws
        store = stop = None
        if task.saved is not None:
            store = stack.enter_context(_store(task, beginning, task.saved))
            if beginning.is_new and maxima is not None:
                keep_maxima(store.directory, maxima, problem)
            stop = stack.enter_context(interruptible())
        try:
            run = Run(
                problem,
                settings,
                **{**task.numbers, "warmup": task.warmup},
                init=beginning.starts.position,
                progress=report,
                engine=engine,
                checkpointer=store,
                stop=stop,
                too_many_failed=lambda failed, solves, why: failure_rate_exceeded(
                    failed, solves, task.max_failure_rate, failures=why
                ),
                live=live_diagnostics,
            )
            first = limits.first_after(task.warmup, run.warmup_solves, task.costs)
            result, limit = run.extend(first), ""
            while limits.until_ess is not None and not limit:
                so_far = _as_trace(task, beginning, result, draws_only=True)
                missing = draws_missing(so_far, limits.until_ess, maxima)
                if not missing:
                    break
                allowed, limit = limits.allow(result)
                if allowed:
                    result = run.extend(min(missing, allowed))
            run.report_end()
        except Interrupted as stopped:
            stack.close()
            if stopped.result is None:
                raise StoppedRun("in warm-up", None) from None
            drawn = _as_trace(task, beginning, stopped.result, predictions=False)
            drawn.attrs["complete"] = 0
            planned = "" if limits.until_ess is not None else f"of {limits.first} "
            where = f"after {stopped.result.draws} {planned}draws"
            raise StoppedRun(where, drawn if maxima is None else with_maxima(drawn, maxima)) from None
        if stop is not None and stop():  # the last draw is saved
            raise KeyboardInterrupt
    return result, limit


def convert(task: Task, beginning: Beginning, result: RunResult, limit: str) -> xr.DataTree:
    """Return the trace of all draws, with the attributes and groups that the verdict needs."""
    from fmu.analysis.convergence.diagnosis import with_maxima
    from fmu.analysis.estimate import gradient_cost
    from fmu.analysis.trace.densities import is_updating

    problem = task.problem
    trace = _as_trace(task, beginning, result)
    if _takes_exact_gradients(trace, problem, beginning.settings):
        last = result.posterior.position[: result.chains // result.groups, -1]
        trace.attrs["gradient_cost"] = gradient_cost(problem, last)
    if beginning.maxima is not None:
        trace = with_maxima(trace, beginning.maxima)
    if limit:
        trace.attrs["limit"] = limit
        trace.attrs["beyond_limit"] = task.limits.describe_excess(result, task.numbers["warmup"])
    trace.attrs["complete"] = 1
    if is_updating(problem) and problem.model.certificate is not None:
        trace.attrs.update(problem.model.certificate.attributes())  # no verdict before the certificate
    return trace


def examine(task: Task, beginning: Beginning, trace: xr.DataTree, engine: Engine) -> xr.DataTree:
    """Return the trace with certificates, modes, pairing, identifiability and the leave-one-out table added.

    The engine solves the full models for the certificate of a reduced model. Identifiability and the table are
    computed only if the problem is not hierarchical and its likelihood has residuals (`Likelihood.of_modes`). If
    the problem is not an updating problem, its trace is returned unchanged.
    """
    from fmu.analysis.certificate import certify
    from fmu.analysis.frf.certificate import certify_frfs
    from fmu.analysis.held_out.modes import with_left_out
    from fmu.analysis.identifiability import with_identifiability
    from fmu.analysis.pairing_changes import with_pairing
    from fmu.analysis.trace.densities import is_updating
    from fmu.analysis.trace.modal_states import with_modes

    problem, maxima = task.problem, beginning.maxima
    if not is_updating(problem):
        return trace
    with problem.model.spread_over(engine):
        certificate = certify(trace, problem, full_solves=task.full_solves)
    trace.attrs.update({} if certificate is None else certificate.attributes())
    of_frfs = certify_frfs(trace, problem)
    trace.attrs.update({} if of_frfs is None else of_frfs.attributes())
    trace = with_pairing(with_modes(trace, problem, maxima), problem)
    if problem.is_hierarchical or not problem.likelihood.of_modes:
        return trace
    return with_left_out(with_identifiability(trace, problem, maxima), problem)


def _as_trace(
    task: Task, beginning: Beginning, result: RunResult, *, predictions: bool = True, draws_only: bool = False
) -> xr.DataTree:
    from fmu.analysis.trace.conversion import to_trace

    starts = beginning.starts
    result = replace(result, init=starts.word)
    return to_trace(result, task.problem, starts.origin, predictions=predictions, draws_only=draws_only)


def _store(task: Task, beginning: Beginning, saved: Checkpoint) -> Store:
    """Open the checkpoint of a run, and return its store."""
    from fmu.analysis.trace.densities import names_of, units_of
    from fmu.analysis.trace.provenance import describe_inputs
    from fmu.runs.identity import Identity
    from fmu.runs.store import Store
    from fmu.samplers.settings import describe

    problem, settings = task.problem, beginning.settings
    run = {**task.numbers, "walkers": settings.walkers, "init": beginning.starts.origin}
    if task.warmup < task.numbers["warmup"]:
        run[_SHORTENED] = task.warmup
    configuration = describe_inputs(problem, settings.name, describe(settings), run)
    return Store(saved, Identity.of(configuration), names_of(problem), units_of(problem))


def _saved_warmup(saved: Checkpoint, asked: int, warmup: int) -> int:
    """Return the number of warm-up steps with which a run resumes.

    A saved run that also requested `asked` warm-up steps keeps its own number, which its limits may have
    shortened. If the saved run requested another number, or if its record is missing or cannot be read, the
    number is `warmup`.
    """
    from fmu.durable_files import DamagedError
    from fmu.runs.identity import Identity

    try:
        identity = Identity.read(Path(saved.directory))
    except DamagedError:
        return warmup
    run = {} if identity is None else identity.configuration["run"]
    return int(run.get(_SHORTENED, asked)) if run.get("warmup") == asked else warmup


def engine_of(workers: int | str | Engine, stack: ExitStack) -> Engine:
    """Return the engine that runs the tasks. If it is created here, `stack` closes it."""
    from fmu.engines import engine
    from fmu.engines.base import Engine

    if isinstance(workers, Engine):
        return workers
    return stack.enter_context(engine(cluster=workers) if isinstance(workers, str) else engine(workers))


def _takes_exact_gradients(trace: xr.DataTree, problem: LogDensity, settings: Sampler) -> bool:
    """Return True if the run used exact gradients whose cost exceeds the solves counted for them.

    This is False for finite differences, whose solves are counted, and for a user's function, which returns value
    and gradient in one call.
    """
    from fmu.analysis.trace.densities import is_updating

    is_function = is_updating(problem) and bool(problem.model.functions)
    return bool(trace.attrs["n_gradients"]) and not is_function and settings.gradient != "central-difference"
