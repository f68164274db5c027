"""`fmu.sample`, which samples the posterior of a problem and returns a trace."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Interval

from fmu.arguments import Chains, Count, Draws, OwnRule, Seed, Workers, check_arguments, shown
from fmu.samplers.registry import SAMPLERS as SAMPLERS
from fmu.sampling.limits import Limits
from fmu.sampling.steps import StoppedRun as StoppedRun
from fmu.sampling.steps import Task, begin, convert, draw, engine_of, examine

if TYPE_CHECKING:
    import os

    import xarray as xr
    from numpy.typing import ArrayLike

    from fmu.analysis.maxima.results import Maxima
    from fmu.engines.base import Engine
    from fmu.runs import Checkpoint
    from fmu.samplers.kernel import Sampler
    from fmu.types import LogDensity, Positive

INITS = ("maxima", "prior", "start")
"""Values of `init` that name starting points."""
DEFAULT_SAMPLER = "mixture"
"""Name of the default sampler, whose ESS per evaluation no other sampler of fmu exceeded.

ESS per evaluation of the worst parameter, after a warm-up of 1000 steps; a gradient counts as 1.9 evaluations:

- cantilever-young, bulk ESS: 0.54 for the mixture, 0.05 for HMC;
- cantilever-section paired by number, bulk ESS: 0.77 for the mixture, 0.05 for HMC;
- shear-2dof, bulk ESS: 0.59 for the mixture, 0.02 for HMC;
- shear-10dof, bulk ESS: 0.06 for both, after 20 000 evaluations for the mixture and 35 000 for HMC to converge;
- densities without known maxima, such as a banana, two modes and a funnel, smaller of bulk and tail ESS: 0.20 to
  0.75 for the mixture, 0.03 to 0.20 for HMC;
