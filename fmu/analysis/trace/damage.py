"""Damage estimated by a run: each parameter's loss in each state or test, and probabilities of large losses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fmu.analysis.fit.checks import contradicted_laws
from fmu.analysis.trace.reading import LOSSES, has, later_states, problem_of
from fmu.arguments import ArgumentError, check_arguments
from fmu.numbers import given, names_in_words, whole
from fmu.tables import data_frame

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

BY_TEST = "loss_by_test"
"""Name of the trace group with each test's losses, for damage at an unknown date."""
ANY = "any"
"""Row name for the largest loss in a state or test."""
WITHHELD = "withheld"
"""Text for a probability that is not given, and name of the table attribute with the reason."""


def probably(p: float) -> str:
    """Format a probability estimated from draws as a percentage: ``"32 %"``, ``"< 1 %"`` or ``"> 99 %"``.

    NaN marks a withheld probability and becomes ``"withheld"``.
    """
    if np.isnan(p):
        return WITHHELD
    return "< 1 %" if p < 0.01 else "> 99 %" if p > 0.99 else f"{whole(round(100.0 * p))} %"


def limits_of(beyond: Sequence[float]) -> dict[str, float]:
    """Return the different limits of losses, keyed by their percentages in full, such as ``"12.5 %"``."""
    return {f"{given(round(100.0 * x, 10))} %": x for x in beyond}


@check_arguments
def damage(trace: xr.DataTree, beyond: Sequence[float] = (0.05, 0.1)) -> pd.DataFrame:
    """Return the losses d = 1 − θ/θ_reference of the parameters that vary between groups of tests.

    Parameters
    ----------
    trace : xarray.DataTree
        A trace of a `fmu.JointProblem` with parameters that vary by ``"group"`` or `fmu.Damage`.
    beyond : sequence of float
        Thresholds, at least 0 and below 1; the probability of a loss above each of them is computed.

    Returns
    -------
    pandas.DataFrame
        One row for each state and parameter, and one row per state named ``"any"`` for the largest loss over all
        parameters. The columns are ``mean``, ``sd``, ``eti90_lb`` and ``eti90_ub`` (the central 90 %), and
        ``P(loss > 5 %)`` and so on for each value of `beyond`. These probabilities are NaN if the tests contradict
        a parameter's law, such as its dependence on temperature, because the losses then include effects that the
        law omits; ``attrs["withheld"]`` gives the reason.

    Raises
    ------
    ValueError
        If the trace has no losses, or a value of `beyond` is below 0, or is 1 or more.
    """
    if not has(trace, LOSSES):
        rule = "has no losses, as it has no parameter that varies between groups of tests"
        if has(trace, BY_TEST):
            rule += "; fmu.damage_by_test and the report have the losses from an unknown date on"
        raise ArgumentError("trace", rule)
    return _table(trace, LOSSES, "state", beyond)


@check_arguments
def damage_by_test(trace: xr.DataTree, beyond: Sequence[float] = (0.05, 0.1)) -> pd.DataFrame:
    """Return the losses in each test of the parameters with damage at an unknown date (`fmu.UndatedDamage`).

    Parameters
    ----------
    trace : xarray.DataTree
        A trace of a `fmu.JointProblem` with these parameters.
    beyond : sequence of float
        Thresholds, at least 0 and below 1; the probability of a loss above each of them is computed.

    Returns
    -------
    pandas.DataFrame
        One row for each test and parameter, with the columns of `fmu.damage`, and one row per test named ``"any"``
        for the largest loss over all parameters.

    Raises
    ------
    ValueError
        If the trace has no damage at an unknown date, or a value of `beyond` is below 0, or is 1 or more.
    """
    if not has(trace, BY_TEST):
        raise ArgumentError("trace", "has no losses by test, as no parameter has damage at an unknown date")
    return _table(trace, BY_TEST, "test", beyond)


