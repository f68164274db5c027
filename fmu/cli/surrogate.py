"""Surrogates in ``fmu run``: decide whether one replaces a slow model, build it, and print messages about it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from fmu.numbers import significant, whole

if TYPE_CHECKING:
    import xarray as xr

    from fmu.config.kept import KeptProblem, Orders
    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem
    from fmu.runs.run_directory import RunDirectory

MAX_SOLVES = 2_000_000
"""Default limit on a sampler's solves, including warm-up, at which a run ends even if it has not converged."""
NO_SURROGATE = (
    "--exact: this model has no surrogate, so its draws are exact already. Leave out --exact or, if the model can "
    "have a surrogate, add --surrogate."
)
_MOST = 8
"""Default limit on the proposals for exact draws, relative to the number solved first."""
_THINNED = 4
"""ESS at which the surrogate's sampler first stops, relative to the number of proposals solved first."""


def wants_surrogate(problem: UpdatingProblem, asked: bool | None) -> bool:
    """Return True if a surrogate is to be built.

    `asked` decides this. If it is None, a surrogate is built if a solve of the model is slow and a surrogate is
    possible (`can_learn`).

    Raises
    ------
    click.UsageError
        If a surrogate is requested but not possible.
    """
    from fmu.analysis.estimate import seconds_of_a_solve
    from fmu.fem.programs.solves import SLOW_S
    from fmu.surrogates.learning import can_learn

    if asked is False:
        return False
    why_not = can_learn(problem)
    if asked and why_not:
        raise click.UsageError(f"--surrogate: {why_not}.")
    if asked or why_not:
        return bool(asked)
    return seconds_of_a_solve(problem) >= SLOW_S


def with_surrogate(problem: UpdatingProblem, orders: Orders, engine: Engine, speaks: bool) -> UpdatingProblem:
    """Build a surrogate and return the problem that uses it.

    If `speaks`, print its expected cost and then its certificate.
    """
    from fmu.analysis.estimate import seconds_of_a_solve, time_in_words
    from fmu.surrogates.delayed_acceptance import proposals
    from fmu.surrogates.learning import certificate_of, expected_solves, surrogate

    if speaks:
        one_s, n = seconds_of_a_solve(problem), expected_solves(problem)
        click.echo(
            f"A solve takes {significant(one_s, 2)} s: Gaussian processes learn from about {whole(n)} solves, "
            f"{time_in_words(n * one_s / engine.workers)}, and stand for the model (--no-surrogate: it is solved "
            "for every draw). Solves are stored, and used again.",
            err=True,
        )
        if orders.get("exact"):
            more = proposals(orders["until_ess"], orders["chains"])
            click.echo(
                f"Then about {whole(more)} of its draws, or more where it is poor, are solved, and accepted or "
                f"rejected (--exact): {time_in_words(more * one_s / engine.workers)}.",
                err=True,
            )
    found = surrogate(problem, seed=orders["seed"], engine=engine, max_solves=_budget(problem, orders))
    if speaks:
        for sentence in certificate_of(found).sentences():
            click.echo(sentence, err=True)
    return found


def _budget(problem: UpdatingProblem, orders: Orders) -> int:
    """Return the largest number of solves for a surrogate.

    This is the requested limit. If draws are made exact or no limit was requested, it is at most the default of
    `fmu.surrogate`.
    """
    from fmu.surrogates.learning import most_solves

    by_default, most = most_solves(problem), int(orders["max_solves"])
    return min(by_default, most) if most == MAX_SOLVES or orders.get("exact") else most


def may_learn_more(problem: UpdatingProblem, orders: Orders) -> bool:
    """Return True if the surrogate needs a higher limit on solves to learn more.

    This is the case if the limit leaves fewer solves than are needed to check the surrogate again.
    """
    from fmu.surrogates.learning import CHECKS, certificate_of

    return _budget(problem, orders) - certificate_of(problem).solves < CHECKS


def of_its_surrogate(asked: KeptProblem, problem: UpdatingProblem, running: RunDirectory) -> KeptProblem:
    """Save the hash of the solves that a run's surrogate learnt from; return the problem and options with it.

    If a run is resumed with more solves, its surrogate is new. A message is then printed, and all saved draws from
    the earlier surrogate are removed.
    """
    design = problem.model.configuration()["design"]
    is_other = asked.orders.get("design", design) != design
    asked = replace(asked, orders={**asked.orders, "design": design})
    if is_other:
        click.echo("The surrogate has learnt from other solves than before: the draws begin anew.", err=True)
        asked = replace(asked, finished=())
        running.begin(asked)
    else:
        asked.save(running.folder)
    return asked


def exact_draws(
    problem: UpdatingProblem, name: str, *, until_ess: float, most: int | None, workers: Engine, **arguments: Any
) -> xr.DataTree:
    """Return exact posterior draws by accepting or rejecting surrogate draws.

    More surrogate draws are made until the exact draws have converged and reach `until_ess`, or a limit on solves
    or on surrogate draws is reached. If a limit is reached, the trace has the attribute ``limit``.

    Parameters
    ----------
    problem : UpdatingProblem
        Problem with a surrogate.
    name : str
        Name of the sampler that draws from the surrogate's posterior.
    until_ess : float
        Bulk and tail ESS that every parameter must reach.
    most : int, optional
        Limit on solves, including the solves for the surrogate. By default the solves for the surrogate do not
        count, and the limit is ten exact solves per unit of the required ESS.
    workers : Engine
    **arguments
        Arguments of `fmu.sample`.

    Raises
    ------
    ValueError
        If `most` leaves fewer exact solves than there are chains.
    """
    from fmu.sampling import sample
    from fmu.surrogates.delayed_acceptance import delayed_acceptance, proposals
    from fmu.surrogates.learning import certificate_of

    chains, learnt = arguments["chains"], certificate_of(problem).solves
    first = proposals(until_ess, chains)
    left = _MOST * first if most is None else most - learnt
    if left < chains:
        raise ValueError(
            f"max_solves: must leave some for exact draws (got {most}, and the surrogate took {learnt})"
        )
    enough = _THINNED * first
    tell_draws = arguments.pop("on_draws", None)  # called with the model's draws, not the surrogate's
    while True:
        trace = sample(problem, name, until_ess=enough, workers=workers, **arguments)
        found = delayed_acceptance(problem, trace, until_ess=until_ess, max_solves=left, engine=workers)
        solved = found.attrs["second_stage_proposals"]
        if "limit" not in found.attrs or "limit" in trace.attrs or solved + chains > left:
            if tell_draws is not None:
                tell_draws(found)
            return found
        enough *= 2
