"""Damage estimated by a run: the loss of each parameter in each state, and the probability of large losses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.trace.reading import has, problem_of, roles_of
from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import names_in_words, share, whole
from fmu.tables import data_frame

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

GROUP = "loss"
"""Group of a trace with the losses."""
ANY = "any"
"""Name of the row with the largest loss in a state."""


def probably(p: float) -> str:
    """Return a probability estimated from draws, in per cent: ``"32 %"``, ``"< 1 %"`` or ``"> 99 %"``."""
    return "< 1 %" if p < 0.01 else "> 99 %" if p > 0.99 else f"{whole(round(100.0 * p))} %"


@check_arguments
def damage(trace: xr.DataTree, beyond: Sequence[float] = (0.05, 0.1)) -> pd.DataFrame:
    """Return the losses d = 1 − θ/θ_reference of the parameters that vary between groups of tests.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace of a `fmu.JointProblem` with parameters that vary by ``"group"`` or `fmu.Damage`.
    beyond : sequence of float
        Losses between 0 and 1; the probability of exceeding each of them is computed.

    Returns
    -------
    pandas.DataFrame
        One row for each state and parameter, and one row per state named ``"any"`` for the largest loss of all
        parameters. The columns are ``mean``, ``sd``, ``eti90_lb`` and ``eti90_ub`` (the central 90 %), and
        ``P(loss > 5 %)`` and so on for each value of `beyond`.

    Raises
    ------
    ValueError
        If the trace has no losses, or a value of `beyond` is not between 0 and 1.
    """
    wrong = [x for x in beyond if not 0.0 <= x < 1.0]
    if wrong:
        raise ArgumentError("beyond", "must be between 0 and 1, such as 0.05", wrong[0])
    if not has(trace, GROUP):
        raise ArgumentError("trace", "has no losses, as it has no parameter that varies between groups of tests")
    losses = trace[GROUP].to_dataset()
    names = [str(name) for name in losses.data_vars]
    rows: list[list[float]] = []
    index: list[tuple[str, str]] = []
    for state in losses["state"].to_numpy().tolist():
        draws = np.stack([losses[name].sel(state=state).to_numpy().ravel() for name in names])
        for name, values in zip((*names, ANY), (*draws, draws.max(axis=0)), strict=True):
            low, high = np.quantile(values, (0.05, 0.95))
            rows.append([values.mean(), values.std(ddof=1), low, high, *(np.mean(values > x) for x in beyond)])
            index.append((state, name))
    columns = ["mean", "sd", "eti90_lb", "eti90_ub", *(f"P(loss > {share(x)})" for x in beyond)]
    found = data_frame(dict(zip(columns, np.array(rows).T, strict=True)), "parameter", np.arange(len(rows)))
    import pandas

    found.index = pandas.MultiIndex.from_tuples(index, names=["state", "parameter"])
    return found


def is_loss(trace: xr.DataTree, name: str) -> bool:
    """Return True if a parameter belongs to a later state: its loss, or its value in this state."""
    kind, _, where = roles_of(trace).get(name, ("", "", ""))
    return kind in ("loss", "group") and has(trace, GROUP) and where in _later(trace)


def before_and_after(trace: xr.DataTree) -> pd.DataFrame:
    """Return the posterior means, in SI units, of every parameter that may have lost a share, before and after.

    Returns
    -------
    pandas.DataFrame
        One row for each state and parameter, as in `damage`. The columns are ``before`` and ``after``.
    """
    import pandas

    losses, tests = trace[GROUP].to_dataset(), trace["tests"].to_dataset()
    first = tests_in(trace, str(trace[GROUP].attrs["reference"]))[0]
    rows: dict[tuple[str, str], tuple[float, float]] = {}
    for state in _later(trace):
        for name in map(str, losses.data_vars):
            before = tests[name].sel(test=first)
            after = before * (1.0 - losses[name].sel(state=state))
            rows[state, name] = float(before.mean()), float(after.mean())
    index = pandas.MultiIndex.from_tuples(list(rows), names=["state", "parameter"])
    return pandas.DataFrame(list(rows.values()), index, ["before", "after"])


def tests_in(trace: xr.DataTree, state: str) -> list[str]:
    """Return the names of the tests of a state."""
    return [str(test["name"]) for test in problem_of(trace)["tests"] if test["group"] == state]


def before_in_words(trace: xr.DataTree) -> str:
    """Return the reference state and its tests: ``"reference (tests reference 1 and reference 2)"``."""
    return state_in_words(trace, str(trace[GROUP].attrs["reference"]))


def state_in_words(trace: xr.DataTree, state: str) -> str:
    """Return a state and its tests: ``"pattern 1 (test one)"``."""
    tests = tests_in(trace, state)
    return state if tests == [state] else f"{state} (test{'s' * (len(tests) > 1)} {names_in_words(tests)})"


def _later(trace: xr.DataTree) -> list[str]:
    return [str(state) for state in trace[GROUP]["state"].to_numpy().tolist()]