def _table(trace: xr.DataTree, group: str, each: str, beyond: Sequence[float]) -> pd.DataFrame:
    """Return the table of losses in a trace group, with one row per parameter in each state or test.

    Each state or test has one more row, named ``"any"``, for the largest loss over all parameters. Raise
    ValueError unless every value of `beyond` is at least 0 and below 1.
    """
    wrong = [x for x in beyond if not 0.0 <= x < 1.0]
    if wrong:
        raise ArgumentError("beyond", "must be between 0 and 1, such as 0.05", wrong[0])
    losses, reason, limits = trace[group].to_dataset(), _reason_to_withhold(trace), limits_of(beyond)
    names = [str(name) for name in losses.data_vars]
    rows: list[list[float]] = []
    index: list[tuple[str, str]] = []
    for state in losses[each].to_numpy().tolist():
        draws = np.stack([losses[name].sel({each: state}).to_numpy().ravel() for name in names])
        for name, values in zip((*names, ANY), (*draws, draws.max(axis=0)), strict=True):
            low, high = np.quantile(values, (0.05, 0.95))
            exceeded = [np.nan if reason else float(np.mean(values > x)) for x in limits.values()]
            rows.append([values.mean(), values.std(ddof=1), low, high, *exceeded])
            index.append((state, name))
    columns = ["mean", "sd", "eti90_lb", "eti90_ub", *(f"P(loss > {limit})" for limit in limits)]
    found = data_frame(dict(zip(columns, np.array(rows).T, strict=True)), "parameter", np.arange(len(rows)))
    import pandas

    found.index = pandas.MultiIndex.from_tuples(index, names=[each, "parameter"])
    found.attrs[WITHHELD] = reason
    return found


def _reason_to_withhold(trace: xr.DataTree) -> str:
    """Return the reason why loss probabilities are withheld, or an empty string if they are not."""
    contradicted = contradicted_laws(trace)
    if not contradicted:
        return ""
    return f"P is withheld, as losses include what the laws of the model leave out. {'; '.join(contradicted)}."


def before_and_after(trace: xr.DataTree) -> pd.DataFrame:
    """Return the posterior means, in SI units, of every parameter that has a loss, before and after the damage.

    The mean before damage is taken over the tests of the reference state in which the parameter is unknown. If the
    parameter is known in all tests of this state, the mean of the known values is used.

    Returns
    -------
    pandas.DataFrame
        One row for each state and parameter. The columns are ``before`` and ``after``.
    """
    import pandas

    losses, tests = trace[LOSSES].to_dataset(), trace["tests"].to_dataset()
    undamaged = tests_in(trace, str(trace[LOSSES].attrs["reference"]))
    known = {str(test["name"]): test["known"] for test in problem_of(trace)["tests"]}
    rows: dict[tuple[str, str], tuple[float, float]] = {}
    for state in later_states(trace):
        for name in map(str, losses.data_vars):
            unknown = [test for test in undamaged if name not in known[test]] or undamaged
            before = tests[name].sel(test=unknown).mean("test")
            after = before * (1.0 - losses[name].sel(state=state))
            rows[state, name] = float(before.mean()), float(after.mean())
    index = pandas.MultiIndex.from_tuples(list(rows), names=["state", "parameter"])
    return pandas.DataFrame(list(rows.values()), index, ["before", "after"])


def tests_in(trace: xr.DataTree, state: str) -> list[str]:
    """Return the names of the tests made in a state of the structure."""
    return [str(test["name"]) for test in problem_of(trace)["tests"] if test["group"] == state]


def before_in_words(trace: xr.DataTree) -> str:
    """Return the reference state and its tests in words: ``"reference (tests reference 1 and reference 2)"``."""
    return state_in_words(trace, str(trace[LOSSES].attrs["reference"]))


def state_in_words(trace: xr.DataTree, state: str) -> str:
    """Return a state and its tests in words: ``"pattern 1 (test one)"``.

    Return only the state if its single test has the same name.
    """
    tests = tests_in(trace, state)
    return state if tests == [state] else f"{state} (test{'s' * (len(tests) > 1)} {names_in_words(tests)})"
