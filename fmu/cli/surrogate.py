"""Whether ``fmu run`` lets a surrogate stand for a slow model, and what it says of that."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from fmu.numbers import significant, whole

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fmu.engines.base import Engine
    from fmu.posterior.problem import UpdatingProblem


def wants_surrogate(problem: UpdatingProblem, asked: bool | None) -> bool:
    """Return whether a surrogate is to be learnt: as asked for, or where a solve of a user's function is slow.

    Raises
    ------
    click.UsageError
        If one is asked for that is not possible.
    """
    from fmu.analysis.estimate import seconds_of_a_solve
    from fmu.fem.black_box import SLOW_S
    from fmu.surrogates.learning import can_learn

    if asked is False:
        return False
    why_not = can_learn(problem)
    if asked and why_not:
        raise click.UsageError(f"--surrogate: {why_not}.")
    if asked or why_not:
        return bool(asked)
    return seconds_of_a_solve(problem) >= SLOW_S


def with_surrogate(
    problem: UpdatingProblem, orders: Mapping[str, Any], engine: Engine, speaks: bool
) -> UpdatingProblem:
    """Learn the surrogate; say before what it will cost, and after what it is worth."""
    from fmu.analysis.certificate import surrogate_in_words
    from fmu.analysis.estimate import seconds_of_a_solve, time_in_words
    from fmu.surrogates.learning import expected_solves, most_solves, surrogate

    if speaks:
        one_s, n = seconds_of_a_solve(problem), expected_solves(problem)
        click.echo(
            f"A solve takes {significant(one_s, 2)} s: Gaussian processes learn from about {whole(n)} solves, "
            f"{time_in_words(n * one_s / engine.workers)}, and stand for the model (--no-surrogate: it is solved "
            "for every draw). Solves are stored, and used again.",
            err=True,
        )
    most = min(most_solves(problem), orders["max_solves"])
    found = surrogate(problem, seed=orders["seed"], engine=engine, max_solves=most)
    if speaks:
        for sentence in surrogate_in_words(found.model.record):
            click.echo(sentence, err=True)
    return found
