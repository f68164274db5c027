"""Test whether a new test comes from the population of earlier tests and, if not, which parameter has departed.

A test's score is the distance of a parameter's value from the population mean, in population standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from annotated_types import Ge

from fmu.analysis.trace.conversion import SCORED_TEST_STREAM, generator
from fmu.analysis.trace.reading import check_trace, parameter_draws, parameter_names
from fmu.arguments import ArgumentError, check_arguments
from fmu.formats.shown import names_shown
from fmu.numbers import names_in_words
from fmu.posterior.joint.joint_problem import NextTest, draw_next_test
from fmu.posterior.joint.modal_test import Test, TestsError
from fmu.tables import data_frame
from fmu.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from fmu.posterior.problem import UpdatingProblem

MOST_DRAWS = 4000
"""Default largest number of posterior draws at which the next test is simulated."""
LEAST_DRAWS_PER_MODE = 10
ALIKE = 1.1
"""Largest ratio of the standard deviations of errors that are taken to be the same."""
CLEAR = 2.0 * np.log(20.0)
"""Two departures can be told apart if one makes the data 20 times as probable as the other."""


@check_arguments
def predict_tests(
    trace: xr.DataTree,
    problem: UpdatingProblem,
    tests: Sequence[Test],
    *,
    like: str | None = None,
    draws: Annotated[int, Ge(2)] = MOST_DRAWS,
) -> pd.DataFrame:
    """Compare new tests of a structure with the posterior prediction of the next test.

    Each new test is compared with the earlier tests only, not with the other new tests. If values are correlated
    in time, or a loss has an unknown date, the new test must have the covariate that serves as time. If test
    numbers serve as time, the scores of each new test follow those of the last earlier test, and a sudden loss is
    that of the last earlier test. A growing loss must have a covariate as time, because test numbers do not tell
    how much further it has grown.

    The next test is simulated at n posterior draws: its scores are drawn from the populations, it has the
    covariates and the group of the new test, and measurement errors are added. The statistic is the squared
    Mahalanobis distance D² = (y − ȳ)ᵀ S⁻¹ (y − ȳ) of the frequencies that the new test has. The mean ȳ and the
    covariance S are those of the n simulated tests and the new one together, and p is the fraction of these n + 1
    tests whose D² is at least that of the new test. If the new test is from the population, all its ranks by D²
    are equally probable, and p ≤ α has the probability α, averaged over campaigns and new tests.

    If only the score of parameter j departs, the frequencies change in the direction aⱼ, the regression of the
    simulated frequencies on the scores. Let now ȳ and S be the mean and covariance of the simulated tests alone.
    With the residual r = y − ȳ, the shift that fits best is aⱼᵀS⁻¹r / aⱼᵀS⁻¹aⱼ. It explains the part
    tⱼ² = (aⱼᵀS⁻¹r)² / aⱼᵀS⁻¹aⱼ of rᵀS⁻¹r, a generalised likelihood ratio (Kay 1998, *Fundamentals of Statistical
    Signal Processing: Detection Theory*, sec. 6.4). If no score departs, tⱼ has mean 0 and standard deviation 1.

    Parameters
    ----------
    trace : xarray.DataTree
        Draws from the posterior of `problem`.
    problem : UpdatingProblem
        A `fmu.JointProblem` with a population.
    tests : sequence of Test
        The new tests. Their modes have the labels of the problem's modes, and may be fewer. Their frequency
        errors, masses, springs and known parameters are taken from a test of the problem; see `like`. Standard
        deviations in the data of a new test are not used.
    like : str, optional
        Name of the problem's test whose configuration and errors the new tests have. Default: the first test of
        the same group (of all tests, if no test has this group) that has all modes of the new test. The tests to
        choose from must then share masses, springs and known parameters, and the standard deviations of their
        errors in these modes must agree within 10 %. In the test `like`, the value of at least one parameter with
        a population must be unknown. If a parameter depends on the group, as with scatter between groups, an
        earlier test must have the group of the new test.
    draws : int
        Largest number of draws used, evenly spaced over the trace. The model is solved at each of them. Draws at
        which it has no solution are left out.

    Returns
    -------
    pandas.DataFrame
        One row per test:

        - ``p_value``: p, between 1/(n + 1) and 1;
        - ``parameter``: the parameter with a population that explains the departure best;
        - ``or_parameters``: other parameters that the data cannot distinguish from it, because the best fit with
          one makes the data less than 20 times as probable as the best fit with the other;
        - ``change``: the best-fitting change of ``parameter`` from its population mean, relative to this mean; NaN
          if the mean is zero;
        - ``score NAME``: tⱼ, for each parameter with a population; NaN if its value in the test is known;
        - ``draws``: n.

        All columns except ``p_value`` and ``draws`` assume that one parameter departed, and mean nothing for a
        test from the population.

    Raises
    ------
    TestsError
        If the new tests do not fit the problem; the error lists every fault.
    ValueError
        If the problem has no population, no frequency errors, or a growing loss whose time is the test number, if
        the trace belongs to another problem, or if fewer than ten draws for each mode of a new test are used.
    """
    check_trace(trace)
    if parameter_names(trace) != problem.names:
        raise ArgumentError("trace", "must be of the problem (its parameters have other names)")
    require_next_test(problem)
    wanted, found = [], []
    for number, test in enumerate(tests):
        try:
            wanted.append(_find_like(problem, test, like))
        except TestsError as error:
            found += [f"tests.{number}.{mistake}" for mistake in error.mistakes]
    if found:
        raise TestsError(found)
    theta = parameter_draws(trace).reshape(-1, problem.ndim)
    theta = theta[np.linspace(0, len(theta) - 1, min(draws, len(theta))).astype(int)]
    seed, simulated = int(trace.attrs.get("seed", 0)), dict[object, NextTest]()
    rows = []
    for test, t in zip(tests, wanted, strict=True):
        needed = {role.where for role in problem.roles if role.kind == "slope"} | _times(problem)
        covariates = {name: x for name in sorted(needed) if (x := test.known_covariate(name)) is not None}
        key = (t, *covariates.values())
        if key not in simulated:
            simulated[key] = _without_failures(
                draw_next_test(problem, generator(seed, SCORED_TEST_STREAM), theta, t, covariates)
            )
        rows.append(_compare(problem, test, problem.tests[t], simulated[key]))
    return data_frame(rows, "test", [test.name for test in tests])


def require_next_test(problem: UpdatingProblem) -> None:
    """Raise ValueError unless the frequencies of a test can be drawn from a population, at a known time."""
    if not problem.is_hierarchical:
        rule = 'must have a parameter with varies = "population", from which the next test is drawn'
        raise ArgumentError("problem", rule, "none")
    if not problem.likelihood.simulates:
        raise ArgumentError("problem", "must have errors of frequencies, which a new test has too", "none")
    layout = problem.layout
    for parameter, value_of in zip(layout.structural, layout.values_of, strict=True):
        if layout.by_date.get(parameter.name) == "" and value_of.sudden_loss is None:
            rule = (
                f"must have the time of the growing loss of {parameter.name} as a covariate, since the numbers of "
                'the tests do not tell how far it has grown in a new test; name it (onset = { by = "day", grows = '
                "true }), give each test its value, and sample again"
            )
            raise ArgumentError("problem", rule, "test numbers")


def _find_like(problem: UpdatingProblem, test: Test, like: str | None) -> int:
    """Return the index of the earlier test whose configuration and errors apply to a new test.

    Raise TestsError if the new test or `like` does not fit the problem.
    """
    found: list[str] = []
    every = problem.tests
    names, groups = [one.name for one in every], list(dict.fromkeys(one.group for one in every))
    labels = list(dict.fromkeys(label for one in every for label in one.data.labels))
    if test.name in names:
        found.append(f"name: must not be that of a test that was updated with; rename it (got {test.name!r})")
    unknown = [label for label in test.data.labels if label not in labels]
    found += [f"labels: must be modes among {names_shown(labels)} (got {label!r})" for label in unknown]
    for role in problem.roles:
        if role.kind == "slope" and role.where not in test.covariates:
            name = "" if role.of is None else problem.layout.structural[role.of].name
            found.append(f"covariates: must have {role.where}, on which {name} depends (got none)")
        elif role.kind == "slope" and test.known_covariate(role.where) is None:
            found.append(
                f"covariates.{role.where}: must be a number in a further test (got a value to be inferred)"
            )
    for name in sorted(_times(problem)):
        if test.known_covariate(name) is None:
            found.append(f"covariates: must have {name} as a number, which is the time of a test (got none)")
    if like is not None and like not in names:
        found.append(f"like: must be one of {names_shown(names)} (got {like!r})")
    by_group = bool(problem.layout.by_state) or any(
        role.kind in ("effect", "sd") and role.where for role in problem.roles
    )
    if by_group and test.group not in groups:
        found.append(
            f"group: must be one of {names_shown(groups)}, as a parameter varies by group (got {test.group!r})"
        )
    if found:
        raise TestsError(list(dict.fromkeys(found)))
    same = [
        t
        for t, one in enumerate(every)
        if (one.name == like if like is not None else test.group not in groups or one.group == test.group)
    ]
    if like is not None and by_group and every[same[0]].group != test.group:
        raise TestsError(
            [f"like: must be a test of the group {test.group} (got {like!r}, of {every[same[0]].group})"]
        )
    if len({every[t].configuration[:3] for t in same}) > 1:
        rule = "must name the test whose masses, springs and known parameters the new test has, as they differ"
        raise TestsError([f"like: {rule} (got none)"])
    first = every[same[0]]
    if any(test.configuration[:3]) and test.configuration[:3] != first.configuration[:3]:
        rule = "must have no masses, springs and known parameters, or those of"
        raise TestsError([f"like: {rule} {first.name!r}; name another test"])
    if set(problem.layout.populations) <= first.known.keys():
        rule = "must name a test in which the value of a parameter with a population is unknown"
        raise TestsError([f"like: {rule} (got {first.name!r})"])
    fitting = [t for t in same if set(test.data.labels) <= set(every[t].data.labels)]
    if not fitting:
        modes = names_in_words(test.data.labels)
        raise TestsError(
            [f"labels: must be modes that one of the earlier tests has all (got {modes}); leave one out"]
        )
    sd = np.array([_standard_deviations(problem, t, test.data.labels) for t in fitting])
    if np.any(sd.max(axis=0) > ALIKE * sd.min(axis=0)):
        raise TestsError(["like: must name the test whose errors the new test has, as they differ (got none)"])
    return fitting[0]


def _standard_deviations(problem: UpdatingProblem, t: int, labels: Sequence[str]) -> FloatArray:
    """Return the standard deviations of the errors of some modes in test `t`, in the unit of the errors.

    Inferred standard deviations have their starting values.
    """
    columns = np.flatnonzero(problem.model.test_of_modes == t)
    columns = columns[[problem.tests[t].data.labels.index(label) for label in labels]]
    term = problem.likelihood.frequency_term
    assert term is not None  # narrowed for the type checker: `require_next_test` has checked it
    return np.sqrt(term.spread.variance(problem.start[None, problem.n_structural :])[0, columns])


def _times(problem: UpdatingProblem) -> set[str]:
    """Return the names of the covariates that give the times of tests, for correlation in time or dated losses."""
    layout = problem.layout
    return {by for by in layout.by_date.values() if by} | (layout.in_time.times if layout.in_time else set())


def _without_failures(drawn: NextTest) -> NextTest:
    """Return the simulated tests without the draws at which the model could not be solved."""
    solved = np.isfinite(drawn.measured).all(axis=1)
    return NextTest(*(part[solved] for part in drawn))


def _compare(problem: UpdatingProblem, test: Test, like: Test, drawn: NextTest) -> Mapping[str, object]:
    """Return the table row of a new test, given draws of the next test with the modes of the test `like`.

    Raise ValueError if there are fewer than ten draws for each mode.
    """
    columns = [like.data.labels.index(label) for label in test.data.labels]
    y, measured = drawn.measured[:, columns], np.asarray(test.data.frequencies_hz)
    n = len(y)
    if n < LEAST_DRAWS_PER_MODE * len(columns):
        rule = f"must have {LEAST_DRAWS_PER_MODE * len(columns)} draws at least for {len(columns)} modes"
        raise ArgumentError("trace", rule, n)
    populations = [p.name for p in problem.layout.structural if p.name in problem.layout.populations]
    free = [j for j, name in enumerate(populations) if name not in like.known]
    number = {p.name: j for j, p in enumerate(problem.layout.structural)}
    departures = [_departure(drawn.scores, j, drawn.values[:, number[populations[j]]], y, measured) for j in free]
    found = {populations[j]: one for j, one in zip(free, departures, strict=True)}
    best = max(found, key=lambda name: abs(found[name].score))
    alike = [name for name, one in found.items() if name != best and found[best].score ** 2 - one.score**2 < CLEAR]
    return {
        "p_value": rank_p_value(y, measured),
        "parameter": best,
        "or_parameters": ", ".join(alike),
        "change": found[best].change,
        **{f"score {name}": found[name].score if name in found else np.nan for name in populations},
        "draws": n,
    }


def rank_p_value(simulated: FloatArray, measured: FloatArray) -> float:
    """Return a p-value: the rank of a measurement's squared Mahalanobis distance among simulations.

    Parameters
    ----------
    simulated : ndarray, shape (n, m)
    measured : ndarray, shape (m,)

    Returns
    -------
    float
        (1 + number of simulations at least as far as the measurement) / (n + 1). Mean and covariance are computed
        from simulations and measurement together, so that all n + 1 are treated alike.
    """
    together = np.vstack([measured, simulated])
    off = (together - together.mean(axis=0)) / together.std(axis=0)
    distance = np.einsum("ni,ni->n", off, np.linalg.solve(off.T @ off, off.T).T)
    return float(np.mean(distance >= distance[0]))


class _Departure(NamedTuple):
    """Departure of one parameter in a new test: the score tⱼ and the parameter's relative change."""

    score: float
    change: float


def _departure(scores: FloatArray, j: int, value: FloatArray, y: FloatArray, measured: FloatArray) -> _Departure:
    """Return tⱼ and the relative change of the parameter whose scores are in column `j`; see `predict_tests`."""
    z = scores - scores.mean(axis=0)
    scale = y.std(axis=0)
    off, r = (y - y.mean(axis=0)) / scale, (measured - y.mean(axis=0)) / scale
    a = np.linalg.lstsq(z, off)[0][j]
    weighted = np.linalg.solve(off.T @ off / (len(y) - 1), a)
    size = float(weighted @ a)
    by_score = float(z[:, j] @ value / (z[:, j] @ z[:, j]))
    mean = float(value.mean())
    change = float(weighted @ r) / size * by_score / abs(mean) if mean else np.nan
    return _Departure(float(weighted @ r) / np.sqrt(size), change)