- four of these densities without gradients: 0.26 to 0.76 for the mixture, 0.05 to 0.14 for Metropolis–Hastings;
- a Python function of two parameters: 0.35 for the mixture, 0.22 for Metropolis–Hastings.
"""


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

    The same problem, sampler, settings and seed give the same draws, bit for bit, whatever the number of workers
    and however often the run was interrupted. There is one exception: for a function without gradients, the limit
    of the search depends on whether a solve takes 0.05 s (`fmu.find_map`). If it takes about that long, pass
    ``maxima=fmu.find_map(problem, starts=16)`` to make the draws repeatable.

    Parameters
    ----------
    problem : LogDensity
        An `UpdatingProblem`, or any object with ``ndim``, ``lower``, ``upper``, ``log_prob`` and, if the sampler
        needs exact gradients, ``log_prob_and_grad``. Its attributes ``offset``, ``scale``, ``start`` and
        ``sample_prior`` are used if it has them (`fmu.types.LogDensity`).
    sampler : str or Sampler, optional
        ``"mh"``, ``"slice"``, ``"hmc"``, ``"emcee"``, ``"mixture"``, ``"gibbs"`` or ``"tempering"`` with default
        settings, or a settings object such as ``fmu.HamiltonianMonteCarlo(gradient="central-difference")``. The
        default is the mixture, because no other sampler gave a larger effective sample size per evaluation in our
        comparisons. For a posterior with populations (`fmu.JointProblem`) the default is Gibbs sampling
        (`fmu.samplers.gibbs.gibbs`).
    draws, warmup : int
        Number of retained steps, and number of warm-up steps before them. Each retained step of an ensemble gives
        one draw per walker.
    chains : int
        Number of independent chains or, for an ensemble sampler, of independent ensembles.
    seed : int
        Seed of the random numbers.
    init : {"maxima", "prior", "start"} or array_like, shape (chains, ndim) or (chains, walkers, ndim)
        Where the chains start. ``"maxima"``: around the maxima of the posterior, in proportion to their
        probability (`fmu.analysis.maxima.starts`), or around the typical point of a hierarchical posterior. This
        is not done if the density is infinite at a bound. If `problem` is not an updating problem, it is done
        only if the masses of its maxima are reliable and there are several maxima or no prior. Otherwise the
        chains start at draws from the prior; without a prior, or if the log-density is not finite at some of these
        draws, they start at scattered points. ``"prior"``: at draws from the prior. ``"start"``: at
        ``problem.start``; the walkers of an ensemble start close to it. An array: at these points, in SI units.
    jumps : bool, optional
        Whether every second step of ``"mh"``, ``"slice"`` or ``"hmc"`` is an independent proposal from a mixture
        that is fitted to the posterior in warm-up. Chains then cross between separated maxima
        (`fmu.samplers.mixture.mixture.with_jumps`). By default True if at least two maxima have more than 1 % of
        the probability each, or if several maxima are known and the chains do not start at them.
    groups : int, optional
        Number of groups into which the chains are divided for several workers. The chains of a group advance and
        are tuned together, so the draws depend on this number. By default all chains form one group, and each
        ensemble is a group of its own.
    until_ess : float, optional
        If given, sampling continues after `draws`, with the settings learnt in warm-up, until the draws pass the
        convergence tests of `fmu.diagnose` and every parameter has at least this bulk and tail ESS. Sampling also
        ends at a limit, or if divergences or heavy-tailed weights make more draws useless. The number of missing
        draws is predicted from the draws so far (`fmu.analysis.convergence.remedies.draws_to_come`). The draws are
        the same, bit for bit, as in a run with the same warm-up and `draws` set to the final number. An ensemble
        sampler must also run for at least 50 autocorrelation times; four ensembles of 32 walkers then have an ESS
        of at least 6400.
    max_draws : int, optional
        Largest number of retained steps, whatever the verdict. Defaults to 32 times `draws`, or to no limit if
        `max_solves` is given.
    max_solves : int, optional
        Approximate largest number of solves in warm-up and draws; the search for maxima and the analyses after the
        draws are not counted. If the sampler usually needs more solves for `warmup` and `draws`, both are
        shortened. If the run ends at a limit, the verdict states by how much the warm-up was shortened and reports
        an excess of more than 1 %.
    maxima : Maxima, optional
        Result of `fmu.find_map`. It is stored in the trace, and every verdict on the trace uses it. By default
        `fmu.sample` searches for the maxima, wherever the chains start, except in a hierarchical posterior.
    checkpoint : path-like or Checkpoint, optional
        A directory in which the draws and the state of the sampler are saved during the run. The same call with
        the same directory resumes a run that was stopped or killed. After a finished run, the same call reads the
        draws from the directory and repeats only the analyses.
    workers : int, str or Engine
        Number of processes on this machine that advance the groups and solve the full model for the certificate;
        or a Dask scheduler's address, ``"tcp://host:port"``; or an engine from `fmu.engine`.
    max_failure_rate : float
        The run stops when more than this fraction of the solves has failed, after at least 200 solves. If 1,
        failures never stop the run.
    progress : bool or callable, optional
        Whether to draw progress bars on a terminal or in a notebook, or to write log lines to standard error
        elsewhere. By default there are only the bars in a notebook. A callable replaces the display: it is called
        as ``progress(phase, done, total, info)`` after every step in this process, and several times a second for
        steps in other processes; see `fmu.samplers.Run`. It is also called in the long phases before and after the
        draws, such as ``"search"`` and ``"predictions"``, with the number of solves in the phase in
        ``info["solves"]``.
    on_draws : callable, optional
        Called with the trace after the last draw, before the analyses that need further solves: the certificate,
        the mode shapes and leave-one-out. `fmu.diagnose` can already judge this trace.

    Returns
    -------
    xarray.DataTree
        The trace; see `fmu.analysis.trace.conversion.to_trace`. Its attributes include ``before_n_solves``, the
        number of solves that it took to adapt the sampler to the maxima; ``after_n_solves``, the number of solves
        after the last draw (for example for predictions); ``gradient_cost``, the time of an exact gradient divided
        by the time of a log-probability, if the sampler uses exact gradients and they do not come from a user's
        function; the certificate of the reduced model or surrogate, if there is one
        (`fmu.analysis.certificate.certify`); and ``limit``, which names the limit that ended a run before it had
        converged and reached `until_ess`. The trace of an updating problem also has the groups ``modes``
        (`fmu.analysis.trace.modal_states`), ``pairing`` (`fmu.analysis.pairing_changes`), ``identifiability``
        (`fmu.analysis.identifiability`) and ``leave_one_out`` (`fmu.analysis.held_out.modes`), as far as they
        apply to it.

    Raises
    ------
    ValueError
        If the name of the sampler is unknown, the sampler needs gradients that `problem` lacks, a setting does not
        fit `problem`, `jumps` is True for a sampler without local steps, `groups` does not suit the chains or the
        sampler, a trace cannot store the name of a parameter, or a number is out of range. Also if `max_draws` or
        `max_solves` is given without `until_ess`; if `init` is unknown, has the wrong shape or needs a prior or a
        start that `problem` lacks; if a chain would start outside the bounds or where the log-probability, or a
        gradient that the sampler needs, is not finite; or if `checkpoint` contains another run, one that is still
        running, or one that was made with other versions of fmu, NumPy, SciPy or emcee.
    OSError
        If `checkpoint` cannot be written to.
    StoppedRun
        If Ctrl-C or SIGTERM stopped a run with a checkpoint before its last draw. This KeyboardInterrupt has the
        trace so far, without the analyses that need further solves, or None if the run was still in warm-up. A
        stop after the last draw raises a plain KeyboardInterrupt; the draws are saved.
    TooManyFailuresError
        If the fraction of failed solves exceeds `max_failure_rate`.
    RunFailedError
        If workers die repeatedly, or the connection to a cluster is lost.
    """
    from fmu.progress import reporting
    from fmu.progress.phases import solves, told_to
    from fmu.samplers.mixture.mixture import with_jumps

    settings = _settings_of(default_sampler(problem) if sampler is None else sampler)
    settings = with_jumps(settings) if jumps else settings
    limits = Limits.of(draws, until_ess, max_draws, max_solves)
    numbers = _check(problem, settings, init, workers, warmup=warmup, chains=chains, groups=groups, seed=seed)
    task = Task.of(problem, settings, numbers, limits, checkpoint, max_failure_rate)
    with reporting(progress, settings.name) as report, told_to(report), ExitStack() as stack:
        beginning = begin(task, settings, init, jumps, maxima)
        engine = engine_of(workers, stack)
        result, limit = draw(task, beginning, report, engine)
        before = solves()
        trace = convert(task, beginning, result, limit)
        if on_draws is not None:
            on_draws(trace)
        trace = examine(task, beginning, trace, engine)
        trace.attrs |= {"before_n_solves": beginning.n_solves, "after_n_solves": solves() - before}
    return trace


