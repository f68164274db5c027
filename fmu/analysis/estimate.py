"""Estimate the cost of a run in solves and seconds, and the cost of a gradient."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fmu.numbers import fixed, whole
from fmu.samplers.registry import make_sampler, plan_steps
from fmu.samplers.settings import usual_costs

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem
    from fmu.samplers.kernel import Sampler
    from fmu.types import FloatArray, LogDensity

_CLIMB = 12  # evaluations with gradient
_WEIGHED = 1024  # draws for each maximum
_SLOW_S = 0.005
_OVERHEAD_S = 1e-4  # time of a step without its solve
_MOST_OVERHEAD_S = 5e-3
_PROBES, _PROBE_S = 5, 0.04
_CERTIFIED = 64  # time of a certificate, in full solves
_WORTH_S = 60.0
_NEAR = (
    0.1  # share of the way from the starting point to a prior draw, where the reduced model is used as in the run
)
_FEWEST, _MOST, _MEASURED_S, _AT_ONCE = 5, 50, 0.05, 16


class Estimate(NamedTuple):
    """Estimated cost of one part of a run: its name, solves, seconds, and the limit on its solves, if any."""

    name: str
    solves: float
    seconds: float
    most: int | None = None


def estimates(problem: UpdatingProblem, orders: Mapping[str, Any], starts: int, workers: int) -> list[Estimate]:
    """Estimate the cost of each sampler, and of each other part of a run that takes a second or longer.

    The search for maxima is included only if a solve takes more than 5 ms or calls a user's function. The list is
    empty if the whole run takes less than a minute. Progress bars then suffice, and a busy machine would make the
    estimates wrong.

    Parameters
    ----------
    problem : UpdatingProblem
        The problem, which is solved a few times to measure the time of a solve.
    orders : mapping of str
        ``samplers``, ``draws``, ``warmup``, ``chains``, ``groups`` and ``max_solves`` of the run. If ``draws`` is
        None, each sampler is estimated up to the first verdict.
    starts : int
        Number of starting points in the search for maxima.
    workers : int
        Number of processes that share the work.
    """
    per_gradient = problem.solves_per_gradient
    is_function = bool(problem.model.functions)
    one_s = seconds_of_a_solve(problem)
    is_slow = is_function or one_s > _SLOW_S
    found: list[Estimate] = []
    solves: float
    if is_slow:
        at_once = workers if is_function else 1
        solves = (starts * _CLIMB + 6 * problem.ndim) * per_gradient + _WEIGHED
        found.append(Estimate("search", solves, solves * one_s / at_once))
    for name in orders["samplers"]:
        settings = make_sampler(name)
        lines = orders["chains"] * settings.walkers
        warmup, draws = plan_steps(name, orders["warmup"], orders["draws"])
        of_warmup, of_draw = usual_costs(settings, orders["chains"], per_gradient)
        solves = warmup * of_warmup + draws * of_draw
        if not is_slow:
            side_by_side, each_s = 1, one_s + _OVERHEAD_S
            if (
                solves * (one_s + _MOST_OVERHEAD_S) >= _WORTH_S
            ):  # otherwise measuring it would take longer than it saves
                with suppress(ValueError):  # a start without a finite log-probability: the run will report it
                    each_s = _seconds_in_a_sampler(problem, settings, orders, warmup, draws)
        else:
            each_s = one_s + _OVERHEAD_S
            # a user's function is called in parallel, for at most all chains and walkers of one step
            side_by_side = min(workers, lines) if is_function else min(workers, orders["groups"] or 1)
        most = orders["max_solves"] if orders["draws"] is None else None
        found.append(Estimate(name, solves, solves * each_s / side_by_side, most))
        if is_slow and not is_function:
            predicted = lines * draws * settings.cost[2]
            found.append(Estimate(f"predictions of {name}", predicted, predicted * one_s))
    if problem.model.sizes:
        full_s = _time_call(lambda: problem.model.truth.frequencies(problem.model_parameters(problem.start[None])))
        of_each = Estimate("certificate", _CERTIFIED, _CERTIFIED * full_s)
        found += [of_each] * len(orders["samplers"])
    if sum(part.seconds for part in found) < _WORTH_S:
        return []
    samplers = set(orders["samplers"])
    return [part for part in found if part.name in samplers or part.seconds >= 1.0]


def estimates_in_words(parts: list[Estimate]) -> str:
    """Format the estimates in one line: ``hmc: about 36 000 solves, 12 min (at most 2 000 000 solves)``.

    No time is stated for the largest number of solves, because a run is not expected to take that long.
    """
    found = []
    for name, solves, seconds, most in parts:
        longest = "" if most is None else f" (at most {whole(most)} solves)"
        found.append(f"{name}: about {_round_number(solves)} solves, {time_in_words(seconds)}{longest}")
    return "; ".join(found)


def gradient_cost(density: LogDensity, theta: FloatArray) -> float:
    """Return the time of a gradient divided by the time of a log-probability.

    Each time is the shortest of at least five measurements, which alternate between the two, because other work on
    the machine can only lengthen a measurement.

    Parameters
    ----------
    density : LogDensity
        A density with exact gradients.
    theta : ndarray, shape (n, ndim)
        Points evaluated in one batch; only the first 16 are used.
    """
    theta = theta[:_AT_ONCE]
    took: list[tuple[float, float]] = []
    end = time.perf_counter() + _MEASURED_S
    while len(took) < _FEWEST or (len(took) < _MOST and time.perf_counter() < end):
        began = time.perf_counter()
        density.log_prob_and_grad(theta)
        between = time.perf_counter()
        density.log_prob(theta)
        took.append((between - began, time.perf_counter() - between))
    gradient_s, value_s = np.min(took, axis=0)
    return float(gradient_s / value_s)


def seconds_of_a_solve(problem: UpdatingProblem) -> float:
    """Return the time of one solve in seconds.

    If the model calls users' functions, this is the total time of the calls that one solve needs.
    """
    of_calls = problem.model.seconds_at(problem.model_parameters(problem.start[None])[0])
    return _time_call(lambda: problem.log_prob(problem.start)) if of_calls is None else of_calls


def _time_call(work: Callable[[], object]) -> float:
    """Return the time of a call in seconds. A call of up to 1 s is repeated: the first may load modules."""
    took = 0.0
    for _ in range(2):
        began = time.perf_counter()
        work()
        took = time.perf_counter() - began
        if took > 1.0:
            break
    return took


def _seconds_in_a_sampler(
    problem: UpdatingProblem, settings: Sampler, orders: Mapping[str, Any], warmup: int, draws: int
) -> float:
    """Return the time per solve in a sampler's first steps, in seconds, including the sampler's own work."""
    from fmu.samplers.loop.group import DRAWS, WARMUP, Chunk, GroupState, RunContext, advance
    from fmu.samplers.loop.run import n_groups

    context = RunContext(problem, settings, max(warmup, 1))
    rng = np.random.default_rng(0)
    chains = orders["chains"] // n_groups(orders["groups"], orders["chains"], settings)
    shape = (chains, problem.ndim) if settings.walkers == 1 else (chains, settings.walkers, problem.ndim)
    near = problem.start + _NEAR * (problem.sample_prior(rng, chains * settings.walkers) - problem.start)
    phase, steps = (WARMUP, warmup) if warmup else (DRAWS, draws)
    group = GroupState.at(context.scaled.to_scaled(near.reshape(shape)), rng)
    each_s = []
    for _ in range(_PROBES):
        began = time.perf_counter()
        done = advance(context, Chunk(group, phase, steps, _PROBE_S, 1))
        solves = int(done.steps.stats["n_solves"].sum())
        each_s.append((time.perf_counter() - began) / max(solves, 1))
        group = done.group
    return float(np.median(each_s))  # the first loads modules, and the machine may be busy


def _round_number(number: float) -> str:
    """Format a number rounded to two significant digits, with thousands separators."""
    digits = len(str(int(number))) - 2
    return whole(round(number, -max(digits, 0)))


def time_in_words(seconds: float) -> str:
    """Format a time given in seconds, rounded and with a suitable unit: ``"12 min"``, ``"under 1 s"``."""
    if seconds < 1.0:
        return "under 1 s"
    for size, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 1.5 * size:
            value = seconds / size
            return f"{fixed(value, 1 if value < 9.95 else 0)} {unit}"
    return f"{fixed(seconds, 0)} s"
