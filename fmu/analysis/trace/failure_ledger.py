"""Tabulate a run's failed solves, and check the failure rate at which the run stops."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from fmu.numbers import share
from fmu.posterior.failures import Failure

ENOUGH_SOLVES = 200
"""Smallest number of solves that gives a reliable failure rate, because chains may start where the model fails."""


class FailedSolves(NamedTuple):
    """Failed solves in one part of a run.

    Attributes
    ----------
    task : int
        Index of the chains' group.
    phase : str
        Phase of the run: "start", "warmup" or "draws".
    step : int
        Number of steps completed in the phase by the end of the part.
    failures : sequence of Failure
        Recorded failures (`fmu.UpdatingProblem.take_failures`).
    n_failed : int
        Number of failed evaluations. It exceeds the number of recorded failures if some failed at the same theta,
        or if very many failed.
    """

    task: int
    phase: str
    step: int
    failures: Sequence[Failure]
    n_failed: int


def failures_csv(
    names: Sequence[str], units: Sequence[str], parts: Iterable[FailedSolves], header: bool = True
) -> str:
    """Return the table of failed solves as CSV, with all digits of the numbers.

    Parameters
    ----------
    names, units : sequence of str, one per parameter
    parts : iterable of FailedSolves
    header : bool
        Whether to write the header; False to append to a file.

    Returns
    -------
    str
        One row per recorded failure, in the order of `parts`: ``task``, ``phase`` and ``step`` as in
        `FailedSolves`; the parameters in SI units, as ``E [Pa]``; ``reason``. Failures at a repeated or an
        unrecorded theta are counted in a row without parameters.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    if header:
        writer.writerow(_columns(names, units))
    writer.writerows(_rows(len(names), parts))
    return text.getvalue()


def failure_rate_exceeded(
    n_failed: int,
    n_solves: int,
    limit: float,
    at_least: int = ENOUGH_SOLVES,
    failures: Sequence[Failure] = (),
) -> str | None:
    """Return a message if too many of the solves failed, otherwise None.

    Parameters
    ----------
    n_failed, n_solves : int
        Number of failed solves, and number of all solves.
    limit : float
        Largest failure rate allowed; with 1 no run is ever stopped.
    at_least : int
        Smallest number of solves for which the rate is judged.
    failures : sequence of Failure
        If given, the most frequent reason is part of the message.

    Raises
    ------
    ValueError
        If the limit does not lie between 0 and 1.
    """
    if not 0.0 <= limit <= 1.0:
        raise ValueError(f"limit: must lie between 0 and 1, a share of the solves (got {limit!r})")
    if n_solves < at_least or n_failed <= limit * n_solves:
        return None
    why = ""
    if failures:
        reason, _ = Counter(failure.reason for failure in failures).most_common(1)[0]
        why = f"; most often: {reason}"
    failed = share(n_failed / n_solves, digits=4)
    return f"{n_failed} of {n_solves} solves failed ({failed}), more than the limit of {share(limit)}{why}"


def _columns(names: Sequence[str], units: Sequence[str]) -> list[str]:
    parameters = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
    return ["task", "phase", "step", *parameters, "reason"]


def _rows(ndim: int, parts: Iterable[FailedSolves]) -> Iterable[list[object]]:
    for part in parts:
        place = [part.task, part.phase, part.step]
        for failure in part.failures:
            yield [*place, *failure.theta.tolist(), failure.reason]
        others = part.n_failed - len(part.failures)
        if others > 0:
            yield [*place, *[None] * ndim, f"{others} more failed solves, at a theta above or not recorded"]