def default_sampler(problem: LogDensity) -> str:
    """Return the name of the default sampler for a problem.

    For a hierarchical posterior it is ``"gibbs"``: each test adds parameters, and a mixture cannot be fitted to so
    many of them.
    """
    from fmu.analysis.maxima.search import is_searchable

    return DEFAULT_SAMPLER if is_searchable(problem) else "gibbs"


DEFAULTS: Mapping[str, Any] = {
    name: argument.default
    for name, argument in inspect.signature(sample).parameters.items()
    if argument.kind is argument.KEYWORD_ONLY
}
"""Keyword arguments of `sample` with their default values, which ``fmu run`` uses too."""


def _settings_of(sampler: str | Sampler) -> Sampler:
    """Return the settings of a sampler given by name, or the settings object itself.

    Raise ValueError if `sampler` is neither a known name nor a settings object.
    """
    from fmu.samplers.kernel import Sampler
    from fmu.samplers.registry import make_sampler

    if isinstance(sampler, str):
        return make_sampler(sampler)
    if not isinstance(sampler, Sampler):
        raise ValueError(
            f"sampler: must be one of {', '.join(SAMPLERS)}, or a settings object derived from "
            f"fmu.samplers.Sampler, such as fmu.Slice() (got {sampler!r})"
        )
    return sampler


def _check(
    problem: LogDensity,
    settings: Sampler,
    init: Any,
    workers: Any,
    *,
    warmup: Any,
    chains: Any,
    groups: Any,
    seed: Any,
) -> dict[str, int]:
    """Check the arguments; return the numbers that determine a run's draws, keyed by name.

    Raise ValueError if an argument is invalid.
    """
    import numpy as np

    from fmu.analysis.trace.densities import names_of
    from fmu.posterior.parameters import require_name
    from fmu.samplers.loop.run import n_groups
    from fmu.samplers.settings import whole_number

    if isinstance(workers, str) and "://" not in workers:
        raise ValueError(f"workers: must be the address of a scheduler, such as tcp://host:8786 (got {workers!r})")
    for name in names_of(problem):
        require_name(name)
    if settings.gradient == "exact" and not hasattr(problem, "log_prob_and_grad"):
        raise ValueError(
            f"sampler: {settings.name} needs a density with log_prob_and_grad; without it take 'mixture', or "
            "fmu.HamiltonianMonteCarlo(gradient='central-difference')"
        )
    if isinstance(init, str):
        if init not in INITS:
            raise ValueError(f"init: must be one of {', '.join(INITS)} or an array (got {init!r})")
    else:
        shape = (chains, problem.ndim) if settings.walkers == 1 else (chains, settings.walkers, problem.ndim)
        if np.shape(init) != shape or not np.isfinite(init).all():
            raise ValueError(f"init: must be finite, of shape {shape} (got {shown(init)})")
    warmup, chains = whole_number("warmup", warmup, 0), whole_number("chains", chains, 1)
    seed, groups = whole_number("seed", seed, 0), n_groups(groups, chains, settings)
    return {"warmup": warmup, "chains": chains, "groups": groups, "seed": seed}
